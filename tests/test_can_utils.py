"""can-utils beside a running bench: what they show, inject, replay and forward is what the bench says it was.

The device is in this process and answers only while a test has it play: the plant calls the roll until candump listens,
and the run stands still at a known instant while another tool does its work. Nothing here depends on who is faster.

Whoever listens joins after plant and device. The kernel hands a frame to the latest comer first, so that even with
several CPUs no listener can see an answer before what it answers.

Every command line here that begins with one of their names stands in docs/vcan.md as well, and the other way round.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest
from conftest import ROOT
from pumpbench.candump import read_lines
from pumpbench.capture import Capture
from test_transports import need_vcan

import dbc
from can_bus import codec
from can_bus.frame import Frame, from_message
from can_bus.link import Link
from can_bus.lockstep import Phase
from can_bus.url import open_link
from firmware_sim.firmware import Firmware

DAYS = 1
STRANGER, FORGED = Frame(0x6AB, b"\xde\xad\xbe\xef"), Frame(0x100, bytes.fromhex("00100FA000000000"))
FLOOD = 100
INJECTED_AT, FLOODED_AT, FLIPPED_FROM = 12, 60, 24
"""Steps at which the run stands still: for cansend, for cangen, and for a further rule of cangw."""

GIVE_UP = 240.0
"""Seconds of the wall clock after which something is taken to hang."""

pytestmark = pytest.mark.timeout(4 * GIVE_UP)

PATIENCE = f"--connect-timeout {GIVE_UP:g} --step-timeout {GIVE_UP:g}"

HERE = Path(__file__)
TOOLS = ("candump", "cansend", "cangen", "canplayer", "cangw")

RULES = ("cangw -A -s vcan0 -d vcan1 -e", "cangw -A -s vcan1 -d vcan0 -e")
FLIPPED = "cangw -A -s vcan0 -d vcan1 -e -f 100:C00007FF -m XOR:D:000.0.0000010000000000"


def frame_id(name: str) -> int:
    return codec.message(name).can_id


def decode(frame: Frame) -> dict[str, Any]:
    values: dict[str, Any] = dbc.load().decode_message(frame.can_id, frame.data, decode_choices=False, scaling=False)
    return values


def is_token_of(frame: Frame, step: int) -> bool:
    """Whether it opens the first turn of a step."""
    if frame.can_id != frame_id("SYNC_Step") or len(frame.data) != 8:
        return False
    token = decode(frame)
    return bool(token["SyncPhase"] == Phase.STEP and token["StepIndex"] == step)


def token_row(frames: list[Frame], step: int) -> int:
    return next(row for row, frame in enumerate(frames) if is_token_of(frame, step))


# ---------------------------------------------------------------- processes


def can_utils() -> None:
    need_vcan()
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        why = f"no {', '.join(missing)} here: apt-get install can-utils (tools/with_vcan fetches it for its guest)"
        if os.environ.get("CI"):
            pytest.fail(why)
        pytest.skip(why)


def split(command: str) -> list[str]:
    program, *arguments = shlex.split(command)
    return [sys.executable, "-m", program, *arguments] if program == "pumpbench" else [program, *arguments]


def finish(command: str, folder: Path) -> None:
    """Run it to its end."""
    done = subprocess.run(split(command), cwd=folder, timeout=GIVE_UP, check=False)
    assert done.returncode == 0, command


@contextlib.contextmanager
def running(command: str, folder: Path, output: str | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is ended with the block if it has not ended by itself."""
    with contextlib.ExitStack() as stack:
        out = stack.enter_context((folder / output).open("w")) if output else None
        process = stack.enter_context(subprocess.Popen(split(command), cwd=folder, stdout=out))
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()


def ended(process: subprocess.Popen[bytes]) -> None:
    assert process.wait(GIVE_UP) == 0, process.args


def wait_for(what: Callable[[], bool], text: str) -> None:
    end = time.monotonic() + GIVE_UP
    while not what():
        assert time.monotonic() < end, text
        time.sleep(0.001)


def listeners(interface: str) -> int:
    """How many sockets get every frame of the interface."""
    return sum(
        line.split()[0] == interface and line.split()[-1] == "raw"
        for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines()
        if line.strip()
    )


def children(parent: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def wait_until_read(pid: int) -> None:
    """Until a process that only listens has read all there was, or has died.

    It sleeps when its socket is empty; one that merely waits for the CPU does not.
    """
    stat = Path(f"/proc/{pid}/stat")
    wait_for(lambda: stat.read_text().rpartition(")")[2].split()[0] in "SZ", f"process {pid} never waits for a frame")


@contextlib.contextmanager
def candump(command: str, folder: Path, output: str | None = None) -> Iterator[int]:
    """Listens from here on, and is ended when it has written what it was shown; yields its process id."""
    interfaces = [word for word in command.split() if word.startswith("vcan")]
    before = {name: listeners(name) for name in interfaces}
    with running(command, folder, output) as process:
        wait_for(lambda: all(listeners(name) > before[name] for name in interfaces), f"{command} does not listen")
        yield process.pid
        wait_until_read(process.pid)


def wait_until_shown(log: Path) -> None:
    """Until a candump that writes at once, and with it whoever has listened for longer, has heard the roll call."""
    wait_for(lambda: log.stat().st_size > 0, f"{log.name}: candump hears no roll call")


class Device:
    """The reference firmware, which does a step when it is told to."""

    def __init__(self, link: Link) -> None:
        self._firmware = Firmware()
        self._link = link
        self._heard: deque[Frame] = deque()
        link.send(self._firmware.start())

    def listen(self) -> None:
        """Wait until somebody speaks: at first, until the roll is called, which goes on until it is answered."""
        frames = self._link.recv(GIVE_UP)
        assert frames, "nobody speaks on the device's bus"
        self._heard.extend(frames)

    def play(self, listeners: Sequence[int], until: int | None = None) -> None:
        """Take part in the run to its end, or until the token of a step has come, which stays unanswered.

        Args:
            listeners: processes that must miss nothing; each token waits for them, as an ordinary user's socket has
                room for some hundred frames only.
            until: the step.
        """
        while not self._firmware.finished:
            if not self._heard:
                self.listen()
            frame = self._heard[0]
            if until is not None and is_token_of(frame, until):
                break
            if frame.can_id == frame_id("SYNC_Step"):
                for pid in listeners:
                    wait_until_read(pid)
            answer = self._firmware.receive(self._heard.popleft())
            if answer:
                self._link.send(answer)

    def hear(self, count: int) -> list[Frame]:
        """What is said while the run stands still: so many frames, behind the token."""
        while len(self._heard) < 1 + count:
            self.listen()
        _, *said = self._heard
        return said


@contextlib.contextmanager
def joined(url: str) -> Iterator[Device]:
    with open_link(url) as link:
        yield Device(link)


def frames_of(log: Path, interface: str = "vcan0") -> list[Frame]:
    return [line.frame for line in read_lines(log) if line.interface == interface]


# ---------------------------------------------------------------- one run, and everything done to it


@dataclass
class Disturbed:
    """A run on vcan0, what candump wrote beside it, and the same run undisturbed and without a bus."""

    folder: Path
    frames: list[Frame]
    shown: list[Frame]
    logged: list[Frame]
    metrics: dict[str, Any]
    quiet: list[Frame]
    injected: list[Frame]
    flood: list[Frame]


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Disturbed:
    can_utils()
    folder = tmp_path_factory.mktemp("can-utils")
    with contextlib.ExitStack() as stack:
        device = stack.enter_context(joined("socketcan:vcan0"))
        command = f"pumpbench run --bus socketcan:vcan0 --strategy s3 --days {DAYS} --out run --firmware none"
        run = stack.enter_context(running(f"{command} {PATIENCE}", folder))
        device.listen()
        logged = stack.enter_context(candump("candump -r 8388608 -l vcan0", folder))
        shown = stack.enter_context(candump("candump -r 8388608 -L vcan0", folder, "shown.log"))
        wait_until_shown(folder / "shown.log")
        everybody = [*children(run.pid), logged, shown]  # with the recorder
        device.play(everybody, until=INJECTED_AT)
        finish("cansend vcan0 6AB#DEADBEEF", folder)
        finish("cansend vcan0 100#00100FA000000000", folder)
        injected = device.hear(2)
        device.play(everybody, until=FLOODED_AT)
        finish(f"cangen vcan0 -v -g 1 -n {FLOOD}", folder)
        flood = device.hear(FLOOD)
        device.play(everybody)
        ended(run)
    (own_log,) = folder.glob("candump-*.log")
    return Disturbed(
        folder,
        frames_of(folder / "run" / "bus.log", "can0"),
        frames_of(folder / "shown.log"),
        frames_of(own_log),
        json.loads((folder / "run" / "metrics.json").read_text()),
        undisturbed("s3", DAYS),
        injected,
        flood,
    )


def undisturbed(strategy: str, days: float) -> list[Frame]:
    from pumpbench import rig

    capture = Capture()
    request = rig.Request("adult#001", Path(), strategy=strategy, steps=round(days * 288), bus="inproc")
    rig.simulate(rig.prepare(request), capture)
    return capture.finish().frames()


@pytest.mark.vcan
@pytest.mark.parametrize("log", ["shown", "logged"])
def test_candump_logs_what_the_bench_records(disturbed: Disturbed, log: str) -> None:
    seen: list[Frame] = getattr(disturbed, log)
    ours, before = seen[-len(disturbed.frames) :], seen[: -len(disturbed.frames)]
    assert len(disturbed.frames) > 288 * DAYS * 8
    assert ours == disturbed.frames
    # ... and before the record there is nothing but the roll call
    names = {dbc.load().get_message_by_frame_id(frame.can_id).name for frame in before}
    assert names <= {"PLANT_Info", "SYNC_Step", "SYNC_Done", "CTRL_Info", "HB_CTRL"}
    assert {"SYNC_Step", "SYNC_Done"} <= names


@pytest.mark.vcan
def test_cansend_is_recorded_and_a_forged_reading_is_counted(disturbed: Disturbed) -> None:
    frames = disturbed.frames
    assert disturbed.injected == [STRANGER, FORGED]
    told = token_row(frames, INJECTED_AT)
    assert frames[told + 1 : told + 3] == [STRANGER, FORGED]
    assert frames.count(STRANGER) == frames.count(FORGED) == 1
    assert decode(FORGED)["GlucoseConc"] > 0
    before_the_flood = frames[: token_row(frames, FLOODED_AT)]
    counts = [decode(frame)["E2eErrorCount"] for frame in before_the_flood if frame.can_id == frame_id("CTRL_Diag")]
    steps_before = INJECTED_AT + 1  # that step's own token came ahead of the reading
    assert counts == [0] * steps_before + [1] * (FLOODED_AT - steps_before)
    assert disturbed.metrics["safety"]["e2e_errors"] >= 1


@pytest.mark.vcan
def test_cangen_floods_the_run_and_no_dose_follows(disturbed: Disturbed) -> None:
    assert len(disturbed.flood) == FLOOD
    told = token_row(disturbed.frames, FLOODED_AT)
    assert disturbed.frames[told + 1 : told + 1 + FLOOD] == disturbed.flood
    assert len({frame.can_id for frame in disturbed.flood}) > FLOOD * 0.8, "random ids"
    for name in ("PUMP_BasalCmd", "PUMP_BolusCmd", "PUMP_Ack", "PUMP_BolusState", "PUMP_Delivered", "PUMP_Status"):
        told, undisturbed_told = (
            [frame for frame in frames if frame.can_id == frame_id(name) and frame not in disturbed.flood]
            for frames in (disturbed.frames, disturbed.quiet)
        )
        assert told, name
        assert told == undisturbed_told, name
    assert set(disturbed.metrics["safety"]["hazards"].values()) == {0}
    assert all(ledger["closes"] for ledger in disturbed.metrics["safety"]["ledger"].values())


@pytest.mark.vcan
def test_canplayer_replays_bus_log_to_candump(disturbed: Disturbed) -> None:
    folder, count = disturbed.folder, len(disturbed.frames)
    if os.geteuid() != 0:  # then candump may not have the buffer it asks for
        count = head_of_log(folder, 200)
    with candump("candump -r 8388608 -L vcan0", folder, "replayed.log"):
        if count == len(disturbed.frames):
            finish("canplayer -t -I run/bus.log vcan0=can0", folder)
        else:
            finish("canplayer -t -I head.log vcan0=can0", folder)
    assert frames_of(folder / "replayed.log") == disturbed.frames[:count]


@pytest.mark.vcan
def test_canplayer_replays_bus_log_to_python_can(disturbed: Disturbed) -> None:
    count = head_of_log(disturbed.folder, 200)  # a bus of python-can has a socket's usual buffer, of some 280 frames
    with can.Bus("vcan0", interface="socketcan") as bus:
        finish("canplayer -t -I head.log vcan0=can0", disturbed.folder)
        messages = [bus.recv(5) for _ in range(count)]
    assert [from_message(message) for message in messages if message] == disturbed.frames[:count]


def head_of_log(folder: Path, count: int) -> int:
    lines = (folder / "run" / "bus.log").read_text().splitlines(keepends=True)
    (folder / "head.log").write_text("".join(lines[:count]))
    return count


# ---------------------------------------------------------------- the kernel's gateway


@contextlib.contextmanager
def gateway(rules: tuple[str, ...], folder: Path) -> Iterator[Callable[[str], None]]:
    """The rules, and how to add one; they go one by one, as others on this machine may have some of their own."""
    can_utils()
    root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    if not os.environ.get("VCAN_GUEST") and shutil.which("modprobe"):
        subprocess.run([*root, "modprobe", "can-gw"], capture_output=True, check=False)
    there: list[str] = []

    def add(rule: str) -> None:
        arguments = [*root, *split(rule)]
        done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=20, check=False)
        if done.returncode:
            why = f"{rule}: {done.stderr.strip()} (it takes root, and the module can-gw)"
            if os.environ.get("CI"):
                pytest.fail(why)
            pytest.skip(why)
        there.append(rule)

    try:
        for rule in rules:
            add(rule)
        yield add
    finally:
        for rule in there:
            subprocess.run([*root, *split(rule.replace(" -A ", " -D "))], timeout=20, check=True)


@dataclass
class Forwarded:
    """A run of plant and firmware on two interfaces joined by the kernel, as either side saw it."""

    rules: str
    plant: list[Frame]
    device: list[Frame]
    quiet: list[Frame]


@pytest.fixture(scope="module")
def forwarded(tmp_path_factory: pytest.TempPathFactory) -> Forwarded:
    folder = tmp_path_factory.mktemp("cangw")
    with contextlib.ExitStack() as stack:
        add = stack.enter_context(gateway(RULES, folder))
        device = stack.enter_context(joined("socketcan:vcan1"))
        command = f"pumpbench plant --bus socketcan:vcan0 --strategy s2 --days {DAYS} {PATIENCE}"
        plant = stack.enter_context(running(command, folder))
        device.listen()
        both = stack.enter_context(candump("candump -r 8388608 -L vcan0 vcan1", folder, "both.log"))
        wait_until_shown(folder / "both.log")
        device.play([both], until=FLIPPED_FROM)
        add(FLIPPED)
        device.play([both])
        ended(plant)
        rules = subprocess.run(["cangw", "-L"], capture_output=True, text=True, timeout=20, check=False).stdout
    sides = []
    for interface in ("vcan0", "vcan1"):
        capture = Capture()  # it takes the roll call away
        capture.extend(0, frames_of(folder / "both.log", interface))
        sides.append(capture.finish().frames())
    return Forwarded(rules, sides[0], sides[1], undisturbed("s2", DAYS))


def flipped(frame: Frame) -> Frame:
    data = bytearray(frame.data)
    data[2] ^= 0x01
    return Frame(frame.can_id, bytes(data))


@pytest.mark.vcan
def test_the_loop_runs_over_the_kernels_gateway(forwarded: Forwarded) -> None:
    listed = [set(line.split()) for line in forwarded.rules.splitlines()]
    assert all(any(set(rule.split()) <= words for words in listed) for rule in (*RULES, FLIPPED)), forwarded.rules
    told = token_row(forwarded.quiet, FLIPPED_FROM) + 1
    assert told > FLIPPED_FROM * 8
    assert forwarded.plant[:told] == forwarded.quiet[:told]
    assert forwarded.device[:told] == forwarded.quiet[:told]


@pytest.mark.vcan
def test_a_bit_flipped_by_the_kernels_gateway_is_an_e2e_error_for_the_device(forwarded: Forwarded) -> None:
    sent, heard, quiet = (
        [frame for frame in frames if frame.can_id == frame_id("CGM_Reading")]
        for frames in (forwarded.plant, forwarded.device, forwarded.quiet)
    )
    assert sent == quiet
    again = sent[FLIPPED_FROM + 1 :]
    assert len(again) > 288 * DAYS // 2
    assert Counter(heard) == Counter(sent) + Counter(flipped(frame) for frame in again)
    diag = [decode(frame)["E2eErrorCount"] for frame in forwarded.device if frame.can_id == frame_id("CTRL_Diag")]
    assert diag[FLIPPED_FROM:] == list(range(len(diag) - FLIPPED_FROM))
    commands = [frame for frame in forwarded.plant if frame.can_id == frame_id("PUMP_BasalCmd")]
    assert commands == [frame for frame in forwarded.quiet if frame.can_id == frame_id("PUMP_BasalCmd")]


# ---------------------------------------------------------------- the documentation


def test_the_documented_commands_are_those_that_are_tested() -> None:
    section = (ROOT / "docs" / "vcan.md").read_text().split("## With can-utils")[1].split("\n## ")[0]
    documented = {
        re.split(r"  +#|  *>| &$", line.strip())[0].rstrip()
        for line in section.splitlines()
        if line.strip().startswith(TOOLS)
    }
    tested = HERE.read_text().replace(f"{{{'FLOOD'}}}", str(FLOOD))
    assert len(documented) >= 8
    for command in documented:
        assert command in tested, f"{command} is documented and not tested"
    for tool in TOOLS:
        assert any(command.startswith(tool) for command in documented), tool
