"""Announced meals: every MealId acts once, and what is no meal to dose for gives no bolus (USR-01 to USR-03)."""

import itertools
import random

import pytest
from bench import MODE_OFF, Bench

from can_bus.lockstep import Done, Phase
from firmware_sim.alarms import Code
from firmware_sim.meals import IDS, Meals

MA = 3
CARBS, SIMPLE, SNACK, HYPO, CANCEL = 1, 2, 3, 4, 5
NOTHING = (0, 0)


def announced(number: int, kind: int = CARBS, carbs: int = 80, offset: int = 0) -> dict[str, int]:
    return {"MealId": number, "MealKind": kind, "CarbsEst": carbs, "MealOffset": offset}


def hear(meal: dict[str, int]) -> Meals:
    meals = Meals()
    meals.hear(meal)
    return meals


# ---- one per step


@pytest.mark.parametrize(
    "first",
    [announced(7), announced(7, HYPO), announced(7, CANCEL), announced(7, kind=9), announced(7, carbs=301)],
)
def test_a_second_announcement_of_a_step_waits_until_the_user_repeats_it(first: dict[str, int]) -> None:
    meals = hear(first)
    meals.hear(announced(8))
    assert (meals.take(), meals.last) == ((CARBS, 80) if first == announced(7) else NOTHING, 7)
    meals.hear(announced(8))
    assert (meals.take(), meals.last) == ((CARBS, 80), 8)


# ---- numbers


@pytest.mark.parametrize("last", [0, 1, 127, 128, 254])
def test_half_the_circle_ahead_is_newer_and_the_other_half_is_older(last: int) -> None:
    for number in range(256):
        meals = hear(announced(last))
        meals.take()
        meals.hear(announced(number))
        ahead = (number - last) % IDS
        newer, older = number < IDS and 1 <= ahead <= 127, number < IDS and ahead >= 128
        assert (meals.take() == (CARBS, 80)) == newer
        assert meals.repeated == older
        assert meals.last == (number if newer else last)
        assert not meals.refused


def test_the_first_number_of_a_run_may_be_any() -> None:
    for number in range(255):
        assert hear(announced(number)).take() == (CARBS, 80)
    meals = hear(announced(255))  # SNA
    assert (meals.take(), meals.last, meals.repeated, meals.refused) == (NOTHING, None, 0, False)


def test_a_meal_is_taken_once_even_if_it_is_said_before_and_after() -> None:
    meals = hear(announced(7))
    meals.hear(announced(7))
    assert meals.take() == (CARBS, 80)
    assert meals.take() == NOTHING
    meals.hear(announced(7, carbs=300))  # the same number is the same meal, whatever else it says
    assert meals.take() == NOTHING
    assert meals.repeated == 0


def test_of_two_in_one_step_one_is_taken_and_the_other_waits_to_be_repeated() -> None:
    meals = hear(announced(7, carbs=40))
    meals.hear(announced(8, carbs=30))
    assert meals.last == 7  # so the second one is not echoed
    assert meals.take() == (CARBS, 40)
    meals.hear(announced(8, carbs=30))
    assert meals.take() == (CARBS, 30)
    assert (meals.last, meals.repeated) == (8, 0)


@pytest.mark.parametrize("kind", [HYPO, CANCEL, 0])
def test_what_gives_no_bolus_takes_its_step_too(kind: int) -> None:
    meals = hear(announced(7, kind))
    meals.hear(announced(8))
    assert meals.take() == NOTHING
    assert meals.last == 7
    meals.hear(announced(8))
    assert meals.take() == (CARBS, 80)


@pytest.mark.parametrize(("number", "left"), [(7, NOTHING), (8, NOTHING), (255, (CARBS, 80)), (6, (CARBS, 80))])
def test_a_meal_of_this_step_can_be_cancelled(number: int, left: tuple[int, int]) -> None:
    """By its own number or a newer one."""
    meals = hear(announced(7))
    meals.hear(announced(number, CANCEL))
    assert meals.take() == left
    assert meals.last == max(number % 255, 7)
    meals.hear(announced(7, CANCEL))  # of what was taken nothing is left to cancel
    assert meals.take() == NOTHING


def test_no_mix_of_repeated_and_late_announcements_doses_a_meal_twice() -> None:
    source = random.Random(5)
    meals, taken, said = Meals(), [], 0
    for _ in range(3000):
        if source.random() < 0.3:
            said += 1
        for back in source.choices(range(20), k=source.randrange(3)):
            if said - back >= 0:
                meals.hear(announced((said - back) % IDS, carbs=1))
        if meals.take() != NOTHING:
            taken.append(meals.last)
    assert len(taken) > 300
    steps = [(b - a) % IDS for a, b in itertools.pairwise(taken)]
    assert all(1 <= step <= IDS // 2 for step in steps)
    assert sum(steps) <= said


# ---- contents


@pytest.mark.parametrize("kind", range(16))
def test_every_kind_is_dosed_for_noted_or_refused(kind: int) -> None:
    meals = hear(announced(1, kind))
    taken = {CARBS: (CARBS, 80), SIMPLE: (SIMPLE, 0), SNACK: (SNACK, 80)}.get(kind, NOTHING)
    assert meals.take() == taken
    assert meals.refused == (kind not in (CARBS, SIMPLE, SNACK, HYPO, CANCEL))
    assert meals.last == 1  # echoed in any case: the user need not say it again


@pytest.mark.parametrize("kind", [CARBS, SNACK])
def test_more_than_150_g_and_reserved_codes_are_refused(kind: int) -> None:
    for carbs in range(1024):
        meals = hear(announced(1, kind, carbs))
        assert meals.take() == ((kind, carbs) if carbs <= 300 else NOTHING)
        assert meals.refused == (carbs > 300)


@pytest.mark.parametrize("kind", [CARBS, SIMPLE, SNACK])
def test_a_meal_more_than_an_hour_away_or_at_no_time_is_refused(kind: int) -> None:
    for offset in range(-128, 128):
        meals = hear(announced(1, kind, offset=offset))
        assert (meals.take() != NOTHING) == (-60 <= offset <= 60)
        assert meals.refused == (not -60 <= offset <= 60)


def test_what_needs_no_estimate_is_not_refused_for_one() -> None:
    assert hear(announced(1, SIMPLE, 1023)).take() == (SIMPLE, 0)
    for kind in (HYPO, CANCEL):
        meals = hear(announced(1, kind, 1023, -128))
        assert (meals.take(), meals.refused) == (NOTHING, False)


def test_the_last_number_survives_a_reset_and_an_open_meal_does_not() -> None:
    for meals in (Meals(), hear(announced(0)), hear(announced(254))):
        other = Meals()
        other.restore(iter(meals.save()))
        assert other.last == meals.last
        assert other.take() == NOTHING
        if meals.last is not None:
            other.hear(announced(meals.last))
            assert other.take() == NOTHING  # never dosed twice
            other.hear(announced((meals.last + 1) % IDS))
            assert other.take() == (CARBS, 80)


# ---- the whole firmware


def dosed(bench: Bench, *meals: dict[str, int]) -> tuple[int, bool, int]:
    """Insulin that is programmed in this step, whether DoseRejected is told, and the echo; the step ends uncertain."""
    bench.give(bench.sample(), bench.status(), bench.delivered())
    for drug in (1, 2):
        bench.send("PUMP_BolusState", BolusStateHormone=drug, BolusPhase=0)
    for meal in meals:
        bench.send("MEAL_Announce", **meal)
    first = turn = bench.token(Phase.STEP, bench.k, bench.k * 300)
    while turn.done["DoneStatus"] == Done.CONTINUE:
        turn = bench.token(Phase.CONTINUE, bench.k, bench.k * 300)
    bench.obey(first)
    bench.k += 1
    doses = [command["InsulinBolus"] for command in first.all("PUMP_BolusCmd")]
    return sum(doses), bool(turn.alarms(Code.DOSE_REJECTED)), turn.status["LastMealId"]


@pytest.mark.parametrize(
    ("meal", "doses", "rejected"),
    [
        (announced(4), True, False),
        (announced(4, CARBS, 301), False, True),
        (announced(4, CARBS, 80, -128), False, True),
        (announced(4, 6), False, True),
        (announced(4, HYPO), False, False),
        (announced(4, CANCEL), False, False),
        (announced(4, CARBS, 0), False, False),
    ],
)
def test_a_bolus_or_a_refusal_that_is_told_in_the_same_step(meal: dict[str, int], doses: bool, rejected: bool) -> None:
    bench = Bench(mode=MA)
    bench.run(5)
    dose, told, echo = dosed(bench, meal)
    assert (dose > 0, told, echo) == (doses, rejected, 4)
    dose, _, echo = dosed(bench, meal)
    assert (dose, echo) == (0, 4)


def test_older_meals_are_counted_and_not_dosed() -> None:
    bench = Bench(mode=MA)
    bench.run(5)
    dosed(bench, announced(4, HYPO))
    before = bench.run(1).diag["SequenceErrorCount"]
    assert dosed(bench, announced(3)) == (0, False, 4)
    assert bench.run(1).diag["SequenceErrorCount"] == before + 1


def test_a_meal_while_off_is_not_kept_for_later() -> None:
    bench = Bench(mode=MODE_OFF)
    bench.run(5)
    assert dosed(bench, announced(4))[0] == 0
    bench.send("MODE_Cmd", ModeRequest=MA, ModeCmdSeq=1, SuspendRequest=0)
    assert [dosed(bench)[0] for _ in range(3)] == [0, 0, 0]
