"""What is drawn of a run while it is on is what is drawn of it afterwards."""

import random
from pathlib import Path

import pyarrow as pa
import pytest
from live_bus import free_port
from pumpbench.capture import Capture, Follower
from pumpbench.frames import Frames
from pumpbench.recording.file import write_recording
from pumpbench.recording.live import LiveRecording
from pumpbench.trace import Trace
from rerun.chunk import RrdReader
from synthetic_capture import Loop, dropping

from can_bus import codec
from can_bus.frame import Frame, pack

Rows = dict[str, dict[float, list[dict[str, str]]]]


def read(path: Path) -> Rows:
    """Entity -> simulated seconds -> rows; what holds at all times stands at -1."""
    found: Rows = {}
    for chunk in RrdReader(path).stream():
        batch, entity = chunk.to_record_batch(), str(chunk.entity_path)
        names = [name for name in batch.schema.names if not name.startswith("rerun.") and name != "sim_time"]
        times = [-1.0] * batch.num_rows
        if not chunk.is_static:
            times = [nanos / 1e9 for nanos in batch.column("sim_time").cast(pa.int64()).to_pylist()]
        for row, time_s in enumerate(times):
            values = {name: str(batch.column(name)[row].as_py()) for name in names}  # as text NaN equals NaN
            rows = found.setdefault(entity, {}).setdefault(time_s, [])
            if chunk.is_static and rows:
                rows[0].update(values)  # the later one counts
            else:
                rows.append(values)
    return found


def drawn(
    sent: list[tuple[int, Frame]], folder: Path, seed: int, lengths: tuple[int, ...] = (20, 60, 200, 1500)
) -> tuple[Rows, Rows]:
    """The same frames drawn as they come, in batches of many lengths, and all at once."""
    channels = 1 + max(channel for channel, _ in sent)
    recording = LiveRecording(folder / "live.rrd", free_port(), {"patient": "adult#001"}, gateway=channels > 1)
    follower, capture, rng = Follower(channels), Capture(), random.Random(seed)
    position = 0
    while position < len(sent):
        batch = sent[position : position + rng.choice(lengths)]
        position += len(batch)
        for channel, frame in batch:
            follower.extend(channel, pack([frame]))
            capture.extend(channel, [frame])
        recording.draw(follower.take())
    recording.draw(follower.take(over=True))
    recording.close()
    frames = capture.finish()
    write_recording(Trace.from_frames(frames, {"patient": "adult#001"}), frames, folder / "whole.rrd")
    return read(folder / "live.rrd"), read(folder / "whole.rrd")


@pytest.mark.parametrize("seed", range(3))
def test_live_and_afterwards_the_same(seed: int, tmp_path: Path) -> None:
    loop = Loop(200, occlusion=range(150, 162), faults=dropping("CGM_Reading", range(24, 50)))
    live, whole = drawn(loop.run_frames(), tmp_path, seed)
    assert live.keys() <= whole.keys()
    assert {entity.split("/")[1] for entity in whole.keys() - live.keys()} == {"closeup"}  # made when all is known
    end_s = 200 * 300.0
    for entity in live.keys() - {"/__properties", "/__properties/scene"}:
        now, then = live[entity], whole[entity]
        if entity.startswith("/limits/"):  # a line of two points would be none before its end is known
            assert now.keys() - {-1.0} == {300.0 * step for step in range(201)}
        elif entity == "/log":  # how long a fault lasts is known when it is over
            assert {time for time in now if now[time] != then[time]} == {24 * 300.0}
        elif entity == "/state/5_insulin_line":  # is shown from the first hour in which something is wrong with it
            changes = [rows[0]["StateChange:state"] for time, rows in sorted(now.items()) if time >= 0]
            assert changes == ["['Clear']", "['Occluded']", "['Clear']"]
        else:
            if then.get(0.0) == [{"StateChange:state": "['']"}]:
                del then[0.0]  # a lane begins with its first state
            differ = {time for time in now.keys() | then.keys() if now.get(time) != then.get(time)}
            assert differ <= {end_s}, entity
            assert all(then[time] == [{"Scalars:scalars": "[nan]"}] for time in differ)  # none is known, none will come


def test_what_holds_longer_than_the_window(tmp_path: Path) -> None:
    """A standing alarm is none anew, unless the device has started anew; an open fault ends; colours stay."""
    tx = codec.Transmitter()
    cgm = {"FaultTarget": codec.choice("FAULT_Inject", "FaultTarget", "CGM"), "FaultCanId": 0x100, "FaultCount": 0}
    alarm = {"CtrlAlarmState": 1, "CtrlAlarmPriority": 2, "CtrlAlarmCode": 1, "CtrlAlarmInstance": 7}
    status = {"CtrlMode": 6, "InsulinOnBoard": 120, "LimiterBits": 0, "LastMealId": 0, "LastCgmSeq": 0}
    extra = {
        5: tx.frame("FAULT_Inject", FaultKind=1, **cgm),
        10: tx.frame("CTRL_Alarm", **alarm),
        30: tx.frame("CTRL_Status", CtrlState=codec.choice("CTRL_Status", "CtrlState", "SafeBasal"), **status),
        50: tx.frame("CTRL_Alarm", **alarm),
        55: tx.frame("CTRL_Status", CtrlState=codec.choice("CTRL_Status", "CtrlState", "Suspended"), **status),
        60: tx.frame("FAULT_Inject", FaultKind=0, **cgm),
        65: tx.frame("HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=1, BootCtrl=2),
        85: tx.frame("CTRL_Alarm", **alarm),
    }
    sent: list[tuple[int, Frame]] = []
    step = -2  # the roll call and the calibration are closed as well
    for channel, frame in Loop(95).run_frames():
        if frame.can_id == codec.message("SYNC_Done").can_id:
            sent += [(0, extra[step])] if step in extra else []
            step += 1
        sent.append((channel, frame))
    live, whole = drawn(sent, tmp_path, 1, lengths=(20, 40))
    for entity in ("/alarm/CgmLost_CTRL", "/fault/Drop_CGM_Reading", "/state/1_firmware"):
        assert live[entity] == whole[entity], entity
    assert [time // 300 for time in live["/alarm/CgmLost_CTRL"] if time >= 0] == [10, 65, 85]
    assert [time // 300 for time in live["/fault/Drop_CGM_Reading"] if time >= 0] == [5, 60]
    assert {time for time in live["/log"] if live["/log"][time] != whole["/log"].get(time)} == {5 * 300.0}


def test_nothing_to_draw(tmp_path: Path) -> None:
    recording = LiveRecording(tmp_path / "live.rrd", free_port(), {}, gateway=False)
    recording.draw(Frames.none())
    recording.close()
    assert [entry.application_id for entry in RrdReader(tmp_path / "live.rrd").blueprints()] == ["pumpbench"]
