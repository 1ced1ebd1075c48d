"""Fixtures for whole runs: folders of failed tests are kept where PUMPBENCH_KEEP says."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report = yield
    if report.when == "call":
        item.stash[_failed] = report.failed
    return report


_failed: pytest.StashKey[bool] = pytest.StashKey()


@pytest.fixture
def runs(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A directory for run folders."""
    yield tmp_path
    keep = os.environ.get("PUMPBENCH_KEEP")
    if keep and request.node.stash.get(_failed, True):
        shutil.copytree(tmp_path, Path(keep) / request.node.name, dirs_exist_ok=True)


Pumpbench = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def pumpbench(runs: Path) -> Pumpbench:
    """Run the command line as a user does; returns the finished process."""

    def call(*arguments: str | Path, timeout: float = 120.0) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            [sys.executable, "-m", "pumpbench", *map(str, arguments)],
            cwd=runs,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return call
