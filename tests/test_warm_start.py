"""A command that was forked cannot be told from one that was started."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from conftest import ROOT
from warm_start import WarmStart


@pytest.fixture(scope="module")
def warm() -> Iterator[WarmStart]:
    server = WarmStart()
    yield server
    server.close()


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        (["--version"], 0),
        (["run", "--patient", "nobody"], 2),
        (["run", "--days", "0.01", "--bus", "inproc", "--out", "out"], 0),
    ],
)
def test_output_status_and_files_are_the_same(
    arguments: list[str], status: int, warm: WarmStart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    found = []
    for place in (tmp_path / "forked", tmp_path / "started"):
        place.mkdir()
        if place.name == "forked":
            done = warm.run(arguments, place, 240.0)
        else:
            command = [sys.executable, "-m", "pumpbench", *arguments]
            done = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=240.0, check=False)
        files = {str(each.relative_to(place)) for each in place.rglob("*")}
        found.append((done.returncode, done.stdout, done.stderr, files))
    assert found[0] == found[1]
    assert found[0][0] == status


def test_the_environment_is_that_of_the_test(warm: WarmStart, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "device"
    device.write_text("#!/bin/sh\nexit 7\n")
    device.chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    done = warm.run(["run", "--firmware", "device", "--out", "out"], tmp_path, 240.0)
    assert (done.returncode, "ended with status 7" in done.stderr) == (3, True), done.stderr


def test_a_command_that_takes_too_long_is_killed(warm: WarmStart, tmp_path: Path) -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        warm.run(["run", "--days", "14", "--out", "out"], tmp_path, 0.2)
    _, alive = psutil.wait_procs(psutil.Process(warm.pid).children(recursive=True), timeout=20)
    assert not alive
    assert not (tmp_path / "out").exists()


def test_it_ends_with_its_owner() -> None:
    owner = f"import sys; sys.path.insert(0, {str(ROOT / 'tests')!r}); from warm_start import WarmStart\n"
    owner += "print(WarmStart().pid, flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", owner], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        server = psutil.Process(int(process.stdout.readline()))
        process.kill()
    _, alive = psutil.wait_procs([server], timeout=60)
    assert not alive
