"""The C firmware cross-compiled for a Cortex-M3, on an emulated board that speaks slcan over its UART."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
import pytest
import serial
from conftest import ROOT, Pumpbench
from pumpbench.runfolder import RunFolder
from test_c_firmware import (
    BASAL_CMD,
    DROPPED,
    SOURCE,
    any_calibration,
    comparable,
    disturbed,
    flashed,
    of_reference,
    select,
    slcan_frames,
    slcan_text,
    vector,
)

from can_bus.frame import Frame

SEEDS = (0, 1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 5)))

RUN = SOURCE / "cortex_m3" / "run.py"
WITH_ARM = ROOT / "tools" / "with_arm"
NOT_TO_BE_HAD = 125


@pytest.fixture(scope="module", autouse=True)
def tools() -> Iterator[None]:
    """Compiler and emulator on the PATH, installed or fetched; their absence is an error where everything must run."""
    found = subprocess.run([WITH_ARM, "printenv", "PATH"], capture_output=True, text=True, timeout=280, check=False)
    if found.returncode == NOT_TO_BE_HAD and not os.environ.get("CI"):
        pytest.skip(found.stderr.strip())
    assert found.returncode == 0, found.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", found.stdout.strip())
        yield


@pytest.fixture(scope="module")
def build(tools: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the firmware is, built as the README says for this machine and for the board."""
    folder = tmp_path_factory.mktemp("cortex_m3")
    options = [f"BUILD={folder}", f"PYTHON={sys.executable}", "ARM_CFLAGS=-O2 -g -Wconversion"]
    done = subprocess.run(
        ["make", "all", "cortex-m3", *options], cwd=SOURCE, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "text" in done.stdout and "bss" in done.stdout  # the size
    return folder


@contextlib.contextmanager
def board(program: Path) -> Iterator[tuple[str, psutil.Process]]:
    """The emulated board as a device that runs by itself: the URL of its serial port, and the launcher."""
    command = [sys.executable, str(RUN), "--kernel", str(program)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip(), psutil.Process(process.pid)
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def port(build: Path) -> Iterator[serial.Serial]:
    """The serial port of a board."""
    with board(build / "fw.elf") as (url, _):
        path = url.removeprefix("slcan:").partition("@")[0]
        with serial.Serial(path, timeout=60.0, write_timeout=60.0) as opened:
            yield opened


@contextlib.contextmanager
def writing(port: serial.Serial, text: bytes) -> Iterator[None]:
    """Write while the caller reads; neither end of the line holds all of it."""
    writer = threading.Thread(target=port.write, args=(text,))
    writer.start()
    yield
    writer.join()


def answers(port: serial.Serial, heard: Sequence[Frame], before: bytes = b"C\r") -> list[Frame]:
    """What the board says to these frames, from the opening of its channel on."""
    with writing(port, before + b"O\r" + slcan_text(heard) + b"V\r"):
        said = port.read_until(b"V0101\r")  # the version comes when everything before it is answered
    assert said.endswith(b"V0101\r")
    return slcan_frames(said)


# ---- the same frames


def test_the_golden_vectors(port: serial.Serial) -> None:
    heard, said = vector()
    found = answers(port, heard)[4:]  # HB_CTRL of the start; HB_CTRL, CTRL_Info, SYNC_Done
    assert len(select(said, BASAL_CMD)) == 288
    assert found == said


def test_a_board_whose_bench_does_not_read_loses_nothing(port: serial.Serial) -> None:
    """It cannot send, its buffer of what came is full, and the line is held up: all of it goes on from there."""
    lines = random.Random(1).choices([b"", b"V"], k=20_000)
    with writing(port, b"C\r" + b"".join(line + b"\r" for line in lines)):
        time.sleep(3.0)  # to let it come to that
        expected = b"\r" + b"".join(b"V0101\r" if line else b"\r" for line in lines)
        assert port.read(len(expected)) == expected


def test_a_bench_that_was_killed_left_the_channel_open(port: serial.Serial) -> None:
    heard, said = vector()
    found = answers(port, heard, before=b"C\rO\r" + slcan_text(heard[:500]))
    assert found[-len(said) :] == said
    assert [frame for frame in found if frame == found[0]][:4] == [found[0]] * 4  # two starts and two roll calls


@pytest.mark.parametrize("seed", SEEDS)
def test_a_disturbed_day_ends_as_with_the_reference(port: serial.Serial, seed: int) -> None:
    heard = [frame for frame in disturbed(vector()[0], seed) if not frame.is_error]  # of which slcan has none
    assert comparable(answers(port, heard)) == comparable(of_reference(heard))


@pytest.mark.parametrize("seed", SEEDS)
def test_any_calibration_gives_the_echoes_and_the_doses_of_the_reference(port: serial.Serial, seed: int) -> None:
    """Products of 64 bits, their saturation and their rounding are another machine's here."""
    heard = flashed(vector()[0], any_calibration(random.Random(seed)))
    assert comparable(answers(port, heard)) == comparable(of_reference(heard))


def run(pumpbench: Pumpbench, out: Path, *arguments: str | Path, status: int = 0) -> RunFolder:
    done = pumpbench("run", *arguments, "--out", out, timeout=240.0)
    assert done.returncode == status, done.stderr + done.stdout
    return RunFolder.load(out)


@pytest.mark.parametrize(
    ("days", "faults"),
    [("1", ""), pytest.param("0.25", DROPPED, marks=pytest.mark.nightly)],
    ids=["a day", "an hour without samples"],
)
def test_a_day_is_the_same_to_the_last_bit(
    build: Path, pumpbench: Pumpbench, runs: Path, days: str, faults: str
) -> None:
    options: list[str | Path] = ["--strategy", "nma", "--days", days, "--seed", "1"]
    if faults:
        (runs / "faults.yaml").write_text(faults)
        options += ["--faults", runs / "faults.yaml"]
    emulated = f"{sys.executable} {RUN} --kernel {build / 'fw.elf'} {{bus}}"
    folders = (
        run(pumpbench, runs / "m3", *options, "--firmware", emulated),
        run(pumpbench, runs / "x86", *options, "--firmware", f"{build / 'firmware'} {{bus}}"),
        run(pumpbench, runs / "python", *options, "--bus", "inproc"),
    )
    assert len(select(folders[0].frames.frames(), BASAL_CMD)) == round(288 * float(days))
    assert len({folder.info["trace_sha256"] for folder in folders}) == 1


RESTART = "faults:\n  - {kind: restart, start: '01:00'}\n  - {kind: hang, start: '02:00', end: '02:30'}\n"


def test_a_board_without_power_or_time_is_a_process_without_them(build: Path, pumpbench: Pumpbench, runs: Path) -> None:
    """Of the run in which it restarts nothing is left to the C firmware, which is a hazard (H8)."""
    (runs / "faults.yaml").write_text(RESTART)
    options = ("--strategy", "nma", "--days", "0.125", "--seed", "1", "--faults", runs / "faults.yaml")
    emulated = f"{sys.executable} {RUN} --kernel {build / 'fw.elf'} {{bus}}"
    commands = {"m3": emulated, "x86": f"{build / 'firmware'} {{bus}}"}
    folders = [
        run(pumpbench, runs / name, *options, "--firmware", command, status=1) for name, command in commands.items()
    ]
    assert len({folder.info["trace_sha256"] for folder in folders}) == 1


@pytest.mark.nightly
def test_one_board_on_its_serial_port_does_one_run_after_the_other(
    build: Path, pumpbench: Pumpbench, runs: Path
) -> None:
    short = ("--strategy", "nma", "--days", "0.05", "--seed", "1")
    with board(build / "fw.elf") as (url, _):
        buses = (url, url, url.partition("@")[0])
        folders = [
            run(pumpbench, runs / str(n), *short, "--bus", bus, "--firmware", "none") for n, bus in enumerate(buses)
        ]
    folders.append(run(pumpbench, runs / "python", *short, "--bus", "inproc"))
    assert len({folder.info["trace_sha256"] for folder in folders}) == 1


SHORT_SUITE = "SEN-01,SEN-03,SEN-04,E2E-01,E2E-02,E2E-07,CMD-08,LIM-01,FAL-01,FAL-02,FAL-04,ALM-03,TIM-01,TIM-04,NUM-02"


def test_it_conforms(build: Path, pumpbench: Pumpbench) -> None:
    """A device behind a serial adapter, as far as the bench can tell."""
    with board(build / "fw.elf") as (url, _):
        options = ["--bus", url, "--firmware", "none", "--only", SHORT_SUITE, "--modes", "nma", "--json", "-"]
        done = pumpbench("conformance", *options, timeout=300.0)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)["requirements"]
    assert {each["verdict"] for each in told} == {"passed"}
    assert len(told) == len(SHORT_SUITE.split(","))


# ---- a board that dies or babbles


def emulators(parent: psutil.Process) -> list[psutil.Process]:
    found = []
    with contextlib.suppress(psutil.NoSuchProcess):
        for process in parent.children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                if process.name().startswith("qemu-system-arm"):
                    found.append(process)
    return found


def kill_emulator_when_it_works(parent: psutil.Process, running: "subprocess.Popen[str]") -> list[psutil.Process]:
    """SIGKILL once it has computed for as long as some hours of a patient take; the processes of the run until then."""
    deadline = time.monotonic() + 120.0
    before = None
    while running.poll() is None and time.monotonic() < deadline:
        for emulator in emulators(parent):
            spent = sum(emulator.cpu_times()[:2])
            before = spent if before is None else before
            if spent > before + 1.0:
                children = psutil.Process(running.pid).children(recursive=True)
                emulator.send_signal(signal.SIGKILL)
                return children
        time.sleep(0.05)
    pytest.fail(f"no emulator at work; the run's status: {running.poll()}")


def assert_broken_off(running: "subprocess.Popen[str]", children: list[psutil.Process], text: str, out: Path) -> None:
    _, stderr = running.communicate(timeout=60)
    assert running.returncode == 3, stderr
    assert text in stderr
    assert len(stderr.strip().splitlines()) == 1, stderr
    assert not out.exists()
    assert children
    _, alive = psutil.wait_procs(children, timeout=10)
    assert not alive


@contextlib.contextmanager
def fortnight(*arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    """A run that does not end by itself while a test waits."""
    command = [sys.executable, "-m", "pumpbench", "run", "--strategy", "nma", "--days", "14", *map(str, arguments)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as running:
        try:
            yield running
        finally:
            running.terminate()


@pytest.mark.nightly
def test_a_killed_emulator_ends_the_run(build: Path, runs: Path) -> None:
    emulated = f"{sys.executable} {RUN} --kernel {build / 'fw.elf'} {{bus}}"
    with fortnight("--firmware", emulated, "--out", runs / "out") as running:
        children = kill_emulator_when_it_works(psutil.Process(running.pid), running)
        assert_broken_off(running, children, "the firmware ended with status 3", runs / "out")


def test_a_killed_emulator_ends_the_run_on_its_serial_port(build: Path, runs: Path) -> None:
    with (
        board(build / "fw.elf") as (url, launcher),
        fortnight("--bus", url, "--firmware", "none", "--out", runs / "out") as running,
    ):
        children = kill_emulator_when_it_works(launcher, running)
        assert_broken_off(running, children, "the gateway ended with status 3", runs / "out")
        assert launcher.wait(timeout=10) == 3


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_emulator_goes_with_its_launcher(build: Path, number: signal.Signals) -> None:
    with board(build / "fw.elf") as (_, launcher):
        (emulator,) = emulators(launcher)
        launcher.send_signal(number)
        _, alive = psutil.wait_procs([emulator], timeout=10)
    assert not alive


BABBLER = """
#include "device.h"
#include "protocol.h"
#include "serial.h"
#include "uart.h"

static struct firmware firmware;
static struct frame heard[TRANSPORT_BATCH], answer[FIRMWARE_FRAMES_AT_MOST];

int main(void)
{
    size_t n;
    uart_start();
    (void)transport_slcan.open("slcan:");
    firmware_start(&firmware, answer, &n);
    (void)transport_slcan.send(answer, n);
    while (firmware.supervisor.step < STEP) {
        (void)transport_slcan.receive(heard);
        (void)firmware_receive(&firmware, heard, answer, &n);
        (void)transport_slcan.send(answer, n);
    }
    for (;;) {
        (void)serial_write((const uint8_t *)TEXT, sizeof TEXT - 1u);
    }
}
"""

BABBLES = {
    "lines from the start": (-1, r"assertion failed: main.c:17\r", "waited 3 s for CTRL to answer the roll call"),
    "lines in a run": (20, r"assertion failed: main.c:17\r", "waited 3 s for CTRL to answer step 2"),
    "no line ends": (20, "assertion failed: main.c:17 ", "this is no slcan: no line end in 512 characters"),
    "what begins like a frame": (20, r"t7012ZZ00\r", "a frame was lost: unreadable line b't7012ZZ00'"),
    "frames": (20, r"t70120000\r", "waited 3 s for CTRL to answer step 2"),
}
"""The step from which on it babbles, what, and the verdict."""


@pytest.mark.parametrize("way", [pytest.param("hub", marks=pytest.mark.nightly), "serial port"])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.nightly] if name in ("lines in a run", "frames") else [])
        for name in BABBLES
    ],
)
def test_a_board_that_babbles_ends_with_a_verdict(
    name: str, way: str, build: Path, pumpbench: Pumpbench, runs: Path
) -> None:
    step, text, verdict = BABBLES[name]
    source, program = runs / "babbler.c", runs / "babbler.elf"
    source.write_text(f'#define STEP {step}\n#define TEXT "{text}"\n{BABBLER}')
    own = {"main.o", "device.o"}
    objects = [path for path in (build / "arm").rglob("*.o") if path.name not in own]
    command = ["arm-none-eabi-gcc", "-mcpu=cortex-m3", "-mthumb", "-ffreestanding", "-nostdlib", "-Wl,--gc-sections"]
    include = [f"-I{place}" for place in (SOURCE, SOURCE / "cortex_m3", build)]
    script = SOURCE / "cortex_m3" / "link.ld"
    subprocess.run([*command, *include, "-T", script, "-o", program, source, *objects, "-lgcc"], check=True, timeout=60)
    patience = ("--connect-timeout", "3" if step < 0 else "60", "--step-timeout", "3")
    options = ("--strategy", "nma", *patience, "--out", runs / "out")
    if way == "hub":
        emulated = f"{sys.executable} {RUN} --kernel {program} {{bus}}"
        done = pumpbench("run", *options, "--firmware", emulated)
    else:
        with board(program) as (url, _):
            done = pumpbench("run", *options, "--bus", url, "--firmware", "none")
    assert done.returncode == 3, done.stderr
    assert verdict in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert not (runs / "out").exists()
    assert not [each for each in psutil.process_iter(["cmdline"]) if str(program) in (each.info["cmdline"] or ())]


# ---- what is missing is said


def test_the_launcher_says_what_is_missing(build: Path, tmp_path: Path) -> None:
    for arguments, text in (
        (["--kernel", tmp_path / "fw.elf"], "no such file; make it with `make -C examples/c_firmware cortex-m3`"),
        (["--kernel", build / "fw.elf", "--qemu", "no-such-qemu"], "there is no no-such-qemu: install it"),
    ):
        done = subprocess.run(
            [sys.executable, RUN, *arguments], capture_output=True, text=True, timeout=20, check=False
        )
        assert done.returncode == 2
        assert text in done.stderr


def test_with_arm_says_what_is_missing(tmp_path: Path) -> None:
    bare = {"PATH": str(tmp_path), "HOME": str(tmp_path)}
    for arguments, environment, text in (
        ([], None, "usage"),
        (["--what"], None, "usage"),
        (["true"], bare, "no apt-get to fetch gcc-arm-none-eabi qemu-system-arm"),
        (["true"], {"PATH": str(tmp_path)}, "no HOME: set PUMPBENCH_CACHE"),
    ):
        done = subprocess.run(
            ["/bin/bash", WITH_ARM, *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
        assert done.returncode == NOT_TO_BE_HAD
        assert text in done.stderr
    assert subprocess.run([WITH_ARM, "--", "sh", "-c", "exit 7"], timeout=20, check=False).returncode == 7
