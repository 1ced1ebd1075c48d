"""The recorder's command line: `pumpbench record`, and `python -m pumpbench.recorder` for the rig."""

import argparse
import contextlib
import json
import signal
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can

import pumpbench.recorder
from can_bus.url import BusUrlError, open_link
from pumpbench.candump import read_candump
from pumpbench.capture import Capture
from pumpbench.identity import versions
from pumpbench.recorder import live
from pumpbench.recorder.journal import NAMES
from pumpbench.recorder.listening import listen
from pumpbench.recorder.repair import repair
from pumpbench.recorder.writing import write
from pumpbench.rewind import Diverged, Origin
from pumpbench.runfolder import NotWritten, RunFolder, RunFolderError


@contextlib.contextmanager
def _signals() -> Iterator[int]:
    """A descriptor that becomes readable on SIGTERM or SIGINT, which interrupt nothing meanwhile."""
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    with reader, writer:
        before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        handlers = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield reader.fileno()
        finally:
            signal.set_wakeup_fd(before)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit status 0 recorded to the end or asked to end, 2 wrong usage, 3 the bus or the disk failed."""
    parser = argparse.ArgumentParser(prog="pumpbench record", description=pumpbench.recorder.__doc__)
    parser.add_argument("--bus", metavar="URL", help="the device's bus")
    parser.add_argument("--plant-bus", metavar="URL", help="the plant's bus, when a gateway lies between")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the run folder to write")
    parser.add_argument("--info", type=Path, metavar="FILE", help="JSON to be merged into run.json")
    parser.add_argument("--origin", type=Path, metavar="LOG", help="a recorded run that this one begins with")
    parser.add_argument("--origin-step", type=int, default=0, metavar="K", help="the instant up to which it does")
    parser.add_argument("--firmware-since", type=int, metavar="K", help="the instant from which this firmware answers")
    parser.add_argument("--free-running", action="store_true", help="the device answers no token")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run folder")
    parser.add_argument(
        "--serve",
        type=int,
        nargs="?",
        const=live.PORT,
        metavar="PORT",
        help=f"show the run in Rerun's viewer while it is on, on {live.ADDRESS} (default port: {live.PORT})",
    )
    parser.add_argument(
        "--web",
        type=int,
        nargs="?",
        const=live.WEB_PORT,
        metavar="PORT",
        help=f"and in a browser, with --serve (default port: {live.WEB_PORT})",
    )
    parser.add_argument(
        "--repair", type=Path, metavar="DIR.partial", help="write the files that a killed recorder could not, and end"
    )
    options = parser.parse_args(arguments)
    if options.repair is not None:
        return _repair(options.repair)
    if options.bus is None or options.out is None:
        parser.error("give --bus and --out (or --repair)")
    if options.web is not None and options.serve is None:
        parser.error("--web is a way to look at what --serve serves: give both")
    return _record(options)


def _record(options: argparse.Namespace) -> int:
    urls = [options.bus, *([options.plant_bus] if options.plant_bus else [])]
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_signals())
        try:
            info, origin = _info(options), _origin(options)
            live.check_ports(options.serve, options.web)
            folder = RunFolder.create(options.out, overwrite=options.overwrite)
        except (OSError, ValueError) as error:
            return _failed(error, 2)
        try:
            journal = stack.enter_context(contextlib.closing(folder.begin(info, len(urls))))
            view = None
            if options.serve is not None:
                view = live.View(folder.partial, len(urls), options.serve, options.web)
                stack.callback(view.close)
        except OSError as error:
            return _failed(error, 3)
        try:
            links = [stack.enter_context(open_link(url)) for url in urls]
        except (BusUrlError, OSError, can.CanError) as error:
            folder.discard()
            return _failed(error, 2)
        print("ready", *live.where(options.serve, options.web), sep="\n", flush=True)

        def keep(channel: int, records: bytes) -> None:
            try:
                journal.keep(channel, records)
            except OSError as error:
                raise folder.failed(NAMES[channel], error) from error

        status = 0

        def without_view() -> bool:
            nonlocal status, view
            assert view is not None
            status = _failed(f"{view.ended()}; the record goes on without it", 3)
            view = None
            return False

        watch: dict[int, Callable[[], bool]] = {stop: lambda: True}
        if view is not None:
            watch[view.fileno()] = without_view
        capture, complete = Capture(keep), False
        try:
            complete = listen(links, capture, watch, free_running=options.free_running)
        except NotWritten as error:
            return _failed(error, 3)
        except (can.CanError, OSError) as error:
            status = _failed(error, 3)
        try:
            if view is not None:
                view.finish()  # it draws the rest while we write
            write(folder, capture, info, complete=complete, origin=origin)
            if view is not None:
                view.wait()
        except (OSError, ValueError, Diverged) as error:
            status = _failed(error, 3)
    return status


def _info(options: argparse.Namespace) -> dict[str, Any]:
    """What run.json says of a run that we know nothing of, and what somebody else says of it.

    Raises:
        ValueError: the file of --info is no JSON object.
        OSError: it cannot be read.
    """
    known: dict[str, Any] = versions() | {"bus": options.bus}
    if options.info is None:
        return known
    try:
        said = json.loads(options.info.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"--info {options.info} is no JSON: {error}") from None
    if not isinstance(said, dict):
        raise ValueError(f"--info {options.info}: expected a JSON object, as run.json has, found {said!r}")
    return known | said


def _origin(options: argparse.Namespace) -> Origin | None:
    if options.origin is None:
        return None
    return Origin(read_candump(options.origin), options.origin_step, options.firmware_since)


def _repair(partial: Path) -> int:
    try:
        print(repair(partial))
    except RunFolderError as error:
        return _failed(error, 3 if isinstance(error, NotWritten) else 2)
    return 0


def _failed(reason: Exception | str, status: int) -> int:
    print(f"recorder: {reason}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
