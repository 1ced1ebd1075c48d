"""What the firmware does around its control law, compiled: it judges the sample, climbs the ladder, gives boluses.

Every function bears the name of the method it repeats and works on an array of integers in place of that object. It
holds what can happen on a wire that loses nothing and without a reset: the rest is not here, and cannot come about,
for `case.prepare` refuses what would bring it about. One source for both would have to keep, as words of arrays, what
a lost frame, a reset or a suspension leaves behind: harder to read in the device, and slower here. Constants are the
originals; tests hold every dose against plant and firmware on the bus.
"""

from firmware_sim import cgm as fw_cgm
from firmware_sim.bolus import LIMIT_AT_BOOT
from firmware_sim.cgm import (
    ABOVE_RANGE_ACTS_AS,
    AGE_USABLE,
    BELOW_RANGE_ACTS_AS,
    GLUCOSE_HIGH,
    GLUCOSE_LOW,
    JUMP,
    NOISE_HIGH,
    NOISE_RESERVED,
    SESSION_SNA,
    SETTLING_SAMPLES,
)
from firmware_sim.control.layout import MEAL_CARBS, MEAL_NONE, MEAL_SIMPLE, MEAL_SNACK
from firmware_sim.day import HOURS, STEPS_PER_HOUR
from firmware_sim.ladder import AGE_SAFE_BASAL, SAMPLES_UP, State
from firmware_sim.meals import CARBS_MAX
from pumpbench.closed_loop.compiled import Words, helper

NEVER = fw_cgm.NEVER
SAMPLE_OK, SAMPLE_BELOW, SAMPLE_ABOVE = fw_cgm.STATE_OK, fw_cgm.STATE_BELOW_RANGE, fw_cgm.STATE_ABOVE_RANGE
INIT, AUTO, DEGRADED, SAFE_BASAL = int(State.INIT), int(State.AUTO), int(State.DEGRADED), int(State.SAFE_BASAL)

TAKEN, STREAK, SINCE_GAP, SESSION, DOUBTFUL, BELOW_RANGE, GLUCOSE_LAST, UNCONFIRMED, EQUAL, VALUE_LAST = range(10)
"""Words of `firmware_sim.cgm.Cgm`; TAKEN -1 = no sample yet."""

CGM_AT_BOOT = (-1, 0, 0, SESSION_SNA, 0, 0, -1, -1, 0, -1)

STATE, RUNG = range(2)
"""Words of `firmware_sim.ladder.Ladder`."""

LADDER_AT_BOOT = (INIT, SAFE_BASAL)

HOUR, DAY_WORDS = HOURS, HOURS + 1
"""Words of `firmware_sim.day.Day`: the sums of the hours, then the hour that runs."""

OPEN, DOSE, REMAINING, LIMIT = range(4)
"""Words of one drug in `firmware_sim.bolus.Boluses`: whether a bolus is not settled, its raw dose, what of it no total
holds yet, and the largest dose the pump accepts, as it last said."""

BOLUS_AT_BOOT = (0, 0, 0, LIMIT_AT_BOOT)


# ---- firmware_sim.cgm.Cgm


@helper
def status(cgm: Words, noise: int, session: int) -> None:
    """`Cgm.status`: a CGM_Status without fault bits; noise in 0.5 mg/dL."""
    cgm[DOUBTFUL] = 1 if NOISE_HIGH < noise < NOISE_RESERVED else 0
    if session not in (SESSION_SNA, cgm[SESSION]):
        if cgm[SESSION] != SESSION_SNA:
            cgm[SINCE_GAP] = 0
            cgm[UNCONFIRMED] = cgm[GLUCOSE_LAST] = cgm[VALUE_LAST] = -1
        cgm[SESSION] = session


@helper
def age(cgm: Words, step: int) -> int:
    """`Cgm.age`."""
    return NEVER if cgm[TAKEN] < 0 else step - cgm[TAKEN]


@helper
def glucose_of(state: int, value: int) -> int:
    """`Cgm._glucose`."""
    if state == SAMPLE_BELOW:
        return BELOW_RANGE_ACTS_AS
    if state == SAMPLE_ABOVE:
        return ABOVE_RANGE_ACTS_AS
    if state == SAMPLE_OK and GLUCOSE_LOW <= value <= GLUCOSE_HIGH:
        return value
    return -1


@helper
def stuck(cgm: Words, value: int, state: int, limit: int) -> bool:
    """`Cgm._stuck`."""
    if state != SAMPLE_OK:
        cgm[EQUAL], cgm[VALUE_LAST] = 0, -1
        return False
    cgm[EQUAL] = cgm[EQUAL] + 1 if value == cgm[VALUE_LAST] else 1
    cgm[VALUE_LAST] = value
    return bool(0 < limit <= cgm[EQUAL])


@helper
def jumped(cgm: Words, glucose: int, taken: int) -> bool:
    """`Cgm._jumped`."""
    if cgm[TAKEN] < 0 or cgm[GLUCOSE_LAST] < 0 or taken - cgm[TAKEN] > AGE_USABLE:
        return False
    allowed = JUMP * max(taken - cgm[TAKEN], 1)
    if glucose - cgm[GLUCOSE_LAST] <= allowed:
        return False
    if cgm[UNCONFIRMED] >= 0 and -JUMP <= glucose - cgm[UNCONFIRMED] <= JUMP:
        return False
    cgm[UNCONFIRMED] = glucose
    return True


@helper
def judge(cgm: Words, sent: bool, state: int, value: int, step: int, stuck_limit: int) -> int:
    """`Cgm.judge` of one sample taken now, or of none; the usable glucose (0.1 mg/dL), or -1."""
    gap = age(cgm, step) > AGE_USABLE + 1
    usable = -1
    if sent:
        glucose = glucose_of(state, value)
        if glucose >= 0 and not stuck(cgm, value, state, stuck_limit) and not jumped(cgm, glucose, step):
            cgm[GLUCOSE_LAST] = glucose
            cgm[UNCONFIRMED] = -1
            cgm[TAKEN] = step
            cgm[BELOW_RANGE] = 1 if state == SAMPLE_BELOW else 0
            usable = glucose
    if usable < 0:
        cgm[STREAK] = 0
    else:
        cgm[STREAK] += 1
        cgm[SINCE_GAP] = 1 if gap else min(cgm[SINCE_GAP] + 1, SETTLING_SAMPLES)
    return usable


@helper
def settling(cgm: Words) -> bool:
    """`Cgm.settling`."""
    return bool(cgm[SINCE_GAP] < SETTLING_SAMPLES)


# ---- firmware_sim.ladder.Ladder


@helper
def next_rung(ladder: Words, age: int, streak: int, age_degraded: int) -> int:
    """`Ladder._next_rung`."""
    if age >= AGE_SAFE_BASAL:
        return SAFE_BASAL
    floor = DEGRADED if age >= age_degraded else AUTO
    if floor >= ladder[RUNG]:
        return floor
    if streak >= SAMPLES_UP:
        return int(ladder[RUNG] - 1)
    return int(ladder[RUNG])


@helper
def update(ladder: Words, age: int, streak: int, age_degraded: int) -> int:
    """`Ladder.update` of a calibrated device that hears its pump, with no bolus uncertain and nobody suspending."""
    ladder[RUNG] = next_rung(ladder, age, streak, age_degraded)
    if ladder[STATE] == INIT and streak < SAMPLES_UP and age < AGE_SAFE_BASAL:
        return INIT
    if ladder[STATE] == INIT and streak >= SAMPLES_UP:
        ladder[RUNG] = AUTO
    ladder[STATE] = ladder[RUNG]
    return int(ladder[STATE])


# ---- firmware_sim.day.Day


@helper
def add(day: Words, amount: int, step: int) -> None:
    """`Day.add`."""
    hour = step // STEPS_PER_HOUR
    for passed in range(min(hour - day[HOUR], HOURS)):
        day[(hour - passed) % HOURS] = 0
    day[HOUR] = max(hour, day[HOUR])
    day[day[HOUR] % HOURS] += amount


@helper
def total(day: Words) -> int:
    """`Day.total`."""
    amount = 0
    for hour in range(HOURS):
        amount += int(day[hour])
    return amount


# ---- firmware_sim.meals.Meals


@helper
def hear(kind: int, carbs: int) -> tuple[int, int]:
    """`Meals.hear` of an announcement that is new, then `Meals.take`: what of it there is to dose for."""
    if kind == MEAL_SIMPLE:
        return kind, 0
    if kind in (MEAL_CARBS, MEAL_SNACK) and carbs <= CARBS_MAX:
        return kind, carbs
    return MEAL_NONE, 0


# ---- firmware_sim.bolus.Boluses


@helper
def follow(bolus: Words, pump_delivers: bool, given: int) -> int:
    """`Boluses.open_step` of one drug, whose committed bolus the pump tells of; what newly was delivered, raw."""
    if not bolus[OPEN]:
        return 0
    left = bolus[DOSE] - min(given, bolus[DOSE])
    delivered = max(bolus[REMAINING] - left, 0)
    bolus[REMAINING] = min(bolus[REMAINING], left)
    bolus[OPEN] = 1 if pump_delivers else 0
    return int(delivered)


@helper
def start(bolus: Words, dose: int) -> None:
    """`Boluses.start`."""
    bolus[OPEN] = 1
    bolus[DOSE] = bolus[REMAINING] = dose


@helper
def remaining(bolus: Words) -> int:
    """`Boluses.remaining`."""
    return int(bolus[REMAINING] * bolus[OPEN])
