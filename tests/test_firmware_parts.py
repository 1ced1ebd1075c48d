"""The small parts of the firmware by themselves, at the edges that whole runs seldom meet."""

import pytest
from test_pump_protocol import BASAL, command

from firmware_sim.allowance import insulin_left, pram_left
from firmware_sim.bolus import Boluses
from firmware_sim.caution import RESETS_KEPT, RESETS_WITHIN, Caution
from firmware_sim.delivery import Delivery
from firmware_sim.pump import Op, Pump
from firmware_sim.wire import ALARM_HOLD, Wire


@pytest.mark.parametrize(
    ("tdd", "delivered", "under_way", "left"),
    [
        (2500, 0, 0, 50_000),  # twice 25 U, in mU
        (2500, 12_345, 0, 37_655),
        (2500, 12_345, 230, 35_355),
        (2500, 49_999, 0, 1),
        (2500, 50_000, 0, 0),
        (2500, 49_000, 101, 0),
        (0, 0, 0, 0),
    ],
)
def test_what_is_left_of_insulin_for_24_hours(tdd: int, delivered: int, under_way: int, left: int) -> None:
    assert insulin_left(tdd, delivered, under_way) == left


@pytest.mark.parametrize(
    ("tdd", "delivered", "under_way", "left"),
    [(1200, 0, 0, 1200), (1200, 5550, 0, 645), (1200, 5550, 300, 345), (1200, 11_990, 0, 1), (1200, 11_990, 2, 0)],
)
def test_what_is_left_of_pramlintide_for_24_hours(tdd: int, delivered: int, under_way: int, left: int) -> None:
    assert pram_left(tdd, delivered, under_way) == left


@pytest.mark.parametrize("begin", [0, 100, 500_000])
@pytest.mark.parametrize(("last", "held"), [(RESETS_WITHIN - 1, True), (RESETS_WITHIN, False)])
def test_five_resets_within_an_hour_hold_the_schedule(begin: int, last: int, held: bool) -> None:
    caution = Caution()
    for step in (*range(RESETS_KEPT - 1), last):
        assert not caution.held
        caution.count_reset(begin + step)
    assert caution.held == held
    caution.resume()
    caution.count_reset(begin + last)
    assert caution.held is False


def test_a_missing_total_counts_as_the_schedule_where_the_pump_was_left_to_it() -> None:
    pump = Pump()
    delivery = Delivery(pump, Boluses())
    delivery.update({"PumpBootCount": 0, "InsulinTotal": 500, "PramTotal": 0}, 0, BASAL, 0)
    command(pump, Op.RESUME_SCHEDULE)
    delivery.update(None, 1, BASAL, 0)
    assert delivery.insulin == 119


def test_every_impostor_is_an_error_and_holds_the_alarm() -> None:
    wire = Wire()
    assert wire.alone(0)
    for number in (1, 2, 3):
        wire.impostor()
        assert wire.e2e_errors == number
    wire.close(7)
    assert [wire.alone(7 + steps) for steps in range(ALARM_HOLD + 1)] == [False] * ALARM_HOLD + [True]
