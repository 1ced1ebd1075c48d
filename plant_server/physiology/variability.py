"""Variability of the patient from meal to meal and over the day (Pons Torres 2025, tuning and validation).

Every source draws from a stream of its own, derived from (seed, patient, purpose) and, for a meal, its index:
switching one source off, or giving another answer to a meal, never shifts the numbers of another.
"""

import hashlib
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from . import parameters as par
from .compiled import Array


class MealFactors(NamedTuple):
    """Multipliers that hold from one meal to the next."""

    k_abs: float = 1.0
    f: float = 1.0
    insulin: float = 1.0


NOMINAL = MealFactors()
"""A meal like the patient's average one."""

SOURCES = {
    "k_abs": "intestinal absorption rate, per meal, U(0.7, 1.3)",
    "f": "share of absorbed glucose that reaches plasma, per meal, U(0.9, 1.1), capped at f = 1",
    "insulin_pk": "insulin absorption, per meal, one factor U(0.7, 1.3) on ka1, ka2 and kd",
    "circadian": "insulin sensitivity over the day, once per patient, amplitude U(-0.3, 0.3), phase U(0, 2π)",
}
"""What can vary, and what it means."""


class Variability:
    """The random course of one patient under one seed."""

    def __init__(self, seed: int, patient: str, sources: Iterable[str] = tuple(SOURCES)) -> None:
        """Prepare the streams of `patient`.

        Args:
            seed: the study's seed, 0 or greater.
            patient: the patient's name.
            sources: names of `SOURCES` that are on; none of them for a patient who never varies.
        """
        self.seed = seed
        self.patient = patient
        self.sources = frozenset(sources)
        unknown = self.sources - SOURCES.keys()
        if unknown:
            raise ValueError(f"unknown variability {min(unknown)!r}; there are {', '.join(SOURCES)}")

    def meal(self, index: int) -> MealFactors:
        """The factors from meal number `index` (0, 1, ...) until the next; the same at every call."""
        return MealFactors(
            k_abs=self._uniform("k_abs", 0.7, 1.3, index),
            f=self._uniform("f", 0.9, 1.1, index),
            insulin=self._uniform("insulin_pk", 0.7, 1.3, index),
        )

    @property
    def circadian_amplitude(self) -> float:
        """Relative swing of Vmx and kp3 over the day."""
        return self._uniform("circadian", -0.3, 0.3, 0, when_off=0.0)

    @property
    def circadian_phase(self) -> float:
        """Phase of that swing, rad."""
        return self._uniform("circadian", 0.0, 2.0 * math.pi, 1, when_off=0.0)

    def apply(self, p: Array, factors: MealFactors = NOMINAL, out: Array | None = None) -> Array:
        """Return the parameters in effect: the nominal `p` with this patient's day and these `factors`.

        Args:
            p: the patient's nominal parameters, left as they are.
            factors: of the present meal; the default is the time before the first one.
            out: array to write to (a new one otherwise).
        """
        effective = p.copy() if out is None else out
        effective[:] = p
        effective[par.K_ABS] *= factors.k_abs
        effective[par.F] = min(1.0, p[par.F] * factors.f)
        effective[par.KA1] *= factors.insulin
        effective[par.KA2] *= factors.insulin
        effective[par.KD] *= factors.insulin
        effective[par.CIRCADIAN_AMPLITUDE] = self.circadian_amplitude
        effective[par.CIRCADIAN_PHASE] = self.circadian_phase
        return effective

    def _uniform(self, source: str, low: float, high: float, index: int, when_off: float = 1.0) -> float:
        if source not in self.sources:
            return when_off
        # numpy promises the bits of PCG64 but not the methods of Generator; hence the float made by hand.
        purpose = [self.seed, _number(self.patient), _number(source)]
        bits = np.random.PCG64(np.random.SeedSequence(purpose, spawn_key=(index,))).random_raw()
        unit = (int(bits) >> 11) * 2.0**-53
        return low + (high - low) * unit


def _number(text: str) -> int:
    """A stable number for a name; Python's own hash() changes from run to run."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
