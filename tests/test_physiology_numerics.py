"""The integration: against an independent solution, its order, its balances, and what it survives."""

import math
import os
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from scipy.integrate import solve_ivp

from plant_server import physiology
from plant_server.physiology import integrate
from plant_server.physiology import parameters as par
from plant_server.physiology import states as st

FULL = os.environ.get("PUMPBENCH_FULL") == "1"

STEPS_PER_DAY = 2880
STEPS_PER_SAMPLE = 10


class Course(NamedTuple):
    """What happens to a patient, per 30-s step, and the meals: step -> mg."""

    insulin: np.ndarray
    pramlintide: np.ndarray
    carbs: np.ndarray
    meals: dict[int, float]


def busy_days(patient, days, seed=3, pramlintide=True):
    """Three to five meals a day with boluses of both drugs, insulin that changes every 5 min, pramlintide with it."""
    rng = np.random.default_rng(seed)
    n = days * STEPS_PER_DAY
    rate = rng.uniform(0.0, 2.2, n // STEPS_PER_SAMPLE).repeat(STEPS_PER_SAMPLE)
    insulin = rate * patient.basal_u_per_h / 120.0
    drug = 10.0 * insulin
    carbs = np.zeros(n)
    meals = {}
    for day in range(days):
        for hour in (7.5, 12.6, 19.3, *rng.uniform(9.5, 12.0, rng.integers(0, 3))):
            start = int((24 * day + hour) * 12) * STEPS_PER_SAMPLE
            grams = rng.uniform(8.0, 100.0)
            minutes = int(rng.integers(5, 20))
            carbs[start : start + 2 * minutes] += 1000.0 * grams / (2 * minutes)
            meals[start] = meals.get(start, 0.0) + 1000.0 * grams
            units = 0.8 * grams / patient.carb_ratio_g_per_u
            insulin[start : start + 8] += units / 8
            drug[start : start + 4] += 15.0 / 4
    return Course(insulin, drug * pramlintide, carbs, meals)


def run(patient, variability, course):
    """Plasma glucose at every 5-min sample, by `advance` in chunks of 5 min."""
    x = patient.x0.copy()
    p = variability.apply(patient.params)
    glucose = []
    for sample, k in enumerate(range(0, course.insulin.size, STEPS_PER_SAMPLE)):
        if k in course.meals:
            meal = sorted(course.meals).index(k)
            p = variability.apply(patient.params, variability.meal(meal))
            physiology.begin_meal(x, p, course.meals[k])
        piece = slice(k, k + STEPS_PER_SAMPLE)
        inputs = course.insulin[piece], course.pramlintide[piece], course.carbs[piece]
        physiology.advance(x, p, 5.0 * sample, *inputs)
        glucose.append(physiology.glucose(x, p))
    return np.array(glucose)


def printed_equations(t, x, q, meal, insulin_u_min, pramlintide_ug_min, carbs_mg_min):
    """The model once more, term by term as it is printed, on plain floats; `q` holds parameters by name."""
    (q_sto1, q_sto2, q_gut, gp, gt, gs, ip, il, x_, i1, xl, isc1, isc2, q1, q2, p1, p_eff, h, xh, srhs) = x

    sensitivity = 1.0 + q["circadian_amplitude"] * math.sin(2 * math.pi * t / 1440 + q["circadian_phase"])
    vmx, kp3 = q["Vmx"] * sensitivity, q["kp3"] * sensitivity

    # pramlintide
    p_in = pramlintide_ug_min * 253.20
    dq1 = q["a_s"] * p_in - (q["kq1"] + q["kq12"]) * q1
    dq2 = q["kq12"] * q1 - q["kq2"] * q2
    dp1 = q["kq1"] * q1 + q["kq2"] * q2 - q["ke"] * p1
    dp_eff = q["ka"] * (p1 - p_eff)
    hill = q["n"] * max(p_eff, 0.0) ** q["e"] / (q["d"] ** q["e"] + max(p_eff, 0.0) ** q["e"])
    eta = 1.0 / (1.0 + hill)

    # meal
    if meal > 0:
        alpha = 5 / (2 * meal * (1 - q["b"]))
        beta = 5 / (2 * meal * q["c"])
        q_sto = q_sto1 + q_sto2
        k_empt = q["kmin"] + (q["kmax"] - q["kmin"]) / 2 * (
            math.tanh(alpha * (q_sto - q["b"] * meal)) - math.tanh(beta * (q_sto - q["c"] * meal)) + 2
        )
    else:
        k_empt = q["kmax"]
    if 0 < meal < q["small_meal"]:
        k_empt *= q["small_meal"] / max(meal, 1000.0)
    dq_sto1 = carbs_mg_min - q["kmax"] * q_sto1
    dq_sto2 = q["kmax"] * q_sto1 - eta * k_empt * q_sto2
    dq_gut = eta * k_empt * q_sto2 - q["kabs"] * q_gut
    ra = q["f"] * q["kabs"] * q_gut / q["BW"]

    # insulin
    insulin = ip / q["Vi"]
    disc1 = insulin_u_min * 6000 / q["BW"] - (q["ka1"] + q["kd"]) * isc1
    disc2 = q["kd"] * isc1 - q["ka2"] * isc2
    dip = -(q["m2"] + q["m4"]) * ip + q["m1"] * il + q["ka1"] * isc1 + q["ka2"] * isc2
    dil = -(q["m1"] + q["m30"]) * il + q["m2"] * ip
    dx_ = -q["p2u"] * x_ + q["p2u"] * (insulin - q["Ib"])
    di1 = -q["ki"] * (i1 - insulin)
    dxl = -q["ki"] * (xl - i1)

    # glucose and counter-regulation
    g = gp / q["Vg"]
    on = q["S2013"]
    risk = 0.0
    if on and g < q["Gth"]:
        risk = 10 * (math.log(max(g, 60.0)) ** q["r1"] - math.log(q["Gth"]) ** q["r1"]) ** 2
    egp = max(0.0, q["kp1"] - q["kp2"] * gp - kp3 * xl + on * q["kcounter"] * xh)
    excretion = max(0.0, q["ke1"] * (gp - q["ke2"]))
    uptake = (q["Vm0"] + vmx * x_ * (1 + q["r3"] * risk)) * gt / (q["Km0"] + gt)
    dgp = egp + ra - q["Fsnc"] - excretion - q["k1"] * gp + q["k2"] * gt
    dgt = -uptake + q["k1"] * gp - q["k2"] * gt
    dgs = q["ksc"] * (gp - gs)
    dh = dxh = dsrhs = 0.0
    if on:
        target = q["kGSRs"] * (q["Gth"] - g) / (1 + max(insulin - q["Ith"], 0.0)) + q["k01g"] * q["Hb"]
        dsrhs = -q["alfaG"] * (srhs - max(target, 0.0))
        dh = -q["k01g"] * h + max(srhs, 0.0) + q["kGSRd"] * max(-dgp / q["Vg"], 0.0)
        dxh = q["kXGn"] * (max(h - q["Hb"], 0.0) - xh)
    stomach = (dq_sto1, dq_sto2, dq_gut)
    body = (dgp, dgt, dgs, dip, dil, dx_, di1, dxl, disc1, disc2)
    return (*stomach, *body, dq1, dq2, dp1, dp_eff, dh, dxh, dsrhs)


def by_name(p):
    return {record.name: float(value) for record, value in zip(par.PARAMETERS, p, strict=True)}


def dop853(patient, variability, course):
    """The same course by SciPy's DOP853, started anew wherever an input changes."""
    inputs = np.stack([course.insulin, course.pramlintide, course.carbs])
    changes = {0, inputs.shape[1], *course.meals, *(np.flatnonzero(np.diff(inputs).any(axis=0)) + 1).tolist()}
    marks = sorted(changes)
    x, meal = patient.x0[: st.INTEGRATED].copy(), 0.0
    q = by_name(variability.apply(patient.params))
    glucose = np.full(inputs.shape[1] // STEPS_PER_SAMPLE, np.nan)
    for start, end in pairwise(marks):
        if start in course.meals:
            meal = x[st.Q_STO1] + x[st.Q_STO2] + course.meals[start]
            factors = variability.meal(sorted(course.meals).index(start))
            q = by_name(variability.apply(patient.params, factors))
        rates = (inputs[:, start] / physiology.STEP_MIN).tolist()
        samples = [k for k in range(start + 1, end + 1) if k % STEPS_PER_SAMPLE == 0]
        solution = solve_ivp(
            lambda t, y, q=q, meal=meal, rates=rates: printed_equations(t, y.tolist(), q, meal, *rates),
            (start / 2, end / 2),
            x,
            method="DOP853",
            rtol=1e-11,
            atol=1e-9,
            t_eval=sorted({*(k / 2 for k in samples), end / 2}),
        )
        assert solution.success
        x = solution.y[:, -1]
        for k, t in ((k, k / 2) for k in samples):
            column = int(np.searchsorted(solution.t, t))
            glucose[k // STEPS_PER_SAMPLE - 1] = solution.y[st.GP, column] / q["Vg"]
    return glucose


# --- accuracy ----------------------------------------------------------------------------------------------------

NO_DRUG = ""
SHORT = [("adult#001", "S2008", "P2"), ("adult#006", "S2008", NO_DRUG), ("adult#004", "S2013", "moderate")]
COMBINATIONS = [("S2008", "P2"), ("S2008", NO_DRUG), ("S2013", "P2")]
ALL = [(name, *combination) for name in physiology.cohort() for combination in COMBINATIONS]


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("name", "kind", "drug"), ALL if FULL else SHORT)
def test_agrees_with_dop853_to_a_hundredth_of_a_mg_per_dl(name, kind, drug, record_property):
    patient = physiology.load_patient(name, pramlintide=drug or "P2", physiology=kind)
    variability = physiology.Variability(11, name)
    course = busy_days(patient, days=14 if FULL else 1, pramlintide=drug != NO_DRUG)
    error = np.abs(run(patient, variability, course) - dop853(patient, variability, course)).max()
    record_property("error_mg_dl", float(error))
    print(f"{name} {kind} {drug or 'no pramlintide'}: {error:.2e} mg/dL")
    assert error <= 0.01


@pytest.mark.parametrize(("grams", "minutes"), [(5, 0.5), (15, 3), (40, 5), (80, 5), (80, 20)])
def test_stays_accurate_however_fast_the_meal_is_eaten(grams, minutes):
    """adult#006 switches its gastric emptying within seconds when a meal is bolted."""

    class FastestGut(physiology.Variability):
        def meal(self, index):
            return physiology.MealFactors(k_abs=1.3, f=1.1, insulin=1.3)

    patient = physiology.load_patient("adult#006")
    n, eating = 480, int(2 * minutes)
    insulin = np.full(n, patient.basal_u_per_h / 120)
    carbs = np.zeros(n)
    carbs[100 : 100 + eating] = 1000.0 * grams / eating
    course = Course(insulin, np.zeros(n), carbs, {100: 1000.0 * grams})
    variability = FastestGut(1, "adult#006")
    assert np.abs(run(patient, variability, course) - dop853(patient, variability, course)).max() < 1e-3


@pytest.mark.parametrize("kind", physiology.PHYSIOLOGIES)
@pytest.mark.parametrize("name", physiology.cohort())
def test_right_hand_side_is_the_printed_one(name, kind):
    rng = np.random.default_rng(5)
    patient = physiology.load_patient(name, physiology=kind, pramlintide="P4")
    p = physiology.Variability(2, name).apply(patient.params)
    for _ in range(40):
        x = patient.x0 * rng.uniform(0.2, 2.0, len(st.STATES))
        x[: st.Q_GUT + 1] = rng.uniform(0.0, 4e4, 3)
        x[st.Q1 : st.P_EFF + 1] = rng.uniform(0.0, 3e3, 4)
        x[st.XH] = rng.uniform(0.0, 50.0)
        x[st.D] = rng.choice([0.0, 500.0, 20e3, 90e3])
        t, u, drug, eating = rng.uniform(0, 1e4), rng.uniform(0, 3), rng.uniform(0, 60), rng.uniform(0, 1e4)
        dx = np.zeros(len(st.STATES))
        circadian = integrate.circadian_factor(t, p)
        integrate.derivatives(x, p, circadian, u * 6000 / patient.body_weight_kg, drug * 253.20, eating, dx)
        printed = printed_equations(t, x[: st.INTEGRATED].tolist(), by_name(p), x[st.D], u, drug, eating)
        np.testing.assert_allclose(dx[: st.INTEGRATED], printed, rtol=1e-10, atol=1e-9)


def test_is_of_fourth_order():
    """Halving the step divides the error by 16, on a course without kinks."""
    patient = physiology.load_patient("adult#003")
    p = physiology.Variability(4, "adult#003").apply(patient.params)

    def state_after_two_hours(step):
        n = round(120 / step)
        x = patient.x0.copy()
        x[st.Q_STO1] = x[st.D] = 50e3
        x[st.ISC1] *= 2.0
        x[st.Q1] = 2000.0
        nothing = np.zeros(n)
        integrate.runge_kutta(x, p, 0.0, step, np.full(n, 0.02 * step), nothing, nothing)
        return x

    exact = state_after_two_hours(1 / 64)
    errors = [abs(state_after_two_hours(step)[st.GP] - exact[st.GP]) for step in (2.0, 1.0, 0.5, 0.25)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    print("orders", orders)
    assert np.all(orders > 3.6)
    assert orders[-1] == pytest.approx(4.0, abs=0.2)


def test_result_does_not_depend_on_the_pieces():
    """Bit for bit: a day at once, in 5-min turns, and in odd pieces."""
    patient = physiology.load_patient("adult#002", physiology="S2013")
    p = physiology.Variability(1, "adult#002").apply(patient.params)
    course = busy_days(patient, 1)

    def after(pieces):
        x = patient.x0.copy()
        physiology.begin_meal(x, p, 60e3)
        k = 0
        while k < STEPS_PER_DAY:
            piece = slice(k, k + pieces)
            inputs = course.insulin[piece], course.pramlintide[piece], course.carbs[piece]
            physiology.advance(x, p, 0.5 * k, *inputs)
            k += pieces
        return x

    whole = after(STEPS_PER_DAY)
    assert after(10).tobytes() == whole.tobytes()
    assert after(7).tobytes() == whole.tobytes()
    assert after(1).tobytes() == whole.tobytes()


def test_vanished_masses_become_zero():
    """Months without a meal do not end in the slow arithmetic of denormal numbers."""
    patient = physiology.load_patient("adult#002")
    x = patient.x0.copy()
    physiology.begin_meal(x, patient.params, 50e3)
    n = 30 * STEPS_PER_DAY
    carbs, nothing = np.zeros(n), np.zeros(n)
    carbs[0] = 50e3
    physiology.advance(x, patient.params, 0.0, np.full(n, patient.basal_u_per_h / 120), nothing, carbs)
    assert x[st.Q_STO1] == x[st.Q_STO2] == 0.0
    assert physiology.glucose(x, patient.params) == pytest.approx(120.0, rel=1e-6)


@pytest.mark.parametrize("bad", [-1e-9, math.nan, math.inf, 1e7])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_refuses_amounts_that_nobody_can_deliver(which, bad):
    patient = physiology.load_patient("adult#001")
    x = patient.x0.copy()
    inputs = [np.zeros(10), np.zeros(10), np.zeros(10)]
    inputs[which][7] = bad
    with pytest.raises(ValueError, match="negative, not a number"):
        physiology.advance(x, patient.params, 0.0, *inputs)
    assert x.tobytes() == patient.x0.tobytes()
    with pytest.raises(ValueError, match="a meal has"):
        physiology.begin_meal(x, patient.params, bad if not bad > 0 else math.inf)


def test_refuses_arrays_that_do_not_fit():
    patient = physiology.load_patient("adult#001")
    ten, nine = np.zeros(10), np.zeros(9)
    with pytest.raises(ValueError, match="number of steps"):
        physiology.advance(patient.x0.copy(), patient.params, 0.0, ten, nine, ten)
    with pytest.raises(ValueError, match="wrong length"):
        physiology.advance(patient.x0[:-1].copy(), patient.params, 0.0, ten, ten, ten)


# --- rest and balance ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", physiology.PHYSIOLOGIES)
@pytest.mark.parametrize("basal_glucose", [90.0, 110.0, 120.0, 150.0, 180.0, None])
def test_rests_at_basal(kind, basal_glucose):
    for name in physiology.cohort():
        patient = physiology.load_patient(name, basal_glucose=basal_glucose, physiology=kind)
        x = patient.x0.copy()
        n = 2 * STEPS_PER_DAY
        nothing = np.zeros(n)
        insulin = np.full(n, patient.basal_u_per_h / 120.0)
        physiology.advance(x, patient.params, 0.0, insulin, nothing, nothing)
        # X may rest at zero: it is measured against the insulin it comes from
        scale = np.where(patient.x0 == 0.0, 1.0, np.abs(patient.x0))
        scale[st.X] = patient.x0[st.I1]
        assert np.max(np.abs(x - patient.x0) / scale) < 1e-6
        assert physiology.glucose(x, patient.params) == pytest.approx(patient.basal_glucose, rel=1e-9)
        assert physiology.interstitial(x, patient.params) == pytest.approx(patient.basal_glucose, rel=1e-9)


def classical_step(x, p, t, h, rates, outflows):
    """One Runge-Kutta step written anew, with the outflows integrated by the same stages."""
    stages, slopes, out = [x], [], np.zeros(3)
    for stage, (node, weight) in enumerate(((0.0, 1), (0.5, 2), (0.5, 2), (1.0, 1))):
        slope = np.zeros(len(st.STATES))
        integrate.derivatives(stages[-1], p, integrate.circadian_factor(t + node * h, p), *rates, slope)
        out += h / 6 * weight * outflows(stages[-1])
        slopes.append(slope)
        if stage < 3:
            stages.append(x + (h / 2, h / 2, h)[stage] * slope)
    return x + h / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3]), out


def test_masses_balance():
    """What went in = what is there + what went out, for all three inputs.

    A Runge-Kutta step changes a sum of states by the weighted sum of its derivatives, so outflows integrated with
    the same stages close the balance to rounding.
    """
    patient = physiology.load_patient("adult#007")
    p = physiology.Variability(8, "adult#007").apply(patient.params)
    course = busy_days(patient, 1)
    h = physiology.STEP_MIN
    x = patient.x0.copy()
    start = patient.x0
    eaten = infused = injected = absorbed = cleared = eliminated = 0.0
    kg = patient.body_weight_kg

    def outflows(y):
        insulin = p[par.M4] * y[st.IP] + p[par.M30] * y[st.IL]
        return np.array([p[par.K_ABS] * y[st.Q_GUT], insulin, p[par.KE] * y[st.P1]])

    for k in range(STEPS_PER_DAY):
        if k in course.meals:
            physiology.begin_meal(x, p, course.meals[k])
        rates = course.insulin[k] / h * 6000 / kg, course.pramlintide[k] / h * 253.20, course.carbs[k] / h
        by_hand = x.copy()
        parts = integrate.parts_of_step(x, p, h, rates[2])
        for part in range(parts):
            by_hand, out = classical_step(by_hand, p, k * h + part * h / parts, h / parts, rates, outflows)
            absorbed, cleared, eliminated = absorbed + out[0], cleared + out[1], eliminated + out[2]
        inputs = (a[k : k + 1] for a in (course.insulin, course.pramlintide, course.carbs))
        physiology.advance(x, p, k * h, *inputs)
        np.testing.assert_allclose(x, by_hand, rtol=1e-12, atol=1e-12)
        eaten += course.carbs[k]
        infused += course.insulin[k] * 6000 / kg
        injected += course.pramlintide[k] * 253.20

    gut = [st.Q_STO1, st.Q_STO2, st.Q_GUT]
    insulin = [st.ISC1, st.ISC2, st.IP, st.IL]
    drug = [st.Q1, st.Q2, st.P1]
    assert eaten == pytest.approx(x[gut].sum() - start[gut].sum() + absorbed, rel=1e-9)
    assert infused == pytest.approx(x[insulin].sum() - start[insulin].sum() + cleared, rel=1e-9)
    assert p[par.A_S] * injected == pytest.approx(x[drug].sum() + eliminated, rel=1e-9)


# --- anything that may come ------------------------------------------------------------------------------------

segments = some.lists(
    some.tuples(
        some.integers(1, 400),  # steps
        some.sampled_from([0.0, 0.01, 0.05, 1.0, 25.0]) | some.floats(0.0, 100.0),  # U per step
        some.sampled_from([0.0, 0.1, 60.0]) | some.floats(0.0, 1e4),  # µg per step
        some.sampled_from([0.0, 1.0, 5e3]) | some.floats(0.0, 1e6),  # mg per step
        some.none() | some.floats(0.0, 1e6),  # a meal begins, mg
    ),
    min_size=1,
    max_size=5,
)


@settings(max_examples=3000 if FULL else 60, deadline=None)
@given(
    name=some.sampled_from(physiology.cohort()),
    kind=some.sampled_from(physiology.PHYSIOLOGIES),
    drug=some.sampled_from(physiology.pramlintide_sets()),
    basal=some.floats(70.0, 200.0),
    seed=some.integers(0, 2**32),
    course=segments,
)
def test_survives_anything(name, kind, drug, basal, seed, course):
    """No NaN, no negative mass, and no more glucose than was eaten, made and there before."""
    patient = physiology.load_patient(name, basal_glucose=basal, pramlintide=drug, physiology=kind)
    variability = physiology.Variability(seed, name)
    p = variability.apply(patient.params, variability.meal(0))
    x = patient.x0.copy()
    t = eaten = 0.0
    for steps, insulin, pramlintide, carbs, meal in course:
        if meal is not None:
            physiology.begin_meal(x, p, meal)
        inputs = (np.full(steps, amount) for amount in (insulin, pramlintide, carbs))
        physiology.advance(x, p, t, *inputs)
        t += steps * physiology.STEP_MIN
        eaten += steps * carbs

        assert np.isfinite(x).all()
        masses = np.delete(x, st.X)
        assert masses.min() >= -1e-9 * masses.max()
        # Tissue without insulin returns up to Vmx·Ib - Vm0, a property of the published equation.
        made = p[par.KP1] + 1.3 * p[par.VMX] * p[par.IB] * (1 + p[par.R3] * 4.0) + p[par.KCOUNTER] * x[st.XH]
        glucagon = 10.0 * (kind == "S2013")
        there = patient.x0[st.GP] + patient.x0[st.GT]
        most = there + eaten / patient.body_weight_kg + (made + glucagon) * t
        assert x[st.GP] + x[st.GT] <= most
        assert 0.0 < physiology.eta(x, p) <= 1.0
