"""The control core's numbers: rounding, ranges, saturation, and the same source compiled by numba."""

import random
from collections.abc import Callable
from fractions import Fraction
from math import floor
from typing import Any

import numpy as np
import pytest
from bench import OPEN_LOOP, S2, Bench, calibration
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pumpbench.closed_loop import compiled

import firmware_sim.firmware
from firmware_sim.calibration import CORE, parameter_names
from firmware_sim.control import layout
from firmware_sim.control.core import (
    MODE_MA,
    MODE_NMA,
    MODE_OFF,
    MODE_S1,
    MODE_S2,
    MODE_S3,
    MODE_S4,
    MODE_SMA,
    RATE_MAX,
    control_step,
    limit_rate,
)
from firmware_sim.control.fixed import INT32_MAX, INT32_MIN, round_divide, round_shift, saturate
from firmware_sim.control.layout import Word
from firmware_sim.control.strategies import s2

INT64 = range(-(1 << 63), 1 << 63)

quick = settings(max_examples=100, deadline=None, derandomize=True)


# ---- arithmetic


@quick
@given(st.integers(-(1 << 61), 1 << 61), st.integers(1, 40))
def test_round_shift_rounds_to_nearest_halves_up(value: int, bits: int) -> None:
    assert round_shift(value, bits) == floor(Fraction(value, 1 << bits) + Fraction(1, 2))


@quick
@given(st.integers(-(1 << 62), 1 << 62), st.integers(1, 1 << 40))
def test_round_divide_rounds_to_nearest_halves_up(value: int, divisor: int) -> None:
    result = round_divide(value, divisor)
    if divisor % 2 == 0:
        assert result == floor(Fraction(value, divisor) + Fraction(1, 2))
    assert abs(Fraction(value, divisor) - result) <= Fraction(1, 2)


@pytest.mark.parametrize(
    ("value", "clamped", "counted"),
    [
        (0, 0, 0),
        (INT32_MAX, INT32_MAX, 0),
        (INT32_MIN, INT32_MIN, 0),
        (INT32_MAX + 1, INT32_MAX, 1),
        (INT32_MIN - 1, INT32_MIN, 1),
        (1 << 62, INT32_MAX, 1),
        (-(1 << 62), INT32_MIN, 1),
    ],
)
def test_saturate_clamps_and_counts(value: int, clamped: int, counted: int) -> None:
    counts = [7]
    assert saturate(value, counts) == clamped
    assert counts == [7 + counted]


# ---- ranges


class Int64(int):
    """An int that fails when an intermediate result does not fit a signed 64-bit word."""

    results = 0


def _checked(name: str) -> Callable[..., Any]:
    plain = getattr(int, name)

    def operate(self: Int64, *others: int) -> Any:
        result = plain(self, *others)
        if result is NotImplemented:
            return result
        if result not in INT64:
            raise OverflowError(f"{int(self)} {name} {others}: {result}")
        Int64.results += 1
        return Int64(result)

    return operate


for _name in ("add", "sub", "mul", "lshift", "rshift", "floordiv", "mod", "and", "or", "xor"):
    for _side in ("", "r"):
        setattr(Int64, f"__{_side}{_name}__", _checked(f"__{_side}{_name}__"))
for _name in ("neg", "abs", "invert"):
    setattr(Int64, f"__{_name}__", _checked(f"__{_name}__"))


def test_the_instrument_sees_an_overflow() -> None:
    with pytest.raises(OverflowError):
        Int64(1 << 62) * 2
    with pytest.raises(OverflowError):
        1 + Int64((1 << 63) - 1)
    with pytest.raises(OverflowError):
        Int64(1 << 40) << 30


def words(table: tuple[Word, ...]) -> st.SearchStrategy[list[int]]:
    """Values for every word of a table: its ends, and anything between."""
    return st.tuples(*(st.one_of(st.sampled_from([w.low, w.high]), st.integers(w.low, w.high)) for w in table)).map(
        list
    )


def drawn(table: tuple[Word, ...], draw: random.Random) -> list[int]:
    """The same from a seeded generator, a hundred times faster."""
    return [draw.choice((w.low, w.high, draw.randint(w.low, w.high))) for w in table]


def room_to_count(state: list[int]) -> list[int]:
    """The count of clamps cannot reach its end: ten a step for 10 years are 1e7."""
    state[layout.SATURATIONS] = min(state[layout.SATURATIONS], 1 << 30)
    return state


def check_ranges(table: tuple[Word, ...], values: list[int]) -> None:
    for word, value in zip(table, values, strict=True):
        assert word.low <= value <= word.high, (word.name, value)


def inputs_of(**values: int) -> list[int]:
    """The inputs of a step with nothing in the way: no daily limit near, no meal, schedule delivered."""
    words = [0] * len(layout.INPUTS)
    words[layout.IN_DELIVERED] = -1
    words[layout.IN_INSULIN_LEFT] = words[layout.IN_PRAM_LEFT] = INT32_MAX
    for name, value in values.items():
        words[getattr(layout, name)] = value
    return words


def ends(table: tuple[Word, ...], *low: str) -> list[int]:
    """Every word at its upper end, those named at their lower one."""
    return [word.low if word.name in low else word.high for word in table]


def check_steps(state: list[int], parameters: list[int], inputs: list[list[int]]) -> None:
    """No exception, nothing beyond int64 on the way, every word within its documented range, clamps counted."""
    s = [Int64(value) for value in room_to_count(state)]
    p = [Int64(value) for value in parameters]
    o = [Int64(0)] * len(layout.OUTPUTS)
    for step in inputs:
        before = s[layout.SATURATIONS]
        Int64.results = 0
        control_step(s, p, [Int64(value) for value in step], o)
        assert Int64.results > 30  # the instrument was in every sum
        check_ranges(layout.STATE, s)
        check_ranges(layout.OUTPUTS, o)
        assert s[layout.SATURATIONS] >= before
        assert o[layout.OUT_RATE] * 5 <= max(p[layout.MAX_BASAL], p[layout.BASAL])
        assert o[layout.OUT_RATE] * 50 <= p[layout.BASAL] * max(p[layout.BASAL_FACTOR], 10)
        assert o[layout.OUT_BOLUS] <= p[layout.MAX_BOLUS]
        assert o[layout.OUT_PRAM_BOLUS] <= p[layout.PRAM_BOLUS]
        assert o[layout.OUT_BOLUS] * 10 <= step[layout.IN_INSULIN_LEFT]
        assert o[layout.OUT_PRAM_BOLUS] <= step[layout.IN_PRAM_LEFT]
        assert o[layout.OUT_BOLUS] == 0 or o[layout.OUT_IOB] + o[layout.OUT_BOLUS] <= p[layout.MAX_IOB]
        if step[layout.IN_LIMIT] != layout.LIMIT_NONE:
            assert o[layout.OUT_BOLUS] == o[layout.OUT_PRAM_BOLUS] == 0
        if step[layout.IN_PRAM_STOP]:
            assert o[layout.OUT_PRAM_RATE] == o[layout.OUT_PRAM_BOLUS] == 0
        if step[layout.IN_MODE] not in (MODE_MA, MODE_SMA, MODE_S3, MODE_S4):
            assert o[layout.OUT_BOLUS] == 0
        if step[layout.IN_MODE] not in (MODE_S1, MODE_S3, MODE_S4):
            assert o[layout.OUT_PRAM_BOLUS] == 0
        if step[layout.IN_LIMIT] == layout.LIMIT_SCHEDULE:
            assert o[layout.OUT_RATE] * 5 <= p[layout.BASAL]
        if step[layout.IN_LIMIT] == layout.LIMIT_SUSPEND:
            assert o[layout.OUT_RATE] == o[layout.OUT_PRAM_RATE] == 0
        if step[layout.IN_MODE] not in (MODE_S2, MODE_S4):
            assert o[layout.OUT_PRAM_RATE] == 0


@settings(max_examples=60, deadline=None, derandomize=True)
@given(words(layout.STATE), words(layout.PARAMETERS), st.lists(words(layout.INPUTS), min_size=1, max_size=3))
@example(ends(layout.STATE), ends(layout.PARAMETERS), [ends(layout.INPUTS)] * 3)
@example([w.low for w in layout.STATE], ends(layout.PARAMETERS), [ends(layout.INPUTS, "IN_RESET")] * 3)
@example(
    ends(layout.STATE, "LEAD_1", "LEAD_2", "LEAD_3"),
    ends(layout.PARAMETERS, "LEAD_A1", "LEAD1_B1", "LEAD2_B1", "MEAL_GAIN"),
    [ends(layout.INPUTS, "IN_RESET", "IN_LIMIT")] * 3,
)
@example(
    ends(layout.STATE, "V_1", "LEAD_1"),
    ends(layout.PARAMETERS, "LEAD_A1", "LEAD1_B1", "LEAD2_B1", "MEAL_GAIN", "TARGET"),
    [ends(layout.INPUTS, "IN_RESET", "IN_LIMIT")] * 3,
)
def test_any_state_any_parameters_any_input_stay_within_words(
    state: list[int], parameters: list[int], inputs: list[list[int]]
) -> None:
    check_steps(state, parameters, inputs)


def test_two_thousand_random_corners_stay_within_words() -> None:
    draw = random.Random(1)
    for _ in range(2000):
        inputs = [drawn(layout.INPUTS, draw) for _ in range(3)]
        check_steps(drawn(layout.STATE, draw), drawn(layout.PARAMETERS, draw), inputs)


def test_a_clamp_is_counted_where_it_happens() -> None:
    """An unstable filter runs into the end of its word; every clamp shows, and the rate keeps its limit."""
    parameters = core_parameters("adult#001")
    parameters[layout.LEAD_A1] = -(1 << 25)  # y(k) = 2 y(k-1) + ..
    state, outputs = [0] * len(layout.STATE), [0] * len(layout.OUTPUTS)
    counts = []
    for k in range(60):
        control_step(
            state,
            parameters,
            inputs_of(IN_GLUCOSE=3000, IN_DELIVERED=100, IN_MODE=MODE_NMA, IN_RESET=int(k == 0)),
            outputs,
        )
        counts.append(state[layout.SATURATIONS])
    assert counts[0] == 0 < counts[-1]
    assert counts == sorted(counts)
    assert outputs[layout.OUT_RATE] * 5 <= parameters[layout.MAX_BASAL]


def core_parameters(patient: str, **raws: int) -> list[int]:
    names = parameter_names()
    values = {names[index]: raw for index, raw in calibration(patient, **raws).items()}
    return [values[CORE[word.name]] for word in layout.PARAMETERS]


# ---- the command


def limited(
    demand: int, carry: int = 0, limit: int = 0, basal: int = 10000, max_basal: int = 60000
) -> tuple[int, int, int]:
    """Rate, carry and limiter bits for a demand in 0.005 U/h, 16 fractional bits; no other limit is near."""
    state, parameters = [0] * len(layout.STATE), [0] * len(layout.PARAMETERS)
    inputs, outputs = inputs_of(IN_GLUCOSE=1200, IN_LIMIT=limit), [0] * len(layout.OUTPUTS)
    state[layout.RATE_CARRY] = carry
    parameters[layout.BASAL], parameters[layout.MAX_BASAL] = basal, max_basal
    parameters[layout.BASAL_FACTOR], parameters[layout.MAX_IOB], parameters[layout.MAX_RISE] = 255, 4000, 60000
    rate = limit_rate(demand, 0, state, parameters, inputs, outputs)
    return rate, state[layout.RATE_CARRY], outputs[layout.OUT_LIMITERS]


def test_every_rate_comes_out_as_it_went_in() -> None:
    """Also across 199/200, 255/256, 1199/1200, 1270/1271: no byte, no table, no unit switch in between."""
    for raw in range(RATE_MAX + 1):
        assert limited(raw << 16) == (raw, 0, 0)
        assert limited((raw << 16) + 65535)[0] == raw  # rounded down
    for raw in (RATE_MAX + 1, 8190, 8191, 8192, 16384, INT32_MAX >> 16):
        assert limited(raw << 16) == (RATE_MAX, 0, layout.LIMITER_MAX_BASAL)


def test_a_negative_demand_is_no_rate() -> None:
    for demand in (-1, -65536, INT32_MIN):
        assert limited(demand) == (0, 0, 0)
        assert limited(demand, carry=65535) == (0, 65535, 0)


@pytest.mark.parametrize(
    ("limit", "demand", "rate", "bits"),
    [
        (layout.LIMIT_NONE, 600, 600, 0),
        (layout.LIMIT_NONE, 601, 600, layout.LIMITER_MAX_BASAL),
        (layout.LIMIT_SCHEDULE, 200, 200, 0),
        (layout.LIMIT_SCHEDULE, 150, 150, 0),
        (layout.LIMIT_SCHEDULE, 201, 200, layout.LIMITER_STALE_CGM),
        (layout.LIMIT_SCHEDULE, 700, 200, layout.LIMITER_MAX_BASAL | layout.LIMITER_STALE_CGM),
        (layout.LIMIT_SUSPEND, 0, 0, 0),
        (layout.LIMIT_SUSPEND, 1, 0, layout.LIMITER_LOW_GLUCOSE),
    ],
)
def test_a_cut_shows_in_the_limiter_bits(limit: int, demand: int, rate: int, bits: int) -> None:
    assert limited(demand << 16, limit=limit, basal=1000, max_basal=3000)[::2] == (rate, bits)


def test_an_unset_maximum_is_the_schedule() -> None:
    assert limited(5000 << 16, basal=1000, max_basal=0)[0] == 200


@quick
@given(st.lists(st.integers(-(1 << 20), 600 << 16), min_size=1, max_size=200))
def test_what_is_rounded_off_is_carried(demands: list[int]) -> None:
    carry, given_out, asked = 0, 0, 0
    for demand in demands:
        rate, carry, _ = limited(demand, carry, max_basal=60000)
        given_out += rate << 16
        asked += max(demand, 0)
        assert 0 <= asked - given_out < 1 << 16


@quick
@given(st.lists(st.integers(0, RATE_MAX), min_size=1, max_size=200), st.integers(0, 4000))
def test_pramlintide_is_the_ratio_of_the_insulin_to_one_lsb(rates: list[int], ratio: int) -> None:
    """0.005 U/h times 0.01 ug/U is 1/2000 of 0.1 ug/h."""
    state, parameters = [0] * len(layout.STATE), [0] * len(layout.PARAMETERS)
    parameters[layout.PRAM_RATIO] = ratio
    given_out = exact = 0
    for rate in rates:
        infusion = s2.infusion(rate, state, parameters)
        assert abs(Fraction(ratio * rate, 2000) - infusion) < 1
        given_out += infusion * 2000
        exact += ratio * rate
        assert 0 <= exact - given_out < 2000


@pytest.mark.parametrize("rate", [1, 199, 200, 255, 256, 1199, 1200, 1270, 1271, 4095, 4096, 7999, 8000])
def test_rates_reach_the_wire(rate: int) -> None:
    """An open loop commands its schedule: also beyond 6 U/h and 6.35 U/h, where others wrapped."""
    bench = Bench(mode=OPEN_LOOP, flash=calibration(CfgBasal=rate * 5))
    assert bench.run(4).rate == rate


def test_nothing_is_commanded_in_a_reserved_code() -> None:
    """A schedule beyond what the command can carry ends at its largest rate, and says so."""
    bench = Bench(mode=OPEN_LOOP, flash=calibration(CfgBasal=60000))
    turn = bench.run(4)
    assert turn.rate == RATE_MAX
    assert turn.status["LimiterBits"] & layout.LIMITER_MAX_BASAL


# ---- compiled


class Twin:
    """Plain and compiled core on the same inputs."""

    def __init__(self, parameters: list[int]) -> None:
        self.compiled = compiled.control_step()
        self.parameters = parameters
        self.state, self.outputs = [0] * len(layout.STATE), [0] * len(layout.OUTPUTS)
        self.fast = tuple(np.array(words, dtype=np.int64) for words in (self.state, parameters, self.outputs))

    def step(self, inputs: list[int]) -> None:
        control_step(self.state, self.parameters, inputs, self.outputs)
        state, parameters, outputs = self.fast
        self.compiled(state, parameters, np.array(inputs, dtype=np.int64), outputs)
        assert state.tolist() == self.state
        assert outputs.tolist() == self.outputs
        assert parameters.tolist() == self.parameters


@pytest.mark.parametrize("seed", range(6))
def test_compiled_is_bit_identical_over_a_long_run(seed: int) -> None:
    """Calibrated patients first, then parameters anywhere in their ranges."""
    draw = random.Random(seed)
    patient = f"adult#{draw.randint(1, 10):03d}"
    twin = Twin(core_parameters(patient) if seed < 3 else drawn(layout.PARAMETERS, draw))
    glucose = 1200
    for k in range(8000):
        glucose = min(max(glucose + draw.randint(-60, 60), 200), 8000)
        twin.step(
            inputs_of(
                IN_GLUCOSE=-1 if draw.random() < 0.05 else glucose,
                IN_DELIVERED=draw.choice([-1, 0, 16777215, *[draw.randint(0, 400)] * 20]),
                IN_MODE=draw.choice([MODE_OFF, 1, 15, *range(MODE_NMA, MODE_S4 + 1), *[MODE_S1] * 3]),
                IN_LIMIT=draw.choice([1, 2, *[0] * 8]),
                IN_RESET=int(k < 2 or draw.random() < 0.01),
                IN_BOLUS=draw.choice([0, 0, 0, draw.randint(0, 5000)]),
                IN_MEAL=draw.choice([0, 0, 1, 2, 3]),
                IN_CARBS=draw.randint(0, 1000),
            )
        )
    assert twin.outputs[layout.OUT_RATE] >= 0


def test_compiled_is_bit_identical_at_the_ends_of_all_ranges() -> None:
    draw = random.Random(2)
    for _ in range(3000):
        twin = Twin(drawn(layout.PARAMETERS, draw))
        twin.state[:] = twin.fast[0][:] = room_to_count(drawn(layout.STATE, draw))
        for _ in range(2):
            twin.step(drawn(layout.INPUTS, draw))


def test_compiled_is_bit_identical_in_the_closed_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """The firmware at work, its core doubled: gaps, late totals and a suspension included."""
    twins: list[Twin] = []

    def both(state: list[int], parameters: list[int], inputs: list[int], outputs: list[int]) -> None:
        if not twins:
            twins.append(Twin(parameters))
        twins[0].step(inputs)
        state[:], outputs[:] = twins[0].state, twins[0].outputs

    monkeypatch.setattr(firmware_sim.firmware, "control_step", both)
    bench = Bench(mode=S2)
    draw = random.Random(8)
    glucose, rates = 1200, set()
    for k in range(600):
        glucose = min(max(glucose + draw.randint(-80, 85), 400), 4000)
        if k in (200, 230):
            bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=k // 2 - 99, SuspendRequest=1 if k == 200 else 2)
        turn = bench.step(glucose, drop=draw.random() < 0.1 or 400 < k < 420, totals=draw.random() < 0.9)
        rates.add(turn.command["InsulinRate"])
    assert len(rates) > 100
    assert twins


def test_the_modules_stay_plain() -> None:
    """Compiling leaves the firmware's own functions as they are."""
    compiled.control_step()
    from firmware_sim.control import core, fixed, observer

    for module in (core, fixed, observer, s2):
        for name, value in vars(module).items():
            assert not hasattr(value, "py_func"), (module, name)


def test_the_compiled_core_can_be_called_from_compiled_code() -> None:
    import numba

    step = compiled.control_step()

    @numba.njit
    def day(state: Any, parameters: Any, inputs: Any, outputs: Any) -> int:
        total = 0
        for _ in range(288):
            step(state, parameters, inputs, outputs)
            total += outputs[0]
        return total

    words = [np.zeros(len(table), dtype=np.int64) for table in (layout.STATE, layout.INPUTS, layout.OUTPUTS)]
    parameters = np.array(core_parameters("adult#001"), dtype=np.int64)
    words[1][:] = inputs_of(IN_GLUCOSE=1200, IN_MODE=MODE_NMA)
    assert day(words[0], parameters, words[1], words[2]) == 288 * parameters[layout.BASAL] // 5
