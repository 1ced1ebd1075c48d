"""The run folder: complete or not there, read back with errors that name the file."""

import errno
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pumpbench import runfolder
from pumpbench.frames import Frames
from pumpbench.runfolder import FILES, RunFolder, RunFolderError
from synthetic_capture import Loop

INFO = {"patient": "adult#001", "strategy": "s2", "seed": 1}
METRICS: dict[str, Any] = {"tir_70_180": np.float64(71.5), "cv": float("nan"), "safety": {"hazards": {"H1": None}}}


@pytest.fixture(scope="module")
def frames() -> Frames:
    return Loop(30).run().finish()


@pytest.fixture(scope="module")
def written(frames: Frames, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    RunFolder.create(out).write_all(frames, INFO, METRICS)
    return out


@pytest.fixture
def copy(written: Path, tmp_path: Path) -> Path:
    target = tmp_path / "run"
    target.mkdir()
    for file in written.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


def test_everything_is_in_it(written: Path, frames: Frames) -> None:
    assert sorted(file.name for file in written.iterdir()) == sorted(FILES)
    assert not written.with_name("run.partial").exists()
    folder = RunFolder.load(written)
    assert folder.info == INFO | {"complete": True, "frames": len(frames), "trace_sha256": frames.sha256()}
    assert folder.metrics == {"tir_70_180": 71.5, "cv": None, "safety": {"hazards": {"H1": None}}}
    assert folder.frames.sha256() == frames.sha256()
    assert folder.trace.step[-1] == 30
    assert folder.trace.info == folder.info
    assert folder.recording.is_file()
    assert folder.summary.is_file()


def test_the_caller_is_not_changed(frames: Frames, tmp_path: Path) -> None:
    before = json.dumps(INFO)
    RunFolder.create(tmp_path / "x").write_partial(frames, INFO)
    assert json.dumps(INFO) == before


def test_nothing_has_the_name_before_the_end(frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "deep" / "run"
    folder = RunFolder.create(out)
    assert not out.exists()
    assert out.with_name("run.partial").is_dir()

    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(runfolder, "write_candump", full)
    with pytest.raises(
        RunFolderError, match=r"cannot write bus\.log: the disk is full \(\d+ KiB free\); .*run\.partial"
    ):
        folder.write_all(frames, INFO, METRICS)
    assert not out.exists()
    with pytest.raises(RunFolderError, match=r"no run folder .*run; an unfinished one is .*run\.partial"):
        RunFolder.load(out)
    with pytest.raises(RunFolderError, match=r"run\.partial is unfinished: .* missing"):
        RunFolder.load(out.with_name("run.partial"))
    monkeypatch.undo()
    RunFolder.create(out).write_all(frames, INFO, METRICS)  # the unfinished one makes room
    RunFolder.load(out)


def test_a_failing_recording_is_named(frames: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pumpbench.recording.tool.rerun_binary", lambda: "/bin/false")
    with pytest.raises(RunFolderError, match=r"cannot write recording\.rrd: rerun rrd optimize failed: no message"):
        RunFolder.create(tmp_path / "run").write_all(frames, INFO, METRICS)
    assert {"run.json", "bus.log", "trace.parquet", "metrics.json"} == {
        file.name for file in (tmp_path / "run.partial").iterdir()
    }


def test_a_run_cut_off_stays_partial(frames: Frames, tmp_path: Path) -> None:
    out = tmp_path / "run"
    RunFolder.create(out).write_partial(frames.select(np.arange(100)), INFO)
    partial = out.with_name("run.partial")
    assert not out.exists()
    assert json.loads((partial / "run.json").read_text())["complete"] is False
    assert len((partial / "bus.log").read_text().splitlines()) == 100
    folder = RunFolder.create(out)
    folder.discard()
    assert not partial.exists()


def test_only_run_folders_are_ever_replaced(copy: Path, frames: Frames, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="already holds a run"):
        RunFolder.create(copy)
    (copy / "notes.txt").write_text("mine")
    before = {file.name: hashlib.sha256(file.read_bytes()).digest() for file in copy.iterdir()}
    folder = RunFolder.create(copy, overwrite=True)
    assert before == {file.name: hashlib.sha256(file.read_bytes()).digest() for file in copy.iterdir()}
    folder.write_all(frames, INFO | {"seed": 2}, METRICS)
    assert RunFolder.load(copy).info["seed"] == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]

    other = tmp_path / "thesis"
    other.mkdir()
    RunFolder.create(other).discard()  # an empty folder is fine
    (other / "chapter1.tex").write_text("precious")
    for overwrite in (False, True):
        with pytest.raises(RunFolderError, match="is no run folder: it is not touched"):
            RunFolder.create(other, overwrite=overwrite)
    (tmp_path / "file").write_text("x")
    with pytest.raises(RunFolderError, match="exists and is not a folder"):
        RunFolder.create(tmp_path / "file")
    blocked = tmp_path / "blocked.partial"
    blocked.mkdir()
    (blocked / "photo.jpg").write_text("x")
    with pytest.raises(RunFolderError, match="is in the way"):
        RunFolder.create(tmp_path / "blocked")
    with pytest.raises(RunFolderError, match="cannot make"):
        RunFolder.create(tmp_path / "file" / "below")
    assert (other / "chapter1.tex").read_text() == "precious"


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(copy: Path, name: str) -> None:
    (copy / name).unlink()
    with pytest.raises(RunFolderError, match=f"not a complete run folder: {name} missing"):
        RunFolder.load(copy)


@pytest.mark.parametrize(
    ("name", "attribute", "content"),
    [
        ("run.json", "info", "{"),
        ("run.json", "info", "[]"),
        ("metrics.json", "metrics", "\x00"),
        ("bus.log", "frames", "(0.0) can0 100#00\nnot a frame\n"),
        ("trace.parquet", "trace", "PAR1"),
    ],
)
def test_a_corrupt_file_is_named(copy: Path, name: str, attribute: str, content: str) -> None:
    (copy / name).write_text(content)
    with pytest.raises(RunFolderError, match=name.replace(".", r"\.")):
        getattr(RunFolder.load(copy), attribute)


def test_a_changed_log_is_noticed(copy: Path) -> None:
    log = copy / "bus.log"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:50] + lines[51:]))
    with pytest.raises(RunFolderError, match=r"bus\.log was changed"):
        _ = RunFolder.load(copy).frames
    (copy / "run.json").write_text(json.dumps(RunFolder.load(copy).info | {"dbc_crc32": "0badcafe"}))
    with pytest.raises(RunFolderError, match=r"bus\.log was recorded with another pumpbench\.dbc: CRC-32 0badcafe"):
        _ = RunFolder.load(copy).frames


def test_fourteen_days_take_seconds(tmp_path: Path) -> None:
    capture = Loop(14 * 288).run()
    start = time.process_time()
    RunFolder.create(tmp_path / "run").write_all(capture.finish(), INFO, METRICS)
    assert time.process_time() - start < 10  # 2 s on an idle core; the rest is for a busy machine
