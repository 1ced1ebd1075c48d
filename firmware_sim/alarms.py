"""Alarms: one frame per change of state, repeated every step until the user has confirmed it."""

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from can_bus.lockstep import Turn


class Code(enum.IntEnum):
    """CTRL_Alarm.CtrlAlarmCode."""

    CGM_LOST = 1
    CGM_IMPLAUSIBLE = 2
    PUMP_LOST = 3
    DELIVERY_UNCERTAIN = 4
    DOSE_LIMITED = 10
    DOSE_REJECTED = 11
    E2E_FAULT = 12
    WATCHDOG = 13
    SELF_TEST = 14
    URGENT_LOW = 15
    NODE_RESET = 18
    CLOCK_JUMP = 19
    STATE_CHANGE = 20


class State(enum.IntEnum):
    """CTRL_Alarm.CtrlAlarmState, after the annunciations of the Bluetooth Insulin Delivery Service."""

    INACTIVE = 0
    PENDING = 1
    CONFIRMED = 2
    SNOOZED = 3


class Priority(enum.IntEnum):
    """CTRL_Alarm.CtrlAlarmPriority, named after IEC 60601-1-8."""

    INFO = 0
    LOW = 1
    MEDIUM = 2
    HIGH = 3


PRIORITY = {
    Code.CGM_LOST: Priority.MEDIUM,
    Code.CGM_IMPLAUSIBLE: Priority.MEDIUM,
    Code.PUMP_LOST: Priority.HIGH,
    Code.DELIVERY_UNCERTAIN: Priority.HIGH,
    Code.DOSE_LIMITED: Priority.LOW,
    Code.DOSE_REJECTED: Priority.LOW,
    Code.E2E_FAULT: Priority.MEDIUM,
    Code.WATCHDOG: Priority.HIGH,
    Code.SELF_TEST: Priority.HIGH,
    Code.URGENT_LOW: Priority.HIGH,
    Code.NODE_RESET: Priority.INFO,
    Code.CLOCK_JUMP: Priority.LOW,
    Code.STATE_CHANGE: Priority.INFO,
}

STEPS_AT_LEAST = 6
"""Steps an alarm lasts however soon its cause ends, so that a flapping cause raises one alarm in 30 min (FAL-03)."""

ALARM_HOLD = 3
"""Quiet steps after which the cause of an alarm that tells of a passing event ends (project's choice)."""

STEPS_CONFIRMED = 6
STEPS_CONFIRMED_OF = {Code.STATE_CHANGE: 3}
"""Steps after which an alarm that was confirmed or snoozed is pending again if its cause still holds (ALM-04)."""

INSTANCES = 65535
"""Instance numbers run from 0 to 65534; 65535 is SNA."""


@dataclass
class _Alarm:
    instance: int
    state: State
    aux: int
    changed: bool = True
    steps: int = 0  # reported so far
    quiet: int = 0  # steps since the user confirmed or snoozed it


class Alarms:
    """The alarms in force, by code: at most one of each."""

    def __init__(self) -> None:
        self._active: dict[Code, _Alarm] = {}
        self._next_instance = 0
        self._event_steps: dict[Code, int] = {}  # of the newest event that this alarm tells of
        self._totals: dict[Code, int] = {}  # of such events that are counted
        self._seen = 0  # bit per code: raised since boot
        self._kept = 0  # bit per code: raised since the history was cleared, over resets

    def active(self, code: Code) -> bool:
        """Whether this alarm is in force, confirmed or not."""
        return code in self._active

    @property
    def bits(self) -> int:
        """Those in force, confirmed or not: a bit per code."""
        return sum(1 << code for code in self._active)

    def event(self, code: Code, step: int) -> None:
        """Something happened in this step that the alarm tells of, and may be over with it."""
        self._event_steps[code] = step

    def count(self, code: Code, total: int, step: int) -> None:
        """Such events as somebody else counts: how many there were so far."""
        if total > self._totals.get(code, 0):
            self._totals[code] = total
            self.event(code, step)

    def recent(self, code: Code, step: int) -> bool:
        """Whether such an event is a cause to hold the alarm: the last one was less than `ALARM_HOLD` steps ago."""
        return code in self._event_steps and step - self._event_steps[code] < ALARM_HOLD

    def hold(self, code: Code, cause: bool, aux: int) -> None:
        """Raise the alarm if its cause holds, end it if not; `aux` (16 bit) tells more and may change.

        To be called once per step. An alarm younger than `STEPS_AT_LEAST` outlives its cause.
        """
        alarm = self._active.get(code)
        if cause:
            self._seen |= 1 << code
            self._kept |= 1 << code
        if cause and alarm is None:
            self._active[code] = _Alarm(self._next_instance, State.PENDING, aux & 0xFFFF)
            self._next_instance = (self._next_instance + 1) % INSTANCES
        elif cause and alarm is not None:
            alarm.aux = aux & 0xFFFF
            alarm.quiet = alarm.quiet + 1 if alarm.state in (State.CONFIRMED, State.SNOOZED) else 0
            if alarm.quiet > STEPS_CONFIRMED_OF.get(code, STEPS_CONFIRMED):
                alarm.state = State.PENDING
                alarm.quiet = 0
        elif alarm is not None and alarm.steps >= STEPS_AT_LEAST and alarm.state != State.INACTIVE:
            alarm.state = State.INACTIVE
            alarm.changed = True

    def acknowledge(self, instance: int, *, confirm: bool) -> bool:
        """The user confirms or snoozes one instance; the cause stays. False if there is no such alarm."""
        for alarm in self._active.values():
            if alarm.instance == instance and alarm.state in (State.PENDING, State.SNOOZED):
                alarm.state = State.CONFIRMED if confirm else State.SNOOZED
                alarm.changed = True
                return True
        return False

    def repeat(self, code: Code) -> None:
        """Send this alarm in the next report even if nothing about it has changed."""
        if code in self._active:
            self._active[code].changed = True

    def listing(self) -> list[dict[str, int | str]]:
        """The alarms in force, highest priority first."""
        order = sorted(self._active, key=lambda code: (-PRIORITY[code], self._active[code].instance))
        return [
            {
                "code": code.name.lower(),
                "priority": PRIORITY[code].name.lower(),
                "state": self._active[code].state.name.lower(),
                "instance": self._active[code].instance,
                "aux": self._active[code].aux,
            }
            for code in order
        ]

    def history(self, code: Code) -> tuple[bool, bool, bool]:
        """Whether the alarm is in force, was raised since boot, and since `clear`."""
        alarm = self._active.get(code)
        in_force = alarm is not None and alarm.state != State.INACTIVE
        return in_force, bool(self._seen >> code & 1), bool(self._kept >> code & 1)

    def clear(self, code: Code) -> None:
        """Forget that it was raised; an alarm in force stays in force, and is remembered again if its cause holds."""
        self._seen &= ~(1 << code)
        self._kept &= ~(1 << code)

    def save(self) -> list[int]:
        """Words for the non-volatile memory: instances are not used twice, and the history outlives a reset."""
        return [self._next_instance, self._kept]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote; causes that still hold raise their alarms anew."""
        self._next_instance = next(words)
        self._kept = next(words)

    def renew(self, code: Code) -> None:
        """Something new of the same kind: pending again, also for a user who has confirmed the last one."""
        if code in self._active:
            self._active[code].state = State.PENDING
            self._active[code].changed = True

    def report(self, turn: Turn) -> None:
        """Send what changed and what is pending, highest priority first; forget what has ended."""
        order = sorted(self._active, key=lambda code: (-PRIORITY[code], self._active[code].instance))
        for code in order:
            alarm = self._active[code]
            if alarm.changed or alarm.state == State.PENDING:
                turn.send(
                    "CTRL_Alarm",
                    CtrlAlarmState=alarm.state,
                    CtrlAlarmPriority=PRIORITY[code],
                    CtrlAlarmCode=code,
                    CtrlAlarmInstance=alarm.instance,
                    CtrlAlarmAux=alarm.aux,
                )
                alarm.changed = False
            alarm.steps += 1
            if alarm.state == State.INACTIVE:
                del self._active[code]
