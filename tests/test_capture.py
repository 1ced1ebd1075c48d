"""Capture: steps and turns out of the frames alone, canonical order, hash, candump files other tools read."""

import hashlib
import struct
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import can
import cantools.logreader
import numpy as np
import pytest
from e2e.p02 import e2e_p02_check
from pumpbench.candump import read_candump, write_candump
from pumpbench.capture import Capture
from pumpbench.frames import Frames
from synthetic_capture import Loop, as_frames, dropping, random_frames

import dbc
from can_bus import codec
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame

STEPS = 100


@pytest.fixture(scope="module")
def frames() -> Frames:
    return Loop(STEPS).run().finish()


def same(one: Frames, other: Frames) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Frames))


def names_of(frames: Frames) -> list[str]:
    return [codec.messages_by_id()[ident].name for ident in frames.can_id.tolist()]


def test_roll_call_is_no_part_of_the_record(frames: Frames) -> None:
    names = names_of(frames)
    assert "PLANT_Info" not in names
    assert "CTRL_Info" not in names
    assert names[:5] == ["CFG_Param"] * 3 + ["MODE_Cmd", "SYNC_Step"]


def test_late_answers_to_the_roll_call_leave_no_trace() -> None:
    def loop(late: int) -> Frames:
        made = Loop(3)
        sent = made.run()
        position = next(i for i, (_, f) in enumerate(made.sent) if f.can_id == codec.message("CFG_Param").can_id)
        answers = [made.sent[position - 2], made.sent[position - 1]] * late
        capture = Capture()
        for channel, frame in [*made.sent[: position + 1], *answers, *made.sent[position + 1 :]]:
            capture.extend(channel, [frame])
        assert len(capture) == len(sent) + 2 * late
        return capture.finish()

    assert loop(0).sha256() == loop(3).sha256()


def test_a_device_that_answers_every_call_when_the_last_one_is_out_leaves_no_trace() -> None:
    made = Loop(3)
    sent = made.run()
    info = codec.message("CTRL_Info").can_id
    position = next(i for i, (_, frame) in enumerate(made.sent) if frame.can_id == info)
    capture = Capture()
    for channel, frame in made.sent[:position]:
        capture.extend(channel, [frame])
    for call in range(2):  # the loop's own answer is to call 2
        device = codec.Transmitter()  # which each call starts anew
        boot_up = device.frame("HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=0, BootCtrl=1)
        done = device.frame("SYNC_Done", DoneStatus=0, DoneStepIndex=call, ExecTime=120, TxCount=3)
        capture.extend(0, [boot_up, made.sent[position][1], done])
    for channel, frame in made.sent[position:]:
        capture.extend(channel, [frame])
    assert len(capture) == len(sent) + 6
    assert capture.finish().sha256() == sent.finish().sha256()


def test_a_roll_call_nobody_answers_is_an_empty_record() -> None:
    tx = codec.Transmitter()
    capture = Capture()
    capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=0, StepIndex=k, SimTime=0) for k in range(5)])
    assert len(capture.finish()) == 0
    assert len(Capture().finish()) == 0
    assert Capture().finish().sha256() == hashlib.sha256().hexdigest()


def test_every_frame_is_in_its_step(frames: Frames) -> None:
    words = frames.word
    for name, signal in (("PLANT_Truth", "TruthStep"), ("SYNC_Done", "DoneStepIndex"), ("SYNC_Step", "StepIndex")):
        message = codec.message(name)
        rows = frames.can_id == message.can_id
        field = message.fields[signal]
        stated = (words[rows] >> np.uint64(field.shift)) & np.uint64(field.mask)
        assert np.array_equal(stated, frames.step[rows])
    assert frames.step[0] == 0
    assert frames.step[-1] == STEPS


def test_turns_and_times(frames: Frames) -> None:
    assert set(frames.turn[frames.step == 5]) == {0}
    assert frames.turn[0] == -1
    meal = frames.select(frames.step == 96)
    assert set(meal.turn) == {0, 1, 2}
    assert meal.time_s[meal.turn == 2][0] == 300 * 96 + 2
    step = frames.select(frames.step == 5)
    assert np.allclose(step.time_s, 1500 + 0.00025 * np.arange(len(step)), atol=1e-9)
    assert (np.diff(frames.time_s) > 0).all()


def test_hash_is_over_the_documented_bytes(frames: Frames) -> None:
    digest = hashlib.sha256()
    for row in range(len(frames)):
        frame = frames.frame(row)
        digest.update(
            struct.pack("<BIIB8s", frames.channel[row], frames.step[row], frame.can_id, len(frame.data), frame.data)
        )
    assert frames.sha256() == digest.hexdigest()


def test_order_of_reading_two_buses_does_not_matter() -> None:
    made = Loop(20, faults=dropping("CGM_Reading", range(5, 8)))
    interleaved = made.run().finish()
    capture = Capture()
    for channel in (1, 0):
        capture.extend(channel, [frame for where, frame in made.sent if where == channel])
    assert same(interleaved, capture.finish())
    assert set(interleaved.channel) == {0, 1}
    for step in (0, 5, 20):
        assert (np.diff(interleaved.channel[interleaved.step == step].astype(int)) >= 0).all()


def test_capture_can_go_on_after_finish() -> None:
    made = Loop(4)
    made.run()
    capture = Capture()
    half = len(made.sent) // 2
    capture.extend(0, [frame for _, frame in made.sent[:half]])
    assert len(capture.finish()) < half
    capture.extend(0, [frame for _, frame in made.sent[half:]])
    assert same(capture.finish(), made.capture.finish())


def test_the_end_of_an_earlier_run_on_the_same_bus_is_left_out() -> None:
    earlier, made = Loop(12), Loop(8)
    earlier.run()
    made.run()
    capture = Capture()
    for _, frame in [*earlier.sent[-90:], *made.sent]:
        capture.extend(0, [frame])
    assert same(capture.finish(), made.capture.finish())


def test_a_replayed_roll_call_ends_no_record() -> None:
    made = Loop(8)
    made.run()
    call = next(frame for _, frame in made.sent if frame.can_id == codec.message("SYNC_Step").can_id)
    capture = Capture()
    for index, (channel, frame) in enumerate(made.sent):
        capture.extend(channel, [frame])
        if index in (len(made.sent) // 2, len(made.sent) - 1):
            capture.extend(channel, [call])
    frames = capture.finish()
    assert len(frames) == len(made.capture.finish()) + 2
    assert frames.step[-1] == 8


def test_in_a_free_run_the_batch_belongs_to_its_token_and_the_device_to_the_last_one() -> None:
    tx = codec.Transmitter()
    capture = Capture()
    for k in range(3):
        capture.extend(0, [tx.frame("HB_CGM", NmtCgm=5, ToggleCgm=0, ResetCauseCgm=0, BootCgm=1)])
        capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=1, StepIndex=k, SimTime=300 * k)])
        capture.extend(0, [tx.frame("HB_CTRL", NmtCtrl=5, ToggleCtrl=0, ResetCauseCtrl=0, BootCtrl=1)])
    assert capture.finish().step.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_a_step_nobody_answers_ends_where_the_plant_speaks_again() -> None:
    made = Loop(6)
    made.run()
    done = codec.message("SYNC_Done").can_id
    kept = Capture()
    seen = 0
    for channel, frame in made.sent:
        seen += frame.can_id == done
        if frame.can_id == done and seen == 4:  # roll call, Config, step 0, step 1
            continue
        kept.extend(channel, [frame])
    frames, whole = kept.finish(), made.capture.finish()
    lost = int(np.flatnonzero((whole.step == 1) & (whole.can_id == done))[0])
    assert np.array_equal(frames.step, np.delete(whole.step, lost))


def test_a_run_cut_off_in_the_middle_of_a_batch() -> None:
    made = Loop(6)
    made.run()
    token = codec.message("SYNC_Step").can_id
    last = max(i for i, (_, frame) in enumerate(made.sent) if frame.can_id == token)
    capture = Capture()
    capture.extend(0, [frame for _, frame in made.sent[:last]])
    frames = capture.finish()
    assert frames.step[-1] == 6
    assert frames.time_s[frames.step == 6][0] == 1800


def test_repeated_and_replayed_tokens_open_no_turn() -> None:
    made = Loop(8)
    made.run()
    token = codec.message("SYNC_Step").can_id
    capture, tokens = Capture(), []
    for channel, frame in made.sent:
        capture.extend(channel, [frame])
        if frame.can_id == token:
            tokens.append(frame)
            if len(tokens) == 8:
                capture.extend(channel, [frame, tokens[5]])  # a duplicate and a replay, as a gateway may inject them
    frames = capture.finish()
    whole = made.capture.finish()
    assert len(frames) == len(whole) + 2
    assert np.bincount(frames.step).tolist() == (np.bincount(whole.step) + (np.arange(9) == 3) * 2).tolist()


def test_tokens_from_another_time_open_no_turn() -> None:
    made = Loop(30)
    made.run()
    tx = codec.Transmitter()
    token = codec.message("SYNC_Step").can_id
    capture = Capture()
    for index, (channel, frame) in enumerate(made.sent):
        capture.extend(channel, [frame])
        if frame.can_id == token and index > 100:
            capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=1, StepIndex=step, SimTime=9) for step in (20, 1000000)])
    frames = capture.finish()
    whole = made.capture.finish()
    assert frames.step.max() == 30
    ours = codec.message("CGM_Reading").can_id
    assert np.array_equal(frames.step[frames.can_id == ours], whole.step[whole.can_id == ours])


@pytest.mark.parametrize("seed", range(15))
def test_no_traffic_breaks_it(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pool = [frame for _, frame in random_frames(8, seed)] + [frame for _, frame in Loop(3).run_frames()]
    capture = Capture()
    for index in rng.integers(len(pool), size=400):
        frame = pool[index]
        if rng.random() < 0.2:
            frame = Frame(int(rng.integers(2**32)), rng.bytes(int(rng.integers(9))))
        capture.extend(int(rng.integers(2)), [frame])
    frames = capture.finish()
    for channel in (0, 1):
        mine = frames.select(frames.channel == channel)
        assert (np.diff(mine.time_s) > 0).all()
        assert (np.diff(mine.step) >= 0).all()
    write_candump(frames, tmp_path / "bus.log")
    assert same(read_candump(tmp_path / "bus.log"), frames)


def test_a_babbling_node_keeps_time_in_order() -> None:
    made = Loop(3)
    made.run()
    capture = Capture()
    for channel, frame in made.sent:
        capture.extend(channel, [frame])
        if frame.can_id == codec.message("MODE_Cmd").can_id:
            capture.extend(channel, [Frame(0, b"")] * 1_300_000)
    frames = capture.finish()
    assert (np.diff(frames.time_s) > 0).all()
    assert frames.time_s[frames.step == 1].min() == 300


def test_intact_agrees_with_the_e2e_library() -> None:
    rng = np.random.default_rng(8)
    damaged, expected = [], []
    for name, frame in random_frames(40):
        data = frame.data
        if rng.random() < 0.5:
            bit = int(rng.integers(8 * len(data)))
            data = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(len(data), "little")
        ids = codec.message(name).data_ids
        damaged.append(Frame(frame.can_id, data))
        expected.append(ids is None or e2e_p02_check(data, ids))
    strangers = [Frame(0x100, bytes(7)), Frame(0x7FF, bytes(8)), Frame(0x100 | CAN_EFF_FLAG, bytes(8))]
    assert as_frames([*damaged, *strangers]).intact.tolist() == [*expected, False, False, False]
    assert 0.3 < np.mean(expected) < 0.7


ODD = [
    Frame(0x123, b""),
    Frame(0x7FF, b"\x01\x02\x03"),
    Frame(0x18DAF110 | CAN_EFF_FLAG, b"\xff" * 8),
    Frame(0x55 | CAN_EFF_FLAG, b"\x00"),
    Frame(0x100 | CAN_RTR_FLAG, bytes(8)),
    Frame(0x100 | CAN_RTR_FLAG, b""),
    Frame(0x18DAF110 | CAN_EFF_FLAG | CAN_RTR_FLAG, bytes(3)),
    Frame(0x80 | CAN_ERR_FLAG, b"\x00\x08\x00\x00\x00\x00\x60\x00"),
    Frame(0x4 | CAN_ERR_FLAG, b"\x00\x04\x00\x00\x00\x00\x00\x00"),
]


def test_frames_that_a_bus_can_carry_are_recorded_as_they_came() -> None:
    capture = Capture()
    capture.extend(0, ODD)
    assert [(frame.can_id, len(frame.data)) for frame in capture.finish().frames()] == [
        (frame.can_id, len(frame.data)) for frame in ODD
    ]


@pytest.mark.parametrize("gateway", [False, True])
def test_candump_round_trip(tmp_path: Path, gateway: bool) -> None:
    made = Loop(30, faults=dropping("CGM_Reading", range(5, 8)) if gateway else None)
    made.run()
    made.capture.extend(0, ODD)
    frames = made.capture.finish()
    path = tmp_path / "bus.log"
    write_candump(frames, path)
    again = read_candump(path)
    assert same(frames, again)
    assert frames.sha256() == again.sha256()


def test_python_can_reads_the_log(tmp_path: Path) -> None:
    made = Loop(10)
    made.run()
    made.capture.extend(0, ODD)
    frames = made.capture.finish()
    write_candump(frames, tmp_path / "bus.log", names=("vcan0", "vcan1"))
    messages = list(can.LogReader(tmp_path / "bus.log"))
    assert len(messages) == len(frames)
    for row, message in enumerate(messages):
        frame = frames.frame(row)
        assert message.timestamp == pytest.approx(frames.time_s[row], abs=1e-6)
        assert message.channel == ("vcan0" if not message.is_error_frame else None)
        if not frame.is_error:  # python-can drops the details of error frames
            assert message.arbitration_id == frame.identifier
            assert (message.is_extended_id, message.is_remote_frame) == (frame.is_extended, frame.is_remote)
            assert message.dlc == len(frame.data)
            assert frame.is_remote or bytes(message.data) == frame.data


def test_log_written_by_python_can_is_read(tmp_path: Path, frames: Frames) -> None:
    with can.CanutilsLogWriter(tmp_path / "x.log", channel="can0") as writer:
        for row, frame in enumerate(frames.frames()):
            writer.on_message_received(
                can.Message(
                    timestamp=1e9 + row, arbitration_id=frame.can_id, data=frame.data, is_extended_id=False, is_rx=True
                )
            )
    assert same(read_candump(tmp_path / "x.log"), frames)


def test_cantools_decodes_the_log(tmp_path: Path, frames: Frames) -> None:
    path = tmp_path / "bus.log"
    write_candump(frames, path)
    with path.open() as file:
        parsed = list(cantools.logreader.Parser(file))
    assert len(parsed) == len(frames)
    assert parsed[50].timestamp.timestamp() == pytest.approx(frames.time_s[50], abs=1e-6)
    result = subprocess.run(
        [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc.DBC_PATH)],
        input="".join(path.read_text().splitlines(keepends=True)[:40]),
        capture_output=True,
        text=True,
        check=True,
    )
    assert "CGM_Reading" in result.stdout
    assert "SyncPhase: Config" in result.stdout


@pytest.mark.parametrize(
    "line",
    [
        "rubbish",
        "(1.0) can0 100#0",
        "(1.0) can0 100",
        "(1.0) can0 100#001122334455667788",
        "(x) can0 1#",
        "(1.0) can0 1##100",
    ],
)
def test_a_broken_log_names_the_line(tmp_path: Path, line: str) -> None:
    path = tmp_path / "bus.log"
    path.write_text(f"(0.000000) can0 100#00\n\n{line}\n")
    with pytest.raises(ValueError, match=r"bus\.log:3: not a line of a candump log"):
        read_candump(path)
