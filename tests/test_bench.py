"""A run as a function, and every assertion on it: passing where the run is so, failing with words where it is not."""

from pathlib import Path

import numpy as np
import pytest
from pumpbench import bench, faults
from pumpbench.bench import Outcome
from pumpbench.rig import RigError
from pumpbench.runfolder import RunFolder
from pumpbench.signals import frame_text

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import CAN_ERR_FLAG, CAN_RTR_FLAG, Frame

LOST = faults.drop("CGM_Reading", start="02:00", end="02:40")


@pytest.fixture(scope="module")
def lost() -> Outcome:
    """Forty minutes without a sensor in a run with meals and boluses."""
    return bench.run(strategy="sma", scenario="six-hours", hours=6, faults=[LOST])


def test_what_came_of_it(lost: Outcome) -> None:
    assert lost.hazards == {}
    assert lost.counters["frames_lost"] == 8
    assert [name for _, name in lost.states()] == ["Init", "Auto", "Degraded", "SafeBasal", "Degraded", "Auto"]
    assert [event.code for event in lost.raised(node="CTRL")] == ["StateChange", "CgmLost"]  # the end of Init is told
    assert lost.raised("CgmLost", "PUMP") == []
    assert len(lost.glucose) == 73
    assert lost.minutes_above(250) == 5 * np.count_nonzero(lost.glucose[:-1] > 250)
    assert lost.minutes_below(400) == 5 * 72
    assert repr(lost) == f"<Outcome of {lost.title}>" and "adult#001" in lost.title


def test_the_same_twice_and_a_folder_when_it_is_asked_for(lost: Outcome, tmp_path: Path) -> None:
    again = bench.run(strategy="sma", scenario="six-hours", hours=6, faults=[LOST], out=tmp_path / "run")
    assert again.frames.sha256() == lost.frames.sha256()
    assert lost.folder is None and again.folder == tmp_path / "run"
    read = Outcome.load(tmp_path / "run")
    assert read.frames.sha256() == lost.frames.sha256()
    assert read.metrics["safety"] == again.metrics["safety"]
    assert read.states() == lost.states() and read.title == lost.title


def test_on_a_bus_the_run_leaves_its_folder() -> None:
    outcome = bench.run(strategy="nma", scenario="fasting", hours=1, bus="hub", faults=[LOST])
    assert outcome.folder is not None and RunFolder.load(outcome.folder).info["steps"] == 12
    assert (
        outcome.frames.sha256() == bench.run(strategy="nma", scenario="fasting", hours=1, faults=[LOST]).frames.sha256()
    )


PASS_AND_FAIL = [
    (lambda o: o.assert_state("Degraded", at="02:25"), lambda o: o.assert_state("Auto", at="02:25"),
     r"CTRL was Degraded at 02:25, not Auto; its states: 00:00 Init, 00:05 Auto, 02:15 Degraded, "),
    (lambda o: o.assert_alarm("CgmLost", after="02:00", within="00:20"),
     lambda o: o.assert_alarm("CgmLost", after="02:00", within="00:10"),
     r"CTRL did not raise CgmLost within 00:10 after 02:00; it raised: 00:05 StateChange, 02:15 CgmLost"),
    (lambda o: o.assert_alarm("CgmLost"), lambda o: o.assert_alarm("Occlusion", node="PUMP"),
     r"PUMP did not raise Occlusion after 00:00; it raised: nothing"),
    (lambda o: o.assert_no_alarm("CgmLost", after="03:00"), lambda o: o.assert_no_alarm("CgmLost"),
     r"CTRL raised CgmLost at 02:15"),
    (lambda o: o.assert_back_to("Auto", after="02:40", within="00:15"),
     lambda o: o.assert_back_to("Auto", after="02:30", within="00:05"),
     r"CTRL was SafeBasal, not Auto, 00:05 after 02:30; its states: "),
    (lambda o: o.assert_dose_never_above(insulin_u_per_h=1.5, start="02:15", end="02:40"),
     lambda o: o.assert_dose_never_above(insulin_u_per_h=0.5), r"[\d.]+ U/h of insulin at \d\d:\d\d, above 0.5"),
    (lambda o: o.assert_dose_never_above(insulin_bolus_u=9, pramlintide_bolus_ug=0, pramlintide_ug_per_h=0),
     lambda o: o.assert_dose_never_above(insulin_bolus_u=0.5), r"[\d.]+ U of insulin at once at 01:00, above 0.5"),
    (lambda o: o.assert_no_hazards(), None, ""),
    (lambda o: o.assert_ledger_closes(), None, ""),
]  # fmt: skip


@pytest.mark.parametrize(("holds", "fails", "text"), PASS_AND_FAIL)
def test_assertions_hold_or_say_what_was_found(lost: Outcome, holds, fails, text: str) -> None:  # type: ignore[no-untyped-def]
    holds(lost)
    if fails is not None:
        with pytest.raises(AssertionError, match=text):
            fails(lost)


def test_hazards_and_an_open_ledger_fail(lost: Outcome) -> None:
    safety = lost.safety | {
        "hazards": lost.safety["hazards"] | {"H3": 2},
        "first_hazards": [{"step": 25, "hazard": "H3"}, {"step": 30, "hazard": "H3"}],
        "ledger": {"insulin": {"commanded": 5, "delivered": 3, "pending": 1, "lost": 0, "closes": False}},
    }
    wrong = Outcome(lost.frames, lost.trace, {"safety": safety}, None, lost.info)
    with pytest.raises(AssertionError, match=r"hazards were counted: {'H3': 2}; first: \(25, 'H3'\)"):
        wrong.assert_no_hazards()
    with pytest.raises(AssertionError, match="the insulin ledger does not close"):
        wrong.assert_ledger_closes()
    story = wrong.story()
    assert "02:05  HAZARD H3" in story and "the frames of step 25, in which H3 was found:" in story
    assert "SYNC_Step SyncPhase=Step StepIndex=25" in story


def test_the_story_has_faults_alarms_and_states_in_order(lost: Outcome) -> None:
    lines = lost.story().splitlines()
    assert lines[0] == "00:05  CTRL raises StateChange (Info)"
    assert "02:00  fault Drop CGM_Reading" in lines
    assert "02:15  CTRL raises CgmLost (Medium)" in lines and "02:15  CTRL is Degraded" in lines
    assert lines == sorted(lines, key=lambda line: line[:5])
    assert lost.story(limit=2).splitlines()[-1] == f"... and {len(lines) - 2} more"
    assert lost.frames_of(30, limit=3).splitlines()[-1].startswith("... and ")


def test_frames_in_words() -> None:
    reading = Transmitter().frame(
        "CGM_Reading", CgmState=1, GlucoseConc=8191, GlucoseRate=-50, CgmSampleSeq=3, CgmSampleStep=4
    )
    assert frame_text(reading) == (
        "CGM_Reading CgmState=Ok GlucoseConc=SNA GlucoseRate=-0.5mg/dL/min CgmSampleSeq=3 CgmSampleStep=4"
    )
    cgm = codec.message("CGM_Reading").can_id
    assert frame_text(Frame(cgm, b"\1\2")) == "frame 0x100 [01 02]"
    assert frame_text(Frame(cgm | CAN_RTR_FLAG, bytes(8))).startswith("remote frame 0x100")
    assert frame_text(Frame(CAN_ERR_FLAG | 0x40, bytes(8))).startswith("error frame 0x40")
    assert frame_text(Frame(0x80000001, b"\xff")) == "frame 0x1 (29 bits) [ff]"


def test_arguments_that_make_no_run() -> None:
    with pytest.raises(RigError, match="there is no strategy 's9'"):
        bench.run(strategy="s9")
    with pytest.raises(TypeError, match="'drop' is no fault"):
        bench.run(faults=["drop"])
    with pytest.raises(ValueError, match="a time is"):
        bench.run(scenario="fasting", hours=0.5).state("noon")


# ---- the makers of faults


def test_makers_take_what_is_needed_by_position() -> None:
    assert faults.drop("HB_PUMP", start="01:00") == faults.drop(message="HB_PUMP", start="01:00")
    assert faults.set_value("CGM_Reading", "GlucoseConc", 54).signal == "GlucoseConc"
    assert faults.clock_jump(60).seconds == 60
    assert faults.drop.__doc__ == "The frame is lost."
    with pytest.raises(TypeError, match="drop: takes message in this order"):
        faults.drop("HB_PUMP", message="HB_CGM")
    with pytest.raises(AttributeError, match="no attribute 'drip'"):
        _ = faults.drip


def test_a_fault_as_python_makes_itself_again() -> None:
    for fault in (
        LOST, faults.restart(start="1+01:00", memory="torn"), faults.masquerade("PUMP_Ack", values={"AckId": 3}),
        faults.compression_low(start="01:00", end="02:00"), faults.occlusion("pramlintide", start="00:30"),
    ):  # fmt: skip
        text = faults.call(fault)
        assert eval(text, {"faults": faults}) == fault, text
