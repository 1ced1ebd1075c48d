"""The ideal sensor: interstitial glucose as it is."""

from typing import Literal

import numpy as np

from .model import Errors, Model, Streams, Wear, additive


class Ideal(Model):
    """No error: what is left is the delay of the interstitial fluid, which is in the patient."""

    name: Literal["ideal"] = "ideal"

    def draw(self, wear: Wear, streams: Streams) -> Errors:
        """All errors are zero."""
        return additive(np.zeros(wear.instants), 0.0)
