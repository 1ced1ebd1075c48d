"""A recorded run done again up to an instant, frame by frame, so that it can go on from there otherwise.

The record is the state: everything on the bench is a function of what it heard, so that whoever hears the beginning of
a run again is where it was then. That holds for a firmware that nobody can look into as well. Every frame is compared
with the record on the way, and one that differs ends the run.
"""

import itertools
import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from can_bus import codec
from can_bus.faults import clock
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from plant_server.pump import NMT_BOOT_UP
from plant_server.server import PlantServer, Run
from pumpbench.frames import Frames, concatenated
from pumpbench.signals import frame_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

_log = logging.getLogger("pumpbench.rewind")

DEVICE, PLANT = 0, 1
"""Channels of a record."""


class Diverged(RuntimeError):
    """The beginning of a recorded run did not come out as recorded; the text names the first frame that differs."""


@dataclass(frozen=True, eq=False)
class Origin:
    """A recorded run, and how much of it comes first in another one.

    Attributes:
        frames: its record.
        step: the instant up to which it is done again.
        since: the instant from which on the new run's firmware is the one that answers; before it, the plant is told
            what the record says. None: it is the one that answered all along.
        info: its run.json.
        state: that of a checkpoint, which the nodes are to be in at the instant; None: nobody has stored it.
    """

    frames: Frames
    step: int
    since: int | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    state: Mapping[str, Any] | None = None

    def beginning(self, channel: int) -> Frames:
        """The frames of one channel up to the instant; without a gateway both buses are the same."""
        chosen = self.frames.select(before(self.frames, self.step))
        known = chosen.select(chosen.channel == (channel if (self.frames.channel == PLANT).any() else DEVICE))
        return replace(known, channel=np.full(len(known), channel, "u1"))

    def calibration(self) -> dict[int, int]:
        """CfgIndex and raw value of what the device was flashed with, in that order."""
        message = codec.message("CFG_Param")
        flashed = {}
        beginning = self.frames.select((self.frames.turn < 0) & (self.frames.can_id == message.can_id))
        for frame in beginning.frames(int(beginning.channel.max(initial=DEVICE))):
            values = message.unpack(frame.data)
            index = values.pop("CfgIndex")
            flashed[index] = values[message.pages[index][0].name]
        return flashed


def before(frames: Frames, step: int) -> "NDArray[np.bool_]":
    """Which frames were on the bus before this instant opened; the calibration was before them all."""
    earlier: NDArray[np.bool_] = (frames.step < step) | (frames.turn < 0)
    return earlier


class RewoundPlant(PlantServer):
    """A plant that begins with a recorded run, and goes on by itself from an instant on.

    Args:
        run: with what changes from that instant on.
        origin: the record.

    Attributes:
        arrived: called at the instant, before anything of it is done.
    """

    def __init__(self, run: Run, origin: Origin) -> None:
        super().__init__(run)
        self.arrived: Callable[[], None] = lambda: None
        self._origin = origin
        recorded = origin.beginning(PLANT)
        self._record = recorded.frames(PLANT)
        self._record_steps = recorded.step.tolist()
        self._row = 0
        self._said: deque[Frame] = deque()  # by the plant, and not yet met in the record
        self._rewinding = False  # the roll call is no part of a record
        self._answers: list[Frame] = []  # of a device that is not asked, in this turn
        self._otherwise = False  # it has answered otherwise than the record
        self._done = codec.message("SYNC_Done")

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """As `PlantServer.receive`.

        Raises:
            Diverged: this frame, or what the plant answered to an earlier one, is not what the record has.
            PlantError: as there.
        """
        if not self._rewinding:
            calling = self._phase == Phase.INIT
            said = super().receive(frame)
            self._rewinding = calling and bool(said)
            self._said.extend(said if self._rewinding else ())
            return said
        answer = self._feed(frame) if self._fed else self._repeat(frame)
        if self._phase in (Phase.STEP, Phase.END) and self.step >= self._origin.step:
            self._rewinding = False
            if self._row < len(self._record):
                raise Diverged(f"{self._place()}: the device is done, the record goes on with {self._recorded()}")
        return answer

    def _open_step(self) -> list[Frame]:
        if self._rewinding and self.step == self._origin.step:
            self.arrived()
        return super()._open_step()

    @property
    def _fed(self) -> bool:
        """Whether the device's answers do not count yet."""
        since = self._origin.since
        return since is not None and (self._phase == Phase.CONFIG or self.step < since)

    def _repeat(self, frame: Frame) -> Sequence[Frame]:
        """Take a frame of the device, which is to be that of the record."""
        while self._said and self._row < len(self._record) and self._said[0] == self._record[self._row]:
            self._said.popleft()
            self._row += 1
        if self._row >= len(self._record) or self._record[self._row] != frame:
            culprit, other = ("the plant", self._said[0]) if self._said else ("the device", frame)
            raise Diverged(f"{self._place()}: the record has {self._recorded()}, now {culprit} says {_text(other)}")
        self._row += 1
        answer = super().receive(frame)
        self._said.extend(answer)
        return answer

    def _feed(self, frame: Frame) -> Sequence[Frame]:
        """Take a frame of a device that is not asked: when its turn is over, the plant hears that of the record."""
        self._answers.append(frame)
        if not self._ends_turn(frame):
            return ()
        recorded: list[Frame] = []
        answer: list[Frame] = []
        token = codec.message("SYNC_Step").can_id
        while self._row < len(self._record) and not any(each.can_id == token for each in answer):
            each = self._record[self._row]
            self._row += 1
            if self._said and self._said[0] == each:
                self._said.popleft()
                continue
            recorded.append(each)
            said = super().receive(each)
            self._said.extend(said)
            answer += said
        self._compare(recorded)
        if not self._fed:
            self._receiver.reset()  # whoever speaks from now on has counted its own frames
        return answer

    def _ends_turn(self, frame: Frame) -> bool:
        if boots_up(frame):
            return True
        if frame.can_id != self._done.can_id or len(frame.data) != self._done.length:
            return False
        return self._done.unpack(frame.data)["DoneStepIndex"] == self.step

    def _compare(self, recorded: list[Frame]) -> None:
        """Say once that the device answers otherwise than the one of the record; its work (SYNC_Done) may differ."""
        ours, theirs = (
            [frame for frame in frames if frame.can_id != self._done.can_id] for frames in (self._answers, recorded)
        )
        self._answers = []
        known = self._origin.since != self._origin.step  # it took over in an earlier fork, which has said so
        if ours == theirs or self._otherwise or known:
            return
        self._otherwise = True
        mine, other = next(pair for pair in itertools.zip_longest(ours, theirs) if pair[0] != pair[1])
        _log.warning(
            "this firmware answers otherwise than the recorded one since %s: %s, recorded was %s",
            clock(self._record_steps[self._row - 1] * STEP_SECONDS),
            _text(mine),
            _text(other),
        )

    def _place(self) -> str:
        return f"not as recorded at {clock(self.step * STEP_SECONDS)} (step {self.step})"

    def _recorded(self) -> str:
        return _text(self._record[self._row]) if self._row < len(self._record) else "nothing"


def boots_up(frame: Frame) -> bool:
    """Whether the device says with this frame that it has started anew."""
    heartbeat = codec.message("HB_CTRL")
    if frame.can_id != heartbeat.can_id or len(frame.data) != heartbeat.length:
        return False
    return heartbeat.unpack(frame.data)["NmtCtrl"] == NMT_BOOT_UP


def _text(frame: Frame | None) -> str:
    return "nothing" if frame is None else frame_text(frame)


def join(origin: Origin, frames: Frames) -> Frames:
    """The whole record of a run that began with another one: that of the origin up to the instant, then its own.

    Args:
        origin: what it began with.
        frames: what was recorded, from the calibration on.

    Raises:
        Diverged: what was to be done again was not the same on every bus.
    """
    channels = [DEVICE, PLANT] if (frames.channel == PLANT).any() else [DEVICE]
    past = before(frames, origin.step)
    parts = []
    for channel in channels:
        recorded = origin.beginning(channel)
        again = frames.select(past & (frames.channel == channel))
        _check(recorded.select(_asked(recorded, origin)), again.select(_asked(again, origin)))
        parts.append(recorded)
    parts.append(frames.select(~past))
    return concatenated(parts).in_order()


def _asked(frames: Frames, origin: Origin) -> "NDArray[np.bool_]":
    """Which frames came while the device's answers counted."""
    if origin.since is None:
        return np.ones(len(frames), bool)
    asked: NDArray[np.bool_] = (frames.step >= origin.since) & (frames.turn >= 0)
    return asked


def _check(recorded: Frames, again: Frames) -> None:
    common = min(len(recorded), len(again))
    same = np.ones(common, bool)
    for name in ("can_id", "length", "step"):
        same &= getattr(recorded, name)[:common] == getattr(again, name)[:common]
    same &= (recorded.data[:common] == again.data[:common]).all(axis=1)
    row = common if same.all() else int(np.flatnonzero(~same)[0])
    if row == len(recorded) == len(again):
        return
    one, other = (_text(each.frame(row)) if row < len(each) else "nothing" for each in (recorded, again))
    step = int((recorded if row < len(recorded) else again).step[row])
    raise Diverged(
        f"not as recorded at {clock(step * STEP_SECONDS)} (step {step}): the record has {one}, now the bus had {other}"
    )
