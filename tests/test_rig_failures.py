"""Whatever goes wrong: one line, the right exit status, no process left, no folder that looks complete."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from conftest import Pumpbench

SCRIPTS = {
    "exits at once": ("import sys; sys.exit(7)", "the firmware ended with status 7"),
    "never answers": ("import time; time.sleep(60)", "waited 2 s for CTRL to answer the roll call"),
    "prints why": ("import sys; sys.exit('no such board')", "no such board"),
}

STOPS_AT_STEP = """
import sys
import time
from can_bus import open_link
from firmware_sim.firmware import Firmware
firmware = Firmware()
link = open_link(sys.argv[1])
while True:
    for frame in link.recv(None):
        answer = firmware.receive(frame)
        if firmware._step == 20:
            {what}
        if answer:
            link.send(answer)
"""

DIES = {
    "killed": ("import os; os.kill(os.getpid(), 9)", "the firmware was killed by SIGKILL"),
    "hangs": ("import time; time.sleep(60)", "waited 2 s for CTRL to answer step 20 with SYNC_Done"),
    "wrong step": (
        "link.send([firmware._turn.transmitter.frame('SYNC_Done', DoneStatus=0, DoneStepIndex=7)]); continue",
        "waited 2 s for CTRL to answer step 20 with SYNC_Done"),
    "talks on and on": (
        "[(link.send([firmware._turn.transmitter.frame('CTRL_Diag')] * 10), time.sleep(0.001)) for _ in iter(int, 1)]",
        "waited 2 s for CTRL to answer step 20 with SYNC_Done"),
    "asks for turns for ever": (
        "link.send([firmware._turn.transmitter.frame('SYNC_Done', DoneStatus=3, DoneStepIndex=20)]); continue",
        "asked for more than 32 turns in step 20"),
}  # fmt: skip

TIMEOUTS = ("--connect-timeout", "2", "--step-timeout", "2")


def check(done: "subprocess.CompletedProcess[str]", status: int, text: str, out: Path) -> None:
    assert done.returncode == status, done.stderr + done.stdout
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not out.exists()
    assert not leftovers(out), "a process was left behind"


def leftovers(out: Path) -> list[psutil.Process]:
    """Processes that mention this test's folder."""
    folder = str(out.parent)
    return [
        process
        for process in psutil.process_iter(["cmdline"])
        if process.pid != os.getpid() and any(folder in part for part in process.info["cmdline"] or ())
    ]


@pytest.mark.parametrize("name", SCRIPTS)
def test_firmware_that_never_joins(name: str, pumpbench: Pumpbench, runs: Path) -> None:
    script, text = SCRIPTS[name]
    file = runs / "firmware.py"
    file.write_text(script)
    done = pumpbench("run", "--firmware", f"{sys.executable} {file}", *TIMEOUTS, "--out", runs / "out")
    check(done, 3, text, runs / "out")
    assert not (runs / "out.partial").exists() or any((runs / "out.partial").iterdir())


@pytest.mark.parametrize("name", DIES)
def test_firmware_that_stops_in_the_middle(name: str, pumpbench: Pumpbench, runs: Path) -> None:
    what, text = DIES[name]
    file = runs / "firmware.py"
    file.write_text(STOPS_AT_STEP.replace("{what}", what))
    done = pumpbench("run", "--firmware", f"{sys.executable} {file} {{bus}}", *TIMEOUTS, "--out", runs / "out")
    check(done, 3, text, runs / "out")


def test_firmware_command_that_does_not_exist(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("run", "--firmware", "no-such-firmware {bus}", "--out", runs / "out")
    check(done, 3, "cannot start the firmware (no-such-firmware", runs / "out")


def test_firmware_that_sends_garbage_is_ignored_until_the_timeout(pumpbench: Pumpbench, runs: Path) -> None:
    file = runs / "firmware.py"
    file.write_text(
        "import random, sys, time\nfrom can_bus import open_link\nfrom can_bus.frame import Frame\n"
        "random.seed(1)\nlink = open_link(sys.argv[1])\n"
        "for _ in range(2000):\n    link.send([Frame(random.randrange(2048), random.randbytes(8))])\ntime.sleep(60)\n"
    )
    done = pumpbench("run", "--firmware", f"{sys.executable} {file} {{bus}}", *TIMEOUTS, "--out", runs / "out")
    check(done, 3, "waited 2 s for CTRL to answer the roll call", runs / "out")


WRONG = {
    "patient": (("--patient", "adult#011"), "adult#011"),
    "scenario": (("--scenario", "breakfast"), "there is no scenario 'breakfast'"),
    "bus": (("--bus", "wifi"), "'wifi'"),
    "days": (("--days", "15"), "has 14 days, asked for 15"),
    "no days": (("--days", "0"), "at least one step"),
    "sensor": (("--sensor", "nose"), "there is no sensor 'nose'"),
    "inproc": (("--bus", "inproc", "--firmware", "x"), "--bus inproc runs the built-in firmware only"),
    "empty firmware": (("--firmware", " "), "--firmware is empty"),
    "no second bus": (("--bus", "unix:/run/a", "--faults", "faults.yaml"), "--device-bus"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_usage(name: str, pumpbench: Pumpbench, runs: Path) -> None:
    (runs / "faults.yaml").write_text("faults: [{kind: drop, message: CGM_Reading}]")
    arguments, text = WRONG[name]
    check(pumpbench("run", *arguments, "--out", runs / "out"), 2, text, runs / "out")


def test_unknown_strategy_names_those_there_are(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("run", "--strategy", "s9", "--out", runs / "out")
    assert done.returncode == 2
    assert "'s9' is not one of" in done.stderr


FAULT_FILES = {
    "faults: [{kind: drop, message: CGM_Readin}]": "1: faults.0.message: the DBC has no message of this name",
    'faults:\n  - {kind: drop, message: CGM_Reading,\n     start: "25:00"}': "3: faults.0.start",
    "faults:\n  - {kind: drop, message: CGM_Reading, from: 1}": "2: faults.0.from",
    "faults: 3": "1: faults",
    "faults: [": "not YAML",
}


@pytest.mark.parametrize("text", FAULT_FILES)
def test_malformed_fault_file_names_file_and_line(text: str, pumpbench: Pumpbench, runs: Path) -> None:
    file = runs / "faults.yaml"
    file.write_text(text)
    done = pumpbench("run", "--faults", file, "--out", runs / "out")
    check(done, 2, FAULT_FILES[text], runs / "out")
    assert str(file) in done.stderr


def test_run_folder_is_never_overwritten_unasked(pumpbench: Pumpbench, runs: Path) -> None:
    out = runs / "out"
    day = ("run", "--bus", "inproc", "--days", "0.1", "--out", out)
    assert pumpbench(*day).returncode == 0
    before = (out / "run.json").read_bytes()
    refused = pumpbench(*day, "--seed", "2")
    assert refused.returncode == 2
    assert "already holds a run" in refused.stderr
    assert (out / "run.json").read_bytes() == before
    assert pumpbench(*day, "--seed", "2", "--overwrite").returncode == 0
    assert (out / "run.json").read_bytes() != before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_interrupted_run_leaves_nothing_behind(number: signal.Signals, runs: Path) -> None:
    out = runs / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "pumpbench", "run", "--days", "14", "--out", str(out)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not any("firmware_sim" in " ".join(child.cmdline()) for child in _children(process.pid)):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    children = _children(process.pid)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.strip() == f"pumpbench: interrupted by {number.name}"
    assert not out.exists()
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


@pytest.mark.parametrize("bus", ["hub", "inproc"])
def test_full_disk_is_one_line_and_the_partial_folder_keeps_its_name(bus: str, runs: Path) -> None:
    """The disk is full for whoever records: its files may not grow beyond 200 kB."""
    script = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "from pumpbench.cli import main; sys.argv[0] = 'pumpbench'; main()\n"
    )
    out = runs / "out"
    done = subprocess.run(
        [sys.executable, "-c", script, "run", "--days", "2", "--bus", bus, "--out", str(out)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    check(done, 3, "cannot write", out)
    assert (runs / "out.partial").is_dir()
