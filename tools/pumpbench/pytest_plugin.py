"""The pytest plugin: a `bench` to run firmware on, and on failure what went wrong first, a recording and its picture.

    def test_forty_minutes_without_a_sensor(bench):
        outcome = bench.run(strategy="s4", hours=6, faults=[drop("CGM_Reading", start="02:00", end="02:40")])
        outcome.assert_alarm("CgmLost", after="02:00", within="00:25")

It comes with the package. `--pumpbench-bus` and `--pumpbench-firmware` (or `pumpbench_bus` and `pumpbench_firmware` in
the ini file) say what is tested: nothing given, the reference firmware in this process.
"""

from __future__ import annotations

import html
import shutil
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pumpbench.bench import Fork, Outcome
    from pumpbench.closeups import CloseUp
    from pumpbench.replay import Replay

SETTINGS = {
    "bus": ("inproc", "the bus of every run that names none: inproc, hub, socketcan:vcan0, slcan:/dev/ttyACM0@500000"),
    "device-bus": ("", "the device's side of it, with faults on a bus that is no hub (vcan1 beside vcan0)"),
    "firmware": ("", 'command that starts the firmware; "{bus}" becomes the URL of its bus, "{nvm}" a file'),
    "out": ("pumpbench-failed", "folder for the recordings of failed tests"),
}

SUMMARY = "summary.md"
"""What the failed tests of a session were about, in the folder of their recordings."""

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

    def replay(self, run: Path | Outcome, **keys: Any) -> Replay:
        """What a recorded device heard, fed into the firmware that the command line names: `outcome.assert_same()`.

        See `pumpbench.bench.replay`.
        """
        from pumpbench import bench  # noqa: PLC0415

        defaults: dict[str, Any] = {"bus": _setting(self._config, "bus")}
        firmware = _setting(self._config, "firmware")
        if firmware:
            defaults["firmware"] = firmware
        return bench.replay(run, **(defaults | keys))

    def fork(self, origin: Outcome | Path, at: str | None = None) -> BenchFork:
        """An instant of a run, to go on from on the same bus and with the same firmware; see `pumpbench.bench.Fork`."""
        return BenchFork(self, origin, at)

    def forked(self, origin: Fork, keys: dict[str, Any]) -> Outcome:
        """A continuation."""
        given = {"bus": _setting(self._config, "bus")} | keys
        firmware, device_bus = _setting(self._config, "firmware"), _setting(self._config, "device-bus")
        if firmware and firmware != origin.instant.info["firmware"]:
            given.setdefault("firmware", firmware)
        if device_bus:
            given.setdefault("device_bus", device_bus)
        if given["bus"] != "inproc":
            given.setdefault("out", self._folder / f"run-{len(self._runs)}")
        outcome = origin.run(**given)
        self._runs.append(outcome)
        return outcome


class BenchFork:
    """An instant of a run on a `Bench`."""

    def __init__(self, bench: Bench, origin: Outcome | Path, at: str | None = None) -> None:
        from pumpbench.bench import Fork  # noqa: PLC0415

        self._bench = bench
        self._fork = Fork(origin, at)

    def run(self, **keys: Any) -> Outcome:
        """Go on to the end; see `pumpbench.bench.Fork.run`."""
        return self._bench.forked(self._fork, keys)


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Bench:
    """An insulin pump's controller on a virtual patient: `bench.run(...)` gives what came of a run, to assert on."""
    runs: list[Outcome] = []
    request.node.stash[_RUNS] = runs
    return Bench(request.config, tmp_path, runs)


def pytest_sessionstart(session: pytest.Session) -> None:
    """What an earlier session told of its failed tests is not to be taken for this one's."""
    if not hasattr(session.config, "workerinput"):  # of pytest-xdist's processes, the one that starts the others
        page = Path(_setting(session.config, "out")) / SUMMARY
        if page.is_file():
            page.unlink()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """A failed test keeps its runs, and says of each what went wrong first."""
    report = yield
    if call.when == "call" and report.failed and call.excinfo is not None:
        runs: list[Outcome] = item.stash.get(_RUNS, [])
        for number, outcome in enumerate(runs):
            account = _account(item, outcome, number, call.excinfo.exconly())
            report.sections.append((f"pumpbench run {number}", account))
    return report


def _account(item: pytest.Item, outcome: Outcome, number: int, reason: str) -> str:
    """Keep the run with its pictures, and tell of it."""
    from pumpbench.pictures.summary import write_close_ups  # noqa: PLC0415

    name = item.nodeid.replace("/", "-").replace("::", "-").replace(":", "-")
    folder = (Path(_setting(item.config, "out")) / f"{name}-{number}").absolute()
    try:
        if outcome.folder is None:
            outcome.write(folder, overwrite=True)
        elif outcome.folder != folder:
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(outcome.folder, folder)
        closeups = write_close_ups(outcome.trace, folder)
        with (folder.parent / SUMMARY).open("a", encoding="utf-8") as file:
            file.write(_markdown(f"{item.nodeid}, run {number}", reason, outcome, folder, closeups))
        pictures = [folder / "summary.png", *(path for _, path in closeups)]
        kept = f"recording: {folder / 'recording.rrd'}\n" + "\n".join(f"picture:   {path}" for path in pictures)
    except OSError as error:  # a full disk must not hide what the test found
        kept = f"the run could not be kept: {error}"
    return f"{outcome.title}\n{outcome.story()}\n{kept}\n"


def _markdown(name: str, reason: str, outcome: Outcome, folder: Path, closeups: Iterable[tuple[CloseUp, Path]]) -> str:
    """A section of the page that CI shows. It has no pictures: GitHub renders none that are not on a server."""
    fence = "`" * 4  # a message may quote three
    parts = [f"### {name}", f"{fence}\n{reason}\n{fence}", outcome.title, f"{fence}\n{outcome.story()}\n{fence}"]
    parts.append(f"Kept: `{folder.name}/recording.rrd`, `{folder.name}/summary.png`.")
    for number, (closeup, path) in enumerate(closeups, 1):
        look = f"`{folder.name}/{path.name}`, or `pumpbench view {folder.name} --fault {number}`"
        parts.append(f"<details><summary>{html.escape(closeup.name)}</summary>\n\n{look}\n")
        parts.append(f"{closeup.text(outcome.trace)}\n</details>")
    return "\n\n".join(parts) + "\n\n"
