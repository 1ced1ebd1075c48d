"""How a recording is shown: close-ups, layouts, pictures by Rerun's viewer and by Matplotlib, and the viewer itself.

The viewer draws off-screen with the Vulkan driver of `tools/with_browser`, so that its pictures are tested everywhere.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import psutil
import pyarrow as pa
import pytest
from conftest import ROOT, Pumpbench
from matplotlib.image import imread
from pumpbench.closeups import LONGEST, MAX_CLOSE_UPS, CloseUp, close_ups
from pumpbench.events import AlarmEvent, FaultEvent
from pumpbench.pictures.lanes import FAULT
from pumpbench.pictures.summary import write_close_ups
from pumpbench.recording import viewing
from pumpbench.recording.columns import wire_bits
from pumpbench.recording.file import APPLICATION
from pumpbench.recording.layout import LAYOUTS, LayoutError, Window, blueprint, views
from pumpbench.recording.scene import Scene, scene_of
from pumpbench.recording.snapshot import Shot, close_up_shots, snapshot
from pumpbench.recording.tool import RecordingError, quiet_environment, rerun_binary
from pumpbench.runfolder import RunFolder
from pumpbench.story import notes
from pumpbench.trace import Trace
from rerun.chunk import RrdReader
from synthetic_capture import Loop, as_frames, dropping

from can_bus.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, Frame

HOUR = 3600.0
INFO = {"patient": "adult#001", "strategy": "s2", "scenario": "synthetic", "seed": 1}
NOT_TO_BE_HAD = 125
NAMES = ["02:00 Drop CGM_Reading, CgmLost", "12:30 Occlusion"]
FILES = ["fault-1-0200-Drop-CGM_Reading-CgmLost.png", "fault-2-1230-Occlusion.png"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A day with a sensor lost from 02:00 to 03:00 and an occlusion from 12:30 to 13:30."""
    made = Loop(288, occlusion=range(150, 162), faults=dropping("CGM_Reading", range(24, 36)))
    out = tmp_path_factory.mktemp("looks") / "run"
    folder = RunFolder.create(out)
    folder.write_all(made.run().finish(), INFO, {"tir_70_180": 87.5})
    return RunFolder.load(out)


@pytest.fixture(scope="module")
def driver() -> dict[str, str]:
    """The environment in which Rerun's viewer draws without a display."""
    names = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "LD_LIBRARY_PATH")
    script = f"import json, os; print(json.dumps({{n: os.environ[n] for n in {names} if n in os.environ}}))"
    done = subprocess.run(
        [ROOT / "tools" / "with_browser", "--", sys.executable, "-c", script],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    if done.returncode == NOT_TO_BE_HAD and not os.environ.get("CI"):
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout)
    return found


@pytest.fixture
def vulkan(driver: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in driver.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def no_vulkan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent.json")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent.json")


def picture(png: Path) -> np.ndarray:
    assert png.read_bytes().startswith(b"\x89PNG")
    found: np.ndarray = np.round(imread(png)[..., :3] * 255).astype(int)
    return found


def is_drawn(png: Path) -> bool:
    """Whether it shows more than a background and a line of text."""
    colours, counts = np.unique(picture(png).reshape(-1, 3), axis=0, return_counts=True)
    return len(colours) > 100 and counts.max() / counts.sum() < 0.97


def reds(png: Path) -> int:
    red, green, blue = np.moveaxis(picture(png), 2, 0)
    return int(((red > 150) & (green < 90) & (blue < 90)).sum())


# ----------------------------------------------------------------------------------------------------------- close-ups


def trace(hours: float, faults: list[FaultEvent] | None = None, alarms: list[AlarmEvent] | None = None) -> Trace:
    steps = np.arange(round(hours * 12) + 1)
    return Trace({}, steps, steps * 300.0, faults=faults or [], alarms=alarms or [])


def fault(start_h: float, end_h: float, kind: str = "Drop") -> list[FaultEvent]:
    keys: dict[str, Any] = {"target": "CGM", "message": "CGM_Reading", "count": 0}
    return [FaultEvent(start_h * HOUR, kind, **keys), FaultEvent(end_h * HOUR, "None", **keys)]


def alarm(hours: float, priority: str = "High", state: str = "Pending", instance: int = 1) -> AlarmEvent:
    return AlarmEvent(hours * HOUR, "CTRL", "CgmLost", state, priority, instance)


def spans(found: list[CloseUp]) -> list[tuple[str, float, float]]:
    return [(each.name, each.start_s / HOUR, each.end_s / HOUR) for each in found]


def test_a_close_up_is_the_hour_before_and_the_time_after() -> None:
    assert spans(close_ups(trace(24, fault(13, 15)))) == [("13:00 Drop CGM_Reading", 12, 16.5)]
    assert spans(close_ups(trace(24, fault(0.5, 23.9)))) == [("00:30 Drop CGM_Reading", 0, 7.5)]  # LONGEST
    assert spans(close_ups(trace(72, fault(49, 50)))) == [("d2 01:00 Drop CGM_Reading", 48, 51.5)]
    assert close_ups(trace(24)) == []
    assert close_ups(Trace({}, np.arange(0), np.zeros(0))) == []


def test_an_alarm_that_stands_is_shown_where_it_begins() -> None:
    assert spans(close_ups(trace(24, alarms=[alarm(10)]))) == [("10:00 CgmLost", 9, 12.5)]
    over = [alarm(10), alarm(10.5, state="Inactive")]
    assert spans(close_ups(trace(24, alarms=over))) == [("10:00 CgmLost", 9, 12)]
    assert close_ups(trace(24, alarms=[alarm(10, "Info")])) == []


def test_what_overlaps_is_one_close_up_as_long_as_it_can_be_seen() -> None:
    near = trace(24, [*fault(3, 4), *fault(5, 6, "Delay")])
    assert spans(close_ups(near)) == [("03:00 Drop CGM_Reading, Delay CGM_Reading", 2, 7.5)]
    far = trace(24, [*fault(3, 4), *fault(7, 8)])
    assert [each.name for each in close_ups(far)] == ["03:00 Drop CGM_Reading", "07:00 Drop CGM_Reading"]
    chain = trace(24, [event for hour in range(1, 23) for event in fault(hour, hour + 0.2)])
    found = close_ups(chain)
    assert all(each.end_s - each.start_s <= LONGEST for each in found)
    for hour in range(1, 23):
        assert any(each.start_s <= hour * HOUR < each.end_s for each in found)


def test_of_many_the_gravest_are_kept_in_order_of_time() -> None:
    alarms = [alarm(6.0 * n, "High" if n in (1, 11) else "Low", instance=n) for n in range(1, 12)]
    found = close_ups(trace(72, alarms=alarms))
    assert len(found) == MAX_CLOSE_UPS
    assert found == sorted(found, key=lambda each: each.start_s)
    assert {"d0 06:00 CgmLost", "d2 18:00 CgmLost"} <= {each.name for each in found}


def test_more_labels_than_fit_are_counted() -> None:
    several = [event for kind in ("Drop", "Delay", "StuckRaw") for event in fault(3, 4, kind)]
    assert close_ups(trace(24, several))[0].name == "03:00 Delay CGM_Reading, Drop CGM_Reading +1"


def test_a_close_up_tells_what_happened_in_it(run: RunFolder) -> None:
    first, second = close_ups(run.trace)
    assert [first.name, second.name] == NAMES
    text = first.text(run.trace)
    assert "| d0 02:00 | fault | Drop CGM_Reading for 60 min |" in text
    assert "| d0 02:00 | alarm | CTRL CgmLost pending (medium) |" in text
    assert "Occlusion" not in text
    assert "PUMP Occlusion over (high)" in second.text(run.trace)


def test_an_alarm_that_is_repeated_is_told_once() -> None:
    states = ["Pending", "Confirmed", "Pending", "Confirmed", "Inactive", "Pending"]
    repeated = trace(24, alarms=[alarm(1 + n, state=state) for n, state in enumerate(states)])
    assert [note.text.split("  ")[1].split()[2] for note in notes(repeated)] == [
        "pending",
        "confirmed",
        "over",
        "pending",
    ]


# -------------------------------------------------------------------------------------------------------------- layout


def shown(scene: Scene, layout: str) -> list[str]:
    tabs = blueprint(scene, layout).root_container
    return [view.name for view in views(tabs.contents[tabs.active_tab])]


def test_views_of_each_layout(run: RunFolder) -> None:
    scene = scene_of(run.recording)
    assert [each.name for each in scene.close_ups] == NAMES
    loop = ["Glucose [mg/dL]", "Insulin: commanded against delivered [U/h, U]"]
    assert shown(scene, "day")[:2] == loop
    assert {"Alarms, injected faults, states", "What happened", "Frames, plant's bus"} <= set(shown(scene, "day"))
    assert {"Frames per step", "Messages per step, device's bus", "Frames, device's bus"} <= set(shown(scene, "bus"))
    assert {"Stomach: content [g]", "Pramlintide in plasma [pmol/L]"} <= set(shown(scene, "patient"))
    assert shown(scene, NAMES[1])[:2] == loop
    alone = Scene(gateway=False)
    assert not any("plant's" in name for layout in LAYOUTS for name in shown(alone, layout))


def test_layouts_and_views_that_there_are_not(run: RunFolder) -> None:
    scene = scene_of(run.recording)
    with pytest.raises(
        LayoutError, match=r"no layout 'week'; there are day, bus, patient, 02:00 Drop CGM_Reading, Cgm"
    ):
        blueprint(scene, "week")
    with pytest.raises(LayoutError, match=r"no view 'Stomach' in Day; there are Glucose \[mg/dL\], Insulin"):
        blueprint(scene, "day", view="Stomach")
    with pytest.raises(LayoutError, match=r"'12:30 Occlusion' has a window of its own"):
        blueprint(scene, NAMES[1], (0.0, HOUR))


@pytest.mark.parametrize("window", [None, (3 * HOUR, 5 * HOUR)])
def test_windows_of_linked_plots_and_of_close_ups(window: Window | None, run: RunFolder, tmp_path: Path) -> None:
    scene = scene_of(run.recording)
    blueprint(scene, window=window).save(APPLICATION, tmp_path / "looks.rbl")
    reader = RrdReader(tmp_path / "looks.rbl")
    found: list[tuple[float, float]] = []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        if "TimeAxis:view_range" in batch.schema.names:
            ((times,),) = batch.column("TimeAxis:view_range").to_pylist()
            found.append((times["start"] / 3.6e12, times["end"] / 3.6e12))
    linked = tuple(hours / HOUR for hours in window or (0.0, 24 * HOUR))
    expected = [(1.0, 4.5)] * 5 + [(11.5, 15.0)] * 5 + [linked]  # the plots and lanes of each, and one for all others
    assert len(found) == len(expected)
    for (start, end), (first, last) in zip(sorted(found), sorted(expected), strict=True):
        span = last - first
        assert (start, end) == pytest.approx((first - 0.17 * span, last + 0.01 * span))  # the legend's room


def test_the_scene_travels_in_the_recording(run: RunFolder, tmp_path: Path) -> None:
    import rerun as rr

    assert scene_of(run.recording) == Scene.of(run.trace, run.frames)
    assert Scene.from_json(Scene().as_json()) == Scene()
    other = tmp_path / "other.rrd"
    with rr.RecordingStream("other") as stream:
        stream.save(other)
        stream.log("text", rr.TextLog("of somebody else"))
    with pytest.raises(ValueError, match=r"other\.rrd does not say how it can be shown"):
        scene_of(other)


def lane(run: RunFolder, entity: str) -> list[tuple[float, str]]:
    """Hours and states of a lane."""
    found: list[tuple[float, str]] = []
    for chunk in RrdReader(run.recording).stream().filter(content=entity, is_static=False):
        batch = chunk.to_record_batch()
        nanos = batch.column("sim_time").cast(pa.int64()).to_pylist()
        states = batch.column("StateChange:state").to_pylist()
        found += [(time / 3.6e12, state[0]) for time, state in zip(nanos, states, strict=True)]
    return found


def test_a_message_that_is_missing_is_a_gap_in_its_lane(run: RunFolder) -> None:
    assert lane(run, "/rate/can0/1_CGM_Reading") == [(0, "1"), (2, ""), (3, "1")]
    assert lane(run, "/rate/can1/1_CGM_Reading") == [(0, "1")]
    assert lane(run, "/rate/can0/2_FAULT_Inject")[1:3] == [(2, "1"), (3, "")]


def test_bits_on_the_wire() -> None:
    """The worst case of textbooks: 135 bits for eight bytes with an identifier of 11 bits, 160 with one of 29."""
    frames = as_frames(
        [
            Frame(0x100, bytes(8)),
            Frame(0x100 | CAN_EFF_FLAG, bytes(8)),
            Frame(0x100, b""),
            Frame(0x100 | CAN_RTR_FLAG, bytes(8)),
        ]
    )
    assert wire_bits(frames).tolist() == [135, 160, 55, 55]


# ------------------------------------------------------------------------------------------------------------ pictures


@pytest.mark.usefixtures("vulkan")
def test_the_viewer_draws_every_layout_and_no_view_complains(run: RunFolder, tmp_path: Path) -> None:
    scene = scene_of(run.recording)
    shots = [Shot(tmp_path / f"{layout}.png", layout) for layout in LAYOUTS] + close_up_shots(scene, tmp_path / "new")
    assert snapshot(run.recording, shots, size=(1200, 800)) == "drawn by Rerun's viewer, off-screen"
    assert [shot.path.name for shot in shots[3:]] == FILES
    drawn = [picture(shot.path) for shot in shots]
    for index, shot in enumerate(shots):
        assert drawn[index].shape == (800, 1200, 3)
        assert is_drawn(shot.path), shot
        for other in drawn[:index]:
            assert (drawn[index] != other).any(axis=2).mean() > 0.02, shot
    assert reds(shots[3].path) > 1000  # the lane of the dropped message
    assert reds(shots[4].path) > 1000  # that of the alarm of high priority


@pytest.mark.nightly
@pytest.mark.usefixtures("vulkan")
def test_the_viewer_draws_a_window_and_a_single_view(run: RunFolder, tmp_path: Path) -> None:
    shots = [
        Shot(tmp_path / "before.png", window=(0.5 * HOUR, 1.5 * HOUR)),
        Shot(tmp_path / "lost.png", window=(2.1 * HOUR, 2.9 * HOUR)),
        Shot(tmp_path / "view.png", "patient", view="Stomach: content [g]"),
    ]
    assert snapshot(run.recording, shots, size=(1200, 800)) == "drawn by Rerun's viewer, off-screen"
    assert reds(shots[1].path) > reds(shots[0].path) + 5000  # all of the window is fault
    green = picture(shots[2].path)
    assert ((green[..., 1] > 150) & (green[..., 0] < 120) & (green[..., 2] < 130)).sum() > 500  # only that line


@pytest.mark.usefixtures("no_vulkan")
@pytest.mark.nightly
def test_matplotlib_draws_the_same_files(run: RunFolder, tmp_path: Path) -> None:
    scene = scene_of(run.recording)
    shots = [Shot(tmp_path / f"{layout}.png", layout) for layout in LAYOUTS] + close_up_shots(scene, tmp_path / "new")
    shots.append(Shot(tmp_path / "window.png", "bus", (2.1 * HOUR, 2.9 * HOUR)))
    how = snapshot(run.recording, shots)
    assert how.startswith("drawn by Matplotlib, because Rerun's viewer cannot draw here: it ended with status")
    assert [shot.path.name for shot in shots[3:5]] == FILES
    for shot in shots:
        assert picture(shot.path).shape == (1000, 1600, 3)
        assert is_drawn(shot.path), shot
    colour = [int(FAULT[i : i + 2], 16) for i in (1, 3, 5)]
    assert len({shot.path.read_bytes() for shot in shots}) == len(shots)
    fault_drawn = [(np.abs(picture(shot.path) - colour).max(axis=2) < 3).sum() for shot in shots]
    assert all(count > 500 for count in fault_drawn)
    assert fault_drawn[3] > 2 * fault_drawn[0]  # closer


def test_close_ups_of_a_run_without_a_viewer(run: RunFolder, tmp_path: Path) -> None:
    drawn = write_close_ups(run.trace, tmp_path)
    assert [(closeup.name, path.name) for closeup, path in drawn] == list(zip(NAMES, FILES, strict=True))
    assert all(is_drawn(path) for _, path in drawn)


# ------------------------------------------------------------------------------------------------------------ commands


def test_snapshot_as_a_command(run: RunFolder, tmp_path: Path, pumpbench: Pumpbench) -> None:
    done = pumpbench("snapshot", run.path, "--faults", "--out", tmp_path / "pictures")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(tmp_path / "pictures" / name) for name in FILES]
    assert done.stderr.startswith("drawn by ")
    copied = Path(shutil.copytree(run.path, tmp_path / "copied"))
    done = pumpbench("snapshot", copied, "--layout", "bus", "--window", "01:30-03:30")
    assert done.stdout.split() == [str(copied / "bus.png")]
    assert is_drawn(copied / "bus.png")


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["snapshot", "RUN", "--window", "02:00"], 2, "--window 02:00: it is from-to, as 01:30-03:30"),
        (["snapshot", "RUN", "--window", "03:00-02:00"], 2, "--window 03:00-02:00: it ends before it begins"),
        (["snapshot", "RUN", "--window", "1+02:00-1+03:00"], 2, "--window 1+02:00-1+03:00: the run is from 00:00 to"),
        (["snapshot", "RUN", "--layout", "week"], 2, "no layout 'week'; there are day, bus, patient, 02:00 Drop"),
        (["snapshot", "RUN", "--layout", "bus", "--faults"], 2, "--faults has its own layout and windows"),
        (["snapshot", "nowhere"], 2, "there is no run folder nowhere"),
        (["snapshot", "RUN/metrics.json"], 2, "metrics.json is no recording"),
        (["view", "RUN", "--web", "--at", "noon"], 2, '--at noon: a time is "hh:mm"'),
        (["view", "RUN", "--web", "--at", "3+00:00"], 2, "--at 3+00:00: the run is from 00:00 to 1+00:00"),
        (
            ["view", "RUN", "--web", "--fault", "3"],
            2,
            "there is no close-up 3: 1 is 02:00 Drop CGM_Reading, CgmLost; 2",
        ),
        (["view", "RUN", "--web", "--fault", "1", "--at", "02:00"], 2, "--fault has its own layout and window"),
        (
            ["view", "rerun+http://127.0.0.1:1/proxy", "--web", "--fault", "1"],
            2,
            "/proxy is being made and has its own looks",
        ),
        (
            ["view", "rerun+http://elsewhere:1/proxy", "--web"],
            3,
            "a page shows what is served on 127.0.0.1, with its port",
        ),
        (["view"], 2, "there is no run below runs/"),
        (["view", "RUN"], 3, "there is no display"),
    ],
)
def test_what_is_wrong_is_one_line(
    arguments: list[str],
    status: int,
    text: str,
    run: RunFolder,
    pumpbench: Pumpbench,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = pumpbench(*(each.replace("RUN", str(run.path)) for each in arguments))
    assert (done.returncode, done.stdout) == (status, "")
    assert done.stderr.startswith("pumpbench: ")
    assert text in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_viewer_that_fails_is_one_line(run: RunFolder, pumpbench: Pumpbench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = pumpbench("view", run.path)
    assert done.returncode == 3
    assert done.stderr.startswith("pumpbench: Rerun's viewer ended with status ")
    assert done.stderr.count("\n") == 1


def test_the_viewer_is_given_the_looks_that_are_asked_for(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextlib.contextmanager
    def viewer(arguments: list[str], _scratch: Path) -> Iterator["subprocess.Popen[bytes]"]:
        given.append(arguments)
        if arguments[-1].endswith(".rbl"):
            shutil.copy(arguments[-1], tmp_path / "looks.rbl")
        with subprocess.Popen(["true"]) as process:
            yield process

    given: list[list[str]] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(viewing, "viewer", viewer)
    viewing.open_window(run.recording)
    assert given == [["--bind", "127.0.0.1", "--port", "auto", str(run.recording)]]  # the recording has its own looks
    viewing.open_window(run.recording, layout="bus", window=(HOUR, 3 * HOUR))
    assert given[1][:5] == given[0]
    reader = RrdReader(tmp_path / "looks.rbl")
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[0])]
    ends = [
        batch.column("TimeAxis:view_range").to_pylist()[0][0]["end"] / 3.6e12
        for batch in batches
        if "TimeAxis:view_range" in batch.schema.names
    ]
    assert pytest.approx(3.02) in ends
    viewing.open_window("rerun+http://127.0.0.1:1/proxy", layout="patient")
    assert given[2][4] == "rerun+http://127.0.0.1:1/proxy"
    assert given[2][5].endswith(".rbl")


def test_a_recording_that_was_cut_off_is_shown(run: RunFolder, tmp_path: Path) -> None:
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(run.recording.read_bytes()[: run.recording.stat().st_size * 2 // 3])
    command = [rerun_binary(), "rrd", "verify"]
    environment = quiet_environment(tmp_path)
    assert subprocess.run([*command, cut], env=environment, capture_output=True, check=False).returncode != 0
    with viewing.readable(cut) as whole:
        subprocess.run([*command, whole], env=environment, capture_output=True, check=True)
        assert scene_of(whole) == scene_of(run.recording)
    with viewing.readable(run.recording) as whole:
        assert whole == run.recording
    nothing = tmp_path / "nothing.rrd"
    nothing.write_bytes(b"no recording")
    with pytest.raises(RecordingError, match=r"nothing\.rrd is no recording"), viewing.readable(nothing):
        pass


@pytest.fixture
def served(run: RunFolder) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`pumpbench view --web`, and the address it prints."""
    process = subprocess.Popen(
        [sys.executable, "-m", "pumpbench", "view", str(run.path), "--web", "--fault", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    yield process, process.stdout.readline().strip()
    if process.poll() is None:
        process.terminate()  # not killed: it has a viewer to end
    process.communicate(timeout=30)


def test_the_page_shows_the_recording_and_talks_to_nobody_else(served: tuple[Any, str]) -> None:
    _, address = served
    parts = urlsplit(address)
    (source,) = parse_qs(parts.query)["url"]
    assert parts.hostname == "127.0.0.1"
    assert source.startswith("rerun+http://127.0.0.1:")
    with urllib.request.urlopen(address) as answer:
        policy = answer.headers["Content-Security-Policy"]
        assert b"re_viewer" in answer.read()
    port = urlsplit(source).port
    assert set(re.findall(r"https?://\S+|\*", policy)) == {f"http://127.0.0.1:{port}", f"http://localhost:{port}"}
    with urllib.request.urlopen(f"http://{parts.netloc}/re_viewer_bg.wasm") as answer:
        assert answer.headers["Content-Type"] == "application/wasm"
        assert answer.read(4) == b"\0asm"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://{parts.netloc}/nothing")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_page_and_leaves_no_process(number: signal.Signals, served: tuple[Any, str]) -> None:
    process, _ = served
    children = psutil.Process(process.pid).children(recursive=True)
    assert [child.name() for child in children] == ["rerun"]
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, f"pumpbench: interrupted by {number.name}\n")
    assert not any(child.is_running() for child in children)
