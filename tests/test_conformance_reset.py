"""The checks of reset and memory: the reference passes each, and each can fail."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from conformance_devices import Changed, Values, built_from, expect_failed, expect_passed
from pumpbench.conformance.device import InProcess
from pumpbench.conformance.suite import select

from can_bus.faults.nodes import MemoryState
from firmware_sim import alarms, caution
from firmware_sim.alarms import Alarms
from firmware_sim.bolus import Boluses, Op, Phase
from firmware_sim.calibration import Calibration
from firmware_sim.cgm import Cgm
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.nvm import ERASED, RamMemory
from firmware_sim.pump import Pump
from firmware_sim.user import User

MAX_BASAL = 3
"""CfgIndex of CfgMaxBasal."""


@pytest.mark.parametrize("requirement", [each.id for each in select(["RST"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def forget(monkeypatch: pytest.MonkeyPatch, part: type, restore: str, what: Callable[[Any], None]) -> None:
    """A device one part of which does something when it takes up its memory."""
    as_it_is = getattr(part, restore)

    def forgetful(self: Any, words: Iterator[int]) -> None:
        as_it_is(self, words)
        what(self)

    monkeypatch.setattr(part, restore, forgetful)


def sets(**fields: Any) -> Callable[[Any], None]:
    """A change of attributes."""

    def change(part: Any) -> None:
        for name, value in fields.items():
            setattr(part, name, value)

    return change


def no_insulin(device: Firmware) -> None:
    """It begins with nothing on board."""
    device._state[:] = [0] * len(device._state)


def no_limit(calibration: Calibration) -> None:
    """It takes up the largest limit there is."""
    calibration._received[MAX_BASAL] = 60000
    calibration._activate()


def hasty(device: Firmware) -> None:
    """It does not wait for a second sample, and knows neither its meals nor its boluses."""
    device._cgm.streak = 2
    device._meals.last = None
    device._boluses._open.clear()


def open_loop(device: Firmware) -> None:
    """It goes on in another mode."""
    device._user.mode = 2


def on_hold(device: Firmware) -> None:
    """It goes on as after too many resets."""
    device._caution.held = True


@pytest.mark.parametrize(
    ("part", "restore", "what", "text"),
    [
        (Firmware, "_restore", no_insulin, "at least 364 of insulin on board"),
        (User, "restore", sets(mode=2), "CtrlMode 6 as before the power was cut; 2 came"),
        (User, "restore", sets(suspended=False), "CtrlState SUSPENDED after a restart"),
        (Pump, "restore", sets(_sequence=1022), "a BasalCmdSeq that goes on from"),
        (Cgm, "restore", sets(_sequence=None), "a sample that was used before the power was cut is not used"),
        (Calibration, "restore", no_limit, "at most CfgMaxBasal"),
        (Alarms, "restore", sets(hold=lambda *_: None), "the alarm CgmLost also after a restart"),
        (Firmware, "_restore", hasty, "one bolus for one meal with power cut at frame"),
        (Boluses, "restore", sets(_open={}), "the bolus of step 10 on board in step 11 with power cut at frame"),
    ],
)
def test_power_cuts(
    monkeypatch: pytest.MonkeyPatch, part: type, restore: str, what: Callable[[Any], None], text: str
) -> None:
    forget(monkeypatch, part, restore, what)
    expect_failed("RST-01", text)


def test_a_device_without_a_memory() -> None:
    expect_failed("RST-01", "a sample that was used before the power was cut", built_from(Firmware))


def remembering(erased_by: tuple[MemoryState, ...], after: Callable[[Firmware], None] = lambda _: None) -> InProcess:
    """The reference with a memory that only these take away, and what it does when it starts with one."""
    memory = RamMemory(NVM_BYTES)

    def build(state: MemoryState | None) -> Firmware:
        if state is None or state in erased_by:
            memory.write(0, bytes([ERASED]) * memory.size)
        device = Firmware(memory)
        if state == "lost":
            after(device)
        return device

    return InProcess(build)


@pytest.mark.parametrize(
    ("device", "text"),
    [
        (lambda: remembering(("torn",)), "CtrlMode of at most one step ago after a torn write"),
        (remembering, "no bolus by a device that has lost its memory"),
        (lambda: remembering((), open_loop), "at most the schedule of 285 by a device that has lost its memory"),
        (lambda: remembering((), on_hold), "CfgMaxIob on board by a device that knows of none"),
    ],
)
def test_a_damaged_memory(device: Callable[..., InProcess], text: str) -> None:
    expect_failed("RST-02", text, device(()) if device is remembering else device())


def test_a_damaged_memory_that_nobody_is_told_of() -> None:
    def full(name: str, values: Values) -> Values:
        return values | {"InsulinOnBoard": 4000} if name == "CTRL_Status" else values

    device = Changed(says=full)
    device._device = remembering((), on_hold)
    expect_failed("RST-02", "the alarm SelfTest by a device that has lost its memory", device)


def test_boluses_before_the_pump_was_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pump, "heard", True)
    monkeypatch.setattr(Pump, "age", lambda *_: 0)
    expect_failed("RST-03", "no bolus after a restart before PUMP_Status was heard")


def test_boluses_before_their_states_were_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Boluses, "known", True)
    expect_failed("RST-03", "no bolus after a restart before PUMP_BolusState was heard")


def test_boluses_that_never_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    forget(monkeypatch, Boluses, "restore", sets(ready=lambda _: False))
    expect_failed("RST-03", "a bolus for a meal within 8 steps after PUMP_Status")


def test_a_second_dose_after_a_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    forget(monkeypatch, Firmware, "_restore", hasty)
    expect_failed("RST-03", "one bolus for one meal with a restart between Commit and acknowledgement")


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"NmtCtrl": 5}, "BootUp after a start; NmtCtrl 5 came"),
        ({"BootCtrl": 0}, "BootCtrl 1, one more; 0 came"),
        ({"ResetCauseCtrl": 7}, "a ResetCauseCtrl of the DBC; 7 came"),
    ],
)
def test_resets_that_are_not_told(fields: Values, text: str) -> None:
    def says(name: str, values: Values) -> Values:
        return values | fields if name == "HB_CTRL" else values

    expect_failed("RST-04", text, Changed(says=says))


def test_resets_without_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alarms, "ALARM_HOLD", 0)
    expect_failed("RST-04", "the alarm NodeReset in the step after a start")


@pytest.mark.parametrize(
    ("resets", "text"),
    [(4, "CtrlState AUTO 15 steps after 4 resets"), (6, "CtrlState SAFE_BASAL 0 steps after 5 resets")],
)
def test_too_many_resets(monkeypatch: pytest.MonkeyPatch, resets: int, text: str) -> None:
    monkeypatch.setattr(caution, "RESETS_KEPT", resets)
    expect_failed("RST-04", text)


def test_a_user_who_resumes_in_vain() -> None:
    def deaf(name: str, values: Values) -> Values | None:
        return None if name == "MODE_Cmd" and values["SuspendRequest"] == 2 else values

    expect_failed("RST-04", "CtrlState AUTO 8 steps after the user has resumed", Changed(deaf))


def test_a_bolus_committed_after_the_pumps_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Boluses._follow

    def stubborn(self: Boluses, drug: Any, bolus: Any, state: Values, delivered: Any) -> None:
        if state["BolusPhase"] == Phase.ABORTED:
            bolus.op, bolus.uncertain = Op.COMMIT, False
        else:
            as_it_is(self, drug, bolus, state, delivered)

    monkeypatch.setattr(Boluses, "_follow", stubborn)
    expect_failed("RST-05", "no Commit of a bolus that was programmed before the pump's reset")


def test_a_rate_that_is_not_set_again() -> None:
    steps: list[str] = []

    def once(name: str, values: Values) -> Values | None:
        steps.append(name)
        return None if name == "PUMP_BasalCmd" and steps.count(name) > 11 else values

    expect_failed("RST-05", "the rate set again within 6 steps of the pump's reset", Changed(says=once))


def test_an_id_that_is_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Boluses.start

    def start(self: Boluses, drug: Any, dose: int, step: int) -> None:
        self.next_id = 0
        as_it_is(self, drug, dose, step)

    monkeypatch.setattr(Boluses, "start", start)
    expect_failed("RST-05", "another BolusId than 0 for the next meal")
