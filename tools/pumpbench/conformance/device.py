"""The device under test, wherever it is: a node in this process, or somebody's firmware at the far end of a bus."""

import contextlib
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import dbc
from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.faults.nodes import MemoryState
from can_bus.frame import Frame
from can_bus.link import Link
from can_bus.lockstep import Node, Phase
from pumpbench.conformance.driver import Silent, Violation

FRAMES_PER_TURN = 2000
"""More than that in one turn is a flood; the busiest turn of the reference has 60, those of its calibration."""

ROLL_CALL_SECONDS = 0.3
"""A device whose counters are those of an earlier run may miss the first call: it is called again."""

STRAY_SECONDS = 0.05
"""How long nothing must come before a device that has just started has said all it says."""


class Device(Node, Protocol):
    """A node that can also be started anew.

    Attributes:
        can_restart: whether `restart` can be used.
    """

    can_restart: bool

    def restart(self, memory: MemoryState = "kept") -> Sequence[Frame]:
        """Cut its power, do this to its memory, give it power again; returns what it says by itself."""

    def renew(self) -> None:
        """Before a check: forget what was said too late in the last one."""


class InProcess:
    """A node in this process.

    Args:
        build: makes the device from the text of its memory: "kept", "lost" or "torn", or None for a new one.
    """

    can_restart = True

    def __init__(self, build: Callable[[MemoryState | None], Node]) -> None:
        self._build = build
        self._node = build(None)

    @property
    def finished(self) -> bool:
        """Whether the node has nothing more to do."""
        return self._node.finished

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """What the node answers."""
        return self._node.receive(frame)

    def restart(self, memory: MemoryState = "kept") -> Sequence[Frame]:
        """A new node with the memory of the old one."""
        self._node = self._build(memory)
        start: Callable[[], Sequence[Frame]] = getattr(self._node, "start", list)
        return start()

    def renew(self) -> None:
        """A new node with a new memory."""
        self._node = self._build(None)


class Remote:
    """Somebody's firmware behind a link: frames go out with the next token, what comes up to SYNC_Done is the answer.

    Args:
        link: the device's bus.
        timeout: seconds to wait for SYNC_Done.
        watch: called while waiting; raises when the device's process has ended.
        restart: cuts the power and starts the device, if somebody can.
    """

    def __init__(
        self,
        link: Link,
        *,
        timeout: float = 5.0,
        watch: Callable[[], None] = lambda: None,
        restart: Callable[[MemoryState], None] | None = None,
    ) -> None:
        self._link = link
        self._timeout = timeout
        self._watch = watch
        self._restart = restart
        self.can_restart = restart is not None
        self.finished = False
        self._tokens = Receiver(["SYNC_Step"])
        self._token = codec.message("SYNC_Step").can_id
        self._done, self._length = codec.message("SYNC_Done").can_id, codec.message("SYNC_Done").length
        self._request = codec.message("UDS_Request").can_id
        self._said = {each.frame_id for each in dbc.load().messages if each.senders == ["CTRL"]}
        self._batch: list[Frame] = []

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Keep a frame for the next turn; send a token and wait for the end of the turn.

        Raises:
            Silent: SYNC_Done did not come in time, or the device has died.
            Violation: it spoke out of turn, or does not stop.
        """
        self._batch.append(frame)
        if frame.can_id == self._request:
            return self._converse()
        if frame.can_id != self._token:
            return ()
        check, _, token, _ = self._tokens.receive(frame)
        if check <= Check.OK_SOME_LOST and token["SyncPhase"] == Phase.INIT:
            return self._roll_call(token["StepIndex"])
        if check > Check.OK_SOME_LOST:
            return ()  # no device may answer this one
        self._flush()
        return self._turn()

    def _roll_call(self, call: int) -> list[Frame]:
        """Wait for the answer to just this call; none is no fault, it is called again."""
        self._tokens.reset()
        self._link.recv(0)  # the answer to an earlier call may have come late
        self._link.send(self._batch)
        self._batch = []
        frames: list[Frame] = []
        over = time.monotonic() + ROLL_CALL_SECONDS
        while (left := over - time.monotonic()) > 0:
            for frame in self._of_device(self._link.recv(left)):
                frames.append(frame)
                done = frame.can_id == self._done and len(frame.data) == self._length
                if done and codec.message("SYNC_Done").unpack(frame.data)["DoneStepIndex"] == call:
                    return frames
                if done:
                    frames = []
            self._alive()
        return []

    def _flush(self) -> None:
        early = self._of_device(self._link.recv(0))
        if early:
            raise Violation(f"silence out of turn; {len(early)} frames came, the first with id 0x{early[0].can_id:03X}")
        self._link.send(self._batch)
        self._batch = []

    def _of_device(self, frames: Sequence[Frame]) -> list[Frame]:
        return [frame for frame in frames if frame.can_id in self._said]

    def _turn(self) -> list[Frame]:
        frames: list[Frame] = []
        over = time.monotonic() + self._timeout
        while (left := over - time.monotonic()) > 0:
            frames += self._of_device(self._link.recv(min(left, 0.25)))
            for place, frame in enumerate(frames):
                if frame.can_id == self._done:
                    if place + 1 < len(frames):
                        more = f"{len(frames) - place - 1} frames came behind it"
                        raise Violation(f"SYNC_Done as the last frame of a turn; {more}")
                    return frames
            if len(frames) > FRAMES_PER_TURN:
                raise Violation(f"at most {FRAMES_PER_TURN} frames in a turn; the device does not stop")
            self._alive()
        what = f"{len(frames)} other frames came" if frames else "nothing came"
        raise Silent(f"SYNC_Done within {self._timeout:g} s; {what}")

    def _converse(self) -> list[Frame]:
        """Whatever comes until nothing comes any more: a tester is answered out of turn."""
        self._flush()
        frames: list[Frame] = []
        while found := self._of_device(self._link.recv(STRAY_SECONDS if frames else ROLL_CALL_SECONDS)):
            frames += found
        return frames

    def _alive(self) -> None:
        try:
            self._watch()
        except RuntimeError as error:
            raise Silent(f"a device that lives; {error}") from error

    def restart(self, memory: MemoryState = "kept") -> Sequence[Frame]:
        """Start it anew; returns what it says until it is quiet.

        Raises:
            Silent: it says nothing in time.
        """
        assert self._restart is not None, "asked for a restart where there is none"
        self._batch = []
        self._tokens.reset()  # as the device does
        self._restart(memory)
        frames: list[Frame] = []
        over = time.monotonic() + self._timeout
        while time.monotonic() < over and not frames:
            frames += self._of_device(self._link.recv(0.25))
            self._alive()
        if not frames:
            raise Silent(f"HB_CTRL BootUp within {self._timeout:g} s of a start; nothing came")
        while more := self._of_device(self._link.recv(STRAY_SECONDS)):
            frames += more
        return frames

    def renew(self) -> None:
        """Forget what is still to be read."""
        self._batch = []
        with contextlib.suppress(Violation):
            while self._link.recv(STRAY_SECONDS):
                self._alive()
