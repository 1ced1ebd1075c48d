"""The Rerun recording, read back as data; how it looks is in test_looks.py."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pumpbench.candump import read_candump, write_candump
from pumpbench.capture import Capture
from pumpbench.frames import Frames
from pumpbench.recording.columns import describe
from pumpbench.recording.file import APPLICATION, write_recording
from pumpbench.recording.snapshot import Shot, snapshot
from pumpbench.recording.tool import RecordingError, quiet_environment, rerun_binary
from pumpbench.story import clock, notes, state_changes
from pumpbench.trace import Trace
from rerun.chunk import RrdReader
from synthetic_capture import Loop, as_frames, dropping, random_frames

import dbc
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame

STEPS = 200
INFO = {"patient": "adult#001", "strategy": "s2", "scenario": "synthetic", "seed": 1, "faults": [{"kind": "drop"}]}


class Run:
    def __init__(self, frames: Frames, path: Path) -> None:
        self.frames, self.path = frames, path
        self.trace = Trace.from_frames(frames, INFO)
        write_recording(self.trace, frames, path, {"tir_70_180": 87.5})
        self.reader = RrdReader(path)

    def columns(self, entity: str) -> dict[str, list[Any]]:
        """All rows of an entity: component -> values, `sim_time` in seconds."""
        found: dict[str, list[Any]] = {}
        for chunk in self.reader.stream().filter(content=entity, is_static=False):
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name == "sim_time":
                    values = (batch.column(name).cast(pa.int64()).to_numpy(zero_copy_only=False) / 1e9).tolist()
                elif name.startswith("rerun."):
                    continue
                else:
                    values = [row[0] if row else None for row in batch.column(name).to_pylist()]
                found.setdefault(name, []).extend(values)
        return found

    def entities(self) -> set[str]:
        return {str(chunk.entity_path) for chunk in self.reader.stream()}

    def series(self, entity: str) -> dict[float, float]:
        columns = self.columns(entity)
        return dict(zip(columns["sim_time"], columns["Scalars:scalars"], strict=True))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    made = Loop(STEPS, occlusion=range(150, 162), faults=dropping("CGM_Reading", range(24, 36)))
    yield Run(made.run().finish(), tmp_path_factory.mktemp("run") / "recording.rrd")


def test_every_frame_is_in_the_recording_as_it_is_in_the_log(run: Run, tmp_path: Path) -> None:
    write_candump(run.frames, tmp_path / "bus.log")
    logged = read_candump(tmp_path / "bus.log")
    total = 0
    for channel in (0, 1):
        table = run.columns(f"/can/can{channel}")
        rows = np.flatnonzero(logged.channel == channel)
        assert table["sim_time"] == pytest.approx(logged.time_s[rows].tolist(), abs=1e-6)
        assert [int(ident, 16) for ident in table["id"]] == logged.can_id[rows].tolist()
        assert [bytes.fromhex(data) for data in table["data"]] == [frame.data for frame in logged.frames(channel)]
        assert table["step"] == logged.step[rows].tolist()
        total += len(rows)
    assert total == len(run.frames)


def test_rerun_verifies_it(run: Run, tmp_path: Path) -> None:
    result = subprocess.run(
        [rerun_binary(), "rrd", "verify", run.path], env=quiet_environment(tmp_path), capture_output=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_series_are_the_columns_of_the_trace(run: Run) -> None:
    columns, time_s = run.trace.columns, run.trace.time_s.tolist()
    for entity, values in (
        ("/glucose/true", columns["TruthGlucose"]),
        ("/insulin/rate_commanded", columns["InsulinRate"]),
        ("/insulin/delivered", run.trace.basal_delivered("Insulin")),
        ("/pramlintide/delivered", run.trace.basal_delivered("Pram")),
        ("/stomach/eta", columns["TruthEta"] * 100),
        ("/body/insulin_on_board", columns["InsulinOnBoard"]),
    ):
        assert np.array_equal(list(run.series(entity).values()), values, equal_nan=True), entity
        assert list(run.series(entity)) == time_s
    received = {time: value for time, value in zip(time_s, columns["GlucoseConc"], strict=True) if value == value}
    assert run.series("/glucose/cgm") == received
    assert not set(range(24, 36)) & {time / 300 for time in received}
    assert set(run.series("/limits/70").values()) == {70.0}
    commanded, delivered = run.series("/insulin/bolus_commanded"), run.series("/insulin/bolus_delivered")
    assert set(commanded) - set(delivered) == {156 * 300.0}  # the bolus during the occlusion
    assert run.series("/bus/frames/0")[300 * 50.0] == np.sum((run.frames.step == 50) & (run.frames.channel == 0))


def test_states_faults_and_log(run: Run) -> None:
    lane = run.columns("/state/1_firmware")
    assert list(zip(lane["sim_time"], lane["StateChange:state"], strict=True)) == [
        (0.0, "Auto"),
        (24 * 300.0, "Degraded"),
        (36 * 300.0, "Auto"),
    ]
    assert run.columns("/state/3_sensor")["StateChange:state"] == ["Ok", "", "Ok"]
    assert run.columns("/state/5_insulin_line")["StateChange:state"] == ["Clear", "Occluded", "Clear"]
    fault = run.columns("/fault/Drop_CGM_Reading")
    assert list(zip(fault["sim_time"], fault["StateChange:state"], strict=True)) == [(7200.0, "Drop"), (10800.0, "")]
    alarm = run.columns("/alarm/Occlusion_PUMP")
    assert [time // 300 for time in alarm["sim_time"]] == [150, 162]
    assert alarm["StateChange:state"] == ["Pending", ""]
    assert run.columns("/alarm/CgmLost_CTRL")["StateChange:state"] == ["Pending"]
    log = run.columns("/log")
    lines = list(zip(log["TextLog:level"], log["TextLog:text"], strict=True))
    assert ("FAULT", "d0 02:00  Drop CGM_Reading for 60 min") in lines
    assert ("ALARM", "d0 02:00  CTRL CgmLost pending (medium)") in lines
    assert ("ALARM", "d0 12:30  PUMP Occlusion pending (high)") in lines
    assert ("ALARM", "d0 13:30  PUMP Occlusion over (high)") in lines
    assert ("MEAL", "d0 08:00  45 g of carbohydrate") in lines
    assert log["sim_time"] == sorted(log["sim_time"])


def test_blueprint_and_what_it_shows(run: Run) -> None:
    assert [entry.application_id for entry in run.reader.blueprints()] == [APPLICATION]
    assert len(run.reader.recordings()) == 1
    entities = run.entities()
    shown = ("glucose", "limits", "insulin", "pramlintide", "stomach", "state", "fault", "log", "bus", "can", "run")
    for group in shown:
        assert any(entity.split("/")[1] == group for entity in entities), group


def test_the_same_run_gets_the_same_id(run: Run, tmp_path: Path) -> None:
    again = Run(run.frames, tmp_path / "again.rrd")
    ids = [reader.recordings()[0].recording_id for reader in (run.reader, again.reader)]
    assert ids[0] == ids[1]


def test_odd_frames_and_damaged_ones(tmp_path: Path) -> None:
    made = Loop(5)
    made.run()
    odd = [
        Frame(0x18DAF110 | CAN_EFF_FLAG, b"\xff" * 8),
        Frame(0x100 | CAN_RTR_FLAG, bytes(8)),
        Frame(0x80 | CAN_ERR_FLAG, bytes(8)),
        Frame(0x7FF, b""),
        Frame(0x100, bytes(8)),
    ]
    made.capture.extend(0, odd)
    odd_run = Run(made.capture.finish(), tmp_path / "odd.rrd")
    table = odd_run.columns("/can/can0")
    assert table["data"][-5:] == ["FF " * 7 + "FF", "00 " * 7 + "00", "00 " * 7 + "00", "", "00 " * 7 + "00"]
    assert table["TextLog:level"][-5:] == ["unknown!", "unknown!", "unknown!", "unknown!", "CGM_Reading!"]
    assert sum(odd_run.series("/bus/errors/refused_0").values()) == 5


@pytest.mark.parametrize("steps", [0, 1])
def test_hardly_any_run(tmp_path: Path, steps: int) -> None:
    frames = Loop(steps).run().finish() if steps else Capture().finish()
    Run(frames, tmp_path / "short.rrd")


def test_no_room_is_said_clearly(run: Run, tmp_path: Path) -> None:
    with pytest.raises((RecordingError, OSError)):
        write_recording(run.trace, run.frames, tmp_path / "no such folder" / "recording.rrd")


def test_text_of_a_frame_says_what_cantools_says() -> None:
    named = list(random_frames(4))
    frames = as_frames([frame for _, frame in named])
    for (name, frame), text in zip(named, describe(frames), strict=True):
        decoded = dbc.load().get_message_by_name(name).decode(frame.data)
        said = {part.split("=")[0] for part in text.split() if "=" in part}
        assert said == set(decoded) - {"CHECKSUM", "COUNTER"}
        for signal, value in decoded.items():
            if signal in said and not isinstance(value, int | float):
                assert f"{signal}={value}" in text
    assert describe(as_frames([Frame(0x100, bytes(8))])) == [""]


def test_notes_and_clock(run: Run) -> None:
    assert clock(0) == "d0 00:00"
    assert clock(13 * 86400 + 23 * 3600 + 59 * 60 + 59) == "d13 23:59"
    assert {note.kind for note in notes(run.trace)} == {"ALARM", "FAULT", "MEAL", "STATE"}
    assert state_changes(run.trace, "NoSuchSignal", "CTRL_Status") == []


def test_snapshot_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.rrd is missing"):
        snapshot(tmp_path / "none.rrd", [Shot(tmp_path / "shot.png")])


def test_only_who_writes_a_recording_imports_rerun() -> None:
    code = (
        "import sys\nfrom pumpbench import candump, capture, runfolder, story, trace\n"
        "from pumpbench.pictures import summary\n"
        "from pumpbench.recording import columns, file, scene, snapshot, still\n"
        "print([m for m in ('rerun', 'matplotlib', 'pyarrow', 'cantools') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
