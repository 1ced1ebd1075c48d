"""One conformance suite for every transport: what a node may rely on, whatever the bus is made of.

The nodes are processes where the transport connects processes, and threads where it doesn't. ``unix`` and ``tcp`` use
a standalone hub, ``embedded`` one that this process hosts and drives. The same checks run on a kernel's vcan.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import multiprocessing
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import can
import pytest

from can_bus.frame import (
    CAN_EFF_FLAG,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    RECORD_SIZE,
    Frame,
    from_message,
    pack,
    to_message,
    unpack,
)
from can_bus.hub import Hub
from can_bus.link import BusLost, Link
from can_bus.socketcan import FrameBatch, SocketcanLink
from can_bus.url import BusUrlError, open_bus, open_link

LIMIT = 60.0
WORKERS = multiprocessing.get_context("forkserver")
WORKERS.set_forkserver_preload(["can_bus.url"])

VCAN = pytest.param("vcan", marks=pytest.mark.vcan)
HUBS = ["unix", "tcp", "embedded"]
PROCESSES = [*HUBS, VCAN]
SHARED = [*PROCESSES, "inproc"]
ALL = [*SHARED, "virtual", "slcan"]


# -- what the nodes of a test do, in processes or threads ------------------------------------------------------------


def numbered(node: int, count: int) -> list[Frame]:
    return [Frame(0x100 + node, node.to_bytes(2, "little") + number.to_bytes(6, "little")) for number in range(count)]


def number_of(frame: Frame) -> int:
    return int.from_bytes(frame.data[2:], "little")


def collect(link: Link, count: int) -> list[Frame]:
    frames: list[Frame] = []
    while len(frames) < count:
        batch = link.recv(LIMIT)
        assert batch, f"{count - len(frames)} of {count} frames did not come"
        frames += batch
    assert len(frames) == count
    return frames


def flood(link: Link, node: int, count: int, others: int) -> bytes:
    """Send everything before reading anything, in batches of all sizes; return what the others sent."""
    frames = numbered(node, count)
    start = 0
    for size in itertools.cycle((1, 2, 7, 50, 300)):
        if start >= count:
            break
        link.send(frames[start : start + size])
        start += size
    return pack(collect(link, others))


def echo(link: Link, count: int) -> None:
    """Send back what comes, frame for frame."""
    while count > 0:
        frames = link.recv(LIMIT)
        link.send(frames)
        count -= len(frames)


def send_all(link: Link, node: int, count: int) -> None:
    frames = numbered(node, count)
    for start in range(0, count, 100):
        link.send(frames[start : start + 100])


def send_until_stopped(link: Link, node: int) -> None:
    number = 0
    while not link.recv(0.001):
        link.send([Frame(0x100 + node, bytes(2) + n.to_bytes(6, "little")) for n in range(number, number + 20)])
        number += 20


def collect_packed(link: Link, count: int) -> bytes:
    return pack(collect(link, count))


def join_often(link: Link, url: str, times: int) -> list[list[int]]:
    """Join a busy bus again and again; return the numbers each time's first 200 frames carry."""
    del link
    seen = []
    for _ in range(times):
        with open_link(url, filters=[0x100]) as late:
            frames: list[Frame] = []
            while len(frames) < 200:
                batch = late.recv(LIMIT)
                assert batch
                frames += batch
            seen.append([number_of(frame) for frame in frames])
    return seen


def wait_for_the_end(link: Link) -> tuple[str, float]:
    """Block in a receive until the bus is lost; return the reason and when."""
    try:
        while True:
            link.recv(LIMIT)
    except BusLost as lost:
        return str(lost), time.monotonic()


def send_to_the_end(link: Link) -> tuple[str, float]:
    try:
        while True:
            link.send([Frame(0x1, b"")])
            time.sleep(0.01)
    except BusLost as lost:
        return str(lost), time.monotonic()


class Node:
    """A link in a process or thread of its own, that does what it is told."""

    def __init__(self, rig: Rig, url: str, filters: list[int] | None, *, thread: bool) -> None:
        self._rig = rig
        self._pipe, theirs = WORKERS.Pipe()
        if thread:
            self.pid = os.getpid()
            self._worker: Any = threading.Thread(target=_work, args=(theirs, url, filters), daemon=True)
        else:
            self._worker = WORKERS.Process(target=_work, args=(theirs, url, filters), daemon=True)
        self._worker.start()
        if not thread:
            theirs.close()
            self.pid = self._worker.pid
        self.result()

    def start(self, task: Callable[..., Any], *arguments: Any) -> None:
        self._pipe.send((task, arguments))

    def result(self) -> Any:
        end = time.monotonic() + LIMIT
        while not self._pipe.poll(0 if self._rig.hub else 0.1):
            assert time.monotonic() < end, f"a node did not come to an end: {self.whereabouts()}"
            if self._rig.hub is not None:
                self._rig.hub.poll(0.01)
        kind, value = self._pipe.recv()
        if kind == "error":
            raise value
        return value

    def call(self, task: Callable[..., Any], *arguments: Any) -> Any:
        self.start(task, *arguments)
        return self.result()

    def kill(self, number: int = signal.SIGKILL) -> None:
        os.kill(self.pid, number)

    def stop(self) -> None:
        """SIGSTOP it, and return when it stands still."""
        self.kill(signal.SIGSTOP)
        self.wait_for_stop()

    def wait_for_stop(self) -> None:
        end = time.monotonic() + LIMIT
        while self._state() != "T":
            assert time.monotonic() < end, f"a node does not stop: {self.whereabouts()}"
            time.sleep(0.001)

    def _state(self) -> str:
        return Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0]

    def whereabouts(self) -> str:
        """What the kernel says of it, and of frames that it has lost before any socket (second number)."""
        waits = Path(f"/proc/{self.pid}/wchan").read_text()
        lost = Path("/proc/net/softnet_stat").read_text().splitlines()
        return f"state {self._state()}, waits in {waits}, backlogs {[each.split()[:3] for each in lost]}"

    def end(self) -> None:
        with contextlib.suppress(OSError):
            self._pipe.send(None)
        if isinstance(self._worker, threading.Thread):
            self._worker.join(LIMIT)
        else:
            if self._worker.is_alive():
                with contextlib.suppress(ProcessLookupError):
                    self.kill(signal.SIGCONT)
            self._worker.join(2)
            if self._worker.is_alive():
                self._worker.kill()
            self._worker.join(LIMIT)
            self._worker.close()
        self._pipe.close()


def _work(pipe: Connection, url: str, filters: list[int] | None) -> None:
    try:
        link = open_link(url, filters=filters)
    except Exception as error:
        pipe.send(("error", error))
        return
    with link, pipe, contextlib.suppress(EOFError, OSError):
        pipe.send(("value", None))
        while (order := pipe.recv()) is not None:
            task, arguments = order
            try:
                pipe.send(("value", task(link, *arguments)))
            except Exception as error:
                pipe.send(("error", AssertionError(repr(error))))


class Rig:
    """A bus of one kind for one test."""

    def __init__(self, kind: str, folder: Path, stack: contextlib.ExitStack, shared: list[str] | None = None) -> None:
        self.kind = kind
        self.hub: Hub | None = None
        self.server: subprocess.Popen[str] | None = None
        self._stack = stack
        self._urls: Iterator[str] | None = None
        if kind in ("unix", "tcp"):
            self.url = next(url for url in shared or [] if url.startswith(kind))
        elif kind.startswith("mortal"):
            self.server = serve(stack, f"unix:{folder}/bus" if kind == "mortal unix" else "tcp:127.0.0.1:0")
            (self.url,) = announced(self.server)
        elif kind == "embedded":
            self.hub = stack.enter_context(Hub(f"unix:{folder}/bus"))
            self.url = self.hub.urls[0]
        elif kind == "vcan":
            need_vcan()
            self.url = "socketcan:vcan0"
        elif kind == "slcan":
            self._urls = serial_cable(stack)
            self.url = "slcan"
        else:
            self.url = f"{kind}:{folder.name}"

    def link(self, filters: list[int] | None = None) -> Link:
        """Open a link in this thread; on the embedded hub it is the host's own."""
        if self.hub is not None:
            return self._stack.enter_context(self.hub.local_link(filters))
        url = next(self._urls) if self._urls is not None else self.url
        return self._stack.enter_context(open_link(url, filters=filters))

    def let_go(self) -> None:
        """Let an embedded hub run by itself, for tests that block in something other than its link."""
        if self.hub is not None:
            self.hub.start()
            self.hub = None

    def node(self, filters: list[int] | None = None) -> Node:
        """Start another node: a process where the transport can, else a thread."""
        url = next(self._urls) if self._urls is not None else self.url
        node = Node(self, url, filters, thread=self.kind in ("inproc", "virtual", "slcan"))
        self._stack.callback(node.end)
        return node


def serve(stack: contextlib.ExitStack, *arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-m", "can_bus.hub", *arguments], stdout=subprocess.PIPE, text=True)

    def end() -> None:
        process.terminate()
        process.wait(LIMIT)
        assert process.stdout is not None
        process.stdout.close()

    stack.callback(end)
    return process


def announced(hub: subprocess.Popen[str]) -> list[str]:
    """The URLs that a hub says it serves."""
    assert hub.stdout is not None
    return hub.stdout.readline().split()[1:]


def need_vcan() -> None:
    """Skip without a vcan0, but never in CI, where a skip would look like a pass."""
    try:
        with socket.socket(29, socket.SOCK_RAW, 1) as probe:
            probe.bind(("vcan0",))
    except OSError as error:
        if os.environ.get("CI") == "true" or os.environ.get("VCAN_GUEST"):
            pytest.fail(f"no vcan0 here ({error.strerror}); run this through tools/with_vcan")
        pytest.skip(f"no vcan0 here ({error.strerror}); tools/with_vcan runs these")


def serial_cable(stack: contextlib.ExitStack) -> Iterator[str]:
    """Two serial ports with a cable between them, as slcan URLs."""
    ends = [os.openpty() for _ in range(2)]
    for master, slave in ends:
        tty.setraw(master)
        tty.setraw(slave)
        stack.callback(os.close, master)
        stack.callback(os.close, slave)

    def carry() -> None:
        masters = [master for master, _ in ends]
        while not done.is_set():
            for master in select.select(masters, [], [], 0.05)[0]:
                text = os.read(master, 4096)
                while text:
                    text = text[os.write(masters[1 - masters.index(master)], text) :]

    done = threading.Event()
    cable = threading.Thread(target=carry)
    cable.start()
    stack.callback(cable.join)
    stack.callback(done.set)
    return iter([f"slcan:{os.ttyname(slave)}@500000" for _, slave in ends])


@pytest.fixture(scope="module")
def shared_hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """One standalone hub for all tests that don't kill it, on both kinds of socket."""
    with contextlib.ExitStack() as stack:
        yield announced(serve(stack, f"unix:{tmp_path_factory.mktemp('hub')}/bus", "tcp:127.0.0.1:0"))


@pytest.fixture
def rig(request: pytest.FixtureRequest, tmp_path: Path, shared_hub: list[str]) -> Iterator[Rig]:
    with contextlib.ExitStack() as stack:
        yield Rig(request.param, tmp_path, stack, shared_hub)


def on(kinds: list[Any]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("rig", kinds, indirect=True)


# -- frames arrive as they were sent ---------------------------------------------------------------------------------

EVERY_FRAME = [
    *(Frame(0x123, bytes(range(1, size + 1))) for size in range(9)),
    *(Frame(1 << bit, b"\xff\x00\xa5") for bit in range(11)),
    *(Frame(CAN_EFF_FLAG | 1 << bit, b"\x00\xff") for bit in range(29)),
    Frame(0x000, b""),
    Frame(0x7FF, bytes(8)),
    Frame(CAN_EFF_FLAG, b"\xff" * 8),
    Frame(CAN_EFF_FLAG | 0x1FFFFFFF, b"\x80"),
    *(Frame(CAN_RTR_FLAG | 0x55, bytes(size)) for size in range(9)),
    Frame(CAN_RTR_FLAG | CAN_EFF_FLAG | 0x12345678, bytes(3)),
]
ERROR_FRAMES = [Frame(CAN_ERR_FLAG | 1 << bit, bytes([bit] * 8)) for bit in range(9)]


@on(ALL)
def test_every_kind_of_frame_arrives_as_it_was_sent(rig: Rig) -> None:
    frames = EVERY_FRAME if rig.kind == "slcan" else EVERY_FRAME + ERROR_FRAMES
    mine, other = rig.link(), rig.node()
    other.start(echo, 2 * len(frames))
    for frame in frames:
        mine.send([frame])
        assert collect(mine, 1) == [frame]
    mine.send(frames)
    assert collect(mine, len(frames)) == frames
    other.result()


@on([*SHARED, "virtual"])
def test_a_python_can_program_sees_the_same_frames(rig: Rig) -> None:
    frames = EVERY_FRAME + ([] if rig.kind == "vcan" else ERROR_FRAMES)  # python-can cuts an error frame's class there
    other = rig.node()
    rig.let_go()
    with open_bus(rig.url) as bus:
        other.start(echo, len(frames))
        for frame in frames:
            bus.send(to_message(frame))
            message = bus.recv(LIMIT)
            assert message is not None
            assert from_message(message) == frame
            assert message.is_rx or rig.kind == "vcan"  # there python-can means "not from this machine"
        assert bus.recv(0.05) is None
    other.result()


@on(ALL)
def test_nine_bytes_are_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="more than 8 data bytes"):
        rig.link().send([Frame(0x1, bytes(9))])


def test_slcan_cannot_carry_error_frames_and_says_so(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack, pytest.raises(ValueError, match="slcan cannot carry error frames"):
        Rig("slcan", tmp_path, stack).link().send([Frame(CAN_ERR_FLAG | 1, bytes(8))])


# -- who gets what, and when -----------------------------------------------------------------------------------------


@on(ALL)
def test_no_own_echo(rig: Rig) -> None:
    mine, other = rig.link(), rig.node()
    other.start(echo, 1)
    mine.send([Frame(0x10, b"once")])
    assert collect(mine, 1) == [Frame(0x10, b"once")]  # what the other sent back
    assert mine.recv(0.05) == []
    other.result()


@on([*SHARED, "virtual"])
def test_own_echo_on_request(rig: Rig) -> None:
    rig.let_go()
    with open_bus(rig.url, receive_own_messages=True) as bus:
        bus.send(can.Message(arbitration_id=0x77, is_extended_id=False, data=b"me"))
        message = bus.recv(LIMIT)
        assert message is not None
        assert from_message(message) == Frame(0x77, b"me")


@on(ALL)
def test_time_out_is_an_empty_list(rig: Rig) -> None:
    mine = rig.link()
    assert mine.recv(0) == []
    start = time.monotonic()
    assert mine.recv(0.05) == []
    assert 0.045 <= time.monotonic() - start < 5
    mine.send([])


@on(ALL)
def test_filters_pass_wanted_numbers_and_error_frames_only(rig: Rig) -> None:
    passing = [Frame(0x100, b"a"), Frame(0x200 | CAN_RTR_FLAG, bytes(2)), Frame(0x200, b"")]
    passing += [Frame(CAN_EFF_FLAG | 0x100, b"x"), Frame(CAN_EFF_FLAG | CAN_RTR_FLAG | 0x200, bytes(1))]
    stopped = [Frame(0x101, b""), Frame(0x300, b""), Frame(CAN_EFF_FLAG | 0x10000100, b"x")]
    errors = [] if rig.kind == "slcan" else [Frame(CAN_ERR_FLAG | 0x40, bytes(8))]
    sender, picky = rig.link(), rig.node(filters=[0x100, 0x200])
    picky.start(collect, 2 * len(passing) + len(errors))
    sender.send([passing[0], *stopped, *passing[1:], *stopped])
    sender.send(stopped)
    sender.send([*errors, *passing])
    assert picky.result() == [*passing, *errors, *passing]


@on(ALL)
def test_a_filter_does_not_stretch_the_time_out(rig: Rig) -> None:
    noisy, picky = rig.node(), rig.link(filters=[0x7F0])
    noisy.start(send_all, 1, 200)
    start = time.monotonic()
    assert picky.recv(0.2) == []
    assert 0.19 <= time.monotonic() - start < 5
    noisy.result()


def test_filters_are_standard_ids() -> None:
    with pytest.raises(ValueError, match="standard identifiers"):
        open_link("inproc:filters", filters=[0x800])


@on([*SHARED, "slcan"])
def test_select_sees_what_recv_has(rig: Rig) -> None:
    mine, other = rig.link(), rig.node()
    mine.recv(0.01)
    if rig.hub is None:
        assert select.select([mine], [], [], 0)[0] == []
    other.start(send_all, 1, 3)
    seen: list[Frame] = []
    while len(seen) < 3:
        assert select.select([mine], [], [], LIMIT)[0] == [mine]
        seen += mine.recv(0)
    other.result()
    assert seen == numbered(1, 3)


# -- order and losses ------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def lossless_or_loud(rig: Rig) -> Iterator[None]:
    """Only root gets a receive queue on vcan that holds a flood; without it a loss must be reported, and no more."""
    try:
        yield
    except (BusLost, AssertionError) as end:
        if rig.kind != "vcan" or os.geteuid() == 0 or "frames lost" not in str(end):
            raise


@on(SHARED)
def test_four_nodes_flood_the_bus_and_all_see_the_same(rig: Rig) -> None:
    count = 10_000
    listener, nodes = rig.link(), [rig.node() for _ in range(4)]
    for number, node in enumerate(nodes):
        node.start(flood, number, count, 3 * count)
    with lossless_or_loud(rig):
        compare_floods(rig, collect(listener, 4 * count), nodes, count)


def compare_floods(rig: Rig, everything: list[Frame], nodes: list[Node], count: int) -> None:
    for number, node in enumerate(nodes):
        seen = unpack(node.result())
        expected = [frame for frame in everything if frame.can_id != 0x100 + number]
        if rig.kind == "vcan" and (os.cpu_count() or 1) > 1:  # two CPUs may feed two sockets in different orders
            seen.sort()
            expected.sort()
        assert seen == expected
    for number in range(4):
        assert [frame for frame in everything if frame.can_id == 0x100 + number] == numbered(number, count)


@on(SHARED)
def test_a_node_that_joins_a_busy_bus_misses_nothing_from_then_on(rig: Rig) -> None:
    stopper, sender, joiner = rig.link(filters=[]), rig.node(), rig.node(filters=[])
    sender.start(send_until_stopped, 0)
    for numbers in joiner.call(join_often, rig.url, 50):
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    stopper.send([Frame(0x7FF, b"stop")])
    sender.result()


@on(PROCESSES)
def test_a_reader_stopped_for_a_second_loses_nothing(rig: Rig) -> None:
    count = 20_000
    sender, slow, other = rig.node(filters=[]), rig.node(), rig.node()
    for reader in (slow, other):
        reader.start(collect_packed, count)
    slow.stop()
    end = time.monotonic() + 1.0
    sender.call(send_all, 1, count)
    with lossless_or_loud(rig):
        assert unpack(other.result()) == numbered(1, count), "a reader in time must not wait for the slow one"
    while time.monotonic() < end:
        rig.hub.poll(0.05) if rig.hub is not None else time.sleep(0.05)
    slow.kill(signal.SIGCONT)
    with lossless_or_loud(rig):
        assert unpack(slow.result()) == numbered(1, count)


# -- ends ------------------------------------------------------------------------------------------------------------


@on(PROCESSES)
def test_a_killed_peer_disturbs_nobody(rig: Rig) -> None:
    listener, sender, victim = rig.link(filters=[0x101, 0x102]), rig.node(filters=[]), rig.node(filters=[])
    victim.start(send_all, 2, 100_000)
    seen = listener.recv(LIMIT)
    victim.kill()
    sender.start(send_all, 1, 1000)
    while sum(frame.can_id == 0x101 for frame in seen) < 1000:
        batch = listener.recv(LIMIT)
        assert batch
        seen += batch
    sender.result()
    assert [frame for frame in seen if frame.can_id == 0x101] == numbered(1, 1000)
    dying = [frame for frame in seen if frame.can_id == 0x102]
    assert dying == numbered(2, len(dying)), "what it sent before is whole and in order"


@on(["mortal unix", "mortal tcp"])
def test_a_killed_hub_ends_receives_and_sends_at_once(rig: Rig) -> None:
    assert rig.server is not None
    reader, writer, mine = rig.node(), rig.node(), rig.link()
    reader.start(wait_for_the_end)
    writer.start(send_to_the_end)
    assert mine.recv(LIMIT)
    rig.server.kill()
    rig.server.wait()
    killed = time.monotonic()
    for node in (reader, writer):
        reason, when = node.result()
        assert "the hub is gone" in reason
        assert rig.url in reason
        assert when - killed < 1.0
    with pytest.raises(BusLost, match="the hub is gone"):
        while True:
            mine.recv(LIMIT)
    with pytest.raises(BusLost, match="the hub is gone"):
        mine.send([Frame(1, b"")])


@on(["mortal unix", "mortal tcp"])
def test_the_first_send_after_a_killed_hub_raises(rig: Rig) -> None:
    assert rig.server is not None
    mine = rig.link()
    rig.server.kill()
    rig.server.wait()
    with pytest.raises(BusLost, match="the hub is gone"):
        mine.send([Frame(1, b"")])


@on(ALL)
def test_closing_twice_is_fine_and_a_closed_link_says_so(rig: Rig) -> None:
    mine = rig.link()
    mine.close()
    mine.close()
    for _ in range(2):
        with pytest.raises(BusLost, match="this link was closed"):
            mine.recv(1.0)
        with pytest.raises(BusLost, match="this link was closed"):
            mine.send([Frame(1, b"")])


@on(["unix", "tcp", "inproc", "slcan", VCAN])
def test_closing_ends_a_receive_in_another_thread(rig: Rig) -> None:
    mine = rig.link()
    ends: list[BaseException] = []

    def wait() -> None:
        try:
            mine.recv(LIMIT)
        except BusLost as lost:
            ends.append(lost)

    thread = threading.Thread(target=wait)
    thread.start()
    time.sleep(0.05)  # most likely it is in the receive now; the outcome is the same if it is not
    mine.close()
    thread.join(LIMIT)
    assert len(ends) == 1


@on(ALL)
def test_a_link_has_a_url_and_is_a_context(rig: Rig) -> None:
    with rig.link() as link:
        assert rig.url in link.url
        assert link.url in repr(link)
    with pytest.raises(BusLost):
        link.recv(0)


# -- vcan: the kernel drops frames of slow readers, and we must say so -----------------------------------------------


def open_small(link: Link, count: int) -> str:
    """Read with a small queue after having been stopped; return how it ended."""
    del link
    with SocketcanLink("vcan0", receive_buffer=4096) as small:
        small.send([Frame(0x7F0, b"ready")])
        os.kill(os.getpid(), signal.SIGSTOP)
        small.send([Frame(0x7F0, b"awake")])
        seen = 0
        try:
            while seen < count:
                batch = small.recv(3.0)
                if not batch:
                    return f"silence after {seen} of {count}"
                seen += len(batch)
        except BusLost as lost:
            return str(lost)
    return f"all {seen} frames"


@pytest.mark.parametrize("behind", [0, 10], ids=["nothing behind the loss", "more frames behind the loss"])
@on([VCAN])
def test_an_overrun_on_vcan_is_loud(rig: Rig, behind: int) -> None:
    count = 5000
    control, sender, reader = rig.link(filters=[0x7F0]), rig.node(filters=[]), rig.node(filters=[])
    reader.start(open_small, count + behind)
    assert collect(control, 1)
    reader.wait_for_stop()
    sender.call(send_all, 1, count)
    if behind:
        reader.kill(signal.SIGCONT)
        assert collect(control, 1)
        sender.call(send_all, 2, behind)
    else:
        reader.kill(signal.SIGCONT)
    end = reader.result()
    assert "frames lost: this reader was too slow" in end, end
    assert int(end.split(": ")[1].split()[0]) > 0


class FullQueue:
    """A transmit queue that is full for a while."""

    def __init__(self, real: FrameBatch, times: float) -> None:
        self._real = real
        self._left = times

    def send(self, records: bytes) -> int:
        self._left -= 1
        if self._left >= 0:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        return self._real.send(records[:RECORD_SIZE])  # and then it takes one frame at a time


@on([VCAN])
def test_a_full_transmit_queue_is_waited_out(rig: Rig) -> None:
    mine, other = rig.link(), rig.node()
    assert isinstance(mine, SocketcanLink)
    other.start(collect, 5)
    mine._outboxes[:] = [FullQueue(mine._outboxes[0], 3)]  # type: ignore[list-item]
    mine.send(numbered(1, 5))
    assert other.result() == numbered(1, 5)


@on([VCAN])
def test_a_transmit_queue_that_stays_full_is_loud(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = rig.link()
    assert isinstance(mine, SocketcanLink)
    monkeypatch.setattr("can_bus.socketcan._SEND_LIMIT", 0.05)
    mine._outboxes[:] = [FullQueue(mine._outboxes[0], float("inf"))]  # type: ignore[list-item]
    with pytest.raises(BusLost, match=r"the transmit queue stayed full for 0\.05 s"):
        mine.send(numbered(1, 1))


@pytest.mark.parametrize("how", [["set", "vcan77", "down"], ["delete", "vcan77"]], ids=["down", "deleted"])
@pytest.mark.vcan
def test_an_interface_that_goes_away_is_loud(how: list[str]) -> None:
    need_vcan()
    if os.geteuid() != 0:
        pytest.skip("needs root to make an interface of its own")

    def ip(*words: str) -> int:
        return subprocess.run(["ip", "link", *words], check=False).returncode

    assert ip("add", "vcan77", "type", "vcan") == 0
    try:
        assert ip("set", "vcan77", "up") == 0
        with open_link("socketcan:vcan77") as link:
            assert link.recv(0) == []
            assert ip(*how) == 0
            with pytest.raises(BusLost, match="the interface is gone"):
                link.recv(LIMIT)
            with pytest.raises(BusLost, match="the interface is gone"):
                link.send(numbered(1, 1))
        with pytest.raises(can.CanInitializationError) if "delete" in how else contextlib.nullcontext():
            open_link("socketcan:vcan77").close()
    finally:
        ip("delete", "vcan77")


# -- URLs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "expected"),
        ("vcan0", "expected"),
        ("unix:", "expected"),
        ("unix:/" + 120 * "x", "at most 107 bytes"),
        ("tcp:127.0.0.1", "expected tcp:127.0.0.1:port"),
        ("tcp:127.0.0.1:http", "expected tcp:127.0.0.1:port"),
        ("tcp:127.0.0.1:70000", "port from 0 to 65535"),
        ("tcp:0.0.0.0:5000", "only reachable on this machine"),
        ("tcp:example.org:5000", "only reachable on this machine"),
        ("nonsense:0", "no interface 'nonsense'"),
        ("socketcan:", "expected"),
        ("slcan:@500000", "no channel"),
        ("hub", "private bus of one run"),
        ("hub:", "private bus of one run"),
        ("inproc", "private bus of one run"),
        ("inproc:", "private bus of one run"),
    ],
)
@pytest.mark.parametrize("opens", [open_link, open_bus])
def test_a_wrong_url_is_one_clear_line(opens: Callable[[str], object], url: str, says: str) -> None:
    with pytest.raises(BusUrlError) as caught:
        opens(url)
    text = str(caught.value)
    assert says in text
    assert repr(url) in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("url", "says"),
    [
        pytest.param("socketcan:vcan98", "no such CAN interface", marks=pytest.mark.vcan),
        ("unix:/nowhere/bus", "no hub is serving there"),
        ("tcp:127.0.0.1:1", "no hub is serving there"),
        ("socketcan:vcan99", "(no such CAN interface|no CAN)"),
        ("slcan:/dev/nowhere@500000", "/dev/nowhere"),
        ("slcan:/dev/null@500000", "/dev/null"),
    ],
)
def test_a_bus_that_is_not_there_is_one_clear_line(url: str, says: str) -> None:
    with pytest.raises(can.CanInitializationError, match=says) as caught:
        open_link(url)
    assert str(caught.value).startswith(url + ": ")
    assert "\n" not in str(caught.value)


def test_a_bit_rate_that_slcan_does_not_have_is_one_clear_line() -> None:
    master, slave = os.openpty()
    url = f"slcan:{os.ttyname(slave)}@123"
    with pytest.raises(can.CanInitializationError, match="Invalid bitrate, choose one of 10000") as caught:
        open_link(url)
    assert str(caught.value).startswith(url + ": ")
    os.close(slave)
    os.close(master)


def test_other_python_can_interfaces_take_options_behind_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def record(**settings: object) -> can.BusABC:
        given.update(settings)
        raise can.CanInitializationError("not now")

    monkeypatch.setattr(can, "Bus", record)
    with pytest.raises(can.CanInitializationError, match="not now"):
        open_bus("udp_multicast:239.74.163.2@250000,hop_limit=0,fd=false,receive_timeout=0.5,name=x")
    assert given == {
        "interface": "udp_multicast",
        "channel": "239.74.163.2",
        "bitrate": 250000,
        "hop_limit": 0,
        "fd": False,
        "receive_timeout": 0.5,
        "name": "x",
        "receive_own_messages": False,
    }


# -- slcan against an adapter that is not perfect --------------------------------------------------------------------


@pytest.fixture
def adapter() -> Iterator[tuple[int, Link]]:
    """The far end of a serial port that a link has open."""
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    try:
        with open_link(f"slcan:{os.ttyname(slave)}@500000") as link:
            yield master, link
    finally:
        os.close(slave)
        with contextlib.suppress(OSError):
            os.close(master)


def test_slcan_sets_the_bit_rate_and_opens(adapter: tuple[int, Link]) -> None:
    assert os.read(adapter[0], 100).startswith(b"C\rS6\r")


def test_slcan_reads_split_lines_time_stamps_and_answers(adapter: tuple[int, Link]) -> None:
    master, link = adapter
    os.write(master, b"\r\az\rt12")
    assert link.recv(0.05) == []
    os.write(master, b"32A1B2\rt0010FFFF\rV1013\rd1232A1B2\r")
    assert collect(link, 2) == [Frame(0x123, b"\xa1\xb2"), Frame(0x001, b"")]


def test_slcan_a_garbled_line_is_a_lost_frame(adapter: tuple[int, Link]) -> None:
    master, link = adapter
    os.write(master, b"t1\rt1230\r")  # the tail of another session, then a frame
    assert collect(link, 1) == [Frame(0x123, b"")]
    os.write(master, b"t1238112233\r")
    with pytest.raises(BusLost, match="a frame was lost: unreadable line"):
        link.recv(LIMIT)


def test_slcan_does_not_tell_of_every_line_of_a_flood(
    adapter: tuple[int, Link], caplog: pytest.LogCaptureFixture
) -> None:
    master, link = adapter
    os.write(master, b"t1230\r")
    assert collect(link, 1) == [Frame(0x123, b"")]
    for _ in range(100):
        os.write(master, b"assertion failed\r" * 10)
        assert link.recv(0) == []
    os.write(master, b"t1240\r")
    assert collect(link, 1) == [Frame(0x124, b"")]
    assert "ignored what is no slcan: b'assertion failed'" in caplog.messages[0]
    assert "no more of this is told" in caplog.messages[-1]
    assert len(caplog.messages) == 21


def test_slcan_a_pulled_adapter_is_loud(adapter: tuple[int, Link]) -> None:
    master, link = adapter
    os.close(master)
    with pytest.raises(BusLost, match="the serial port is gone"):
        link.recv(LIMIT)


def test_slcan_over_a_pyserial_url() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"slcan:socket://127.0.0.1:{server.getsockname()[1]}@500000"
        with open_link(url) as link:
            device, _ = server.accept()
            with device:
                link.send([Frame(0x321, b"\x0f")])
                received = b""
                while not received.endswith(b"t32110F\r"):
                    received += device.recv(100)
                device.sendall(b"t7FF101\rT1FFFFFFF0\r")
                assert collect(link, 2) == [Frame(0x7FF, b"\x01"), Frame(CAN_EFF_FLAG | 0x1FFFFFFF, b"")]


# -- frames ----------------------------------------------------------------------------------------------------------


def test_records_are_linux_can_frames() -> None:
    packed = pack([Frame(CAN_EFF_FLAG | 0x1ABCDEF0, b"\x01\x02")])
    assert packed == bytes.fromhex("f0debc9a 02 000000 0102000000000000")
    assert unpack(pack(EVERY_FRAME + ERROR_FRAMES)) == EVERY_FRAME + ERROR_FRAMES
    assert len(pack(EVERY_FRAME)) == RECORD_SIZE * len(EVERY_FRAME)
    assert unpack(b"") == []


def test_bytes_beyond_the_length_are_ignored() -> None:
    (frame,) = unpack(bytes.fromhex("23010000 02 ffffff 0102ffffffffffff"))
    assert frame == Frame(0x123, b"\x01\x02")
    (remote,) = unpack(bytes.fromhex("23010040 03 ffffff ffffffffffffffff"))
    assert remote == Frame(CAN_RTR_FLAG | 0x123, bytes(3))


@pytest.mark.parametrize("frame", EVERY_FRAME + ERROR_FRAMES)
def test_messages_of_python_can_are_the_same_frames(frame: Frame) -> None:
    message = to_message(frame, timestamp=1.5)
    message._check()
    assert from_message(message) == frame
    assert message.timestamp == 1.5


@pytest.mark.parametrize("frame", [Frame(1, bytes(9)), Frame(-1, b""), Frame(1 << 32, b""), Frame(1, bytes(300))])
def test_what_is_no_frame_is_refused(frame: Frame) -> None:
    with pytest.raises(ValueError, match="not a classic CAN frame"):
        pack([frame])


def test_can_fd_is_refused() -> None:
    with pytest.raises(ValueError, match="CAN FD"):
        from_message(can.Message(is_fd=True, data=bytes(12)))
    with pytest.raises(ValueError, match="more than 8"):
        from_message(can.Message(data=bytes(9)))
