"""pumpbench convert: another tool reads the same frames at the same times, or there is no file at all."""

import gzip
import importlib.util
import subprocess
import sys
from pathlib import Path

import can
import pytest
from conftest import ROOT, Pumpbench
from pumpbench.candump import read_candump, read_lines, write_candump
from pumpbench.convert import ConvertError, convert
from synthetic_capture import Loop, dropping
from typer.testing import CliRunner

from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame, from_message

DATA = [Frame(0x123, b""), Frame(0x7FF, b"\x01\x02\x03"), Frame(0x18DAF110 | CAN_EFF_FLAG, b"\xff" * 8),
        Frame(0x55 | CAN_EFF_FLAG, b"\x00")]  # fmt: skip
REMOTE = [Frame(0x100 | CAN_RTR_FLAG, bytes(8)), Frame(0x100 | CAN_RTR_FLAG, b""),
          Frame(0x18DAF110 | CAN_EFF_FLAG | CAN_RTR_FLAG, bytes(3))]  # fmt: skip
ERRORS = [Frame(0x80 | CAN_ERR_FLAG, bytes.fromhex("0008000000006000")), Frame(0x4 | CAN_ERR_FLAG, b"\x00\x04")]

TIMES = [0.0, 0.00025, 0.0005, 300.0, 300.00025, 86400.123457, 1209600.999999]
"""Simulated, whole runs of 14 days included."""


def log_of(path: Path, frames: list[Frame], *, start: float = 0.0, names: tuple[str, str] = ("can0", "can1")) -> Path:
    """A candump log with the frames on two buses in turn, written here and not by what is tested."""
    lines = []
    for number, (can_id, data) in enumerate(frames):
        wide = can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)
        ident = f"{can_id & ~CAN_RTR_FLAG & ~CAN_EFF_FLAG:08X}" if wide else f"{can_id & ~CAN_RTR_FLAG:03X}"
        payload = f"R{len(data) or ''}" if can_id & CAN_RTR_FLAG else data.hex().upper()
        time = start + TIMES[number % len(TIMES)] + number // len(TIMES) * 1.5e6
        lines.append(f"({time:.6f}) {names[number % 2]} {ident}#{payload}\n")
    path.write_text("".join(lines))
    return path


def read(path: Path) -> list[tuple[float, int, Frame]]:
    """Micro-seconds are what a candump log has."""
    return [(round(m.timestamp, 6), m.channel, from_message(m)) for m in can.LogReader(path)]


def expected(log: Path, **numbers: int) -> list[tuple[float, int, Frame]]:
    return [(line.time_s, numbers[line.interface], line.frame) for line in read_lines(log)]


@pytest.mark.parametrize("start", [0.0, 600.00025])
def test_blf_has_every_frame_as_it_was(tmp_path: Path, start: float) -> None:
    log = log_of(tmp_path / "bus.log", DATA + REMOTE + ERRORS, start=start)
    done = convert(log, tmp_path / "x.blf")
    assert done == (9, {"can0": 0, "can1": 1}, 0)
    assert read(tmp_path / "x.blf") == expected(log, can0=0, can1=1)


@pytest.mark.parametrize("start", [0.0, 600.00025])
def test_asc_has_them_too_but_no_details_of_error_frames(tmp_path: Path, start: float) -> None:
    log = log_of(tmp_path / "bus.log", DATA + REMOTE + ERRORS, start=start)
    convert(log, tmp_path / "x.asc")
    there, was = read(tmp_path / "x.asc"), expected(log, can0=0, can1=1)
    assert there[:7] == was[:7]
    assert [(time, channel, frame.is_error) for time, channel, frame in there[7:]] == [
        (time, channel, True) for time, channel, _ in was[7:]
    ]
    assert "Begin Triggerblock" in (tmp_path / "x.asc").read_text()


def test_a_log_by_the_wall_clock_keeps_its_date(tmp_path: Path) -> None:
    log = log_of(tmp_path / "bus.log", DATA, start=1.7e9, names=("vcan0", "vcan1"))
    for name in ("x.blf", "x.trc", "x.log"):
        convert(log, tmp_path / name)
        times = [message.timestamp for message in can.LogReader(tmp_path / name)]
        assert times == pytest.approx([line.time_s for line in read_lines(log)], abs=2e-6), name
    convert(log, tmp_path / "x.asc")
    messages = list(can.ASCReader(tmp_path / "x.asc", relative_timestamp=False))
    assert [message.timestamp for message in messages] == pytest.approx(
        [line.time_s for line in read_lines(log)], abs=1e-3
    )


def test_trc_says_what_it_has_to_leave_out(tmp_path: Path) -> None:
    log = log_of(tmp_path / "bus.log", ERRORS + DATA + REMOTE)
    done = convert(log, tmp_path / "x.trc")
    assert done == (4, {"can0": 0, "can1": 1}, 5)
    assert read(tmp_path / "x.trc") == [
        (time, channel, frame) for time, channel, frame in expected(log, can0=1, can1=2) if frame in DATA
    ]
    assert str(tmp_path / "x.trc") in (tmp_path / "x.trc").read_text(), "not the name it was written under"
    answer = CliRunner().invoke(_app(), ["convert", str(log), str(tmp_path / "y.trc")])
    assert answer.exit_code == 0
    assert ".trc has no remote or error frames: 5 were left out" in answer.stderr
    assert f"4 frames of can0, can1: {tmp_path / 'y.trc'}" in answer.stdout


@pytest.mark.parametrize("suffix", ["csv", "db"])
def test_formats_without_channels_take_one_interface(tmp_path: Path, suffix: str) -> None:
    log = log_of(tmp_path / "bus.log", DATA + REMOTE + ERRORS)
    out = tmp_path / f"x.{suffix}"
    with pytest.raises(ConvertError, match=rf"\.{suffix} does not say on which bus .* has can0, can1: choose one"):
        convert(log, out)
    assert not out.exists()
    assert convert(log, out, only="can1").frames == 4
    there = [(round(message.timestamp, 6), from_message(message)) for message in can.LogReader(out)]
    assert there == [(line.time_s, line.frame) for line in read_lines(log) if line.interface == "can1"]


def test_a_candump_log_of_one_interface_is_a_candump_log(tmp_path: Path) -> None:
    log = log_of(tmp_path / "bus.log", DATA, names=("vcan0", "vcan1"))
    assert convert(log, tmp_path / "x.log", only="vcan1") == (2, {"vcan1": 1}, 0)
    lines = [line for line in read_lines(log) if line.interface == "vcan1"]
    assert list(read_lines(tmp_path / "x.log")) == lines
    with pytest.raises(ConvertError, match=r"bus\.log has no interface 'can9'; it has vcan0, vcan1"):
        convert(log, tmp_path / "y.log", only="can9")


@pytest.mark.parametrize(
    ("names", "numbers"),
    [(("can0", "vcan0"), (0, 1)), (("device", "plant"), (0, 1)), (("can5", "can2"), (5, 2)), (("b", "a"), (1, 0))],
)
def test_interfaces_get_a_number_each(tmp_path: Path, names: tuple[str, str], numbers: tuple[int, int]) -> None:
    log = log_of(tmp_path / "bus.log", DATA, names=names)
    assert convert(log, tmp_path / "x.blf").channels == dict(zip(names, numbers, strict=True))
    assert [channel for _, channel, _ in read(tmp_path / "x.blf")] == [*numbers, *numbers]


def test_the_direction_is_kept(tmp_path: Path) -> None:
    (tmp_path / "x.log").write_text("(1.000000) vcan0 123#01 T\n(2.000000) vcan0 123#02 R\n")
    convert(tmp_path / "x.log", tmp_path / "x.blf")
    assert [message.is_rx for message in can.LogReader(tmp_path / "x.blf")] == [False, True]


def test_compressed_and_in_a_folder_to_be_made(tmp_path: Path) -> None:
    log = log_of(tmp_path / "bus.log", DATA)
    convert(log, tmp_path / "new" / "a.b.ASC.gz")
    assert b"18DAF110x" in gzip.decompress((tmp_path / "new" / "a.b.ASC.gz").read_bytes())
    with pytest.raises(ConvertError, match=r"\.blf is currently incompatible with gzip"):
        convert(log, tmp_path / "x.blf.gz")


def test_mf4_or_what_it_needs(tmp_path: Path) -> None:
    log = log_of(tmp_path / "bus.log", DATA + REMOTE + ERRORS)
    if importlib.util.find_spec("asammdf") is None:
        with pytest.raises(ConvertError, match=r"x\.mf4: The asammdf package was not found"):
            convert(log, tmp_path / "x.mf4")
        assert [path.name for path in tmp_path.iterdir()] == ["bus.log"]
    else:
        convert(log, tmp_path / "x.mf4")
        there, was = read(tmp_path / "x.mf4"), expected(log, can0=0, can1=1)
        assert [entry[1:] for entry in there] == [entry[1:] for entry in was]
        assert [entry[0] for entry in there] == pytest.approx([entry[0] for entry in was], abs=1e-6)


# ---------------------------------------------------------------- whole or not at all


def _app():  # type: ignore[no-untyped-def]
    from pumpbench.cli import app

    return app


def test_wrong_usage_is_one_line_and_status_2(pumpbench: Pumpbench, runs: Path) -> None:
    log = log_of(runs / "bus.log", DATA)
    (runs / "folder").mkdir()
    (runs / "there.asc").write_text("mine")
    (runs / "broken.log").write_text("(0.000000) can0 123#00\nrubbish\n")
    listed = ".asc, .blf, .csv, .db, .log, .mf4, .trc, .txt"
    for arguments, text in {
        (log, "x.xyz"): f"x.xyz: no log format has the suffix '.xyz'; there is {listed}",
        (log, "x"): f"x: no log format has the suffix ''; there is {listed}",
        ("none.log", "x.blf"): "there is no file none.log",
        ("folder", "x.blf"): "there is no bus.log in folder",
        (log, "there.asc"): "there.asc exists; give --overwrite to replace it",
        (log, "folder"): "folder is a folder",
        ("broken.log", "x.blf"): "broken.log:2: not a line of a candump log: 'rubbish'",
    }.items():
        done = pumpbench("convert", *arguments)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"pumpbench: {text}\n")
    assert (runs / "there.asc").read_text() == "mine"
    assert sorted(path.name for path in runs.iterdir()) == ["broken.log", "bus.log", "folder", "there.asc"]
    done = pumpbench("convert", log, "there.asc", "--overwrite")
    assert done.returncode == 0, done.stderr
    assert len(list(can.LogReader(runs / "there.asc"))) == len(DATA)


def test_a_writer_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = log_of(tmp_path / "bus.log", DATA)
    (tmp_path / "x.blf").write_text("mine")
    written = []

    def full(_self: object, message: can.Message) -> None:
        written.append(message)
        if len(written) == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(can.BLFWriter, "on_message_received", full)
    with pytest.raises(OSError, match="No space left"):
        convert(log, tmp_path / "x.blf", overwrite=True)
    assert (tmp_path / "x.blf").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bus.log", "x.blf"]


# ---------------------------------------------------------------- a run


def test_a_run_with_a_gateway_goes_into_every_format_and_back(tmp_path: Path) -> None:
    made = Loop(30, faults=dropping("CGM_Reading", range(5, 8)))
    made.run()
    frames = made.capture.finish()
    run = tmp_path / "run"
    run.mkdir()
    write_candump(frames, run / "bus.log")
    was = expected(run / "bus.log", can0=0, can1=1)
    for name in ("x.blf", "x.asc"):
        assert convert(run, tmp_path / name).frames == len(frames)
        assert read(tmp_path / name) == was
    convert(run, tmp_path / "x.trc")
    assert read(tmp_path / "x.trc") == [(time, channel + 1, frame) for time, channel, frame in was]
    convert(run, tmp_path / "x.log")
    assert read_candump(tmp_path / "x.log").sha256() == frames.sha256()
    messages = list(can.LogReader(run / "bus.log"))
    assert [(message.timestamp, int(str(message.channel)[3:]), from_message(message)) for message in messages] == was


def test_cantools_decodes_bus_log(tmp_path: Path) -> None:
    made = Loop(3)
    made.run()
    write_candump(made.capture.finish(), tmp_path / "bus.log")
    with (tmp_path / "bus.log").open() as log:
        done = subprocess.run(
            [sys.executable, "-m", "cantools", "decode", "dbc/pumpbench.dbc"],
            cwd=ROOT, stdin=log, capture_output=True, text=True, check=True,
        )  # fmt: skip
    assert done.stdout.count("CGM_Reading(") == 4  # instants 0 to 3
    assert "GlucoseConc: " in done.stdout
    assert "InsulinRate: " in done.stdout
    assert "Unknown" not in done.stdout
