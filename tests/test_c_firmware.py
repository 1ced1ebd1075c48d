"""The firmware in C: the same doses, states and alarms as the reference firmware, and no crash whatever it hears."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from conftest import ROOT

from can_bus.codec import Transmitter, message
from can_bus.frame import Frame, pack, unpack
from can_bus.lockstep import Phase
from firmware_sim.firmware import Firmware

SOURCE = ROOT / "examples" / "c_firmware"
VECTOR = ROOT / "examples" / "golden_vectors" / "nma.log"

BASAL_CMD = message("PUMP_BasalCmd").can_id
DONE = message("SYNC_Done").can_id
ITS_OWN = {message(name).can_id for name in ("CTRL_Diag", "CTRL_Info", "UDS_Response")}
"""Counters, version and diagnostics are every firmware's own."""

DAY = ("--patient", "adult#001", "--strategy", "nma", "--days", "1", "--seed", "1")


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the firmware and its sanitized twin are, built as the README says."""
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.fail("gcc and make are needed to build examples/c_firmware")
    folder = tmp_path_factory.mktemp("c_firmware")
    options = [f"BUILD={folder}", f"PYTHON={sys.executable}", "CC=gcc", "CFLAGS=-O2 -g -Wconversion"]
    done = subprocess.run(
        ["make", "all", "sanitize", *options], cwd=SOURCE, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in done.stderr
    return folder


def vector() -> tuple[list[Frame], list[Frame]]:
    """The day of the golden vectors: what the device hears, with a roll call before it, and what it answers."""
    heard, said = [Transmitter().frame("SYNC_Step", SyncPhase=Phase.INIT, StepIndex=1, SimTime=0)], []
    for line in VECTOR.read_text(encoding="ascii").splitlines():
        _, _, body, direction = line.split()
        can_id, _, data = body.partition("#")
        (heard if direction == "R" else said).append(Frame(int(can_id, 16), bytes.fromhex(data)))
    return heard, said


def answers(program: Path, records: bytes, status: int = 0) -> list[Frame]:
    """What the C firmware says to these records on its stdin, after the heartbeat of its start."""
    done = subprocess.run([program, "stdio:"], input=records, capture_output=True, timeout=60, check=False)
    assert done.returncode == status, (done.returncode, done.stderr.decode())
    assert b"runtime error" not in done.stderr and b"Sanitizer" not in done.stderr
    frames = unpack(done.stdout)
    assert frames[0].can_id == message("HB_CTRL").can_id
    return frames[1:]


def expected(heard: Sequence[Frame]) -> list[Frame]:
    """What the reference firmware says to the same frames."""
    firmware = Firmware()
    firmware.start()
    return [answer for frame in heard for answer in firmware.receive(frame)]


def comparable(frames: Sequence[Frame]) -> list[Frame]:
    """Everything but what is a firmware's own; of SYNC_Done the part that is not ExecTime or its checksum."""
    return [
        frame if frame.can_id != DONE else Frame(DONE, frame.data[1:4] + frame.data[7:])
        for frame in frames
        if frame.can_id not in ITS_OWN
    ]


def doses(frames: Sequence[Frame]) -> list[Frame]:
    return [frame for frame in frames if frame.can_id == BASAL_CMD]


@pytest.mark.parametrize("program", ["firmware", "firmware_sanitize"])
def test_the_golden_vectors(build: Path, program: str) -> None:
    heard, said = vector()
    found = answers(build / program, pack(heard))[3:]  # HB_CTRL, CTRL_Info, SYNC_Done of the roll call
    assert len(doses(said)) == 288
    assert doses(found) == doses(said)
    assert comparable(found) == comparable(said)
    print(f"\n{len(doses(said))} set-points, {len(said)} frames; {sum(map(Frame.__eq__, found, said))} with every byte")
