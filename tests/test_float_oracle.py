"""The firmware's integers against the paper's equations in float64, on the same inputs, in the closed loop.

The oracle is written from the transfer functions and the physical parameters; it shares neither code nor coefficients
with the firmware. It sees what the firmware sees on the bus: the CGM's readings, the pump's totals, and how much the
ladder allowed. Compared are the rates the firmware commanded, and the demand it computed before limits and rounding.
"""

import os
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest
from pumpbench.calibration import MODES, Tuning, calibrate, lead, tuning_for
from pumpbench.controller_model import ControllerModel, lags, shipped_models
from scipy import signal

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Phase
from firmware_sim.calibration import CORE, UNSET, parameter_names
from firmware_sim.control import core, layout
from firmware_sim.control.core import control_step
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from firmware_sim.pump import Op
from plant_server.physiology import Patient, load_patient
from plant_server.scenario import load_scenario
from plant_server.server import PlantServer, Run

Floats = npt.NDArray[np.float64]

T = 5.0  # min
DELAY = 3  # samples of e^(-15 s)
INSULIN_LSB = 0.005  # U/h
PRAMLINTIDE_LSB = 0.1  # ug/h
INSULIN, PRAMLINTIDE = 1, 2  # BolusHormone
BOLUS_LSB = {INSULIN: 0.01, PRAMLINTIDE: 0.1}  # U, ug
STEPS_PER_DAY = 288

ADULTS = tuple(f"adult#{number:03d}" for number in range(1, 11))


MODEL = shipped_models()["adult#001"]
"""Its time constants are those of all adults."""


def gains(name: str) -> tuple[float, float]:
    """K_d in mg/dL per g/min and K_u in mg/dL per U/min of one patient."""
    model = shipped_models()[name]
    return model.K_d, model.K_u


# ---- the oracle


@dataclass
class Inputs:
    """What the firmware was told, one entry per step."""

    glucose: list[float] = field(default_factory=list)  # mg/dL
    total: list[float] = field(default_factory=list)  # U delivered since the start
    limit: list[int] = field(default_factory=list)
    below_range: list[bool] = field(default_factory=list)  # suspends, whatever the ladder says
    bolus: list[float] = field(default_factory=list)  # U of insulin boluses delivered since the start
    meals: dict[int, float | None] = field(default_factory=dict)  # step -> g announced, None = the time alone


class Oracle:
    """Pons Torres et al. 2025, section "Main controller", in continuous-time terms; scipy makes it discrete."""

    def __init__(self, patient: Patient, tuning: Tuning, mode: int) -> None:
        self.basal = patient.basal_u_per_h
        self.target = patient.basal_glucose
        self.max_basal = max(tuning.max_basal, self.basal)
        self.mode, self.tuning = mode, tuning
        self.carb_ratio = shipped_models()[patient.name].carb_ratio
        self.ratio = tuning.pram_ratio if mode in (MODES["s2"], MODES["s4"]) else 0.0
        meal_gain, insulin_gain = gains(patient.name)
        self.meal_gain = meal_gain
        self.gamma = tuning.gain * meal_gain / insulin_gain
        # G_u(s) = K_u / ((tau_1u s + 1)^2 (tau_2u s + 1)), insulin held over a sample
        poles = np.polymul(np.polymul([MODEL.tau_1u, 1], [MODEL.tau_1u, 1]), [MODEL.tau_2u, 1])
        numerator, denominator, _ = signal.cont2discrete(([insulin_gain], poles), T, method="zoh")
        self.insulin_model = numerator.ravel(), denominator
        # F(s) G_d(s)^-1 = (tau_1d s + 1)^2 (tau_2d s + 1) / (theta s + 1)^3 / K_d, by Tustin's rule
        zeros = np.polymul(np.polymul([MODEL.tau_1d, 1], [MODEL.tau_1d, 1]), [MODEL.tau_2d, 1])
        filtered = np.polymul(np.polymul([tuning.theta, 1], [tuning.theta, 1]), [tuning.theta, 1])
        self.observer = signal.bilinear(zeros, filtered, fs=1 / T)

    def demand(self, inputs: Inputs) -> Floats:
        """u_b + gamma d - x F e^(-15 s) u_B of every step, U/h, before limits and rounding."""
        answer = self.gamma * self.meal(np.array(inputs.glucose), np.array(inputs.total))
        return self.basal + 60 * (answer - self.tuning.bolus_deduction * self.filtered(np.array(inputs.bolus)))

    def filtered(self, bolus: Floats) -> Floats:
        """F(s) e^(-15 s) u_B of every step, U/min, from the bolus insulin delivered since the start."""
        given = np.zeros(bolus.size)
        given[1:] = np.diff(bolus) / T
        numerator, denominator, _ = signal.cont2discrete(([1.0], cascade(*[self.tuning.theta] * 3)), T, method="zoh")
        delayed = np.concatenate([np.zeros(DELAY - 1), given])[: bolus.size]
        return signal.lfilter(numerator.ravel(), denominator, delayed)

    def boluses(self, demand: Floats, inputs: Inputs) -> dict[tuple[int, int], float]:
        """What the mode gives: (step, drug) -> U or ug, before rounding."""
        doses: dict[tuple[int, int], float] = {}
        for step, grams in inputs.meals.items():
            if inputs.limit[step] != 0:
                continue  # nothing is dosed for a meal while insulin is held back
            simple = self.mode in (MODES["sma"], MODES["s4"])
            carbs = self.tuning.assumed_carbs if simple or grams is None else grams
            insulin = self.tuning.meal_factor * carbs / self.carb_ratio
            doses[step, INSULIN] = insulin
            if self.mode == MODES["s3"]:
                doses[step, PRAMLINTIDE] = self.tuning.pram_bolus
            elif self.mode == MODES["s4"]:
                doses[step, PRAMLINTIDE] = self.ratio * np.floor(insulin * 100 + 1e-9) / 100
        if self.mode == MODES["s1"]:
            doses |= {(step, PRAMLINTIDE): self.tuning.pram_bolus for step in self.peaks(demand, inputs)}
        held_back = [key for key in doses if inputs.limit[key[0]] != 0]
        low = [key for key in doses if key[1] == PRAMLINTIDE and inputs.glucose[key[0]] < 70 - 1e-9]
        return {key: dose for key, dose in doses.items() if key not in (*held_back, *low)}

    def peaks(self, demand: Floats, inputs: Inputs) -> list[int]:
        """Steps in which B_1 and B_2 of strategy 1 hold."""
        u, glucose = np.maximum(demand, 0), np.array(inputs.glucose)
        found: list[int] = []
        for k in range(2, u.size):
            peak = u[k - 1] > u[k - 2] and u[k] < u[k - 1]
            steep = (glucose[k] - glucose[k - 1]) / T > self.tuning.peak_slope + 1e-9
            waited = not found or k - found[-1] > self.tuning.peak_lockout
            if peak and steep and waited and u[k] > self.tuning.peak_ratio * self.basal:
                found.append(k)
        return found

    def meal(self, glucose: Floats, total: Floats) -> Floats:
        """The estimate d of every step, g/min."""
        above = np.zeros(glucose.size)  # [k]: mean of u - u_b over the sample before instant k, U/min
        above[1:] = np.diff(total) / T - self.basal / 60
        # a delay of 15 min, of which scipy's strictly proper filter does one sample and `above` does another
        delayed = np.concatenate([np.zeros(DELAY - 1), above])[: glucose.size]
        v = glucose - self.target + signal.lfilter(*self.insulin_model, delayed)
        # after a gap, so also at the start, the first two samples are taken as if glucose had always been there
        settled = 2
        d = v.copy()
        at_rest = signal.lfilter_zi(*self.observer) * v[settled - 1]
        d[settled:], _ = signal.lfilter(*self.observer, v[settled:], zi=at_rest)
        return d / self.meal_gain

    def commands(self, demand: Floats, limits: list[int]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Rates of both drugs in their LSBs: limited, rounded down, the rest carried."""
        insulin, pramlintide = np.zeros(demand.size, dtype=np.int64), np.zeros(demand.size, dtype=np.int64)
        carry = pram_carry = 0.0
        for k, limit in enumerate(limits):
            ceiling = {0: self.max_basal, 1: self.basal, 2: 0.0}[limit] / INSULIN_LSB
            exact = min(max(demand[k] / INSULIN_LSB, 0.0), ceiling) + carry
            carry = exact - np.floor(exact)
            insulin[k] = min(np.floor(exact), np.floor(ceiling))
            if limit != 2:
                exact = self.ratio * insulin[k] * INSULIN_LSB / PRAMLINTIDE_LSB + pram_carry
                pram_carry = exact - np.floor(exact)
                pramlintide[k] = np.floor(exact)
        return insulin, pramlintide


# ---- the closed loop


@dataclass
class Loop:
    """One run of plant and firmware in this process, and what the two said to each other."""

    inputs: Inputs = field(default_factory=Inputs)
    demand: list[float] = field(default_factory=list)  # U/h
    insulin: list[int] = field(default_factory=list)
    pramlintide: list[int] = field(default_factory=list)
    operation: list[int] = field(default_factory=list)
    boluses: dict[tuple[int, int], int] = field(default_factory=dict)  # (step, drug) -> raw dose committed
    step: int = 0
    delivered: dict[int, int] = field(default_factory=dict)  # BolusId -> raw
    meal_ids: set[int] = field(default_factory=set)
    announced: list[dict[str, int]] = field(default_factory=list)
    diag: dict[str, int] = field(default_factory=dict)

    def play(self, run: Run) -> "Loop":
        plant, firmware = PlantServer(run), Firmware()
        to_device = deque(plant.call_roll())
        while not plant.finished:
            assert to_device, plant.waiting_for
            answers = []
            for frame in to_device:
                self._hear_plant(frame)
                answers += firmware.receive(frame)
            to_device.clear()
            for frame in answers:
                self._hear_firmware(frame, firmware)
                to_device += plant.receive(frame)
        # the last instant only ends the run
        self.inputs.glucose.pop()
        self.inputs.total.pop()
        self.inputs.bolus.pop()
        return self

    def _hear_plant(self, frame: Frame) -> None:
        message = codec.messages_by_id()[frame.can_id]
        if message.name == "CGM_Reading":
            values = message.unpack(frame.data)
            out_of_range = {4: 40.0, 5: 400.0}
            self.inputs.glucose.append(out_of_range.get(values["CgmState"], values["GlucoseConc"] * 0.1))
            self.inputs.below_range.append(values["CgmState"] == 4)
        elif message.name == "PUMP_Delivered":
            self.inputs.total.append(message.unpack(frame.data)["InsulinTotal"] * 0.001)
        elif message.name == "PUMP_BolusState":
            values = message.unpack(frame.data)
            if values["BolusStateHormone"] == INSULIN:
                self.delivered[values["BolusStateId"]] = values["BolusDeliveredRaw"]
                self.inputs.bolus.append(sum(self.delivered.values()) * 0.01)
        elif message.name == "MEAL_Announce":
            self.announced.append(message.unpack(frame.data))
        elif message.name == "SYNC_Step":
            values = message.unpack(frame.data)
            if values["SyncPhase"] == Phase.STEP:
                self.step = values["StepIndex"]
                for meal in self.announced:
                    if meal["MealId"] not in self.meal_ids and self.step not in self.inputs.meals:
                        self.meal_ids.add(meal["MealId"])
                        self.inputs.meals[self.step] = None if meal["MealKind"] == 2 else meal["CarbsEst"] * 0.5
                self.announced.clear()

    def _hear_firmware(self, frame: Frame, firmware: Firmware) -> None:
        message = codec.messages_by_id()[frame.can_id]
        if message.name == "PUMP_BasalCmd":
            values = message.unpack(frame.data)
            self.insulin.append(values["InsulinRate"])
            self.pramlintide.append(values["PramlintideRate"])
            self.operation.append(values["BasalOp"])
            self.demand.append(firmware._outputs[layout.OUT_DEMAND] / 65536 * INSULIN_LSB)
        elif message.name == "PUMP_BolusCmd":
            values = message.unpack(frame.data)
            if values["BolusOp"] == 2:
                drug = values["BolusHormone"]
                dose = values["InsulinBolus" if drug == INSULIN else "PramlintideBolus"]
                self.boluses[self.step, drug] = dose
        elif message.name == "CTRL_Status":
            state = message.unpack(frame.data)["CtrlState"]
            limit = {State.AUTO: 0, State.SUSPENDED: 2}.get(State(state), 1)
            self.inputs.limit.append(2 if self.inputs.below_range[-1] else limit)
        elif message.name == "CTRL_Diag":
            self.diag = message.unpack(frame.data)


@dataclass
class Errors:
    """How far apart firmware and oracle are; the worst of a run."""

    insulin: int  # LSB, commanded rate
    pramlintide: int
    unequal: int  # steps with any difference
    demand: float  # LSB of the insulin command
    day: float  # share of a day's insulin
    bolus: float  # LSB of the bolus command, of either drug
    boluses: int  # given by either
    odd: int  # boluses that only one of the two gave


Wrong = Tuning | ControllerModel


def compare(name: str, strategy: str, days: int, tuning: Tuning | None = None, wrong: Wrong | None = None) -> Errors:
    """Run one patient in the closed loop and hold the oracle against the firmware.

    Args:
        name: of the patient.
        strategy: as on the command line.
        days: of the validation scenario.
        tuning: of both.
        wrong: tuning or model of the firmware, if that shall differ from the oracle's.
    """
    patient, tuning = load_patient(name), tuning or tuning_for(strategy)
    mode = MODES[strategy]
    if isinstance(wrong, ControllerModel):
        calibration = calibrate(patient, tuning, wrong)
    else:
        calibration = calibrate(patient, wrong or tuning)
    run = Run(patient, load_scenario("validation-14d"), days * STEPS_PER_DAY, 1, mode, calibration)
    loop = Loop().play(run)
    assert loop.diag["SaturationCount"] == loop.diag["LostFrameCount"] == loop.diag["E2eErrorCount"] == 0
    oracle = Oracle(patient, tuning, mode)
    assert len(loop.meal_ids) < 255, "MealId has wrapped: the oracle cannot tell meals apart"
    demand = oracle.demand(loop.inputs)
    insulin, pramlintide = oracle.commands(demand, loop.inputs.limit)
    commanded = np.array(loop.operation) == Op.SET_RATE
    assert commanded[1:].all() and not commanded[0]  # the first sample only opens the ladder
    difference = (np.array(loop.insulin) - insulin)[commanded]
    pram_difference = (np.array(loop.pramlintide) - pramlintide)[commanded]
    daily = np.where(commanded, [loop.insulin, insulin], 0).reshape(2, days, STEPS_PER_DAY).sum(axis=2)
    expected = oracle.boluses(demand, loop.inputs)
    both = expected.keys() & loop.boluses.keys()
    bolus_errors = [expected[key] / BOLUS_LSB[key[1]] - loop.boluses[key] for key in both]
    return Errors(
        insulin=int(np.abs(difference).max()),
        pramlintide=int(np.abs(pram_difference).max()),
        unequal=int(np.count_nonzero(difference)),
        demand=float(np.abs(np.array(loop.demand) - demand).max() / INSULIN_LSB),
        day=float(np.abs(daily[0] / daily[1] - 1).max()),
        bolus=float(max(np.abs(bolus_errors), default=0.0)),
        boluses=len(both),
        odd=len(expected.keys() ^ loop.boluses.keys()),
    )


def pairs() -> list[tuple[str, str]]:
    """Adults and modes: every one of both, eleven runs; all seventy with PUMPBENCH_NIGHTLY=1 (`make nightly`)."""
    every = [(name, strategy) for name in ADULTS for strategy in MODES]
    return every if os.environ.get("PUMPBENCH_NIGHTLY") == "1" else [*every[::8], every[50], every[-1]]


@pytest.mark.parametrize(("name", "strategy"), pairs())
def test_every_dose_is_within_one_lsb_of_the_float_oracle(name: str, strategy: str) -> None:
    errors = compare(name, strategy, days=14)
    print(f"{name} {strategy}: {errors}")
    assert errors.insulin <= 1
    assert errors.pramlintide <= 1
    assert errors.demand < 0.25  # the integers themselves; the rest of an LSB is the rounding of the command
    assert errors.day < 0.001
    assert errors.bolus < 1 + 1e-9  # rounded down
    assert errors.odd == 0
    assert (errors.boluses > 14) == (strategy not in ("nma", "s2"))


def test_a_limit_that_bites_is_kept_to_the_same_lsb() -> None:
    errors = compare("adult#001", "s2", days=2, tuning=Tuning(max_basal=2.502))
    assert errors.insulin <= 1
    assert errors.pramlintide <= 1
    assert errors.day < 0.001


@pytest.mark.parametrize(
    "wrong", [Tuning(theta=12.05), Tuning(gain=0.681), Tuning(pram_ratio=10.1), MODEL._replace(tau_2u=324.0)]
)
def test_the_oracle_notices_a_controller_that_is_slightly_off(wrong: Wrong) -> None:
    """What is flashed differs by half a percent or so from what the oracle was told."""
    errors = compare("adult#001", "s2", days=1, wrong=wrong)
    assert errors.demand > 0.25 or errors.pramlintide > 1


# ---- closed forms


def flashed(name: str, tuning: Tuning | None = None) -> list[int]:
    """The parameters of the control core after flashing this patient."""
    names = parameter_names()
    values = {names[index]: raw for index, raw in calibrate(load_patient(name), tuning).items()}
    assert set(CORE.values()) <= set(values) | set(UNSET)
    return [values[CORE[word.name]] for word in layout.PARAMETERS]


def core_demand(parameters: list[int], glucose: Floats, delivered: Floats | None) -> Floats:
    """Demand of the integer core in U/h for CGM values in mg/dL and insulin in U per step (None: as scheduled)."""
    state, inputs, outputs = ([0] * len(words) for words in (layout.STATE, layout.INPUTS, layout.OUTPUTS))
    demand = np.zeros(glucose.size)
    for k in range(glucose.size):
        inputs[layout.IN_GLUCOSE] = round(glucose[k] * 10)
        inputs[layout.IN_DELIVERED] = -1 if delivered is None else round(delivered[k] * 1000)
        inputs[layout.IN_MODE] = core.MODE_NMA
        inputs[layout.IN_INSULIN_LEFT] = 1 << 30
        inputs[layout.IN_RESET] = int(k < 2)
        control_step(state, parameters, inputs, outputs)
        demand[k] = outputs[layout.OUT_DEMAND] / 65536 * INSULIN_LSB
    assert state[layout.SATURATIONS] == 0
    return demand


def responses(system: tuple[list[float], Floats], u: Floats, substeps: int = 10) -> Floats:
    """Response at the sampling instants of gain/denominator to an input held over fractions of a sample."""
    numerator, denominator, _ = signal.cont2discrete(system, T / substeps, method="zoh")
    return signal.lfilter(numerator.ravel(), denominator, u)[::substeps]


def cascade(*taus: float) -> Floats:
    product = np.array([1.0])
    for tau in taus:
        product = np.polymul(product, [tau, 1])
    return product


@pytest.mark.parametrize("taus", [(79.0, 79.0, 323.0), (12.0, 12.0, 12.0), (2.0, 159.0, 55.0)])
def test_lags_are_the_exact_hold(taus: tuple[float, float, float]) -> None:
    a = np.array([[-1 / taus[0], 0, 0], [1 / taus[1], -1 / taus[1], 0], [0, 1 / taus[2], -1 / taus[2]]])
    b = np.array([[1 / taus[0]], [0], [0]])
    expected = signal.cont2discrete((a, b, np.array([[0, 0, 1]]), np.zeros((1, 1))), T, method="zoh")
    matrix, inlet = lags(taus)
    np.testing.assert_allclose(matrix, expected[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(inlet, expected[1].ravel(), rtol=1e-12)
    # and as a transfer function, poles in any order
    numerator, denominator, _ = signal.cont2discrete(([1.0], cascade(*taus)), T, method="zoh")
    impulse = signal.lfilter(numerator.ravel(), denominator, np.eye(1, 40).ravel())
    x, response = np.zeros(3), []
    for k in range(40):
        response.append(x[2])
        x = matrix @ x + inlet * (k == 0)
    np.testing.assert_allclose(response, impulse, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("tau", "theta"), [(159.0, 12.0), (2.0, 12.0), (0.0, 15.0)])
def test_lead_is_tustins_rule(tau: float, theta: float) -> None:
    b, a = signal.bilinear([tau, 1], [theta, 1], fs=1 / T)
    b0, b1, a1 = lead(tau, theta)
    np.testing.assert_allclose([b0, b1, 1, a1], [*b, *a], rtol=1e-12)
    assert (b0 + b1) / (1 + a1) == pytest.approx(1)  # a constant passes unchanged


@pytest.mark.parametrize("name", ADULTS)
def test_constant_glucose_above_target_is_a_constant_meal(name: str) -> None:
    """G_d(0) = K_d: an offset e at rest reads as a meal of e/K_d, answered with gamma e/K_d."""
    patient, tuning = load_patient(name), Tuning()
    _, insulin_gain = gains(name)
    offset = 50.0
    demand = core_demand(flashed(name), np.full(50, patient.basal_glucose + offset), None)
    expected = patient.basal_u_per_h + 60 * tuning.gain * offset / insulin_gain
    np.testing.assert_allclose(demand, expected, atol=0.1 * INSULIN_LSB)


@pytest.mark.parametrize("name", ADULTS)
def test_insulin_that_leaves_no_trace_in_glucose_is_answered_in_full(name: str) -> None:
    """G_u(0) = K_u: with glucose at target, insulin u above the schedule must meet a meal of K_u u/K_d."""
    patient, tuning = load_patient(name), Tuning()
    parameters = flashed(name)
    steps = 3000
    per_step = round(parameters[layout.BASAL] / 12) / 1000 + 0.050
    above = per_step * 12 - parameters[layout.BASAL] / 1000
    demand = core_demand(parameters, np.full(steps, patient.basal_glucose), np.full(steps, per_step))
    assert demand[-1] - patient.basal_u_per_h == pytest.approx(tuning.gain * above, abs=0.2 * INSULIN_LSB)


@pytest.mark.parametrize("name", ADULTS)
def test_a_meal_of_50_g_is_estimated_as_50_g(name: str) -> None:
    patient, tuning = load_patient(name), Tuning()
    meal_gain, insulin_gain = gains(name)
    gamma = tuning.gain * meal_gain / insulin_gain
    steps, substeps = 600, 10
    eaten = np.zeros(steps * substeps)
    start, minutes = 20, 15
    eaten[(start + DELAY) * substeps : (start + DELAY + minutes // 5) * substeps] = 50 / minutes  # g/min, 15 min late
    rise = responses(([meal_gain], cascade(MODEL.tau_1d, MODEL.tau_1d, MODEL.tau_2d)), eaten)
    meal = (core_demand(flashed(name), patient.basal_glucose + rise, None) - patient.basal_u_per_h) / 60 / gamma
    assert meal.sum() * T == pytest.approx(50, rel=0.02)
    assert np.abs(meal[:start]).max() < 0.02  # nothing before the meal
    peak = int(meal.argmax())
    # F delays by 3 theta on average, and the model's delay cannot be looked behind
    assert start + DELAY < peak <= start + DELAY + round((minutes + 3 * tuning.theta) / T)


@pytest.mark.parametrize("name", ADULTS)
def test_insulin_whose_effect_is_seen_is_no_meal(name: str) -> None:
    """y = -G_u u: the observer explains the fall of glucose with the insulin, and asks for nothing."""
    patient, tuning = load_patient(name), Tuning()
    _, insulin_gain = gains(name)
    parameters = flashed(name)
    steps, substeps = 800, 10
    generator = np.random.default_rng(4)
    boluses = 0.05 * generator.poisson(4.0, steps) * (generator.random(steps) < 0.1)
    basal = parameters[layout.BASAL] / 12000
    # the motor's own steps: whole mU, the schedule on average
    scheduled = np.diff(np.floor(np.arange(steps + 1) * basal * 1000)) / 1000
    delivered = scheduled + boluses
    above = np.zeros(steps * substeps)
    held = np.repeat((delivered - basal) / T, substeps)
    above[DELAY * substeps :] = held[: -DELAY * substeps]
    fall = responses(([insulin_gain], cascade(MODEL.tau_1u, MODEL.tau_1u, MODEL.tau_2u)), above)
    reported = np.concatenate([[basal], delivered[:-1]])  # the total of an instant is of the sample before it
    demand = core_demand(parameters, patient.basal_glucose - fall, reported)
    assert fall.max() > 10  # mg/dL: there was something to explain
    # what is left is the sensor's resolution of 0.1 mg/dL, seen through the observer
    b, a = Oracle(patient, tuning, MODES["nma"]).observer
    gain = np.abs(signal.lfilter(b, a, np.eye(1, 400).ravel())).sum()
    noise = 0.05 * gain * 60 * tuning.gain / insulin_gain
    assert np.abs(demand[2:] - patient.basal_u_per_h).max() < noise + INSULIN_LSB


def test_calibration_of_the_filter_is_three_equal_lags() -> None:
    names = parameter_names()
    values = {names[index]: raw for index, raw in calibrate(load_patient("adult#001")).items()}
    numerator, denominator, _ = signal.cont2discrete(([1.0], cascade(12.0, 12.0, 12.0)), T, method="zoh")
    response = signal.lfilter(numerator.ravel(), denominator, np.ones(60))
    a = [values[f"CfgFilterA{i}"] / 2**30 for i in (1, 2, 3)]
    b = [values[f"CfgFilterB{i}"] / 2**30 for i in (1, 2, 3)]
    matrix = np.array([[a[0], 0, 0], [a[1], a[0], 0], [a[2], a[1], a[0]]])
    x = np.zeros(3)
    for expected in response:
        assert x[2] == pytest.approx(expected, abs=1e-7)
        x = matrix @ x + np.array(b)
