"""What the pump shows its user: an alarm per cause, repeated until it is confirmed, gone with its cause."""

import enum
from collections.abc import Collection
from dataclasses import dataclass

from can_bus.codec import Transmitter
from can_bus.frame import Frame

INSTANCES = 65535
"""PumpAlarmInstance runs from 0 to 65534."""


class Alarm(enum.IntEnum):
    """PUMP_Alarm.PumpAlarmCode."""

    OCCLUSION = 5
    RESERVOIR_LOW = 6
    RESERVOIR_EMPTY = 7
    BATTERY_LOW = 8
    BATTERY_EMPTY = 9
    CTRL_LOST = 21


HIGH, MEDIUM = 3, 2
PRIORITY = {
    Alarm.OCCLUSION: HIGH,
    Alarm.RESERVOIR_LOW: MEDIUM,
    Alarm.RESERVOIR_EMPTY: HIGH,
    Alarm.BATTERY_LOW: MEDIUM,
    Alarm.BATTERY_EMPTY: HIGH,
    Alarm.CTRL_LOST: HIGH,
}
"""PUMP_Alarm.PumpAlarmPriority of each code (requirement ALM-02)."""

INACTIVE, PENDING, CONFIRMED = 0, 1, 2
"""PUMP_Alarm.PumpAlarmState."""

AUX_INSULIN, AUX_PRAMLINTIDE, AUX_PUMP = 1, 2, 0
"""PUMP_Alarm.PumpAlarmAux: which drug it is about."""

Cause = tuple[Alarm, int]
"""Its code and what it is about."""


@dataclass
class _Shown:
    """An alarm whose cause is there."""

    instance: int
    state: int = PENDING
    told: bool = False


class Alarms:
    """The alarms of one pump."""

    def __init__(self) -> None:
        self._shown: dict[Cause, _Shown] = {}
        self._next_instance = 0

    def report(self, causes: Collection[Cause], transmitter: Transmitter) -> list[Frame]:
        """The frames of a step in which these causes are there: one per change of state, repeated until confirmed."""
        for cause in sorted(causes - self._shown.keys()):
            self._shown[cause] = _Shown(self._next_instance)
            self._next_instance = (self._next_instance + 1) % INSTANCES
        frames = []
        for cause, alarm in sorted(self._shown.items(), key=lambda item: (-PRIORITY[item[0][0]], item[1].instance)):
            if cause not in causes:
                alarm.state, alarm.told = INACTIVE, False
            if alarm.told and alarm.state != PENDING:
                continue
            alarm.told = True
            code, drug = cause
            frames.append(
                transmitter.frame(
                    "PUMP_Alarm",
                    PumpAlarmState=alarm.state,
                    PumpAlarmPriority=PRIORITY[code],
                    PumpAlarmCode=code,
                    PumpAlarmInstance=alarm.instance,
                    PumpAlarmAux=drug,
                )
            )
        self._shown = {cause: alarm for cause, alarm in self._shown.items() if cause in causes}
        return frames

    def pending(self) -> list[int]:
        """Instances that the user has been told of and has not confirmed."""
        return [alarm.instance for alarm in self._shown.values() if alarm.state == PENDING and alarm.told]

    def confirm(self, instance: int) -> None:
        """The user confirms an alarm; its cause stays."""
        for alarm in self._shown.values():
            if alarm.instance == instance and alarm.state == PENDING:
                alarm.state, alarm.told = CONFIRMED, False
