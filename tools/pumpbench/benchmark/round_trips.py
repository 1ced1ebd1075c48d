"""How fast the buses are, each beside the fastest that bare sockets of the same kind and topology can do here.

Every figure is taken between processes: this one is the master, another the member that answers, and where a whole
step's frames are exchanged a third only listens. The ceiling runs the same processes with prebuilt bytes on bare
sockets, nothing parsed and nothing checked. Ceiling and link are measured in turn, run after run, so that a busy
neighbour hits both.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from can_bus.frame import RECORD_SIZE, Frame, pack
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.socketcan import MSG_WAITFORONE, FrameBatch
from can_bus.timeval import timeval
from can_bus.url import open_link
from pumpbench.benchmark.figure import Figure, figure

_LIMIT: Final = 30.0
_WARM_UP: Final = 200
_DATA: Final = bytes(range(8))

CEILING_OF: Final = {"hub": "bare-unix", "vcan": "bare-can"}
"""The kinds of bus that runs use, and bare sockets with the same wake-ups."""


class Sample(NamedTuple):
    """One run: steps per second, and the step's time in microseconds at the 50th and 99th percentile."""

    rate: float
    p50: float
    p99: float


def vcan_available(channel: str = "vcan0") -> bool:
    """Whether a raw CAN socket can be opened on this machine."""
    try:
        with _can_socket(channel):
            return True
    except OSError:
        return False


def round_trips(kind: str, *, steps: int, runs: int) -> list[Figure]:
    """Rate and delays of one frame there and one back, on a kind of bus in `CEILING_OF`."""
    ours: list[Sample] = []
    bare: list[Sample] = []
    for _ in range(runs):
        bare.append(measure(CEILING_OF[kind], steps))
        ours.append(measure(kind, steps))
    name = f"round-trips/{kind}"
    return [
        figure(name, "1/s", [s.rate for s in ours], [s.rate for s in bare]),
        figure(f"{name}/p50", "us", [s.p50 for s in ours], [s.p50 for s in bare], lower=True),
        figure(f"{name}/p99", "us", [s.p99 for s in ours], [s.p99 for s in bare], lower=True),
    ]


# ---- one run


def measure(kind: str, steps: int, n_to: int = 1, n_back: int = 1, *, listener: bool = False) -> Sample:
    """Run steps of one kind with its own processes and tell how fast they were.

    Args:
        kind: of bus or of bare sockets.
        steps: how many.
        n_to: frames to the member in a step.
        n_back: frames that it answers with.
        listener: a third process hears them all (bare sockets only).

    Raises:
        RuntimeError: a process of the run failed, or the listener did not see every frame.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pb-")))
        crew = _Crew(stack, folder, steps + _WARM_UP, n_to, n_back, listener=listener)
        step = _MASTERS[kind](crew)
        for _ in range(_WARM_UP):
            step()
        clock = time.perf_counter_ns
        stamps = [clock()]
        for _ in range(steps):
            step()
            stamps.append(clock())
        crew.join()
    delays = sorted(after - before for before, after in pairwise(stamps))
    return Sample(
        rate=steps / ((stamps[-1] - stamps[0]) / 1e9),
        p50=delays[len(delays) // 2] / 1e3,
        p99=delays[len(delays) * 99 // 100] / 1e3,
    )


class _Crew:
    """The other processes of a run, and what it is made of."""

    def __init__(
        self, stack: contextlib.ExitStack, folder: Path, steps: int, n_to: int, n_back: int, *, listener: bool
    ) -> None:
        self.stack = stack
        self.folder = folder
        self.steps = steps
        self.n_to = n_to
        self.n_back = n_back
        self.listener = listener
        self._processes: list[subprocess.Popen[bytes]] = []

    def start(self, role: str, where: str, *, ready: bool = False) -> None:
        """Start a process; with `ready`, wait until it says that it listens."""
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path)))
        numbers = [str(self.steps), str(self.n_to), str(self.n_back)]
        process = subprocess.Popen(
            [sys.executable, "-m", __spec__.name, role, where, *numbers], stdout=subprocess.PIPE, env=environment
        )
        self.stack.callback(_end, process)
        self._processes.append(process)
        assert process.stdout is not None
        if ready and not process.stdout.readline():
            raise RuntimeError(f"a process of the benchmark ({role}) did not start")

    def join(self) -> None:
        """Wait until every process has seen all it should have."""
        for process in self._processes:
            if process.wait(_LIMIT) != 0:
                raise RuntimeError(f"a process of the benchmark failed with status {process.returncode}")


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


Step = Callable[[], None]


def _hub_master(crew: _Crew) -> Step:
    hub = crew.stack.enter_context(Hub(f"unix:{crew.folder}/bus"))
    crew.start("member", hub.urls[0])
    link = hub.local_link()
    hub.wait_for_clients(1, _LIMIT)
    return _link_step(link, crew.n_to, crew.n_back)


def _vcan_master(crew: _Crew) -> Step:
    url = "socketcan:vcan0"
    crew.start("member", url, ready=True)
    return _link_step(crew.stack.enter_context(open_link(url)), crew.n_to, crew.n_back)


def _link_step(link: Link, n_to: int, n_back: int) -> Step:
    batch = [Frame(0x100 + number, _DATA) for number in range(n_to)]

    def step() -> None:
        link.send(batch)
        _receive(link, n_back)

    return step


def _bare_unix_master(crew: _Crew) -> Step:
    path = f"{crew.folder}/bare"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(path)
        server.listen()
        server.settimeout(_LIMIT)
        crew.start("bare-member", path)
        member = crew.stack.enter_context(_accepted(server))
        if crew.listener:
            crew.start("bare-listener", path)
        other = crew.stack.enter_context(_accepted(server)) if crew.listener else None
    records = _records(crew.n_to)
    expected = crew.n_back * RECORD_SIZE

    def step() -> None:
        member.sendall(records)
        if other is not None:
            other.sendall(records)
        _receive_bytes(member, expected, other)

    return step


def _bare_can_master(crew: _Crew) -> Step:
    crew.start("can-member", "vcan0", ready=True)
    if crew.listener:
        crew.start("can-listener", "vcan0", ready=True)
    sock = crew.stack.enter_context(_can_socket("vcan0"))
    batch = FrameBatch(sock.fileno())
    records = _records(crew.n_to)

    def step() -> None:
        batch.send(records)
        _receive_batches(batch, crew.n_back)

    return step


_MASTERS: Final[dict[str, Callable[[_Crew], Step]]] = {
    "hub": _hub_master,
    "vcan": _vcan_master,
    "bare-unix": _bare_unix_master,
    "bare-can": _bare_can_master,
}


# ---- what both ends do


def _records(count: int) -> bytes:
    return pack([Frame(0x100 + number, _DATA) for number in range(count)])


def _receive(link: Link, count: int) -> None:
    while count > 0:
        frames = link.recv(_LIMIT)
        if not frames:
            raise RuntimeError(f"{count} frames did not come")
        count -= len(frames)


def _receive_bytes(sock: socket.socket, size: int, other: socket.socket | None = None) -> None:
    """Take so many bytes, and pass them on."""
    while size > 0:
        chunk = sock.recv(65536)
        if not chunk:
            raise RuntimeError("the other side is gone")
        if other is not None:
            other.sendall(chunk)
        size -= len(chunk)


def _receive_batches(batch: FrameBatch, count: int) -> None:
    while count > 0:
        count -= batch.receive(MSG_WAITFORONE)


def _bound(sock: socket.socket) -> None:
    """Let the kernel end a receive that waits for a process that died; Python's time-outs would cost a call."""
    sock.settimeout(None)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval(_LIMIT))


def _accepted(server: socket.socket) -> socket.socket:
    connection, _ = server.accept()
    _bound(connection)
    return connection


def _connected(path: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(path)
    _bound(connection)
    return connection


def _can_socket(channel: str) -> socket.socket:
    sock = socket.socket(29, socket.SOCK_RAW, 1)  # AF_CAN, CAN_RAW: by number, so that it can be said anywhere
    try:
        sock.bind((channel,))
        _bound(sock)
        with contextlib.suppress(PermissionError):
            sock.setsockopt(socket.SOL_SOCKET, 33, 64 << 20)  # SO_RCVBUFFORCE
    except BaseException:
        sock.close()
        raise
    return sock


# ---- the other processes


def _member(url: str, steps: int, n_to: int, n_back: int) -> None:
    answer = [Frame(0x200 + number, _DATA) for number in range(n_back)]
    with open_link(url) as link:
        print("ready", flush=True)
        for _ in range(steps):
            _receive(link, n_to)
            link.send(answer)


def _bare_member(path: str, steps: int, n_to: int, n_back: int) -> None:
    answer = _records(n_back)
    with _connected(path) as sock:
        for _ in range(steps):
            _receive_bytes(sock, n_to * RECORD_SIZE)
            sock.sendall(answer)


def _bare_listener(path: str, steps: int, n_to: int, n_back: int) -> None:
    with _connected(path) as sock:
        _receive_bytes(sock, steps * (n_to + n_back) * RECORD_SIZE)


def _can_member(channel: str, steps: int, n_to: int, n_back: int) -> None:
    answer = _records(n_back)
    with _can_socket(channel) as sock:
        print("ready", flush=True)
        batch = FrameBatch(sock.fileno())
        for _ in range(steps):
            _receive_batches(batch, n_to)
            batch.send(answer)


def _can_listener(channel: str, steps: int, n_to: int, n_back: int) -> None:
    with _can_socket(channel) as sock:
        print("ready", flush=True)
        _receive_batches(FrameBatch(sock.fileno()), steps * (n_to + n_back))


_ROLES: Final = {
    "member": _member,
    "bare-member": _bare_member,
    "bare-listener": _bare_listener,
    "can-member": _can_member,
    "can-listener": _can_listener,
}


if __name__ == "__main__":
    _ROLES[sys.argv[1]](sys.argv[2], *map(int, sys.argv[3:]))
