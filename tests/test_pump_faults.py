"""Faults of the pump and of the sensor from the same fault file: they act, they are told, the ledger closes."""

import json
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import faults as fault_files
from pumpbench.runfolder import RunFolder

from can_bus.faults import Drop
from can_bus.yaml_file import FileError
from plant_server.faults import (
    AirBubble,
    DoubleStrokes,
    EmptyReservoir,
    LowBattery,
    MissedStrokes,
    Occlusion,
    SlowMotor,
)
from plant_server.sensors.effects import Stuck

EVERYTHING = """faults:
  - {kind: missed_strokes, start: "00:30", end: "01:00"}
  - {kind: double_strokes, start: "01:00", end: "01:30"}
  - {kind: slow_motor, start: "01:30", end: "02:00"}
  - {kind: drop, message: CGM_Reading, start: "02:00", end: "02:30"}
  - {kind: occlusion, start: "04:00", end: "09:00", lost: true}
  - {kind: air_bubble, drug: pramlintide, strokes: 12, start: "10:00"}
  - {kind: stuck, start: "11:00", end: "11:30"}
  - {kind: empty_reservoir, drug: pramlintide, start: "12:00"}
  - {kind: low_battery, percent: 3, start: "13:00"}
"""


def test_a_file_is_sorted_by_where_its_faults_act(tmp_path: Path) -> None:
    file = tmp_path / "faults.yaml"
    file.write_text(EVERYTHING)
    faults = fault_files.load(file)
    assert [type(fault) for fault in faults.wire] == [Drop]
    motor = [MissedStrokes, DoubleStrokes, SlowMotor]
    assert [type(fault) for fault in faults.pump] == [*motor, Occlusion, AirBubble, EmptyReservoir, LowBattery]
    assert [type(fault) for fault in faults.sensor] == [Stuck]
    fault_files.write_wire(faults, tmp_path / "wire.yaml")
    assert fault_files.load(tmp_path / "wire.yaml") == fault_files.Faults(wire=faults.wire)
    again = tmp_path / "again.yaml"
    again.write_text(json.dumps({"faults": faults.as_json()}))
    assert fault_files.load(again) == faults


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('faults: [{kind: occlusion, start: "05:00", end: "04:00"}]', "end must be later than start"),
        ('faults:\n  - {kind: occlusoin, start: "05:00"}', "2: faults.0"),
        ('faults: [{kind: air_bubble, start: "05:00", strokes: 0}]', "strokes"),
        ('faults: [{kind: low_battery, start: "05:00", percent: 101}]', "percent"),
        ('faults: [{kind: occlusion, start: "05:00", drug: glucagon}]', "drug"),
        ("faults: [{kind: occlusion}]", "start"),
    ],
)
def test_wrong_entries_are_named(text: str, expected: str, tmp_path: Path) -> None:
    file = tmp_path / "faults.yaml"
    file.write_text(text)
    with pytest.raises(FileError, match=expected) as error:
        fault_files.load(file)
    assert str(file) in str(error.value)


def test_all_of_them_in_one_run_on_hub_and_inproc(pumpbench: Pumpbench, runs: Path) -> None:
    file = runs / "faults.yaml"
    file.write_text(EVERYTHING)
    folders = {}
    for bus in ("hub", "inproc"):
        done = pumpbench("run", "--bus", bus, "--faults", file, "--out", runs / bus)
        assert done.returncode == 0, done.stderr + done.stdout
        folders[bus] = RunFolder.load(runs / bus)
    assert folders["hub"].info["trace_sha256"] == folders["inproc"].info["trace_sha256"]
    folder = folders["hub"]
    trace = folder.trace
    ledger = folder.metrics["safety"]["ledger"]
    assert ledger["insulin"]["closes"]
    assert ledger["pramlintide"]["closes"]
    assert ledger["insulin"]["lost"] > 60  # at least what was held back until the pump noticed
    assert ledger["pramlintide"]["lost"] >= 12
    assert folder.metrics["safety"]["hazards"]["H6"] == 0
    occluded = trace.get("InsulinOcclusion")
    assert occluded[60] in (0, 1)  # not noticed within an hour
    assert 2 in occluded[60:108]
    assert set(occluded[110:]) == {0}  # the new set is free
    assert not trace.get("InsulinDelivered")[49:108].any()
    assert {(event.code, event.node) for event in trace.alarms} >= {
        ("Occlusion", "PUMP"), ("ReservoirEmpty", "PUMP"), ("BatteryLow", "PUMP"), ("BatteryEmpty", "PUMP"),
    }  # fmt: skip
    kinds = [event.kind for event in trace.faults]
    assert kinds.count("Occlusion") == 60  # told in every step it lasts
    assert {"Drop", "AirBubble", "EmptyReservoir", "LowBattery"} <= set(kinds)
    assert [kinds.count(kind) for kind in ("MissedStrokes", "DoubleStrokes", "SlowMotor", "SensorStuck")] == [6] * 4
    glucose = trace.get("GlucoseConc")
    assert len(set(glucose[133:138])) == 1  # stuck
    assert trace.get("PumpState")[-2] == 5  # the battery ran out


def test_the_example_runs(pumpbench: Pumpbench, runs: Path) -> None:
    example = Path(__file__).parents[1] / "examples" / "occlusion.yaml"
    done = pumpbench("run", "--bus", "inproc", "--faults", example, "--out", runs / "out")
    assert done.returncode == 0, done.stderr
    assert RunFolder.load(runs / "out").info["faults"][0]["kind"] == "occlusion"
