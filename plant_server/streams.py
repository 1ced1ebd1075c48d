"""Random streams: one of its own for every purpose, derived from (seed, patient, purpose).

Two runs that differ in one thing only, say the strategy, meet the same numbers everywhere else: comparisons are paired.
"""

import hashlib

import numpy as np


def stream(seed: int, patient: str, purpose: str) -> np.random.Generator:
    """The generator of one purpose.

    Args:
        seed: of the run, 0 or greater.
        patient: name of the virtual patient.
        purpose: e.g. "cgm"; another word is another, independent stream.
    """
    words = [seed, *(int.from_bytes(hashlib.sha256(text.encode()).digest()[:8]) for text in (patient, purpose))]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(words)))
