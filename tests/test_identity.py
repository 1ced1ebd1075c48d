"""Which firmware a result is of: hashes of its files, and what it says of itself."""

import hashlib
import json
import os
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench.capture import Capture
from pumpbench.identity import firmware_sha256, stated, versions
from synthetic_capture import Loop

import dbc
from can_bus.codec import Transmitter
from can_bus.frame import Frame

SNA = {
    "CtrlProtocolMajor": 63, "CtrlProtocolMinor": 63, "FirmwareMajor": 255, "FirmwareMinor": 255,
    "FirmwareBuild": 16777215,
}  # fmt: skip


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_files_named_in_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, table = tmp_path / "firmware", tmp_path / "table.bin"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    table.write_bytes(b"\x01")
    command = f"{program} {{bus}} --table {table} --name nothing"
    assert firmware_sha256(command) == {str(program): sha256(program), str(table): sha256(table)}
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert firmware_sha256("firmware {bus}") == {"firmware": sha256(program)}
    program.write_text("#!/bin/sh\nexit 1\n")
    assert firmware_sha256("firmware {bus}") == {"firmware": sha256(program)}
    assert firmware_sha256("not-there {bus}") == {}


def test_a_device_that_runs_by_itself_has_no_files_and_the_reference_its_sources() -> None:
    assert firmware_sha256("none") == {}
    (name, digest), *more = firmware_sha256(None).items()
    assert (name, len(digest), more) == ("firmware_sim", 64, [])


def test_what_a_device_says_of_itself() -> None:
    said = SNA | {"FirmwareMajor": 3, "FirmwareMinor": 14, "CtrlProtocolMajor": 1, "CtrlProtocolMinor": 3}
    assert stated(said) == {"version": "3.14", "build": None, "protocol": "1.3"}
    assert stated(SNA | {"FirmwareBuild": 7}) == {"version": None, "build": 7, "protocol": None}
    assert stated(None) is None


def test_the_capture_keeps_what_answers_the_roll_call() -> None:
    capture = Capture()
    assert capture.device_info() is None
    good = Transmitter().frame("CTRL_Info", **(SNA | {"FirmwareMajor": 2, "FirmwareMinor": 5}))
    capture.extend(0, [Frame(good.can_id, bytes([good.data[0] ^ 1]) + good.data[1:]), good])
    info = capture.device_info()
    assert info is not None
    assert (info["FirmwareMajor"], info["FirmwareMinor"]) == (2, 5)
    made = Loop(2).run()
    assert stated(made.device_info()) == {"version": "0.1", "build": None, "protocol": "1.0"}
    assert 0x302 not in made.finish().can_id


@pytest.mark.parametrize("bus", ["inproc", "hub"])
def test_a_run_folder_says_it(pumpbench: Pumpbench, runs: Path, bus: str) -> None:
    done = pumpbench("run", "--days", "0.05", "--bus", bus, "--out", "run")
    assert done.returncode == 0, done.stderr
    info = json.loads((runs / "run" / "run.json").read_text())
    assert info["device"] == {"version": "0.2", "build": 0, "protocol": "1.3"}
    assert info["firmware_sha256"] == firmware_sha256(None)
    assert {key: info[key] for key in versions()} == versions()
    assert info["dbc_crc32"] == f"{dbc.crc32():08x}"


def test_a_conformance_report_says_it_too(pumpbench: Pumpbench) -> None:
    done = pumpbench("conformance", "--only", "SEN-02,TIM-05", "--json", "-")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["device"] == {"version": "0.2", "build": 0, "protocol": "1.3"}
    assert told["firmware_sha256"] == firmware_sha256(None)
    assert {key: told[key] for key in versions()} == versions()
    assert (told["only"], told["catalogue"]) == ("SEN-02,TIM-05", 90)
    row = told["requirements"][0]
    assert row["requirement"].startswith("A sample dated after the current step")
    assert row["hazards"] == ["H3"]
    assert row["check"].startswith("A good frame whose CgmSampleStep is ahead")
