"""The doctor: every way a device is usually wrong is named, and by its own check; it never hangs and leaves nothing."""

import contextlib
import itertools
import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import psutil
import pytest
from conftest import ROOT, Pumpbench
from pumpbench.doctor import examine as doctor
from pumpbench.doctor import wiring
from pumpbench.doctor.checkup import Mark, Request
from serial_cable import cable
from test_rig_failures import leftovers

import dbc
from can_bus import codec
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, Frame
from can_bus.inproc import inproc_hub
from can_bus.link import BusLost
from can_bus.lockstep import Done, Phase
from can_bus.slcan import SlcanLink
from can_bus.url import BusUrlError, open_link
from firmware_sim.firmware import Firmware

Twist = Callable[[Frame, list[Frame]], Sequence[Frame] | None]
"""What a device makes of its answer to a frame; None: it restarts."""

NUMBERS = itertools.count()
STEPS = 5


def name(frame: Frame) -> str:
    message = codec.messages_by_id().get(frame.can_id)
    return "" if message is None else message.name


def changed(frame: Frame, **values: int) -> Frame:
    """The same frame with other values, its CHECKSUM right again."""
    message = codec.messages_by_id()[frame.can_id]
    word = message.pack(message.unpack(frame.data) | values)
    return Frame(frame.can_id, codec.protect(message, word, frame.data[1] & 0xF))


def made(name: str, **values: int) -> Frame:
    return codec.Transmitter().frame(name, **values)


def token(frame: Frame) -> tuple[int, int] | None:
    """Phase and step of a token."""
    values = codec.message("SYNC_Step").unpack(frame.data) if name(frame) == "SYNC_Step" else None
    return values and (values["SyncPhase"], values["StepIndex"])


def each(message: str, change: Callable[[Frame], Frame | None]) -> Twist:
    """Do something to every frame of a message; None loses it."""

    def twist(_heard: Frame, answer: list[Frame]) -> list[Frame]:
        changed = [change(frame) if name(frame) == message else frame for frame in answer]
        return [frame for frame in changed if frame is not None]

    return twist


class Device:
    """The reference firmware in a thread on a bus of this process, with something wrong about it."""

    def __init__(self, url: str, twist: Twist) -> None:
        self._link = open_link(url)
        self._twist = twist
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        firmware = Firmware()
        with contextlib.suppress(BusLost):
            while not self._stop.is_set():
                for frame in self._link.recv(0.02):
                    said = self._twist(frame, list(firmware.receive(frame)))
                    if said is None:
                        firmware = Firmware()
                        said = firmware.start()
                    if said:
                        self._link.send(said)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._link.close()


@contextlib.contextmanager
def on_a_bus(*twists: Twist) -> Iterator[str]:
    """The URL of a bus with a device for every twist."""
    url = f"inproc:doctor-{os.getpid()}-{next(NUMBERS)}"
    with contextlib.ExitStack() as stack:
        for twist in twists:
            stack.callback(Device(url, twist).close)
        yield url


def examine(*twists: Twist, timeout: float = 5.0) -> doctor.Report:
    with on_a_bus(*twists) as url:
        return doctor.examine(Request(url, steps=STEPS, timeout=timeout))


def honest(_heard: Frame, answer: list[Frame]) -> list[Frame]:
    return answer


# ---- what is usually wrong


def swapped(_heard: Frame, answer: list[Frame]) -> list[Frame]:
    """SYNC_Done ahead of the command."""
    return sorted(answer, key=lambda frame: name(frame) == "PUMP_BasalCmd")


def echoing(heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [heard, *answer]


def as_the_pump(heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [made("HB_PUMP", NmtPump=5), *answer] if token(heard) else answer


def with_a_stranger(heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [Frame(0x6AB, b"\1"), *answer] if token(heard) == (Phase.STEP, 2) else answer


def with_an_error(heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [Frame(CAN_ERR_FLAG | 0x20, bytes(8)), *answer] if token(heard) == (Phase.STEP, 2) else answer


def step_behind(frame: Frame) -> Frame:
    """Every step but the first is called by the number of the one before it."""
    step = codec.message("SYNC_Done").unpack(frame.data)["DoneStepIndex"]
    running = codec.message("SYNC_Done").unpack(frame.data)["ExecTime"] != 65535
    return changed(frame, DoneStepIndex=step - 1) if running and step else frame


def another_call(frame: Frame) -> Frame:
    return changed(frame, DoneStepIndex=999)


def bad_crc(frame: Frame) -> Frame:
    return Frame(frame.can_id, bytes([frame.data[0] ^ 0x5A]) + frame.data[1:])


def frozen(frame: Frame) -> Frame:
    """COUNTER stays 0, and CHECKSUM fits."""
    word = int.from_bytes(bytes([0, frame.data[1] & 0xF0, *frame.data[2:]]), "little")
    return Frame(frame.can_id, codec.protect(codec.messages_by_id()[frame.can_id], word, 0))


def silent_from(phase: Phase, step: int) -> Twist:
    def twist(heard: Frame, answer: list[Frame]) -> list[Frame]:
        return [] if token(heard) == (phase, step) else answer

    return twist


def rebooting() -> Twist:
    """Once, when step 3 comes."""
    tokens: list[tuple[int, int]] = []

    def twist(heard: Frame, answer: list[Frame]) -> list[Frame] | None:
        tokens.extend([turn] if (turn := token(heard)) else [])
        return None if tokens.count((Phase.STEP, 3)) == 1 and tokens[-1] == (Phase.STEP, 3) else answer

    return twist


def without_diagnostics(_heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [frame for frame in answer if name(frame) != "UDS_Response"]


def other_dbc(frame: Frame) -> Frame:
    return Frame(frame.can_id, frame.data[:4] + bytes.fromhex("01020304"))


def twice(_heard: Frame, answer: list[Frame]) -> list[Frame]:
    return [*answer, answer[-1]] if answer and name(answer[-1]) == "SYNC_Done" else answer


MAJOR, MINOR = dbc.protocol_version()

WRONG: dict[str, tuple[Sequence[Twist], dict[str, str]]] = {
    "two devices": ((honest, honest), {"alone": "two devices are on this bus"}),
    "SYNC_Done twice": ((twice,), {"alone": "a second SYNC_Done came for the same token"}),
    "echo": ((echoing,), {"ids": r"the bench's own frames come back: CFG_Param \(\d+\)"}),
    "as the pump": ((as_the_pump,), {"ids": r"somebody else sends frames of the bench: HB_PUMP \(\d+\)"}),
    "stranger": ((with_a_stranger,), {"ids": r"0x6AB \(1\)"}),
    "error frame": ((with_an_error,), {"wire": "1 error frames"}),
    "another step": (
        (each("SYNC_Done", step_behind),),
        {"steps": "step 1 was answered with DoneStepIndex 0; 1 of 5 were right"},
    ),
    "another call": ((each("SYNC_Done", another_call),), {"roll call": r"call \d+ was answered with.* 999"}),
    "SYNC_Done first": ((swapped,), {
        "order": r"sent behind SYNC_Done: .*PUMP_BasalCmd \(5\)", "TxCount": "wrong in 5 of 7 turns, first:",
    }),
    "SYNC_Done before the status": (
        (lambda heard, answer: sorted(answer, key=lambda frame: name(frame) == "CTRL_Status"),),
        {"order": r"CTRL_Status \(1\)", "mode": "no CTRL_Status came", "TxCount": "wrong in"},
    ),
    "wrong CRC": (
        (each("PUMP_BasalCmd", bad_crc),),
        {"CHECKSUM": r"PUMP_BasalCmd: \[.*\] has CHECKSUM ..?, ought to be .. \(COUNTER 0, data id ..\)"},
    ),
    "no SYNC_Done can be read": (
        (each("SYNC_Done", bad_crc),),
        {"CHECKSUM": "SYNC_Done", "roll call": "its SYNC_Done cannot be read"},
    ),
    "frozen counter": ((each("CTRL_Status", frozen),), {"COUNTER": "CTRL_Status: 0 behind 0, ought to be 1"}),
    "too short": ((each("CTRL_Diag", lambda frame: Frame(frame.can_id, frame.data[:7])),), {
        "form": "CTRL_Diag: a data frame of 7 bytes, ought to be a data frame of 8 with an 11-bit id",
    }),
    "29 bits": ((each("CTRL_Diag", lambda frame: Frame(frame.can_id | CAN_EFF_FLAG, frame.data)),), {
        "form": "CTRL_Diag: a 29-bit frame of 8 bytes",
    }),
    "TxCount": ((each("SYNC_Done", lambda frame: changed(frame, TxCount=1)),), {
        "TxCount": r"wrong in 6 of 7 turns, first: 1 for \d+ frames",
    }),
    "another echo": ((each("CFG_ParamEcho", lambda frame: changed(frame, EchoRaw=7)),), {
        "calibration": "CTRL did not accept CfgBasal .* echoed 7",
    }),
    "no echo": ((each("CFG_ParamEcho", lambda frame: None),), {"calibration": "no echo", "TxCount": "1 turns"}),
    "another mode": ((each("CTRL_Status", lambda frame: changed(frame, CtrlMode=6)),), {
        "mode": "did not take up mode InsulinNMA: it reports PramS2_RatioNMA",
    }),
    "restarts": ((rebooting(),), {"steps": "HB_CTRL said BootUp 1 times in 5 steps"}),
    "a fault": ((each("SYNC_Done", lambda frame: changed(frame, DoneStatus=Done.FAULT) if frame.data[1] & 0xF > 2 else
                      frame),), {"steps": "DoneStatus Fault in 4 turns"}),
    "no CTRL_Info": ((each("CTRL_Info", lambda frame: None),), {"version": "does not say which protocol"}),
    "says neither": (
        (lambda _heard, answer: [frame for frame in answer if name(frame) not in ("CTRL_Info", "HB_CTRL")],),
        {"version": "does not say", "node": "neither HB_CTRL nor CTRL_Info", "TxCount": "."},
    ),
    "another major version": (
        (each("CTRL_Info", lambda frame: changed(frame, CtrlProtocolMajor=MAJOR + 1)),),
        {"version": rf"built for protocol {MAJOR + 1}\.{MINOR}, this bench speaks {MAJOR}\.{MINOR}: rebuild"},
    ),
    "another minor version": (
        (each("CTRL_Info", lambda frame: changed(frame, CtrlProtocolMinor=MINOR + 1)),),
        {"version": rf"built for protocol {MAJOR}\.{MINOR + 1}.*this bench does not know what was added"},
    ),
    "another DBC": ((each("UDS_Response", other_dbc),), {"DBC": f"CRC-32 01020304, the bench's {dbc.crc32():08x}"}),
}  # fmt: skip

MILD = {"stranger", "a fault", "no CTRL_Info", "another minor version", "another DBC"}
"""Those that a device may run with: a warning."""


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_named_by_its_own_check(case: str) -> None:
    twists, expected = WRONG[case]
    report = examine(*twists, timeout=1.0)
    found = {
        check.name: f"{check.found} -> {check.advice}" for check in report.checks if check.mark in ("FAIL", "warn")
    }
    assert found.keys() == expected.keys(), found
    for check, pattern in expected.items():
        assert re.search(pattern, found[check]), found[check]
    assert bool(report.failed) == (case not in MILD)
    assert not report.bus_failed
    assert all(check.advice for check in report.failed)


def test_a_device_without_fault_passes() -> None:
    report = examine(honest)
    assert {check.name: check.mark for check in report.checks} == dict.fromkeys(
        ("bus", "wire", "frames", "node", "ids", "alone", "form", "CHECKSUM", "roll call", "version", "DBC",
         "calibration", "mode", "steps", "order", "TxCount", "COUNTER", "latency"), Mark.PASSED,
    )  # fmt: skip
    assert len(report.latencies) == STEPS
    assert not report.failed


@pytest.mark.parametrize(
    ("phase", "step", "what"),
    [
        (Phase.CONFIG, 0, {"calibration": r"SYNC_Step\(Config\) was not answered with SYNC_Done within 1 s"}),
        (Phase.STEP, 3, {"steps": "step 3 was not answered with SYNC_Done within 1 s"}),
        (Phase.END, STEPS, {"steps": r"SYNC_Step\(End\) was not answered"}),
    ],
)
def test_silence_ends_the_check_and_is_placed(phase: Phase, step: int, what: dict[str, str]) -> None:
    report = examine(silent_from(phase, step), timeout=1.0)
    found = {check.name: check.found for check in report.failed}
    assert found.keys() == what.keys()
    for check, pattern in what.items():
        assert re.match(pattern, found[check]), found[check]


def test_nobody_there() -> None:
    report = examine(timeout=0.3)
    assert [check.name for check in report.failed] == ["frames"]
    assert "nothing arrived within 0.3 s" in report.failed[0].found


def test_somebody_who_is_no_device() -> None:
    report = examine(lambda heard, _answer: [Frame(0x123, b"")] if token(heard) else [], timeout=0.3)
    assert [check.name for check in report.failed] == ["node"]
    assert re.match(r"no frame of CTRL came, but 0x123 \(\d+\)", report.failed[0].found)


def test_a_device_that_talks_on_and_on_does_not_hold_it_up() -> None:
    report = examine(lambda _heard, _answer: [made("CTRL_Diag")] * 5, timeout=0.5)
    assert [check.name for check in report.failed] == ["roll call"]


def test_a_device_slower_than_the_roll_is_called_passes() -> None:
    def slow(heard: Frame, answer: list[Frame]) -> list[Frame]:
        time.sleep(0.15 if token(heard) and token(heard)[0] == Phase.INIT else 0)
        return answer

    report = examine(slow)
    assert not report.failed, report.failed


def test_a_bus_that_goes_away_in_the_middle() -> None:
    def cut(heard: Frame, answer: list[Frame]) -> list[Frame]:
        if token(heard) != (Phase.STEP, 2):
            return answer
        inproc_hub(url.removeprefix("inproc:")).close()
        return []

    with on_a_bus(cut) as url:
        report = doctor.examine(Request(url, steps=STEPS))
    assert report.bus_failed
    assert "the bus was closed" in report.failed[0].found
    found = {check.name: check.found for check in report.checks}
    assert found["steps"] == "step 2 was not answered with SYNC_Done any more"


# ---- the bus itself


def test_a_hub_that_nobody_serves(tmp_path: Path) -> None:
    report = doctor.examine(Request(f"unix:{tmp_path}/bus"))
    assert report.bus_failed
    (check,) = report.checks
    assert "no hub is serving there" in check.found
    assert "--host" in check.advice


def test_what_no_bus_is_called() -> None:
    with pytest.raises(BusUrlError, match="wifi"):
        doctor.examine(Request("wifi"))


def test_an_interface_that_is_down(monkeypatch: pytest.MonkeyPatch) -> None:
    assert wiring.obstacle("socketcan:lo") is None
    monkeypatch.setattr(wiring.fcntl, "ioctl", lambda *_: bytes(32))
    obstacle = wiring.obstacle("socketcan:lo")
    assert obstacle is not None
    assert obstacle[0] == "the interface lo is down"
    assert "ip link set lo up" in obstacle[1]
    assert wiring.obstacle("socketcan:none") is None  # opening it says so


def test_a_serial_port_that_is_not_there_or_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyACM0"
    obstacle = wiring.obstacle(f"slcan:{port}@500000")
    assert obstacle is not None and obstacle[0] == f"there is no {port}"
    port.touch()
    assert wiring.obstacle(f"slcan:{port}@500000") is None
    monkeypatch.setattr(wiring.os, "access", lambda *_: False)
    obstacle = wiring.obstacle(f"slcan:{port}@500000")
    assert obstacle is not None and "usermod -aG" in obstacle[1]
    assert wiring.obstacle("slcan:socket://127.0.0.1:1@500000") is None


class Adapter:
    """An slcan adapter on a pty with nobody behind it: refuses what it is to send, and tells its status."""

    def __init__(self, status: bytes) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.url = f"slcan:{os.ttyname(self._slave)}@500000"
        self._status = status
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        rest = b""
        while True:
            *lines, rest = (rest + os.read(self._master, 4096)).split(b"\r")
            for line in lines:
                if line == b"end":
                    return
                os.write(self._master, {b"t": b"\a", b"F": self._status}.get(line[:1], b"\r"))

    def close(self) -> None:
        os.write(self._slave, b"end\r")
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)


def test_an_adapter_with_another_bit_rate_than_the_device() -> None:
    adapter = Adapter(b"FA4\r")
    try:
        report = doctor.examine(Request(adapter.url, timeout=0.3))
    finally:
        adapter.close()
    found = {check.name: check for check in report.failed}
    assert found.keys() == {"wire", "frames"}
    assert "the adapter reports error warning, error passive, bus error" in found["wire"].found
    assert re.search(r"the adapter refused \d+ commands", found["wire"].found)
    assert "its bit rate the adapter's (500000)" in found["frames"].advice


def test_an_adapter_is_asked_for_its_status() -> None:
    adapter = Adapter(b"F02\r")
    try:
        with open_link(adapter.url) as link:
            assert isinstance(link, SlcanLink)
            assert link.status is None
            link.ask_status()
            while link.status is None:
                link.recv(0.1)
            assert link.status == 2
    finally:
        adapter.close()
    assert wiring.adapter_words(2) == "transmit queue full"
    assert wiring.adapter_words(0) == "no error"


# ---- as a command


def test_behind_a_serial_adapter(pumpbench: Pumpbench) -> None:
    with cable() as (ours, theirs):
        firmware = f"{sys.executable} -m firmware_sim --bus {theirs}"
        done = pumpbench("doctor", "--bus", ours, "--firmware", firmware, "--steps", 3)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.vcan
def test_on_a_vcan(pumpbench: Pumpbench) -> None:
    firmware = f"{sys.executable} -m firmware_sim --bus {{bus}}"
    done = pumpbench("doctor", "--bus", "socketcan:vcan0", "--firmware", firmware, "--steps", 3)
    assert done.returncode == 0, done.stdout + done.stderr


def masked(text: str) -> list[str]:
    """What the doctor prints, without what depends on the machine: how often the roll was called, and times."""
    return [re.sub(r"[0-9.]+ (frames arrived|ms\b|s\b)", r"# \1", line) for line in text.strip().splitlines()]


def test_the_page_shows_what_the_doctor_says(pumpbench: Pumpbench) -> None:
    page = (ROOT / "docs/your-firmware.md").read_text(encoding="utf-8")
    shown = re.findall(r"```\n\$ pumpbench doctor\n(.*?)```", page, re.DOTALL)
    assert len(shown) == 1
    done = pumpbench("doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    assert masked(shown[0]) == masked(done.stdout)


def test_the_page_shows_a_device_that_says_less(pumpbench: Pumpbench) -> None:
    page = (ROOT / "docs/your-firmware.md").read_text(encoding="utf-8")
    command, shown = re.findall(r"```\n\$ pumpbench doctor --firmware \"(.+?)\"\n(.*?)```", page, re.DOTALL)[0]
    command = command.replace("python examples", f"{sys.executable} {ROOT}/examples")
    done = pumpbench("doctor", "--firmware", command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert masked(shown) == masked(done.stdout)


def firmware_file(folder: Path, text: str) -> str:
    path = folder / "firmware.py"
    path.write_text(text, encoding="utf-8")
    return f"{sys.executable} {path} {{bus}}"


ANSWERS_999 = """
import sys
from can_bus import open_link
from can_bus.codec import Transmitter
with open_link(sys.argv[1]) as link:
    while True:
        for frame in link.recv(None):
            if frame.can_id == 0x10:
                link.send([Transmitter().frame("SYNC_Done", DoneStatus=0, DoneStepIndex=999, TxCount=1)])
"""


@pytest.mark.parametrize(
    ("script", "status", "text"),
    [
        ("import sys; sys.exit('no such board')", 3, "ended with status 1 in the middle of the run: no such board"),
        ("import time; time.sleep(60)", 1, "FAIL frames       nothing arrived within 2 s"),
        (ANSWERS_999, 1, "was answered with DoneStepIndex 999"),
    ],
)  # fmt: skip
def test_exit_status_and_no_process_left(script: str, status: int, text: str, pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("doctor", "--firmware", firmware_file(runs, script), "--timeout", 2)
    assert done.returncode == status, done.stdout + done.stderr
    assert text in done.stdout
    assert re.fullmatch(r"pumpbench: not passed: .*\n", done.stderr)
    assert not leftovers(runs / "out")


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (("--bus", "wifi"), 2, "'wifi'"),
        (("--bus", "inproc"), 2, "no wiring within one process"),
        (("--bus", "socketcan:can0", "--firmware", "none"), 2, "leave it out"),
        (("--firmware", " "), 2, "--firmware is empty"),
        (("--strategy", "s9"), 2, "there is no strategy 's9'"),
        (("--steps", "5000"), 2, "14 days"),
        (("--bus", "unix:/nowhere/at/all"), 3, "not passed: bus"),
        (("--firmware", "no-such-program"), 3, "not passed: firmware"),
    ],
)
def test_wrong_usage_and_a_bus_that_fails(
    arguments: Sequence[str], status: int, text: str, pumpbench: Pumpbench
) -> None:
    done = pumpbench("doctor", *arguments)
    assert (done.returncode, done.stderr.count("\n")) == (status, 1), done.stdout + done.stderr
    assert text in done.stderr


def test_for_machines(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("doctor", "--steps", 3, "--json", "-")
    found = json.loads(done.stdout)
    assert (found["passed"], found["steps"], found["bus"]) == (True, 3, "hub")
    assert {check["mark"] for check in found["checks"]} == {"ok"}
    assert 0 < found["latency_ms"]["median"] <= found["latency_ms"]["worst"]
    assert found["patient_day_s"] > 0
    done = pumpbench("doctor", "--bus", "unix:/nowhere", "--json", "found.json")
    found = json.loads((runs / "found.json").read_text())
    assert done.returncode == 3
    assert (found["passed"], found["latency_ms"], found["patient_day_s"]) == (False, None, None)
    assert found["checks"][0]["name"] == "bus" and found["checks"][0]["advice"]


def test_interrupted_it_leaves_nothing(runs: Path) -> None:
    up = runs / "up"
    command = firmware_file(runs, f"import pathlib, time; pathlib.Path({str(up)!r}).touch(); time.sleep(120)")
    process = subprocess.Popen(
        [sys.executable, "-m", "pumpbench", "doctor", "--firmware", command, "--timeout", "100"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not up.exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    children = psutil.Process(process.pid).children()
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr) == (130, "pumpbench: interrupted by SIGTERM\n")
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive


def test_a_hub_served_by_the_doctor(pumpbench: Pumpbench, runs: Path) -> None:
    url = f"unix:{runs}/bus"
    with subprocess.Popen([sys.executable, "-c", JOINS_LATER, url]) as device:
        done = pumpbench("doctor", "--bus", url, "--host", "--steps", 3, "--timeout", 60)
        assert device.wait(60) == 0
    assert done.returncode == 0, done.stdout + done.stderr


JOINS_LATER = """
import sys
from can_bus.url import open_link
from firmware_sim.firmware import Firmware
firmware = Firmware()
with open_link(sys.argv[1], wait=60) as link:
    while not firmware.finished:
        for frame in link.recv(None):
            link.send(firmware.receive(frame))
"""
