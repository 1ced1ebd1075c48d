"""The gateway between the device's bus and the plant's: where frames are lost, late or forged on purpose.

It is a wire with faults: what arrives on one side goes out on the other in the same order, except for what a fault does
to it. Every injection is itself a frame, FAULT_Inject, on the bus the faulty frame was headed for. While the device has
no power or hangs, the gateway takes its turn, so that simulated time goes on.

Simulated time is read off the lockstep: what the plant sends after SYNC_Done(k) belongs to instant k+1, although the
token of that instant comes last. On a device that does not do lockstep, the newest SYNC_Step tells the time. The roll
call passes untouched: faults begin with the calibration.
"""

import argparse
import contextlib
import enum
import select
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from can_bus import codec
from can_bus.faults import (
    TARGETS,
    Fault,
    Hang,
    Injector,
    Kill,
    NodeControl,
    NodeFault,
    Restart,
    load_faults,
    report,
)
from can_bus.faults.fields import repaired
from can_bus.frame import Frame
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.lockstep import EXEC_TIME_SNA, STEP_SECONDS, Done, Phase
from can_bus.node_control import CommandControl, SocketControl
from can_bus.process import exit_status
from can_bus.url import open_link

TAP_EVERY = 0.2
"""Seconds after which a tap's hub is run even if nothing crosses: a recorder may be knocking."""


class Side(enum.IntEnum):
    """The two ends of the gateway; also the channel numbers of a recording."""

    DEVICE = 0
    PLANT = 1


class Clock:
    """Simulated time as the frames tell it.

    Attributes:
        token_id, done_id: whose frames it wants to see.
        time: simulated seconds.
        running: the roll call is over; how often the roll was called depends on the wall clock, so that a fault must
            not act on it.
        ended: the device has answered the last token, or in a free run the last token was given.
        first_turn: the newest token opened a step.
        step: of the newest token.
    """

    def __init__(self, *, free_running: bool = False) -> None:
        self._free_running = free_running
        self.time = 0
        self.running = False
        self.ended = False
        self.first_turn = False
        self._token = codec.message("SYNC_Step")
        self._done = codec.message("SYNC_Done")
        self.token_id, self.done_id = self._token.can_id, self._done.can_id
        self._phase: int = Phase.INIT
        self.step = -1

    def token(self, frame: Frame) -> None:
        """The plant gives the turn, whether the device gets to know or not."""
        self.first_turn = False
        if len(frame.data) != self._token.length:
            return
        values = self._token.unpack(frame.data)
        self._phase, self.step = values["SyncPhase"], values["StepIndex"]
        self.running = self._phase != Phase.INIT
        if self._phase == Phase.INIT:
            self.time = 0
        elif self._phase == Phase.END:
            self.ended |= self._free_running
        elif self._phase == Phase.STEP:
            self.first_turn = True
            self.time = self.step * STEP_SECONDS

    def asks_for_more(self, frame: Frame) -> bool:
        """Whether a SYNC_Done says Continue."""
        return len(frame.data) == self._done.length and self._done.unpack(frame.data)["DoneStatus"] == Done.CONTINUE

    def done(self, frame: Frame) -> None:
        """The plant hears that the device's turn is over; what does not answer its token is ignored there too."""
        if len(frame.data) != self._done.length:
            return
        values = self._done.unpack(frame.data)
        if values["DoneStepIndex"] != self.step:
            return
        if self._phase == Phase.INIT:
            self.running = True
        elif self._phase == Phase.END:
            self.ended = True
        elif self._phase in (Phase.STEP, Phase.CONTINUE) and values["DoneStatus"] != Done.CONTINUE:
            self.time = (self.step + 1) * STEP_SECONDS


class Crossing(NamedTuple):
    """What the gateway puts on either bus for a frame."""

    device: list[Frame]
    plant: list[Frame]


class Stamp:
    """Numbers the frames of one message anew, once the gateway has added or swallowed one of them."""

    def __init__(self, name: str) -> None:
        self._codec = codec.message(name)
        self._next: int | None = None
        self._last = -1

    def restart(self) -> None:
        """The sender has started anew, its counter too."""
        self._next, self._last = None, -1

    def passed(self, frame: Frame) -> Frame:
        """The frame as it goes on."""
        if len(frame.data) != self._codec.length:
            return frame
        if self._next is None:
            self._last = frame.data[1] & 0xF
            return frame
        return Frame(frame.can_id, repaired(self._codec, frame.data, self._count()))

    def swallowed(self) -> None:
        """A frame of the sender's was kept back."""
        if self._next is None:
            self._next = (self._last + 1) % codec.COUNTER_MODULUS

    def added(self, **values: int) -> Frame:
        """A frame in the sender's place."""
        self.swallowed()
        return Frame(self._codec.can_id, codec.protect(self._codec, self._codec.pack(values), self._count()))

    def _count(self) -> int:
        assert self._next is not None
        number = self._next
        self._next = (number + 1) % codec.COUNTER_MODULUS
        return number


class Gateway:
    """The gateway without its buses: a frame in, what goes out on either side.

    Args:
        faults: what is to go wrong.
        control: who runs the device; needed by faults that take its power or its time away.
        free_running: the device answers no token.

    Raises:
        ValueError: such a fault, and nobody who could do it.
    """

    def __init__(
        self, faults: Sequence[Fault] = (), control: NodeControl | None = None, *, free_running: bool = False
    ) -> None:
        self._injector = Injector([fault for fault in faults if not isinstance(fault, NodeFault)])
        self._clock = Clock(free_running=free_running)
        self._tokens, self._dones = Stamp("SYNC_Step"), Stamp("SYNC_Done")
        self._device = _Device([fault for fault in faults if isinstance(fault, NodeFault)], control)

    @property
    def finished(self) -> bool:
        """True when the end of the run has been passed on."""
        return self._clock.ended

    def forward(self, frame: Frame, source: Side) -> Crossing:
        """What the buses get for a frame that came from this side.

        What goes back to where a frame came from does so only when that side has passed the turn on and is silent, so
        that the order on either bus is always the same.
        """
        if source == Side.DEVICE:
            return Crossing([], self._from_device(frame))
        if frame.can_id == self._clock.token_id:
            return self._from_plant_token(frame)
        if not self._clock.running:
            return Crossing([frame], [])
        if self._device.absent:
            return Crossing([], [])
        passed, reports = self._injector.apply(frame, self._clock.time, "device")
        return Crossing(reports + passed, [])

    def _from_plant_token(self, frame: Frame) -> Crossing:
        clock = self._clock
        was_running = clock.running
        clock.token(frame)
        if not was_running:
            return Crossing([frame], [])
        before: list[Frame] = []
        if clock.first_turn:
            self._device.strike(clock.time)
        if self._device.absent:
            self._tokens.swallowed()
            return Crossing([], self._take_turn())
        if clock.first_turn:
            before = self._device.told() + self._injector.barrier(clock.time, "device")
        passed, reports = self._injector.apply(self._tokens.passed(frame), clock.time, "device")
        return Crossing(before + reports + passed, [])

    def _take_turn(self) -> list[Frame]:
        """Answer a token in the device's place, unless the device is about to."""
        fault = self._device.down
        if fault is None:
            return []
        clock = self._clock
        done = self._dones.added(DoneStatus=Done.OK, DoneStepIndex=clock.step, ExecTime=EXEC_TIME_SNA, TxCount=1)
        told = report(fault.code, TARGETS["CTRL"], clock.time)
        clock.done(done)
        return [told, done]

    def _from_device(self, frame: Frame) -> list[Frame]:
        clock = self._clock
        if not clock.running:
            if frame.can_id == clock.done_id:
                clock.done(frame)
            return [frame]
        if self._device.absent:
            if not self._device.heard(frame):
                return []
            self._dones.restart()
            return [frame]  # the lockstep hangs on it: no fault acts on this one
        is_done = frame.can_id == clock.done_id
        ends_step = is_done and not clock.asks_for_more(frame)
        if self._device.cuts(is_done=is_done, ends_step=ends_step):
            return []
        before = self._injector.barrier(clock.time, "plant") if ends_step else []
        stamped = self._dones.passed(frame) if is_done else frame
        passed, reports = self._injector.apply(stamped, clock.time, "plant")
        if is_done and stamped in passed:
            clock.done(stamped)
        return before + reports + passed


class _Device:
    """Whether there is a device behind the gateway, and what faults of the node do about it."""

    def __init__(self, faults: Sequence[Restart | Kill | Hang], control: NodeControl | None) -> None:
        self._to_come = sorted(faults, key=lambda each: each.start)
        if faults and control is None:
            raise ValueError(
                f"{faults[0].kind}: a fault of the device needs somebody who runs it: "
                "`pumpbench run`, or --node with the command that does it"
            )
        self._control = control
        self._hb_id = codec.message("HB_CTRL").can_id
        self._cut: Restart | None = None  # loses its power when so many more frames have passed
        self._left = 0
        self._booting = False  # has its power back and has not said so yet
        self._reports: list[Frame] = []
        self.down: Restart | Kill | Hang | None = None

    @property
    def absent(self) -> bool:
        """Nobody listens: no power, hangs, dead, or has just started."""
        return self._booting or self.down is not None

    def strike(self, time: int) -> None:
        """At the token of an instant: what is due ends or begins."""
        control = self._control
        if control is None:
            return
        if self.down is not None:
            if self.down.end is None or time < self.down.end:
                return
            over, self.down = self.down, None
            if isinstance(over, Hang):
                control.thaw()
            else:
                self._start(over, time)
        while self._to_come and time >= self._to_come[0].start and not self.absent and self._cut is None:
            fault = self._to_come.pop(0)
            if isinstance(fault, Restart) and fault.after_frames is not None:
                self._cut, self._left = fault, fault.after_frames
                self._time = time
            elif isinstance(fault, Restart) and fault.end is None:
                control.cut()
                self._start(fault, time)
            else:
                control.freeze() if isinstance(fault, Hang) else control.cut()
                self.down = fault

    def cuts(self, *, is_done: bool, ends_step: bool) -> bool:
        """Whether a frame of the device's turn is one that did not get out any more."""
        if self._cut is None:
            return False
        if self._left > 0 and not ends_step:
            self._left -= 1
            return False
        if self._left > 0:  # the whole turn is out: the power goes with the next one
            self._to_come.insert(0, self._cut.model_copy(update={"after_frames": None}))
            self._cut = None
            return False
        if is_done:  # by now it has said all that it would have said
            fault, self._cut = self._cut, None
            assert self._control is not None
            self._control.cut()
            self._start(fault, self._time)
        return True

    def _start(self, fault: Restart | Kill, time: int) -> None:
        assert self._control is not None and isinstance(fault, Restart)
        self._booting = True
        self._reports.append(report(fault.code, TARGETS["CTRL"], time))
        self._control.start(fault.memory)

    def heard(self, frame: Frame) -> bool:
        """Whether this frame says that the device is back."""
        if not self._booting or frame.can_id != self._hb_id or len(frame.data) != 2 or frame.data[0] & 0x7F:
            return False
        self._booting = False
        return True

    def told(self) -> list[Frame]:
        """Reports of what was done to the device, once there is somebody on its bus."""
        reports, self._reports = self._reports, []
        return reports


def serve(gateway: Gateway, device: Link, plant: Link, tap: Link | None = None) -> None:
    """Join two buses until the run ends.

    Args:
        gateway: what becomes of the frames.
        device: the device's bus; error frames are left out where it cannot carry them (slcan).
        plant: the plant's bus.
        tap: gets all frames of the device's bus in order, for a recorder where only one program can open that bus.

    Raises:
        BusLost: one of the buses is gone or lost frames.
    """
    sides = {device.fileno(): (device, Side.DEVICE), plant.fileno(): (plant, Side.PLANT)}
    while not gateway.finished:
        ready, _, _ = select.select(list(sides), [], [], None if tap is None else TAP_EVERY)
        for descriptor in ready:
            link, side = sides[descriptor]
            to_device: list[Frame] = []
            to_plant: list[Frame] = []
            frames = link.recv(0)
            for frame in frames:
                crossing = gateway.forward(frame, side)
                to_device += crossing.device
                to_plant += crossing.plant
            if tap is not None and (to_device or side == Side.DEVICE):
                tap.send([*(frames if side == Side.DEVICE else ()), *to_device])
            if to_device:
                device.send(to_device if device.carries_errors else [each for each in to_device if not each.is_error])
            if to_plant:
                plant.send(to_plant)
        if tap is not None:
            tap.recv(0)  # nobody speaks there; this runs its hub


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit status 0 the run ended, 2 wrong usage or fault file, 3 a bus was lost."""
    parser = argparse.ArgumentParser(prog="python -m can_bus.gateway", description=__doc__)
    parser.add_argument("--plant", required=True, metavar="URL", help="the plant's bus")
    parser.add_argument("--device", required=True, metavar="URL", help="the device's bus")
    parser.add_argument("--host", action="store_true", help="serve the device's bus as a hub, from this process")
    parser.add_argument("--tap", metavar="URL", help="serve a hub that shows the device's bus, for a recorder")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="YAML file of faults")
    parser.add_argument("--free-running", action="store_true", help="the device answers no token")
    switch = parser.add_mutually_exclusive_group()
    switch.add_argument("--node", metavar="CMD", help="switches the device: run with cut, start kept, freeze or thaw")
    switch.add_argument("--node-socket", type=int, metavar="FD", help="a stream socket whose other end switches it")
    options = parser.parse_args(arguments)
    try:
        faults = load_faults(options.faults) if options.faults else ()
        gateway = Gateway(faults, _control(options), free_running=options.free_running)
    except ValueError as error:
        print(f"gateway: {error}", file=sys.stderr)
        return 2
    return exit_status("gateway", lambda: _join(gateway, options))


def _control(options: argparse.Namespace) -> NodeControl | None:
    if options.node is not None:
        return CommandControl(options.node)
    if options.node_socket is not None:
        return SocketControl(socket.socket(fileno=options.node_socket))
    return None


def _join(gateway: Gateway, options: argparse.Namespace) -> None:
    with contextlib.ExitStack() as stack:
        plant = stack.enter_context(open_link(options.plant))
        if options.host:
            device: Link = stack.enter_context(stack.enter_context(Hub(options.device)).local_link())
        else:
            device = stack.enter_context(open_link(options.device))
        tap: Link | None = None
        if options.tap:
            tap = stack.enter_context(stack.enter_context(Hub(options.tap)).local_link())
        print("ready", flush=True)
        serve(gateway, device, plant, tap)


if __name__ == "__main__":
    sys.exit(main())
