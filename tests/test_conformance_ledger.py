"""The checks of the delivery ledger: the reference passes each, and each can fail."""

from typing import Any

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from firmware_sim.bolus import Boluses, Phase
from firmware_sim.control.fixed import round_divide
from firmware_sim.pump import Pump
from plant_server import mechanism, server


@pytest.mark.parametrize("requirement", [each.id for each in select(["LED"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


# ---- LED-01: the pump


def test_a_ledger_that_is_told_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = server._ledger

    def one_less(words: mechanism.Words) -> tuple[int, int, int]:
        commanded, pending, lost = ledger(words)
        return commanded, pending, max(lost - 1, 0)

    monkeypatch.setattr(server, "_ledger", one_less)
    expect_failed("LED-01", "commanded = delivered + pending + lost of TruthInsulin")


def test_strokes_that_vanish(monkeypatch: pytest.MonkeyPatch) -> None:
    def lose_held(words: mechanism.Words) -> None:
        words[mechanism.PENDING] -= words[mechanism.HELD]
        words[mechanism.HELD] = words[mechanism.BOLUS_HELD] = 0

    monkeypatch.setattr(mechanism, "lose_held", lose_held)
    expect_failed("LED-01", "the pump's ledger does not close in step 10")


# ---- LED-02, LED-03: totals


def by_command(self: Pump, _totals: Values | None, step: int, basal: int, _bolus: int = 0) -> int:
    self._totals_step = step
    return round_divide(basal if self._commanded_rate is None else self._commanded_rate * 5, 12)


def test_insulin_on_board_of_what_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pump, "delivered", by_command)
    expect_failed("LED-02", "while the pump gives nothing")


def test_a_schedule_that_is_caught_up_in_the_books(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was missed for an hour is booked when the totals move again."""
    delivered, missed = Pump.delivered, [0]

    def with_what_was_missed(self: Pump, totals: Values | None, step: int, basal: int, bolus: int = 0) -> int:
        given = delivered(self, totals, step, basal, bolus)
        if given == 0:
            missed[0] += basal // 12
            return 0
        booked, missed[0] = missed[0], 0
        return given + booked

    monkeypatch.setattr(Pump, "delivered", with_what_was_missed)
    expect_failed("LED-02", "nothing on board of a schedule that was missed")


def test_insulin_nobody_asked_for_that_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    delivered = Pump.delivered
    monkeypatch.setattr(Pump, "delivered", lambda self, *told: min(delivered(self, *told), 1000))
    expect_failed("LED-02", "once 2 U came unasked")


def test_a_total_that_falls_and_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one then counts everything once more."""
    monkeypatch.setattr(Pump, "_believable", lambda *_: True)
    monkeypatch.setattr(Pump, "fallen", True)
    expect_failed("LED-03", "after a total that fell without a reset")


def test_a_total_that_falls_and_nobody_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pump, "fallen", False)
    expect_failed("LED-03", "an alarm for a total that fell")


def test_a_pump_that_resets_and_is_not_believed() -> None:
    def hears(name: str, values: Values) -> Values:
        return values | {"PumpBootCount": 0} if name == "PUMP_Delivered" else values

    expect_failed("LED-03", "after a reset of the pump", Changed(hears))


def test_what_a_bolus_gave_before_a_reset_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    def hears(name: str, values: Values) -> Values:
        aborted = name == "PUMP_BolusState" and values["BolusPhase"] == Phase.ABORTED
        return values | {"BolusPhase": Phase.DELIVERING} if aborted else values

    expect_failed("LED-03", "a reset of the pump that had made 100 of a bolus", Changed(hears))


# ---- LED-04


def test_a_bolus_broken_off_that_counts_in_full() -> None:
    def hears(name: str, values: Values) -> Values:
        aborted = name == "PUMP_BolusState" and values["BolusPhase"] == Phase.ABORTED
        return values | {"BolusPhase": Phase.DELIVERING} if aborted else values

    expect_failed("LED-04", "that was acknowledged was broken off at 50", Changed(hears))


def test_a_bolus_broken_off_that_counts_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once by the totals, and once by PUMP_BolusState."""
    delivered = Pump.delivered

    def twice(self: Pump, totals: Any, step: int, basal: int, bolus: int = 0) -> int:
        return delivered(self, totals, step, basal, bolus) + bolus

    monkeypatch.setattr(Pump, "delivered", twice)
    expect_failed("LED-04", "InsulinOnBoard of about 50 (0.01 U) after a bolus of it")


def test_a_bolus_in_doubt_that_never_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    follow = Boluses._follow

    def unless_in_doubt(self: Boluses, drug: Any, bolus: Any, state: Values, delivered: Any) -> None:
        if not bolus.uncertain:
            follow(self, drug, bolus, state, delivered)

    monkeypatch.setattr(Boluses, "_follow", unless_in_doubt)
    expect_failed("LED-04", "with its acknowledgements lost")
