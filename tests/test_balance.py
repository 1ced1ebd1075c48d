"""What was asked for against what the totals say: a motor that slips or runs away is told of, a sound one never."""

import pytest
from bench import GLUCOSE, NMA, Bench
from pumpbench import faults
from pumpbench.bench import Outcome, run

from firmware_sim.alarms import Code
from firmware_sim.balance import Balance


def test_a_rate_in_whole_strokes_is_never_off() -> None:
    balance, accumulated = Balance(500), 0
    for _ in range(5000):
        accumulated += 1267  # 0.001 U/h; a stroke is 50 mU
        strokes, accumulated = divmod(accumulated, 600)
        balance.account(1267, 0, 50 * strokes)
        assert not balance.off(0)


@pytest.mark.parametrize(("per_step", "off_after"), [(50, 11), (-50, 11), (501, 1), (-501, 1), (500, 2)])
def test_ten_strokes_are_the_limit_either_way(per_step: int, off_after: int) -> None:
    balance = Balance(500)
    found = []
    for _ in range(12):
        balance.account(1200, 0, 100 + per_step)
        found.append(balance.off(0))
    assert found.index(True) + 1 == off_after


def test_a_bolus_under_way_may_be_given_before_it_is_told() -> None:
    balance = Balance(500)
    balance.account(0, 0, 3000)
    assert not balance.off(2500) and balance.off(2499)
    balance.account(0, 3000, 0)
    assert not balance.off(0)


def test_a_reset_forgets() -> None:
    balance = Balance(500)
    balance.account(0, 0, 501)
    assert balance.off(0)
    for _ in range(2):
        balance.reset()
        balance.account(1, 0, 501)  # a twelfth of a unit below 501
        assert not balance.off(0)
        balance.account(11, 0, 1)
        assert balance.off(0)


def test_it_begins_with_nothing() -> None:
    balance = Balance(500)
    balance.account(1, 0, 501)
    assert not balance.off(0)


# ---- on the device


def uncertain(bench: Bench, error: int, steps: int) -> int:
    """Steps until DeliveryUncertain when the pump gives so many mU more than it is asked for in each; 0 never."""
    for k in range(1, steps + 1):
        bench.total += 12 * error
        if bench.step(GLUCOSE).alarms(Code.DELIVERY_UNCERTAIN):
            return k
    return 0


@pytest.mark.parametrize(("error", "after"), [(0, 0), (50, 11), (600, 1), (2, 0)])
def test_a_pump_that_gives_more_than_it_is_asked_for(error: int, after: int) -> None:
    bench = Bench(mode=NMA)
    bench.run(5)
    assert uncertain(bench, error, 40) == after
    assert bench.step().state.name == "AUTO"  # it tells, and doses by what the totals say


def test_a_gap_in_the_totals_is_no_difference() -> None:
    bench = Bench(mode=NMA)
    bench.run(5)
    bench.total += 12 * 400
    assert not bench.step().alarms(Code.DELIVERY_UNCERTAIN)
    bench.step(totals=False)
    bench.total += 12 * 400  # nobody knows when
    assert not bench.step().alarms(Code.DELIVERY_UNCERTAIN)
    bench.total += 12 * 400
    assert not bench.step().alarms(Code.DELIVERY_UNCERTAIN)
    bench.total += 12 * 200
    assert bench.step().alarms(Code.DELIVERY_UNCERTAIN)


def test_a_bolus_that_ends_before_it_is_whole_is_held_against_the_pump() -> None:
    """Air in a bolus: the pump tells of less than was programmed, and of nothing else (found by the matrix)."""
    air = faults.air_bubble("insulin", 20, start="02:00")
    outcome = bench_run(strategy="s3", patient="adult#004", seed=14, faults=[air])
    outcome.assert_alarm("DeliveryUncertain", after="02:00", within="02:00")
    outcome.assert_ledger_closes()


def test_a_bolus_short_of_a_stroke_is_whole() -> None:
    """Doses are in 0.01 U, strokes in 0.05: what is missing of many boluses never adds up to an alarm."""
    outcome = bench_run(strategy="sma", patient="adult#004", hours=24 * 14, scenario="validation-14d")
    assert [event.code for event in outcome.raised(node="CTRL")] == ["StateChange"]  # the end of Init is told


def bench_run(**keys: object) -> Outcome:
    return run(**({"scenario": "six-hours", "hours": 6} | keys))  # type: ignore[arg-type]
