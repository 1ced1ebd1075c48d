"""A firmware built for another version of the protocol is told so at once, by both sides."""

import contextlib
import logging
import re
import sys
import threading
import time
from pathlib import Path

import pytest
from bench import Bench
from conftest import Pumpbench
from pumpbench.calibration import MODES, calibrate

import dbc
from can_bus.codec import Transmitter
from can_bus.link import BusLost
from can_bus.lockstep import Done, Phase
from can_bus.url import open_link
from firmware_sim.firmware import Firmware
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.serve import serve
from plant_server.server import PlantError, PlantServer, Run

MAJOR, MINOR = dbc.protocol_version()
OURS = rf"this bench speaks {MAJOR}\.{MINOR}"
NOT_SAID = (63, 63)


def new_plant(steps: int = 2) -> PlantServer:
    patient = load_patient("adult#001")
    return PlantServer(Run(patient, load_scenario("fasting"), steps, 1, MODES["nma"], calibrate(patient)))


def join(version: tuple[int, int] | None, status: Done = Done.OK) -> list[object]:
    """A device of this version answers the roll call; what the plant sends then."""
    plant, said = new_plant(), Transmitter()
    plant.call_roll()
    if version is not None:
        major, minor = version
        assert not plant.receive(said.frame("CTRL_Info", CtrlProtocolMajor=major, CtrlProtocolMinor=minor))
    return list(plant.receive(said.frame("SYNC_Done", DoneStatus=status, DoneStepIndex=1, TxCount=1)))


# ---- the bench's side


@pytest.mark.parametrize("version", [(MAJOR - 1, 9), (MAJOR + 1, 0)])
@pytest.mark.parametrize("status", [Done.OK, Done.FAULT])
def test_the_bench_refuses_another_major_version(version: tuple[int, int], status: Done) -> None:
    with pytest.raises(PlantError, match=rf"built for protocol {version[0]}\.{version[1]}, {OURS}: rebuild"):
        join(version, status)


@pytest.mark.parametrize(
    ("version", "unaware"), [((MAJOR, MINOR - 1), "the firmware"), ((MAJOR, MINOR + 1), "this bench")]
)
def test_the_bench_goes_on_with_another_minor_version_and_says_so(
    version: tuple[int, int], unaware: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert join(version)
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    text = rf"CTRL was built for protocol {version[0]}\.{version[1]}, {OURS}: {unaware} does not know what was added"
    assert re.match(text, record.getMessage())


@pytest.mark.parametrize("version", [(MAJOR, MINOR), None, NOT_SAID])
def test_the_bench_has_nothing_to_say_of_its_own_version_or_of_none(
    version: tuple[int, int] | None, caplog: pytest.LogCaptureFixture
) -> None:
    assert join(version)
    assert not caplog.records


@pytest.mark.parametrize(
    ("version", "said"),
    [
        (None, "does not say its version"),
        (NOT_SAID, "does not say"),
        ((MAJOR, MINOR), rf"built for protocol {MAJOR}\."),
    ],
)
def test_a_device_that_refuses_is_not_run(version: tuple[int, int] | None, said: str) -> None:
    with pytest.raises(PlantError, match=rf"CTRL refused the roll call with DoneStatus Fault; it .*{said}.*{OURS}"):
        join(version, Done.FAULT)


# ---- the device's side


def told(version: tuple[int, int], dbc_crc: int | None = None) -> tuple[int, list[tuple[str, str]]]:
    """DoneStatus of the reference firmware towards a bench of this version, and its log."""
    bench = Bench(start=False)
    lines: list[tuple[str, str]] = []
    bench.firmware.log = lambda level, _seconds, module, text: lines.append((level, f"{module}: {text}"))
    crc = dbc.crc32() if dbc_crc is None else dbc_crc
    bench.send("PLANT_Info", PlantProtocolMajor=version[0], PlantProtocolMinor=version[1], PlantDbcCrc=crc)
    return bench.token(Phase.INIT, 1).done["DoneStatus"], lines


@pytest.mark.parametrize("version", [(MAJOR - 1, 9), (MAJOR + 1, 0)])
def test_the_device_refuses_another_major_version(version: tuple[int, int]) -> None:
    major, minor = version
    text = f"version: refused: the bench speaks protocol {major}.{minor}, this firmware {MAJOR}.{MINOR}"
    assert told(version) == (Done.FAULT, [("error", text)])


@pytest.mark.parametrize("minor", [MINOR - 1, MINOR + 1])
def test_the_device_goes_on_with_another_minor_version_and_says_so(minor: int) -> None:
    text = f"version: the bench speaks protocol {MAJOR}.{minor}, this firmware {MAJOR}.{MINOR}"
    assert told((MAJOR, minor)) == (Done.OK, [("warn", text)])


def test_the_device_names_another_dbc_and_goes_on() -> None:
    text = f"version: the bench has another DBC: CRC 16909060, ours {dbc.crc32()}"
    assert told((MAJOR, MINOR), 0x01020304) == (Done.OK, [("warn", text)])


def test_the_device_has_nothing_to_say_of_its_own_version() -> None:
    assert told((MAJOR, MINOR)) == (Done.OK, [])
    assert told((MAJOR, MINOR), 0) == (Done.OK, [])  # a bench that does not state its DBC


# ---- as processes


def firmware_of(version: tuple[int, int], folder: Path) -> str:
    """The command of the reference firmware as it would be, built for this version."""
    path = folder / "firmware.py"
    path.write_text(
        f"import sys, dbc\ndbc.protocol_version = lambda: {version}\n"
        "from firmware_sim.__main__ import main\nsys.exit(main(['--bus', sys.argv[1]]))\n",
        encoding="utf-8",
    )
    return f"{sys.executable} {path} {{bus}}"


def test_a_run_with_another_major_version_ends_at_once(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("run", "--firmware", firmware_of((MAJOR + 1, 0), runs), "--days", 0.1, "--out", runs / "out")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert re.search(rf"built for protocol {MAJOR + 1}\.0, {OURS}: rebuild", done.stderr)
    assert not (runs / "out").exists()


def test_a_run_with_another_minor_version_says_so_in_one_line(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("run", "--firmware", firmware_of((MAJOR, MINOR + 1), runs), "--days", 0.1, "--out", runs / "out")
    assert (done.returncode, done.stderr.count("\n")) == (0, 1), done.stderr
    assert re.match(rf"CTRL was built for protocol {MAJOR}\.{MINOR + 1}, {OURS}", done.stderr)


# ---- a device that is slow to answer


def test_a_device_slower_than_the_roll_is_called_joins() -> None:
    """Its answer to every call comes when the next call is out already, with its counters begun anew each time."""
    url = "inproc:slow-device"

    def run_device() -> None:
        firmware = Firmware()
        with link, contextlib.suppress(BusLost):
            while not firmware.finished:
                for frame in link.recv(None):
                    if answer := firmware.receive(frame):
                        time.sleep(0.25 if firmware._step is None else 0)
                        link.send(answer)

    link = open_link(url)
    device = threading.Thread(target=run_device)
    device.start()
    plant = new_plant()
    with open_link(url) as plants:
        try:
            serve(plant, plants, connect_timeout=20)
        finally:
            link.close()
            device.join()
    assert plant.finished
    assert plant.late_answers >= 1
