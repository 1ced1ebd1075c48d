"""The serial console: what it answers, that it never waits, and that it changes no frame."""

import itertools
import json
import os
import random
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import serial
from bench import S2, Bench
from hypothesis import given, settings
from hypothesis import strategies as st

from can_bus.codec import Transmitter
from can_bus.lockstep import Turn
from firmware_sim.__main__ import attend
from firmware_sim.alarms import Alarms, Code
from firmware_sim.console import LINE_MAX, LOG_LINES, Console, FirmwareView
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.nvm import RamMemory
from firmware_sim.serial_port import PENDING_MAX, PortError, SerialPort


def say(console: Console, *lines: str) -> list[str]:
    """Lines typed without echo; the lines that come back."""
    console.feed(b"set echo=off\r")
    return console.feed("".join(f"{line}\r\n" for line in lines).encode("latin-1")).decode("ascii").splitlines()


@pytest.fixture
def bench() -> Bench:
    bench = Bench(mode=S2)
    bench.run(9)  # by then nothing is told of the start any more
    return bench


def test_status_tells_the_newest_step(bench: Bench) -> None:
    (line, ok) = say(Console(bench.firmware), "status")  # type: ignore[arg-type]
    values = dict(pair.split("=") for pair in line.split())
    assert ok == "OK"
    assert (values["step"], values["time"], values["state"], values["rate"]) == ("8", "2400", "auto", "285")


def test_parameters_can_be_read_and_not_written(bench: Bench) -> None:
    console = Console(bench.firmware)  # type: ignore[arg-type]
    assert say(console, "get CfgBasal") == ["CfgBasal=1425", "OK"]
    before = dict(bench.firmware.parameters())  # type: ignore[attr-defined]
    for name in (*before, "rate", "iob", "bolus", "mode", "test"):
        assert say(console, f"set {name}=1")[0].startswith("ERR 3")
    assert bench.firmware.parameters() == before  # type: ignore[attr-defined]
    assert len(say(console, "get")) == len(before) + 1


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        ("", []),
        ("bolus 10", ["ERR 1 no such command, see help"]),
        ("get Nothing", ["ERR 2 no such parameter is stored, get lists them"]),
        ("set echo", ["ERR 2 usage: set NAME=VALUE"]),
        ("set echo=maybe", ["ERR 2 usage: echo on|off"]),
        ("log loud", ["ERR 2 usage: log off|error|warn|info|debug"]),
        ("status now", ["ERR 2 usage: status"]),
        ("reset", ["ERR 5 there is no non-volatile memory to restart from"]),
        ("x" * (LINE_MAX + 1), [f"ERR 4 a line has at most {LINE_MAX} characters"]),
        ("stätus", ["ERR 4 a line is plain ASCII text"]),
        ("faults", ["OK"]),
    ],
)
def test_replies(bench: Bench, line: str, reply: list[str]) -> None:
    assert say(Console(bench.firmware), line) == reply  # type: ignore[arg-type]


def test_version_and_help_and_prompt(bench: Bench) -> None:
    console = Console(bench.firmware)  # type: ignore[arg-type]
    assert console.feed(b"version\n").startswith(b"version\r\nfirmware=0.2 protocol=1.3 dbc_crc=")
    assert console.feed(b"\r\n").endswith(b"> ")
    assert console.feed(b"helq\x7fp\r").count(b"\r\n") == 12


def test_log_lines_have_simulated_time_and_the_oldest_are_dropped(bench: Bench) -> None:
    console = Console(bench.firmware)  # type: ignore[arg-type]
    console.log("info", 0, "ladder", "not asked for")
    assert say(console, "log info") == ["OK"]
    for k in range(LOG_LINES + 7):
        console.log("info", 300 * k, "ladder", f"line {k}")
        console.log("debug", 300 * k, "ladder", "too much")
    lines = console.feed(b"").decode().splitlines()
    assert lines[0] == "I (2100) ladder: line 7"
    assert len(lines) == LOG_LINES
    assert "dropped=7" in say(console, "status")[0]


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.binary(max_size=600))
def test_any_bytes_are_answered_and_never_more_than_a_line_is_kept(data: bytes) -> None:
    console = Console(Firmware())
    for k in range(0, len(data), 7):
        console.feed(data[k : k + 7])
        assert len(console._line) <= LINE_MAX
    assert console.feed(b"\r\nset echo=off\r").endswith(b"OK\r\n")
    assert console.feed(b"status\r").startswith(b"step=-1 ")


def test_a_flood_on_the_console_changes_no_frame() -> None:
    quiet, noisy = Bench(mode=S2), Bench(mode=S2)
    console = Console(noisy.firmware)  # type: ignore[arg-type]
    noisy.firmware.log = console.log  # type: ignore[attr-defined]
    draw = random.Random(4)
    for k in range(60):
        console.feed(draw.randbytes(200))
        console.feed(b"\rlog debug\rstatus\rfaults\rget\rset CfgMaxBasal=60000\rreset\r")
        glucose = 1200 + 13 * k
        assert noisy.step(glucose, drop=k % 9 == 4).frames == quiet.step(glucose, drop=k % 9 == 4).frames


def test_a_reset_is_asked_for_where_there_is_a_memory() -> None:
    firmware = Firmware(RamMemory(NVM_BYTES))
    assert say(Console(firmware), "reset") == ["OK"]
    assert firmware.reset_requested


def test_a_log_line_takes_the_place_of_the_prompt_and_of_what_is_being_typed(bench: Bench) -> None:
    console = Console(bench.firmware)  # type: ignore[arg-type]
    assert console.feed(b"log info\rsta").endswith(b"OK\r\n> sta")
    console.log("info", 300, "ladder", "AUTO -> DEGRADED")
    assert console.feed(b"") == b"\r\x1b[KI (300) ladder: AUTO -> DEGRADED\r\n> sta"
    assert console.feed(b"tus\r").startswith(b"tus\r\nstep=")
    assert console.feed(b"echo off\r").endswith(b"OK\r\n")
    console.log("info", 600, "ladder", "DEGRADED -> AUTO")
    assert console.feed(b"") == b"I (600) ladder: DEGRADED -> AUTO\r\n"


def test_the_view_shows_whole_steps_and_logs_what_becomes_of_an_alarm(bench: Bench) -> None:
    firmware = bench.firmware
    assert isinstance(firmware, Firmware)
    view = FirmwareView(firmware)
    lines: list[tuple[str, int, str, str]] = []
    view.log = lambda *line: lines.append(line)
    held = (view.status(), view.parameters(), view.faults())
    kept = [dict(held[0]), dict(held[1]), list(held[2])]
    for _ in range(4):
        before = view.status()
        bench.step(1200, drop=True)
        assert view.status() is before
        view.publish()
    assert [dict(held[0]), dict(held[1]), list(held[2])] == kept
    assert view.status()["step"] == 12
    assert ("warn", 3600, "alarm", "cgm_lost pending") in lines
    for _ in range(12):
        bench.step(1200)
        view.publish()
    assert [line[3] for line in lines if line[2] == "alarm" and line[3].startswith("cgm_lost")][-1] == "cgm_lost over"


def test_alarms_that_change_in_another_thread_can_be_listed() -> None:
    """The device's own listing cannot: it fails when an alarm ends half-way."""
    alarms = Alarms()
    turn = Turn(Transmitter())
    device = Firmware()
    device._alarms = alarms
    view = FirmwareView(device)
    console = Console(view)
    console.feed(b"echo off\r")
    over = threading.Event()
    replies: set[bytes] = set()

    def look() -> None:
        while not over.is_set():
            replies.add(console.feed(b"faults\r")[-4:])

    reader = threading.Thread(target=look)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        reader.start()
        end = time.monotonic() + 1
        for k in itertools.count():
            for code in Code:
                alarms.hold(code, k // 8 % 2 == 0, k)
            alarms.report(turn)
            turn.take()
            view.publish()
            if time.monotonic() > end:
                break
        assert reader.is_alive()
    finally:
        over.set()
        reader.join()
        sys.setswitchinterval(interval)
    assert replies == {b"OK\r\n"}


# ---- ports


def test_a_pseudo_terminal_that_nobody_reads_never_blocks(tmp_path: Path) -> None:
    port = SerialPort(f"pty:{tmp_path / 'tty'}")
    line = b"I (0) flood: nobody reads this line\r\n"
    for _ in range(20000):
        port.write(line)
    assert 0 < 20000 * len(line) - port.dropped <= PENDING_MAX + 65536
    with serial.serial_for_url(port.name, timeout=0.1) as tty:  # what is read later is whole lines
        got = b""
        for _ in range(20):
            port.write(b"")
            got += tty.read(4096)
    assert len(got) > PENDING_MAX - 4096 - len(line)
    assert set(got.split(b"\r\n")[1:-1]) == {line.strip()} and got.endswith(line)
    port.close()
    assert not (tmp_path / "tty").is_symlink()


@pytest.mark.parametrize(
    "name",
    [
        "/dev/nothing-here",
        "socket://10.0.0.1:99",
        "SOCKET://10.0.0.1:99",
        "socket://127.0.0.1:80@10.0.0.1:99",
        "socket://localhost.example:99",
        "rfc2217://10.0.0.1:99",
        "nonsense://x",
    ],
)
def test_a_port_that_cannot_be_had_is_named(name: str) -> None:
    with pytest.raises(PortError, match=re.escape(name)) as caught:
        SerialPort(name)
    assert ("on the loopback" in str(caught.value)) == ("socket" in name.lower() or "rfc2217" in name)


def test_a_link_that_exists_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("mine")
    with pytest.raises(PortError, match="does not exist yet"):
        SerialPort(f"pty:{tmp_path / 'tty'}")
    assert (tmp_path / "tty").read_text() == "mine"


def test_the_link_of_a_firmware_that_was_killed_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "tty"
    link.symlink_to("/dev/pts/987654")
    port = SerialPort(f"pty:{link}")
    assert str(link.readlink()) == port.name
    with pytest.raises(PortError, match="does not exist yet"):  # but not that of one that lives
        SerialPort(f"pty:{link}")
    assert str(link.readlink()) == port.name
    port.close()


# pyserial forgets to close a socket whose other end is gone
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_socket_that_nobody_reads_does_not_block_and_its_end_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = SerialPort(f"socket://127.0.0.1:{server.getsockname()[1]}")
        there, _ = server.accept()
        begin = time.process_time()
        for _ in range(20000):
            port.write(b"x" * 1022 + b"\r\n")
        assert port.dropped > 1000000
        assert time.process_time() - begin < 5
        there.close()
        attend(port, Console(Firmware()), threading.Event())
    port.close()
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("firmware_sim: the console is gone: socket://127.0.0.1:")


def run_folder_sha256(out: Path, *options: str) -> str:
    base = ["--strategy", "s3", "--days", "2", "--seed", "5", "--out", str(out)]
    done = subprocess.run([sys.executable, "-m", "pumpbench", "run", *base, *options], check=False, timeout=200)
    assert done.returncode == 0
    return str(json.loads((out / "run.json").read_text(encoding="utf-8"))["trace_sha256"])


@pytest.mark.nightly
def test_a_flooded_console_changes_no_frame_of_a_run_between_processes(tmp_path: Path) -> None:
    quiet = run_folder_sha256(tmp_path / "quiet")
    link = tmp_path / "tty"
    over = threading.Event()
    typed = 0

    def flood() -> None:
        nonlocal typed
        draw = random.Random(7)
        tty = None
        while not over.is_set():
            try:
                if tty is None:
                    tty = os.open(link, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
                typed += os.write(tty, draw.randbytes(100) + b"\rlog debug\rget\rset CfgMaxBasal=60000\rreset\r")
            except OSError:  # not there yet, full, or gone
                time.sleep(0.01)
        if tty is not None:
            os.close(tty)

    flooder = threading.Thread(target=flood)
    flooder.start()
    try:
        command = f"{sys.executable} -m firmware_sim --bus {{bus}} --console pty:{link}"
        noisy = run_folder_sha256(tmp_path / "noisy", "--firmware", command)
    finally:
        over.set()
        flooder.join()
    assert typed > 1000
    assert noisy == quiet


def test_the_console_of_a_running_firmware(tmp_path: Path) -> None:
    """Processes: status while it runs, a reset in the middle of the run, and the plant comes to its end."""
    bus, link, nvm = tmp_path / "bus", tmp_path / "tty", tmp_path / "nvm"
    options = ["--bus", f"unix:{bus}", "--host", "--strategy", "s3", "--days", "14"]
    plant = subprocess.Popen([sys.executable, "-m", "pumpbench", "plant", *options], stdout=subprocess.DEVNULL)
    firmware = None
    try:
        end = time.monotonic() + 60
        while not bus.exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        command = [sys.executable, "-m", "firmware_sim", "--bus", f"unix:{bus}", "--nvm", str(nvm)]
        firmware = subprocess.Popen([*command, "--console", f"pty:{link}"], stderr=subprocess.DEVNULL)
        while not link.exists():
            assert time.monotonic() < end
            time.sleep(0.02)
        with serial.serial_for_url(str(link), timeout=5) as tty:
            tty.write(b"\rset echo=off\r")
            tty.read_until(b"OK\r\n")
            step = -1
            while step < 100:
                tty.write(b"status\r")
                reply = tty.read_until(b"OK\r\n").decode()
                step = int(reply.partition("step=")[2].split()[0])
                assert time.monotonic() < end
            tty.write(b"reset\r")
            assert tty.read_until(b"\r\n") == b"OK\r\n"
            boots = 0
            while boots == 0:
                tty.write(b"status\r")
                reply = tty.read_until(b"OK\r\n").decode()
                boots = int(reply.partition("boots=")[2].split()[0])
                assert time.monotonic() < end
        assert firmware.wait(60) == 0
        assert plant.wait(60) == 0
        assert not link.exists()
    finally:
        plant.kill()
        plant.wait()
        if firmware is not None:
            firmware.kill()
            firmware.wait()


# ---- pumpbench console


def test_a_reply_behind_a_full_backlog_of_log_lines_comes_whole(bench: Bench) -> None:
    """More than a terminal's buffer takes at once."""
    console, port = Console(bench.firmware), SerialPort("pty")  # type: ignore[arg-type]
    with serial.serial_for_url(port.name, timeout=0.1) as tty:
        console.feed(b"echo off\rlog info\r")
        for k in range(LOG_LINES):
            console.log("info", 300 * k, "ladder", "a line as long as those of a busy device are")
        port.write(console.feed(b"status\r"))
        got = b""
        for _ in range(8):
            got += tty.read(4096)
            port.write(b"")
    port.close()
    assert got.count(b"ladder") == LOG_LINES and got.endswith(b"OK\r\n")
    assert port.dropped == 0


def test_what_an_earlier_session_left_unread_is_no_reply(bench: Bench, tmp_path: Path) -> None:
    link = tmp_path / "tty"
    with Answering(bench.firmware, link):  # type: ignore[arg-type]
        with serial.serial_for_url(str(link)) as tty:
            tty.write(b"set echo=off\r" + b"get\r" * 20)  # more than the terminal's own buffer, which opening empties
            time.sleep(0.3)
        status, out, _ = run_console(str(link), "--command", "get CfgBasal\nversion")
    assert status == 0
    assert out.startswith("CfgBasal=1425\nOK\nfirmware=0.2 ") and out.count("OK\n") == 2


def test_by_hand_at_a_terminal(bench: Bench, tmp_path: Path) -> None:
    master, slave = os.openpty()
    with Answering(bench.firmware, tmp_path / "tty"):  # type: ignore[arg-type]
        command = [sys.executable, "-m", "pumpbench", "console", str(tmp_path / "tty")]
        with subprocess.Popen(command, stdin=slave, stdout=subprocess.PIPE) as process:
            os.write(master, b"get CfgBasal\n\x04")
            out, _ = process.communicate(timeout=60)
    os.close(master)
    os.close(slave)
    assert process.returncode == 0
    assert out.replace(b"\r", b"") == b"CfgBasal=1425\nOK\n"


def test_a_device_that_goes_away_ends_the_session(bench: Bench, tmp_path: Path) -> None:
    master, slave = os.openpty()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = f"socket://127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "pumpbench", "console", port]
        with subprocess.Popen(command, stdin=slave, stderr=subprocess.PIPE, text=True) as process:
            server.accept()[0].close()
            _, err = process.communicate(timeout=60)
    os.close(master)
    os.close(slave)
    assert process.returncode == 3
    assert err.startswith("pumpbench: socket://") and err.count("\n") == 1


class Answering:
    """A console behind a pseudo terminal, served by a thread."""

    def __init__(self, firmware: Firmware, link: Path) -> None:
        self.port = SerialPort(f"pty:{link}")
        self.over = threading.Event()
        self.console = Console(firmware)
        self.thread = threading.Thread(target=attend, args=(self.port, self.console, self.over), daemon=True)

    def __enter__(self) -> "Answering":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.thread.join()
        self.port.close()


def run_console(*arguments: str, stdin: str = "") -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "pumpbench", "console", *arguments],
        check=False,
        input=stdin,
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.returncode, done.stdout, done.stderr


def test_commands_of_a_script(bench: Bench, tmp_path: Path) -> None:
    link = tmp_path / "tty"
    with Answering(bench.firmware, link):  # type: ignore[arg-type]
        status, out, _ = run_console(str(link), "--command", "get CfgBasal", "--command", "faults")
        assert (status, out) == (0, "CfgBasal=1425\nOK\nOK\n")
        status, out, _ = run_console(str(link), "--command", "set rate=5", "--command", "get CfgBasal")
        assert status == 1
        assert out.splitlines() == [
            "ERR 3 only echo and log can be set here, nothing that doses",
            "CfgBasal=1425",
            "OK",
        ]


def test_commands_from_a_pipe(bench: Bench, tmp_path: Path) -> None:
    with Answering(bench.firmware, tmp_path / "tty"):  # type: ignore[arg-type]
        status, out, _ = run_console(str(tmp_path / "tty"), stdin="version\n\nstatus\n")
    assert status == 0
    assert out.count("OK") == 2


def test_no_port_and_no_answer_are_one_line_each(tmp_path: Path) -> None:
    status, _, err = run_console(str(tmp_path / "nothing"), "--command", "status")
    assert status == 2 and "nothing" in err and err.count("\n") == 1
    port = SerialPort("pty")
    status, _, err = run_console(port.name, "--command", "status", "--timeout", "0.2")
    port.close()
    assert (status, err) == (3, "pumpbench: nobody answers on this port within 0.2 s\n")


def test_an_alarm_that_goes_on_is_not_logged_again(bench: Bench) -> None:
    view = FirmwareView(bench.firmware)  # type: ignore[arg-type]
    logged: list[str] = []
    view.log = lambda _level, _seconds, _module, text: logged.append(text)
    alarms = bench.firmware._alarms  # type: ignore[attr-defined]
    alarms.hold(Code.CGM_LOST, True, 7)
    view.publish()
    alarms.hold(Code.E2E_FAULT, True, 0)
    view.publish()
    assert [text.split()[0] for text in logged] == ["cgm_lost", "e2e_fault"]


def test_the_view_answers_for_the_device(bench: Bench) -> None:
    console = Console(FirmwareView(bench.firmware))  # type: ignore[arg-type]
    assert say(console, "get CfgBasal") == ["CfgBasal=1425", "OK"]
    assert say(console, "version")[0].startswith("firmware=")
    assert say(console, "set log=debug") == ["OK"]
    assert say(console, "set log=loud")[0].startswith("ERR")


class Remote:
    """A port of pyserial without a descriptor, as rfc2217:// is one."""

    def __init__(self, *_arguments: object, **_options: object) -> None:
        self.sent = b""
        self.full = self.gone = False

    def read(self, _size: int) -> bytes:
        if self.gone:
            raise serial.SerialException("connection failed")
        return b"status"

    def write(self, data: bytes) -> None:
        if self.full:
            raise serial.SerialTimeoutException("Write timeout")
        if self.gone:
            raise serial.SerialException("connection failed")
        self.sent += data

    def close(self) -> None:
        self.gone = True


def test_a_port_without_a_descriptor(monkeypatch: pytest.MonkeyPatch) -> None:
    remote = Remote()
    monkeypatch.setattr(serial, "serial_for_url", lambda *_arguments, **_options: remote)
    port = SerialPort("rfc2217://127.0.0.1:4000")
    assert port.fileno() == -1
    port.wait(0.0)
    assert port.read() == b"status"
    remote.full = True
    port.write(b"one")
    remote.full = False
    port.write(b" two")
    assert remote.sent == b"one two"
    port.close()
    with pytest.raises(PortError, match=r"rfc2217.*connection failed"):
        port.read()
    with pytest.raises(PortError, match=r"rfc2217.*connection failed"):
        port.write(b"x")


def test_a_url_that_is_none_is_named() -> None:
    with pytest.raises(PortError, match=r"socket://\["):
        SerialPort("socket://[")
    with pytest.raises(PortError, match=r"loop://.*another side"):
        SerialPort("loop://")


def test_a_pty_that_is_full_keeps_what_it_could_not_send(tmp_path: Path) -> None:
    port = SerialPort("pty")
    sent = b"".join(b"%06d\n" % number for number in range(3000))  # more than a terminal holds
    port.write(sent)
    port.write(b"")
    reader = os.open(port.name, os.O_RDONLY | os.O_NONBLOCK)
    received = b""
    while len(received) < len(sent):
        received += os.read(reader, 4096)
        port.write(b"")
    os.close(reader)
    port.close()
    assert received == sent
    assert port.dropped == 0
