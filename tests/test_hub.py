"""The hub: its addresses, its wire, its promises to slow and dying clients, and its python-can plugin."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import logging
import os
import re
import select
import shutil
import signal
import socket
import stat
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from can_bus import hub_wire
from can_bus.address import parse_address
from can_bus.frame import RECORD_SIZE, Frame, from_message, pack, to_message
from can_bus.hilbus import HilBus
from can_bus.hub import Hub, main
from can_bus.hub_link import HubLink
from can_bus.inproc import inproc_hub
from can_bus.link import BusLost, Link
from can_bus.url import BusUrlError, open_link

LIMIT = 30.0
KINDS = ["unix", "tcp"]


def frames(count: int, can_id: int = 0x100) -> list[Frame]:
    return [Frame(can_id, number.to_bytes(8, "little")) for number in range(count)]


def collect(link: Link, count: int) -> list[Frame]:
    seen: list[Frame] = []
    while len(seen) < count:
        batch = link.recv(LIMIT)
        assert batch, f"{len(seen)} of {count} frames came"
        seen += batch
    assert len(seen) == count
    return seen


@pytest.fixture
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"unix:{tmp_path}/bus" if getattr(request, "param", "unix") == "unix" else "tcp:127.0.0.1:0"


@pytest.fixture
def hub(url: str) -> Iterator[Hub]:
    """A hub that nobody drives yet."""
    with Hub(url) as made:
        yield made


_opened: list[HubLink] = []


@pytest.fixture(autouse=True)
def closed_behind() -> Iterator[None]:
    """Close the links of ``joined``, also when a test fails."""
    yield
    while _opened:
        _opened.pop().close()


def joined(hub: Hub) -> HubLink:
    """Open a link to a hub that this thread drives."""
    thread = threading.Thread(target=lambda: _opened.append(HubLink(hub.urls[0])))
    thread.start()
    while thread.is_alive():
        hub.poll(0.01)
    thread.join()
    return _opened[-1]


def raw(hub: Hub) -> socket.socket:
    """A bare connection, for clients that do it wrong."""
    address = parse_address(hub.urls[0])
    connection = socket.socket(address.family, socket.SOCK_STREAM)
    connection.connect(address.target)
    connection.settimeout(LIMIT)
    return connection


def read_exactly(connection: socket.socket, size: int) -> bytes:
    got = b""
    while len(got) < size:
        part = connection.recv(size - len(got))
        assert part, f"the connection ended after {got!r}"
        got += part
    return got


on_both = pytest.mark.parametrize("url", KINDS, indirect=True)


# -- addresses -------------------------------------------------------------------------------------------------------


def test_the_socket_file_is_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        with Hub(f"unix:{tmp_path}/bus"):
            assert stat.S_IMODE((tmp_path / "bus").stat().st_mode) == 0o600
            assert os.umask(0) == 0, "the umask of the process must not be touched"
    finally:
        os.umask(before)


def test_the_socket_file_is_never_open_to_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    real = Path.chmod

    def watch(path: Path, mode: int) -> None:
        modes.append(stat.S_IMODE(path.stat().st_mode))
        real(path, mode)

    monkeypatch.setattr(Path, "chmod", watch)
    before = os.umask(0)
    try:
        Hub(f"unix:{tmp_path}/bus").close()
    finally:
        os.umask(before)
    assert modes == [0o600], "the mode between bind and chmod"


def test_the_socket_file_goes_with_the_hub(tmp_path: Path) -> None:
    hub = Hub([f"unix:{tmp_path}/one", f"unix:{tmp_path}/two", "tcp:127.0.0.1:0", "tcp:[::1]:0"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]
    assert [url.partition(":")[0] for url in hub.urls] == ["unix", "unix", "tcp", "tcp"]
    assert not hub.urls[2].endswith(":0")
    hub.close()
    hub.close()
    assert list(tmp_path.iterdir()) == []


def test_another_hubs_file_is_not_removed(tmp_path: Path) -> None:
    first = Hub(f"unix:{tmp_path}/bus")
    (tmp_path / "bus").unlink()
    with Hub(f"unix:{tmp_path}/bus"):
        first.close()
        assert (tmp_path / "bus").exists()


def test_a_stale_socket_file_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / "bus"))
    assert (tmp_path / "bus").exists()
    with Hub(f"unix:{tmp_path}/bus") as hub, joined(hub):
        assert hub.clients == 1


def test_a_served_path_is_refused_and_stays_served(tmp_path: Path) -> None:
    url = f"unix:{tmp_path}/bus"
    with Hub(url) as hub:
        with pytest.raises(can.CanInitializationError, match="another hub is serving this path") as caught:
            Hub(url)
        assert url in str(caught.value)
        with joined(hub):
            assert hub.clients == 1


@pytest.mark.parametrize("thing", ["file", "folder", "link"])
def test_what_is_no_socket_is_not_removed(tmp_path: Path, thing: str) -> None:
    path = tmp_path / "bus"
    if thing == "file":
        path.write_text("precious")
    elif thing == "folder":
        path.mkdir()
    else:
        path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(can.CanInitializationError, match="a file that is no socket is in the way"):
        Hub(f"unix:{path}")
    assert path.is_symlink() or path.exists()


def test_a_missing_folder_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(can.CanInitializationError, match="No such file or directory"):
        Hub(f"unix:{tmp_path}/missing/bus")


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "", "192.0.2.1", "example.org"])
def test_tcp_never_leaves_the_machine(host: str) -> None:
    with pytest.raises(BusUrlError, match="only reachable on this machine"):
        Hub(f"tcp:{host}:29536")


def test_a_port_in_use_is_a_clear_error_and_closes_what_was_opened(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        url = f"tcp:127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(can.CanInitializationError, match=f"{url}: the address is in use by another program"):
            Hub([f"unix:{tmp_path}/bus", url])
    assert list(tmp_path.iterdir()) == []


def test_several_addresses_are_one_bus(tmp_path: Path) -> None:
    hub = Hub([f"unix:{tmp_path}/bus", "tcp:127.0.0.1:0"]).start()
    with hub, open_link(hub.urls[0]) as one, open_link(hub.urls[1]) as two:
        one.send(frames(3))
        assert collect(two, 3) == frames(3)
        two.send(frames(2))
        assert collect(one, 2) == frames(2)


# -- the wire --------------------------------------------------------------------------------------------------------


@on_both
def test_hello_and_welcome_byte_by_byte(hub: Hub) -> None:
    hub.start()
    with raw(hub) as client:
        for byte in b"HILBUS\r\n" + struct.pack("<HHI", 1, 0, 4711):
            client.send(bytes([byte]))
            time.sleep(0.001)
        magic, version, flags, pid = struct.unpack("<8sHHI", read_exactly(client, 16))
        assert (magic, version, flags, pid) == (b"HILBUS\r\n", 1, 0, os.getpid())
        with open_link(hub.urls[0]) as other:
            packed = pack(frames(2))
            for byte in packed:  # records in pieces
                client.send(bytes([byte]))
            assert collect(other, 2) == frames(2)
            other.send(frames(3))
            assert read_exactly(client, 48) == pack(frames(3))


@on_both
def test_frames_right_behind_the_hello_count(hub: Hub) -> None:
    local = hub.local_link()
    with raw(hub) as client:
        client.sendall(hub_wire.hello(0) + pack(frames(5)))
        assert collect(local, 5) == frames(5)


@pytest.mark.parametrize("answer", [b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"x", b"HILBUS01" + bytes(8)])
@on_both
def test_a_stranger_gets_a_reason_and_the_door(hub: Hub, answer: bytes, caplog: pytest.LogCaptureFixture) -> None:
    hub.start()
    with raw(hub) as stranger:
        stranger.sendall(answer)
        assert hub_wire.goodbye_text(read_exactly(stranger, 16)) == hub_wire.goodbye_text(
            hub_wire.goodbye(hub_wire.Reason.NOT_A_CLIENT)
        )
        assert ended(stranger)
    assert "did not send a hello" in caplog.text
    assert hub.clients == 0


def ended(connection: socket.socket) -> bool:
    """Whether nothing but the end of the stream follows."""
    try:
        return connection.recv(100) == b""
    except ConnectionResetError:
        return True


def test_another_version_is_refused_in_words(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    hub.start()
    monkeypatch.setattr(hub_wire, "hello", lambda flags: struct.pack("<8sHHI", hub_wire.MAGIC, 9, flags, 1))
    with pytest.raises(can.CanInitializationError, match="refused, the hub speaks version 1 of the protocol"):
        HubLink(hub.urls[0])


def test_something_else_that_answers_is_not_taken_for_a_hub(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "bus"))
        server.listen()

        def answer(text: bytes) -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(text)
                connection.shutdown(socket.SHUT_WR)
                connection.recv(100)

        for text, says in ((b"220 smtp.example.org ESMTP\r\n", "is not a hub"), (b"short", "before its welcome")):
            thread = threading.Thread(target=answer, args=(text,))
            thread.start()
            with pytest.raises(can.CanInitializationError, match=says):
                HubLink(f"unix:{tmp_path}/bus")
            thread.join()


def test_a_hub_that_nobody_drives_is_a_clear_error(hub: Hub) -> None:
    with pytest.raises(can.CanInitializationError, match=r"no welcome within 0\.1 s"):
        HubLink(hub.urls[0], welcome_timeout=0.1)


def test_a_link_can_wait_for_its_hub(tmp_path: Path) -> None:
    url = f"unix:{tmp_path}/bus"
    made: list[Link] = []
    thread = threading.Thread(target=lambda: made.append(open_link(url, wait=LIMIT)))
    thread.start()
    time.sleep(0.05)
    with Hub(url) as hub:
        hub.wait_for_clients(1, LIMIT)
        thread.join()
        made[0].close()


@on_both
def test_a_malformed_record_ends_that_connection_only(hub: Hub, caplog: pytest.LogCaptureFixture) -> None:
    good, bad, local = joined(hub), joined(hub), hub.local_link()
    bad.send_packed(struct.pack("<IB3x8s", 0x123, 9, bytes(8)))
    good.send(frames(2))
    assert collect(local, 2) == frames(2)
    local.send(frames(1))
    assert collect(good, 1) == frames(1)
    while hub.poll(0.05):
        pass
    with pytest.raises(BusLost, match="a record with a length of 9"):
        bad.recv(LIMIT)
    assert "sent a record of length 9" in caplog.text


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_documented_c_client_works(hub: Hub, tmp_path: Path) -> None:
    text = hub_wire.__doc__ or ""
    example = text[text.index("    int s = socket(") :]
    source = tmp_path / "client.c"
    source.write_text(
        "#include <stdint.h>\n#include <string.h>\n#include <sys/socket.h>\n#include <sys/un.h>\n#include <unistd.h>\n"
        "#include <linux/can.h>\n#include <stdio.h>\n"
        + re.search(r"struct hello \{.*?\};", text)[0]  # type: ignore[index]
        + '\nstatic void handle(struct can_frame *f) { printf("%x %d %x\\n", f->can_id, f->len, f->data[0]); }\n'
        + "int main(void) {\n"
        + example.replace("/tmp/bus", f"{tmp_path}/bus").replace("handle(&f)", "handle(&f)")
        + "return 0; }\n"
    )
    program = tmp_path / "client"
    subprocess.run(["cc", "-Wall", "-o", program, source], check=True)
    local = hub.local_link()
    with subprocess.Popen([program], stdout=subprocess.PIPE, text=True) as client:
        assert collect(local, 1) == [Frame(0x123, b"\x01\x02")]
        local.send([Frame(0x80000ABC, b"\x7f"), Frame(0x7, b"")])
        hub.close()
        assert client.communicate(timeout=LIMIT)[0] == "80000abc 1 7f\n7 0 0\n"
    assert client.returncode == 0


# -- slow and dying clients ------------------------------------------------------------------------------------------


@on_both
def test_a_cap_overrun_disconnects_that_client_only(url: str, caplog: pytest.LogCaptureFixture) -> None:
    with Hub(url, cap=1000) as hub:
        local, slow, good = hub.local_link(), joined(hub), joined(hub)
        sent = 0
        while hub.clients == 2:
            local.send(frames(100))
            sent += 100
            assert collect(good, 100) == frames(100)
            assert sent < 1_000_000
        assert len(caplog.records) == 1
        assert caplog.records[0].levelno == logging.ERROR
        assert f"pid {os.getpid()}" in caplog.text
        assert re.search(r"is too slow, \d+ frames wait for it \(cap 1000\): disconnected", caplog.text)

        good.send(frames(2))  # life goes on for the others
        assert collect(local, 2) == frames(2)
        seen: list[Frame] = []
        with pytest.raises(BusLost, match=r"too slow: the hub's queue for it was full and (\d+) frames") as caught:
            while True:
                seen += slow.recv(0.2)
                hub.poll(0)
        discarded = int(re.search(r"and (\d+) frames", str(caught.value))[1])  # type: ignore[index]
        assert discarded > 1000
        assert sent - len(seen) in (discarded, discarded - 1), "every frame is either received or counted"
        assert seen == (frames(100) * (sent // 100))[: len(seen)], "what came before the end is whole and in order"
        with pytest.raises(BusLost, match="too slow"):
            slow.recv(0)
        with pytest.raises(BusLost, match="too slow"):
            slow.send(frames(1))


def test_a_sender_that_never_reads_learns_of_its_overrun(tmp_path: Path) -> None:
    with Hub(f"unix:{tmp_path}/bus", cap=100) as hub:
        local, deaf = hub.local_link(), joined(hub)
        while hub.clients:
            local.send(frames(100))
        with pytest.raises(BusLost, match="the hub is gone"):
            deaf.send(frames(1))


def test_an_overrun_inproc_ends_that_link_only(caplog: pytest.LogCaptureFixture) -> None:
    url = "inproc:overrun"
    inproc_hub("overrun").cap = 1000
    with open_link(url) as sender, open_link(url) as slow, open_link(url) as good:
        for _ in range(11):
            sender.send(frames(100))
            assert collect(good, 100) == frames(100)
        assert "is too slow, more than 1000 frames wait for it: disconnected" in caplog.text
        with pytest.raises(BusLost, match="too slow: its queue was full and 1100 frames were discarded"):
            slow.recv(LIMIT)
        with pytest.raises(BusLost, match="too slow"):
            slow.send(frames(1))
        sender.send(frames(1))
        assert collect(good, 1) == frames(1)


def test_a_closed_inproc_bus_delivers_what_waits_and_then_says_so() -> None:
    with open_link("inproc:closing") as one, open_link("inproc:closing") as two:
        one.send(frames(2))
        inproc_hub("closing").close()
        assert collect(two, 2) == frames(2)
        for link in (one, two):
            with pytest.raises(BusLost, match="the bus was closed"):
                link.recv(LIMIT)
            with pytest.raises(BusLost, match="the bus was closed"):
                link.send(frames(1))
    with open_link("inproc:closing") as again:
        assert again.recv(0) == []


@on_both
def test_what_was_sent_before_a_close_is_switched(hub: Hub) -> None:
    local = hub.local_link()
    for _ in range(20):
        hasty = joined(hub)
        local.send(frames(2000, 0x200))  # it leaves these unread
        hasty.send(frames(300))
        hasty.close()
        assert collect(local, 300) == frames(300)
    while hub.clients:
        hub.poll(LIMIT)


@on_both
def test_a_frame_cut_off_by_death_is_not_switched(hub: Hub) -> None:
    local = hub.local_link()
    with raw(hub) as dying:
        dying.sendall(hub_wire.hello(0) + pack(frames(3))[:-1])
    assert collect(local, 2) == frames(3)[:2]
    while hub.poll(0.05):
        pass
    assert local.recv(0) == []
    assert hub.clients == 0


@on_both
def test_closing_the_hub_delivers_what_waits_and_says_goodbye(hub: Hub) -> None:
    local, slow = hub.local_link(), joined(hub)
    local.send(frames(50_000))
    if slow.url.startswith("unix"):  # the kernel takes less of it than TCP
        taken = int.from_bytes(fcntl.ioctl(slow.fileno(), termios.FIONREAD, bytes(4)), sys.byteorder)
        assert taken < 40_000 * RECORD_SIZE, "the rest waits in the hub"
    seen: list[Frame] = []
    ends: list[str] = []

    def read() -> None:
        try:
            while True:
                seen.extend(slow.recv(LIMIT))
        except BusLost as lost:
            ends.append(str(lost))

    reader = threading.Thread(target=read)
    reader.start()
    hub.close()
    reader.join(LIMIT)
    assert seen == frames(50_000)
    assert ends == [f"{slow.url}: the hub was closed"]
    with pytest.raises(BusLost, match="the hub was closed"):
        local.recv(0)
    with pytest.raises(BusLost, match="the hub was closed"):
        local.send(frames(1))


def test_a_hub_that_closes_over_a_stuck_reader_is_loud(hub: Hub, caplog: pytest.LogCaptureFixture) -> None:
    local, stuck = hub.local_link(), joined(hub)
    local.send(frames(50_000))
    hub.close(linger=0.05)
    assert re.search(r"did not take \d+ frames before the end", caplog.text)
    with pytest.raises(BusLost, match="the hub is gone"):
        while True:
            stuck.recv(LIMIT)


@on_both
def test_two_peers_that_send_before_they_read_do_not_deadlock(hub: Hub) -> None:
    hub.start()
    count = 100_000
    with HubLink(hub.urls[0]) as one, HubLink(hub.urls[0]) as two:
        packed = pack(frames(count))
        threads = [threading.Thread(target=link.send_packed, args=(packed,)) for link in (one, two)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LIMIT)
            assert not thread.is_alive()
        assert collect(one, count) == collect(two, count) == frames(count)


# -- the host's side -------------------------------------------------------------------------------------------------


def test_waiting_for_clients_names_those_that_came(hub: Hub) -> None:
    hub.wait_for_clients(0, 0)
    with joined(hub), pytest.raises(TimeoutError, match=rf"1 of 2 clients joined within 0.05 s .*pid {os.getpid()}"):
        hub.wait_for_clients(2, 0.05)


def test_waiting_for_clients_of_a_hub_in_another_thread(hub: Hub) -> None:
    hub.start()
    with pytest.raises(TimeoutError, match="0 of 1 clients"):
        hub.wait_for_clients(1, 0.05)
    with HubLink(hub.urls[0]):
        hub.wait_for_clients(1, LIMIT)
    with pytest.raises(ValueError, match="already being served"):
        hub.start()


def test_local_links_hear_each_other_and_the_clients(hub: Hub) -> None:
    one, two, client = hub.local_link(), hub.local_link([0x101]), joined(hub)
    one.send(frames(1))
    one.send(frames(1, 0x101))
    assert one.recv(0) == []
    assert two.recv(LIMIT) == frames(1, 0x101)
    assert collect(client, 2) == [*frames(1), *frames(1, 0x101)]
    client.send(frames(1, 0x101))
    assert one.recv(LIMIT) == two.recv(LIMIT) == frames(1, 0x101)
    two.close()
    two.close()
    one.send(frames(1, 0x101))
    with pytest.raises(BusLost, match="this link was closed"):
        two.recv(0)
    with pytest.raises(BusLost, match="this link was closed"):
        two.send(frames(1))


def test_select_on_a_local_link_sees_clients_and_other_local_links(hub: Hub) -> None:
    one, two, client = hub.local_link(), hub.local_link(), joined(hub)
    assert select.select([one], [], [], 0)[0] == []
    client.send(frames(1))
    assert select.select([one], [], [], LIMIT)[0] == [one]
    assert one.recv(0) == two.recv(0) == frames(1)
    two.send(frames(1))
    assert select.select([one], [], [], LIMIT)[0] == [one]
    assert one.recv(0) == frames(1)


def test_the_own_echo_takes_its_place_in_the_order(hub: Hub) -> None:
    hub.start()
    with HubLink(hub.urls[0], echo=True) as one, HubLink(hub.urls[0], echo=True) as two:
        for number in range(300):
            one.send(frames(2, number))
            two.send(frames(3, 0x400 + number))
        assert collect(one, 1500) == collect(two, 1500)


def test_a_host_that_fails_does_not_wait_for_its_readers(tmp_path: Path) -> None:
    with pytest.raises(KeyError), Hub(f"unix:{tmp_path}/bus") as hub:
        joined(hub)
        hub.local_link().send(frames(50_000))
        start = time.monotonic()
        raise KeyError
    assert time.monotonic() - start < 2.0


@on_both
def test_a_send_after_the_goodbye_tells_the_reason(hub: Hub) -> None:
    local, link = hub.local_link(), joined(hub)
    local.send(frames(777))
    hub.close()
    with pytest.raises(BusLost, match="the hub was closed"):
        link.send(frames(1))


def test_a_closed_hub_cannot_be_polled(hub: Hub) -> None:
    hub.close()
    with pytest.raises(ValueError, match="the hub is closed"):
        hub.poll(0)


# -- python -m can_bus.hub -------------------------------------------------------------------------------------------


def test_the_command_serves_until_a_signal_and_cleans_up(tmp_path: Path) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        command = [sys.executable, "-m", "can_bus.hub", f"unix:{tmp_path}/bus", "tcp:127.0.0.1:0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            said, *urls = process.stdout.readline().split()
            assert said == "serving"
            with open_link(urls[0]) as one, open_link(urls[1]) as two:
                one.send(frames(3))
                assert collect(two, 3) == frames(3)
                process.send_signal(number)
                with pytest.raises(BusLost, match="the hub was closed"):
                    one.recv(LIMIT)
            assert process.wait(LIMIT) == 0
            assert "joined" in process.stderr.read()
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", ["tcp:0.0.0.0:1", "unix:/nowhere/bus", "hub"])
def test_the_command_refuses_in_one_line(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([wrong]) == 2
    said = capsys.readouterr().err
    assert said.startswith("hub: ")
    assert wrong.partition(":")[0] in said
    assert said.count("\n") == 1


# -- the python-can plugin -------------------------------------------------------------------------------------------


@pytest.fixture
def served(hub: Hub) -> str:
    return hub.start().urls[0]


def test_python_can_finds_the_plugin_by_name(served: str) -> None:
    with can.Bus(interface="hilbus", channel=served) as bus, open_link(served) as link:
        assert isinstance(bus, HilBus)
        assert served in str(bus)
        bus.send(to_message(Frame(0x42, b"x")))
        assert collect(link, 1) == [Frame(0x42, b"x")]
        link.send(frames(1))
        message = bus.recv(LIMIT)
        assert message is not None
        assert from_message(message) == frames(1)[0]
        assert message.channel == served
        assert abs(message.timestamp - time.time()) < LIMIT


def test_messages_in_one_batch_come_one_by_one_and_select_sees_each(served: str) -> None:
    with HilBus(served) as bus, open_link(served) as link:
        assert bus.recv(0) is None
        assert bus.recv(0.01) is None
        link.send(frames(5))
        for frame in frames(5):
            assert select.select([bus], [], [], LIMIT)[0] == [bus]
            message = bus.recv(0)
            assert message is not None
            assert from_message(message) == frame
        assert select.select([bus], [], [], 0)[0] == []


@pytest.mark.parametrize("kind", ["hub", "inproc"])
def test_python_can_filters(served: str, kind: str) -> None:
    url = served if kind == "hub" else "inproc:python-can-filters"
    with HilBus(url, can_filters=[{"can_id": 0x100, "can_mask": 0x700}]) as bus, open_link(url) as link:
        link.send([Frame(0x200, b""), Frame(0x1FF, b""), Frame(0x300, b""), Frame(0x101, b"")])
        assert [message.arbitration_id for message in (bus.recv(LIMIT), bus.recv(LIMIT)) if message] == [0x1FF, 0x101]
        assert bus.recv(0.01) is None
        bus.set_filters(None)
        link.send([Frame(0x200, b"")])
        assert bus.recv(LIMIT) is not None


def test_a_notifier_in_a_thread(served: str) -> None:
    reader = can.BufferedReader()
    with HilBus(served) as bus, open_link(served) as link:
        with can.Notifier(bus, [reader], timeout=0.1):
            link.send(frames(20))
            seen = [reader.get_message(LIMIT) for _ in range(20)]
        assert [from_message(message) for message in seen if message] == frames(20)


@pytest.mark.parametrize("kind", ["hub", "inproc"])
def test_a_notifier_in_an_event_loop(served: str, kind: str) -> None:
    url = served if kind == "hub" else "inproc:python-can-notifier"

    async def run() -> list[Frame]:
        reader = can.AsyncBufferedReader()
        with HilBus(url) as bus, open_link(url) as link:
            notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())
            link.send(frames(20))
            seen = [from_message(await asyncio.wait_for(reader.get_message(), LIMIT)) for _ in range(20)]
            notifier.stop(0.1)
            return seen

    assert asyncio.run(run()) == frames(20)


def test_periodic_messages_and_iteration(served: str) -> None:
    with HilBus(served) as bus, HilBus(served) as other:
        task = bus.send_periodic(can.Message(arbitration_id=0x5, is_extended_id=False), period=0.002)
        for count, message in enumerate(other):
            assert message.arbitration_id == 0x5
            if count == 4:
                break
        task.stop()


def test_shutting_down_twice_is_fine(served: str) -> None:
    bus = HilBus(served)
    bus.shutdown()
    bus.shutdown()
    with pytest.raises(can.CanOperationError):
        bus.recv(0.1)
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message())


def test_can_fd_is_refused_in_words(served: str) -> None:
    with pytest.raises(ValueError, match="classic CAN only"):
        HilBus(served, fd=True)
    with HilBus(served) as bus, pytest.raises(ValueError, match="CAN FD"):
        bus.send(can.Message(is_fd=True))


def test_a_dead_hub_is_an_error_for_python_can(hub: Hub) -> None:
    hub.start()
    with HilBus(hub.urls[0]) as bus:
        hub.close()
        with pytest.raises(can.CanOperationError, match="the hub was closed"):
            bus.recv(LIMIT)
        with pytest.raises(can.CanOperationError, match="the hub was closed"):
            bus.send(can.Message())


def test_sending_from_two_threads_never_mixes_records(hub: Hub) -> None:
    hub.start()
    with HubLink(hub.urls[0]) as shared, HubLink(hub.urls[0]) as other:
        threads = [
            threading.Thread(target=lambda i=i: [shared.send(frames(500, 0x100 + i)) for _ in range(20)])
            for i in range(3)
        ]
        for thread in threads:
            thread.start()
        seen = collect(other, 30_000)
        for thread in threads:
            thread.join()
    for i in range(3):
        assert [frame for frame in seen if frame.can_id == 0x100 + i] == frames(500, 0x100 + i) * 20


def test_sizes() -> None:
    assert hub_wire.HELLO.size == hub_wire.GOODBYE.size == RECORD_SIZE
    with contextlib.suppress(OSError):
        assert len(hub_wire.hello(0)) == RECORD_SIZE
