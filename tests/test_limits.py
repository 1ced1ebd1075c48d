"""Each limit of the insulin rate at its edge, and several at once: every cut is told, and none that cuts nothing."""

from collections.abc import Callable

import pytest

from firmware_sim.control.layout import (
    BASAL,
    BASAL_FACTOR,
    GLUCOSE,
    GLUCOSE_1,
    GLUCOSE_2,
    IN_GLUCOSE,
    IN_INSULIN_LEFT,
    IN_LIMIT,
    IN_OPEN,
    INPUTS,
    LIMIT_SCHEDULE,
    LIMIT_SUSPEND,
    LIMITER_DAY,
    LIMITER_LOW_GLUCOSE,
    LIMITER_MAX_BASAL,
    LIMITER_MAX_IOB,
    LIMITER_RISE,
    LIMITER_STALE_CGM,
    LOW_SUSPEND,
    MAX_BASAL,
    MAX_IOB,
    MAX_RISE,
    OUT_IOB,
    OUT_LIMITERS,
    OUTPUTS,
    PARAMETERS,
    RATE,
    RATE_CARRY,
    STATE,
    TREND,
)
from firmware_sim.control.limits import RATE_MAX, limit_rate

SCHEDULE = 200
"""Scheduled rate of `Device`, 0.005 U/h: 1 U/h."""


class Device:
    """The arrays of a device that nothing limits but the largest rate of the wire."""

    def __init__(self) -> None:
        self.state, self.parameters = [0] * len(STATE), [0] * len(PARAMETERS)
        self.inputs, self.outputs = [0] * len(INPUTS), [0] * len(OUTPUTS)
        self.parameters[BASAL], self.parameters[MAX_BASAL], self.parameters[BASAL_FACTOR] = 1000, 60000, 255
        self.parameters[MAX_IOB], self.parameters[LOW_SUSPEND], self.parameters[MAX_RISE] = 4000, 700, 60000
        self.inputs[IN_GLUCOSE], self.inputs[IN_INSULIN_LEFT] = 1500, 100_000
        self.state[GLUCOSE] = self.state[GLUCOSE_1] = self.state[GLUCOSE_2] = 1500

    def rate(self, demand: float, bolus: int = 0) -> tuple[int, int]:
        """Rate for a demand (both in 0.005 U/h), and the limiters that it tells of."""
        arrays = self.state, self.parameters, self.inputs, self.outputs
        return limit_rate(round(demand * 65536), bolus, *arrays), self.outputs[OUT_LIMITERS]


Limit = Callable[[Device], None]
"""Puts a limit in force."""


def largest_rate(device: Device) -> None:
    device.parameters[MAX_BASAL] = 1500


def largest_factor(device: Device) -> None:
    device.parameters[BASAL_FACTOR] = 15


def on_board(device: Device) -> None:
    device.outputs[OUT_IOB] = 3990
    device.inputs[IN_OPEN] = 5  # leaves 0.05 U, which are 0.6 U/h for five minutes; the schedule is not counted


def total_of_a_day(device: Device) -> None:
    device.inputs[IN_INSULIN_LEFT] = 125  # mU, which are 1.5 U/h for five minutes


def rise(device: Device) -> None:
    device.state[RATE], device.parameters[MAX_RISE] = 260, 200


def low(device: Device) -> None:
    device.inputs[IN_GLUCOSE] = 699


def suspended(device: Device) -> None:
    device.inputs[IN_LIMIT] = LIMIT_SUSPEND


def soon_low(device: Device) -> None:
    device.state[TREND], device.state[GLUCOSE_2], device.state[GLUCOSE] = 3, 1800, 1400


def held_at_the_schedule(device: Device) -> None:
    device.inputs[IN_LIMIT] = LIMIT_SCHEDULE


def no_sample(device: Device) -> None:
    device.inputs[IN_GLUCOSE], device.state[RATE] = -1, 300


CASES = [
    (largest_rate, 300, LIMITER_MAX_BASAL),
    (largest_factor, 300, LIMITER_MAX_BASAL),
    (on_board, 320, LIMITER_MAX_IOB),
    (total_of_a_day, 300, LIMITER_DAY),
    (rise, 300, LIMITER_RISE),
    (low, 0, LIMITER_LOW_GLUCOSE),
    (suspended, 0, LIMITER_LOW_GLUCOSE),
    (soon_low, SCHEDULE, LIMITER_LOW_GLUCOSE),
    (held_at_the_schedule, SCHEDULE, LIMITER_STALE_CGM),
    (no_sample, 300, LIMITER_STALE_CGM),
]


@pytest.mark.parametrize(("limit", "ceiling", "told"), CASES)
def test_a_limit_cuts_what_is_above_it_and_tells_only_of_a_cut(limit: Limit, ceiling: int, told: int) -> None:
    for demand, expected in ((ceiling, (ceiling, 0)), (ceiling + 2**-16, (ceiling, told)), (5000, (ceiling, told))):
        device = Device()
        limit(device)
        assert device.rate(demand) == expected
        assert device.state[RATE] == ceiling
        assert device.state[RATE_CARRY] == 0  # what was cut is not carried on


def test_without_a_limit_the_wire_holds_the_largest_rate() -> None:
    for demand, told in ((RATE_MAX, 0), (RATE_MAX + 2**-16, LIMITER_MAX_BASAL)):
        device = Device()
        device.parameters[BASAL] = 2000  # largest rate: 25.5 schedules
        assert device.rate(demand) == (RATE_MAX, told)


def test_every_limit_that_cuts_is_told() -> None:
    device = Device()
    device.parameters[MAX_BASAL] = 2500  # 500
    device.outputs[OUT_IOB] = 3990  # 440
    device.inputs[IN_INSULIN_LEFT] = 175  # 420
    device.state[RATE], device.parameters[MAX_RISE] = 300, 500  # 400
    device.inputs[IN_GLUCOSE] = -1  # 300
    assert device.rate(1000) == (
        300,
        LIMITER_MAX_BASAL | LIMITER_MAX_IOB | LIMITER_DAY | LIMITER_RISE | LIMITER_STALE_CGM,
    )


@pytest.mark.parametrize(
    ("limit", "rate", "told"),
    [
        (low, 0, LIMITER_LOW_GLUCOSE),
        (soon_low, SCHEDULE, LIMITER_LOW_GLUCOSE),
        (held_at_the_schedule, SCHEDULE, LIMITER_STALE_CGM),
    ],
)
def test_a_low_glucose_or_a_doubt_is_told_beside_the_limits(limit: Limit, rate: int, told: int) -> None:
    device = Device()
    largest_rate(device)
    limit(device)
    assert device.rate(1000) == (rate, LIMITER_MAX_BASAL | told)


def test_a_limit_that_is_no_lower_than_another_one_cuts_nothing_more() -> None:
    device = Device()
    for limit in (largest_rate, total_of_a_day, rise):
        limit(device)
    device.outputs[OUT_IOB], device.inputs[IN_OPEN] = 3995, 0
    device.parameters[MAX_BASAL] = 1600
    device.inputs[IN_INSULIN_LEFT] = 134  # 321
    assert device.rate(1000) == (300, LIMITER_MAX_BASAL | LIMITER_RISE)  # 320 on board is that of the largest rate


@pytest.mark.parametrize("limit", [total_of_a_day, rise, no_sample])
def test_of_two_equal_limits_the_first_is_told(limit: Limit) -> None:
    device = Device()
    largest_rate(device)
    limit(device)
    assert device.rate(1000) == (300, LIMITER_MAX_BASAL)


@pytest.mark.parametrize("limit", [soon_low, held_at_the_schedule])
def test_at_the_schedule_a_limit_down_to_the_schedule_tells_nothing(limit: Limit) -> None:
    device = Device()
    device.parameters[MAX_BASAL] = 0  # never more than the schedule
    limit(device)
    assert device.rate(1000) == (SCHEDULE, LIMITER_MAX_BASAL)


def test_a_bolus_of_the_step_uses_up_what_is_left() -> None:
    device = Device()
    on_board(device)
    assert device.rate(1000, bolus=2) == (SCHEDULE + 3 * 24, LIMITER_MAX_IOB)
    device = Device()
    total_of_a_day(device)
    assert device.rate(1000, bolus=10) == (60, LIMITER_DAY)
    device = Device()
    total_of_a_day(device)
    assert device.rate(1000, bolus=13) == (0, LIMITER_DAY)


@pytest.mark.parametrize("glucose", [0, 1])
def test_a_sample_of_nothing_is_a_sample(glucose: int) -> None:
    device = Device()
    device.inputs[IN_GLUCOSE] = glucose
    assert device.rate(1) == (0, LIMITER_LOW_GLUCOSE)
    device = Device()
    device.inputs[IN_GLUCOSE], device.parameters[LOW_SUSPEND] = glucose, 0
    assert device.rate(300) == (300, 0)


def test_the_smallest_demand_is_cut_and_told_when_glucose_is_low() -> None:
    device = Device()
    low(device)
    assert device.rate(0) == (0, 0)
    assert device.rate(2**-16) == (0, LIMITER_LOW_GLUCOSE)
    assert device.state[RATE_CARRY] == 0


def test_what_is_below_one_step_of_the_rate_is_carried_on() -> None:
    device = Device()
    assert [device.rate(10.375)[0] for _ in range(8)] == [10, 10, 11, 10, 10, 11, 10, 11]
