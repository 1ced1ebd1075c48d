"""The loop: patient, sensor, pump, user and device from one sampling instant to the next, as one compiled function.

In every instant the same order as on the bus (`plant_server.server`, `firmware_sim.firmware.Firmware._tasks`): what is
eaten and told, the sample, what the pump reports; sensor, pump, ladder, law, command, boluses; then five minutes of
strokes and of the patient.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import firmware_sim
import plant_server
from can_bus.lockstep import STEP_MINUTES
from firmware_sim import allowance
from firmware_sim.control import layout
from firmware_sim.pump import RATE_EXPIRES_AFTER, RATE_LIMIT_AT_BOOT
from plant_server import mechanism, physiology
from plant_server.chamber import INSULIN, PRAMLINTIDE
from plant_server.mechanism import DELIVERED, FLUID, MOTOR_WORDS, SUBSTEPS
from plant_server.scenario import RESCUE_EATING_MINUTES
from pumpbench.closed_loop import compiled, device, pump
from pumpbench.closed_loop.compiled import Words, helper

Floats = npt.NDArray[np.float64]

NO_NUMBER = 8191
"""CGM_Reading.GlucoseConc SNA: an instant without a sample, or a sample without a number."""

RESCUE_SUBSTEPS = int(RESCUE_EATING_MINUTES / physiology.STEP_MIN)

(
    SCHEDULE, MAX_RATE, MAX_PRAM_RATE, MAX_BOLUS, MAX_PRAM_BOLUS, CHANGE_EVERY, MODE, STUCK_SAMPLES, STALE_AGE,
    INSULIN_TDD, PRAM_TDD, RESCUE_SAMPLES, RESCUE_TOLD, RESCUE_KIND, RESCUE_RAW,
) = range(15)  # fmt: skip
"""Words of `Plan.settings`: the pump's, the device's beside the law's parameters, the sugar's (0 samples = none)."""

RESCUE_BELOW, RESCUE_CARBS_MG, RESCUE_LOCKOUT_MINUTES, RANGE_LOW, RANGE_HIGH = range(5)
"""Words of `Plan.levels`, mg/dL, mg and min."""


class Plan(NamedTuple):
    """Everything a run meets that does not depend on what happens in it, as arrays that nobody changes."""

    settings: Words
    levels: Floats
    parameters: Words  # of the control core
    x0: Floats
    bodies: Floats  # parameters of the patient: before the first meal, then from each meal to the next
    meals: Words  # step of each meal that starts, in order
    meal_mg: Floats
    meal_body: Words  # row of `bodies` from that meal on; -1 = as before
    carbs: Floats  # mg eaten in every 30-s step, one row per sampling interval
    told: Words  # step, kind and raw carbohydrate of every planned announcement, one row each
    gain: Floats  # of the sensor, one entry per sampling instant
    offset: Floats  # mg/dL
    sent: Words  # 1 = there is a sample
    forced: Words  # CgmState the sensor is in whatever the glucose; STATE_OK = it measures
    noise: Words  # CGM_Status at this instant: noise in 0.5 mg/dL, -1 = none
    session: Words


class Record(NamedTuple):
    """What happened, one entry per step."""

    floats: Floats  # rows: plasma glucose, plasma insulin, plasma pramlintide
    words: Words  # rows: see `result.Result`


(
    CGM, CGM_STATE, INSULIN_RATE, PRAM_RATE, INSULIN_BOLUS, PRAM_BOLUS, INSULIN_STROKES, PRAM_STROKES, LIMITERS, LADDER,
) = range(10)  # fmt: skip
"""Rows of `Record.words`."""

GLUCOSE, PLASMA_INSULIN, PLASMA_PRAMLINTIDE = range(3)
"""Rows of `Record.floats`."""

control_step = compiled.control_step()
limit_of = compiled.twin(allowance.limit_of)
insulin_left = compiled.twin(allowance.insulin_left)
pram_left = compiled.twin(allowance.pram_left)
begin_meal, advance, plasma_glucose = physiology.begin_meal, physiology.advance, physiology.glucose
interstitial, plasma_insulin = physiology.interstitial, physiology.plasma_insulin
plasma_pramlintide = physiology.plasma_pramlintide
run_motor = mechanism.run

FIRMWARE, PLANT, HERE = (
    Path(each).parent for each in (str(firmware_sim.__file__), str(plant_server.__file__), __file__)
)

STATE_WORDS, INPUT_WORDS, OUTPUT_WORDS = len(layout.STATE), len(layout.INPUTS), len(layout.OUTPUTS)

MILLIUNITS_PER_STROKE, PRAM_TOTAL_PER_STROKE = 50, 50
"""A stroke in PUMP_Delivered: 0.05 U in 0.001 U, 0.5 ug in 0.01 ug."""

NO_STATE = 15
"""CGM_Reading.CgmState of an instant without a sample."""

SCHEDULE_RUNS = -1
"""Instead of a commanded rate: the device leaves the pump to its stored schedule."""

INSULIN_UNITS, INSULIN_VOLUME, INSULIN_CAPACITY = INSULIN.stroke_units, INSULIN.stroke_volume, INSULIN.capacity
PRAM_UNITS, PRAM_VOLUME, PRAM_CAPACITY = PRAMLINTIDE.stroke_units, PRAMLINTIDE.stroke_volume, PRAMLINTIDE.capacity
INSULIN_PRIMED, PRAM_PRIMED = INSULIN.capacity - INSULIN.priming, PRAMLINTIDE.capacity - PRAMLINTIDE.priming


@helper
def give_boluses(
    wanted: int, pram_wanted: int, asked: Words, pram_asked: Words, given: Words, pram_given: Words,
    motor: Words, pram_motor: Words, settings: Words,
) -> tuple[int, int, bool]:  # fmt: skip
    """Both boluses of a step through all turns of the protocol: `Firmware._start_boluses` and `Boluses.listen`.

    Returns:
        The raw doses that were committed, and whether the device cut one to what the pump had last said it accepts.
    """
    dose, pram_dose = min(wanted, asked[device.LIMIT]), min(pram_wanted, pram_asked[device.LIMIT])
    cut = dose < wanted or pram_dose < pram_wanted
    refused = False
    if dose > 0:
        limit = pump.limit_raw(motor, settings[MAX_BOLUS])
        if pump.program(given, dose, limit):
            device.start(asked, dose)
            pump.commit(given, motor, dose)
            asked[device.LIMIT] = max(limit, asked[device.LIMIT])
        else:
            refused = True
            asked[device.LIMIT] = limit
            dose = 0
    if pram_dose > 0:
        limit = pump.limit_raw(pram_motor, settings[MAX_PRAM_BOLUS])
        if not pump.program(pram_given, pram_dose, limit):
            pram_asked[device.LIMIT] = limit
            pram_dose = 0
        else:
            pram_asked[device.LIMIT] = max(limit, pram_asked[device.LIMIT])
            if refused:  # a meal is refused as a whole: the pramlintide is cancelled
                pump.cancel(pram_given, pram_motor)
                pram_dose = 0
            else:
                device.start(pram_asked, pram_dose)
                pump.commit(pram_given, pram_motor, pram_dose)
    return dose, pram_dose, cut


@compiled.kept_on_disk([FIRMWARE, PLANT, HERE, Path(compiled.__file__)])
def run(plan: Plan, record: Record) -> tuple[Words, Words]:
    """Run a plan to its end.

    Args:
        plan: see `Plan`.
        record: is filled, one column per step.

    Returns:
        The motors of insulin and pramlintide as they stand at the end.
    """
    settings, levels, parameters = plan.settings, plan.levels, plan.parameters
    steps = record.words.shape[1]
    x = plan.x0.copy()
    body = 0
    motor, pram_motor = np.zeros(MOTOR_WORDS, np.int64), np.zeros(MOTOR_WORDS, np.int64)
    motor[FLUID], pram_motor[FLUID] = INSULIN_CAPACITY, PRAM_CAPACITY
    insulin, pramlintide = np.zeros(SUBSTEPS), np.zeros(SUBSTEPS)
    carbs = np.zeros(SUBSTEPS)
    setpoint = np.zeros(4, np.int64)
    pump.fall_back(setpoint, settings[SCHEDULE])
    given, pram_given = np.zeros(2, np.int64), np.zeros(2, np.int64)

    cgm, ladder = np.array(device.CGM_AT_BOOT), np.array(device.LADDER_AT_BOOT)
    asked, pram_asked = np.array(device.BOLUS_AT_BOOT), np.array(device.BOLUS_AT_BOOT)
    day, pram_day = np.zeros(device.DAY_WORDS, np.int64), np.zeros(device.DAY_WORDS, np.int64)
    state, inputs = np.zeros(STATE_WORDS, np.int64), np.zeros(INPUT_WORDS, np.int64)
    outputs = np.zeros(OUTPUT_WORDS, np.int64)
    rate_limit, pram_rate_limit = RATE_LIMIT_AT_BOOT, RATE_LIMIT_AT_BOOT
    strokes_seen, pram_strokes_seen = -1, 0

    waiting = np.zeros((plan.told.shape[0] + steps, 2), np.int64)  # announcements that are due: kind, raw carbohydrate
    first_waiting, end_waiting, next_told, next_meal = 0, 0, 0, 0
    low_samples, eaten = 0, -1

    for step in range(steps):
        p = plan.bodies[body]
        glucose = plasma_glucose(x, p)
        record.floats[GLUCOSE, step] = glucose
        record.floats[PLASMA_INSULIN, step] = plasma_insulin(x, p)
        record.floats[PLASMA_PRAMLINTIDE, step] = plasma_pramlintide(x, p)

        # sugar (plant_server.scenarios.rescue.Rescuer), announcements (plant_server.user.User)
        rescue_mg = 0.0
        if settings[RESCUE_SAMPLES] > 0:
            low_samples = low_samples + 1 if glucose < levels[RESCUE_BELOW] else 0
            waited = eaten < 0 or (step - eaten) * STEP_MINUTES >= levels[RESCUE_LOCKOUT_MINUTES]
            if low_samples >= settings[RESCUE_SAMPLES] and waited:
                eaten = step
                rescue_mg = levels[RESCUE_CARBS_MG]
        while next_told < plan.told.shape[0] and plan.told[next_told, 0] <= step:
            waiting[end_waiting, 0], waiting[end_waiting, 1] = plan.told[next_told, 1], plan.told[next_told, 2]
            next_told += 1
            end_waiting += 1
        if rescue_mg > 0.0 and settings[RESCUE_TOLD] == 1:
            waiting[end_waiting, 0], waiting[end_waiting, 1] = settings[RESCUE_KIND], settings[RESCUE_RAW]
            end_waiting += 1
        kind, meal_raw = layout.MEAL_NONE, 0
        if first_waiting < end_waiting:
            kind, meal_raw = device.hear(waiting[first_waiting, 0], waiting[first_waiting, 1])
            first_waiting += 1

        # the sample (plant_server.sensor.Sensor.sample and PlantServer._read_sensor)
        shown = plan.gain[step] * interstitial(x, p) + plan.offset[step]
        sample_state = plan.forced[step]
        value = NO_NUMBER
        if sample_state == device.SAMPLE_OK:
            if shown < levels[RANGE_LOW]:
                sample_state, shown = device.SAMPLE_BELOW, levels[RANGE_LOW]
            elif shown > levels[RANGE_HIGH]:
                sample_state, shown = device.SAMPLE_ABOVE, levels[RANGE_HIGH]
            value = int(np.rint(shown * 10))
        sent = plan.sent[step] == 1
        record.words[CGM, step] = value if sent else NO_NUMBER
        record.words[CGM_STATE, step] = sample_state if sent else NO_STATE

        # the device: sensor, pump, ladder (Firmware._judge_sensor, _hear_pump, _task_ladder)
        if plan.noise[step] >= 0:
            device.status(cgm, plan.noise[step], plan.session[step])
        usable = device.judge(cgm, sent, sample_state, value, step, settings[STUCK_SAMPLES])
        blocked = min(np.rint(motor[FLUID] * INSULIN_VOLUME * 10), 4000) == 0
        pram_blocked = min(np.rint(pram_motor[FLUID] * PRAM_VOLUME), 4093) == 0
        delivered = -1
        if strokes_seen >= 0:
            delivered = (motor[DELIVERED] - strokes_seen) * MILLIUNITS_PER_STROKE
        device.add(day, max(delivered, 0), step)
        device.add(pram_day, (pram_motor[DELIVERED] - pram_strokes_seen) * PRAM_TOTAL_PER_STROKE, step)
        strokes_seen, pram_strokes_seen = motor[DELIVERED], pram_motor[DELIVERED]
        bolus = device.follow(asked, given[pump.PHASE] == pump.DELIVERING, pump.delivered_raw(given, motor)) * 10
        device.follow(pram_asked, pram_given[pump.PHASE] == pump.DELIVERING, pump.delivered_raw(pram_given, pram_motor))
        rung = device.update(ladder, device.age(cgm, step), cgm[device.STREAK], settings[STALE_AGE])

        # the law (Firmware._control)
        inputs[layout.IN_GLUCOSE] = usable
        inputs[layout.IN_DELIVERED] = delivered
        inputs[layout.IN_BOLUS] = bolus
        inputs[layout.IN_MODE] = settings[MODE]
        inputs[layout.IN_RESET] = 1 if device.settling(cgm) else 0
        inputs[layout.IN_LIMIT] = limit_of(
            rung == device.AUTO, cgm[device.BELOW_RANGE] == 1, cgm[device.DOUBTFUL] == 1 or blocked
        )
        inputs[layout.IN_OPEN] = device.remaining(asked)
        inputs[layout.IN_INSULIN_LEFT] = insulin_left(settings[INSULIN_TDD], device.total(day), device.remaining(asked))
        inputs[layout.IN_PRAM_LEFT] = pram_left(
            settings[PRAM_TDD], device.total(pram_day), device.remaining(pram_asked)
        )
        inputs[layout.IN_PRAM_STOP] = 1 if pram_blocked or blocked else 0
        stop = 0 if rung == device.AUTO and not asked[device.OPEN] else layout.STOP_INSULIN
        stop |= 0 if rung == device.AUTO and not pram_asked[device.OPEN] else layout.STOP_PRAM
        inputs[layout.IN_BOLUS_STOP] = stop
        inputs[layout.IN_MEAL], inputs[layout.IN_CARBS] = kind, meal_raw
        control_step(state, parameters, inputs, outputs)

        # its set-point (Firmware._command, firmware_sim.pump.Pump.command), and the pump's answer
        rate, pram_rate = 0, 0
        record.words[INSULIN_RATE, step] = record.words[PRAM_RATE, step] = SCHEDULE_RUNS
        if rung in (device.AUTO, device.DEGRADED):
            wanted = outputs[layout.OUT_RATE]
            pram_wanted = outputs[layout.OUT_PRAM_RATE] if wanted > 0 else 0
            rate, pram_rate = min(wanted, rate_limit), pram_wanted
            if rate < wanted:
                pram_rate = pram_rate * rate // wanted
            pram_rate = min(pram_rate, pram_rate_limit)
            if rate != wanted or pram_rate != pram_wanted:
                outputs[layout.OUT_LIMITERS] |= layout.LIMITER_MAX_BASAL
            accepted, pram_accepted = pump.command(
                setpoint, rate, pram_rate, settings[MAX_RATE], settings[MAX_PRAM_RATE], settings[SCHEDULE], step,
                RATE_EXPIRES_AFTER,
            )  # fmt: skip
            rate_limit = max(settings[MAX_RATE], rate_limit) if accepted else settings[MAX_RATE]
            pram_rate_limit = (
                max(settings[MAX_PRAM_RATE], pram_rate_limit) if pram_accepted else settings[MAX_PRAM_RATE]
            )
            record.words[INSULIN_RATE, step], record.words[PRAM_RATE, step] = rate, pram_rate
        else:
            pump.fall_back(setpoint, settings[SCHEDULE])

        # its boluses
        dose, pram_dose = 0, 0
        if rung == device.AUTO:
            dose, pram_dose, cut = give_boluses(
                outputs[layout.OUT_BOLUS], outputs[layout.OUT_PRAM_BOLUS], asked, pram_asked, given, pram_given, motor,
                pram_motor, settings,
            )  # fmt: skip
            if cut:
                outputs[layout.OUT_LIMITERS] |= layout.LIMITER_MAX_BOLUS
        record.words[INSULIN_BOLUS, step], record.words[PRAM_BOLUS, step] = dose, pram_dose
        record.words[LIMITERS, step] = outputs[layout.OUT_LIMITERS] if rung in (device.AUTO, device.DEGRADED) else 0
        record.words[LADDER, step] = rung

        # five minutes of the motors (Pump.deliver)
        pump.expire(setpoint, settings[SCHEDULE], step)
        run_motor(motor, setpoint[pump.RATE], INSULIN_UNITS, INSULIN_VOLUME, False, False, insulin)
        run_motor(pram_motor, setpoint[pump.PRAM_RATE], PRAM_UNITS, PRAM_VOLUME, False, False, pramlintide)
        record.words[INSULIN_STROKES, step] = motor[DELIVERED] - strokes_seen
        record.words[PRAM_STROKES, step] = pram_motor[DELIVERED] - pram_strokes_seen
        pump.follow(given, motor)
        pump.follow(pram_given, pram_motor)
        if settings[CHANGE_EVERY] > 0 and (step + 1) % settings[CHANGE_EVERY] == 0:
            motor[FLUID], pram_motor[FLUID] = INSULIN_PRIMED, PRAM_PRIMED

        # and of the patient (Body.advance)
        while next_meal < plan.meals.size and plan.meals[next_meal] == step:
            if plan.meal_body[next_meal] >= 0:
                body = plan.meal_body[next_meal]
            begin_meal(x, plan.bodies[body], plan.meal_mg[next_meal])
            next_meal += 1
        p = plan.bodies[body]
        carbs[:] = plan.carbs[step]
        if rescue_mg > 0.0:
            begin_meal(x, p, rescue_mg)
            carbs += rescue_mg / RESCUE_SUBSTEPS
        advance(x, p, float(step * STEP_MINUTES), insulin, pramlintide, carbs)
    return motor, pram_motor
