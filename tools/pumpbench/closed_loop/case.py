"""One run as asked for, and everything in it that can be known beforehand, as arrays.

The vocabulary is that of `pumpbench.rig.Request`, the random numbers are those of the plant on the bus: the same case
is the same run. What depends on patient, seed, sensor and scenario alone is kept for the next case of this process.
"""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from can_bus.lockstep import STEPS_PER_DAY
from firmware_sim.allowance import stale_age
from firmware_sim.calibration import SET_CRC_INDEX, Calibration, parameter_names
from plant_server import physiology
from plant_server.mechanism import SUBSTEPS
from plant_server.physiology import Patient, Variability, load_patient, parameters
from plant_server.pump import PumpSettings
from plant_server.scenario import (
    BUILT_IN,
    EATING_MINUTES,
    RESCUE,
    Announcement,
    Kind,
    Meal,
    Policy,
    Scenario,
    announcements,
    load_scenario,
    policy_of,
    rescue_announcement,
)
from plant_server.sensor import STATE_OK, STATUS_EVERY, Sensor, SensorSettings, load_sensor
from plant_server.sensors.ideal import Ideal
from pumpbench.calibration import MODES, Tuning, calibrate, tuning_for
from pumpbench.closed_loop.compiled import Words
from pumpbench.closed_loop.loop import Floats, Plan
from pumpbench.controller_model import ControllerModel

DAYS_MAX = 100
"""Beyond, numbers on the wire begin anew that the loop does not follow."""

CIRCADIAN = [parameters.CIRCADIAN_AMPLITUDE, parameters.CIRCADIAN_PHASE]

KEPT = 64
"""Patients and seeds of which the arrays are kept."""


class CaseError(ValueError):
    """What was asked for is no run, or one that only the bus can do; the text says what was expected."""


@dataclass(frozen=True)
class Case:
    """One closed-loop run without faults.

    Attributes:
        patient: name, or a patient of one's own.
        mode: one of `pumpbench.calibration.MODES`.
        scenario: name or file (`plant_server.scenario.load_scenario`), or a scenario of one's own.
        seed: of everything random.
        days: rounded to steps of 5 min.
        sensor: name or file (`plant_server.sensor.load_sensor`), or settings; without effects.
        variability: of `physiology.SOURCES`, what varies in the patient.
        pramlintide: parameter set of a patient given by name; None = P2.
        physiology: of a patient given by name; None = what its file says.
        tuning: None = that of the mode (`pumpbench.calibration.tuning_for`).
        model: what the controller knows of the patient; None = the model that comes with the package.
    """

    patient: str | Patient
    mode: str = "nma"
    scenario: str | Scenario = "validation-14d"
    seed: int = 1
    days: float = 1.0
    sensor: str | SensorSettings = "coloured"
    variability: tuple[str, ...] = tuple(physiology.SOURCES)
    pramlintide: str | None = None
    physiology: str | None = None
    tuning: Tuning | None = None
    model: ControllerModel | None = None

    @property
    def steps(self) -> int:
        """Sampling intervals of 5 min."""
        return round(self.days * STEPS_PER_DAY)


def prepare(case: Case) -> Plan:
    """Look everything up, draw everything random.

    Raises:
        CaseError, PatientError, ScenarioError, SensorError, ControllerModelError, CalibrationError:
            what is wrong with the case.
    """
    steps = case.steps
    if case.mode not in MODES:
        raise CaseError(f"there is no mode {case.mode!r}; choose one of {', '.join(MODES)}")
    if not 1 <= steps <= DAYS_MAX * STEPS_PER_DAY:
        raise CaseError(f"days: a compiled run has one step of 5 min to {DAYS_MAX} days, found {case.days:g}")
    if case.seed < 0:
        raise CaseError(f"seed: 0 or greater, found {case.seed}")
    unknown = sorted(set(case.variability) - physiology.SOURCES.keys())
    if unknown:
        raise CaseError(f"variability: choose of {', '.join(physiology.SOURCES)}, found {unknown[0]!r}")
    patient = _patient(case)
    scenario = _scenario(case, patient.name)
    if steps > scenario.days * STEPS_PER_DAY:
        raise CaseError(f"scenario {scenario.name} has {scenario.days} days, asked for {case.days:g}")
    sensor = load_sensor(case.sensor) if isinstance(case.sensor, str) else case.sensor
    if sensor.effects:
        raise CaseError(f"sensor: effects ({sensor.effects[0].kind}) need the bus; the compiled loop has none")
    mode = MODES[case.mode]
    tuning = case.tuning or tuning_for(case.mode, noisy=not isinstance(sensor.model, Ideal))
    law, limits = _calibration(_Key(patient), tuning, case.model)
    meals = tuple(meal for meal in scenario.meals if meal.step < steps)
    if any(meal.step < 0 for meal in meals):
        raise CaseError(f"scenario {scenario.name}: a meal starts before the run")
    policy = policy_of(mode)
    rescue = scenario.rescue
    sugar = None if rescue is None else rescue_announcement(scenario, policy, Meal(0, RESCUE, rescue.carbs))
    pump = PumpSettings(basal_milliunits_per_h=round(patient.basal_u_per_h * 1000))
    settings = (
        pump.basal_milliunits_per_h,
        pump.max_rate_raw,
        pump.max_pramlintide_rate_raw,
        pump.max_bolus_raw,
        pump.max_pramlintide_bolus_raw,
        pump.change_every_steps,
        mode,
        *limits,
        *((0, 0, 0, 0) if rescue is None else (rescue.samples, int(sugar is not None), *_told(sugar))),
    )
    levels = (0.0, 0.0, 0.0) if rescue is None else (rescue.below, rescue.carbs * 1000, rescue.lockout_minutes)
    bodies, starts, amounts, rows = _body(_Key(patient), meals, case.seed, frozenset(case.variability))
    gain, offset, sent, forced, noise, session = _sensor(sensor, steps, case.seed, patient.name)
    return Plan(
        settings=np.array(settings, np.int64),
        levels=np.array([*levels, *sensor.range], np.float64),
        parameters=law,
        x0=np.array(patient.x0),
        bodies=bodies,
        meals=starts,
        meal_mg=amounts,
        meal_body=rows,
        carbs=_carbs(meals, steps),
        told=_announced(scenario, policy, case.seed, patient.name),
        gain=gain,
        offset=offset,
        sent=sent,
        forced=forced,
        noise=noise,
        session=session,
    )


class _Key:
    """A patient as a key: equal when all its numbers are."""

    def __init__(self, patient: Patient) -> None:
        self.patient = patient
        self._value = (
            patient.name,
            patient.params.tobytes(),
            patient.x0.tobytes(),
            patient.basal_u_per_h,
            patient.basal_glucose,
        )

    def __hash__(self) -> int:
        return hash(self._value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._value == other._value


# ---- by name, or one's own


def _patient(case: Case) -> Patient:
    if isinstance(case.patient, Patient):
        if case.pramlintide is not None or case.physiology is not None:
            raise CaseError("pramlintide and physiology are chosen for a patient given by name; this one has its own")
        return case.patient
    load = _shipped_patient if case.patient in physiology.cohort() else _load_patient
    return load(case.patient, case.pramlintide or "P2", case.physiology)


def _load_patient(name: str, pramlintide: str, choice: str | None) -> Patient:
    return load_patient(name, pramlintide=pramlintide, physiology=choice)


_shipped_patient = functools.lru_cache(KEPT)(_load_patient)


def _scenario(case: Case, patient: str) -> Scenario:
    if isinstance(case.scenario, Scenario):
        return case.scenario
    load: Callable[..., Scenario] = _built_in if case.scenario in BUILT_IN else load_scenario
    return load(case.scenario, seed=case.seed, patient=patient, days=case.steps / STEPS_PER_DAY)


_built_in = functools.lru_cache(KEPT)(load_scenario)


# ---- arrays


@functools.lru_cache(KEPT)
def _calibration(key: _Key, tuning: Tuning, model: ControllerModel | None) -> tuple[Words, tuple[int, int, int, int]]:
    """The law's parameters, and of the rest of the device: stuck samples, stale age, both limits of a day.

    Raises:
        CaseError: the device would not accept the set.
    """
    flashed = Calibration()
    names = parameter_names()
    for index, raw in calibrate(key.patient, tuning, model).items():
        echo = flashed.store({"CfgIndex": index, names[index]: raw})
        if echo["EchoRaw"] != raw & 0x3FFFFFFF:
            raise CaseError(f"the device would not accept {names[index]} (CfgIndex {index}): raw {raw}")
    if not flashed.active:
        raise CaseError(f"the device would not accept the calibration: {names[SET_CRC_INDEX]} does not fit")
    stale = stale_age(flashed.value("CfgStaleCgmLimit"))
    limits = flashed.value("CfgStuckSamples"), stale, flashed.value("CfgInsulinTdd"), flashed.value("CfgPramTdd")
    return np.array(flashed.parameters, np.int64), limits


@functools.lru_cache(KEPT)
def _body(
    key: _Key, planned: tuple[Meal, ...], seed: int, sources: frozenset[str]
) -> tuple[Floats, Words, Floats, Words]:
    """The patient's parameters from meal to meal, and the meals in the order in which they start."""
    nominal = key.patient.params
    first = Variability(seed, key.patient.name, sources).apply(nominal)
    of_meals = Variability(
        seed, key.patient.name, sources - {"circadian"}
    )  # that is the same all along, and slow to draw
    bodies, rows = [first], []
    meals = sorted(planned, key=lambda meal: meal.step)
    for meal in meals:
        rows.append(-1 if meal.kind == RESCUE else len(bodies))
        if meal.kind != RESCUE:
            body = of_meals.apply(nominal, of_meals.meal(len(bodies) - 1))
            body[CIRCADIAN] = first[CIRCADIAN]
            bodies.append(body)
    steps = np.array([meal.step for meal in meals], np.int64)
    amounts = np.array([meal.carbs_g * 1000 for meal in meals], np.float64)
    return np.array(bodies), steps, amounts, np.array(rows, np.int64)


@functools.lru_cache(KEPT)
def _carbs(planned: tuple[Meal, ...], steps: int) -> Floats:
    """What is eaten in every 30-s step, mg."""
    carbs = np.zeros((steps, SUBSTEPS))
    substeps = int(EATING_MINUTES / physiology.STEP_MIN)
    for meal in planned:
        start = meal.step * SUBSTEPS
        carbs.reshape(-1)[start : start + substeps] += meal.carbs_g * 1000 / substeps
    return carbs


def _told(announcement: Announcement | None) -> tuple[int, int]:
    """Raw MealKind and CarbsEst as the user sends them."""
    if announcement is None:
        return 0, 0
    kind = Kind(announcement.kind)
    return int(kind), 0 if announcement.carbs_g is None else round(announcement.carbs_g * 2)


@functools.lru_cache(KEPT)
def _announced(scenario: Scenario, policy: Policy, seed: int, patient: str) -> Words:
    planned = announcements(scenario, policy, seed, patient)
    rows = [(announcement.step, *_told(announcement)) for announcement in planned]
    return np.array(rows, np.int64).reshape(len(rows), 3)


@functools.lru_cache(KEPT)
def _sensor(
    settings: SensorSettings, steps: int, seed: int, patient: str
) -> tuple[Floats, Floats, Words, Words, Words, Words]:
    """Gain, offset, sent, forced state, noise and session, see `Plan`: asked of the sensor itself.

    Without effects nothing of this depends on glucose, so any will do. A sensor that is always ready and never runs out
    is asked only when it says something new of itself: to hear the same again changes nothing in the device.
    """
    sensor = Sensor(settings, steps + 1, seed, patient)
    sent, forced = np.ones(steps, np.int64), np.full(steps, STATE_OK, np.int64)
    noise, session = np.full(steps, -1, np.int64), np.zeros(steps, np.int64)
    within = sum(settings.range) / 2
    asked: Iterable[int] = range(steps)
    if sensor.additive_only and settings.renew:
        worn, noise_sd = sensor.wear.session, sensor.errors.noise_sd
        told = np.union1d(np.arange(0, steps, STATUS_EVERY), 1 + np.flatnonzero(np.diff(worn[:steps])))
        new = (np.diff(worn[told]) != 0) | (np.diff(noise_sd[told]) != 0)
        asked = told[np.concatenate(([True], new))].tolist()
    for step in asked:
        gain, offset = sensor.errors.gain[step], sensor.errors.offset[step]
        sample = sensor.sample(step, (within - offset) / gain)
        if sample is None:
            sent[step] = 0
        else:
            forced[step] = sample.state
        status = sensor.status(step)
        if status is not None:
            noise[step], session[step] = min(round(status.noise * 2), 252), status.session
    errors = np.ascontiguousarray(sensor.errors.gain), np.ascontiguousarray(sensor.errors.offset)
    return *errors, sent, forced, noise, session
