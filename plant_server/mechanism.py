"""The pump's motors: rates become whole strokes, and every stroke is accounted for.

For each drug, in strokes and at every instant: commanded = delivered + pending + lost. A rate fills an accumulator in
exact integer units; a full accumulator is one commanded stroke. Strokes are made on the 30-s grid of the plant. A made
stroke reaches the patient, is held back by an occlusion (and stays pending), or moved air or nothing (and is lost).

The strokes of a bolus are commanded all at once and made before those of the rate. They are followed apart, so that
what of a bolus has reached the patient is exact whatever happens to the line.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

SUBSTEPS = 10
"""30-s steps in one sampling interval."""

INSULIN_STROKE_U = 0.05
PRAMLINTIDE_STROKE_UG = 0.5

INSULIN_STROKE = 6000
"""A stroke of 0.05 U in units of 0.001 U/h for 30 s."""

PRAMLINTIDE_STROKE = 600
"""A stroke of 0.5 ug in units of 0.1 ug/h for 30 s."""

STROKES_PER_SUBSTEP = 15
"""Fastest motor: a stroke every 2 s, 1.5 U/min of insulin (the order of commercial pumps)."""

(
    ACCUMULATED, COMMANDED, PENDING, DELIVERED, LOST, HELD, FLUID, AIR, BOLUS, BOLUS_HELD, BOLUS_DELIVERED,
    SLOWED, MISS_EVERY, MISS_SINCE, DOUBLE_EVERY, DOUBLE_SINCE,
) = range(16)  # fmt: skip
"""Words of one drug's motor, in strokes but for the first: HELD is the part of PENDING that an occlusion holds back in
the line, FLUID what is left in the reservoir, AIR what of the line is air. Of the newest bolus BOLUS is what is not
made yet (a part of PENDING), BOLUS_HELD its part of HELD, BOLUS_DELIVERED its part of DELIVERED.

What is wrong with the motor, all 0 when it is sound: SLOWED is by how many strokes per 30 s it is slower, every
MISS_EVERYth stroke moves nothing and every DOUBLE_EVERYth moves twice the fluid, and so many strokes were made SINCE
the last one of these, always fewer than EVERY."""

MOTOR_WORDS = 16

Words = npt.NDArray[np.int64]


def motor(fluid: int) -> Words:
    """A motor at rest that has delivered nothing, with `fluid` strokes in its reservoir."""
    words = np.zeros(MOTOR_WORDS, dtype=np.int64)
    words[FLUID] = fluid
    return words


@njit(cache=True)  # type: ignore[untyped-decorator]
def run(
    words: Words,
    rate: int,
    stroke: int,
    volume: float,
    blocked: bool,
    stopped: bool,
    out: npt.NDArray[np.float64],
) -> None:
    """Run one motor for a sampling interval.

    Args:
        words: the motor, changed in place.
        rate: in the unit of which `stroke` makes one stroke within 30 s.
        stroke: `INSULIN_STROKE` or `PRAMLINTIDE_STROKE`.
        volume: of one stroke, in U or ug.
        blocked: the line is occluded; what is held back comes out when it no longer is.
        stopped: the pump has stopped this motor; what was asked for is lost and never caught up.
        out: gets the amount that reaches the patient within each 30-s step.
    """
    for i in range(out.size):
        words[ACCUMULATED] += rate
        strokes = words[ACCUMULATED] // stroke
        words[ACCUMULATED] -= strokes * stroke
        words[COMMANDED] += strokes
        words[PENDING] += strokes
        arrived = 0
        if stopped:
            waiting = words[PENDING] - words[HELD]
            words[PENDING] -= waiting
            words[LOST] += waiting
            words[BOLUS] = 0
        else:
            made = min(words[PENDING] - words[HELD], STROKES_PER_SUBSTEP - words[SLOWED])
            of_bolus = min(made, words[BOLUS])
            words[BOLUS] -= of_bolus
            moved, moved_of_bolus = made, of_bolus  # strokes' volumes
            if words[MISS_EVERY]:
                moved_of_bolus -= (words[MISS_SINCE] + of_bolus) // words[MISS_EVERY]
                moved -= (words[MISS_SINCE] + made) // words[MISS_EVERY]
                words[MISS_SINCE] = (words[MISS_SINCE] + made) % words[MISS_EVERY]
            if words[DOUBLE_EVERY]:
                moved_of_bolus += (words[DOUBLE_SINCE] + of_bolus) // words[DOUBLE_EVERY]
                extra = (words[DOUBLE_SINCE] + made) // words[DOUBLE_EVERY]
                words[DOUBLE_SINCE] = (words[DOUBLE_SINCE] + made) % words[DOUBLE_EVERY]
                words[COMMANDED] += extra  # nobody asked for it: the motor did it by itself
                words[PENDING] += extra
                made += extra
                moved += extra
            air = min(moved, words[AIR])
            words[AIR] -= air
            fluid = min(moved - air, words[FLUID])
            words[FLUID] -= fluid
            words[PENDING] -= made - fluid
            words[LOST] += made - fluid
            words[HELD] += fluid
            words[BOLUS_HELD] += min(max(moved_of_bolus - air, 0), fluid, of_bolus)
        if not blocked:
            arrived = words[HELD]
            words[HELD] = 0
            words[BOLUS_DELIVERED] += words[BOLUS_HELD]
            words[BOLUS_HELD] = 0
            words[PENDING] -= arrived
            words[DELIVERED] += arrived
        out[i] = arrived * volume


def begin_bolus(words: Words, strokes: int) -> None:
    """Command the strokes of a bolus at once; the motor makes them as fast as it can. The last one must be over."""
    words[COMMANDED] += strokes
    words[PENDING] += strokes
    words[BOLUS] = strokes
    words[BOLUS_HELD] = words[BOLUS_DELIVERED] = 0


def end_bolus(words: Words) -> None:
    """What of the bolus is not made yet is lost, and never caught up."""
    words[PENDING] -= words[BOLUS]
    words[LOST] += words[BOLUS]
    words[BOLUS] = 0


def lose_held(words: Words) -> None:
    """What an occlusion held back is lost, e.g. because the user changes the infusion set."""
    words[PENDING] -= words[HELD]
    words[LOST] += words[HELD]
    words[HELD] = words[BOLUS_HELD] = 0


def ledger_closes(words: Words) -> bool:
    """Whether every stroke is accounted for."""
    _, commanded, pending, delivered, lost, held, _, _, bolus, bolus_held = words.tolist()[:BOLUS_DELIVERED]
    parts = 0 <= bolus <= pending - held and 0 <= bolus_held <= held
    return bool(commanded == delivered + pending + lost and 0 <= held <= pending and lost >= 0 and parts)
