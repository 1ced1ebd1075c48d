"""Applies faults to what passes the gateway."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from can_bus import codec
from can_bus.frame import CAN_ERR_FLAG, MAX_DATA, Frame
from can_bus.lockstep import STEP_SECONDS

from .base import TARGETS, Fault, FrameFault, Held, Memory, report
from .bus import ERROR_BUS_OFF, ERROR_RESTARTED, BusFault, BusOff

LOCKSTEP = frozenset(codec.message(name).can_id for name in ("SYNC_Step", "SYNC_Done", "PLANT_Info"))
"""What keeps the bench going: a controller that is off the bus gets and gives it all the same."""


@dataclass
class _Waiting:
    """A frame that goes on later."""

    frame: Frame
    time: int | None
    frames: int | None
    behind: int | None


@dataclass
class _Lane:
    """One direction: what waits in it, and the instant up to which injections of the bus are done."""

    waiting: deque[_Waiting] = field(default_factory=deque)
    step: int = -1

    def hold(self, held: Held) -> None:
        self.waiting.append(_Waiting(*held))

    def due(self, time: int) -> list[Frame]:
        """What goes ahead of the frame that comes at this time."""
        if not self.waiting:
            return []
        ready = [each for each in self.waiting if each.time is not None and time >= each.time]
        return self._let_go(ready)

    def passed(self, can_id: int, already: int) -> list[Frame]:
        """What goes behind a frame with this id; the last `already` that wait have only just come."""
        ready = []
        for each in list(self.waiting)[: len(self.waiting) - already]:
            if each.frames is not None:
                each.frames -= 1
            if each.frames == 0 or each.behind == can_id:
                ready.append(each)
        return self._let_go(ready)

    def _let_go(self, ready: list[_Waiting]) -> list[Frame]:
        for each in ready:
            self.waiting.remove(each)
        return [each.frame for each in ready]


class Injector:
    """Faults of the wire at work; remembers how often each has acted, and holds the frames that are late.

    Args:
        faults: those that act on frames or on the bus; in the order of the list where several act on one frame.
    """

    def __init__(self, faults: Sequence[Fault]) -> None:
        places = [index if fault.place is None else fault.place for index, fault in enumerate(faults)]
        seeds = [
            f"{place} {fault.kind} {getattr(fault, 'seed', 0)}" for place, fault in zip(places, faults, strict=True)
        ]
        self._memories = [Memory(seed) for seed in seeds]
        self._by_id: dict[int, list[tuple[FrameFault, Memory]]] = {}
        self._on_bus: list[tuple[BusFault, Memory]] = []
        self._off: list[BusOff] = []
        self._was_off = False
        self._newest: dict[str, dict[str, int]] = {}
        self._watched: set[int] = set()
        for fault, memory in zip(faults, self._memories, strict=True):
            if isinstance(fault, FrameFault):
                self._by_id.setdefault(codec.message(fault.message).can_id, []).append((fault, memory))
                if fault.condition is not None:
                    self._watched.add(codec.message(fault.condition.message).can_id)
            elif isinstance(fault, BusFault):
                self._on_bus.append((fault, memory))
            elif isinstance(fault, BusOff):
                self._off.append(fault)
        self._lanes = {"device": _Lane(), "plant": _Lane()}

    def apply(self, frame: Frame, time: int, side: str) -> tuple[list[Frame], list[Frame]]:
        """What becomes of a frame on its way to `side` ("device" or "plant") at a simulated second.

        Returns:
            The frames that go on to that side in its place, and the FAULT_Inject frames that tell what was done, which
            go ahead of them.
        """
        lane = self._lanes[side]
        ahead = lane.due(time)
        reports: list[Frame] = []
        passing = [frame]
        held = 0
        for fault, memory in self._by_id.get(frame.can_id, ()):
            fault.see(frame, memory)
            now = next((each for each in passing if each.can_id == frame.can_id), None)
            if now is None or not fault.chosen(time, memory, self._newest):
                continue
            made = fault.act(now, time, memory)
            if made is None:
                continue
            memory.acted += 1
            reports.append(report(fault.code, TARGETS[fault.codec.sender], time, frame.can_id))
            at = passing.index(now)
            passing[at : at + 1] = [each for each in made if isinstance(each, Frame)]
            for each in made:
                if isinstance(each, Held):
                    lane.hold(each)
                    held += 1
        if frame.can_id in self._watched:
            self._remember(frame)
        if self._off and any(fault.open(time) for fault in self._off) and frame.can_id not in LOCKSTEP:
            reports.append(report(BusOff.CODE, TARGETS["CTRL"], time, frame.can_id & 0x7FF))
            passing = []
        return ahead + passing + lane.passed(frame.can_id, held), reports

    def _remember(self, frame: Frame) -> None:
        watched = codec.messages_by_id()[frame.can_id]
        if len(frame.data) == watched.length:
            self._newest[watched.name] = watched.unpack(frame.data)

    def barrier(self, time: int, side: str) -> list[Frame]:
        """What faults of the bus put on `side` in a step, ahead of the frame that passes the turn on; reports first."""
        lane = self._lanes[side]
        step = time // STEP_SECONDS
        if step == lane.step:
            return []  # a further turn of the same step
        lane.step = step
        reports: list[Frame] = []
        frames: list[Frame] = []
        for fault, memory in self._on_bus:
            if fault.side != side or not fault.open(time):
                continue
            memory.matched += 1
            if (memory.matched - 1) % fault.every:
                continue
            made = fault.inject(memory)
            reports.append(report(fault.CODE, fault.target, time, fault.can_id, len(made)))
            frames += made
        if side == "device" and self._off:
            off = any(fault.open(time) for fault in self._off)
            if off != self._was_off:
                self._was_off = off
                reports.append(report(BusOff.CODE, TARGETS["CTRL"], time))
                frames.append(Frame(CAN_ERR_FLAG | (ERROR_BUS_OFF if off else ERROR_RESTARTED), bytes(MAX_DATA)))
        return reports + frames
