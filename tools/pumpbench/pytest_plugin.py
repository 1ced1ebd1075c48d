"""The pytest plugin: a `bench` to run firmware on, and on failure what went wrong first, a recording and its picture.

    def test_forty_minutes_without_a_sensor(bench):
        outcome = bench.run(strategy="s4", hours=6, faults=[drop("CGM_Reading", start="02:00", end="02:40")])
        outcome.assert_alarm("CgmLost", after="02:00", within="00:25")

It comes with the package. `--pumpbench-bus` and `--pumpbench-firmware` (or `pumpbench_bus` and `pumpbench_firmware` in
the ini file) say what is tested: nothing given, the reference firmware in this process.
"""

from __future__ import annotations

import shutil
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pumpbench.bench import Outcome

SETTINGS = {
    "bus": ("inproc", "the bus of every run that names none: inproc, hub, socketcan:vcan0, slcan:/dev/ttyACM0@500000"),
    "device-bus": ("", "the device's side of it, with faults on a bus that is no hub (vcan1 beside vcan0)"),
    "firmware": ("", 'command that starts the firmware; "{bus}" becomes the URL of its bus, "{nvm}" a file'),
    "out": ("pumpbench-failed", "folder for the recordings of failed tests"),
}

_RUNS: pytest.StashKey[list[Outcome]] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options and ini keys of the same meaning."""
    group = parser.getgroup("pumpbench", "pumpbench: an insulin pump's controller on a virtual patient")
    for name, (default, text) in SETTINGS.items():
        group.addoption(f"--pumpbench-{name}", metavar=name.upper(), help=f"{text} (default: {default or 'none'})")
        parser.addini(f"pumpbench_{name.replace('-', '_')}", text, default=default)


def _setting(config: pytest.Config, name: str) -> str:
    key = name.replace("-", "_")
    given = config.getoption(f"pumpbench_{key}")
    return str(config.getini(f"pumpbench_{key}") if given is None else given)


class Bench:
    """Runs firmware, and remembers the runs of a test."""

    def __init__(self, config: pytest.Config, folder: Path, runs: list[Outcome]) -> None:
        self._config = config
        self._folder = folder
        self._runs = runs

    def run(self, **keys: Any) -> Outcome:
        """A run to its end, on the bus and with the firmware that the command line names; see `pumpbench.bench.run`."""
        from pumpbench import bench  # noqa: PLC0415

        defaults: dict[str, Any] = {"bus": _setting(self._config, "bus")}
        for name in ("device-bus", "firmware"):
            value = _setting(self._config, name)
            if value:
                defaults[name.replace("-", "_")] = value
        given = defaults | keys
        if given["bus"] != "inproc":
            given.setdefault("out", self._folder / f"run-{len(self._runs)}")
        outcome = bench.run(**given)
        self._runs.append(outcome)
        return outcome


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Bench:
    """An insulin pump's controller on a virtual patient: `bench.run(...)` gives what came of a run, to assert on."""
    runs: list[Outcome] = []
    request.node.stash[_RUNS] = runs
    return Bench(request.config, tmp_path, runs)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """A failed test keeps its runs, and says of each what went wrong first."""
    report = yield
    if call.when == "call" and report.failed:
        runs: list[Outcome] = item.stash.get(_RUNS, [])
        for number, outcome in enumerate(runs):
            report.sections.append((f"pumpbench run {number}", _account(item, outcome, number)))
    return report


def _account(item: pytest.Item, outcome: Outcome, number: int) -> str:
    """Keep the run, and tell of it."""
    name = item.nodeid.replace("/", "-").replace("::", "-").replace(":", "-")
    folder = (Path(_setting(item.config, "out")) / f"{name}-{number}").absolute()
    try:
        if outcome.folder is None:
            outcome.write(folder, overwrite=True)
        elif outcome.folder != folder:
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(outcome.folder, folder)
        kept = f"recording: {folder / 'recording.rrd'}\npicture:   {folder / 'summary.png'}"
    except OSError as error:  # a full disk must not hide what the test found
        kept = f"the run could not be kept: {error}"
    return f"{outcome.title}\n{outcome.story()}\n{kept}\n"
