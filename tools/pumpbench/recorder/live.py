"""The live view of a run: a process of its own that draws what the recorder's journal holds, and serves it.

It reads the journal from the disk, at its own pace and at a low priority: the recorder never waits for it and loses no
frame by it, and if it ends, the record goes on without it. `View` is the recorder's side, `main` the process.

    recorder -> process   "end": everything is in the journal;  end of file: the server may go
    process -> recorder   "ready", "drawn", or "error" and why
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final
from urllib.parse import quote

from can_bus.frame import RECORD_SIZE
from pumpbench.capture import Follower, NewRun
from pumpbench.recorder.journal import NAMES
from pumpbench.runfolder import PARTIAL, RECORDING, RUN, RunFolder

if TYPE_CHECKING:
    from pumpbench.recording.live import LiveRecording

ADDRESS: Final = "127.0.0.1"
PORT: Final = 9876
"""Where `rerun --connect` looks for a server."""

WEB_PORT: Final = 9090
TICK_SECONDS: Final = 0.1
FLUSH_SECONDS: Final = 2.0
CHUNK_FRAMES: Final = 8192
"""Read at once from each bus: what is drawn between two looks at the recorder."""

NICENESS: Final = 10
"""The loop goes first where CPUs are scarce."""

START_SECONDS: Final = 30.0


def url(port: int) -> str:
    """Where a viewer finds the server."""
    return f"rerun+http://{ADDRESS}:{port}/proxy"


def where(port: int | None, web_port: int | None) -> list[str]:
    """Lines that tell a user how to watch."""
    lines = [] if port is None else [f"live: rerun --connect {url(port)}"]
    if port is not None and web_port is not None:
        lines.append(f"live: http://{ADDRESS}:{web_port}/?hide_welcome_screen=1&url={quote(url(port), safe='')}")
    return lines


class LiveError(OSError):
    """There is no live view, or no longer; the text says why."""

    def __init__(self, text: str) -> None:
        super().__init__(text)


def check_ports(port: int | None, web_port: int | None) -> None:
    """See whether the ports are free; Rerun would say nothing if they are not.

    Args:
        port: of the server for viewers, None for no server.
        web_port: of the page for browsers, None for no page.

    Raises:
        LiveError: one is not.
    """
    for number, option in ((port, "--serve"), (web_port, "--web")):
        if number is None:
            continue
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((ADDRESS, number))
            except (OSError, OverflowError) as error:
                reason = error.strerror if isinstance(error, OSError) else "a port is 1 to 65535"
                raise LiveError(f"{option} {number}: {reason}; choose another port") from None


class View:
    """The recorder's side: starts the process and tells it when the run is over.

    Args:
        folder: the unfinished run folder, with run.json and the journal.
        channels: number of buses in the journal.
        port: of the server for viewers.
        web_port: of the page for browsers; None for no page.

    Raises:
        LiveError: it does not start.
    """

    def __init__(self, folder: Path, channels: int, port: int, web_port: int | None) -> None:
        command = [sys.executable, "-m", "pumpbench.recorder.live", str(folder), "--port", str(port)]
        command += ["--channels", str(channels)]
        command += ["--web", str(web_port)] if web_port is not None else []
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={"RUST_LOG": "off"} | os.environ,  # what fails is told by us, in one line
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        if not select.select([self._output], [], [], START_SECONDS)[0]:
            self.close()
            raise LiveError(f"the live view was not ready within {START_SECONDS:g} s")
        try:
            self._expect("ready")
        except LiveError:
            self.close()
            raise

    def fileno(self) -> int:
        """Readable when the process has something to say, which is that it ends."""
        return self._output.fileno()

    def ended(self) -> LiveError:
        """Why the process has ended, to be asked when its descriptor is readable."""
        try:
            self._expect("drawn")
        except LiveError as error:
            return error
        return LiveError("the live view ended")

    def finish(self) -> None:
        """Tell it that everything is in the journal."""
        with contextlib.suppress(BrokenPipeError):  # then it has ended, which `wait` tells
            self._input.write("end\n")
            self._input.flush()

    def wait(self) -> None:
        """Wait until it has drawn everything.

        Raises:
            LiveError: it could not.
        """
        self._expect("drawn")

    def close(self) -> None:
        """End the process, and with it the server."""
        with contextlib.suppress(BrokenPipeError):
            self._input.close()
        try:
            self._process.wait(START_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()

    def _expect(self, word: str) -> None:
        line = self._output.readline().strip()
        if line != word:
            reason = line.removeprefix("error ") if line else f"it ended with status {self._process.wait()}"
            raise LiveError(f"the live view failed: {reason}")


# ---- the process


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of the process; exit status 0, or 3 if the recording cannot be written."""
    from pumpbench.recording.live import LiveRecording  # noqa: PLC0415
    from pumpbench.recording.page import Page  # noqa: PLC0415
    from pumpbench.recording.tool import RecordingError  # noqa: PLC0415

    parser = argparse.ArgumentParser(prog="pumpbench.recorder.live", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--channels", type=int, required=True)
    parser.add_argument("--web", type=int)
    parser.add_argument("--skip", type=int, nargs="+", help="frames of each bus that belong to an earlier run")
    options = parser.parse_args(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # for the recorder; we end when it does
    os.nice(NICENESS - os.nice(0))
    channels, skip = options.channels, options.skip or [0] * options.channels
    with contextlib.ExitStack() as stack:
        try:
            info = json.loads((options.folder / RUN).read_text(encoding="utf-8"))
            if options.web is not None:
                stack.callback(Page(options.web, options.port).close)
            recording = LiveRecording(options.folder / RECORDING, options.port, info, gateway=channels > 1)
            if options.skip is None:
                print("ready", flush=True)
            files = [stack.enter_context((options.folder / name).open("rb", buffering=0)) for name in NAMES[:channels]]
            for file, frames in zip(files, skip, strict=True):
                file.seek(frames * RECORD_SIZE)
            _draw(recording, files)
            recording.flush()
            print("drawn", flush=True)
            sys.stdin.read()
            recording.close()
        except NewRun as error:
            # the servers go down with us and come up again; what viewers have seen is another recording
            taken = [str(frames + before) for frames, before in zip(error.taken, skip, strict=True)]
            command = ["--port", str(options.port), "--channels", str(channels), "--skip", *taken]
            command += ["--web", str(options.web)] if options.web is not None else []
            os.execv(sys.executable, [sys.executable, "-m", "pumpbench.recorder.live", str(options.folder), *command])
        except RecordingError as error:
            partial = RunFolder(options.folder.with_name(options.folder.name.removesuffix(PARTIAL)))
            print(f"error {partial.failed(RECORDING, error)}", flush=True)
            return 3
        except (OSError, ValueError) as error:
            print(f"error {error}", flush=True)
            return 3
    return 0


def _draw(recording: LiveRecording, files: Sequence[BinaryIO]) -> None:
    """Draw the journal as it grows, until the recorder says that it is whole, or is gone."""
    follower = Follower(len(files))
    over = False
    flushed = time.monotonic()
    while True:
        chunks = [_read(file) for file in files]
        for channel, records in enumerate(chunks):
            follower.extend(channel, records)
        more = any(len(records) == CHUNK_FRAMES * RECORD_SIZE for records in chunks)
        recording.draw(follower.take(over=over and not more))
        if over and not more:
            return
        if time.monotonic() - flushed > FLUSH_SECONDS:
            recording.flush()
            flushed = time.monotonic()
        if not over:
            over = bool(select.select([sys.stdin], [], [], 0 if more else TICK_SECONDS)[0])


def _read(file: BinaryIO) -> bytes:
    """What has come since, in whole records."""
    records = file.read(CHUNK_FRAMES * RECORD_SIZE)
    torn = len(records) % RECORD_SIZE
    if torn:  # we looked in the middle of a write
        file.seek(-torn, os.SEEK_CUR)
    return records[: len(records) - torn]


if __name__ == "__main__":
    sys.exit(main())
