"""The pump's electronics, compiled: `plant_server.pump`, its set-points and boluses without faults, on a sound wire.

The motors are those of the plant (`plant_server.mechanism`). As in `device`, every function bears the name of the
method it repeats.
"""

from plant_server import mechanism
from plant_server.bolus import STROKE_RAW, Phase
from plant_server.mechanism import BOLUS_DELIVERED, FLUID, HELD, PENDING
from plant_server.set_point import MILLIUNITS_PER_LSB
from pumpbench.closed_loop.compiled import Words, helper

begin_bolus = helper(mechanism.begin_bolus)
end_bolus = helper(mechanism.end_bolus)

PROGRAMMED, DELIVERING = int(Phase.PROGRAMMED), int(Phase.DELIVERING)
DONE, ABORTED = int(Phase.DONE), int(Phase.ABORTED)

RATE, PRAM_RATE, COMMANDED, EXPIRES = range(4)
"""Words of the set-point in force: 0.001 U/h, 0.1 ug/h, whether it is a command, its last step."""

PHASE, STROKES = range(2)
"""Words of one drug's newest bolus (`plant_server.bolus.DrugBolus`)."""


# ---- set-points (plant_server.set_point.SetPoint)


@helper
def fall_back(pump: Words, schedule: int) -> None:
    """`SetPoint.fall_back` to the stored schedule in 0.001 U/h."""
    pump[COMMANDED] = 0
    pump[RATE] = schedule
    pump[PRAM_RATE] = 0


@helper
def command(
    pump: Words, rate: int, pram_rate: int, limit: int, pram_limit: int, schedule: int, step: int, ahead: int
) -> tuple[bool, bool]:
    """`SetPoint.take` with SET_RATE: which of the two drugs' rates was accepted."""
    accepted, pram_accepted = rate <= limit, pram_rate <= pram_limit
    if accepted or pram_accepted:
        pump[COMMANDED] = 1
        pump[EXPIRES] = step + ahead
        pump[RATE] = rate * MILLIUNITS_PER_LSB if accepted else schedule
        pump[PRAM_RATE] = pram_rate if pram_accepted else 0
    return accepted, pram_accepted


@helper
def expire(pump: Words, schedule: int, step: int) -> None:
    """`SetPoint.expire`."""
    if pump[COMMANDED] and step > pump[EXPIRES]:
        fall_back(pump, schedule)


# ---- reservoirs (plant_server.chamber.Chamber)


@helper
def available(motor: Words) -> int:
    """`Chamber.available`."""
    return int(max(motor[FLUID] - (motor[PENDING] - motor[HELD]), 0))


# ---- boluses (plant_server.bolus.DrugBolus)


@helper
def limit_raw(motor: Words, max_raw: int) -> int:
    """`DrugBolus.limit_raw`."""
    return min(max_raw, available(motor) * STROKE_RAW)


@helper
def program(bolus: Words, dose: int, limit: int) -> bool:
    """`DrugBolus.judge` of a Program for a new bolus; whether it was accepted."""
    if dose > limit:
        return False
    bolus[PHASE], bolus[STROKES] = PROGRAMMED, 0
    return True


@helper
def commit(bolus: Words, motor: Words, dose: int) -> None:
    """`DrugBolus.judge` of the Commit that follows in the same instant."""
    bolus[STROKES] = dose // STROKE_RAW
    begin_bolus(motor, bolus[STROKES])
    bolus[PHASE] = DELIVERING if bolus[STROKES] else DONE


@helper
def cancel(bolus: Words, motor: Words) -> None:
    """`DrugBolus.judge` of a Cancel in the instant of the Program."""
    end_bolus(motor)
    bolus[PHASE] = ABORTED


@helper
def follow(bolus: Words, motor: Words) -> None:
    """`DrugBolus.follow`: without air and occlusion a bolus always comes to its end, for the reservoir holds it."""
    if bolus[PHASE] == DELIVERING and motor[BOLUS_DELIVERED] == bolus[STROKES]:
        bolus[PHASE] = DONE


@helper
def delivered_raw(bolus: Words, motor: Words) -> int:
    """`DrugBolus.delivered_raw`."""
    return 0 if bolus[STROKES] == 0 else int(motor[BOLUS_DELIVERED] * STROKE_RAW)
