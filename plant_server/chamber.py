"""One drug's side of the pump: reservoir, line and motor, and what the pump notices of them."""

import enum
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from . import mechanism
from .mechanism import AIR, DELIVERED, DOUBLE_EVERY, FLUID, HELD, MISS_EVERY, PENDING, SLOWED


class Occlusion(enum.IntEnum):
    """PUMP_Status.InsulinOcclusion and PramOcclusion."""

    CLEAR = 0
    SUSPECTED = 1
    OCCLUDED = 2


@dataclass(frozen=True)
class ChamberSettings:
    """Sizes of one chamber, in strokes."""

    stroke_units: int  # of the rate's unit times 30 s in one stroke
    stroke_volume: float  # U or ug
    capacity: int
    low: int  # ReservoirLow at or below
    occluded_at: int  # held back strokes at which the pressure sensor trips
    priming: int  # strokes that fill the line at a change of reservoir


INSULIN = ChamberSettings(
    stroke_units=mechanism.INSULIN_STROKE,
    stroke_volume=mechanism.INSULIN_STROKE_U,
    capacity=6000,  # 300 U
    low=400,  # 20 U
    occluded_at=60,  # 3.0 U, within the 2.5 to 5 U that pump manuals state
    priming=10,  # 0.5 U
)

PRAMLINTIDE = ChamberSettings(
    stroke_units=mechanism.PRAMLINTIDE_STROKE,
    stroke_volume=mechanism.PRAMLINTIDE_STROKE_UG,
    capacity=8000,  # 4000 ug
    low=200,  # 100 ug
    occluded_at=60,  # the same volume of fluid as the insulin line's 3.0 U at 10 ug/U
    priming=10,
)


class Chamber:
    """A reservoir, a line and a motor.

    `occluded` and `words[AIR]` are what is physically so; `occlusion` is what the pump has noticed.
    """

    def __init__(self, settings: ChamberSettings) -> None:
        self.settings = settings
        self.words = mechanism.motor(settings.capacity)
        self.occluded = False
        self.stopped = False  # the pump has stopped the motor after an occlusion
        self._out = np.zeros(mechanism.SUBSTEPS)

    @property
    def occlusion(self) -> Occlusion:
        """What the pressure sensor says."""
        if self.stopped:
            return Occlusion.OCCLUDED
        return Occlusion.SUSPECTED if self.words[HELD] * 2 >= self.settings.occluded_at else Occlusion.CLEAR

    @property
    def remaining(self) -> float:
        """U or ug in the reservoir."""
        return float(self.words[FLUID]) * self.settings.stroke_volume

    @property
    def low(self) -> bool:
        """Whether the reservoir is at its warning level."""
        return bool(self.words[FLUID] <= self.settings.low)

    @property
    def empty(self) -> bool:
        """Whether the reservoir is empty."""
        return bool(self.words[FLUID] == 0)

    @property
    def available(self) -> int:
        """Strokes in the reservoir that nothing has been commanded of yet."""
        return max(int(self.words[FLUID] - (self.words[PENDING] - self.words[HELD])), 0)

    @property
    def delivered(self) -> int:
        """Strokes that have reached the patient."""
        return int(self.words[DELIVERED])

    def run(self, rate: int, *, halted: bool = False) -> npt.NDArray[np.float64]:
        """Run the motor for a sampling interval.

        Args:
            rate: see `mechanism.run`.
            halted: the pump is suspended or has no power: no stroke is made, and what waits for the motor is lost.

        Returns:
            The amounts within each 30-s step, in an array that is used again.
        """
        settings = self.settings
        stopped = self.stopped or halted
        mechanism.run(
            self.words, rate, settings.stroke_units, settings.stroke_volume, self.occluded, stopped, self._out
        )
        if self.words[HELD] >= settings.occluded_at:
            self.stopped = True
        return self._out

    def occlude(self) -> None:
        """Block the line: strokes are held back until the pressure sensor trips and stops the motor."""
        self.occluded = True

    def release(self, *, lost: bool = False) -> None:
        """Open the line and let the motor go on; what was held back comes out at once, or is lost."""
        if lost:
            mechanism.lose_held(self.words)
        self.occluded = False
        self.stopped = False

    def insert_air(self, strokes: int) -> None:
        """An air bubble: the next strokes deliver nothing."""
        self.words[AIR] += strokes

    def mend(self) -> None:
        """The motor is sound; what is still wrong with it has to be said again."""
        self.words[[SLOWED, MISS_EVERY, DOUBLE_EVERY]] = 0

    def change(self) -> None:
        """The user changes reservoir and line: full again, primed, without air or occlusion."""
        self.release(lost=True)
        self.words[FLUID] = max(self.settings.capacity - self.settings.priming, 0)
        self.words[AIR] = 0
