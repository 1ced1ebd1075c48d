"""What was asked for against what the pump's totals say it gave: a motor that slips or runs away shows here.

The pump turns rates into whole strokes, so that the two differ by less than one of them as long as all is well. The
balance only tells; what counts for doses is what the totals say.
"""

from .day import STEPS_PER_HOUR


class Balance:
    """One drug's balance since the device or its link to the pump was last started anew.

    Args:
        tolerance: difference that is none yet, in the unit of the totals: ten strokes (project's choice).
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._twelfths = 0  # of the unit of the totals: a rate per hour is so many of them in a step

    def reset(self) -> None:
        """What was asked for in between is not known."""
        self._twelfths = 0

    def account(self, per_hour: int, bolus: int, delivered: int) -> None:
        """A step: the rate in force, what newly turned out of boluses, and what the totals grew by."""
        self._twelfths += STEPS_PER_HOUR * (delivered - bolus) - per_hour

    def off(self, under_way: int) -> bool:
        """Whether the pump gave more or less than it was asked for; of a bolus `under_way` any part may be given."""
        return not -self._tolerance <= self._twelfths // STEPS_PER_HOUR <= self._tolerance + under_way
