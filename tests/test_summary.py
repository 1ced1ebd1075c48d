"""The picture of a run: complete, and about what the run was about."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from pumpbench.capture import Capture
from pumpbench.events import AlarmEvent, FaultEvent
from pumpbench.pictures.axes import binned
from pumpbench.pictures.lanes import FAULT, alarm_bars
from pumpbench.pictures.summary import MAX_LINES, _alarm_lines, _headline, write_summary
from pumpbench.trace import Trace
from synthetic_capture import Loop, dropping

INFO = {"patient": "adult#001", "strategy": "s2", "scenario": "synthetic", "seed": 1}


def colours(png: Path) -> np.ndarray:
    picture = imread(png)
    assert picture.shape[:2] == (1000, 1600)
    return np.round(picture[..., :3] * 255).astype(int)


def share(picture: np.ndarray, colour: str) -> float:
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return float((np.abs(picture - wanted).max(axis=2) < 3).mean())


@pytest.fixture(scope="module")
def faulty() -> Trace:
    made = Loop(288, occlusion=range(150, 162), faults=dropping("CGM_Reading", range(24, 36)))
    return Trace.from_frames(made.run().finish(), INFO)


@pytest.fixture(scope="module")
def healthy() -> Trace:
    return Trace.from_frames(Loop(288).run().finish(), INFO)


def test_a_fault_is_red_and_only_there(faulty: Trace, healthy: Trace, tmp_path: Path) -> None:
    write_summary(faulty, tmp_path / "faulty.png")
    write_summary(healthy, tmp_path / "healthy.png")
    assert share(colours(tmp_path / "faulty.png"), FAULT) > 0.0005
    assert share(colours(tmp_path / "healthy.png"), FAULT) == 0


def test_headline(faulty: Trace) -> None:
    computed = _headline(faulty, None)
    assert "in range 70–180: " in computed
    assert "U/day" in computed
    given = _headline(
        faulty, {"tir_70_180": 12.34, "tbr_70": None, "safety": {"hazards": {"H1": 2, "H2": 0, "H3": None}}}
    )
    assert given.startswith("in range 70–180: 12.3 %")
    assert given.endswith("HAZARDS H1×2")
    assert "below" not in given


def test_alarm_bars_and_lines(faulty: Trace) -> None:
    end = float(faulty.time_s[-1])
    bars = alarm_bars(faulty, end)
    assert [(bar.text, bar.start_s // 300, bar.end_s // 300) for bar in bars] == [
        ("CgmLost", 24, 288),
        ("Occlusion", 150, 162),
    ]
    assert [text for text, _ in _alarm_lines(faulty)] == [
        "d0 02:00  CgmLost, not over",
        "d0 12:30  Occlusion, until d0 13:30",
    ]


def test_many_alarms_are_counted_not_piled_up(tmp_path: Path) -> None:
    steps = np.arange(289)
    codes = ["CgmLost", "Occlusion", "PumpLost", "High", "UrgentLow", "Watchdog", "E2EFault"]
    alarms = [
        AlarmEvent(300.0 * k + offset, "CTRL", codes[k % 7], state, "High" if k % 9 == 0 else "Low", k)
        for k in range(0, 280, 2)
        for offset, state in ((0, "Pending"), (250, "Inactive"))
    ]
    faults = [FaultEvent(300.0 * k, f"Kind{k % 8}", "CGM", "CGM_Reading", 3) for k in range(0, 200, 7)]
    trace = Trace({}, steps, steps * 300.0, alarms=sorted(alarms, key=lambda a: a.time_s), faults=faults)
    lines = _alarm_lines(trace)
    assert len(lines) == MAX_LINES
    assert lines[-1][0] == f"and {140 - MAX_LINES + 1} more alarms, see recording.rrd"
    write_summary(trace, tmp_path / "many.png")
    colours(tmp_path / "many.png")


@pytest.mark.parametrize("steps", [0, 1])
def test_any_length(tmp_path: Path, steps: int) -> None:
    frames = Loop(steps).run().finish() if steps else Capture().finish()
    write_summary(Trace.from_frames(frames), tmp_path / "x.png")
    colours(tmp_path / "x.png")


def test_many_days_and_a_stretch_of_them(tmp_path: Path) -> None:
    trace = Trace.from_frames(Loop(4 * 288, occlusion=range(150, 400)).run().finish(), INFO)
    write_summary(trace, tmp_path / "long.png")
    colours(tmp_path / "long.png")
    part = trace.between(10 * 3600.0, 40 * 3600.0)
    assert (part.time_s[0], part.time_s[-1]) == (36000.0, 144000.0)
    assert [alarm.code for alarm in part.alarms] == ["Occlusion", "Occlusion"]
    later = trace.between(15 * 3600.0, 20 * 3600.0)
    assert [(alarm.code, alarm.state, alarm.time_s) for alarm in later.alarms] == [("Occlusion", "Pending", 54000.0)]
    write_summary(part, tmp_path / "part.png")
    colours(tmp_path / "part.png")


def test_bins_are_means_over_what_is_known() -> None:
    values = np.array([1.0, 3.0, np.nan, 5.0, np.nan, np.nan, 7.0, 99.0])  # the last instant leads nowhere
    edges, means = binned(300.0 * np.arange(8), values, 2)
    assert edges.tolist() == [0, 600, 1200, 1800, 2100]
    assert np.array_equal(means, [2.0, 5.0, np.nan, 7.0], equal_nan=True)
