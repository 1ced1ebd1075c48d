"""The checks of user input and configuration: the reference passes each, and each can fail."""

from collections.abc import Iterator
from typing import Any

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select
from test_conformance_numbers import of
from test_conformance_reset import forget, hasty

from firmware_sim import allowance, calibration, ladder, meals, user
from firmware_sim.bolus import Boluses, Op
from firmware_sim.firmware import Firmware
from firmware_sim.meals import Meals


@pytest.mark.parametrize("requirement", [each.id for each in select(["USR"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


# ---- meals


def test_a_meal_that_acts_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Meals.hear

    def forgetful(self: Meals, values: Values) -> None:
        self.last = None
        as_it_is(self, values)

    monkeypatch.setattr(Meals, "hear", forgetful)
    expect_failed("USR-01", "one insulin bolus for one meal however often it is told")


def test_a_meal_that_acts_again_after_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    forget(monkeypatch, Firmware, "_restore", hasty)
    expect_failed("USR-01", "one insulin bolus for one meal with a restart between")


def test_a_meal_without_an_echo() -> None:
    device = Changed(says=of("CTRL_Status", "LastMealId", lambda _: 255))
    expect_failed("USR-01", "LastMealId 0 from step 11 on however often it is told", device)


@pytest.mark.parametrize(
    ("limit", "value", "text"),
    [
        ("CARBS_MAX", 301, "no bolus for a meal with CarbsEst 301"),
        ("CARBS_MAX", 299, "a bolus for a meal with {'CarbsEst': 300}"),
        ("OFFSET_MAX", 127, "no bolus for a meal with MealOffset 61"),
        ("OFFSET_MAX", 59, "a bolus for a meal with {'MealOffset': 60}"),
    ],
)
def test_meals_that_cannot_be(monkeypatch: pytest.MonkeyPatch, limit: str, value: int, text: str) -> None:
    monkeypatch.setattr(meals, limit, value)
    expect_failed("USR-02", text)


def test_a_refusal_that_is_not_told() -> None:
    device = Changed(says=of("CTRL_Alarm", "CtrlAlarmCode", lambda code: 10 if code == 11 else code))
    expect_failed("USR-02", "the alarm DoseRejected for a meal with CarbsEst 301", device)


def test_sugar_taken_for_a_meal() -> None:
    device = Changed(of("MEAL_Announce", "MealKind", lambda kind: 1 if kind == 4 else kind))
    expect_failed("USR-03", "no bolus for HypoTreatment", device)


def test_sugar_without_an_echo() -> None:
    device = Changed(says=of("CTRL_Status", "LastMealId", lambda _: 255))
    expect_failed("USR-03", "LastMealId 0, heard; 255 came", device)


@pytest.mark.parametrize("number", [0, 1])
def test_a_user_who_cancels_in_vain(number: int) -> None:
    def deaf(name: str, values: Values) -> Values | None:
        cancelled = name == "MEAL_Announce" and values["MealKind"] == 5 and values["MealId"] == number
        return None if cancelled else values

    expect_failed("USR-03", f"no bolus for a meal that is cancelled in its step, with MealId {number}", Changed(deaf))


def test_an_answer_that_comes_after_the_cancel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Boluses, "_follow", lambda _self, _drug, bolus, *_: setattr(bolus, "op", Op.COMMIT))
    expect_failed("USR-03", "no bolus for a meal that is cancelled before the pump's answer has come")


# ---- modes


def test_modes_that_nobody_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user, "SUPPORTED_MODES", tuple(range(16)))
    expect_failed("USR-04", "CtrlMode [8] after ModeRequest 9; 9 came")


@pytest.mark.parametrize(
    ("number", "text"), [(4, "CtrlMode 2 after a MODE_Cmd 4"), (255, "CtrlMode 2 after a MODE_Cmd 255")]
)
def test_old_commands(number: int, text: str) -> None:
    device = Changed(of("MODE_Cmd", "ModeCmdSeq", lambda given: 6 if given == number else given))
    expect_failed("USR-04", text, device)


def test_a_suspension_by_an_old_command(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Firmware._on_mode_cmd

    def careless(self: Firmware, values: Values) -> None:
        self._user.suspended = values["SuspendRequest"] == 1
        as_it_is(self, values)

    monkeypatch.setattr(Firmware, "_on_mode_cmd", careless)
    expect_failed("USR-04", "Auto after a MODE_Cmd 4, the last one being 5; Suspended came")


def test_a_mode_that_changes_the_rate() -> None:
    device = Changed(says=of("PUMP_BasalCmd", "InsulinRate", lambda raw: raw + 2 if raw <= 8000 else raw))
    expect_failed("USR-04", "at most the schedule at the target, ModeRequest 1", device)


def test_a_mode_that_doses(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Firmware._on_mode_cmd

    def generous(self: Firmware, values: Values) -> None:
        as_it_is(self, values)
        self._meals.hear({"MealKind": 1, "MealId": values["ModeCmdSeq"], "CarbsEst": 50, "MealOffset": 0})

    monkeypatch.setattr(Firmware, "_on_mode_cmd", generous)
    expect_failed("USR-04", "no bolus for ModeRequest 3")


def test_a_meal_kept_for_another_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Meals, "take", lambda self: self._waiting or (0, 0))
    expect_failed("USR-04", "no bolus for a meal of the mode before")


# ---- parameters


def test_parameters_that_are_clipped() -> None:
    device = Changed(of("CFG_Param", "CfgBasal", lambda raw: min(raw, 60000)))
    expect_failed("USR-05", "the echo of CfgBasal as stored, 1425", device)


def test_a_ratio_of_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "LOWEST", {})
    expect_failed("USR-05", "the echo of CfgCarbRatio as stored, 1230")


def says_of_the_set(raw: Any) -> Changed:
    """A device that echoes something else as the CRC in force."""

    def says(name: str, values: Values) -> Values:
        of_the_set = name == "CFG_ParamEcho" and values["EchoIndex"] == 63
        return values | {"EchoRaw": raw(values["EchoSetCrc"])} if of_the_set else values

    return Changed(says=says)


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (lambda crc: crc ^ 1, "no set active under a CRC that is not its own"),
        (lambda _: 0, "the set active with its CRC"),
    ],
)
def test_a_set_with_a_wrong_checksum(raw: Any, text: str) -> None:
    expect_failed("USR-05", text, says_of_the_set(raw))


def test_an_echo_that_is_missing() -> None:
    seen: Iterator[int] = iter(range(10**6))

    def says(name: str, values: Values) -> Values | None:
        return None if name == "CFG_ParamEcho" and next(seen) == 99 else values

    expect_failed("USR-05", "frames of CTRL with good CRC and the next counter", Changed(says=says))


@pytest.mark.parametrize(
    ("age", "text"), [(99, "4 steps after the newest sample"), (4, "2 steps after the newest sample")]
)
def test_a_looser_stale_limit(monkeypatch: pytest.MonkeyPatch, age: int, text: str) -> None:
    monkeypatch.setattr(allowance, "stale_age", lambda _: age)
    monkeypatch.setattr(ladder, "AGE_DEGRADED", age)
    monkeypatch.setattr(ladder, "AGE_SAFE_BASAL", age + 3)
    expect_failed("USR-05", text)
