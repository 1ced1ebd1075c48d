"""A device that runs by itself is reset before the run, and by faults of the node, through a hook or a serial line."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import bench, rig
from pumpbench.faults import Faults, dump, hang, kill, restart
from serial_cable import cable

from can_bus import node_control
from can_bus.node_control import LineControl, NodeControlError

SHORT = {"strategy": "nma", "scenario": "six-hours", "hours": 3.0}
FAULTS = [restart(start="00:50"), restart(start="01:30", end="01:45")]

HOOK = """
import os, signal, subprocess, sys
here = os.path.dirname(os.path.abspath(__file__))
pid, log = os.path.join(here, "pid"), os.path.join(here, "log")
with open(log, "a") as file:
    print(*sys.argv[2:], file=file)
if sys.argv[2] == "cut" and os.path.exists(pid):
    os.kill(int(open(pid).read()), signal.SIGKILL)
    os.remove(pid)
if sys.argv[2] == "start":
    command = [sys.executable, "-m", "firmware_sim", "--bus", sys.argv[1], "--nvm", os.path.join(here, "nvm")]
    board = subprocess.Popen(command, start_new_session=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                             stderr=subprocess.DEVNULL)
    with open(pid, "w") as file:
        print(board.pid, file=file)
"""
"""A board at the end of a wire: it lives on when the run is over."""


@pytest.fixture
def hook(tmp_path: Path) -> Iterator[Path]:
    script = tmp_path / "hook.py"
    script.write_text(HOOK, encoding="utf-8")
    yield script
    pid = tmp_path / "pid"
    if pid.exists():
        with contextlib.suppress(ProcessLookupError):  # the firmware ends with the run
            os.kill(int(pid.read_text()), signal.SIGKILL)


@pytest.fixture(scope="module")
def expected() -> bench.Outcome:
    return bench.run(**SHORT, faults=FAULTS)


def on_a_cable(**more: object) -> bench.Outcome:
    with cable() as (ours, theirs):
        made = {name: value(theirs) if callable(value) else value for name, value in more.items()}
        return bench.run(**SHORT, bus=ours, firmware="none", **made)


def test_a_hook_resets_a_device_that_runs_by_itself(hook: Path, expected: bench.Outcome) -> None:
    outcome = on_a_cable(reset_hook=lambda url: f"{sys.executable} {hook} {url}", faults=FAULTS)
    assert (hook.parent / "log").read_text().split("\n")[:-1] == ["cut", "start kept"] * 3
    assert outcome.frames.sha256() == expected.frames.sha256()
    assert str(outcome.info["reset"]).startswith(f"{sys.executable} {hook}")


def test_without_faults_it_is_reset_once_before_the_run(hook: Path) -> None:
    outcome = on_a_cable(reset_hook=lambda url: f"{sys.executable} {hook} {url}")
    assert (hook.parent / "log").read_text() == "cut\nstart kept\n"
    assert outcome.frames.sha256() == bench.run(**SHORT).frames.sha256()


class Port:
    """A serial port whose RTS holds a board in reset."""

    def __init__(self, board: "Board") -> None:
        self._board = board
        self._rts = True  # as it is where nobody has asked for anything else
        self.dtr = True
        self.open_ = False

    @property
    def rts(self) -> bool:
        return self._rts

    @rts.setter
    def rts(self, asserted: bool) -> None:
        self._rts = asserted
        if self.open_:
            self._board.reset_line(asserted)

    def open(self) -> None:
        self.open_ = True
        self._board.reset_line(self._rts)

    def close(self) -> None:
        self.open_ = False
        self._board.off()


class Board:
    """The reference firmware behind a reset line."""

    def __init__(self, url: str, nvm: Path) -> None:
        self._command = [sys.executable, "-m", "firmware_sim", "--bus", url, "--nvm", str(nvm)]
        self._process: subprocess.Popen[bytes] | None = None
        self.asserted: list[bool] = []

    def reset_line(self, asserted: bool) -> None:
        self.asserted.append(asserted)
        if asserted:
            self.off()
        elif self._process is None:
            self._process = subprocess.Popen(self._command, stderr=subprocess.DEVNULL)

    def off(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def test_a_reset_line_resets_a_device_that_runs_by_itself(
    tmp_path: Path, expected: bench.Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    boards: list[Board] = []

    with cable() as (ours, theirs):

        def port(url: str, *, do_not_open: bool) -> Port:
            assert (url, do_not_open) == ("/dev/board", True)
            boards.append(Board(theirs, tmp_path / "nvm"))
            return Port(boards[0])

        monkeypatch.setattr(node_control, "serial", type("Serial", (), {"serial_for_url": staticmethod(port)}))
        outcome = bench.run(**SHORT, bus=ours, firmware="none", reset_line="rts:/dev/board", faults=FAULTS)
    assert boards[0].asserted == [False] + [True, False] * 3  # opening it resets nothing
    assert outcome.frames.sha256() == expected.frames.sha256()


def test_both_lines_of_a_port() -> None:
    for line, seen in (("rts", "cts"), ("dtr", "dsr")):  # loop:// joins them
        control = LineControl(f"{line}:loop://")
        with contextlib.closing(control):
            port = control._port
            assert not getattr(port, seen)
            control.cut()
            assert getattr(port, seen)
            control.start("kept")
            assert not getattr(port, seen)


def test_what_a_line_cannot_do(tmp_path: Path) -> None:
    with contextlib.closing(LineControl("dtr:loop://")) as control:
        for request in (control.freeze, control.thaw, lambda: control.start("torn")):
            with pytest.raises(NodeControlError, match="a reset line cannot"):
                request()
    for text in ("cts:/dev/ttyUSB0", "rts", "rts:"):
        with pytest.raises(ValueError, match="expected dtr:PORT or rts:PORT"):
            LineControl(text)
    with pytest.raises(NodeControlError, match=f"rts:{tmp_path}/none: .*No such file"):
        LineControl(f"rts:{tmp_path}/none")


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"reset_hook": "x", "reset_line": "rts:y"}, "give --reset-hook or --reset-line"),
        ({"reset_hook": "x", "bus": "inproc", "firmware": None}, "--bus inproc has no device to reset"),
        ({"reset_hook": " "}, "--reset-hook is empty"),
        ({"faults": [kill(start="01:00")]}, "kill: somebody has to do this .* --reset-hook or --reset-line"),
        ({"reset_line": "rts:y", "faults": [hang(start="01:00")]}, "hang: --reset-line can only restart"),
        ({"reset_line": "rts:y", "faults": [restart(start="01:00", memory="lost")]}, "restart: --reset-line can only"),
    ],
)
def test_what_is_refused_before_anything_starts(more: dict[str, object], text: str) -> None:
    fields = {"bus": "socketcan:can7", "firmware": "none"} | more
    fields["faults"] = Faults.of(fields.get("faults", ()))  # type: ignore[arg-type]
    with pytest.raises(rig.RigError, match=text):
        rig.prepare(rig.Request("adult#001", Path("x"), **fields))  # type: ignore[arg-type]


def test_a_hook_that_fails_is_one_line(pumpbench: Pumpbench, runs: Path) -> None:
    refuses = f"{sys.executable} -c \"import sys; sys.exit('no relay')\""
    with cable() as (ours, _theirs):
        run = ("run", "--bus", ours, "--firmware", "none", "--reset-hook", refuses, "--out", runs / "out")
        done = pumpbench(*run)
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "cut ended with status 1: no relay" in done.stderr
    assert not (runs / "out").exists()


def test_a_hook_that_fails_in_the_middle_is_one_line(hook: Path, pumpbench: Pumpbench, runs: Path) -> None:
    hook.write_text(HOOK + "\nif open(log).read().count('start') > 1: sys.exit('the relay is stuck')\n")
    faults = runs / "faults.yaml"
    faults.write_text(dump(FAULTS), encoding="utf-8")
    with cable() as (ours, theirs):
        run = ("run", "--bus", ours, "--firmware", "none", "--reset-hook", f"{sys.executable} {hook} {theirs}")
        done = pumpbench(*run, "--faults", faults, "--days", 0.25, "--out", runs / "out")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "the relay is stuck" in done.stderr


def test_a_reset_line_that_is_none(pumpbench: Pumpbench, runs: Path) -> None:
    with cable() as (ours, _theirs):
        done = pumpbench("run", "--bus", ours, "--firmware", "none", "--reset-line", "cts:x", "--out", runs / "out")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "--reset-line 'cts:x': expected dtr:PORT or rts:PORT" in done.stderr
