"""Fixtures for whole runs: folders of failed tests are kept where PUMPBENCH_KEEP says."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from warm_start import WarmStart

settings.register_profile("pumpbench", deadline=None)  # a busy machine is no failure
settings.load_profile("pumpbench")

ROOT = Path(__file__).parents[1]


LONG_FILES = (
    "test_cortex_m3.py",
    "test_catalogue.py",
    "test_closed_loop.py",
    "test_rig_failures.py",
    "test_conformance_variants.py",
    "test_fork.py",
    "test_live_recorder.py",
    "test_docs.py",
    "test_looks.py",
    "test_study.py",
    "test_doctor.py",
    "test_c_firmware.py",
    "test_conformance.py",
    "test_evidence.py",
)
"""The files that take longest: they begin first, so that at the end no process works alone."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the nightly tests to the night, and begin with the longest files."""
    if not os.environ.get("PUMPBENCH_NIGHTLY"):
        left_out = [item for item in items if item.get_closest_marker("nightly")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("nightly")]
    rank = {name: number for number, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


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


@pytest.fixture(scope="session")
def warm_start(request: pytest.FixtureRequest) -> Iterator[WarmStart | None]:
    """What starts commands; None where each is to start from nothing, at night and for the count of lines."""
    if os.environ.get("PUMPBENCH_NIGHTLY") or request.config.pluginmanager.has_plugin("_cov"):
        yield None
        return
    server = WarmStart()
    yield server
    server.close()


@pytest.fixture
def pumpbench(runs: Path, warm_start: WarmStart | None) -> Pumpbench:
    """Run the command line as a user does; returns the finished process."""

    def call(*arguments: str | Path, timeout: float = 120.0) -> "subprocess.CompletedProcess[str]":
        words = [str(each) for each in arguments]
        if warm_start is not None:
            return warm_start.run(words, runs, timeout)
        return subprocess.run(
            [sys.executable, "-m", "pumpbench", *words],
            cwd=runs,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )

    return call
