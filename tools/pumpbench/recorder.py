"""The recorder: a passive node that turns what it hears on the bus into a run folder.

It listens to the device's bus, and to the plant's as well when a gateway lies between, from before the roll call until
the plant has closed the run. It never sends and nobody waits for it. Only at the end does it analyse and import what
draws.
"""

import argparse
import contextlib
import json
import select
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can

from can_bus import codec
from can_bus.link import BusLost, Link
from can_bus.lockstep import Phase
from can_bus.url import BusUrlError, open_link
from pumpbench.capture import Capture, read_candump
from pumpbench.identity import stated
from pumpbench.rewind import Diverged, Origin, join
from pumpbench.runfolder import RunFolder

COALESCE_SECONDS = 0.005
"""On a hub nothing is lost while we sleep, and one wake-up then fetches many frames."""


class _Stop(Exception):
    """The recorder was asked to end."""


class Ending:
    """Knows from the frames of one bus when the run is over: SYNC_Done after SYNC_Step(End).

    Args:
        free_running: the device does not answer; SYNC_Step(End) is the end.
    """

    def __init__(self, *, free_running: bool = False) -> None:
        self._free_running = free_running
        self._step_id = codec.message("SYNC_Step").can_id
        self._done_id = codec.message("SYNC_Done").can_id
        self._ending = False
        self.over = False

    def watch(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Look at frames in passing."""
        for can_id, data in frames:
            if can_id == self._step_id and len(data) == 8:
                self._ending = data[1] >> 4 == Phase.END
                self.over |= self._ending and self._free_running
            elif can_id == self._done_id and self._ending:
                self.over = True


def listen(links: Sequence[Link], capture: Capture, *, free_running: bool = False) -> bool:
    """Collect frames until the run is over on every bus; False if asked to stop before (SIGTERM, SIGINT).

    Raises:
        BusLost: a bus is gone or frames were lost.
    """
    endings = [Ending(free_running=free_running) for _ in links]
    by_descriptor = {link.fileno(): channel for channel, link in enumerate(links)}
    lossless = all(link.url.startswith(("unix:", "tcp:", "inproc:")) for link in links)
    try:
        while by_descriptor:
            ready, _, _ = select.select(list(by_descriptor), [], [])
            for descriptor in ready:
                channel = by_descriptor[descriptor]
                frames = links[channel].recv(0)
                capture.extend(channel, frames)
                endings[channel].watch(frames)
                if endings[channel].over:  # this bus may be closed now while the other one still talks
                    del by_descriptor[descriptor]
            if lossless:
                time.sleep(COALESCE_SECONDS)
    except _Stop:
        return False
    return True


def write(
    folder: RunFolder, capture: Capture, info: dict[str, Any], *, complete: bool, origin: Origin | None = None
) -> None:
    """Analyse what was collected and write the run folder; an incomplete run keeps its `.partial` name.

    Raises:
        RunFolderError: the folder could not be written.
        Diverged: the run did not begin as its origin did; it keeps its `.partial` name too.
    """
    from pumpbench.outcome import measure  # noqa: PLC0415
    from pumpbench.trace import Trace  # noqa: PLC0415

    info = info | {"device": stated(capture.device_info())}
    frames = capture.finish()
    if not complete:
        folder.write_partial(frames, info)
        return
    if origin is not None:
        try:
            frames = join(origin, frames)
        except Diverged:
            folder.write_partial(frames, info)
            raise
    trace = Trace.from_frames(frames, info)
    folder.write_all(frames, info, measure(trace, frames), trace)


def _stop(_number: int, _frame: object) -> None:
    raise _Stop


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit status 0 recorded to the end, 2 wrong usage, 3 the bus or the disk failed."""
    parser = argparse.ArgumentParser(prog="pumpbench record", description=__doc__)
    parser.add_argument("--bus", required=True, metavar="URL", help="the device's bus")
    parser.add_argument("--plant-bus", metavar="URL", help="the plant's bus, when a gateway lies between")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="the run folder to write")
    parser.add_argument("--info", type=Path, metavar="FILE", help="JSON to be merged into run.json")
    parser.add_argument("--origin", type=Path, metavar="LOG", help="a recorded run that this one begins with")
    parser.add_argument("--origin-step", type=int, default=0, metavar="K", help="the instant up to which it does")
    parser.add_argument("--firmware-since", type=int, metavar="K", help="the instant from which this firmware answers")
    parser.add_argument("--free-running", action="store_true", help="the device answers no token")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run folder")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    capture = Capture()
    with contextlib.ExitStack() as stack:
        try:
            info = json.loads(options.info.read_text(encoding="utf-8")) if options.info else {}
            origin = None
            if options.origin is not None:
                origin = Origin(read_candump(options.origin), options.origin_step, options.firmware_since)
            folder = RunFolder.create(options.out, overwrite=options.overwrite)
            urls = [options.bus, *([options.plant_bus] if options.plant_bus else [])]
            links = [stack.enter_context(open_link(url)) for url in urls]
        except (BusUrlError, OSError, can.CanError, ValueError) as error:
            return _failed(error, 2)
        print("ready", flush=True)
        try:
            complete = listen(links, capture, free_running=options.free_running)
        except (BusLost, can.CanError, OSError) as error:
            write(folder, capture, info, complete=False)
            return _failed(error, 3)
        try:
            write(folder, capture, info, complete=complete, origin=origin)
        except (OSError, ValueError, Diverged) as error:
            return _failed(error, 3)
    return 0


def _failed(error: Exception, status: int) -> int:
    print(f"recorder: {error}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
