"""What the device hears: every frame judged, values kept for the step they belong to, and everything amiss counted.

Amiss are frames that E2E refuses, frames that were lost, error frames, frames that somebody else sends in the device's
name, and nodes that have fallen silent (requirements E2E-01 to E2E-07).
"""

import dbc
from can_bus.codec import Check, Receiver, message
from can_bus.frame import Frame

from .alarms import ALARM_HOLD
from .e2e_window import E2eWindow
from .heartbeat import Heartbeat

DIAGNOSTICS = "UDS_Request"
"""The one message that is answered out of turn, and that no task sees."""

CYCLIC = ("CGM_Reading", "PUMP_Status", "PUMP_Delivered")
"""Messages of every step whose values are used only while `E2eWindow` calls them valid (requirement E2E-03)."""

BATCH = (*CYCLIC, "PUMP_BolusState")
"""Messages that tell of the instant whose token follows: kept until a task of that step takes them."""

HEARTBEATS = {"HB_PUMP": "TogglePump", "HB_CGM": "ToggleCgm"}
"""Heartbeats that are watched, each with its toggle bit."""

NEVER = -(1 << 20)


def subscriptions() -> list[str]:
    """Names of the messages the DBC addresses to CTRL."""
    return [each.name for each in dbc.load().messages if "CTRL" in each.receivers]


def own_messages() -> list[str]:
    """Names of the messages that nobody but CTRL may send."""
    return [each.name for each in dbc.load().messages if each.senders == ["CTRL"]]


class Wire:
    """The receiving end of the device since its start or the last roll call."""

    def __init__(self) -> None:
        self._receiver = Receiver(name for name in subscriptions() if name != DIAGNOSTICS)
        self._own_ids = frozenset(message(name).can_id for name in own_messages())
        self._windows = {name: E2eWindow() for name in CYCLIC}
        self._valid: dict[str, bool] = {}  # of the step that runs
        self._batch: dict[str, list[dict[str, int]]] = {name: [] for name in BATCH}
        self._heartbeats = {name: Heartbeat() for name in HEARTBEATS}
        self._frames = 0  # since the last step
        self._bus_errors = 0  # error frames of the controller
        self._impostors = 0  # frames with an id of ours that we did not send
        self._impostors_seen = 0  # at the last step
        self._impostor_step = NEVER
        self._samples_lost = 0  # of the CGM, by the counter of its frames, when the newest sample came
        self._lost_unseen = 0  # CGM frames lost that this counter could not show

    # ---- between two steps

    def hear(self, frame: Frame) -> tuple[Check, str, dict[str, int]]:
        """Judge a frame: what E2E says of it, its message and, where they may be read, its values."""
        check, name, values, _ = self._receiver.receive(frame)
        if check == Check.UNKNOWN:
            self._impostors += frame.can_id in self._own_ids  # a node never hears itself
            self._bus_errors += frame.is_error
            return check, name, values
        self._frames += 1
        if name in self._windows:
            self._windows[name].hear(check)
        if check <= Check.OK_SOME_LOST:
            if name in BATCH:
                self._batch[name].append(values)
            elif name in HEARTBEATS:
                self._heartbeats[name].hear(values[HEARTBEATS[name]])
        return check, name, values

    def impostor(self) -> None:
        """Somebody else has sent a frame in the device's name, as another node's answer shows."""
        self._impostors += 1

    # ---- the step

    def close(self, step: int) -> int:
        """Judge what came for instant `step` as a whole, before any task takes it; the number of frames."""
        if self._impostors > self._impostors_seen:
            self._impostors_seen = self._impostors
            self._impostor_step = step
        self._valid = {name: window.close() for name, window in self._windows.items()}
        for heartbeat in self._heartbeats.values():
            heartbeat.close(step)
        frames, self._frames = self._frames, 0
        return frames

    def take(self, name: str) -> tuple[list[dict[str, int]], int]:
        """What came of a message of the batch: the values that may be used, and the number of those that may not."""
        came, self._batch[name] = self._batch[name], []
        return (came, 0) if self._valid.get(name, True) else ([], len(came))

    def newest(self, name: str) -> dict[str, int] | None:
        """The newest values of a message of the batch; None where none may be used."""
        usable, _ = self.take(name)
        return usable[-1] if usable else None

    def used_sample(self, missing: int) -> None:
        """A sample is used before whose number so many are missing: of these the frames' own counter may know."""
        lost = self._receiver.lost_of("CGM_Reading")
        # the 4-bit counter of the frames is blind to a gap of 16, the number of the sample is not
        self._lost_unseen += max(missing - (lost - self._samples_lost), 0)
        self._samples_lost = lost

    def silence(self, heartbeat: str, step: int) -> int:
        """Steps since the sender of a heartbeat was last alive; 0 if it has never told."""
        return self._heartbeats[heartbeat].silence(step)

    def alone(self, step: int) -> bool:
        """Whether nobody else speaks in the device's name, and nobody has for as long as the alarm lasts."""
        return step - self._impostor_step >= ALARM_HOLD

    # ---- counters

    @property
    def e2e_errors(self) -> int:
        """Frames that are not what they claim to be, and errors on the bus."""
        return self._receiver.crc_errors + self._receiver.malformed + self._impostors + self._bus_errors

    @property
    def lost_frames(self) -> int:
        """Frames that never came, by their counters and by the numbers of samples."""
        return self._receiver.lost + self._lost_unseen

    @property
    def sequence_errors(self) -> int:
        """Frames whose counter stood still or leapt too far."""
        return self._receiver.sequence_errors
