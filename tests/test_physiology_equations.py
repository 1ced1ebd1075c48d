"""The equations: values that can be checked by hand, and figures that were published or identified."""

import math

import numpy as np
import pytest

from plant_server import physiology
from plant_server.physiology import counter_regulation, gastric, integrate, pramlintide
from plant_server.physiology import parameters as par
from plant_server.physiology import states as st

STEPS_PER_HOUR = 120


def give(patient, dose_ug: float, hours=24):
    """Plasma pramlintide (pmol/L) every 30 s after a subcutaneous bolus."""
    x = patient.x0.copy()
    nothing = np.zeros(1)
    concentration = []
    for k in range(hours * STEPS_PER_HOUR):
        physiology.advance(x, patient.params, 0.0, nothing, np.array([dose_ug * (k == 0)], dtype=float), nothing)
        concentration.append(physiology.plasma_pramlintide(x, patient.params))
    return np.array(concentration)


def half_emptying_time(patient, dose_ug, grams=75.0, eating_min=10.0):
    """Minutes until half of a meal has left the stomach, pramlintide given at its start."""
    p, x = patient.params, patient.x0.copy()
    nothing = np.zeros(1)
    eating = round(2 * eating_min)
    physiology.begin_meal(x, p, 1000.0 * grams)
    for k in range(24 * STEPS_PER_HOUR):
        dose = np.array([dose_ug if k == 0 else 0.0], dtype=float)
        carbs = np.array([1000.0 * grams / eating if k < eating else 0.0])
        physiology.advance(x, p, 0.0, nothing, dose, carbs)
        if k >= eating and physiology.q_sto(x, p) < 500.0 * grams:
            return (k + 1) / 2
    raise AssertionError("the stomach never emptied")


# --- pramlintide ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dose_ug", "auc", "c_max"),
    [(30, 3220, 37.2), (60, 6439, 74.5), (90, 9659, 111.7), (120, 12878, 149.0)],
)
def test_pramlintide_kinetics_meet_the_fit(dose_ug, auc, c_max):
    """AUC, Cmax and Tmax of the fit to the label's table of subcutaneous doses."""
    concentration = give(physiology.load_patient("adult#001"), dose_ug)
    assert concentration.sum() * physiology.STEP_MIN == pytest.approx(auc, rel=0.002)
    assert concentration.max() == pytest.approx(c_max, rel=0.005)
    assert (concentration.argmax() + 1) / 2 == pytest.approx(20.5, abs=0.75)
    # half-life by regression between 90 and 300 min
    minutes = np.arange(90.0, 300.5, 0.5)
    slope = np.polyfit(minutes, np.log(concentration[179:600]), 1)[0]
    assert -math.log(2) / slope == pytest.approx(50.7, abs=0.5)


@pytest.mark.parametrize(
    ("dose_ug", "auc", "c_max", "t_max"),
    [(30, 3736, 39, 21), (60, 6778, 79, 20), (90, 8507, 102, 19), (120, 11970, 147, 21)],
)
def test_pramlintide_kinetics_are_near_the_label(dose_ug, auc, c_max, t_max):
    """Symlin prescribing information, healthy subjects; the label itself is not proportional to the dose."""
    concentration = give(physiology.load_patient("adult#001"), dose_ug)
    assert concentration.sum() * physiology.STEP_MIN == pytest.approx(auc, rel=0.15)
    assert concentration.max() == pytest.approx(c_max, rel=0.11)
    assert (concentration.argmax() + 1) / 2 == pytest.approx(t_max, abs=2.0)


def test_type1_lowers_concentration_not_effect():
    """Kolterman 1996: 21 to 29 pmol/L after 30 µg in type 1 diabetes; the slowing is what was fitted to patients."""
    healthy = physiology.load_patient("adult#001", pramlintide="moderate")
    type1 = physiology.load_patient("adult#001", pramlintide="moderate+type1")
    assert 21.0 <= give(type1, 30.0, hours=3).max() <= 29.0
    assert half_emptying_time(type1, 30.0) == half_emptying_time(healthy, 30.0)


def test_hill_by_hand():
    assert pramlintide.hill(0.0, 3.7, 760.0, 2.0) == 0.0
    for e in (1.7, 2.0, 2.54, 3.0):
        assert pramlintide.hill(760.0, 3.7, 760.0, e) == pytest.approx(1.85, rel=1e-14)
        assert pramlintide.hill(100.0, 3.7, 760.0, e) == pytest.approx(3.7 * 100**e / (760**e + 100**e), rel=1e-14)


def test_basal_pramlintide_by_hand():
    """12 µg/h: P1 = a_s·rate/ke = 0.35·12·253.2/60/0.0231 = 767 pmol, η = 0.35 with the moderate set."""
    patient = physiology.load_patient("adult#001", pramlintide="moderate")
    x, n = patient.x0.copy(), 48 * STEPS_PER_HOUR
    nothing = np.zeros(n)
    physiology.advance(x, patient.params, 0.0, nothing, np.full(n, 12.0 / STEPS_PER_HOUR), nothing)
    assert x[st.P1] == pytest.approx(767.0, rel=0.001)
    assert x[st.P_EFF] == pytest.approx(x[st.P1], rel=1e-4)
    assert physiology.plasma_pramlintide(x, patient.params) == pytest.approx(21.5, abs=0.1)
    assert physiology.eta(x, patient.params) == pytest.approx(0.35, abs=0.002)


def test_no_pramlintide_no_effect():
    patient = physiology.load_patient("adult#001")
    assert physiology.eta(patient.x0, patient.params) == 1.0


@pytest.mark.parametrize(
    ("name", "minutes", "at_30_ug", "at_60_ug"),
    [
        ("adult#001", 78.5, 1.656, 1.975),
        ("adult#002", 53.5, 1.645, 1.944),
        ("adult#003", 123.0, 1.528, 1.785),
        ("adult#004", 45.0, 1.656, 1.967),
        ("adult#005", 77.5, 1.658, 1.974),
        ("adult#006", 87.0, 1.563, 1.839),
        ("adult#007", 88.0, 1.580, 1.864),
        ("adult#008", 150.5, 1.369, 1.568),
        ("adult#009", 164.5, 1.328, 1.511),
        ("adult#010", 91.0, 1.604, 1.907),
    ],
)
def test_slowing_of_each_adult(name, minutes, at_30_ug, at_60_ug):
    """Half-emptying of 75 g and how much 30 and 60 µg prolong it, from an independent prototype."""
    patient = physiology.load_patient(name, pramlintide="conservative")
    without = half_emptying_time(patient, 0.0)
    assert without == pytest.approx(minutes, abs=1.0)
    assert half_emptying_time(patient, 30.0) / without == pytest.approx(at_30_ug, rel=0.02)
    assert half_emptying_time(patient, 60.0) / without == pytest.approx(at_60_ug, rel=0.02)


# --- meal ----------------------------------------------------------------------------------------------------------

K_MAX, K_MIN, B, C = 0.0558, 0.008, 0.69, 0.17


def k_empt(q_sto, meal):
    return gastric.k_empt(q_sto, meal, K_MAX, K_MIN, B, C)


def test_emptying_rate_at_its_limits():
    meal = 75e3
    assert k_empt(12.0, 0.0) == K_MAX  # no meal, ever
    assert k_empt(1e9, meal) == pytest.approx(K_MAX, rel=1e-12)  # overfull
    # a full and an empty stomach: tanh(2.5) = 0.98661 stands for one
    full = K_MIN + (K_MAX - K_MIN) / 2 * (math.tanh(2.5) - math.tanh(2.5 * (1 - C) / C) + 2)
    empty = K_MIN + (K_MAX - K_MIN) / 2 * (math.tanh(-2.5 * B / (1 - B)) - math.tanh(-2.5) + 2)
    assert k_empt(meal, meal) == pytest.approx(full, rel=1e-12)
    assert k_empt(0.0, meal) == pytest.approx(empty, rel=1e-12)
    assert full > 0.98 * K_MAX
    assert empty > 0.98 * K_MAX
    # halfway down at b·D and halfway up at c·D
    middle = (K_MAX + K_MIN) / 2
    assert k_empt(B * meal, meal) == pytest.approx(middle, rel=0.01)
    assert k_empt(C * meal, meal) == pytest.approx(middle, rel=0.01)
    between = [k_empt(share * meal, meal) for share in np.linspace(0, 1, 101)]
    assert K_MIN < min(between) < 1.1 * K_MIN
    assert max(between) < K_MAX


def test_emptying_rate_is_the_printed_tanh():
    for meal in (10.0, 5e3, 75e3, 4e5):
        alpha, beta = 5 / (2 * meal * (1 - B)), 5 / (2 * meal * C)
        for q in np.linspace(0.0, 3.0 * meal, 200):
            printed = K_MIN + (K_MAX - K_MIN) / 2 * (
                math.tanh(alpha * (q - B * meal)) - math.tanh(beta * (q - C * meal)) + 2
            )
            assert k_empt(q, meal) == pytest.approx(printed, rel=1e-12)


def test_pramlintide_slows_emptying_but_not_grinding():
    patient = physiology.load_patient("adult#001")
    p = patient.params
    x = patient.x0.copy()
    x[st.Q_STO1], x[st.Q_STO2], x[st.D] = 20e3, 30e3, 60e3
    without, slowed = np.zeros(len(x)), np.zeros(len(x))
    integrate.derivatives(x, p, 1.0, 0.0, 0.0, 0.0, without)
    x[st.P_EFF] = 900.0
    integrate.derivatives(x, p, 1.0, 0.0, 0.0, 0.0, slowed)
    eta = physiology.eta(x, p)
    assert 0.0 < eta < 0.2
    assert slowed[st.Q_STO1] == without[st.Q_STO1]
    grinding = p[par.K_MAX] * x[st.Q_STO1]
    assert grinding - slowed[st.Q_STO2] == pytest.approx(eta * (grinding - without[st.Q_STO2]), rel=1e-12)
    assert slowed[st.Q_GUT] == pytest.approx(eta * without[st.Q_GUT], rel=1e-12)


def test_a_second_meal_counts_what_is_left_of_the_first():
    patient = physiology.load_patient("adult#001")
    x = patient.x0.copy()
    x[st.Q_STO1], x[st.Q_STO2] = 7e3, 5e3
    physiology.begin_meal(x, patient.params, 40e3)
    assert x[st.D] == 52e3


def test_everything_eaten_appears():
    """Dose of glucose in plasma = f · carbohydrate / body weight, over a day."""
    patient = physiology.load_patient("adult#004")
    p, x = patient.params, patient.x0.copy()
    appeared, nothing = 0.0, np.zeros(1)
    physiology.begin_meal(x, p, 50e3)
    for k in range(24 * STEPS_PER_HOUR):
        appeared += 0.5 * physiology.rate_of_appearance(x, p) * physiology.STEP_MIN
        physiology.advance(x, p, 0.0, nothing, nothing, np.array([2500.0 if k < 20 else 0.0]))
        appeared += 0.5 * physiology.rate_of_appearance(x, p) * physiology.STEP_MIN
    assert appeared == pytest.approx(0.9 * 50e3 / patient.body_weight_kg, rel=1e-3)


# --- steady state --------------------------------------------------------------------------------------------------

#: simglucose's own steady infusion u2ss (pmol/kg/min) and body weight
U2SS = [
    (1.2386244136, 102.32),
    (1.23270240324, 111.1),
    (1.74604298612, 81.631),
    (1.40925544793, 63.0),
    (1.25415109169, 94.074),
    (2.60909529933, 66.097),
    (1.50334589878, 91.229),
    (1.11044245549, 102.79),
    (1.51977345451, 74.604),
    (1.37923535927, 73.859),
]
REBASED = [1.425, 1.543, 1.645, 0.987, 1.542, 1.789, 1.417, 1.305, 1.397, 1.425]


@pytest.mark.parametrize(("name", "u2ss", "rebased"), [*zip(physiology.cohort(), U2SS, REBASED, strict=True)])
def test_basal_insulin(name, u2ss, rebased):
    for kind in physiology.PHYSIOLOGIES:
        native = physiology.load_patient(name, basal_glucose=None, physiology=kind)
        infusion, kg = u2ss
        assert native.basal_u_per_h == pytest.approx(infusion * kg / 6000.0 * 60.0, rel=1e-9)
        assert physiology.load_patient(name, physiology=kind).basal_u_per_h == pytest.approx(rebased, abs=0.0006)


def test_operating_point_is_at_rest():
    for kind in physiology.PHYSIOLOGIES:
        for level in (60.0, 90.0, 120.0, 180.0, 200.0):
            for name in physiology.cohort():
                patient = physiology.load_patient(name, basal_glucose=level, physiology=kind)
                dx = np.zeros(len(st.STATES))
                infusion = patient.basal_u_per_h / 60.0 * 6000.0 / patient.body_weight_kg
                integrate.derivatives(patient.x0, patient.params, 1.0, infusion, 0.0, 0.0, dx)
                assert np.max(np.abs(dx)) < 1e-12 * np.max(patient.x0)


# --- counter-regulation --------------------------------------------------------------------------------------------


def test_risk_by_hand():
    """10·[ln(G)^0.81 - ln(120)^0.81]²: ln 60 = 4.0943, ln 120 = 4.7875."""
    p = physiology.load_patient("adult#001", physiology="S2013").params
    assert p[par.R2] == pytest.approx(4.7875**0.81, rel=1e-4)
    greatest = 10 * (4.0943**0.81 - 4.7875**0.81) ** 2
    assert counter_regulation.risk(120.0, p) == counter_regulation.risk(300.0, p) == 0.0
    assert counter_regulation.risk(60.0, p) == pytest.approx(greatest, rel=1e-3)
    assert counter_regulation.risk(30.0, p) == counter_regulation.risk(60.0, p)
    assert 0.0 < counter_regulation.risk(90.0, p) < counter_regulation.risk(70.0, p) < greatest


def test_glucagon_answers_a_low():
    """Same overdose in both physiologies: S2013 falls faster into the low, and secretes glucagon there."""
    trace = {}
    for kind in physiology.PHYSIOLOGIES:
        patient = physiology.load_patient("adult#001", physiology=kind)
        x = patient.x0.copy()
        n = 6 * STEPS_PER_HOUR
        insulin, nothing = np.full(n, patient.basal_u_per_h / STEPS_PER_HOUR), np.zeros(n)
        insulin[0] += 4.0
        levels, glucagon = [], []
        for k in range(n):
            piece = slice(k, k + 1)
            physiology.advance(x, patient.params, 0.5 * k, insulin[piece], nothing[piece], nothing[piece])
            levels.append(physiology.glucose(x, patient.params))
            glucagon.append(x[st.H])
        trace[kind] = np.array(levels), np.array(glucagon)
    assert trace["S2008"][1].max() == 0.0
    assert trace["S2013"][1][0] == pytest.approx(60.0, rel=0.01)
    assert trace["S2013"][1].max() > 61.0
    # the risk's gain on insulin action outweighs these small amounts of glucagon
    assert trace["S2013"][0].min() < trace["S2008"][0].min() - 1.0


def test_small_meals_empty_faster_in_s2013_only():
    """A meal of 10 g empties 30/10 times faster (T1DMS), but not without the switch."""
    assert gastric.small_meal_factor(10e3, 30e3) == 3.0
    assert gastric.small_meal_factor(30e3, 30e3) == gastric.small_meal_factor(45e3, 30e3) == 1.0
    assert gastric.small_meal_factor(10e3, 0.0) == gastric.small_meal_factor(0.0, 30e3) == 1.0
    assert gastric.small_meal_factor(1e-3, 30e3) == 30.0
    old, new = (physiology.load_patient("adult#009", physiology=kind) for kind in physiology.PHYSIOLOGIES)
    assert half_emptying_time(new, 0.0, grams=10.0) < 0.6 * half_emptying_time(old, 0.0, grams=10.0)
    assert half_emptying_time(new, 0.0, grams=60.0) == half_emptying_time(old, 0.0, grams=60.0)


# --- records -------------------------------------------------------------------------------------------------------


def test_every_state_and_parameter_is_named():
    for records in (physiology.STATES, physiology.PARAMETERS):
        names = [record.name for record in records]
        assert len(set(names)) == len(names)
        assert all(record.unit and record.description and record.source for record in records)
    assert [par.PARAMETERS[i].name for i in (par.BW, par.C, par.D50, par.R2, par.CIRCADIAN_PHASE)] == [
        "BW",
        "c",
        "d",
        "r2",
        "circadian_phase",
    ]
    assert [st.STATES[i].name for i in (st.Q_STO1, st.GP, st.XL, st.P_EFF, st.D)] == ["Qsto1", "Gp", "XL", "Peff", "D"]
    assert st.STATES[-1].name == "D"  # the one state without an equation stands last


def test_index_constants_match_the_names():
    """Q_STO1 is `Qsto1` and so on: the constants follow the records without being written twice."""

    def plain(text):
        return text.replace("_", "").lower()

    for module, records in ((st, physiology.STATES), (par, physiology.PARAMETERS)):
        by_index = {
            value: name
            for name, value in vars(module).items()
            if name.isupper() and isinstance(value, int) and name != "INTEGRATED"
        }
        assert sorted(by_index) == list(range(len(records)))
        for index, record in enumerate(records):
            expected = "d50" if (module is par and record.name == "d") else plain(record.name)
            assert plain(by_index[index]) == expected
