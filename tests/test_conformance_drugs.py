"""The checks of two drugs: the reference passes each, and each can fail."""

import pytest
from conformance_devices import Change, Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from firmware_sim import pump
from firmware_sim.bolus import ACKS, Boluses, Op
from firmware_sim.ladder import Ladder, State
from firmware_sim.meals import Meals
from firmware_sim.pump import Pump


@pytest.mark.parametrize("requirement", [each.id for each in select(["TWO"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def with_rates(change: Change) -> Changed:
    """The reference, whose set-points are changed on their way out."""

    def says(name: str, values: Values) -> Values | None:
        sets = name == "PUMP_BasalCmd" and values["BasalOp"] == pump.Op.SET_RATE
        return change(name, values) if sets else values

    return Changed(says=says)


def test_pramlintide_without_insulin() -> None:
    alone = with_rates(lambda _, values: values | ({"PramlintideRate": 50} if values["InsulinRate"] == 0 else {}))
    expect_failed("TWO-01", "no pramlintide without insulin", alone)


def test_pramlintide_for_a_meal_without_a_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ladder, "_next_rung", lambda *_: State.AUTO)
    expect_failed("TWO-01", "no bolus of pramlintide while the sensor is lost in mode s3")


def test_a_bolus_of_pramlintide_at_65() -> None:
    def hears(name: str, values: Values) -> Values:
        low = name == "CGM_Reading" and values["GlucoseConc"] < 700
        return values | {"GlucoseConc": values["GlucoseConc"] + 300} if low else values

    expect_failed("TWO-03", "no bolus of pramlintide below 70", Changed(hears))


def test_a_ratio_that_is_off_by_two() -> None:
    more = with_rates(lambda _, values: values | {"PramlintideRate": values["PramlintideRate"] + 2})
    expect_failed("TWO-02", "ug/U of raw", more)


def test_boluses_of_pramlintide_in_a_mode_without() -> None:
    def hears(name: str, values: Values) -> Values:
        return values | {"ModeRequest": 7} if name == "MODE_Cmd" and values["ModeRequest"] == 4 else values

    def says(name: str, values: Values) -> Values:
        return values | {"CtrlMode": 4} if name == "CTRL_Status" and values["CtrlMode"] == 7 else values

    expect_failed("TWO-03", "at most 0 boluses of pramlintide for 3 meals in mode sma", Changed(hears, says))


def test_a_meal_that_is_dosed_as_often_as_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    hear = Meals.hear

    def anew(self: Meals, values: Values) -> None:
        self.last = None
        hear(self, values)

    monkeypatch.setattr(Meals, "hear", anew)
    expect_failed("TWO-03", "at most 3 boluses of pramlintide for 3 meals in mode s3")


def test_sugar_that_is_dosed_like_a_meal() -> None:
    def hears(name: str, values: Values) -> Values:
        kinds = {3: 4, 4: 3}  # instead of the snack
        return (
            values | {"MealKind": kinds.get(values["MealKind"], values["MealKind"])}
            if name == "MEAL_Announce"
            else values
        )

    expect_failed("TWO-03", "one bolus of pramlintide at most after each meal told", Changed(hears))


def test_a_meal_that_gets_nothing_because_one_drug_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    listen = Boluses.listen

    def both(self: Boluses) -> None:
        refused = self.refused
        listen(self)
        for each in self._open.values():
            each.op = Op.CANCEL if self.refused > refused else each.op

    monkeypatch.setattr(Boluses, "listen", both)
    monkeypatch.setattr(Pump, "pram_blocked", property(lambda _: False, lambda *_: None), raising=False)
    expect_failed("TWO-04", "in mode s3; (0, 0) were committed with pramlintide stopped")


def test_a_blocked_line_of_pramlintide_that_stops_insulin(monkeypatch: pytest.MonkeyPatch) -> None:
    status = Pump.status

    def both(self: Pump, values: Values, step: int) -> None:
        status(self, values, step)
        if self.pram_blocked:
            self.rate_limit = 0

    monkeypatch.setattr(Pump, "status", both)
    expect_failed("TWO-04", "insulin goes on with PramOcclusion=2")


def test_pramlintide_beside_a_blocked_line_of_insulin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pump, "insulin_blocked", property(lambda _: False, lambda *_: None), raising=False)
    expect_failed("TWO-04", "no pramlintide with InsulinOcclusion=2")


def test_answers_that_are_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pump, "pram_unanswered", False)
    expect_failed("TWO-05", "after its answers stopped")


def test_an_echo_that_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    advance = Boluses._advance
    monkeypatch.setattr(Boluses, "_advance", lambda self, drug, it, result, _: advance(self, drug, it, result, it.dose))
    expect_failed("TWO-06", "no Commit of a bolus in InsulinBolus whose echo is 10 times")


def test_an_answer_for_pramlintide_that_is_missing_stops_it_until_one_comes() -> None:
    device = Pump()

    class Wire:
        def send(self, _name: str, **_values: int) -> None: ...

    def command() -> None:
        device.command(Wire(), pump.Op.SET_RATE, 7, 240, 120)  # type: ignore[arg-type]

    command()
    assert not device.pram_unanswered  # a pump that never answers is not asked for it
    for purpose, echo in ((1, 240), (8, 120)):
        assert device.pram_unanswered == (purpose == 8)
        device.hear_ack(
            {"AckFor": purpose, "AckResult": 0, "AckId": device._sequence, "AckEchoRaw": echo, "AckLimitRaw": 8000}
        )
    assert not device.pram_unanswered
    command()
    assert device.pram_unanswered


def test_an_answer_for_the_other_drug_that_is_taken_for_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    def hear(self: Boluses, values: Values) -> None:
        for each in self._open.values():
            if values["AckId"] == each.number and values["AckFor"] in ACKS:
                each.ack = (values["AckResult"], values["AckEchoRaw"])

    monkeypatch.setattr(Boluses, "hear_ack", hear)
    expect_failed("TWO-06", "no Commit of a bolus that the pump took for the other drug's")
