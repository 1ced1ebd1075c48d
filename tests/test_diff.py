"""Two runs side by side: the same, or the first difference and what it came to; and what is no run at all."""

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Pumpbench
from pumpbench import bench
from pumpbench.candump import write_candump
from pumpbench.capture import Capture
from pumpbench.comparison import folder
from pumpbench.comparison.account import partings, per_message, settings
from pumpbench.comparison.align import Comparison, Ignore, compare
from pumpbench.comparison.picture import write_picture
from pumpbench.comparison.record import Record
from pumpbench.comparison.report import Report, signal_rows
from pumpbench.faults import drop
from pumpbench.frames import Frames
from rerun.chunk import RrdReader

from can_bus import codec
from can_bus.codec import CodecError, Transmitter
from can_bus.faults.fields import repaired, with_raw
from can_bus.frame import CAN_ERR_FLAG, Frame
from can_bus.lockstep import Phase

DAY = {"strategy": "s3", "scenario": "six-hours", "hours": 4.0}


@pytest.fixture(scope="module")
def outcome() -> bench.Outcome:
    return bench.run(**DAY)


@pytest.fixture(scope="module")
def frames(outcome: bench.Outcome) -> Frames:
    return outcome.frames


@pytest.fixture(scope="module")
def disturbed() -> bench.Outcome:
    return bench.run(**DAY, faults=[drop("CGM_Reading", start="01:00", end="01:40")])


def row_of(frames: Frames, name: str, step: int) -> int:
    return int(np.flatnonzero((frames.can_id == codec.message(name).can_id) & (frames.step == step))[0])


def changed(frames: Frames, row: int, data: bytes) -> Frames:
    payloads = frames.data.copy()
    payloads[row, : len(data)] = np.frombuffer(data, "u1")
    return replace(frames, data=payloads)


def with_signal(frames: Frames, row: int, **raw: int) -> Frames:
    """The same with other values in one frame, its checksum made good."""
    frame = frames.frame(row)
    message = codec.messages_by_id()[frame.can_id]
    return changed(frames, row, repaired(message, with_raw(message, frame.data, raw)))


def kinds(comparison: Comparison) -> list[str]:
    return [each.kind for each in comparison.differences]


def report(a: Frames, b: Frames, *ignore: str) -> Report:
    return Report(compare(a, b, Ignore.of(ignore)), Record("one", a), Record("other", b))


# ---- frames


def test_a_run_is_the_same_as_itself(frames: Frames) -> None:
    comparison = compare(frames, frames)
    assert comparison.same and comparison.first is None and comparison.renumbered == 0
    assert report(frames, frames).headline() == f"the same: {len(frames)} frames"


@pytest.mark.parametrize("bit", [0, 9, 20, 63])
def test_one_bit_is_one_difference(frames: Frames, bit: int) -> None:
    row = row_of(frames, "PUMP_BasalCmd", 7)
    data = bytearray(frames.frame(row).data)
    data[bit // 8] ^= 1 << bit % 8
    other = changed(frames, row, bytes(data))
    told = report(frames, other)
    assert told.comparison.differences == [("changed", row, row)]
    assert "first difference: PUMP_BasalCmd at 00:35, step 7, turn 0, can0 (the device's bus)" in told.text()
    assert signal_rows(frames.frame(row), other.frame(row), Ignore())[-1][:3] == ("CHECKSUM", "right", "wrong")


def test_a_signal_is_told_by_name_value_and_unit(frames: Frames) -> None:
    row = row_of(frames, "PUMP_BasalCmd", 7)
    rate = codec.message("PUMP_BasalCmd").unpack(frames.frame(row).data)["InsulinRate"]
    told = report(frames, with_signal(frames, row, InsulinRate=rate + 20))
    first = told.data()["first"]
    assert (first["message"], first["step"], first["turn"], first["kind"]) == ("PUMP_BasalCmd", 7, 0, "changed")
    (apart,) = [each for each in first["signals"] if each["differs"]]
    assert (apart["name"], apart["unit"]) == ("InsulinRate", "U/h")
    assert float(apart["b"]) - float(apart["a"]) == pytest.approx(0.1)
    assert len(first["before"]) == 5
    assert "SYNC_Step SyncPhase=Step StepIndex=7" in first["before"][-1]
    assert not any("PLANT_Truth" in line for line in first["before"])


def without(frames: Frames, row: int) -> Frames:
    return frames.select(np.delete(np.arange(len(frames)), row))


def test_a_missing_frame_is_one_difference_and_so_is_an_extra_one(frames: Frames) -> None:
    row = row_of(frames, "CGM_Reading", 5)
    less = without(frames, row)
    assert compare(frames, less).differences == [("missing", row, None)]
    assert compare(less, frames).differences == [("extra", None, row)]
    assert "here only A has it" in report(frames, less).text()
    assert "here only B has it" in report(less, frames).text()


@pytest.mark.parametrize("page", range(3))
def test_a_missing_page_of_a_multiplexed_message_leaves_the_others_paired(frames: Frames, page: int) -> None:
    row = row_of(frames, "PLANT_Truth", 5) + page
    after = row_of(frames, "PLANT_Truth", 5) + 4
    other = without(changed(frames, after, bytes([4, 0, 7, 7, 7, 7, 7, 7])), row)
    assert compare(frames, other).differences == [("missing", row, None), ("changed", after, after - 1)]


def test_swapped_frames_are_moved_and_nothing_else(frames: Frames) -> None:
    row = row_of(frames, "PUMP_Status", 5)
    order = np.arange(len(frames))
    order[[row, row + 1]] = row + 1, row
    comparison = compare(frames, frames.select(order))
    assert kinds(comparison) == ["moved"]


def diag_record(*, skipped: int = -1, lost: int = -1, anew: int = -1) -> Frames:
    """40 steps of CTRL_Diag: one never said, one lost on its way, one from which on the sender counts from 0."""
    tx, capture = Transmitter(), Capture()
    for step in range(40):
        if step == anew:
            tx.counters["CTRL_Diag"] = 0
        if step != skipped:
            frame = tx.frame("CTRL_Diag", E2eErrorCount=step)
            capture.extend(0, [frame] if step != lost else [])
        capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=step, SimTime=300 * step)])
        capture.extend(0, [tx.frame("SYNC_Done", DoneStatus=0, DoneStepIndex=step, ExecTime=1, TxCount=1)])
    return capture.finish()


def test_a_sender_that_says_one_frame_less_counts_on_without_it() -> None:
    """What follows is renumbered, and the same."""
    comparison = compare(diag_record(), diag_record(skipped=17))
    assert (kinds(comparison), comparison.renumbered) == (["missing"], 22)
    comparison = compare(diag_record(skipped=17), diag_record())
    assert (kinds(comparison), comparison.renumbered) == (["extra"], 22)


def test_a_frame_lost_on_its_way_renumbers_nothing() -> None:
    comparison = compare(diag_record(), diag_record(lost=17))
    assert (kinds(comparison), comparison.renumbered) == (["missing"], 0)
    comparison = compare(diag_record(), diag_record(skipped=17, lost=30))
    assert (kinds(comparison), comparison.renumbered) == (["missing", "missing"], 21)


def test_a_damaged_frame_among_renumbered_ones_is_a_difference_of_its_own() -> None:
    less = diag_record(skipped=17)
    row = row_of(less, "CTRL_Diag", 25)
    comparison = compare(diag_record(), changed(less, row, bytes(8)))
    assert (kinds(comparison), comparison.renumbered) == (["missing", "changed"], 21)


def test_counters_that_agree_again_are_no_difference() -> None:
    """Both senders start anew, one after it has said one frame less."""
    comparison = compare(diag_record(anew=30), diag_record(skipped=17, anew=30))
    assert (kinds(comparison), comparison.renumbered) == (["missing"], 12)


def test_a_counter_that_jumps_without_a_reason_is_a_difference_once(frames: Frames) -> None:
    message = codec.message("CTRL_Diag")
    rows = np.flatnonzero(frames.can_id == message.can_id)[9:]
    other = frames
    for row in rows.tolist():
        data = frames.frame(row).data
        other = changed(other, row, repaired(message, data, (data[1] + 3) & 0xF))
    told = report(frames, other)
    assert told.comparison.differences == [("changed", rows[0], rows[0])]
    assert told.comparison.renumbered == len(rows) - 1
    assert [
        each.name for each in signal_rows(*told.pair(told.comparison.differences[0]), Ignore()) if each.differs
    ] == ["COUNTER"]


def test_a_shorter_run_differs_from_its_end_on(frames: Frames) -> None:
    comparison = compare(frames, frames.select(frames.step < 20))
    assert set(kinds(comparison)) == {"missing"}
    assert len(comparison.differences) == np.count_nonzero(frames.step >= 20)
    assert frames.step[comparison.first.a] == 20  # type: ignore[union-attr]


def test_a_flood_is_compared_in_no_time(frames: Frames) -> None:
    flood = Frame(0x7FF, bytes(8))
    capture = Capture()
    for frame in frames.frames(0):
        capture.extend(0, [frame])
        if frame.can_id == codec.message("PUMP_Status").can_id:
            capture.extend(0, [flood] * 300)
    flooded = capture.finish()
    row = int(np.flatnonzero(flooded.can_id == 0x7FF)[1000])
    assert kinds(compare(flooded, without(flooded, row))) == ["missing"]


def test_error_frames_and_strangers_are_frames_like_any_other(frames: Frames) -> None:
    capture = Capture()
    capture.extend(0, [*frames.frames(0), Frame(0x80 | CAN_ERR_FLAG, bytes(8)), Frame(0x555, b"\x01")])
    told = report(frames, capture.finish())
    assert kinds(told.comparison) == ["extra", "extra"]
    assert [count.message for count in per_message(told.comparison)] == [f"0x{0x80 | CAN_ERR_FLAG:X}", "0x555"]
    assert "frame 0x80" in told.text()


# ---- what is ignored


def test_messages_and_signals_can_be_ignored(frames: Frames) -> None:
    row = row_of(frames, "SYNC_Done", 7)
    other = with_signal(frames, row, ExecTime=77)
    assert not compare(frames, other).same
    for name in ("SYNC_Done", "SYNC_Done.ExecTime", "own"):
        told = report(frames, other, name)
        assert told.comparison.same, name
        assert "apart from what is ignored" in told.headline()
    assert not compare(frames, other, Ignore.of(["SYNC_Done.TxCount", "CTRL_Diag"])).same
    also = with_signal(other, row, TxCount=99)
    (apart,) = [each for each in report(frames, also, "own").data()["first"]["signals"] if each["differs"]]
    assert apart["name"] == "TxCount"


def test_a_signal_of_one_page_is_ignored_on_that_page_only(frames: Frames) -> None:
    row = row_of(frames, "PLANT_Truth", 5)
    glucose, insulin = with_signal(frames, row, TruthGlucose=7), with_signal(frames, row + 1, TruthInsulin=7)
    ignore = Ignore.of(["PLANT_Truth.TruthGlucose"])
    assert compare(frames, glucose, ignore).same
    assert not compare(frames, insulin, ignore).same


@pytest.mark.parametrize(("name", "text"), [("Nonsense", "no message 'Nonsense'"), ("CTRL_Diag.x", "no signal 'x'")])
def test_what_is_ignored_must_exist(name: str, text: str) -> None:
    with pytest.raises(CodecError, match=text):
        Ignore.of([name])


# ---- two buses, and the account


def test_the_first_difference_is_where_a_frame_was_lost(outcome: bench.Outcome, disturbed: bench.Outcome) -> None:
    told = Report(
        compare(outcome.frames, disturbed.frames),
        Record("one", outcome.frames, outcome.info),
        Record("other", disturbed.frames, disturbed.info),
    )
    assert told.comparison.one_sided == {1: "B"}
    first = told.data()["first"]
    assert (first["message"], first["kind"], first["step"]) == ("CGM_Reading", "missing", 12)
    text = told.text()
    assert "only B has the plant's bus" in text
    assert '"kind": "drop", "start": "01:00"' in text.splitlines()[-1]
    found = {each.what: each for each in partings(outcome.trace, disturbed.trace)}
    assert (found["CGM"].time_s, found["CGM"].steps >= 8, found["CGM"].b) == (3600.0, True, None)
    assert (found["state of the firmware"].a, found["state of the firmware"].b) == ("Auto", "Degraded")
    assert found["alarms"].b == "CTRL CgmLost Pending"
    assert found["insulin delivered"].totals is not None
    assert [each.time_s for each in found.values()] == sorted(each.time_s for each in found.values())


def test_one_bus_alone_can_be_compared(disturbed: bench.Outcome) -> None:
    frames = disturbed.frames
    row = int(np.flatnonzero(frames.channel == 1)[500])
    other = changed(frames, row, bytes(8))
    assert compare(frames, other, channel=0).same
    assert not compare(frames, other, channel=1).same


def test_the_plants_bus_comes_first_on_the_way_to_the_device(disturbed: bench.Outcome) -> None:
    """A difference that the plant makes is told where it was made, one of the device on the device's bus."""
    frames = disturbed.frames
    for name, channel in (("PUMP_Status", 1), ("PUMP_BasalCmd", 0)):
        rows = np.flatnonzero((frames.can_id == codec.message(name).can_id) & (frames.step == 7))
        other = frames
        for row in rows.tolist():
            other = changed(other, row, bytes(7))
        comparison = compare(frames, other)
        assert len(comparison.differences) == 2
        assert frames.channel[comparison.first.a] == channel, name  # type: ignore[union-attr]


def test_settings_that_differ_and_nothing_that_follows_from_frames() -> None:
    a = {"seed": 1, "packages": {"numpy": "2.0"}, "trace_sha256": "x", "frames": 5, "faults": []}
    b = {"seed": 2, "packages": {"numpy": "2.1"}, "trace_sha256": "y", "frames": 6, "faults": [], "reset": "hook"}
    assert settings(a, b) == [("seed", 1, 2), ("packages.numpy", "2.0", "2.1"), ("reset", None, "hook")]
    assert settings({}, b) == []


# ---- the command


@pytest.fixture(scope="module")
def folders(
    outcome: bench.Outcome, disturbed: bench.Outcome, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    place = tmp_path_factory.mktemp("folders")
    return outcome.write(place / "one"), disturbed.write(place / "other")


def test_the_command_says_the_same_or_what_differs(pumpbench: Pumpbench, folders: tuple[Path, Path]) -> None:
    one, other = folders
    done = pumpbench("diff", one, one / "bus.log")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout.startswith("the same: ")
    done = pumpbench("diff", one, other, "--json", "-")
    assert done.returncode == 1
    assert json.loads(done.stdout)["first"]["message"] == "CGM_Reading"


def test_a_comparison_is_kept_with_a_recording_and_a_picture(
    pumpbench: Pumpbench, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    done = pumpbench("diff", *folders, "--out", tmp_path / "kept")
    assert done.returncode == 1
    kept = tmp_path / "kept"
    assert sorted(path.name for path in kept.iterdir()) == [
        "comparison.png",
        "comparison.rrd",
        "report.json",
        "report.txt",
    ]
    assert (kept / "report.txt").read_text() in done.stdout.replace("\nrecording: ", "\0").split("\0")[0]
    assert (kept / "comparison.png").read_bytes().startswith(b"\x89PNG")
    entities = {chunk.entity_path for chunk in RrdReader(kept / "comparison.rrd").stream()}
    assert {"/glucose/true_A", "/glucose/true_B", "/insulin/first", "/apart/insulin/all"} <= entities
    assert {"/state/01_firmware_A", "/state/02_firmware_B", "/differs/01_CGM_Reading", "/report"} <= entities


def test_a_picture_of_many_days_is_drawn_too(tmp_path: Path) -> None:
    runs = [bench.run(strategy="s2", scenario="validation-14d", hours=72, seed=seed) for seed in (1, 2)]
    one, other = (Record(f"seed {seed}", run.frames, run.info) for seed, run in enumerate(runs, 1))
    write_picture(Report(compare(one.frames, other.frames), one, other), tmp_path / "long.png")
    assert (tmp_path / "long.png").read_bytes().startswith(b"\x89PNG")


def test_a_recording_that_cannot_be_written_is_named(
    frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pumpbench.recording.tool.rerun_binary", lambda: "/bin/false")
    with pytest.raises(OSError, match=r"cannot write .*comparison\.rrd: rerun rrd optimize failed"):
        folder.write(report(frames, frames), tmp_path)


def damage(run: Path, name: str, change: Callable[[str], str]) -> None:
    file = run / name
    file.write_text(change(file.read_text()))


def one_bit(text: str) -> str:
    lines = text.splitlines()
    lines[600] = lines[600][:-1] + ("0" if lines[600][-1] != "0" else "1")
    return "\n".join(lines) + "\n"


def test_bad_input_is_one_line_and_exit_status_2(
    pumpbench: Pumpbench, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    one = folders[0]
    broken = [tmp_path / name for name in ("changed", "no-log", "no-json")]
    for copy in broken:
        shutil.copytree(one, copy)
    damage(broken[0], "bus.log", one_bit)
    (broken[1] / "bus.log").unlink()
    damage(broken[2], "run.json", lambda text: text[:50])
    (tmp_path / "text").write_text("no log\n")
    (tmp_path / "foreign.log").write_text("(0.0) can0 123#00\n")
    cases: Iterable[tuple[list[object], str]] = [
        ([broken[0]], "bus.log was changed: its frames do not have the hash that run.json states"),
        ([broken[1]], "is not a complete run folder: bus.log missing"),
        ([broken[2]], "run.json is corrupt"),
        ([tmp_path / "nowhere"], "there is no run folder"),
        ([tmp_path / "text"], "text:1: not a line of a candump log"),
        ([tmp_path / "foreign.log"], "has no SYNC_Step of a run in it"),
        ([one, "--ignore", "X"], "the DBC has no message 'X'"),
        ([one, "--channel", "1"], "--channel 1: not both records have that bus"),
    ]
    for arguments, text in cases:
        done = pumpbench("diff", one, *arguments)  # type: ignore[arg-type]
        assert (done.returncode, done.stdout) == (2, ""), (arguments, done.stdout)
        assert len(done.stderr.splitlines()) == 1 and text in done.stderr, (arguments, done.stderr)


def test_a_log_with_names_of_its_own_is_compared_bus_by_bus(frames: Frames, tmp_path: Path) -> None:
    write_candump(frames, tmp_path / "vcan.log", names=("vcan0", "vcan1"))
    assert compare(frames, Record.load(tmp_path / "vcan.log").frames).same


def test_another_dbc_is_told(frames: Frames) -> None:
    foreign = Record("old", frames, {"dbc_crc32": "00000000"})
    text = Report(compare(frames, frames), foreign, Record("new", frames)).text()
    assert "old was recorded with another pumpbench.dbc: CRC-32 00000000, this one" in text
