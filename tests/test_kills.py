"""SIGKILL at random instants of the wall clock: of the firmware, which goes on; of the plant, after which all end."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pumpbench.candump import read_candump
from pumpbench.hazards import Monitor
from test_restart import DEADLINE, wait_for

KILLS = int(os.environ.get("PUMPBENCH_KILLS", "8"))
"""In all; three in four hit the firmware."""

FIRMWARE_KILLS, PLANT_KILLS = KILLS - KILLS // 4, KILLS // 4


def plant(bus: Path, days: int) -> "subprocess.Popen[str]":
    options = ["--bus", f"unix:{bus}", "--host", "--strategy", "s3", "--scenario", "camerlingo", "--days", str(days)]
    return subprocess.Popen(
        [sys.executable, "-m", "pumpbench", "plant", *options, "--step-timeout", "30"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def firmware(bus: Path, nvm: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "firmware_sim", "--bus", f"unix:{bus}", "--nvm", str(nvm)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


def until_it_stores(nvm: Path) -> None:
    """Until a device that has just started has done a step."""
    before, over = nvm.stat().st_mtime_ns, time.monotonic() + DEADLINE
    while nvm.stat().st_mtime_ns == before and time.monotonic() < over:
        time.sleep(0.002)


def recorder(bus: Path, out: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "pumpbench", "record", "--bus", f"unix:{bus}", "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def end(*processes: "subprocess.Popen[str] | subprocess.Popen[bytes]") -> None:
    for process in processes:
        process.kill()
        process.wait(DEADLINE)
        if process.stdout is not None:
            process.stdout.close()


@pytest.mark.timeout(3600)
def test_a_firmware_killed_again_and_again_does_its_run(tmp_path: Path) -> None:
    """The plant checks the ledger to the stroke in every step, and ends with status 3 where it does not close."""
    rng = random.Random(1)
    days = 14 + FIRMWARE_KILLS * 2 // 5  # enough to be killed in; the pump's 24-bit totals hold 400 of them
    bus, nvm = tmp_path / "bus", tmp_path / "nvm"
    bench = plant(bus, days)
    wait_for(bus)
    device = firmware(bus, nvm)
    killed = 0
    try:
        wait_for(nvm, filled=True)
        while killed < FIRMWARE_KILLS and bench.poll() is None:
            if killed % 4:
                until_it_stores(nvm)
            time.sleep(rng.uniform(0.0, 0.1))  # one in four while it starts
            device.kill()
            device.wait(DEADLINE)
            killed += 1
            device = firmware(bus, nvm)
        over = "" if bench.poll() is None or bench.stdout is None else bench.stdout.read()
        assert killed == FIRMWARE_KILLS, f"the run was over too early: {over}"
        assert bench.wait(DEADLINE + days * 5) == 0
        assert bench.stdout is not None and f"done: {days * 288} steps" in bench.stdout.read()
        assert device.wait(DEADLINE) == 0
    finally:
        end(device, bench)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_a_plant_that_is_killed_takes_everybody_with_it(tmp_path: Path) -> None:
    """Nobody hangs, everybody says so, and in what was recorded until then every stroke is accounted for."""
    rng = random.Random(2)
    steps = 0
    for number in range(PLANT_KILLS):
        bus, nvm, out = (tmp_path / f"{name}-{number}" for name in ("bus", "nvm", "out"))
        bench = plant(bus, 14)
        wait_for(bus)
        listener, device = recorder(bus, out), firmware(bus, nvm)
        try:
            wait_for(nvm)
            time.sleep(rng.uniform(0.2, 2.0))
            bench.kill()
            assert device.wait(DEADLINE) in (0, 3)  # 0: the run was over
            assert listener.wait(DEADLINE) in (0, 3)
        finally:
            end(device, listener, bench)
        frames = read_candump((out if out.is_dir() else Path(f"{out}.partial")) / "bus.log")
        monitor = Monitor()
        monitor.watch(frames.frames(0))
        assert sum(monitor.hazards.values()) == 0, monitor.hazards.found
        steps += int(frames.step.max()) if len(frames) else 0
    assert steps > 0
