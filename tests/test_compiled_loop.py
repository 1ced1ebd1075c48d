"""The compiled loop of campaigns against plant and firmware in this process: the same run, bit for bit."""

import gc
import importlib
import json
import os
import pickle
import subprocess
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pumpbench import rig
from pumpbench.benchmark.closed_loop import closed_loop as benchmark
from pumpbench.calibration import MODES, SAFE, Tuning, calibrate, tuning_for
from pumpbench.closed_loop import Case, CaseError, LoopError, Result, compiled, loop, simulate
from pumpbench.controller_model import ControllerModel, shipped_models

from can_bus import codec
from firmware_sim.control import layout
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from plant_server.bolus import AckResult
from plant_server.chamber import INSULIN as INSULIN_CHAMBER
from plant_server.chamber import PRAMLINTIDE as PRAMLINTIDE_CHAMBER
from plant_server.chamber import Chamber
from plant_server.mechanism import FLUID
from plant_server.physiology import SOURCES, Patient, load_patient
from plant_server.pump import AckFor
from plant_server.scenario import Announcing, Meal, Rescue, Scenario, load_scenario
from plant_server.scenarios.announcing import Late
from plant_server.scenarios.misestimation import Gaussian
from plant_server.sensor import SensorSettings, load_sensor
from plant_server.sensors import MODELS
from plant_server.sensors.ideal import Ideal
from plant_server.server import PlantServer, Run

ADULTS = tuple(f"adult#{number:03d}" for number in range(1, 11))
NIGHTLY = os.environ.get("PUMPBENCH_NIGHTLY") == "1"
DAY = 288

INSULIN = 1  # BolusHormone
SET_RATE = 1  # BasalOp
COMMIT = 2  # BolusOp

Acks = set[tuple[AckFor, AckResult]]


class Watched(PlantServer):
    """The plant, and what goes by and lies within it at every step."""

    def __init__(self, run: Run) -> None:
        super().__init__(run)
        self.floats: list[tuple[float, float, float]] = []
        self.words: list[dict[str, int]] = []
        self.acks: Acks = set()
        self.row: dict[str, int] = {}

    def note(self, name: str, values: dict[str, int]) -> None:
        """A frame of either side."""
        if name == "CGM_Reading":
            self.row |= {"cgm": values["GlucoseConc"], "cgm_state": values["CgmState"]}
        elif name == "PUMP_BasalCmd":
            rates = values["InsulinRate"], values["PramlintideRate"]
            rate, pram_rate = rates if values["BasalOp"] == SET_RATE else (-1, -1)
            self.row |= {"rate": rate, "pram_rate": pram_rate}
        elif name == "PUMP_BolusCmd" and values["BolusOp"] == COMMIT:
            insulin = values["BolusHormone"] == INSULIN
            self.row |= {"bolus": values["InsulinBolus"]} if insulin else {"pram_bolus": values["PramlintideBolus"]}
        elif name == "CTRL_Status":
            self.row |= {"limiters": values["LimiterBits"], "state": values["CtrlState"]}
        elif name == "PUMP_Ack":
            self.acks.add((AckFor(values["AckFor"]), AckResult(values["AckResult"])))

    def _advance(self) -> None:
        body, insulin, pramlintide = self._patient, self.pump.insulin, self.pump.pramlintide
        self.floats.append((body.glucose, body.plasma_insulin, body.plasma_pramlintide))
        before = insulin.delivered, pramlintide.delivered
        super()._advance()
        strokes = {"strokes": insulin.delivered - before[0], "pram_strokes": pramlintide.delivered - before[1]}
        self.words.append({"cgm": 8191, "cgm_state": 15, "bolus": 0, "pram_bolus": 0} | self.row | strokes)
        self.row = {}


def run_of(case: Case) -> Run:
    """The run of a case, looked up without any help of the compiled loop."""
    patient = case.patient
    if not isinstance(patient, Patient):
        patient = load_patient(patient, pramlintide=case.pramlintide or "P2", physiology=case.physiology)
    scenario = case.scenario
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario, seed=case.seed, patient=patient.name, days=case.days)
    sensor = load_sensor(case.sensor) if isinstance(case.sensor, str) else case.sensor
    tuning = case.tuning or tuning_for(case.mode, noisy=not isinstance(sensor.model, Ideal))
    flashed = calibrate(patient, tuning, case.model)
    return Run(
        patient, scenario, round(DAY * case.days), case.seed, MODES[case.mode], flashed, sensor, case.variability
    )


def on_the_bus(case: Case) -> tuple[Result, Acks]:
    """The same case by the nodes themselves, and what the pump answered."""
    plant, firmware = Watched(run_of(case)), Firmware()
    names = ("CGM_Reading", "PUMP_BasalCmd", "PUMP_BolusCmd", "PUMP_Ack", "CTRL_Status")
    watched = {codec.message(name).can_id: codec.message(name) for name in names}
    to_device = deque(plant.call_roll())
    while not plant.finished:
        frame = to_device.popleft()
        answers = list(firmware.receive(frame))
        for each in (frame, *answers):
            if each.can_id in watched:
                plant.note(watched[each.can_id].name, watched[each.can_id].unpack(each.data))
        for answer in answers:
            to_device += plant.receive(answer)
    floats = np.array(plant.floats).T
    words = [np.array([row[name] for row in plant.words]) for name in Result._fields[len(floats) :]]
    return Result(*floats, *words), plant.acks


def the_same(case: Case) -> tuple[Result, Acks]:
    """Both ways, compared to the last bit."""
    ours, (theirs, acks) = simulate(case), on_the_bus(case)
    for name, one, other in zip(Result._fields, ours, theirs, strict=True):
        differ = np.flatnonzero(one != other)
        assert not differ.size, f"{name} of {case} in step {differ[0]}: {one[differ[0]]}, on the bus {other[differ[0]]}"
    return ours, acks


def feast(days: int, carbs: float, *, told_percent: float = 0.0, rescue: Rescue | None = None) -> Scenario:
    """Four large meals a day."""
    meals = tuple(
        Meal(day * DAY + hour * 12, kind, carbs)
        for day in range(days)
        for hour, kind in ((7, "Breakfast"), (12, "Lunch"), (16, "Snack"), (20, "Dinner"))
    )
    habits = Announcing(estimate=Gaussian(mean_percent=told_percent, sd_percent=0))
    return Scenario("feast", days, meals, habits, rescue)


def limiters(result: Result) -> int:
    """Every bit that was set at some time."""
    return int(np.bitwise_or.reduce(result.limiters))


# ---- bit for bit


@pytest.mark.parametrize(("patient", "mode"), list(zip(ADULTS, MODES, strict=False)))
def test_every_mode(patient: str, mode: str) -> None:
    """Two days of the validation scenario, everything varying."""
    result, _ = the_same(Case(patient, mode=mode, days=2, seed=11))
    assert bool(result.bolus.any()) == (mode in ("ma", "sma", "s3", "s4"))
    assert bool(result.pram_strokes.any()) == (mode in ("s1", "s2", "s3", "s4"))
    assert np.ptp(result.glucose) > 50


@pytest.mark.skipif(not NIGHTLY, reason="takes minutes: PUMPBENCH_NIGHTLY=1")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("patient", ADULTS)
def test_every_adult_in_every_mode_for_a_fortnight(patient: str, mode: str) -> None:
    the_same(Case(patient, mode=mode, days=14))


def test_large_announced_meals_tight_limits_sugar_and_a_change_of_reservoirs() -> None:
    rescue = Rescue(below=90.0, announced=True)
    result, _ = the_same(
        Case("adult#010", mode="s3", scenario=feast(4, 120.0, rescue=rescue), days=3.2, tuning=SAFE, seed=4)
    )
    for bit in (layout.LIMITER_MAX_BASAL, layout.LIMITER_LOW_GLUCOSE, layout.LIMITER_STALE_CGM, layout.LIMITER_RISE):
        assert limiters(result) & bit, bit
    assert (result.bolus >= 300).sum() > 8
    assert (result.bolus > 750).any()  # more than the motor makes in five minutes: the next step finds it under way
    assert result.glucose.min() < rescue.below


def test_limits_of_doses_and_of_the_day() -> None:
    tuning = replace(SAFE, max_iob=4.0, max_bolus=1.0, pram_tdd=60.0, basal_factor=2.0)
    result, _ = the_same(
        Case("adult#006", mode="s4", scenario=feast(2, 120.0, rescue=Rescue(below=100.0)), days=2, tuning=tuning)
    )
    for bit in (layout.LIMITER_MAX_BASAL, layout.LIMITER_MAX_BOLUS, layout.LIMITER_DAY):
        assert limiters(result) & bit, bit


def test_samples_that_jump_or_leave_the_range() -> None:
    """A sensor of a narrow range: what leaves and enters it jumps by more than is believed at once."""
    sensor = SensorSettings(range=(100.0, 170.0))
    result, _ = the_same(Case("adult#002", mode="s1", days=2, sensor=sensor, tuning=SAFE))
    assert {1, 4, 5} <= set(result.cgm_state.tolist())
    assert (result.rate == 0).any()  # below the range: nothing


def test_a_sensor_that_repeats_itself_brings_the_device_down_the_ladder() -> None:
    result, _ = the_same(
        Case("adult#003", mode="s2", scenario="fasting", sensor="ideal", variability=(), tuning=Tuning(stuck_samples=3))
    )
    assert {State.INIT, State.AUTO, State.DEGRADED, State.SAFE_BASAL} == set(result.state.tolist())


@pytest.mark.parametrize(
    "sensor",
    [
        SensorSettings(warmup_minutes=60, lifetime_days=0.4),
        SensorSettings.model_validate({"model": "vettoretti", "sample_minutes": 10, "lifetime_days": 0.3}),
        SensorSettings(battery_days=0.5, renew=False),
        SensorSettings(lifetime_days=0.5, renew=False),
        SensorSettings.model_validate({"model": {"name": "coloured", "sd": 16}}),
        SensorSettings(range=(115.0, 125.0), lifetime_days=0.02),
        *(load_sensor(name) for name in ("breton", "facchinetti", "dexcom-g6")),
    ],
)
def test_other_sensors(sensor: SensorSettings) -> None:
    the_same(Case("adult#005", mode="s3", days=0.7, sensor=sensor, seed=5))


def test_sugar_that_is_told_waits_for_its_turn_and_so_does_a_meal_behind_it() -> None:
    patient = load_patient("adult#001", basal_glucose=95.0)
    rescue = Rescue(below=100.0, samples=1, carbs=1.0, lockout_minutes=0, announced=True)
    meals = tuple(Meal(step, "Snack", 5.0) for step in (2, 3, 4))
    result, _ = the_same(
        Case(patient, mode="ma", scenario=Scenario("nibbles", 1, meals, rescue=rescue), variability=())
    )
    assert result.glucose[:7].max() < rescue.below  # sugar in every step
    assert np.flatnonzero(result.bolus).tolist() == [2, 4, 6]


def test_an_estimate_that_no_meal_can_have_is_refused() -> None:
    scenario = feast(1, 120.0, told_percent=30.0)
    result, _ = the_same(Case("adult#002", mode="ma", scenario=scenario))
    assert not result.bolus.any()


def test_rates_that_the_pump_refuses() -> None:
    """What is above the pump's limit is refused once; the device learns that limit."""
    tuning = Tuning(max_basal=40.0, gain=3.0, pram_ratio=40.0, pram_tdd=1600.0)
    result, acks = the_same(Case("adult#007", mode="s2", scenario=feast(1, 250.0), tuning=tuning))
    assert (AckFor.INSULIN_RATE, AckResult.OVER_LIMIT) in acks
    assert (result.rate > 6000).sum() == 1


def test_reservoirs_that_run_empty() -> None:
    """What the reservoir does not hold is refused, and that meal's pramlintide is taken back; then it is changed."""
    controller = shipped_models()["adult#008"]._replace(carb_ratio=4.0)
    tuning = Tuning(pram_bolus=120.0)
    scenario = feast(4, 500.0, told_percent=-70.0)
    result, acks = the_same(Case("adult#008", mode="s3", scenario=scenario, days=3.4, model=controller, tuning=tuning))
    assert (AckFor.INSULIN_BOLUS_PROGRAM, AckResult.OVER_LIMIT) in acks
    assert (AckFor.CANCEL, AckResult.ACCEPTED) in acks
    assert not result.strokes[3 * DAY - 6 : 3 * DAY].any()
    assert result.strokes[3 * DAY :].any()
    assert (
        result.limiters[3 * DAY + 7 * 12] & layout.LIMITER_MAX_BOLUS
    )  # as little as there was to be had the last time


def test_pramlintide_that_runs_out() -> None:
    tuning = Tuning(pram_ratio=40.0, pram_bolus=400.0, pram_tdd=1600.0, assumed_carbs=150.0)
    result, acks = the_same(Case("adult#009", mode="s4", scenario=feast(6, 200.0), days=5.9, tuning=tuning))
    assert (AckFor.PRAM_BOLUS_PROGRAM, AckResult.OVER_LIMIT) in acks
    assert (result.pram_rate > 3000).any()
    for day in (3, 6):
        assert not result.pram_strokes[day * DAY - 60 : day * DAY - 30].any()  # empty before it is changed


def test_what_a_new_reservoir_holds() -> None:
    for settings, primed in ((INSULIN_CHAMBER, loop.INSULIN_PRIMED), (PRAMLINTIDE_CHAMBER, loop.PRAM_PRIMED)):
        chamber = Chamber(settings)
        chamber.change()
        assert chamber.words[FLUID] == primed


def test_a_patient_of_ones_own_and_other_physiology() -> None:
    patient = replace(load_patient("adult#010", pramlintide="P4", physiology="S2013"), name="somebody")
    controller: ControllerModel = shipped_models()["adult#001"]
    result, _ = the_same(Case(patient, mode="s4", scenario="camerlingo", days=1, model=controller, seed=0))
    by_name, _ = the_same(Case("adult#010", mode="s4", scenario="camerlingo", physiology="S2013", pramlintide="P4"))
    assert (result.glucose != by_name.glucose).any()


def anything(number: int) -> Case:
    """A case drawn from everything that can be asked for, far beyond what anybody would."""
    generator = np.random.default_rng(number)

    def pick(*choices: Any) -> Any:
        return choices[int(generator.integers(len(choices)))]

    days = pick(0.5, 1, 2, 4)
    kinds = ("Breakfast", "Lunch", "Dinner", "Snack")
    meals = [
        Meal(int(generator.integers(0, days * DAY)), pick(*kinds), float(np.exp(generator.uniform(1.1, 5.7))))
        for _ in range(int(generator.integers(0, 14 * days)))
    ]
    habits = Announcing(
        estimate=pick("exact", "kawamura", "gaussian"),
        missed=pick(0.0, 0.3),
        late=pick(None, Late(probability=0.5)),
        ahead_minutes=pick(0, 15, 60),
    )
    rescue = pick(None, Rescue(), Rescue(below=100, samples=1, carbs=40, lockout_minutes=5, announced=True))
    sensor = {
        "model": pick(*MODELS, {"name": "coloured", "sd": pick(2, 12, 16, 40)}),
        "sample_minutes": pick(5, 5, 5, 5, 10, 15),
        "range": pick((40, 400), (40, 400), (90, 200), (0, 800)),
        "warmup_minutes": pick(0, 0, 60, 120),
        "lifetime_days": pick(None, None, 0.4, 1.0),
        "renew": pick(True, True, False),
        "worn_minutes": pick(0, 300),
        "battery_days": pick(90, 90, 0.7),
    }
    tuning = Tuning(
        theta=generator.uniform(5, 30),
        gain=generator.uniform(0.2, 3),
        bolus_deduction=generator.uniform(0, 1),
        meal_factor=generator.uniform(0.2, 1),
        assumed_carbs=generator.uniform(5, 150),
        pram_ratio=pick(0, 6, 10, 25, 40),
        pram_bolus=pick(0, 0.3, 15, 30, 130, 400),
        max_basal=pick(1, 5, 30, 40),
        max_bolus=pick(0.03, 3, 30, 40),
        max_iob=pick(2, 8, 40),
        peak_ratio=generator.uniform(0.5, 3),
        peak_slope=generator.uniform(0.1, 1),
        basal_factor=pick(0.5, 4, 25.5),
        low_suspend=pick(0, 70, 110),
        bolus_lockout=pick(0, 3, 12),
        max_rise=pick(0.2, 2, 60),
        pram_tdd=pick(20, 200, 1000, 1600),
        stuck_samples=pick(0, 2, 3, 10),
    )
    loose = replace(tuning, max_basal=40.0, max_rise=60.0, basal_factor=25.5, max_iob=40.0, low_suspend=0.0, gain=3.0)
    return Case(
        pick(*ADULTS),
        mode=pick(*MODES),
        scenario=Scenario("anything", 4, tuple(sorted(meals)), habits, rescue),
        seed=number,
        days=days,
        sensor=SensorSettings.model_validate(sensor),
        variability=pick((), tuple(SOURCES)),
        tuning=pick(tuning, loose, SAFE),
        physiology=pick(None, "S2013"),
        pramlintide=pick(None, "P4"),
    )


@pytest.mark.parametrize("number", range(300 if NIGHTLY else 10))
def test_anything_that_can_be_asked_for(number: int) -> None:
    the_same(anything(number))


# ---- the outcome


def test_the_metrics_are_those_of_the_run_folder(tmp_path: Path) -> None:
    request = rig.Request("adult#003", tmp_path / "run", strategy="s3", steps=DAY, seed=3, bus="inproc")
    recorded = json.loads((rig.execute(rig.prepare(request)) / "metrics.json").read_text())
    safety = recorded.pop("safety")
    ours = simulate(Case("adult#003", mode="s3", seed=3)).metrics()
    assert ours.pop("limiter_steps") == safety["limiter_steps"]
    assert ours == recorded


def test_limiter_steps_are_counted() -> None:
    result = simulate(Case("adult#003", scenario=feast(1, 100.0), tuning=SAFE))
    assert result.metrics()["limiter_steps"] == np.count_nonzero(result.limiters) > 10


def test_a_case_is_the_same_again_and_in_another_process() -> None:
    """The machine code comes from the disk there: a campaign's processes must not compile."""
    case = Case("adult#002", mode="s1", days=0.5, seed=9)
    here = simulate(case)
    assert all(np.array_equal(one, other) for one, other in zip(here, simulate(case), strict=True))
    code = (
        "import pickle, sys; from pumpbench.closed_loop import loop, simulate\n"
        "result = simulate(pickle.load(sys.stdin.buffer))\n"
        "pickle.dump((result, sum(loop.run.stats.cache_misses.values())), sys.stdout.buffer)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(case), stdout=subprocess.PIPE, check=True)
    there, compiled_anew = pickle.loads(done.stdout)
    assert all(np.array_equal(one, other) for one, other in zip(here, there, strict=True))
    assert compiled_anew == 0


def test_every_case_runs_the_same_machine_code() -> None:
    """Another layout or type of one array would compile the whole loop once more."""
    simulate(Case("adult#001", days=0.01, scenario=Scenario("none", 1, ()), sensor="facchinetti"))
    simulate(Case("adult#001", days=0.01, sensor="vettoretti", tuning=SAFE))
    assert len(loop.run.signatures) == 1


def test_machine_code_expires_with_any_of_its_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))  # kept code names its module, which has to be one that can be imported
    source, other = tmp_path / "source_of_code.py", tmp_path / "other.py"
    source.write_text("def double(x):\n    return 2 * x\n")
    other.write_text("A = 1\n")

    def misses() -> int:
        gc.collect()  # nothing of the code before is left in memory: it comes from the disk or is made anew
        monkeypatch.delitem(sys.modules, "source_of_code", raising=False)
        dispatcher = compiled.kept_on_disk([source, other])(importlib.import_module("source_of_code").double)
        assert dispatcher(3) == 6
        return sum(dispatcher.stats.cache_misses.values())

    assert [misses(), misses()] == [1, 0]
    other.write_text("A = 2\n")
    assert [misses(), misses()] == [1, 0]


def test_code_that_cannot_be_kept_is_compiled_each_time() -> None:
    scope: dict[str, object] = {}
    exec("def double(x):\n    return 2 * x\n", scope)  # of no file: there is no place beside it
    assert compiled.kept_on_disk([])(scope["double"])(4) == 8


def test_its_speed_is_a_figure_of_the_benchmark() -> None:
    one, two = benchmark("compiled", days=1, runs=1)
    assert (one["name"], two["name"]) == ("closed-loop/compiled", "closed-loop/compiled/2")
    assert two["ceiling"] == pytest.approx(2 * one["value"], rel=1e-3)
    assert one["ratio"] == pytest.approx(one["value"] / one["ceiling"], abs=1e-3)


# ---- what is refused


@pytest.mark.parametrize(
    ("case", "text"),
    [
        (Case("adult#001", mode="s5"), "no mode 's5'; choose one of nma, ma"),
        (Case("adult#001", days=0.001), "one step of 5 min to 100 days, found 0.001"),
        (Case("adult#001", scenario="fasting", days=101), "to 100 days, found 101"),
        (Case("adult#001", days=15), "scenario validation-14d has 14 days, asked for 15"),
        (Case("adult#001", seed=-1), "seed: 0 or greater, found -1"),
        (Case("adult#001", variability=("mood",)), "variability: choose of k_abs.*, found 'mood'"),
        (Case(load_patient("adult#001"), pramlintide="P2"), "given by name; this one has its own"),
        (Case(load_patient("adult#001"), physiology="S2013"), "given by name; this one has its own"),
        (Case("adult#001", scenario=Scenario("early", 1, (Meal(-1, "Lunch", 9.0),))), "early: a meal starts before"),
        (
            Case("adult#001", sensor=SensorSettings.model_validate({"effects": [{"kind": "stuck"}]})),
            r"sensor: effects \(stuck\) need the bus",
        ),
        (
            Case("adult#001", model=shipped_models()["adult#001"]._replace(carb_ratio=0.5)),
            r"the device would not accept CfgCarbRatio \(CfgIndex \d+\): raw 50",
        ),
    ],
)
def test_what_cannot_be_represented_is_refused(case: Case, text: str) -> None:
    with pytest.raises(CaseError, match=text):
        simulate(case)


def test_a_ledger_that_does_not_close_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def leaking(*_: object) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(11, np.int64), np.arange(11)

    monkeypatch.setattr(loop, "run", leaking)
    with pytest.raises(LoopError, match=r"the pump's ledger does not close: \[0, 1, 2"):
        simulate(Case("adult#001"))
