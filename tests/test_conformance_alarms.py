"""The checks of alarms: the reference passes each, and each can fail."""

import dataclasses
from collections.abc import Callable

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select
from test_conformance_ladder import Patch, never_raises

from can_bus.lockstep import Turn
from firmware_sim import alarms, firmware
from firmware_sim.alarms import Alarms, Code, Priority
from firmware_sim.bolus import Boluses
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from firmware_sim.pump import Op, Pump
from plant_server.chamber import Chamber, ChamberSettings
from plant_server.pump import Pump as SimulatedPump
from plant_server.pump_alarms import Alarm


@pytest.mark.parametrize("requirement", [each.id for each in select(["ALM"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def alarm_frames(change: Callable[[Values], Values]) -> Changed:
    """A device whose alarms say something else."""
    return Changed(says=lambda name, values: change(values) if name == "CTRL_Alarm" else values)


# ---- ALM-01: how they are told


def test_an_alarm_is_never_raised(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.CLOCK_JUMP)
    expect_failed("ALM-01", "ClockJump within 3 steps")


def test_an_alarm_is_told_once(monkeypatch: Patch) -> None:
    report = Alarms.report

    def terse(self: Alarms, turn: Turn) -> None:
        known = {code: alarm for code, alarm in self._active.items() if not alarm.changed}
        self._active = {code: alarm for code, alarm in self._active.items() if alarm.changed}
        report(self, turn)
        self._active |= known

    monkeypatch.setattr(Alarms, "report", terse)
    expect_failed("ALM-01", "a pending alarm in every step until it is confirmed")


def test_the_lowest_first(monkeypatch: Patch) -> None:
    report = Alarms.report

    def upside_down(self: Alarms, turn: Turn) -> None:
        with monkeypatch.context() as upside:
            upside.setattr(alarms, "PRIORITY", {code: 3 - urgency for code, urgency in alarms.PRIORITY.items()})
            report(self, turn)

    monkeypatch.setattr(Alarms, "report", upside_down)
    device = alarm_frames(lambda values: values | {"CtrlAlarmPriority": 3 - values["CtrlAlarmPriority"]})
    expect_failed("ALM-01", "the highest priority first", device)


def test_an_instance_for_several_alarms() -> None:
    device = alarm_frames(lambda values: values | {"CtrlAlarmInstance": 0})
    expect_failed("ALM-01", "one frame per alarm in a turn", device)


def test_the_same_instance_again(monkeypatch: Patch) -> None:
    hold = Alarms.hold

    def numbered(self: Alarms, code: Code, cause: bool, aux: int) -> None:
        self._next_instance = code
        hold(self, code, cause, aux)

    monkeypatch.setattr(Alarms, "hold", numbered)
    expect_failed("ALM-01", "another instance for an alarm that comes again")


def test_an_instance_for_two_codes(monkeypatch: Patch) -> None:
    seen: dict[int, int] = {}

    def mixed_up(values: Values) -> Values:
        times = seen[values["CtrlAlarmCode"]] = seen.get(values["CtrlAlarmCode"], 0) + 1
        return values | {"CtrlAlarmCode": 1} if times == 2 else values

    expect_failed("ALM-01", "an instance for one alarm", alarm_frames(mixed_up))


@pytest.mark.parametrize(("action", "text"), [(1, "UrgentLow told in state 2"), (2, "PumpLost told in state 3")])
def test_an_answer_is_not_heard(action: int, text: str) -> None:
    def deaf(name: str, values: Values) -> Values:
        is_it = name == "UI_AlarmAck" and values["AlarmAckAction"] == action
        return values | {"AlarmAckAction": 0} if is_it else values

    expect_failed("ALM-01", text, Changed(hears=deaf))


def test_an_answer_does_not_silence(monkeypatch: Patch) -> None:
    monkeypatch.setattr(alarms, "STEPS_CONFIRMED", 1)
    expect_failed("ALM-01", "not pending 1 steps after the user has answered")


def test_an_alarm_without_an_end(monkeypatch: Patch) -> None:
    monkeypatch.setattr(alarms, "STEPS_AT_LEAST", 99)
    expect_failed("ALM-01", "every alarm over 90 min after")


# ---- ALM-02: how urgent


@pytest.mark.parametrize("code", ["URGENT_LOW", "PUMP_LOST", "DELIVERY_UNCERTAIN", "WATCHDOG"])
def test_not_urgent_enough(monkeypatch: Patch, code: str) -> None:
    monkeypatch.setitem(alarms.PRIORITY, Code[code], Priority.MEDIUM)
    expect_failed("ALM-02", "with the priority High; Medium came")


@pytest.mark.parametrize("code", ["CGM_LOST", "CGM_IMPLAUSIBLE", "E2E_FAULT"])
@pytest.mark.parametrize("priority", [Priority.HIGH, Priority.LOW])
def test_neither_more_nor_less_than_medium(monkeypatch: Patch, code: str, priority: Priority) -> None:
    monkeypatch.setitem(alarms.PRIORITY, Code[code], priority)
    expect_failed("ALM-02", "with the priority Medium; ")


@pytest.mark.parametrize("code", ["CLOCK_JUMP", "STATE_CHANGE"])
def test_too_urgent(monkeypatch: Patch, code: str) -> None:
    monkeypatch.setitem(alarms.PRIORITY, Code[code], Priority.MEDIUM)
    expect_failed("ALM-02", "with the priority Info or Low; Medium came")


def test_an_alarm_that_never_comes_has_no_priority(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.DELIVERY_UNCERTAIN)
    expect_failed("ALM-02", "DeliveryUncertain did not come")


# ---- ALM-03: how soon


@pytest.mark.parametrize("state", [state for state in State if state != State.FAULT])
def test_urgent_low_is_not_told_in_a_state(monkeypatch: Patch, state: State) -> None:
    report = Firmware._report_alarms

    def silent(self: Firmware, now: State, step: int) -> None:
        self._urgent = self._urgent and now != state
        report(self, now, step)

    monkeypatch.setattr(Firmware, "_report_alarms", silent)
    expect_failed("ALM-03", f"UrgentLow in the step of 54.9 mg/dL in {state.name}")


def test_urgent_low_at_another_limit(monkeypatch: Patch) -> None:
    monkeypatch.setattr(firmware, "URGENT_LOW", 540)
    expect_failed("ALM-03", "54.9 mg/dL in INIT")


@pytest.mark.parametrize("code", [Code.E2E_FAULT, Code.CGM_IMPLAUSIBLE, Code.CLOCK_JUMP])
def test_an_alarm_comes_two_steps_late(monkeypatch: Patch, code: Code) -> None:
    hold = Alarms.hold
    causes = [False, False]

    def late(self: Alarms, held: Code, cause: bool, aux: int) -> None:
        if held == code:
            causes.append(cause)
            cause = causes[-3]
        hold(self, held, cause, aux)

    monkeypatch.setattr(Alarms, "hold", late)
    expect_failed("ALM-03", "within 1 step of")


# ---- ALM-04: again and again


@pytest.mark.parametrize("confirm", [True, False])
def test_an_answer_removes_the_cause(monkeypatch: Patch, confirm: bool) -> None:
    hold, acknowledge = Alarms.hold, Alarms.acknowledge
    answered: set[int] = set()

    def forgetful(self: Alarms, instance: int, *, confirm: bool) -> bool:
        if confirm == wanted:
            answered.add(instance)
        return acknowledge(self, instance, confirm=confirm)

    def gone(self: Alarms, code: Code, cause: bool, aux: int) -> None:
        hold(self, code, cause, aux)
        if code in self._active and self._active[code].instance in answered:
            self._active[code].quiet = 0

    wanted = confirm
    monkeypatch.setattr(Alarms, "acknowledge", forgetful)
    monkeypatch.setattr(Alarms, "hold", gone)
    expect_failed("ALM-04", f"CgmLost pending again 30 min after an answer (state {2 if confirm else 3})")


def test_nobody_is_reminded_of_suspended(monkeypatch: Patch) -> None:
    monkeypatch.setattr(alarms, "STEPS_CONFIRMED_OF", {})
    expect_failed("ALM-04", "StateChange pending again 15 min after")


# ---- ALM-05: occlusion


def test_pramlintide_into_a_blocked_insulin_line(monkeypatch: Patch) -> None:
    status = Pump.status

    def careless(self: Pump, values: dict[str, int], step: int) -> None:
        status(self, values, step)
        self.insulin_blocked = False

    monkeypatch.setattr(Pump, "status", careless)
    expect_failed("ALM-05", "no pramlintide while the insulin line is occluded")


def test_what_was_missed_is_made_up_for(monkeypatch: Patch) -> None:
    owed = 0
    command = Pump.command

    def caught_up(self: Pump, turn: Turn, op: Op, step: int, rate: int = 0, pramlintide_rate: int = 0) -> bool:
        nonlocal owed
        owed = owed + 285 if self.insulin_blocked else owed
        paid = 0 if self.insulin_blocked else min(owed, 600)
        owed -= paid
        return command(self, turn, op, step, rate + paid, pramlintide_rate)

    monkeypatch.setattr(Pump, "command", caught_up)
    expect_failed("ALM-05", "nothing made up after an hour of occlusion")


def test_a_bolus_into_a_blocked_line(monkeypatch: Patch) -> None:
    control = Firmware._control

    def careless(self: Firmware, *how: int) -> None:
        blocked = self._pump.insulin_blocked
        self._pump.insulin_blocked = blocked and self._user.mode == 6
        control(self, *how)  # type: ignore[arg-type]
        self._pump.insulin_blocked = blocked

    monkeypatch.setattr(Firmware, "_control", careless)
    expect_failed("ALM-05", "no bolus for a meal while the line is occluded")


# ---- ALM-06, ALM-07: the pump


@pytest.mark.parametrize("strokes", [50, 70])
def test_the_pump_notices_an_occlusion_at_another_volume(monkeypatch: Patch, strokes: int) -> None:
    init = Chamber.__init__

    def other(self: Chamber, settings: ChamberSettings) -> None:
        init(self, dataclasses.replace(settings, occluded_at=strokes))

    monkeypatch.setattr(Chamber, "__init__", other)
    expect_failed("ALM-06", "Occluded at 3 U missed, after 1800 min at 0.1 U/h")


@pytest.mark.parametrize(
    ("alarm", "text"),
    [
        (Alarm.RESERVOIR_LOW, "ReservoirLow in step"),
        (Alarm.RESERVOIR_EMPTY, "ReservoirEmpty in step"),
        (Alarm.BATTERY_LOW, "BatteryLow in step"),
        (Alarm.BATTERY_EMPTY, "BatteryEmpty in step"),
    ],
)
def test_nobody_tells_what_runs_out(monkeypatch: Patch, alarm: Alarm, text: str) -> None:
    causes = SimulatedPump._causes
    monkeypatch.setattr(SimulatedPump, "_causes", lambda self: {each for each in causes(self) if each[0] != alarm})
    expect_failed("ALM-07", text)


def test_a_bolus_beyond_what_is_left(monkeypatch: Patch) -> None:
    advance = Boluses._advance
    monkeypatch.setattr(
        Boluses, "_advance", lambda self, drug, bolus, _result, _echo: advance(self, drug, bolus, 0, bolus.dose)
    )
    expect_failed("ALM-07", "no bolus beyond the 1.8 U that are left")
