"""can-utils beside a running bench: what they show, inject, replay and forward is what the bench says it was.

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
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest
from conftest import ROOT
from pumpbench.capture import Capture, read_lines
from test_transports import need_vcan

import dbc
from can_bus import codec
from can_bus.frame import Frame, from_message
from can_bus.url import open_link

DAYS = 3
STRANGER, FORGED = Frame(0x6AB, b"\xde\xad\xbe\xef"), Frame(0x100, bytes.fromhex("00100FA000000000"))
FLOOD = 100

HERE = Path(__file__)
TOOLS = ("candump", "cansend", "cangen", "canplayer", "cangw")

RULES = ("cangw -A -s vcan0 -d vcan1 -e", "cangw -A -s vcan1 -d vcan0 -e")
FLIPPED = "cangw -A -s vcan0 -d vcan1 -e -f 100:C00007FF -m XOR:D:000.0.0000010000000000"


def frame_id(name: str) -> int:
    return codec.message(name).can_id


def decode(frame: Frame) -> dict[str, Any]:
    values: dict[str, Any] = dbc.load().decode_message(frame.can_id, frame.data, decode_choices=False, scaling=False)
    return values


# ---------------------------------------------------------------- processes


def can_utils() -> None:
    """On request only: they race a run against tools of the wall clock, and lose where others keep the CPUs busy."""
    if os.environ.get("PUMPBENCH_CAN_UTILS") != "1":
        pytest.skip("on request: PUMPBENCH_CAN_UTILS=1")
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


def finish(command: str, folder: Path) -> str:
    """Run it to its end; returns what it printed."""
    done = subprocess.run(split(command), cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, (command, done.stdout, done.stderr)
    return done.stdout


@contextlib.contextmanager
def running(command: str, folder: Path, output: str | None = None) -> Iterator[subprocess.Popen[str]]:
    """A process that is ended with the block if it has not ended by itself."""
    with contextlib.ExitStack() as stack:
        out: Any = stack.enter_context((folder / output).open("w")) if output else subprocess.PIPE
        process = subprocess.Popen(split(command), cwd=folder, stdout=out, stderr=subprocess.PIPE, text=True)
        stack.enter_context(process)
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()


def ended(process: subprocess.Popen[str], status: int = 0) -> None:
    out, err = process.communicate(timeout=120)
    assert process.returncode == status, (process.args, out, err)


def wait_for(what: Callable[[], bool], text: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, text
        time.sleep(0.01)


def listeners(interface: str) -> int:
    """How many sockets get every frame of the interface."""
    return sum(
        line.split()[0] == interface and line.split()[-1] == "raw"
        for line in Path("/proc/net/can/rcvlist_all").read_text().splitlines()
        if line.strip()
    )


@contextlib.contextmanager
def candump(command: str, folder: Path, output: str | None = None) -> Iterator[None]:
    """Listens from here on, and is ended when it has written what it was shown."""
    interfaces = [word for word in command.split() if word.startswith("vcan")]
    before = {name: listeners(name) for name in interfaces}
    with running(command, folder, output) as process:
        wait_for(lambda: all(listeners(name) > before[name] for name in interfaces), f"{command} does not listen")
        yield
        asleep = [False]

        def idle() -> bool:
            """It sleeps when its socket is empty, while one that only waits for the CPU does not."""
            time.sleep(0.05)
            asleep.append(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "S")
            return all(asleep[-3:])

        wait_for(idle, f"{command} does not come to an end")


@contextlib.contextmanager
def steps_of(url: str) -> Iterator[Callable[[int, subprocess.Popen[str]], None]]:
    """A function that waits until a process that is running has come to a step."""
    with open_link(url, filters=[frame_id("SYNC_Step")]) as link:

        def reached(step: int, process: subprocess.Popen[str]) -> bool:
            assert process.poll() is None, process.communicate()
            tokens = [decode(frame) for frame in link.recv(0)]
            return any(token["SyncPhase"] != 0 and token["StepIndex"] >= step for token in tokens)

        def watch(step: int, process: subprocess.Popen[str]) -> None:
            wait_for(lambda: reached(step, process), f"no step {step}")

        yield watch


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
    flood: list[Frame]


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Disturbed:
    can_utils()
    folder = tmp_path_factory.mktemp("can-utils")
    with contextlib.ExitStack() as stack:
        stack.enter_context(candump("candump -r 8388608 -L vcan0", folder, "shown.log"))
        stack.enter_context(candump("candump -r 8388608 -l vcan0", folder))
        command = f"pumpbench run --bus socketcan:vcan0 --strategy s3 --days {DAYS} --out run"
        watch = stack.enter_context(steps_of("socketcan:vcan0"))
        run = stack.enter_context(running(command, folder))
        watch(12, run)
        finish("cansend vcan0 6AB#DEADBEEF", folder)
        finish("cansend vcan0 100#00100FA000000000", folder)
        watch(60, run)
        flood = finish(f"cangen vcan0 -v -g 1 -n {FLOOD}", folder)
        ended(run)
    (own_log,) = folder.glob("candump-*.log")
    return Disturbed(
        folder,
        frames_of(folder / "run" / "bus.log", "can0"),
        frames_of(folder / "shown.log"),
        frames_of(own_log),
        json.loads((folder / "run" / "metrics.json").read_text()),
        undisturbed("s3", DAYS),
        [
            Frame(int(ident, 16), bytes.fromhex(data.replace(".", "")))
            for ident, data in re.findall(r"vcan0 +([0-9A-F]{3})#([0-9A-F.]*)", flood)
        ],
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
    if os.cpu_count() == 1:  # else two readers may see what two nodes send at once in another order
        assert ours == disturbed.frames
    else:
        foreign = [STRANGER, FORGED, *disturbed.flood]
        assert Counter(ours) == Counter(disturbed.frames)
        assert [f for f in ours if f not in foreign] == [f for f in disturbed.frames if f not in foreign]
    # ... and before the record there is nothing but the roll call
    names = {dbc.load().get_message_by_frame_id(frame.can_id).name for frame in before}
    assert names <= {"PLANT_Info", "SYNC_Step", "SYNC_Done", "CTRL_Info", "HB_CTRL"}
    assert {"SYNC_Step", "SYNC_Done"} <= names


@pytest.mark.vcan
def test_cansend_is_recorded_and_a_forged_reading_is_counted(disturbed: Disturbed) -> None:
    frames = disturbed.frames
    assert frames.count(STRANGER) == frames.count(FORGED) == 1
    assert decode(FORGED)["GlucoseConc"] > 0
    assert frames.index(STRANGER) < frames.index(FORGED) < len(frames) // 2, "in the middle of the run"
    counts = [
        (row, decode(frame)["E2eErrorCount"])
        for row, frame in enumerate(frames)
        if frame.can_id == frame_id("CTRL_Diag") and len(frame.data) == 8
    ]
    assert {count for row, count in counts if row < frames.index(FORGED)} == {0}
    assert next(count for row, count in counts if row > frames.index(FORGED) + 60) == 1
    assert disturbed.metrics["safety"]["e2e_errors"] >= 1


@pytest.mark.vcan
def test_cangen_floods_the_run_and_no_dose_follows(disturbed: Disturbed) -> None:
    assert len(disturbed.flood) == FLOOD
    assert len({frame.can_id for frame in disturbed.flood}) > FLOOD * 0.8, "random ids"
    assert not Counter(disturbed.flood) - Counter(disturbed.frames), "all of it within the run"
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
        stack.enter_context(candump("candump -r 8388608 -L vcan0 vcan1", folder, "both.log"))
        watch = stack.enter_context(steps_of("socketcan:vcan0"))
        device = stack.enter_context(running("pumpbench firmware --bus socketcan:vcan1", folder))
        plant = stack.enter_context(running("pumpbench plant --bus socketcan:vcan0 --strategy s2 --days 2", folder))
        watch(24, plant)
        add(FLIPPED)
        ended(plant)
        ended(device)
        rules = subprocess.run(["cangw", "-L"], capture_output=True, text=True, timeout=20, check=False).stdout
    sides = []
    for interface in ("vcan0", "vcan1"):
        capture = Capture()  # it takes the roll call away
        capture.extend(0, frames_of(folder / "both.log", interface))
        sides.append(capture.finish().frames())
    return Forwarded(rules, sides[0], sides[1], undisturbed("s2", 2))


def flipped(frame: Frame) -> Frame:
    data = bytearray(frame.data)
    data[2] ^= 0x01
    return Frame(frame.can_id, bytes(data))


@pytest.mark.vcan
def test_the_loop_runs_over_the_kernels_gateway(forwarded: Forwarded) -> None:
    listed = [set(line.split()) for line in forwarded.rules.splitlines()]
    assert all(any(set(rule.split()) <= words for words in listed) for rule in (*RULES, FLIPPED)), forwarded.rules
    told = next(row for row, frame in enumerate(forwarded.quiet) if is_token_of(frame, 24))
    assert told > 24 * 8
    assert forwarded.plant[:told] == forwarded.quiet[:told]
    assert forwarded.device[:told] == forwarded.quiet[:told]


def is_token_of(frame: Frame, step: int) -> bool:
    return frame.can_id == frame_id("SYNC_Step") and decode(frame)["StepIndex"] == step


@pytest.mark.vcan
def test_a_bit_flipped_by_the_kernels_gateway_is_an_e2e_error_for_the_device(forwarded: Forwarded) -> None:
    sent = [frame for frame in forwarded.plant if frame.can_id == frame_id("CGM_Reading")]
    heard = [frame for frame in forwarded.device if frame.can_id == frame_id("CGM_Reading")]
    assert sent == [frame for frame in forwarded.quiet if frame.can_id == frame_id("CGM_Reading")]
    extra = list((Counter(heard) - Counter(sent)).elements())
    assert extra
    assert set(extra) <= {flipped(frame) for frame in sent}
    counted = [row for row, frame in enumerate(forwarded.device) if frame.can_id == frame_id("CTRL_Diag")][-1]
    before = [frame for frame in forwarded.device[:counted] if frame in extra]
    assert decode(forwarded.device[counted])["E2eErrorCount"] == len(before) > 20
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
