"""The checks of the limits: the reference passes each, and each can fail."""

from collections.abc import Callable
from typing import Any

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from can_bus.codec import message
from firmware_sim import calibration, firmware
from firmware_sim.alarms import Alarms, Code
from firmware_sim.calibration import Calibration
from firmware_sim.control import core, layout, limits
from firmware_sim.day import Day
from firmware_sim.delivery import Delivery
from firmware_sim.pump import Op
from firmware_sim.pump import Pump as PumpSeen
from firmware_sim.selftest import Failure
from plant_server.bolus import AckResult, DrugBolus
from plant_server.set_point import SetPoint


@pytest.mark.parametrize("requirement", [each.id for each in select(["LIM"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


@pytest.fixture(autouse=True)
def _no_self_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would find that the control law is not the one that was built."""
    monkeypatch.setattr(firmware, "check_program", lambda: Failure.NONE)


def believing(monkeypatch: pytest.MonkeyPatch, limit: str, **parameters: int) -> None:
    """The control law applies one of its limits with other parameters than were flashed."""
    original: Callable[..., int] = getattr(core, limit)

    def wrong(*arguments: Any) -> int:
        *before, flashed, inputs, outputs = arguments
        changed = list(flashed)
        for name, raw in parameters.items():
            changed[getattr(layout, name)] = raw
        return original(*before, changed, inputs, outputs)

    monkeypatch.setattr(core, limit, wrong)


@pytest.mark.parametrize(
    ("requirement", "limit", "parameters", "text"),
    [
        ("LIM-01", "limit_rate", {"BASAL_FACTOR": 255}, "with CfgMaxBasal 30000"),
        ("LIM-01", "limit_rate", {"MAX_BASAL": 30000}, "with CfgMaxBasal 2850"),
        ("LIM-02", "limit_bolus", {"MAX_BOLUS": 4000}, "insulin of at most raw 203 in mode ma"),
        ("LIM-02", "limit_pram_bolus", {"PRAM_BOLUS": 4000}, "pramlintide of at most raw 17 in mode s4"),
        ("LIM-03", "limit_rate", {"MAX_IOB": 4000}, "at most the schedule with InsulinOnBoard"),
        ("LIM-03", "limit_bolus", {"MAX_IOB": 4000}, "InsulinOnBoard of at most 200"),
        ("LIM-07", "limit_bolus", {"BOLUS_LOCKOUT": 0}, "boluses of insulin at least 3 steps apart in mode ma"),
        ("LIM-08", "limit_rate", {"MAX_RISE": 60000}, "a rise of the rate by at most 400"),
    ],
)
def test_a_limit_of_another_size(
    monkeypatch: pytest.MonkeyPatch, requirement: str, limit: str, parameters: dict[str, int], text: str
) -> None:
    believing(monkeypatch, limit, **parameters)
    expect_failed(requirement, text)


def test_insulin_on_board_that_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(core, "insulin_on_board", lambda *_: 0)
    expect_failed("LIM-03", "more than 3 U on board")


# ---- LIM-04


@pytest.mark.parametrize(
    ("name", "raw", "text"),
    [
        ("CfgMaxBasal", 30000, "at most the schedule with CfgMaxBasal not set"),
        ("CfgMaxIob", 4000, "at most the schedule with CfgMaxIob not set"),
        ("CfgMaxBolus", 3000, "no bolus with CfgMaxBolus not set"),
    ],
)
def test_a_limit_that_is_loose_unless_set(monkeypatch: pytest.MonkeyPatch, name: str, raw: int, text: str) -> None:
    monkeypatch.setattr(calibration, "NEEDED", ())  # the reference would not start
    monkeypatch.setitem(calibration.UNSET, name, raw)
    expect_failed("LIM-04", text)


def test_a_limit_that_an_invalid_value_lifts(monkeypatch: pytest.MonkeyPatch) -> None:
    store = Calibration.store
    monkeypatch.setattr(calibration, "NEEDED", ())  # the reference would not start
    monkeypatch.setitem(calibration.UNSET, "CfgMaxBasal", 0)  # so that it is put back afterwards

    def lifted(self: Calibration, values: Values) -> Values:
        if values.get("CfgMaxBasal", 0) > message("CFG_Param").fields["CfgMaxBasal"].high:
            calibration.UNSET["CfgMaxBasal"] = 60000
        return store(self, values)

    monkeypatch.setattr(Calibration, "store", lifted)
    expect_failed("LIM-04", "at most the schedule with CfgMaxBasal out of range")


# ---- LIM-05


def test_a_low_that_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "low", lambda *_: False)
    expect_failed("LIM-05", "no insulin at 69")


def test_a_low_that_is_not_foreseen_at_a_meal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "soon_low", lambda *_: False)
    expect_failed("LIM-05", "no bolus while a low is predicted")


def test_a_low_that_is_not_foreseen_by_a_law_that_asks_for_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "soon_low", lambda *_: False)
    monkeypatch.setattr(core, "meal_insulin", lambda *_: 100 << 16)
    expect_failed("LIM-05", "at most the schedule before a low")


# ---- LIM-06


@pytest.mark.parametrize(("left", "text"), [("insulin_left", "6000 mU"), ("pram_left", "1000 ug of pramlintide")])
def test_a_day_without_end(monkeypatch: pytest.MonkeyPatch, left: str, text: str) -> None:
    monkeypatch.setattr(Delivery, left, lambda *_: 1 << 24)
    expect_failed("LIM-06", text)


def test_a_day_that_a_reset_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    restore = Day.restore

    def forgetful(self: Day, words: Any) -> None:
        restore(self, words)
        self.__init__()  # type: ignore[misc]

    monkeypatch.setattr(Day, "restore", forgetful)
    expect_failed("LIM-06", "at most 6000 mU of insulin in 24 h")


# ---- LIM-08


def test_a_fall_that_is_slowed(monkeypatch: pytest.MonkeyPatch) -> None:
    last = [0]
    command = PumpSeen.command

    def slow(self: PumpSeen, turn: Any, op: Op, step: int, rate: int = 0, pramlintide: int = 0) -> bool:
        last[0] = max(rate, last[0] - 400) if op == Op.SET_RATE else 0
        return command(self, turn, op, step, last[0], pramlintide)

    monkeypatch.setattr(PumpSeen, "command", slow)
    expect_failed("LIM-08", "no insulin at 65 mg/dL at once")


def test_a_suspension_that_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    command = PumpSeen.command

    def waiting(self: PumpSeen, turn: Any, op: Op, step: int, *rates: int) -> bool:
        return command(self, turn, Op.RESUME_SCHEDULE if op == Op.SUSPEND else op, step, *rates)

    monkeypatch.setattr(PumpSeen, "command", waiting)
    expect_failed("LIM-08", "in the step in which the user suspends")


def bits(change: Callable[[int], int]) -> Changed:
    """The reference with other LimiterBits than its own."""

    def says(name: str, values: Values) -> Values:
        return values | {"LimiterBits": change(values["LimiterBits"])} if name == "CTRL_Status" else values

    return Changed(says=says)


def test_a_bit_of_the_rise_that_stays() -> None:
    expect_failed("LIM-08", "for a rise only", bits(lambda found: found | 128))


# ---- LIM-09


@pytest.mark.parametrize("bit", [0, 1, 2, 3, 5, 6, 7])
def test_a_cut_without_its_bit(bit: int) -> None:
    expect_failed("LIM-09", f"bit {bit} of LimiterBits", bits(lambda found: found & ~(1 << bit)))


def test_a_cut_without_its_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    hold = Alarms.hold
    monkeypatch.setattr(
        Alarms, "hold", lambda self, code, cause, aux: hold(self, code, cause and code != Code.DOSE_LIMITED, aux)
    )
    expect_failed("LIM-09", "DoseLimited pending")


def test_a_cut_that_is_told_again_and_again() -> None:
    number = iter(range(1000))

    def says(name: str, values: Values) -> Values:
        return values | {"CtrlAlarmInstance": next(number)} if name == "CTRL_Alarm" else values

    expect_failed("LIM-09", "one alarm DoseLimited", Changed(says=says))


# ---- LIM-10: the pump


def test_a_pump_that_takes_any_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SetPoint, "_judge_rate", staticmethod(lambda *_: AckResult.ACCEPTED))
    expect_failed("LIM-10", "AckResult OverLimit to InsulinRate 6001")


def test_a_pump_that_takes_any_bolus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrugBolus, "limit_raw", 4095)
    expect_failed("LIM-10", "AckResult OverLimit to InsulinBolus 3001")


def test_a_pump_that_refuses_and_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    obey = SetPoint._obey

    def obliging(self: SetPoint, values: Values, step: int, _results: Any) -> None:
        obey(self, values, step, (AckResult.ACCEPTED, AckResult.ACCEPTED))

    monkeypatch.setattr(SetPoint, "_obey", obliging)
    expect_failed("LIM-10", "2 strokes with InsulinRate refused")
