"""Scenarios: meals that are given and meals that are drawn, what is told of them, and sugar against a low."""

import csv
import io
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pumpbench.calibration import MODES
from scipy import stats

from can_bus import codec
from can_bus.lockstep import STEPS_PER_DAY
from plant_server import scenario as scenario_module
from plant_server.physiology import load_patient
from plant_server.scenario import (
    RESCUE,
    VALIDATION,
    Announcement,
    Announcing,
    Kind,
    Meal,
    Policy,
    Rescue,
    Rescuer,
    Scenario,
    ScenarioError,
    announcements,
    built_in,
    load_scenario,
    policy_of,
    rescue_announcement,
)
from plant_server.scenarios.announcing import Late
from plant_server.scenarios.camerlingo import DATA, SNACKS_PER_DAY, distributions
from plant_server.scenarios.misestimation import Exact, Gaussian, Kawamura
from plant_server.server import PlantServer, Run

PATIENT = "adult#001"
MINUTES = 5


def per_day(scenario: Scenario) -> np.ndarray:
    """Carbohydrate of every day, g."""
    sums = np.zeros(scenario.days)
    for meal in scenario.meals:
        sums[meal.step // STEPS_PER_DAY] += meal.carbs_g
    return sums


# ---- the paper's validation scenario


def test_the_validation_scenario_has_the_papers_meals() -> None:
    scenario = load_scenario("validation-14d")
    assert scenario.days == 14
    assert Counter(meal.kind for meal in scenario.meals) == {"Breakfast": 14, "Lunch": 14, "Dinner": 14, "Snack": 18}
    # Pons Torres et al. 2025: 168.58 (57.14) g a day (called a median there; it is the mean)
    assert np.mean(per_day(scenario)) == pytest.approx(168.58, abs=0.005)
    assert np.std(per_day(scenario), ddof=1) == pytest.approx(57.14, abs=0.005)
    assert scenario.meals[0] == Meal(121, "Breakfast", 64.88)
    assert scenario.meals[-1] == Meal((13 * 1440 + 21 * 60 + 20) // 5, "Dinner", 69.27)
    assert scenario.meals == load_scenario("validation-14d", seed=9, patient="adult#007").meals
    assert scenario.announcing.estimate == Kawamura(), "the paper simulates misestimation"
    assert scenario.rescue is None, "and no rescue carbohydrate"


# ---- the paper's tuning scenario


def test_tuning_meals_have_the_papers_moments() -> None:
    meals = [meal for seed in range(60) for meal in load_scenario("tuning", seed=seed, patient=PATIENT).meals]
    assert len(meals) == 60 * 42
    for kind, clock, carbs in (("Breakfast", 480, 35), ("Lunch", 780, 50), ("Dinner", 1200, 85)):
        times = np.array([meal.step * MINUTES % 1440 for meal in meals if meal.kind == kind])
        amounts = np.array([meal.carbs_g for meal in meals if meal.kind == kind])
        assert np.mean(times) == pytest.approx(clock, abs=3)
        assert np.std(times) == pytest.approx(np.hypot(20, MINUTES / np.sqrt(12)), rel=0.07)
        assert np.mean(amounts) == pytest.approx(carbs, rel=0.04)
        assert np.std(amounts) / np.mean(amounts) == pytest.approx(0.30, abs=0.025)
        assert amounts.min() >= 0.1 * carbs


# ---- everyday meals


def drawn(quantity: str, seeds: int = 12, days: int = 200) -> np.ndarray:
    values = []
    for seed in range(seeds):
        meals = load_scenario("camerlingo", seed=seed, patient=PATIENT, days=days).meals
        hours: dict[str, dict[int, float]] = {"Breakfast": {}, "Lunch": {}, "Dinner": {}}
        day = -1
        for meal in meals:  # in order of time: a main meal belongs to the day of the breakfast before it
            if meal.kind == "Breakfast":
                day += 1
            if meal.kind in hours:
                hours[meal.kind][day] = meal.step * MINUTES / 60
        if quantity in ("B", "L", "D", "S"):
            kind = {"B": "Breakfast", "L": "Lunch", "D": "Dinner", "S": "Snack"}[quantity]
            values += [meal.carbs_g for meal in meals if meal.kind == kind]
        elif quantity == "T_B":
            values += [hour % 24 for hour in hours["Breakfast"].values()]
        else:
            first, then = {"T_BL": ("Breakfast", "Lunch"), "T_LD": ("Lunch", "Dinner")}[quantity]
            values += [hours[then][day] - hours[first][day] for day in hours[then]]
    return np.array(values)


SCIPY = {"gamma": stats.gamma, "lognorm": stats.lognorm, "fisk": stats.fisk, "genextreme": stats.genextreme}


@pytest.mark.parametrize("quantity", ["B", "L", "D", "S", "T_B", "T_BL", "T_LD"])
def test_everyday_meals_follow_the_families(quantity: str) -> None:
    family, shape, loc, scale = distributions()[quantity]
    reference = SCIPY[family](shape, loc, scale)
    for share in (1e-6, 0.01, 0.3, 0.5, 0.9, 0.999):
        assert distributions()[quantity].quantile(share) == pytest.approx(reference.ppf(share), rel=1e-9)
    values = drawn(quantity)
    assert len(values) > 2000
    # times are rounded to 5 min: compare the distributions where that does not matter
    for share in (0.1, 0.25, 0.5, 0.75, 0.9, 0.97):
        expected = reference.ppf(share)
        below = np.mean(values <= expected + (MINUTES / 120 if quantity.startswith("T") else 0))
        assert below == pytest.approx(share, abs=0.03), share


def test_the_families_fit_the_papers_table() -> None:
    meals = load_scenario("validation-14d").meals
    with DATA.open(encoding="utf-8") as file:
        rows = {row["quantity"]: row for row in csv.DictReader(line for line in file if not line.startswith("#"))}
    for quantity, kind in {"B": "Breakfast", "L": "Lunch", "D": "Dinner", "S": "Snack"}.items():
        amounts = np.array([meal.carbs_g for meal in meals if meal.kind == kind])
        assert len(amounts) == int(rows[quantity]["n"])
        assert np.mean(amounts) == pytest.approx(float(rows[quantity]["mean"]), abs=0.001)
        assert np.std(amounts, ddof=1) == pytest.approx(float(rows[quantity]["sd"]), abs=0.001)
        family, shape, loc, scale = distributions()[quantity]
        fitted = SCIPY[family].fit(amounts, floc=0)
        assert (shape, loc, scale) == pytest.approx(fitted, rel=0.01)
        assert stats.kstest(amounts, SCIPY[family](shape, loc, scale).cdf).pvalue > 0.05


def test_snacks_come_as_often_as_in_the_papers_table() -> None:
    counts = Counter(
        meal.step // STEPS_PER_DAY for meal in load_scenario("validation-14d").meals if meal.kind == "Snack"
    )
    table = Counter(counts[day] for day in range(14))
    assert pytest.approx([table[k] / 14 for k in range(5)]) == SNACKS_PER_DAY
    snacks = drawn("S")
    assert len(snacks) / (12 * 200) == pytest.approx(18 / 14, rel=0.06)


def test_everyday_meals_add_up_to_the_papers_day() -> None:
    days = np.concatenate(
        [per_day(load_scenario("camerlingo", seed=seed, patient=PATIENT, days=200)) for seed in range(6)]
    )
    # one draw of 14 days had 168.58 g with a deviation of 57.14 between days: within two standard errors of that
    assert np.mean(days) == pytest.approx(168.58, abs=2 * 57.14 / np.sqrt(14))
    assert np.std(days) == pytest.approx(57.14, rel=0.2)


def test_everyday_meals_are_in_order_and_possible() -> None:
    meals = load_scenario("camerlingo", seed=3, patient=PATIENT, days=300).meals
    assert [meal.step for meal in meals] == sorted(meal.step for meal in meals)
    assert all(0 <= meal.step < 300 * STEPS_PER_DAY and 2 <= meal.carbs_g <= 200 for meal in meals)


# ---- random numbers


@pytest.mark.parametrize("name", ["tuning", "camerlingo"])
def test_a_drawn_scenario_is_the_seeds_and_the_patients(name: str) -> None:
    once = load_scenario(name, seed=1, patient=PATIENT)
    assert once == load_scenario(name, seed=1, patient=PATIENT)
    assert once.meals != load_scenario(name, seed=2, patient=PATIENT).meals
    assert once.meals != load_scenario(name, seed=1, patient="adult#002").meals
    assert once.days == 14


def test_more_days_begin_as_fewer_do() -> None:
    short, long = (load_scenario("camerlingo", seed=1, patient=PATIENT, days=days) for days in (3.5, 20))
    assert (short.days, long.days) == (4, 20)
    assert short.meals == tuple(meal for meal in long.meals if meal.step < 4 * STEPS_PER_DAY)


def test_the_stream_of_one_quantity_is_no_others() -> None:
    seeds = range(400)
    first = [load_scenario("tuning", seed=seed, patient=PATIENT).meals[:3] for seed in seeds]
    columns = [[getattr(meals[k], what) for meals in first] for k in range(3) for what in ("step", "carbs_g")]
    matrix = np.corrcoef(columns)
    assert np.abs(matrix - np.eye(6)).max() < 0.2


# ---- announcements


DAY = Scenario(
    "day",
    1,
    (Meal(96, "Breakfast", 40.0), Meal(120, "Snack", 15.0), Meal(156, "Lunch", 60.0), Meal(240, "Dinner", 80.0)),
)


def told(scenario: Scenario, mode: str, seed: int = 1) -> tuple[Announcement, ...]:
    return announcements(scenario, policy_of(MODES[mode]), seed, PATIENT)


@pytest.mark.parametrize("mode", ["ma", "s3"])
def test_with_meal_announcements_everything_is_told(mode: str) -> None:
    assert told(DAY, mode) == (
        Announcement(96, Kind.CARBS_ESTIMATED, 40.0, 96),
        Announcement(120, Kind.SNACK, 15.0, 120),
        Announcement(156, Kind.CARBS_ESTIMATED, 60.0, 156),
        Announcement(240, Kind.CARBS_ESTIMATED, 80.0, 240),
    )


@pytest.mark.parametrize("mode", ["sma", "s4"])
def test_simplified_announcements_tell_the_time_of_main_meals(mode: str) -> None:
    assert told(DAY, mode) == tuple(Announcement(step, Kind.SIMPLE_MEAL, None, step) for step in (96, 156, 240))


@pytest.mark.parametrize("mode", ["nma", "s1", "s2"])
def test_without_announcements_nothing_is_told(mode: str) -> None:
    assert told(DAY, mode) == ()


def test_modes_and_kinds_are_those_of_the_dbc() -> None:
    told = {name: policy_of(code) for name, code in MODES.items()}
    assert {name for name, policy in told.items() if policy is Policy.EVERYTHING} == {"ma", "s3"}
    assert {name for name, policy in told.items() if policy is Policy.MAIN_MEALS} == {"sma", "s4"}
    assert {policy_of(mode) for mode in (0, 1, 15)} == {Policy.NOTHING}  # Off, OpenLoop, none
    for kind in Kind:
        label = kind.name.title().replace("_", "")
        assert codec.choice("MEAL_Announce", "MealKind", label) == kind


MANY = Scenario("many", 3650, tuple(Meal(200 * k, "Lunch", 50.0) for k in range(1, 5001)))


def habits(**settings: object) -> Scenario:
    return MANY._replace(announcing=Announcing.model_validate(settings))


def test_forgotten_and_late_announcements_have_their_probabilities() -> None:
    scenario = habits(missed=0.1, late={"probability": 0.25, "minutes": (10, 40)})
    list_ = told(scenario, "ma")
    assert len(list_) / 5000 == pytest.approx(0.9, abs=0.015)
    delays = MINUTES * np.array([announcement.step - announcement.meal_step for announcement in list_])
    assert np.mean(delays > 0) == pytest.approx(0.25, abs=0.02)
    assert set(delays[delays > 0]) == set(range(10, 45, 5))
    assert np.mean(delays[delays > 0]) == pytest.approx(25, abs=1)
    assert [announcement.step for announcement in list_] == sorted(announcement.step for announcement in list_)


def test_meals_can_be_told_ahead() -> None:
    assert {MINUTES * (a.meal_step - a.step) for a in told(habits(ahead_minutes=15), "s3")} == {15}
    early = Scenario("early", 1, (Meal(1, "Breakfast", 30.0),), Announcing(ahead_minutes=30))
    assert told(early, "ma") == (Announcement(0, Kind.CARBS_ESTIMATED, 30.0, 1),), "not before the run"


def test_switching_one_habit_off_shifts_no_other() -> None:
    late = {"probability": 0.3, "minutes": (10, 40)}
    everything = {a.meal_step: a for a in told(habits(missed=0.2, late=late, estimate="kawamura"), "ma")}
    never_missed = {a.meal_step: a for a in told(habits(late=late, estimate="kawamura"), "ma")}
    exact = {a.meal_step: a for a in told(habits(missed=0.2, late=late), "ma")}
    in_time = {a.meal_step: a for a in told(habits(missed=0.2, estimate="kawamura"), "ma")}
    simple = {a.meal_step: a for a in told(habits(missed=0.2, late=late, estimate="kawamura"), "sma")}
    assert everything.keys() == exact.keys() == in_time.keys() == simple.keys() < never_missed.keys()
    for step, announcement in everything.items():
        assert never_missed[step] == announcement
        assert exact[step] == announcement._replace(carbs_g=50.0)
        assert in_time[step] == announcement._replace(step=step)
        assert simple[step] == announcement._replace(kind=Kind.SIMPLE_MEAL, carbs_g=None)


def test_announcements_are_the_seeds_and_the_patients() -> None:
    scenario = habits(missed=0.2, late={"probability": 0.3}, estimate="kawamura")
    assert told(scenario, "ma") == told(scenario, "ma")
    assert told(scenario, "ma") != told(scenario, "ma", seed=2)
    assert told(scenario, "ma") != announcements(scenario, Policy.EVERYTHING, 1, "adult#002")


# ---- misestimation


def test_small_meals_are_overestimated_and_large_ones_underestimated() -> None:
    model = Kawamura()
    assert [model.grams(g, 0.0) for g in (5, 10, 60, 100, 200)] == pytest.approx([5.75, 11.5, 60, 85, 170])
    assert model.grams(60, 1.0) == pytest.approx(72)
    assert model.grams(60, -9.0) == pytest.approx(12), "never below a fifth"
    estimates = np.array([a.carbs_g for a in told(habits(estimate="kawamura"), "ma")])
    expected = 50 * float(np.interp(50, (10, 60), (1.15, 1.0)))
    assert np.mean(estimates) == pytest.approx(expected, rel=0.01)
    assert np.std(estimates) == pytest.approx(10, rel=0.05)


def test_other_models_of_the_estimate() -> None:
    assert Exact().grams(33, 5.0) == 33
    assert Gaussian(mean_percent=-28, sd_percent=30).grams(100, 1.0) == pytest.approx(102)
    assert Gaussian(sd_percent=30).grams(100, -5.0) == 0
    huge = Scenario(
        "huge", 1, (Meal(10, "Dinner", 450.0),), Announcing(estimate=Gaussian(mean_percent=50, sd_percent=0))
    )
    assert told(huge, "ma")[0].carbs_g == 500, "what MEAL_Announce can carry"


# ---- sugar against a low


def test_sugar_is_eaten_after_some_low_samples_and_then_there_is_a_wait() -> None:
    rescuer = Rescuer(Rescue(below=60, samples=3, carbs=15, lockout_minutes=30))
    glucose = [61, 59, 59, 61, 59, 59, 59, *[55] * 7, 80, 59, 59, 59, 59]
    eaten = [rescuer.carbs(k, glucose[k]) for k in range(len(glucose))]
    assert {k: carbs for k, carbs in enumerate(eaten) if carbs} == {6: 15, 12: 15, 18: 15}


def low(rescue: Rescue | None, steps: int = 60) -> PlantServer:
    """A fasting patient whose pump pours out insulin."""
    scenario = Scenario("low", 1, (Meal(50, "Snack", 10.0),), rescue=rescue)
    plant = PlantServer(Run(load_patient(PATIENT), scenario, steps, 1, 2, {}))
    body = plant._patient
    nothing = np.zeros(10)
    for step in range(steps):
        body.feel(step)
        body.advance(step, np.full(10, 0.15 if step < 12 else 0.0), nothing)
    return plant


def test_a_low_patient_eats_and_recovers() -> None:
    rule = Rescue(below=60, samples=2, carbs=20)
    without, with_sugar = low(None), low(rule)
    eaten = [meal for meals in with_sugar._patient._meals.values() for meal in meals if meal.kind == RESCUE]
    assert eaten
    assert all(meal.carbs_g == 20 for meal in eaten)
    assert np.all(np.diff([meal.step for meal in eaten]) >= 6)
    assert with_sugar._patient.glucose > without._patient.glucose + 10
    assert with_sugar._patient._meal_index == without._patient._meal_index == 1, "planned meals keep their numbers"
    assert with_sugar._patient.carbs_starting(eaten[0].step) == 20
    assert not any(meal.kind == RESCUE for meals in without._patient._meals.values() for meal in meals)


def test_sugar_is_told_where_everything_is_told() -> None:
    meal = Meal(77, RESCUE, 15.0)
    scenario = Scenario("s", 1, (), rescue=Rescue(announced=True))
    assert rescue_announcement(scenario, Policy.EVERYTHING, meal) == Announcement(77, Kind.HYPO_TREATMENT, 15.0, 77)
    assert rescue_announcement(scenario, Policy.MAIN_MEALS, meal) is None
    assert rescue_announcement(scenario._replace(rescue=Rescue()), Policy.EVERYTHING, meal) is None
    assert rescue_announcement(scenario._replace(rescue=None), Policy.EVERYTHING, meal) is None


# ---- files


def test_a_yaml_file_can_say_everything(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        """
meals:
  - {day: 2, time: "00:03", type: Snack, carbs: 12}
  - {day: 1, time: "08:00", type: Breakfast, carbs: 45.5}
days: 3
announcements:
  estimate: {model: gaussian, mean_percent: -10}
  missed: 0.05
  late: {probability: 0.1}
rescue: {below: 54, samples: 2, carbs: 10, lockout_minutes: 20, announced: true}
"""
    )
    assert load_scenario(str(file)) == Scenario(
        "mine",
        3,
        (Meal(96, "Breakfast", 45.5), Meal(289, "Snack", 12.0)),
        Announcing(estimate=Gaussian(mean_percent=-10), missed=0.05, late=Late(probability=0.1)),
        Rescue(below=54, samples=2, carbs=10, lockout_minutes=20, announced=True),
    )


def test_a_yaml_file_can_be_based_on_a_scenario(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("based_on: validation-14d\nrescue: {}\n")
    base = load_scenario("validation-14d")
    assert load_scenario(str(file)) == base._replace(name="mine", rescue=Rescue())
    file.write_text("based_on: tuning\ndays: 2\nannouncements: {estimate: exact}\n")
    mine = load_scenario(str(file), seed=4, patient=PATIENT)
    tuning = load_scenario("tuning", seed=4, patient=PATIENT)
    assert mine.meals == tuning.meals[:6]
    assert (mine.days, mine.announcing) == (2, Announcing())
    file.write_text("based_on: camerlingo\n")
    assert load_scenario(str(file), days=30).days == 30


def test_csv_files(tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text("# mine\nday,type,time,carbs\n1, Lunch ,12:32,50\n\n# tea\n1,Snack,9:00,5\n")
    assert load_scenario(str(file)) == Scenario("mine", 1, (Meal(108, "Snack", 5.0), Meal(150, "Lunch", 50.0)))
    assert load_scenario(str(VALIDATION)).meals == load_scenario("validation-14d").meals
    assert next(csv.DictReader(io.StringIO(VALIDATION.read_text().split("\n", 1)[1])))["cho_g"] == "64.88"


WRONG_YAML = {
    "meals: [{day: 0, time: '08:00', type: Lunch, carbs: 5}]": "1: meals.0.day: Input should be greater than",
    "meals:\n  - {day: 1, time: 13:00, type: Lunch, carbs: 5}": '2: meals.0.time: a time is "hh:mm" in quotes',
    "meals:\n  - {day: 1, time: '24:00', type: Lunch, carbs: 5}": "00:00 to 23:59 (found '24:00')",
    "meals:\n  - {day: 1, time: '23:00', type: Tea, carbs: 5}": "should be 'Breakfast', 'Lunch', 'Dinner' or 'Snack'",
    "meals:\n  - {day: 1, time: '23:00', type: Snack, carbs: -5}": "2: meals.0.carbs",
    "meals:\n  - {day: 1, time: '23:00', type: Snack, grams: 5}": "unknown key",
    "days: 3": "give the meals, or based_on",
    "based_on: breakfast": "based_on is one of fasting, six-hours, validation-14d, tuning, camerlingo, found 'b",
    "based_on: validation-14d\ndays: 15": "days: scenario validation-14d has 14 days, asked for 15",
    "meals: []\nrescue: {below: 5}": "2: rescue.below",
    "meals: []\nannouncements: {missed: 1.5}": "2: announcements.missed",
    "meals: []\nannouncements: {late: {probability: 0.1, minutes: [30, 90]}}": "a delay is [least, most] within 0 to",
    "meals: []\nannouncements: {estimate: guess}": "2: announcements.estimate",
    "meals: []\nannouncements: {estimates: exact}": "expected one of estimate, missed, late, ahead_minutes",
    "- 3": "expected a mapping with the keys meals, based_on, days, announcements, rescue",
}


@pytest.mark.parametrize("text", WRONG_YAML)
def test_a_wrong_yaml_file_is_one_clear_error(text: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    check_error(file, WRONG_YAML[text])


WRONG_CSV = {
    "": "expected the columns day,type,time,cho_g, found nothing",
    "day,type,time\n1,Lunch,12:00\n": "1: expected the columns day,type,time,cho_g, found day,type,time",
    "# x\nday,type,time,cho_g\n1,Lunch,12:00\n": "3: expected the columns day,type,time,cho_g, found 3 cells",
    "day,type,time,cho_g\n\n1,Lunch,12:60,5\n": '3: time: a time is "hh:mm" in quotes, 00:00 to 23:59 (found',
    "day,type,time,cho_g\n1,Lunch,12:00,many\n": "2: carbs: Input should be a valid number",
    "day,type,time,cho_g\nx,Lunch,12:00,3\n": "2: day: Input should be a valid integer",
}


@pytest.mark.parametrize("text", WRONG_CSV)
def test_a_wrong_csv_file_is_one_clear_error(text: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text(text)
    check_error(file, WRONG_CSV[text])


def check_error(file: Path, text: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario(str(file))
    assert str(error.value).startswith(f"{file}:")
    assert text in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "breakfast",
            "there is no scenario 'breakfast'; choose one of fasting, six-hours, validation-14d, tuning, camer",
        ),
        ("validation", "did you mean validation-14d"),
        ("no.csv", "cannot read the scenario no.csv"),
        ("no.yaml", "cannot read no.yaml"),
    ],
)
def test_a_wrong_name_is_one_clear_error(name: str, text: str) -> None:
    with pytest.raises(ScenarioError, match=text):
        load_scenario(name)


def test_a_generator_has_an_end_too() -> None:
    with pytest.raises(ScenarioError, match="at most 3650 days, asked for 4000"):
        load_scenario("camerlingo", days=4000)


def test_what_is_built_in_can_be_loaded() -> None:
    assert built_in() == ("fasting", "six-hours", "validation-14d", "tuning", "camerlingo")
    for name in built_in():
        scenario = load_scenario(name)
        assert scenario.name == name
        assert sum(map(len, scenario.meals_by_step().values())) == len(scenario.meals)
    assert load_scenario("fasting").days == scenario_module.DAYS_MAX
