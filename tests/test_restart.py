"""The firmware as a process, killed without warning in the middle of a run and started again on the same memory."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from pumpbench.calibration import MODES

from firmware_sim.__main__ import main, memory
from firmware_sim.firmware import Cause, Firmware

DEADLINE = 60.0


def wait_for(path: Path, *, filled: bool = False) -> None:
    """Until a file is there; a memory that is `filled` holds a record, so that its device is in the midst of a run."""
    end = time.monotonic() + DEADLINE
    while not path.exists() or (filled and not path.read_bytes().strip(b"\xff")):
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.02)


def test_a_killed_firmware_goes_on_where_it_was(tmp_path: Path) -> None:
    bus, nvm = tmp_path / "bus", tmp_path / "nvm"
    options = ["--bus", f"unix:{bus}", "--host", "--strategy", "s3", "--days", "14"]
    plant = subprocess.Popen(
        [sys.executable, "-m", "pumpbench", "plant", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    command = [sys.executable, "-m", "firmware_sim", "--bus", f"unix:{bus}", "--nvm", str(nvm)]
    try:
        wait_for(bus)
        firmware = subprocess.Popen(command)
        wait_for(nvm, filled=True)
        for _ in range(2):
            time.sleep(0.7)
            firmware.kill()
            firmware.wait()
            firmware = subprocess.Popen([*command, "--reset-cause", "brown_out"])
        assert firmware.wait(DEADLINE) == 0
        assert plant.wait(DEADLINE) == 0
    finally:
        firmware.kill()
        plant.kill()
    output = plant.communicate()[0]
    assert "done: 4032 steps" in output
    assert nvm.stat().st_mode & 0o777 == 0o600
    kept = memory(nvm)
    again = Firmware(kept, Cause.PIN)
    kept.close()
    assert again._step == 4031
    assert again._user.mode == MODES["s3"]
    assert 1 <= len(again._caution._resets) <= 2  # a kill before the first step is no reset within a run
    assert again._calibration.active


def test_a_file_that_is_no_memory_is_refused_with_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "nvm"
    path.write_bytes(b"something else")
    with pytest.raises(SystemExit) as end:
        main(["--bus", "unix:/nowhere", "--nvm", str(path)])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert str(path) in error and "14 bytes" in error and "expected" in error
    assert path.read_bytes() == b"something else"


def test_a_firmware_without_a_memory_does_its_run(tmp_path: Path) -> None:
    url = f"unix:{tmp_path / 'bus'}"
    plant = subprocess.Popen([sys.executable, "-m", "pumpbench", "plant", "--bus", url, "--host", "--days", "1"])
    try:
        wait_for(tmp_path / "bus")
        done = subprocess.run([sys.executable, "-m", "firmware_sim", "--bus", url], timeout=DEADLINE, check=False)
        assert done.returncode == 0
        assert plant.wait(DEADLINE) == 0
    finally:
        plant.kill()


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ([], "--bus URL is needed"),
        (
            ["--bus", "unix:/nowhere", "--console", "socket://10.0.0.1:99"],
            "--console: socket://10.0.0.1:99: a socket must",
        ),
    ],
)
def test_wrong_usage_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], what: str
) -> None:
    monkeypatch.delenv("PUMPBENCH_BUS", raising=False)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert what in capsys.readouterr().err
