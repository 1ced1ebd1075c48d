"""The serial console: what it answers, that it never waits, and that it changes no frame."""

import random
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

from firmware_sim.__main__ import attend
from firmware_sim.console import LINE_MAX, LOG_LINES, Console
from firmware_sim.firmware import NVM_WORDS, Firmware
from firmware_sim.nvm import RamMemory, memory_size
from firmware_sim.serial_port import PortError, SerialPort


def say(console: Console, *lines: str) -> list[str]:
    """Lines typed without echo; the lines that come back."""
    console.feed(b"set echo=off\r")
    return console.feed("".join(f"{line}\r\n" for line in lines).encode("latin-1")).decode("ascii").splitlines()


@pytest.fixture
def bench() -> Bench:
    bench = Bench(mode=S2)
    bench.run(6)
    return bench


def test_status_tells_the_newest_step(bench: Bench) -> None:
    (line, ok) = say(Console(bench.firmware), "status")  # type: ignore[arg-type]
    values = dict(pair.split("=") for pair in line.split())
    assert ok == "OK"
    assert (values["step"], values["time"], values["state"], values["rate"]) == ("5", "1500", "auto", "285")


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
        ("set echo=maybe", ["ERR 2 usage: set echo=on|off"]),
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
    assert console.feed(b"version\n").startswith(b"version\r\nfirmware=0.2 protocol=1.1 dbc_crc=")
    assert console.feed(b"\r\n").endswith(b"> ")
    assert console.feed(b"helq\x7fp\r").count(b"\r\n") == 10


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
    firmware = Firmware(RamMemory(memory_size(NVM_WORDS)))
    assert say(Console(firmware), "reset") == ["OK"]
    assert firmware.reset_requested


# ---- ports


def test_a_pseudo_terminal_that_nobody_reads_never_blocks(tmp_path: Path) -> None:
    port = SerialPort(f"pty:{tmp_path / 'tty'}")
    for _ in range(20000):
        port.write(b"I (0) flood: nobody reads this line\r\n")
    port.close()
    assert not (tmp_path / "tty").exists()


@pytest.mark.parametrize("name", ["/dev/nothing-here", "socket://10.0.0.1:99", "nonsense://x"])
def test_a_port_that_cannot_be_had_is_named(name: str) -> None:
    with pytest.raises(PortError, match=name):
        SerialPort(name)


def test_a_link_that_exists_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("mine")
    with pytest.raises(PortError, match="does not exist yet"):
        SerialPort(f"pty:{tmp_path / 'tty'}")
    assert (tmp_path / "tty").read_text() == "mine"


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


class Answering:
    """A console behind a pseudo terminal, served by a thread."""

    def __init__(self, firmware: Firmware, link: Path) -> None:
        self.port = SerialPort(f"pty:{link}")
        self.over = threading.Event()
        self.thread = threading.Thread(target=attend, args=(self.port, Console(firmware), self.over), daemon=True)

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
