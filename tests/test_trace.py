"""Trace: decoded like cantools decodes, one row per step, doses and events, parquet that explains itself."""

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pumpbench.capture import Capture
from pumpbench.events import FaultEvent, FaultSpan
from pumpbench.signals import decode, labels, signals
from pumpbench.trace import PARQUET_NAME, Trace
from synthetic_capture import MEALS, Loop, as_frames, dropping, random_frames

import dbc
from can_bus import codec
from can_bus.frame import Frame

STEPS = 288
OCCLUSION = range(150, 162)


@pytest.fixture(scope="module")
def loop() -> Loop:
    made = Loop(STEPS, occlusion=OCCLUSION)
    made.run()
    return made


@pytest.fixture(scope="module")
def trace(loop: Loop) -> Trace:
    return Trace.from_frames(loop.capture.finish(), {"patient": "adult#001", "seed": 1})


@pytest.fixture(scope="module")
def faulty() -> Trace:
    return Trace.from_frames(Loop(STEPS, faults=dropping("CGM_Reading", range(24, 36))).run().finish())


def test_every_signal_of_every_message_agrees_with_cantools() -> None:
    named = list(random_frames(120))
    frames = as_frames([frame for _, frame in named])
    tables = {message.name: message for message in dbc.load().messages}
    for name in codec.messages():
        decoded = decode(frames, name)
        mine = [frame for sender, frame in named if sender == name]
        assert len(decoded.rows) == len(mine)
        for row, frame in enumerate(mine):
            raw = tables[name].decode(frame.data, decode_choices=False, scaling=False)
            scaled = tables[name].decode(frame.data, decode_choices=False)
            for signal_name, signal in signals(name).items():
                assert decoded.valid[signal_name][row] == (signal_name in raw)
                if signal_name not in raw:
                    continue
                assert decoded.raw[signal_name][row] == raw[signal_name]
                value = signal.physical(decoded.raw[signal_name][row : row + 1])[0]
                text = signal.choices.get(raw[signal_name])
                if text in ("SNA", "Error") or raw[signal_name] in signal.invalid:
                    assert math.isnan(value), (signal_name, text)
                else:
                    assert value == scaled[signal_name], signal_name


def test_every_code_that_means_no_value_is_nan() -> None:
    for message in dbc.load().messages:
        for name, signal in signals(message.name).items():
            for code, label in signal.choices.items():
                value = signal.physical(np.array([code]))[0]
                assert math.isnan(value) == (label in ("SNA", "Error")), (name, label)
    glucose = signals("CGM_Reading")["GlucoseConc"]
    assert not glucose.is_enumeration
    assert glucose.invalid == (8190, 8191)
    assert signals("CTRL_Status")["CtrlState"].is_enumeration
    assert labels("CTRL_Status", "CtrlState")[3] == "SafeBasal"
    assert signals("CTRL_Status")["CtrlState"].label(math.nan) == ""


def test_one_row_per_step(trace: Trace) -> None:
    assert trace.step.tolist() == list(range(STEPS + 1))
    assert np.array_equal(trace.time_s, 300.0 * trace.step)
    assert all(len(column) == STEPS + 1 for column in trace.columns.values())
    assert not np.isnan(trace.columns["GlucoseConc"]).any()
    assert np.isnan(trace.columns["InsulinRate"][-1])  # nobody answers the final instant with a command
    assert np.isnan(trace.columns["CfgBasal"][1:]).all()
    assert trace.columns["CfgBasal"][0] == pytest.approx(1.2)
    assert {"BolusPhase[Insulin]", "BolusPhase[Pramlintide]", "TruthGlucose", "TruthPramLost"} <= set(trace.columns)
    assert not {"CHECKSUM", "COUNTER"} & set(trace.columns)


def test_column_is_the_last_frame_of_the_step(trace: Trace, loop: Loop) -> None:
    table = dbc.load().get_message_by_name("CGM_Reading")
    last: dict[int, float] = {}
    frames = loop.capture.finish()
    for row in np.flatnonzero(frames.can_id == table.frame_id):
        last[int(frames.step[row])] = table.decode(frames.frame(row).data)["GlucoseConc"]
    assert trace.columns["GlucoseConc"].tolist() == [last[k] for k in range(STEPS + 1)]


def test_doses(trace: Trace, loop: Loop) -> None:
    columns = trace.columns
    assert np.nansum(columns["InsulinDelivered"]) == pytest.approx(loop.insulin, abs=1e-3)
    assert np.nansum(columns["PramDelivered"]) == pytest.approx(loop.pram, abs=1e-2)
    assert np.isnan(columns["InsulinDelivered"][-1])
    assert columns["InsulinDelivered"][100] == pytest.approx(columns["InsulinRate"][100] / 12, abs=2e-3)
    asked = {k: round(carbs / 12, 2) for k, carbs in MEALS.items()}
    assert {k: v for k, v in enumerate(columns["InsulinBolusCommanded"].tolist()) if v} == pytest.approx(asked)
    given = columns["InsulinBolusDelivered"]
    assert {k: v for k, v in enumerate(given.tolist()) if v > 0} == pytest.approx(
        {k: 0.0 if k in OCCLUSION else v for k, v in asked.items() if k not in OCCLUSION}
    )
    assert not columns["PramBolusCommanded"].any()
    during = slice(OCCLUSION.start, OCCLUSION.stop)
    assert (columns["InsulinDelivered"][during] == 0).all()
    assert (columns["InsulinRate"][during] > 0).all()


def test_totals_start_again_after_a_pump_reset() -> None:
    tx = codec.Transmitter()
    capture = Capture()
    for k, (boot, total) in enumerate([(1, 0), (1, 100), (1, 250), (2, 30), (2, 80), (None, 0), (2, 120)]):
        if boot is not None:
            capture.extend(0, [tx.frame("PUMP_Delivered", PumpBootCount=boot, InsulinTotal=total, PramTotal=0)])
        capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=1, StepIndex=k, SimTime=300 * k), tx.frame("SYNC_Done")])
    delivered = Trace.from_frames(capture.finish()).columns["InsulinDelivered"]
    assert delivered[:-1].tolist() == pytest.approx([0.1, 0.15, 0.03, 0.05, 0.02, 0.02])
    assert math.isnan(delivered[-1])


def test_a_bolus_counts_once_however_often_it_is_sent() -> None:
    tx = codec.Transmitter()
    capture = Capture()
    program, commit, cancel = 1, 2, 3
    script = [
        [(program, 7, 300), (commit, 7, 4095)],  # the commit leaves the dose out
        [(commit, 7, 300), (commit, 7, 300)],
        [(program, 8, 200)],
        [(program, 9, 150), (commit, 9, 150), (cancel, 9, 4095)],
    ]
    for k, turn in enumerate(script):
        capture.extend(0, [tx.frame("SYNC_Step", SyncPhase=1, StepIndex=k, SimTime=300 * k)])
        for op, ident, dose in turn:
            capture.extend(
                0, [tx.frame("PUMP_BolusCmd", BolusHormone=2, BolusOp=op, BolusId=ident, PramlintideBolus=dose)]
            )
        capture.extend(0, [tx.frame("SYNC_Done")])
    trace = Trace.from_frames(capture.finish())
    assert trace.columns["PramBolusCommanded"].tolist() == pytest.approx([30.0, 0, 0, 15.0])


def test_alarms_are_changes_not_repetitions(trace: Trace) -> None:
    assert [(a.node, a.code, a.state, a.priority, a.instance) for a in trace.alarms] == [
        ("PUMP", "Occlusion", "Pending", "High", 41),
        ("PUMP", "Occlusion", "Inactive", "High", 41),
    ]
    assert [a.time_s // 300 for a in trace.alarms] == [OCCLUSION.start, OCCLUSION.stop]


def test_meals_are_what_the_patient_ate(trace: Trace) -> None:
    assert [(meal.time_s / 300, meal.carbs_g) for meal in trace.meals] == list(MEALS.items())


def test_a_dropped_message_is_a_gap_and_a_span(faulty: Trace) -> None:
    assert np.flatnonzero(np.isnan(faulty.columns["GlucoseConc"])).tolist() == list(range(24, 36))
    assert not np.isnan(faulty.columns["TruthGlucose"]).any()
    assert len(faulty.faults) == 12
    assert faulty.faults[0].kind == "Drop"
    assert (faulty.faults[0].target, faulty.faults[0].message, faulty.faults[0].count) == ("CGM", "CGM_Reading", 1)
    assert faulty.fault_spans() == [FaultSpan("Drop CGM_Reading", 24 * 300.0, 36 * 300.0)]
    assert [a.code for a in faulty.alarms] == ["CgmLost"]


def test_fault_spans_from_counts_and_clears() -> None:
    steps = np.arange(101)
    events = [
        FaultEvent(600.5, "Stuck", "CGM", "CGM_Reading", 0),
        FaultEvent(900.0, "Drop", "PUMP", "", 3),
        FaultEvent(1500.0, "None", "CGM", "", 0),
        FaultEvent(29000.0, "Delay", "CTRL", "PUMP_BasalCmd", 0),
    ]
    spans = Trace({}, steps, steps * 300.0, faults=events).fault_spans()
    assert spans == [
        FaultSpan("Stuck CGM_Reading", 600.0, 1500.0),
        FaultSpan("Drop PUMP", 900.0, 1200.0),
        FaultSpan("Delay PUMP_BasalCmd", 28800.0, 30000.0),
    ]


def test_an_announcement_seen_on_both_buses_is_one_event() -> None:
    made = Loop(10, faults=dropping("CGM_Reading", range(3, 5)))
    made.run()
    capture = Capture()
    fault = codec.message("FAULT_Inject").can_id
    for channel, frame in made.sent:
        capture.extend(channel, [frame])
        if frame.can_id == fault:
            capture.extend(1 - channel, [frame])
    assert len(Trace.from_frames(capture.finish()).faults) == 2


def test_the_truth_is_taken_from_the_plants_bus() -> None:
    truth = Trace.from_frames(Loop(10, faults=dropping("PLANT_Truth", range(3, 5))).run().finish())
    assert not np.isnan(truth.columns["TruthGlucose"]).any()


def test_frames_that_fail_their_check_are_not_believed() -> None:
    made = Loop(5)
    made.run()
    cgm = codec.message("CGM_Reading").can_id
    capture = Capture()
    for index, (channel, frame) in enumerate(made.sent):
        broken = frame.can_id == cgm and index > len(made.sent) // 2
        capture.extend(channel, [Frame(frame.can_id, bytes([frame.data[0] ^ 1]) + frame.data[1:]) if broken else frame])
    glucose = Trace.from_frames(capture.finish()).columns["GlucoseConc"]
    assert 0 < np.isnan(glucose).sum() < len(glucose)


def test_parquet_round_trip_and_metadata(trace: Trace, tmp_path: Path) -> None:
    trace.save(tmp_path / PARQUET_NAME)
    again = Trace.load(tmp_path)
    assert list(again.columns) == list(trace.columns)
    for name, column in trace.columns.items():
        assert np.array_equal(again.columns[name], column, equal_nan=True), name
    assert np.array_equal(again.step, trace.step)
    assert (again.alarms, again.faults, again.meals, again.info) == (
        trace.alarms,
        trace.faults,
        trace.meals,
        trace.info,
    )
    assert (again.units, again.comments) == (trace.units, trace.comments)
    table = pq.read_table(tmp_path / PARQUET_NAME)
    assert table.schema.field("GlucoseConc").metadata[b"unit"] == b"mg/dL"
    assert b"Interstitial glucose" in table.schema.field("GlucoseConc").metadata[b"comment"]
    assert table.schema.field("InsulinDelivered").metadata[b"unit"] == b"U"
    assert table.column("InsulinRate").null_count == 1  # no value is null, not NaN, for other tools


def test_an_empty_record_is_an_empty_trace(tmp_path: Path) -> None:
    trace = Trace.from_frames(Capture().finish())
    assert len(trace) == 0
    trace.save(tmp_path / PARQUET_NAME)
    assert len(Trace.load(tmp_path)) == 0
    assert trace.fault_spans() == []


def test_load_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"trace\.parquet is missing"):
        Trace.load(tmp_path)
    (tmp_path / PARQUET_NAME).write_bytes(b"no parquet")
    with pytest.raises(ValueError, match=r"trace\.parquet is not a trace"):
        Trace.load(tmp_path)
