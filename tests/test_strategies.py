"""Meals, peaks and limits of the control core, function by function and at their boundaries."""

import pytest

from firmware_sim.control import core, layout, limits, observer, prandial
from firmware_sim.control.layout import MEAL_CARBS, MEAL_NONE, MEAL_SIMPLE, MEAL_SNACK
from firmware_sim.control.strategies import s1, s3, s4

OFF, OPEN_LOOP, NMA, MA, SMA, S1, S2, S3, S4 = range(9)


def words(table: tuple[layout.Word, ...], **values: int) -> list[int]:
    made = [0] * len(table)
    for name, value in values.items():
        made[getattr(layout, name)] = value
    return made


def state(**values: int) -> list[int]:
    return words(layout.STATE, **values)


def parameters(**values: int) -> list[int]:
    return words(layout.PARAMETERS, **{"BASAL": 1000, "MAX_BOLUS": 1000, "MAX_IOB": 2000, "PRAM_BOLUS": 300} | values)


def inputs(**values: int) -> list[int]:
    left = {"IN_GLUCOSE": 1200, "IN_INSULIN_LEFT": 1 << 30, "IN_PRAM_LEFT": 1 << 30}
    return words(layout.INPUTS, **left | values)


def outputs(**values: int) -> list[int]:
    return words(layout.OUTPUTS, **values)


# ---- the core's own bookkeeping


@pytest.mark.parametrize(
    ("glucose", "reset", "before", "after"),
    [
        (1300, 0, 0, 1),
        (1300, 0, 1, 2),
        (1300, 0, 2, 3),
        (1300, 0, 3, 3),  # no further than anybody asks
        (0, 0, 1, 2),  # zero is a sample
        (-1, 0, 3, 0),  # a missing one ends the row
        (1300, 1, 3, 1),  # and so does a new start
    ],
)
def test_a_trend_is_a_row_of_samples(glucose: int, reset: int, before: int, after: int) -> None:
    words = state(TREND=before, GLUCOSE=1200, GLUCOSE_1=1100, GLUCOSE_2=1000)
    core.follow_trend(words, inputs(IN_GLUCOSE=glucose, IN_RESET=reset))
    shifted = (1200, 1100) if glucose >= 0 else (1100, 1000)
    assert (words[layout.TREND], words[layout.GLUCOSE_1], words[layout.GLUCOSE_2]) == (after, *shifted)
    assert words[layout.GLUCOSE] == 1200  # the observer's to change


@pytest.mark.parametrize("word", [layout.BOLUS_WAIT, layout.PRAM_WAIT])
def test_waiting_ends(word: int) -> None:
    words = state()
    words[word] = 3
    seen = []
    for _ in range(5):
        core.wait(words)
        seen.append(words[word])
    assert seen == [2, 1, 0, 0, 0]


def test_off_asks_for_nothing() -> None:
    told, words = outputs(), state(DEMAND=5)
    core.control_step(words, parameters(MEAL_GAIN=1), inputs(IN_MODE=OFF, IN_DELIVERED=-1), told)
    assert (told[layout.OUT_DEMAND], told[layout.OUT_RATE], words[layout.DEMAND]) == (0, 0, 0)


@pytest.mark.parametrize(
    ("carbs", "stop", "dose", "refused"),
    [(0, 0, 0, 0), (1, 0, 400, 0), (1, 1, 0, 1)],  # half a gram at 0.1 g/U and nu = 0.8
)
def test_the_least_of_a_meal_is_dosed_for_or_refused(carbs: int, stop: int, dose: int, refused: int) -> None:
    told = outputs(OUT_REFUSED=9)
    flashed = parameters(MEAL_GAIN=1, CARB_RATIO=10, MEAL_FACTOR=800)
    meal = inputs(IN_MODE=MA, IN_DELIVERED=-1, IN_MEAL=MEAL_CARBS, IN_CARBS=carbs, IN_BOLUS_STOP=stop)
    core.control_step(state(), flashed, meal, told)
    assert (told[layout.OUT_BOLUS], told[layout.OUT_REFUSED]) == (dose, refused)


def test_what_was_delivered_and_is_not_known_is_taken_as_the_schedule() -> None:
    flashed = parameters(BASAL=1200)
    assert observer.above_schedule(flashed, inputs(IN_DELIVERED=-1), 14) == 0
    assert observer.above_schedule(flashed, inputs(IN_DELIVERED=101), 14) == 1 << 14


def test_before_the_first_sample_there_is_no_meal_and_zero_is_a_sample() -> None:
    words = state(GLUCOSE=1500)
    assert observer.meal_insulin(words, parameters(MEAL_GAIN=1), inputs(IN_GLUCOSE=-1, IN_DELIVERED=-1)) == 0
    assert (words[layout.PRIMED], words[layout.GLUCOSE]) == (0, 1500)
    observer.meal_insulin(words, parameters(MEAL_GAIN=1), inputs(IN_GLUCOSE=0, IN_DELIVERED=-1))
    assert (words[layout.PRIMED], words[layout.GLUCOSE]) == (1, 0)


def test_an_observer_beyond_its_words_is_clamped_and_counted() -> None:
    most = (1 << 31) - 1
    words = state(SATURATIONS=5, LAG_3=most)
    flashed = parameters(INSULIN_GAIN=67108863, INSULIN_A33=(1 << 30) - 1, MEAL_GAIN=1)
    observer.meal_insulin(words, flashed, inputs(IN_GLUCOSE=8000, IN_DELIVERED=-1))
    assert words[layout.SATURATIONS] == 5 + 2  # the effect of insulin, and with glucose on top once more
    assert words[layout.V_1] == most


# ---- strategy 1


def peaking(**changes: int) -> tuple[int, list[int], list[int]]:
    """u(k), state and parameters just inside of B_1 and B_2: u_b is 200 LSB, z_1 = 2, z_2 = 0.5 mg/dL/min."""
    values = {"DEMAND": 402 << 16, "RISING": 1, "TREND": 2, "GLUCOSE": 1526, "GLUCOSE_1": 1500} | changes
    u = values.pop("u", (400 << 16) + 1)
    return u, state(**values), parameters(PEAK_RATIO=200, PEAK_SLOPE=500, PEAK_LOCKOUT=12)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, True),
        ({"u": 400 << 16}, False),  # not above z_1 times the schedule
        ({"u": 402 << 16}, False),  # not falling
        ({"RISING": 0}, False),  # did not rise before
        ({"GLUCOSE": 1525}, False),  # 0.5 mg/dL/min is not more than 0.5
        ({"TREND": 1}, False),  # no slope from one sample
        ({"TREND": 3}, True),
        ({"PEAK_WAIT": 1}, True),  # the last step of waiting has passed
        ({"PEAK_WAIT": 2}, False),
    ],
)
def test_a_peak_needs_every_condition(changes: dict[str, int], found: bool) -> None:
    assert s1.peak(*peaking(**changes)) == found


@pytest.mark.parametrize(("u", "rising"), [((402 << 16) + 1, 1), (402 << 16, 0), ((402 << 16) - 1, 0)])
def test_slopes_are_followed_on_the_unrounded_signal(u: int, rising: int) -> None:
    _, memory, flashed = peaking()
    s1.peak(u, memory, flashed)
    assert (memory[layout.DEMAND], memory[layout.RISING]) == (u, rising)


def test_a_dose_starts_the_wait_of_z_3_steps() -> None:
    words = state()
    assert s1.dose(words, parameters(PEAK_LOCKOUT=12)) == 300
    assert words[layout.PEAK_WAIT] == 13


@pytest.mark.parametrize("lockout", [0, 1, 12, 255])
def test_more_than_z_3_steps_pass_between_two_boluses(lockout: int) -> None:
    u, memory, flashed = peaking()
    flashed[layout.PEAK_LOCKOUT] = lockout
    assert s1.dose(memory, flashed) == 300
    steps = 0
    while True:
        steps += 1
        memory[layout.DEMAND], memory[layout.RISING] = 402 << 16, 1
        if s1.peak(u, memory, flashed):
            break
    assert steps == lockout + 1


# ---- meals


@pytest.mark.parametrize(
    ("mode", "kind", "carbs"),
    [(mode, MEAL_NONE, 0) for mode in range(9)]
    + [(mode, kind, 0) for mode in (OFF, OPEN_LOOP, NMA, S1, S2) for kind in (MEAL_CARBS, MEAL_SIMPLE, MEAL_SNACK)]
    + [(mode, kind, 77) for mode in (MA, S3) for kind in (MEAL_CARBS, MEAL_SNACK)]
    + [(mode, MEAL_SIMPLE, 50) for mode in (MA, S3, SMA, S4)]
    + [(mode, MEAL_CARBS, 50) for mode in (SMA, S4)]
    + [(mode, MEAL_SNACK, 0) for mode in (SMA, S4)],
)
def test_what_each_mode_doses_for(mode: int, kind: int, carbs: int) -> None:
    told = inputs(IN_MODE=mode, IN_MEAL=kind, IN_CARBS=77)
    assert prandial.announced_carbs(parameters(ASSUMED_CARBS=50), told) == carbs


@pytest.mark.parametrize(("carbs", "dose"), [(0, 0), (100, 400), (120, 480), (125, 500), (126, 504), (1, 4)])
def test_the_bolus_is_nu_carbs_over_ratio_rounded_down(carbs: int, dose: int) -> None:
    """0.8 of 50 g at 10 g/U are 4 U."""
    assert prandial.bolus(carbs, parameters(MEAL_FACTOR=800, CARB_RATIO=1000)) == dose
    assert prandial.bolus(100, parameters(MEAL_FACTOR=800, CARB_RATIO=1001)) == 399


def test_strategies_3_and_4_dose_pramlintide_with_the_meal() -> None:
    assert s3.dose(parameters(PRAM_BOLUS=150)) == 150
    assert s4.dose(167, parameters(PRAM_RATIO=1000)) == 167  # 1.67 U at 10 ug/U
    assert s4.dose(167, parameters(PRAM_RATIO=599)) == 100


def test_the_deduction_is_the_filtered_bolus_three_samples_late() -> None:
    """A bolus of 1 U delivered in one step, F with no memory: 0.85 of it comes off once, as a rate over one step."""
    flashed = parameters(BOLUS_DEDUCTION=850, FILTER_B1=(1 << 30) - 1, FILTER_B2=(1 << 30) - 1, FILTER_B3=(1 << 30) - 1)
    memory = state()
    taken = [prandial.deduction(memory, flashed, inputs(IN_BOLUS=1000 if k == 0 else 0)) for k in range(8)]
    expected = round(0.85 * 1000 * 12 / 5 * 65536)  # mU per step to 0.005 U/h, 16 bits
    assert taken[:3] == [0, 0, 0]
    assert taken[3] == pytest.approx(expected, abs=3)
    assert taken[4:] == [0] * 4
    assert memory[layout.SATURATIONS] == 0


@pytest.mark.parametrize(("word", "late"), [("FILTER_A1", 1), ("FILTER_A2", 1), ("FILTER_A3", 1)])
def test_every_coefficient_of_the_filter_is_used(word: str, late: int) -> None:
    half = 1 << 29
    flashed = parameters(BOLUS_DEDUCTION=1000, FILTER_B1=half, FILTER_B2=half, FILTER_B3=half, **{word: half})
    memory = state(FILTER_1=1 << 20, FILTER_2=1 << 18, FILTER_3=1 << 16)
    prandial.deduction(memory, flashed, inputs())
    first, second, third = memory[layout.FILTER_1], memory[layout.FILTER_2], memory[layout.FILTER_3]
    expected = {
        "FILTER_A1": (1 << 19, 1 << 17, 1 << 15),
        "FILTER_A2": (0, 1 << 19, 1 << 17),
        "FILTER_A3": (0, 0, 1 << 19),
    }
    assert (first, second, third) == expected[word]


# ---- limits of boluses


def bolus(wanted: int = 500, *, flash: dict[str, int] | None = None, memory: dict[str, int] | None = None, **told: int):
    """Dose and limiter bits."""
    words_out = outputs(OUT_IOB=told.pop("iob", 0), OUT_LIMITERS=256)  # a bit that is there stays there
    kept = state(**memory or {})
    flashed = parameters(BOLUS_LOCKOUT=3, LOW_SUSPEND=700, **flash or {})
    dose = limits.limit_bolus(wanted, kept, flashed, inputs(**told), words_out)
    return dose, words_out[layout.OUT_LIMITERS] - 256, kept[layout.BOLUS_WAIT]


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({}, (500, 0, 3)),
        ({"wanted": 1}, (1, 0, 3)),
        ({"wanted": 1000}, (1000, 0, 3)),
        ({"wanted": 1001}, (1000, 2, 3)),
        ({"iob": 1500}, (500, 0, 3)),
        ({"iob": 1501}, (499, 4, 3)),
        ({"iob": 1400, "IN_OPEN": 101}, (499, 4, 3)),
        ({"iob": 2000}, (0, 4, 0)),
        ({"iob": 2400}, (0, 4, 0)),
        ({"IN_INSULIN_LEFT": 5000}, (500, 0, 3)),
        ({"IN_INSULIN_LEFT": 4999}, (499, 64, 3)),
        ({"IN_INSULIN_LEFT": 9}, (0, 64, 0)),
        ({"IN_LIMIT": 1}, (0, 0, 0)),
        ({"IN_LIMIT": 2}, (0, 0, 0)),
        ({"IN_BOLUS_STOP": 1}, (0, 0, 0)),
        ({"IN_BOLUS_STOP": 2}, (500, 0, 3)),
        ({"IN_BOLUS_STOP": 3}, (0, 0, 0)),
        ({"IN_GLUCOSE": 700}, (500, 0, 3)),
        ({"IN_GLUCOSE": 699}, (0, 8, 0)),
        ({"IN_GLUCOSE": -1}, (500, 0, 3)),
        ({"memory": {"BOLUS_WAIT": 1}}, (0, 32, 1)),
    ],
)
def test_what_cuts_a_bolus(case: dict, expected: tuple[int, int, int]) -> None:
    assert bolus(**case) == expected


def pram_bolus(wanted: int = 150, *, memory: dict[str, int] | None = None, **told: int) -> tuple[int, int, int]:
    words_out = outputs(OUT_LIMITERS=256)
    kept = state(**{"GLUCOSE": 1200} | (memory or {}))
    flashed = parameters(BOLUS_LOCKOUT=3, LOW_SUSPEND=650)
    dose = limits.limit_pram_bolus(wanted, kept, flashed, inputs(**told), words_out)
    return dose, words_out[layout.OUT_LIMITERS] - 256, kept[layout.PRAM_WAIT]


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({}, (150, 0, 3)),
        ({"wanted": 0}, (0, 0, 0)),
        ({"wanted": 1}, (1, 0, 3)),
        ({"IN_GLUCOSE": 649}, (0, 8, 0)),
        ({"IN_GLUCOSE": 650}, (150, 0, 3)),
        ({"memory": {"GLUCOSE": 780, "GLUCOSE_1": 840, "GLUCOSE_2": 900, "TREND": 3}}, (0, 8, 0)),
        ({"wanted": 300}, (300, 0, 3)),
        ({"wanted": 301}, (300, 2, 3)),
        ({"IN_PRAM_LEFT": 150}, (150, 0, 3)),
        ({"IN_PRAM_LEFT": 149}, (149, 64, 3)),
        ({"IN_PRAM_LEFT": 0}, (0, 64, 0)),
        ({"IN_LIMIT": 1}, (0, 0, 0)),
        ({"IN_PRAM_STOP": 1}, (0, 0, 0)),
        ({"IN_BOLUS_STOP": 2}, (0, 0, 0)),
        ({"IN_BOLUS_STOP": 1}, (150, 0, 3)),
        ({"memory": {"GLUCOSE": 700}}, (150, 0, 3)),
        ({"memory": {"GLUCOSE": 699}}, (0, 8, 0)),
        ({"memory": {"PRAM_WAIT": 1}}, (0, 32, 1)),
    ],
)
def test_what_cuts_a_pramlintide_bolus(case: dict, expected: tuple[int, int, int]) -> None:
    assert pram_bolus(**case) == expected


@pytest.mark.parametrize(
    ("wanted", "given", "told", "rate", "bits"),
    [
        (120, 0, {}, 120, 0),
        (9000, 0, {}, 8000, 0),
        (120, 0, {"IN_LIMIT": 1}, 120, 0),
        (120, 0, {"IN_LIMIT": 2}, 0, 0),
        (120, 0, {"IN_PRAM_STOP": 1}, 0, 0),
        (120, 0, {"IN_PRAM_LEFT": 10}, 120, 0),
        (121, 0, {"IN_PRAM_LEFT": 10}, 120, 64),
        (120, 5, {"IN_PRAM_LEFT": 15}, 120, 0),
        (120, 6, {"IN_PRAM_LEFT": 15}, 108, 64),
        (120, 20, {"IN_PRAM_LEFT": 15}, 0, 64),
    ],
)
def test_what_cuts_a_pramlintide_rate(wanted: int, given: int, told: dict[str, int], rate: int, bits: int) -> None:
    words_out = outputs(OUT_LIMITERS=256)
    assert limits.limit_pram_rate(wanted, given, inputs(**told), words_out) == rate
    assert words_out[layout.OUT_LIMITERS] - 256 == bits


# ---- limits of the rate


def rate(demand: int, dose: int = 0, *, memory: dict[str, int] | None = None, iob: int = 0, **values: int):
    """Rate in LSB and limiter bits; u_b is 200 LSB."""
    flashed = {"MAX_BASAL": 30000, "BASAL_FACTOR": 255, "MAX_RISE": 60000, "LOW_SUSPEND": 700}
    for name in list(values):
        if not name.startswith("IN_"):
            flashed[name] = values.pop(name)
    words_out = outputs(OUT_IOB=iob, OUT_LIMITERS=256)
    kept = state(**memory or {})
    given = limits.limit_rate(demand << 16, dose, kept, parameters(**flashed), inputs(**values), words_out)
    assert given == kept[layout.RATE]
    return given, words_out[layout.OUT_LIMITERS] - 256


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"demand": 900}, (900, 0)),
        ({"demand": 900, "MAX_BASAL": 4500}, (900, 0)),
        ({"demand": 901, "MAX_BASAL": 4500}, (900, 1)),
        ({"demand": 800, "BASAL_FACTOR": 40}, (800, 0)),
        ({"demand": 801, "BASAL_FACTOR": 40}, (800, 1)),
        ({"demand": 201, "BASAL_FACTOR": 5}, (200, 1)),
        ({"demand": 900, "MAX_RISE": 2000}, (400, 128)),
        ({"demand": 400, "MAX_RISE": 2000}, (400, 0)),
        ({"demand": 900, "MAX_RISE": 2000, "memory": {"RATE": 500}}, (900, 0)),
        ({"demand": 100, "MAX_RISE": 0, "memory": {"RATE": 500}}, (100, 0)),
        ({"demand": 440, "iob": 1990}, (440, 0)),
        ({"demand": 441, "iob": 1990}, (440, 4)),
        ({"demand": 441, "iob": 1890, "dose": 100}, (440, 4)),
        ({"demand": 441, "iob": 1890, "IN_OPEN": 100}, (440, 4)),
        ({"demand": 900, "iob": 2500}, (200, 4)),
        ({"demand": 240, "IN_INSULIN_LEFT": 100}, (240, 0)),
        ({"demand": 241, "IN_INSULIN_LEFT": 100}, (240, 64)),
        ({"demand": 240, "IN_INSULIN_LEFT": 1090, "dose": 100}, (216, 64)),
        ({"demand": 240, "IN_INSULIN_LEFT": 900, "dose": 100}, (0, 64)),
        ({"demand": 900, "IN_GLUCOSE": 700}, (900, 0)),
        ({"demand": 900, "IN_GLUCOSE": 699}, (0, 8)),
        ({"demand": 0, "IN_GLUCOSE": 699}, (0, 0)),
        ({"demand": 900, "IN_LIMIT": 2}, (0, 8)),
        ({"demand": 900, "IN_LIMIT": 1}, (200, 16)),
        ({"demand": 900, "IN_GLUCOSE": -1, "memory": {"RATE": 300}}, (300, 16)),
        ({"demand": 200, "IN_GLUCOSE": -1, "memory": {"RATE": 300}}, (200, 0)),
    ],
)
def test_what_cuts_a_rate(case: dict, expected: tuple[int, int]) -> None:
    assert rate(**case) == expected


@pytest.mark.parametrize(
    ("samples", "trend", "soon"),
    [
        ((900, 900, 900), 3, False),
        ((780, 800, 820), 3, True),  # 4 mg/dL a step: 66 in six steps
        ((850, 870, 890), 3, False),
        ((820, 840, 860), 3, False),  # exactly at the limit
        ((819, 840, 860), 3, True),
        ((780, 800, 820), 2, False),
    ],
)
def test_a_low_in_half_an_hour_is_seen_on_the_line_through_three_samples(
    samples: tuple[int, int, int], trend: int, soon: bool
) -> None:
    memory = dict(zip(("GLUCOSE", "GLUCOSE_1", "GLUCOSE_2"), samples, strict=True))
    kept = state(TREND=trend, **memory)
    assert limits.soon_low(kept, parameters(LOW_SUSPEND=700)) == soon
    assert rate(900, memory={"TREND": trend, **memory}) == ((200, 8) if soon else (900, 0))
    assert bolus(memory={"TREND": trend, **memory})[:2] == ((0, 8) if soon else (500, 0))


@pytest.mark.parametrize(("mode", "dose"), [(layout.MODE_S3, 120), (layout.MODE_S4, 1)])
def test_the_smallest_insulin_bolus_brings_its_pramlintide(mode: int, dose: int) -> None:
    told = outputs()
    flashed = parameters(
        MEAL_GAIN=1, CARB_RATIO=4000, MEAL_FACTOR=800, ASSUMED_CARBS=1, PRAM_BOLUS=120, PRAM_RATIO=1000
    )
    meal = inputs(IN_MODE=mode, IN_DELIVERED=-1, IN_MEAL=MEAL_CARBS, IN_CARBS=1)  # half a gram at 40 g/U
    core.control_step(state(GLUCOSE=1500, PRIMED=1, TREND=3, GLUCOSE_1=1500, GLUCOSE_2=1500), flashed, meal, told)
    assert (told[layout.OUT_BOLUS], told[layout.OUT_PRAM_BOLUS]) == (1, dose)


def test_a_limited_pramlintide_bolus_is_told_of() -> None:
    told = outputs()
    flashed = parameters(
        MEAL_GAIN=1, CARB_RATIO=1000, MEAL_FACTOR=800, ASSUMED_CARBS=80, PRAM_BOLUS=50, PRAM_RATIO=1000
    )
    meal = inputs(IN_MODE=layout.MODE_S4, IN_DELIVERED=-1, IN_MEAL=MEAL_CARBS, IN_CARBS=80)
    core.control_step(state(GLUCOSE=1500, PRIMED=1, TREND=3, GLUCOSE_1=1500, GLUCOSE_2=1500), flashed, meal, told)
    assert told[layout.OUT_PRAM_BOLUS] == 50
    assert told[layout.OUT_LIMITERS] & layout.LIMITER_MAX_BOLUS
