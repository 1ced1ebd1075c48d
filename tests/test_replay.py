"""A recorded run fed into a firmware: the same answers, or the first that differs; silence, death, loss of power."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conformance_devices import Changed, Values
from conftest import ROOT, Pumpbench
from pumpbench import bench, catalogue
from pumpbench.calibration import MODES
from pumpbench.comparison.align import Ignore
from pumpbench.comparison.record import Record
from pumpbench.conformance.device import Device
from pumpbench.faults import hang, kill, restart
from pumpbench.replay import Replay, ReplayError, feed, replay, turns_of
from test_transports import need_vcan

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame

pytest_plugins = ["pytester"]

HOURS = {"scenario": "six-hours", "hours": 3.0}
POWER = [
    restart(start="00:30"),
    restart(start="00:50", memory="lost"),
    restart(start="01:20", memory="torn"),
    restart(start="01:40", after_frames=2),
    restart(start="02:00", end="02:10"),
    hang(start="02:20", end="02:30"),
    kill(start="02:50"),
]
BAD = f"{sys.executable} {ROOT / 'tests' / 'bad_firmware.py'}"


@pytest.fixture(scope="module")
def outcome() -> bench.Outcome:
    return bench.run(strategy="s3", **HOURS)


@pytest.fixture(scope="module")
def record(outcome: bench.Outcome) -> Record:
    return Record("the run", outcome.frames, outcome.info)


@pytest.fixture(scope="module")
def folder(outcome: bench.Outcome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return outcome.write(tmp_path_factory.mktemp("replay") / "run")


def fed(record: Record, device: Device, *ignore: str, keep_going: bool = False) -> Replay:
    return feed(record, turns_of(record), device, Ignore.of(ignore), keep_going=keep_going, patience=0.0)


def of(outcome: bench.Outcome) -> Record:
    return Record("the run", outcome.frames, outcome.info)


# ---- the same


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_answers_itself_bit_by_bit(mode: str) -> None:
    run = bench.run(strategy=mode, scenario="validation-14d", hours=24)
    played = bench.replay(run)
    played.assert_same()
    assert played.turns[0] == played.turns[1] > 288
    assert played.report.comparison.b.sha256() == run.frames.sha256()


@pytest.mark.parametrize("mode", MODES)
def test_the_golden_vectors_are_records_like_any_other(mode: str) -> None:
    replay(ROOT / "examples" / "golden_vectors" / f"{mode}.log").assert_same()


@pytest.mark.parametrize("entry", catalogue.entries(), ids=lambda entry: entry.name)
def test_whatever_went_wrong_on_the_bus_goes_wrong_again(entry: catalogue.Entry) -> None:
    mode = "s3" if "s3" in entry.modes else entry.modes[0]
    bench.replay(bench.run(strategy=mode, scenario="six-hours", hours=5.5, faults=[entry.fault])).assert_same()


def test_power_is_cut_where_it_was_cut() -> None:
    run = bench.run(strategy="s3", **HOURS, faults=POWER)
    powers = [event for turn in turns_of(of(run)) for event in turn.heard if not isinstance(event, Frame)]
    assert [event.memory for event in powers] == ["kept", "lost", "torn", "kept", "kept"]
    bench.replay(run).assert_same()


def test_on_a_hub_too(folder: Path) -> None:
    replay(folder, bus="hub").assert_same()
    run = bench.run(strategy="s3", **HOURS, faults=POWER)
    bench.replay(run, bus="hub").assert_same()


def test_a_frame_of_every_odd_form_reaches_a_process_as_well() -> None:
    faults = [entry.fault for entry in catalogue.entries() if entry.fault.kind in ("remote_frame", "error_frames")]
    for fault in faults:
        bench.replay(bench.run(strategy="s3", **HOURS, faults=[fault]), bus="hub").assert_same()


@pytest.mark.vcan
def test_on_a_vcan(folder: Path, pumpbench: Pumpbench) -> None:
    need_vcan()
    replay(folder, bus="socketcan:vcan0").assert_same()
    done = pumpbench("replay", folder, "--bus", "socketcan:vcan0", "--firmware", f"{BAD} dies {{bus}}")
    assert done.returncode == 3
    assert "step 0 (00:00): expected a device that lives" in done.stdout


# ---- one mistake


def mistake(name: str, step: int, **values: int) -> Changed:
    """The reference, but for one frame."""
    seen = iter(range(10**6))

    def says(said: str, raw: Values) -> Values:
        return raw | values if said == name and next(seen) == step else raw

    return Changed(says=says)


def test_one_mistake_is_found_at_its_step_and_signal(record: Record) -> None:
    played = fed(record, mistake("PUMP_BasalCmd", 17, InsulinRate=300))
    first = played.report.data()["first"]
    assert (first["message"], first["step"], first["kind"]) == ("PUMP_BasalCmd", 17, "changed")
    assert [(each["name"], each["b"], each["unit"]) for each in first["signals"] if each["differs"]] == [
        ("InsulinRate", "1.5", "U/h")
    ]
    assert len(first["before"]) == 5
    assert len(played.report.comparison.differences) == 1
    assert played.turns[0] < played.turns[1]
    text = played.text()
    assert "first difference: PUMP_BasalCmd at 01:25, step 17" in text
    assert f"{played.turns[0]} of {played.turns[1]} turns were replayed" in text
    with pytest.raises(AssertionError, match=r"InsulinRate +[0-9.]+ +1\.5 +U/h"):
        played.assert_same()


def test_keep_going_finds_all_of_them(record: Record) -> None:
    def says(name: str, raw: Values) -> Values:
        return raw | {"LimiterBits": 64} if name == "CTRL_Status" else raw

    played = fed(record, Changed(says=says), keep_going=True)
    assert played.turns[0] == played.turns[1]
    assert len(played.report.comparison.differences) == 36
    assert fed(record, Changed(says=says), "CTRL_Status.LimiterBits").same


def lost(name: str) -> Changed:
    return Changed(says=lambda said, raw: None if said == name else raw)


def test_a_frame_that_does_not_come_any_more_is_missing(record: Record) -> None:
    first = fed(record, lost("CTRL_Diag")).report.comparison.first
    assert first is not None and (first.kind, first.b) == ("missing", None)
    assert fed(record, lost("CTRL_Diag"), "CTRL_Diag").same


class Doubled(Changed):
    """A device that says its first set-points twice."""

    def receive(self, frame: Frame) -> list[Frame]:
        said = list(super().receive(frame))
        return [each for each in said for _ in range(1 + (each.can_id == codec.message("PUMP_BasalCmd").can_id))]


def test_a_frame_too_many_is_extra(record: Record) -> None:
    first = fed(record, Doubled()).report.comparison.first
    assert first is not None and first.kind == "extra"


class Uncounted(Changed):
    """A device whose COUNTER of CTRL_Status stands still."""

    def receive(self, frame: Frame) -> list[Frame]:
        tx = Transmitter()
        message = codec.message("CTRL_Status")
        return [
            tx.frame(message.name, **message.unpack(each.data)) if each.can_id == message.can_id else each
            for each in super().receive(frame)
            if not tx.counters.update(CTRL_Status=0)  # type: ignore[func-returns-value]
        ]


def test_a_counter_that_stands_still_stops_the_replay(record: Record) -> None:
    played = fed(record, Uncounted())
    first = played.report.data()["first"]
    assert (first["message"], first["step"]) == ("CTRL_Status", 1)
    assert [each["name"] for each in first["signals"] if each["differs"]] == ["COUNTER"]


# ---- the silent and the dying


class Mute(Changed):
    """A device that says nothing from a step on."""

    def __init__(self, since: int) -> None:
        super().__init__()
        self._since = since
        self._tokens = 0

    def receive(self, frame: Frame) -> list[Frame]:
        self._tokens += frame.can_id == codec.message("SYNC_Step").can_id
        return list(super().receive(frame)) if self._tokens <= self._since + 2 else []


def test_silence_is_told_with_its_step(record: Record) -> None:
    played = fed(record, Mute(9))
    assert not played.same and played.report.comparison.same
    assert played.silent == "step 9 (00:45): expected SYNC_Done; nothing came"
    assert played.text().splitlines()[0] == played.silent
    assert fed(record, Mute(-3)).silent == (
        "the roll call: expected an answer within 0 s; the last call: expected an answer to one of three roll calls; "
        "none came"
    )


@pytest.mark.parametrize(
    ("kind", "status", "text"),
    [
        ("dies", 3, "step 0 (00:00): expected a device that lives; the firmware ended with status 7"),
        ("hangs", 3, "step 0 (00:00): expected SYNC_Done within 3 s; nothing came"),
        ("mute", 3, "the roll call: expected an answer within 1 s"),
        ("floods", 1, "step 0 (00:00): expected at most 2000 frames in a turn; the device does not stop"),
        ("garbage", 1, "first difference: PUMP_BasalCmd at 00:00, step 0"),
    ],
)
def test_bad_firmware_on_a_hub(pumpbench: Pumpbench, folder: Path, kind: str, status: int, text: str) -> None:
    patience = "1" if kind == "mute" else "20"
    done = pumpbench(
        "replay", folder, "--firmware", f"{BAD} {kind} {{bus}}", "--timeout", "3", "--connect-timeout", patience
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert text in done.stdout and done.stderr == ""


# ---- the command, and what cannot be replayed


def test_the_command(pumpbench: Pumpbench, folder: Path, tmp_path: Path) -> None:
    done = pumpbench("replay", folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("the same: ")
    firmware = f"{sys.executable} -m firmware_sim --bus {{bus}}"
    done = pumpbench(
        "replay", folder, "--firmware", firmware, "--json", "-", "--ignore", "own", "--out", tmp_path / "o"
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["same"], told["turns"], told["silent"]) == (True, told["of_turns"], None)
    assert (tmp_path / "o" / "comparison.png").is_file()


def test_bad_input_is_one_line_and_exit_status_2(pumpbench: Pumpbench, folder: Path, tmp_path: Path) -> None:
    log = (folder / "bus.log").read_text(encoding="ascii").splitlines(keepends=True)
    (tmp_path / "late.log").write_text("".join(log[400:]))
    for arguments, text in (
        (["nowhere"], "there is no run folder nowhere"),
        ([tmp_path / "late.log"], "does not begin with a calibration"),
        ([folder, "--bus", "slcan:/dev/null"], "only one program can open slcan:/dev/null"),
        ([folder, "--bus", "inproc", "--firmware", "x"], "--bus inproc is the reference firmware"),
        ([folder, "--ignore", "x"], "the DBC has no message 'x'"),
    ):
        done = pumpbench("replay", *arguments)
        assert (done.returncode, done.stdout) == (2, ""), (arguments, done.stdout)
        assert len(done.stderr.splitlines()) == 1 and text in done.stderr, (arguments, done.stderr)


def test_a_free_run_has_no_turns(record: Record) -> None:
    with pytest.raises(ReplayError, match="the run is a free run"):
        turns_of(replace(record, info={"free_running": True}))


def test_a_record_of_the_plants_side_alone_is_no_record_of_a_device(record: Record) -> None:
    heard = ~np.isin(record.frames.can_id, [m.can_id for m in codec.messages().values() if m.sender == "CTRL"])
    with pytest.raises(ReplayError, match="nothing in it is answered"):
        turns_of(Record("the plant", record.frames.select(heard)))


def test_a_restart_that_nobody_reports_is_refused(record: Record) -> None:
    run = bench.run(strategy="s3", **HOURS, faults=[restart(start="00:30")])
    told = run.frames.can_id == codec.message("FAULT_Inject").can_id
    with pytest.raises(ReplayError, match=r"the device started anew in step 6 \(00:30\) and no fault tells why"):
        turns_of(Record("the run", run.frames.select(~told)))


@pytest.mark.parametrize(
    ("fault", "options", "text"),
    [
        (restart(start="00:30"), {}, "the device lost its power in step 6 (00:30): give --reset-hook"),
        (restart(start="00:30", memory="lost"), {"reset_hook": "true"}, "memory was lost in step 6 (00:30)"),
    ],
)
def test_power_that_nobody_can_switch_is_refused(
    fault: object, options: dict[str, str], text: str, tmp_path: Path
) -> None:
    from can_bus.hub import Hub

    run = bench.run(strategy="s3", **HOURS, faults=[fault])
    url = f"unix:{tmp_path / 'bus'}"
    with Hub(url) as hub:
        hub.start()
        with pytest.raises(ReplayError) as error:
            bench.replay(run, bus=url, firmware="none", **options)
    assert text in str(error.value)


def test_torn_memory_of_another_firmware_is_refused() -> None:
    run = bench.run(strategy="s3", **HOURS, faults=[restart(start="00:30", memory="torn")])
    firmware = f"{sys.executable} -m firmware_sim --bus {{bus}} --nvm {{nvm}}"
    with pytest.raises(ReplayError, match="can be done to the reference firmware only"):
        bench.replay(run, bus="hub", firmware=firmware)


def test_a_run_that_was_cut_off_is_replayed_as_far_as_it_goes(record: Record) -> None:
    status = codec.message("PUMP_Status").can_id  # its token did not come any more
    row = np.flatnonzero((record.frames.can_id == status) & (record.frames.step == 20))[0]
    played = replay(replace(record, frames=record.frames.select(np.arange(row + 1))))
    played.assert_same()
    assert played.turns[0] == len(turns_of(record)) - np.unique(record.frames.step[row:]).size


def test_an_answer_to_what_was_never_answered_is_a_difference(record: Record) -> None:
    """Of a device that died in a turn, the record ends there."""
    token = np.flatnonzero(record.frames.can_id == codec.message("SYNC_Step").can_id)[20]
    played = replay(replace(record, frames=record.frames.select(np.arange(token + 1))))
    assert {each.kind for each in played.report.comparison.differences} == {"extra"}


def test_in_a_test_of_ones_own(pytester: pytest.Pytester, folder: Path) -> None:
    pytester.makepyfile(
        f"""
        def test_holds(bench):
            bench.replay({str(folder)!r}).assert_same()

        def test_fails(bench):
            bench.replay({str(folder)!r}, bus="hub", firmware={f"{BAD} garbage {{bus}}"!r}).assert_same()
        """
    )
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*first difference: PUMP_BasalCmd at 00:00, step 0*", "*InsulinRate*SNA*U/h*"])
    assert "def assert_same" not in result.stdout.str()
