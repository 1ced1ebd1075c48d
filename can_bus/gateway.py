"""The gateway between the device's bus and the plant's: where frames are lost, late or forged on purpose.

It is a wire with faults: what arrives on one side goes out on the other in the same order, except for what a fault does
to it. Every injection is itself a frame, FAULT_Inject, on the bus the faulty frame was headed for.

Simulated time is read off the lockstep: what the plant sends after SYNC_Done(k) belongs to instant k+1, although the
token of that instant comes last. On a device that does not do lockstep, the newest SYNC_Step tells the time. The roll
call passes untouched: faults begin with the calibration.
"""

import argparse
import contextlib
import enum
import select
import sys
from collections.abc import Sequence
from pathlib import Path

from can_bus import codec
from can_bus.faults import Fault, Injector, load_faults
from can_bus.frame import Frame
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.lockstep import STEP_SECONDS, Done, Phase
from can_bus.process import exit_status
from can_bus.url import open_link


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
        ended: the device has answered the last token.
    """

    def __init__(self) -> None:
        self.time = 0
        self.running = False
        self.ended = False
        self._token = codec.message("SYNC_Step")
        self._done = codec.message("SYNC_Done")
        self.token_id, self.done_id = self._token.can_id, self._done.can_id
        self._phase: int = Phase.INIT
        self._step = -1

    def token(self, frame: Frame) -> None:
        """The plant gives the turn, whether the device gets to know or not."""
        if len(frame.data) != self._token.length:
            return
        values = self._token.unpack(frame.data)
        self._phase, self._step = values["SyncPhase"], values["StepIndex"]
        self.running = self._phase != Phase.INIT
        if self._phase == Phase.INIT:
            self.time = 0
        elif self._phase == Phase.STEP:
            self.time = self._step * STEP_SECONDS

    def done(self, frame: Frame) -> None:
        """The plant hears that the device's turn is over; what does not answer its token is ignored there too."""
        if len(frame.data) != self._done.length:
            return
        values = self._done.unpack(frame.data)
        if values["DoneStepIndex"] != self._step:
            return
        if self._phase == Phase.INIT:
            self.running = True
        elif self._phase == Phase.END:
            self.ended = True
        elif self._phase in (Phase.STEP, Phase.CONTINUE) and values["DoneStatus"] != Done.CONTINUE:
            self.time = (self._step + 1) * STEP_SECONDS


class Gateway:
    """The gateway without its buses: a frame in, what goes out on the other side."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self._injector = Injector(faults)
        self._clock = Clock()

    @property
    def finished(self) -> bool:
        """True when the end of the run has been passed on."""
        return self._clock.ended

    def forward(self, frame: Frame) -> list[Frame]:
        """What the other side gets for this frame."""
        clock = self._clock
        passed, reports = self._injector.apply(frame, clock.time) if clock.running else ([frame], [])
        if frame.can_id == clock.token_id:
            clock.token(frame)
        elif frame.can_id == clock.done_id and frame in passed:
            clock.done(frame)
        return reports + passed


def serve(gateway: Gateway, device: Link, plant: Link) -> None:
    """Join two buses until the run ends.

    Raises:
        BusLost: one of the buses is gone or lost frames.
    """
    other = {device.fileno(): (device, plant), plant.fileno(): (plant, device)}
    while not gateway.finished:
        ready, _, _ = select.select(list(other), [], [])
        for descriptor in ready:
            source, sink = other[descriptor]
            frames = source.recv(0)
            out = [forwarded for frame in frames for forwarded in gateway.forward(frame)]
            if out:
                sink.send(out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit status 0 the run ended, 2 wrong usage or fault file, 3 a bus was lost."""
    parser = argparse.ArgumentParser(prog="python -m can_bus.gateway", description=__doc__)
    parser.add_argument("--plant", required=True, metavar="URL", help="the plant's bus")
    parser.add_argument("--device", required=True, metavar="URL", help="the device's bus")
    parser.add_argument("--host", action="store_true", help="serve the device's bus as a hub, from this process")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="YAML file of faults")
    options = parser.parse_args(arguments)
    return exit_status("gateway", lambda: _join(options))


def _join(options: argparse.Namespace) -> None:
    gateway = Gateway(load_faults(options.faults) if options.faults else ())
    with contextlib.ExitStack() as stack:
        plant = stack.enter_context(open_link(options.plant))
        if options.host:
            device: Link = stack.enter_context(stack.enter_context(Hub(options.device)).local_link())
        else:
            device = stack.enter_context(open_link(options.device))
        print("ready", flush=True)
        serve(gateway, device, plant)


if __name__ == "__main__":
    sys.exit(main())
