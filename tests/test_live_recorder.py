"""The recorder on a bus: watched while it records, ended in every way, and what is left then."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Pumpbench
from live_bus import (
    HALF,
    LIMIT,
    RECORDER,
    RUN,
    Bus,
    children,
    count_so_far,
    frames_of,
    free_port,
    same_as_log,
    until,
    verifies,
    viewer,
)
from pumpbench.candump import read_candump
from pumpbench.capture import Capture
from pumpbench.recorder import __main__ as recorder
from pumpbench.recorder.repair import repair
from pumpbench.rig import Request, RigError, prepare
from pumpbench.runfolder import RunFolder, RunFolderError
from pumpbench.trace import Trace

from can_bus.hub import Hub


@pytest.fixture
def bus(runs: Path) -> Iterator[Bus]:
    with Hub(f"unix:{runs}/bus.sock") as hub, hub.local_link() as link:
        yield Bus(runs, hub, link)


def check_partial(bus: Bus) -> None:
    """An unfinished folder with everything that was said, and no journal any more."""
    expected = bus.record()
    assert not bus.out.exists()
    assert {"run.json", "bus.log", "trace.parquet", "recording.rrd"} == {file.name for file in bus.partial.iterdir()}
    info = json.loads((bus.partial / "run.json").read_text())
    assert info["complete"] is False
    assert info["bus"] == bus.url
    assert info["device"]["version"] == "0.1"
    assert info["frames"] == len(expected)
    assert read_candump(bus.partial / "bus.log").sha256() == info["trace_sha256"] == expected.sha256()
    assert len(Trace.load(bus.partial)) == expected.step.max() + 1
    assert same_as_log(bus.partial / "recording.rrd", bus.partial / "bus.log")
    assert verifies(bus.partial / "recording.rrd", bus.folder)


# ---------------------------------------------------------------------------------------------------------- live


def test_watched_at_full_speed(runs: Path, pumpbench: Pumpbench) -> None:
    """Nobody waits for who watches: the bytes of the run are those of a run that nobody watches."""
    port = free_port()
    done = pumpbench("run", "--out", runs / "watched", "--serve", str(port))
    assert done.returncode == 0, done.stderr
    assert f"rerun --connect rerun+http://127.0.0.1:{port}/proxy" in done.stderr
    assert same_as_log(runs / "watched" / "recording.rrd", runs / "watched" / "bus.log")
    assert verifies(runs / "watched" / "recording.rrd", runs)
    assert pumpbench("run", "--bus", "inproc", "--out", runs / "alone").returncode == 0
    hashes = {json.loads((runs / name / "run.json").read_text())["trace_sha256"] for name in ("watched", "alone")}
    assert len(hashes) == 1


def test_a_viewer_gets_every_frame_while_the_run_is_on(bus: Bus) -> None:
    port = free_port()
    with bus.recorder("--serve", str(port)) as process:
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        with viewer(url, bus.folder / "early.rrd", bus.folder):
            bus.say(HALF)
            bus.until(lambda: count_so_far(bus.folder / "early.rrd") > 300, "what was said so far")
            with viewer(url, bus.folder / "late.rrd", bus.folder):
                bus.say(RUN[len(HALF) :])
                assert bus.end(process) == (0, "")
    assert verifies(bus.out / "recording.rrd", bus.folder)
    for name in ("early", "late"):
        assert same_as_log(bus.folder / f"{name}.rrd", bus.out / "bus.log"), name


def follow_on(url: str, runs: Path) -> None:
    """Plant, firmware, a recorder and a viewer on a bus, at full speed."""
    port = free_port()
    names = ("plant", "firmware", "recorder")
    with contextlib.ExitStack() as stack:
        logs = {name: stack.enter_context((runs / f"{name}.log").open("w+")) for name in names}

        def start(name: str, *arguments: str) -> "subprocess.Popen[bytes]":
            command = [sys.executable, "-m", "pumpbench", *arguments]
            process = subprocess.Popen(command, stdout=logs[name], stderr=subprocess.STDOUT, cwd=runs)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        def said(name: str) -> str:
            return (runs / f"{name}.log").read_text()

        recorder = start("recorder", "record", "--bus", url, "--out", "out", "--serve", str(port))
        until(lambda: "live:" in said("recorder"), "the recorder")
        with viewer(f"rerun+http://127.0.0.1:{port}/proxy", runs / "viewer.rrd", runs):
            start("plant", "plant", "--bus", url, "--days", "0.25")
            start("firmware", "firmware", "--bus", url)
            assert recorder.wait(LIMIT) == 0, said("recorder")
    assert same_as_log(runs / "out" / "recording.rrd", runs / "out" / "bus.log")
    assert same_as_log(runs / "viewer.rrd", runs / "out" / "bus.log")
    assert verifies(runs / "out" / "recording.rrd", runs)


def test_beside_plant_and_firmware_on_a_hub(runs: Path) -> None:
    with Hub(f"unix:{runs}/bus.sock") as hub:
        thread = threading.Thread(target=hub.serve_forever)
        thread.start()
        try:
            follow_on(hub.urls[0], runs)
        finally:
            hub.stop()
            thread.join()


@pytest.mark.vcan
def test_beside_plant_and_firmware_on_vcan(runs: Path) -> None:
    follow_on("socketcan:vcan0", runs)


def test_the_record_goes_on_without_its_view(bus: Bus) -> None:
    with bus.recorder("--serve", str(free_port())) as process:
        bus.say(HALF)
        bus.until(bus.heard, "the first half")
        (view,) = children(process.pid)
        os.kill(view, signal.SIGKILL)
        bus.say(RUN[len(HALF) :])
        status, errors = bus.end(process)
    assert status == 3
    # whether the run was still on when that was noticed is a matter of who was faster
    assert re.fullmatch(r"recorder: the live view failed: it ended with status -9(; the record goes .*)?\n", errors)
    assert RunFolder.load(bus.out).frames.sha256() == bus.record().sha256()
    assert verifies(bus.out / "recording.rrd", bus.folder)


def test_a_new_run_on_the_bus_is_a_new_recording(bus: Bus) -> None:
    """The plant broke off and was started anew: the first part is no part of the record, and the view begins again."""
    port = free_port()
    with bus.recorder("--serve", str(port)) as process:
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        with viewer(url, bus.folder / "first.rrd", bus.folder):
            bus.say(HALF[:-7])
            bus.until(lambda: count_so_far(bus.folder / "first.rrd") > 300, "the first run")
            bus.said = []
            bus.say(HALF)
            (view,) = children(process.pid)
            bus.until(lambda: b"--skip" in Path(f"/proc/{view}/cmdline").read_bytes(), "the view of the second run")
        bus.until(lambda: connects(port), "its server")
        with viewer(url, bus.folder / "second.rrd", bus.folder):
            bus.say(RUN[len(HALF) :])
            assert bus.end(process) == (0, "")
    assert read_candump(bus.out / "bus.log").sha256() == bus.record().sha256()
    assert same_as_log(bus.folder / "second.rrd", bus.out / "bus.log")


def connects(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False


# ---------------------------------------------------------------------------------------------------------- its end


@pytest.mark.parametrize(
    ("number", "watched"), [(signal.SIGTERM, True), pytest.param(signal.SIGINT, False, marks=pytest.mark.nightly)]
)
def test_asked_to_end_it_writes_what_there_is(number: signal.Signals, watched: bool, bus: Bus) -> None:
    with bus.recorder(*(["--serve", str(free_port())] if watched else [])) as process:
        bus.say(HALF)
        for pid in (*children(process.pid), process.pid):  # as a service manager asks
            os.kill(pid, number)
        assert bus.end(process) == (0, "")
    check_partial(bus)


def test_what_was_said_before_the_signal_is_heard(bus: Bus) -> None:
    with bus.recorder() as process:
        bus.say(RUN[:200])
        bus.until(bus.heard, "what was said")
        process.send_signal(signal.SIGSTOP)
        bus.say(RUN[200:400])
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGCONT)
        assert bus.end(process) == (0, "")
    check_partial(bus)


@pytest.mark.parametrize("watched", [pytest.param(False, marks=pytest.mark.nightly), True])
def test_killed_it_leaves_what_it_heard(watched: bool, bus: Bus, pumpbench: Pumpbench) -> None:
    with bus.recorder(*(["--serve", str(free_port())] if watched else [])) as process:
        bus.say(HALF)
        bus.until(bus.heard, "what was said")
        for pid in [*children(process.pid), process.pid]:
            os.kill(pid, signal.SIGKILL)
        process.wait()
    done = pumpbench("record", "--repair", bus.partial)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{bus.partial}\n"
    check_partial(bus)
    assert repair(bus.partial) == bus.partial  # again, now from the log
    check_partial(bus)


def test_what_a_killed_recorder_left_is_mended_by_whoever_looks_at_it(bus: Bus, pumpbench: Pumpbench) -> None:
    with bus.recorder() as process:
        bus.say(HALF)
        bus.until(bus.heard, "what was said")
        process.kill()
        process.wait()
    done = pumpbench("snapshot", bus.partial, "--out", bus.folder / "day.png")
    assert done.returncode == 0, done.stderr
    assert "its recorder did not come to its end" in done.stderr
    assert (bus.folder / "day.png").is_file()
    check_partial(bus)


def test_a_view_outlives_a_killed_recorder_to_complete_its_file(bus: Bus) -> None:
    with bus.recorder("--serve", str(free_port())) as process:
        bus.say(HALF)
        bus.until(bus.heard, "what was said")
        (view,) = children(process.pid)
        process.kill()
        process.wait()
        bus.until(lambda: not Path(f"/proc/{view}").exists(), "the end of the view")
    assert verifies(bus.partial / "recording.rrd", bus.folder)
    assert len(frames_of(bus.partial / "recording.rrd")) == len(bus.record())


def test_a_frame_torn_by_the_kill_is_left_out(bus: Bus) -> None:
    bus.said = HALF
    bus.partial.mkdir()
    capture = Capture()
    journal = RunFolder(bus.out).begin({"bus": bus.url}, 1)
    keeping = Capture(journal.keep)
    keeping.extend(0, HALF)
    journal.close()
    with (bus.partial / "can0.frames").open("ab") as file:
        file.write(b"\x55" * 9)
    assert len(capture) == 0
    repair(bus.partial)
    check_partial(bus)


def test_what_is_no_remainder_is_not_touched(bus: Bus, pumpbench: Pumpbench) -> None:
    with bus.recorder() as process:
        bus.say(HALF)
        with pytest.raises(RunFolderError, match="is still being recorded"):
            repair(bus.partial)
        process.send_signal(signal.SIGTERM)
        assert bus.end(process) == (0, "")
    check_partial(bus)
    empty = bus.folder / "empty.partial"
    empty.mkdir()
    for folder, text in (
        (bus.folder, "is no unfinished run folder"),
        (empty, "holds neither a journal nor a bus.log"),
    ):
        done = pumpbench("record", "--repair", folder)
        assert done.returncode == 2
        assert text in done.stderr
        assert len(done.stderr.splitlines()) == 1
    (bus.partial / "bus.log").write_text("(0.0) can0 nonsense\n")
    assert "bus.log" in pumpbench("record", "--repair", bus.partial).stderr


# ---------------------------------------------------------------------------------------------------------- disk, port

SMALL_DISK = """
set -e
mount -t tmpfs -o size={size} tmpfs "$1"
shift
status=0
"$@" || status=$?
mount -o remount,size=100M tmpfs "$OUT"
{python} -m pumpbench record --repair "$OUT/out.partial" >&2
mkdir "$KEPT" && cp -r "$OUT/out.partial/." "$KEPT"
exit $status
"""


@pytest.fixture
def small_disk(runs: Path) -> Iterator[Callable[[str], list[str]]]:
    """A command that runs another one with a full disk at `runs`/disk, and repairs what it left when there is room."""
    probe = subprocess.run(
        ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False
    )
    if probe.returncode and not os.environ.get("CI"):
        pytest.skip("no file system of one's own here: " + probe.stderr.decode())
    disk = runs / "disk"
    disk.mkdir()

    def command(size: str) -> list[str]:
        script = SMALL_DISK.replace("{size}", size).replace("{python}", sys.executable)
        environment = [f"OUT={disk}", f"KEPT={runs / 'out.partial'}"]
        return ["env", *environment, "unshare", "-rm", "sh", "-c", script, "sh", str(disk), *RECORDER]

    yield command


@pytest.mark.parametrize(("watched", "size"), [pytest.param(False, "8k", marks=pytest.mark.nightly), (True, "200k")])
def test_a_full_disk_is_told_and_stops_nobody_else(
    watched: bool, size: str, bus: Bus, small_disk: Callable[[str], list[str]]
) -> None:
    real, bus.out = bus.out, bus.folder / "disk" / "out"
    options = ["--serve", str(free_port())] if watched else []
    with bus.recorder(*options, command=small_disk(size)) as process:
        bus.say(HALF)
        bus.say(RUN[len(HALF) :])  # the bus goes on, whatever becomes of the recorder
        status, errors = bus.end(process)
    bus.out = real
    assert status == 3
    told = errors.splitlines()[:-1]  # the last line is of the repair
    assert 1 <= len(told) <= 1 + watched  # a view may notice it as well, or first
    assert all("cannot write" in line and "the disk is full" in line for line in told)
    assert 0 < len(read_candump(bus.partial / "bus.log")) <= len(bus.record())
    assert verifies(bus.partial / "recording.rrd", bus.folder)
    assert same_as_log(bus.partial / "recording.rrd", bus.partial / "bus.log")


@pytest.mark.parametrize("option", ["--serve", "--web"])
def test_a_busy_port_is_said_before_anything_else(option: str, runs: Path, pumpbench: Pumpbench) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        busy, free = str(holder.getsockname()[1]), str(free_port())
        ports = {"--serve": free, "--web": free} | {option: busy}
        options = [part for pair in ports.items() for part in pair]
        for command in (["record", "--bus", "unix:nowhere.sock"], ["run"]):
            done = pumpbench(*command, "--out", runs / "out", *options)
            assert done.returncode == 2
            assert f": {option} {busy}: Address already in use; choose another port" in done.stderr
            assert len(done.stderr.splitlines()) == 1
    assert not list(runs.iterdir())


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--out", "x"], "give --bus and --out"),
        (["--bus", "unix:x", "--out", "x", "--web"], "give both"),
        (["--bus", "unix:x", "--out", "x", "--serve", "99999"], "a port is 1 to 65535"),
        (["--bus", "unix:x.sock", "--out", "x"], "no hub is serving there"),
        (["--bus", "wifi", "--out", "x"], "'wifi'"),
        (
            ["--bus", "unix:x", "--out", "x", "--info", "../list.json"],
            "expected a JSON object, as run.json has, found []",
        ),
        (["--bus", "unix:x", "--out", "x", "--info", "../text"], "--info ../text is no JSON"),
    ],
)
def test_wrong_usage(
    arguments: list[str], text: str, runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (runs / "list.json").write_text("[]")
    (runs / "text").write_text("firmware: mine\n")
    (runs / "empty").mkdir()
    monkeypatch.chdir(runs / "empty")
    try:
        status = recorder.main(arguments)
    except SystemExit as ended:  # argparse
        assert ended.code == 2
        status = 2
    assert status == 2
    assert text in capsys.readouterr().err
    assert not list(Path.cwd().iterdir())


def test_a_run_in_one_process_has_nobody_to_watch_it(runs: Path) -> None:
    for options, text in (
        ({"bus": "inproc", "serve": free_port()}, "--serve needs a bus"),
        ({"web": free_port()}, "give both"),
    ):
        with pytest.raises(RigError, match=text):
            prepare(Request(patient="adult#001", out=runs / "out", **options))
