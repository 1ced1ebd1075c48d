"""The checks of the fallback ladder: the reference passes each, and each can fail."""

from collections.abc import Callable

import pytest
from conformance_devices import Changed, Values, check_one, expect_failed, expect_passed
from pumpbench.conformance.suite import Verdict, select

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Turn
from firmware_sim import alarms, allowance, firmware, ladder, scheduler
from firmware_sim.alarms import Alarms, Code
from firmware_sim.bolus import Boluses
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import Ladder, State
from firmware_sim.pump import Op, Pump


@pytest.mark.parametrize("requirement", [each.id for each in select(["FAL"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


Patch = pytest.MonkeyPatch


def never_raises(monkeypatch: Patch, code: Code) -> None:
    """A device without this alarm."""
    hold = Alarms.hold

    def without(self: Alarms, held: Code, cause: bool, aux: int) -> None:
        hold(self, held, cause and held != code, aux)

    monkeypatch.setattr(Alarms, "hold", without)


def commands(monkeypatch: Patch, change: Callable[[Firmware, State], State]) -> None:
    """A device that commands as in another state than the one it is in."""
    command = Firmware._command
    monkeypatch.setattr(Firmware, "_command", lambda self, state, step: command(self, change(self, state), step))


def gives_boluses(monkeypatch: Patch, state: State) -> None:
    """A device that gives boluses in this state, too."""
    control, start = Firmware._control, Firmware._start_boluses

    def eager(self: Firmware, now: State, *inputs: int) -> None:
        control(self, State.AUTO if now == state and self._meals._waiting else now, *inputs)

    def started(self: Firmware, step: int) -> int:
        now, self._ladder.state = self._ladder.state, State.AUTO if self._ladder.state == state else self._ladder.state
        try:
            return start(self, step)
        finally:
            self._ladder.state = now

    monkeypatch.setattr(Firmware, "_control", eager)
    monkeypatch.setattr(Firmware, "_start_boluses", started)


# ---- FAL-01, FAL-02: the sensor


def test_degraded_too_late(monkeypatch: Patch) -> None:
    monkeypatch.setattr(ladder, "AGE_DEGRADED", 5)
    monkeypatch.setattr(allowance, "stale_age", lambda _: 5)
    expect_failed("FAL-01", "DEGRADED when the newest sample is 4 steps old; Auto came")


def test_above_the_schedule_in_degraded() -> None:
    def generous(name: str, values: Values) -> Values:
        is_rate = name == "PUMP_BasalCmd" and values["BasalOp"] == Op.SET_RATE
        return values | {"InsulinRate": max(values["InsulinRate"], 300)} if is_rate else values

    expect_failed("FAL-01", "at most the schedule of 285 when the newest sample is 4", Changed(says=generous))


def test_no_word_of_a_lost_sensor(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.CGM_LOST)
    expect_failed("FAL-01", "the alarm CgmLost when")


def test_a_meal_in_degraded_is_dosed(monkeypatch: Patch) -> None:
    gives_boluses(monkeypatch, State.DEGRADED)
    expect_failed("FAL-01", "no bolus for a meal of step 24")


def test_a_meal_in_degraded_is_not_refused(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.DOSE_REJECTED)
    expect_failed("FAL-01", "DoseRejected for the meal of step 24")


def test_safe_basal_too_late(monkeypatch: Patch) -> None:
    monkeypatch.setattr(ladder, "AGE_SAFE_BASAL", 8)
    expect_failed("FAL-02", "SAFE_BASAL when the newest sample is 7 steps old; Degraded came")


def test_a_suspension_that_outlives_the_sensor(monkeypatch: Patch) -> None:
    commands(monkeypatch, lambda _self, state: State.AUTO if state == State.SAFE_BASAL else state)
    expect_failed("FAL-02", "exactly the schedule of 285 when the newest sample is 7 steps old; 0 came")


def test_pramlintide_without_a_sensor() -> None:
    def both(name: str, values: Values) -> Values:
        left_alone = name == "PUMP_BasalCmd" and values["BasalOp"] == Op.RESUME_SCHEDULE
        return values | {"BasalOp": 1, "InsulinRate": 285, "PramlintideRate": 7} if left_alone else values

    expect_failed("FAL-02", "no pramlintide when the newest sample is 7 steps old; 7 came", Changed(says=both))


# ---- FAL-03: back up


def test_one_sample_is_enough(monkeypatch: Patch) -> None:
    monkeypatch.setattr(ladder, "SAMPLES_UP", 1)
    expect_failed("FAL-03", "with never more than 1 good samples in a row")


def test_two_rungs_at_once(monkeypatch: Patch) -> None:
    next_rung = Ladder._next_rung

    def leap(self: Ladder, age: int, streak: int, age_degraded: int) -> State:
        rung = next_rung(self, age, streak, age_degraded)
        return State.AUTO if rung < self._rung else rung

    monkeypatch.setattr(Ladder, "_next_rung", leap)
    expect_failed("FAL-03", "one rung per step; SAFE_BASAL to Auto came")


def test_never_up_again(monkeypatch: Patch) -> None:
    next_rung = Ladder._next_rung
    monkeypatch.setattr(Ladder, "_next_rung", lambda self, *how: max(self._rung % 3, next_rung(self, *how)))
    expect_failed("FAL-03", "AUTO after 8 good samples; Degraded came")


def test_a_dose_that_is_made_up_for(monkeypatch: Patch) -> None:
    owed = 0
    command = Pump.command

    def caught_up(self: Pump, turn: Turn, op: Op, step: int, rate: int = 0, pramlintide_rate: int = 0) -> bool:
        nonlocal owed
        owed = owed + 100 if op == Op.RESUME_SCHEDULE and step > 12 else owed
        paid = owed if op == Op.SET_RATE and rate > 285 else 0
        owed -= paid
        return command(self, turn, op, step, rate + paid, pramlintide_rate)

    monkeypatch.setattr(Pump, "command", caught_up)
    expect_failed("FAL-03", "no dose to make up for the time without a sensor")


def test_a_flapping_sensor_nags(monkeypatch: Patch) -> None:
    monkeypatch.setattr(alarms, "STEPS_AT_LEAST", 0)
    expect_failed("FAL-03", "when every fourth sample is damaged; code 12 came after 4")


# ---- FAL-04: the pump


@pytest.mark.parametrize(
    ("steps", "text"),
    [(2, "no PumpLost before 3 steps"), (4, "DELIVERY_UNCERTAIN 3 steps after the pump's last frame")],
)
def test_pump_lost_too_early_or_too_late(monkeypatch: Patch, steps: int, text: str) -> None:
    monkeypatch.setattr(ladder, "PUMP_SILENT", steps)
    monkeypatch.setattr(firmware, "PUMP_SILENT", steps)
    expect_failed("FAL-04", text)


def test_no_word_of_a_lost_pump(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.PUMP_LOST)
    expect_failed("FAL-04", "the alarm PumpLost after 3 steps")


def test_a_pump_lost_while_suspended_is_not_told(monkeypatch: Patch) -> None:
    hold = Alarms.hold
    suspended = False

    def quiet(self: Alarms, code: Code, cause: bool, aux: int) -> None:
        hold(self, code, cause and not (suspended and code == Code.PUMP_LOST), aux)

    def says(name: str, values: Values) -> Values:
        nonlocal suspended
        suspended = values["CtrlState"] == State.SUSPENDED if name == "CTRL_Status" else suspended
        return values

    monkeypatch.setattr(Alarms, "hold", quiet)
    expect_failed("FAL-04", "silence in Suspended, too", Changed(says=says))


@pytest.mark.parametrize("iob", [0, 4000])
def test_iob_of_a_silent_pump_is_guessed(iob: int) -> None:
    def guessed(name: str, values: Values) -> Values:
        lost = name == "CTRL_Status" and values["CtrlState"] == State.DELIVERY_UNCERTAIN
        return values | {"InsulinOnBoard": iob} if lost else values

    expect_failed("FAL-04", "IOB of the last totals", Changed(says=guessed))


@pytest.mark.parametrize("there", ["status", "totals"])
def test_half_a_pump_is_a_pump(monkeypatch: Patch, there: str) -> None:
    monkeypatch.setattr(Pump, "age", lambda self, step: step - getattr(self, f"_{there}_step"))
    text = "DELIVERY_UNCERTAIN with the status alone" if there == "status" else "with the totals alone"
    expect_failed("FAL-04", text)


def test_a_bolus_into_a_silent_pump(monkeypatch: Patch) -> None:
    gives_boluses(monkeypatch, State.DELIVERY_UNCERTAIN)
    expect_failed("FAL-04", "no bolus in steps 20 to 31")


# ---- FAL-05: the user


def test_suspending_stops_nothing(monkeypatch: Patch) -> None:
    commands(monkeypatch, lambda self, state: State.INIT if state == State.SUSPENDED else state)
    expect_failed("FAL-05", "neither drug 0 steps after the user suspended; 285 and 0 came")


def test_suspended_ends_by_itself(monkeypatch: Patch) -> None:
    def impatient(self: Firmware) -> int:
        self._user.suspended = self._user.suspended and self._now < 20
        return run(self)

    run = Firmware._task_ladder
    monkeypatch.setattr(Firmware, "_task_ladder", impatient)
    expect_failed("FAL-05", "SUSPENDED 8 steps after the user suspended; Auto came")


def test_a_mode_resumes() -> None:
    def eager(name: str, values: Values) -> Values:
        return values | {"SuspendRequest": 2} if name == "MODE_Cmd" and values["SuspendRequest"] == 0 else values

    expect_failed("FAL-05", "SUSPENDED 6 steps after the user suspended; Auto came", Changed(hears=eager))


def test_resuming_is_not_heard() -> None:
    def deaf(name: str, values: Values) -> Values:
        return values | {"SuspendRequest": 0} if name == "MODE_Cmd" and values["SuspendRequest"] == 2 else values

    expect_failed("FAL-05", "an end of Suspended", Changed(hears=deaf))


def test_a_bolus_outlives_suspending(monkeypatch: Patch) -> None:
    monkeypatch.setattr(Boluses, "cancel", lambda _self: None)
    expect_failed("FAL-05", "Cancel in step 21")


# ---- FAL-06, FAL-07: telling, and faults


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (Code.CGM_LOST, "with the change from AUTO to Degraded"),
        (Code.PUMP_LOST, "with the change from AUTO to DeliveryUncertain"),
        (Code.STATE_CHANGE, "StateChange with the change from INIT to Auto"),
    ],
)
def test_a_change_without_a_cause(monkeypatch: Patch, code: Code, text: str) -> None:
    never_raises(monkeypatch, code)
    expect_failed("FAL-06", text)


def test_changes_are_not_told_to_a_user_who_knows_the_alarm(monkeypatch: Patch) -> None:
    monkeypatch.setattr(Alarms, "repeat", lambda *_: None)
    expect_failed("FAL-06", "with the change from DEGRADED to Auto")


def test_no_fault_ever(monkeypatch: Patch) -> None:
    monkeypatch.setattr(scheduler, "BITES_AFTER", 99)
    expect_failed("FAL-07", "Fault after overruns in steps 20 to 22; None came")


def test_a_fault_that_heals(monkeypatch: Patch) -> None:
    monkeypatch.setattr(scheduler.Scheduler, "bitten", property(lambda self: self.overruns >= 3 and bool(self.late)))
    expect_failed("FAL-07", "Fault")


def test_commands_in_fault(monkeypatch: Patch) -> None:
    commands(monkeypatch, lambda _self, state: State.INIT if state == State.FAULT else state)
    expect_failed("FAL-07", "no command from step 23 on, in Fault")


def test_a_fault_is_not_told(monkeypatch: Patch) -> None:
    never_raises(monkeypatch, Code.WATCHDOG)
    expect_failed("FAL-07", "the alarm Watchdog in step 23")


def test_without_the_routine_that_overloads_it_does_not_apply() -> None:
    request = codec.message("UDS_Request").can_id

    class Plain(Changed):
        def receive(self, frame: Frame) -> list[Frame]:  # type: ignore[override]
            return [] if frame.can_id == request else list(super().receive(frame))

    result = check_one("FAL-07", Plain())
    assert result.verdict == Verdict.NOT_APPLICABLE
    assert result.text == "needs the UDS routine 0201, which overloads a task"
