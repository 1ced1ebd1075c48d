"""How fast the buses are, each beside the fastest that bare sockets of the same kind and topology can do here.

Every figure is taken between processes: this one is the master, another the member that answers, and in the pattern
variant a third only listens. The ceiling runs the same processes with prebuilt bytes on bare sockets, nothing parsed
and nothing checked. Ceiling and link are measured in turn, run after run, so that a busy neighbour hits both.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple, TypedDict

from can_bus.address import parse_address
from can_bus.frame import RECORD_SIZE, Frame, pack
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.socketcan import MSG_WAITFORONE, FrameBatch
from can_bus.timeval import timeval
from can_bus.url import open_link

_LIMIT: Final = 30.0
_WARM_UP: Final = 200
_DATA: Final = bytes(range(8))

CEILING_OF: Final = {
    "hub": "bare-unix",
    "hub-tcp": "bare-tcp",
    "standalone": "relay-unix",
    "standalone-tcp": "relay-tcp",
    "vcan": "bare-can",
}
"""The ways a bus can be made of processes, and the bare-socket variant with the same wake-ups."""


class Figure(TypedDict):
    """One line of the benchmark: a median of ``runs`` runs beside its ceiling; ``ratio`` 1 is the ceiling."""

    name: str
    value: float
    unit: str
    ceiling: float
    ratio: float
    runs: int


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


def round_trips(kinds: list[str] | None = None, *, steps: int = 3000, runs: int = 7) -> list[Figure]:
    """Return rates and delays of one frame there and one back, for each kind of bus in ``CEILING_OF``.

    ``kinds`` None takes all that this machine has.
    """
    figures: list[Figure] = []
    for kind in _present(kinds):
        ours, bare = _runs(kind, steps, runs, n_to=1, n_back=1, listener=False)
        name = f"round-trips/{kind}"
        figures.append(figure(name, "1/s", [s.rate for s in ours], [s.rate for s in bare]))
        figures.append(figure(f"{name}/p50", "us", [s.p50 for s in ours], [s.p50 for s in bare], lower=True))
        figures.append(figure(f"{name}/p99", "us", [s.p99 for s in ours], [s.p99 for s in bare], lower=True))
    return figures


def pattern(url_kind: str, n_to: int, n_back: int, *, steps: int = 3000, runs: int = 7) -> Figure:
    """Return the rate of a lockstep step's traffic: ``n_to`` frames out, ``n_back`` back, and a passive listener."""
    ours, bare = _runs(url_kind, steps, runs, n_to=n_to, n_back=n_back, listener=True)
    return figure(f"steps/{url_kind}/{n_to}+{n_back}", "1/s", [s.rate for s in ours], [s.rate for s in bare])


def _present(kinds: list[str] | None) -> list[str]:
    if kinds is not None:
        return kinds
    return [kind for kind in CEILING_OF if kind != "vcan" or vcan_available()]


def _runs(
    kind: str, steps: int, runs: int, *, n_to: int, n_back: int, listener: bool
) -> tuple[list[Sample], list[Sample]]:
    ours: list[Sample] = []
    bare: list[Sample] = []
    for _ in range(runs):
        bare.append(measure(CEILING_OF[kind], steps, n_to, n_back, listener))
        ours.append(measure(kind, steps, n_to, n_back, listener))
    return ours, bare


def figure(name: str, unit: str, ours: list[float], bare: list[float], *, lower: bool = False) -> Figure:
    """Medians of both, and their ratio; `lower`: the smaller value is the better one."""
    value, ceiling = median(ours), median(bare)
    ratio = ceiling / value if lower else value / ceiling
    return Figure(
        name=name,
        value=round(value, 2),
        unit=unit,
        ceiling=round(ceiling, 2),
        ratio=round(ratio, 3),
        runs=len(ours),
    )


# -- one run ---------------------------------------------------------------------------------------------------------


def measure(kind: str, steps: int, n_to: int, n_back: int, listener: bool) -> Sample:
    """Run ``steps`` steps of one kind with its own processes and return how fast they were.

    RuntimeError when a process of the run fails, or the listener does not see every frame.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pb-")))
        crew = _Crew(stack, steps + _WARM_UP, n_to, n_back)
        step = _MASTERS[kind](stack, crew, folder, listener)
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
    """The other processes of a run."""

    def __init__(self, stack: contextlib.ExitStack, steps: int, n_to: int, n_back: int) -> None:
        self._stack = stack
        self._processes: list[subprocess.Popen[bytes]] = []
        self.steps = steps
        self.n_to = n_to
        self.n_back = n_back

    def start(self, role: str, where: str, *, joins: bool = True) -> str:
        """Start a process and return its first line, which says that it is ready."""
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path)))
        numbers = [str(self.steps), str(self.n_to), str(self.n_back)]
        process = subprocess.Popen(
            [sys.executable, "-m", __spec__.name, role, where, *numbers], stdout=subprocess.PIPE, env=environment
        )
        self._stack.callback(_end, process)
        if joins:
            self._processes.append(process)
        assert process.stdout is not None
        if role in _SILENT:
            return ""
        line = process.stdout.readline().decode().strip()
        if not line:
            raise RuntimeError(f"a process of the benchmark ({role}) did not start")
        return line

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


def _link_step(link: Link, n_to: int, n_back: int) -> Step:
    batch = [Frame(0x100 + number, _DATA) for number in range(n_to)]
    send, recv = link.send, link.recv

    def step() -> None:
        send(batch)
        got = 0
        while got < n_back:
            frames = recv(_LIMIT)
            if not frames:
                raise RuntimeError("the member did not answer")
            got += len(frames)

    return step


def _hub_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool, *, tcp: bool) -> Step:
    hub = stack.enter_context(Hub("tcp:127.0.0.1:0" if tcp else f"unix:{folder}/bus"))
    crew.start("member", hub.urls[0])
    if listener:
        crew.start("listener", hub.urls[0])
    link = hub.local_link()
    hub.wait_for_clients(2 if listener else 1, _LIMIT)
    return _link_step(link, crew.n_to, crew.n_back)


def _standalone_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool, *, tcp: bool) -> Step:
    url = crew.start("hub", "tcp:127.0.0.1:0" if tcp else f"unix:{folder}/bus", joins=False)
    crew.start("ready-member", url)
    if listener:
        crew.start("ready-listener", url)
    return _link_step(stack.enter_context(open_link(url)), crew.n_to, crew.n_back)


def _vcan_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool) -> Step:
    del folder
    url = "socketcan:vcan0"
    crew.start("ready-member", url)
    if listener:
        crew.start("ready-listener", url)
    return _link_step(stack.enter_context(open_link(url)), crew.n_to, crew.n_back)


def _bare_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool, *, tcp: bool) -> Step:
    with _listening("tcp:127.0.0.1:0" if tcp else f"unix:{folder}/bare") as (server, where):
        crew.start("bare-member", where)
        member = stack.enter_context(_accepted(server))
        if listener:
            crew.start("bare-listener", where)
        other = stack.enter_context(_accepted(server)) if listener else None
    records = _records(crew.n_to)
    expected = crew.n_back * RECORD_SIZE

    def step() -> None:
        member.sendall(records)
        if other is not None:
            other.sendall(records)
        got = 0
        while got < expected:
            chunk = member.recv(65536)
            if not chunk:
                raise RuntimeError("the member is gone")
            if other is not None:
                other.sendall(chunk)
            got += len(chunk)

    return step


def _relay_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool, *, tcp: bool) -> Step:
    role = "bare-relay-3" if listener else "bare-relay-2"
    where = crew.start(role, "tcp:127.0.0.1:0" if tcp else f"unix:{folder}/bare", joins=False)
    master = stack.enter_context(_connected(where))
    master.recv(1)
    crew.start("bare-member", where)
    master.recv(1)  # the relay knows its clients by the order they come in
    if listener:
        crew.start("bare-listener", where)
        master.recv(1)
    return _stream_step(master, crew.n_to, crew.n_back)


def _stream_step(sock: socket.socket, n_to: int, n_back: int) -> Step:
    records = _records(n_to)
    expected = n_back * RECORD_SIZE

    def step() -> None:
        sock.sendall(records)
        got = 0
        while got < expected:
            chunk = sock.recv(65536)
            if not chunk:
                raise RuntimeError("the relay is gone")
            got += len(chunk)

    return step


def _bare_can_master(stack: contextlib.ExitStack, crew: _Crew, folder: Path, listener: bool) -> Step:
    del folder
    crew.start("ready-can-member", "vcan0")
    if listener:
        crew.start("ready-can-listener", "vcan0")
    sock = stack.enter_context(_can_socket("vcan0"))
    batch = FrameBatch(sock.fileno())
    records, n_back = _records(crew.n_to), crew.n_back

    def step() -> None:
        batch.send(records)
        got = 0
        while got < n_back:
            got += batch.receive(MSG_WAITFORONE)

    return step


_MASTERS: Final[dict[str, Callable[[contextlib.ExitStack, _Crew, Path, bool], Step]]] = {
    "hub": lambda *given: _hub_master(*given, tcp=False),
    "hub-tcp": lambda *given: _hub_master(*given, tcp=True),
    "standalone": lambda *given: _standalone_master(*given, tcp=False),
    "standalone-tcp": lambda *given: _standalone_master(*given, tcp=True),
    "vcan": _vcan_master,
    "bare-unix": lambda *given: _bare_master(*given, tcp=False),
    "bare-tcp": lambda *given: _bare_master(*given, tcp=True),
    "relay-unix": lambda *given: _relay_master(*given, tcp=False),
    "relay-tcp": lambda *given: _relay_master(*given, tcp=True),
    "bare-can": _bare_can_master,
}


# -- bare sockets ----------------------------------------------------------------------------------------------------


def _records(count: int) -> bytes:
    return pack([Frame(0x100 + number, _DATA) for number in range(count)])


@contextlib.contextmanager
def _listening(url: str) -> Iterator[tuple[socket.socket, str]]:
    address = parse_address(url)
    with socket.socket(address.family, socket.SOCK_STREAM) as server:
        server.bind(address.target)
        server.listen(8)
        server.settimeout(_LIMIT)
        yield server, f"tcp:127.0.0.1:{server.getsockname()[1]}" if address.is_tcp else url


def _bound(sock: socket.socket) -> None:
    """Let the kernel end a receive that waits for a process that died; Python's time-outs would cost a call."""
    sock.settimeout(None)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeval(_LIMIT))


def _accepted(server: socket.socket) -> socket.socket:
    connection, _ = server.accept()
    _bound(connection)
    if connection.family is not socket.AF_UNIX:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _connected(where: str) -> socket.socket:
    address = parse_address(where)
    connection = socket.socket(address.family, socket.SOCK_STREAM)
    connection.connect(address.target)
    _bound(connection)
    if address.is_tcp:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
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


# -- the other processes ---------------------------------------------------------------------------------------------

_SILENT: Final = ("member", "listener", "bare-member", "bare-listener")


def _member(link: Link, steps: int, n_to: int, n_back: int) -> None:
    answer = [Frame(0x200 + number, _DATA) for number in range(n_back)]
    for _ in range(steps):
        got = 0
        while got < n_to:
            frames = link.recv(_LIMIT)
            if not frames:
                raise RuntimeError("the master stopped")
            got += len(frames)
        link.send(answer)


def _listener(link: Link, frames: int) -> None:
    while frames > 0:
        batch = link.recv(_LIMIT)
        if not batch:
            raise RuntimeError(f"{frames} frames did not come")
        frames -= len(batch)


def _bare_member(sock: socket.socket, steps: int, n_to: int, n_back: int) -> None:
    answer = _records(n_back)
    expected = n_to * RECORD_SIZE
    for _ in range(steps):
        got = 0
        while got < expected:
            chunk = sock.recv(65536)
            if not chunk:
                raise RuntimeError("the master is gone")
            got += len(chunk)
        sock.sendall(answer)


def _bare_listener(sock: socket.socket, size: int) -> None:
    while size > 0:
        chunk = sock.recv(65536)
        if not chunk:
            raise RuntimeError(f"{size} bytes did not come")
        size -= len(chunk)


def _bare_can_member(sock: socket.socket, steps: int, n_to: int, n_back: int) -> None:
    batch = FrameBatch(sock.fileno())
    answer = _records(n_back)
    for _ in range(steps):
        got = 0
        while got < n_to:
            got += batch.receive(MSG_WAITFORONE)
        batch.send(answer)


def _relay(url: str, count: int, n_to: int, n_back: int) -> None:
    """Pass bytes on between the master, the member and perhaps a listener, knowing whose turn it is."""
    with _listening(url) as (server, where), contextlib.ExitStack() as stack:
        print(where, flush=True)
        crew: list[socket.socket] = []
        for _ in range(count):
            crew.append(stack.enter_context(_accepted(server)))
            crew[0].sendall(b"!")
        master, member, *listeners = crew
        while True:
            for source, target, frames in ((master, member, n_to), (member, master, n_back)):
                left = frames * RECORD_SIZE
                while left > 0:
                    chunk = source.recv(65536)
                    if not chunk:
                        return
                    target.sendall(chunk)
                    for listener in listeners:
                        listener.sendall(chunk)
                    left -= len(chunk)


def _play(role: str, where: str, steps: int, n_to: int, n_back: int) -> None:
    frames = steps * (n_to + n_back)
    if role == "hub":
        with Hub(where) as hub:
            print(hub.urls[0], flush=True)
            hub.serve_forever()
    elif role.startswith("bare-relay-"):
        _relay(where, int(role.removeprefix("bare-relay-")), n_to, n_back)
    elif role.startswith("bare-"):
        with _connected(where) as sock:
            if role == "bare-member":
                _bare_member(sock, steps, n_to, n_back)
            else:
                _bare_listener(sock, frames * RECORD_SIZE)
    elif role.startswith("ready-can-"):
        with _can_socket(where) as sock:
            print("ready", flush=True)
            if role == "ready-can-member":
                _bare_can_member(sock, steps, n_to, n_back)
            else:
                batch = FrameBatch(sock.fileno())
                while frames > 0:
                    frames -= batch.receive(MSG_WAITFORONE)
    else:
        with open_link(where) as link:
            if role.startswith("ready-"):
                print("ready", flush=True)
            if role.endswith("member"):
                _member(link, steps, n_to, n_back)
            else:
                _listener(link, frames)


if __name__ == "__main__":
    _play(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:]))
