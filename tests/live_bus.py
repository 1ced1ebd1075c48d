"""A bus on which a test says a run, a recorder beside it, and what its recordings hold."""

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
from pumpbench.candump import read_candump
from pumpbench.capture import Capture
from pumpbench.frames import Frames
from pumpbench.recording.tool import quiet_environment, rerun_binary
from rerun.chunk import RrdReader
from synthetic_capture import Loop

from can_bus.frame import Frame
from can_bus.hub import Hub
from can_bus.hub_local import LocalLink

RECORDER = [sys.executable, "-m", "pumpbench", "record"]
LIMIT = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.02)


def frames_of(rrd: Path, channel: int = 0) -> list[tuple[float, int, bytes]]:
    """Time, id and bytes of every frame in a recording, in order of time."""
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file that still grows has no footer
        reader = RrdReader(rrd)
    for chunk in reader.stream().filter(content=f"/can/can{channel}", is_static=False):
        batch = chunk.to_record_batch()
        times = batch.column("sim_time").cast(pa.int64()).to_pylist()
        idents, payloads = (batch.column(name).to_pylist() for name in ("id", "data"))
        rows += [
            (nanos / 1e9, int(ident[0], 16), bytes.fromhex(data[0]))
            for nanos, ident, data in zip(times, idents, payloads, strict=True)
        ]
    return sorted(rows, key=lambda row: row[0])


def count_so_far(rrd: Path) -> int:
    """How many frames are in a recording that still grows; none while it is empty, or its newest part half written."""
    try:
        return len(frames_of(rrd))
    except (RuntimeError, ValueError):
        return 0


def same_as_log(rrd: Path, log: Path) -> bool:
    """Whether a recording holds the frames of a log, each once, at its time and with its bytes."""
    logged = read_candump(log)
    for channel in sorted(set(logged.channel.tolist())):
        found, times = frames_of(rrd, channel), logged.time_s[logged.channel == channel]
        if [row[1:] for row in found] != [tuple(frame) for frame in logged.frames(channel)]:
            return False
        if not np.allclose([row[0] for row in found], times, rtol=0, atol=1e-6):
            return False
    return len(logged) > 0


def verifies(rrd: Path, scratch: Path) -> bool:
    command = [rerun_binary(), "rrd", "verify", rrd]
    return not subprocess.run(command, env=quiet_environment(scratch), capture_output=True, check=False).returncode


@contextlib.contextmanager
def viewer(url: str, file: Path, scratch: Path) -> Iterator[None]:
    """Rerun's own program at the server, as a viewer is; it writes down what it gets."""
    command = [rerun_binary(), "--bind", "127.0.0.1", "--port", str(free_port()), "--save", file, url]
    process = subprocess.Popen(command, env=quiet_environment(scratch), stdout=subprocess.DEVNULL, stderr=-3)
    try:
        until(lambda: file.is_file() and file.stat().st_size > 50_000, "the blueprint")
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(LIMIT)


class Bus:
    """A hub on which a whole run was, or is, said by the test."""

    def __init__(self, folder: Path, hub: Hub, link: LocalLink) -> None:
        self.folder, self.hub, self.link = folder, hub, link
        self.url = hub.urls[0]
        self.out, self.partial = folder / "out", folder / "out.partial"
        self.said: list[Frame] = []

    @contextlib.contextmanager
    def recorder(self, *options: str | Path, command: Sequence[str] = RECORDER) -> Iterator["subprocess.Popen[str]"]:
        """A recorder that is ready, and did not have to be killed."""
        call = [*command, "--bus", self.url, "--out", str(self.out), *map(str, options)]
        process = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.folder)
        assert process.stdout is not None
        ready: list[str] = []
        reader = threading.Thread(target=lambda: ready.append(process.stdout.readline() if process.stdout else ""))
        reader.start()
        while reader.is_alive():
            self.hub.poll(0.02)
        try:
            assert ready == ["ready\n"], process.communicate(timeout=LIMIT)
            yield process
        finally:
            process.kill()
            process.communicate()

    def say(self, frames: Sequence[Frame]) -> None:
        """Some batches of frames, and let everybody read them."""
        for start in range(0, len(frames), 40):
            self.link.send(frames[start : start + 40])
            self.hub.poll(0.001)
        self.said += frames

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait, while the hub goes on."""
        until(lambda: (self.hub.poll(0), condition())[1], what)

    def heard(self) -> bool:
        """Whether everything that was said is in the journal."""
        file = self.partial / "can0.frames"
        return file.stat().st_size == 16 * len(self.said)

    def end(self, process: "subprocess.Popen[str]") -> tuple[int, str]:
        """Exit status and stderr of a recorder that ends by itself, while the bus goes on."""
        deadline = time.monotonic() + LIMIT
        while process.poll() is None:
            assert time.monotonic() < deadline, "the recorder does not end"
            self.hub.poll(0.02)
        return process.returncode, process.communicate()[1]

    def record(self) -> Frames:
        """What a recorder has to make of it."""
        capture = Capture()
        capture.extend(0, self.said)
        return capture.finish()


RUN = [frame for _, frame in Loop(40).run_frames()]
HALF = RUN[: len(RUN) // 2]


def children(pid: int) -> list[int]:
    return [child.pid for child in psutil.Process(pid).children()]
