"""The checks of the command protocol: the reference passes each, and each can fail."""

from collections.abc import Iterator
from typing import Any

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from can_bus import codec
from firmware_sim import bolus, meals, pump
from firmware_sim.bolus import Boluses
from firmware_sim.ladder import Ladder
from plant_server import bolus as pump_bolus
from plant_server.set_point import SetPoint

ALARM_DOSE_REJECTED = codec.choice("CTRL_Alarm", "CtrlAlarmCode", "DoseRejected")
ALARM_UNCERTAIN = codec.choice("CTRL_Alarm", "CtrlAlarmCode", "DeliveryUncertain")


@pytest.mark.parametrize("requirement", [each.id for each in select(["CMD"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def without(alarm: int) -> Changed:
    """The reference, which never tells of this alarm."""

    def says(name: str, values: Values) -> Values | None:
        return None if name == "CTRL_Alarm" and values["CtrlAlarmCode"] == alarm else values

    return Changed(says=says)


# ---- CMD-01


def test_a_refusal_taken_for_an_agreement() -> None:
    def hears(name: str, values: Values) -> Values:
        return values | {"AckResult": 0} if name == "PUMP_Ack" else values

    expect_failed("CMD-01", "a Commit only after an Accepted Program", Changed(hears))


def test_an_echo_that_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    advance = Boluses._advance
    monkeypatch.setattr(Boluses, "_advance", lambda self, drug, it, result, _: advance(self, drug, it, result, it.dose))
    expect_failed("CMD-01", "with the echo", None)


def test_an_answer_of_another_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    def hear(self: Boluses, values: Values) -> None:
        for each in self._open.values():
            if values["AckId"] == each.number and values["AckFor"] in bolus.ACKS:
                each.ack = (values["AckResult"], values["AckEchoRaw"])

    monkeypatch.setattr(Boluses, "hear_ack", hear)
    expect_failed("CMD-01", "a Commit only after an Accepted Program")


def test_an_answer_to_program_that_confirms_the_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Boluses, "uncertain", False)
    expect_failed("CMD-01", "comes again in place of that to Commit")


# ---- CMD-02


def test_too_many_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bolus, "SENDS", 4)
    expect_failed("CMD-02", "at most 3 times")


def test_a_retry_with_another_expiry() -> None:
    seen: set[tuple[int, int]] = set()

    def says(name: str, values: Values) -> Values:
        if name != "PUMP_BolusCmd":
            return values
        again = (values["BolusId"], values["BolusOp"]) in seen
        seen.add((values["BolusId"], values["BolusOp"]))
        return values | {"BolusUntilStep": values["BolusUntilStep"] + again}

    expect_failed("CMD-02", "whenever it is said", Changed(says=says))


def test_ids_that_begin_anew_with_the_power(monkeypatch: pytest.MonkeyPatch) -> None:
    restore = Boluses.restore

    def forgetful(self: Boluses, words: Iterator[int]) -> None:
        restore(self, words)
        self.next_id = 0

    monkeypatch.setattr(Boluses, "restore", forgetful)
    expect_failed("CMD-02", "of BolusId 0 whenever it is said")


# ---- CMD-03, CMD-04: the pump


def test_a_pump_that_begins_an_id_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pump_bolus, "_is_older", lambda *_: False)
    expect_failed("CMD-03", "no BolusId begun twice")


def test_a_pump_that_gives_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = pump_bolus.mechanism.begin_bolus
    monkeypatch.setattr(pump_bolus.mechanism, "begin_bolus", lambda words, strokes: begin(words, strokes + 1))
    expect_failed("CMD-03", "strokes that were programmed")


def test_a_pump_that_knows_no_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    judge = pump_bolus.DrugBolus.judge

    def timeless(self: Any, op: int, number: int, dose: int, _until: int, step: int, *, ready: bool) -> Any:
        return judge(self, op, number, dose, step, step, ready=ready)

    monkeypatch.setattr(pump_bolus.DrugBolus, "judge", timeless)
    expect_failed("CMD-04", "steps after its expiry")


def test_a_device_that_lets_a_bolus_live_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bolus, "EXPIRES_AFTER", 3)
    expect_failed("CMD-04", "expires 0..2 steps ahead; 3 came")


# ---- CMD-05, CMD-06


def test_doubt_that_comes_a_step_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ladder, "doubt", lambda _: None)
    expect_failed("CMD-05", "DeliveryUncertain once nothing has come")


def test_doubt_that_nobody_is_told_of() -> None:
    expect_failed("CMD-05", "the alarm DeliveryUncertain", without(ALARM_UNCERTAIN))


def test_doubt_that_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    open_step = Boluses.open_step

    def forget(self: Boluses, step: int) -> Any:
        self._open.clear()
        return open_step(self, step)

    monkeypatch.setattr(Boluses, "open_step", forget)
    expect_failed("CMD-05", "no other bolus before the pump has told")


def test_insulin_on_board_without_the_bolus_in_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Boluses, "remaining", lambda *_: 0)
    expect_failed("CMD-06", "InsulinOnBoard of at least")


def test_insulin_on_board_that_keeps_what_was_never_given() -> None:
    def hears(name: str, values: Values) -> Values:
        aborted = name == "PUMP_BolusState" and values["BolusPhase"] == bolus.Phase.ABORTED
        return values | {"BolusPhase": bolus.Phase.DELIVERING} if aborted else values

    expect_failed("CMD-06", "as after a bolus of the 50 that were given", Changed(hears))


# ---- CMD-07


def test_a_refusal_that_is_not_heard() -> None:
    def hears(name: str, values: Values) -> Values | None:
        return None if name == "PUMP_Ack" and values["AckResult"] in (3, 4, 5, 7) else values

    expect_failed("CMD-07", "nothing more of a bolus that was refused", Changed(hears))


def test_a_limit_of_the_pump_that_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bolus, "accepted_limit", lambda _ack, limit: limit)
    expect_failed("CMD-07", "within the limit of raw 80")


def test_a_refusal_that_nobody_is_told_of() -> None:
    expect_failed("CMD-07", "the alarm DoseRejected", without(ALARM_DOSE_REJECTED))


# ---- CMD-08, CMD-09


def test_a_set_point_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pump, "RATE_EXPIRES_AFTER", 25)
    expect_failed("CMD-08", "1..24 steps ahead; 25 came")


def test_a_set_point_that_is_not_renewed(monkeypatch: pytest.MonkeyPatch) -> None:
    command = pump.Pump.command

    def seldom(self: pump.Pump, turn: Any, op: pump.Op, step: int, *rates: int) -> bool:
        return step % 8 == 0 and command(self, turn, op, step, *rates)

    monkeypatch.setattr(pump.Pump, "command", seldom)
    expect_failed("CMD-08", "a set-point at least every 6 steps")


def test_a_pump_that_goes_on_beyond_the_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SetPoint, "expire", lambda *_: None)
    expect_failed("CMD-08", "TbrActive 0 2 steps on")


def test_a_pump_that_keeps_pramlintide_beyond_the_expiry(monkeypatch: pytest.MonkeyPatch) -> None:
    def fall_back(self: SetPoint) -> None:
        self.commanded = False
        self.rate = self._schedule

    monkeypatch.setattr(SetPoint, "fall_back", fall_back)
    expect_failed("CMD-08", "the schedule and no pramlintide")


def test_a_set_point_that_is_not_looked_after() -> None:
    def hears(name: str, values: Values) -> Values:
        return values | {"PumpLastBasalSeq": 1023} if name == "PUMP_Status" else values

    expect_failed("CMD-09", "the alarm DeliveryUncertain or PumpLost", Changed(hears))


def test_a_set_point_that_is_not_said_again() -> None:
    said: list[Values] = []

    def says(name: str, values: Values) -> Values | None:
        if name == "PUMP_BasalCmd":
            said.append(values)
        return None if name == "PUMP_BasalCmd" and len(said) > 13 else values

    expect_failed("CMD-09", "no PUMP_BasalCmd came", Changed(says=says))


# ---- CMD-10


def test_a_meal_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meals, "CARBS_MAX", 1000)
    expect_failed("CMD-10", "no bolus for a meal of 400 g in mode ma")


def test_a_refused_meal_that_nobody_is_told_of() -> None:
    expect_failed("CMD-10", "the alarm DoseRejected for a meal of 400 g", without(ALARM_DOSE_REJECTED))


def test_half_a_meal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Boluses, "_must_wait", lambda *_: False)
    monkeypatch.setattr(Boluses, "listen", Boluses._listen)
    expect_failed("CMD-10", "no pramlintide for a meal whose insulin the pump refused in mode s3")
