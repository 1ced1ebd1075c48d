"""Faults as files and values, the gateway's idea of time, and a gateway process between two real hubs."""

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from can_bus import codec, gateway
from can_bus.codec import Transmitter
from can_bus.faults import Drop, Fault, Injector, load_faults, seconds
from can_bus.frame import CAN_RTR_FLAG, Frame
from can_bus.gateway import Gateway, Side
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.lockstep import STEP_SECONDS, Done, Phase
from can_bus.url import open_link
from can_bus.yaml_file import FileError

FAULT_ID = codec.message("FAULT_Inject").can_id


def name_of(frame: Frame) -> str:
    return codec.messages_by_id()[frame.can_id].name


def names(frames: list[Frame]) -> list[str]:
    return [name_of(frame) for frame in frames]


# ---- times


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("00:00", 0),
        ("02:00", 7200),
        ("2:00", 7200),
        ("02:00:30", 7230),
        ("23:59:59", 86399),
        ("0+00:05", 300),
        ("1+04:00", 100800),
        ("13+23:59:59", 14 * 86400 - 1),
    ],
)
def test_times(text: str, expected: int) -> None:
    assert seconds(text) == expected


@pytest.mark.parametrize(
    "text",
    ["24:00", "2:5", "02:60", "02:00:60", "2", "", "02:00 ", " 02:00", "-01:00", "1+", "+02:00", "1+24:00", "1.5+02:00",
     "02:00:30:10", "12345+00:00", "two", 120, 7200.0, None, True, ["02:00"]],
)  # fmt: skip
def test_what_is_no_time(text: object) -> None:
    with pytest.raises(ValueError, match=r'a time is "hh:mm", "hh:mm:ss" or "days\+hh:mm" in quotes'):
        seconds(text)


# ---- fault files


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "faults.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_fault_file(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "# what the night brings\n"
        "faults:\n"
        '  - {kind: drop, message: CGM_Reading, start: "02:00", end: "03:00"}\n'
        "  - kind: drop\n"
        "    message: PUMP_BasalCmd\n"
        "    start: 1+04:00\n"
        "    count: 3\n"
        "  - {kind: drop, message: HB_PUMP}\n",
    )
    assert load_faults(path) == (
        Drop(message="CGM_Reading", start="02:00", end="03:00"),
        Drop(message="PUMP_BasalCmd", start="1+04:00", count=3),
        Drop(message="HB_PUMP"),
    )
    assert load_faults(path)[0].start == 7200
    assert load_faults(write(tmp_path, "faults: []\n")) == ()


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        (
            "faults:\n  - {kind: drip, message: CGM_Reading}\n",
            2,
            r"faults\.0: there is no kind 'drip'; did you mean drop\?",
        ),
        (
            "faults:\n  - kind: drop\n    message: CGM_Readng\n",
            3,
            r"faults\.0\.message: the DBC has no message .*did you mean CGM_Reading\b.*\(found 'CGM_Readng'\)",
        ),
        (
            "faults:\n  - {kind: drop, message: Xyz}\n",
            2,
            r"the DBC has no message .*; it has SYNC_Step, .*UDS_Response \(found 'Xyz'\)",
        ),
        ("faults:\n  - {kind: drop, message: 5}\n", 2, r"the DBC has no message .*\(found 5\)"),
        ("faults:\n  - {kind: drop, message: [CGM_Reading]}\n", 2, r"the DBC has no message "),
        (
            'faults:\n  - kind: drop\n    message: CGM_Reading\n    strat: "02:00"\n',
            4,
            r"faults\.0\.strat: unknown key; expected one of kind, start, end, place, message, when, nth, ",
        ),
        ("faults:\n  - {message: CGM_Reading}\n", 2, r"faults\.0: expected a mapping with the key kind"),
        ("faults:\n  - {kind: xyz}\n", 2, r"there is no kind 'xyz'; there are drop, delay, .*"),
        ("faults:\n  - {kind: drop}\n", 2, r"faults\.0\.message: this key is missing"),
        (
            "faults:\n"
            "  - {kind: drop, message: CGM_Reading}\n"
            '  - {kind: drop, message: CGM_Reading, start: "03:00", end: "02:00"}\n',
            3,
            r"faults\.1: end must be later than start",
        ),
        (
            'faults:\n  - {kind: drop, message: CGM_Reading, start: "03:00", end: "03:00"}\n',
            2,
            r"end must be later than start",
        ),
        (
            "faults:\n  - kind: drop\n    message: CGM_Reading\n    count: 0\n",
            4,
            r"faults\.0\.count: .*greater than .*\(found 0\)",
        ),
        (
            "faults:\n  - kind: drop\n    message: CGM_Reading\n    start: 12:00\n",  # a number in YAML: base 60
            4,
            r"faults\.0\.start: a time is .*in quotes.*\(found 720\)",
        ),
        (
            "faults:\n  - kind: drop\n    message: CGM_Reading\n    end: '25:00'\n",
            4,
            r"faults\.0\.end: a time is .*\(found '25:00'\)",
        ),
        ("faults:\n  - message: CGM_Reading\n    message: PUMP_Ack\n", 3, r"the key message stands there twice"),
        ("- {kind: drop, message: CGM_Reading}\n", 1, r"top level: expected a mapping with the keys faults"),
        ("", 1, r"top level: expected a mapping with the keys faults"),
        ("# nothing\n", 1, r"top level: expected a mapping with the keys faults"),
        ("faults:\n", 1, r"faults: .*list"),
        ("faults: {kind: drop, message: CGM_Reading}\n", 1, r"faults: .*list"),
        ("faults:\n  - CGM_Reading\n", 2, r"faults\.0: expected a mapping with the key kind \(found 'CGM_Reading'\)"),
        ("fault: []\n", 1, r"fault: unknown key; expected one of faults"),
        ("faults:\n  - {kind: drop\n  x: [\n", 3, r"not YAML: "),
        ("faults:\n\t- x\n", 2, r"not YAML: .*'\\t'"),
        ("faults: []\n---\nfaults: []\n", 2, r"not YAML: .*another document"),
    ],
)
def test_errors_in_a_fault_file_have_file_line_and_expectation(
    tmp_path: Path, text: str, line: int, expected: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(FileError) as error:
        load_faults(path)
    message = str(error.value)
    assert f"{path}:{line}: " in message
    assert re.search(expected, message), message
    assert "\n" not in message


@pytest.mark.parametrize("content", [b"faults: \xff", b"faults: \x00", b"faults: 2026-99-99"])
def test_files_that_are_no_yaml_text(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "faults.yaml"
    path.write_bytes(content)
    with pytest.raises(FileError, match=re.escape(str(path))) as error:
        load_faults(path)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.yaml", tmp_path):
        with pytest.raises(FileError, match=f"cannot read {re.escape(str(path))}: "):
            load_faults(path)


def test_at_most_three_errors_are_told_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, "faults:\n" + "  - {kind: drop, message: CGM_Readng}\n" * 9)
    with pytest.raises(FileError) as error:
        load_faults(path)
    assert re.findall(r"yaml:(\d+): ", str(error.value)) == ["2", "3", "4"]


@pytest.mark.parametrize("text", ["faults: &a [*a]\n", "faults: &a\n  b: *a\n"])
def test_a_file_that_contains_itself(tmp_path: Path, text: str) -> None:
    with pytest.raises(FileError):
        load_faults(write(tmp_path, text))


# ---- the injector


def test_a_fault_acts_from_its_start_until_before_its_end() -> None:
    fault = Drop(message="CGM_Reading", start="02:00", end="03:00")
    assert [fault.open(second) for second in (0, 7199, 7200, 10799, 10800)] == [False, False, True, True, False]
    assert Drop(message="CGM_Reading").open(0)
    assert Drop(message="CGM_Reading", start="02:00").open(10**7)


def test_a_fault_acts_so_often_and_no_more() -> None:
    injector = Injector((Drop(message="CGM_Reading", start="00:10", count=2),))
    frame = Transmitter().frame("CGM_Reading")
    kept = [bool(injector.apply(frame, second, "device")[0]) for second in range(0, 3000, 300)]
    assert kept == [True, True, False, False, True, True, True, True, True, True]


def test_every_injection_is_reported() -> None:
    for message, target in {"CGM_Reading": "CGM", "PUMP_Ack": "PUMP", "HB_CTRL": "CTRL", "MEAL_Announce": "UI",
                            "PLANT_Truth": "Bus", "CFG_Param": "Bus"}.items():  # fmt: skip
        injector = Injector((Drop(message=message),))
        sent = Transmitter().frame(message)
        passed, reports = injector.apply(sent, 86400 + 7200, "device")
        assert passed == []
        (report,) = reports
        assert report.can_id == FAULT_ID
        assert codec.message("FAULT_Inject").unpack(report.data) == {
            "FaultTarget": codec.choice("FAULT_Inject", "FaultTarget", target),
            "FaultKind": codec.choice("FAULT_Inject", "FaultKind", "Drop"),
            "FaultCanId": sent.can_id,
            "FaultCount": 1,
            "FaultParam": 288 + 24,
        }


def test_only_the_message_of_the_fault_is_touched() -> None:
    injector = Injector((Drop(message="CGM_Reading"), Drop(message="CGM_Reading"), Drop(message="PUMP_Ack", count=1)))
    transmitter = Transmitter()
    for name in codec.messages():
        frame = transmitter.frame(name)
        passed, reports = injector.apply(frame, 0, "device")
        if name in ("CGM_Reading", "PUMP_Ack"):
            assert (passed, len(reports)) == ([], 1)  # two faults on one frame: the first one has it
        else:
            assert (passed, reports) == ([frame], [])
    ours = Frame(codec.message("CGM_Reading").can_id | CAN_RTR_FLAG, bytes(8))
    assert injector.apply(ours, 0, "device") == ([ours], [])


# ---- the gateway's time


class Bench:
    """The two sides of a lockstep, frame by frame; `arrived` is what the gateway let through and added."""

    def __init__(self, *faults: Fault) -> None:
        self.gateway = Gateway(faults)
        self.plant = Transmitter()
        self.device = Transmitter()
        self.sent: list[Frame] = []
        self.arrived: list[Frame] = []
        self.dropped: list[tuple[str, int]] = []  # message, step of the report

    def put(self, frame: Frame) -> list[Frame]:
        self.sent.append(frame)
        source = Side.DEVICE if codec.messages_by_id()[frame.can_id].sender == "CTRL" else Side.PLANT
        crossing = self.gateway.forward(frame, source)
        out = crossing.device + crossing.plant
        self.arrived += out
        inject = codec.message("FAULT_Inject")
        for report in out:
            if report.can_id == FAULT_ID:
                values = inject.unpack(report.data)
                self.dropped.append((codec.messages_by_id()[values["FaultCanId"]].name, values["FaultParam"]))
        return out

    def token(self, phase: Phase, step: int, time: int = 0) -> None:
        self.put(self.plant.frame("SYNC_Step", SyncPhase=phase, StepIndex=step, SimTime=time))

    def done(self, step: int, status: Done = Done.OK) -> None:
        self.put(self.device.frame("SYNC_Done", DoneStatus=status, DoneStepIndex=step, TxCount=1))

    def roll_call(self, calls: int = 3) -> None:
        for call in range(1, calls + 1):
            self.put(self.plant.frame("PLANT_Info"))
            self.token(Phase.INIT, call)
        for call in range(1, calls + 1):  # a device answers all it finds, the plant waits for the last
            self.put(self.device.frame("HB_CTRL"))
            self.done(call)
        self.put(self.plant.frame("MODE_Cmd"))
        self.token(Phase.CONFIG, 0)
        self.put(self.device.frame("CFG_ParamEcho"))
        self.done(0)

    def batch(self, step: int) -> None:
        self.put(self.plant.frame("CGM_Reading", CgmSampleSeq=step))
        self.put(self.plant.frame("PUMP_Delivered"))

    def step(self, step: int, turns: int = 0) -> None:
        self.batch(step)
        self.token(Phase.STEP, step, step * STEP_SECONDS)
        for turn in range(1, turns + 1):
            self.put(self.device.frame("PUMP_BolusCmd"))
            self.done(step, Done.CONTINUE)
            self.put(self.plant.frame("PUMP_Ack", AckId=step))
            self.token(Phase.CONTINUE, step, step * STEP_SECONDS + turn)
        self.put(self.device.frame("PUMP_BasalCmd"))
        self.done(step)

    def run(self, steps: int, turns: int = 0) -> "Bench":
        self.roll_call()
        for step in range(steps):
            self.step(step, turns)
        self.batch(steps)
        self.token(Phase.END, steps, steps * STEP_SECONDS)
        assert not self.gateway.finished
        self.done(steps)
        assert self.gateway.finished
        return self

    def steps_of(self, message: str) -> list[int]:
        return [step for name, step in self.dropped if name == message]


def test_without_faults_every_frame_passes_in_order() -> None:
    bench = Bench().run(20, turns=2)
    assert bench.arrived == bench.sent


def test_faults_follow_simulated_time() -> None:
    """The batch of instant k precedes the token of k, and belongs to k all the same."""
    bench = Bench(
        Drop(message="CGM_Reading", start="00:25", end="00:40"),
        Drop(message="PUMP_BasalCmd", start="00:25", end="00:40"),
    ).run(12)
    assert bench.steps_of("CGM_Reading") == bench.steps_of("PUMP_BasalCmd") == [5, 6, 7]
    cgm = codec.message("CGM_Reading")
    seen = [cgm.unpack(frame.data)["CgmSampleSeq"] for frame in bench.arrived if frame.can_id == cgm.can_id]
    assert seen == [0, 1, 2, 3, 4, 8, 9, 10, 11, 12]
    rest = [frame for frame in bench.arrived if frame.can_id != FAULT_ID]
    gone = [frame for frame in bench.sent if frame not in rest]
    assert names(gone) == ["CGM_Reading", "PUMP_BasalCmd"] * 3
    assert rest == [frame for frame in bench.sent if frame not in gone]


def test_the_report_stands_where_the_frame_stood() -> None:
    bench = Bench(Drop(message="CGM_Reading", start="00:05", count=1)).run(3)
    place = bench.sent.index(next(f for f in bench.sent if name_of(f) == "CGM_Reading" and f.data[5:7] == b"\x01\0"))
    assert bench.arrived[place].can_id == FAULT_ID
    assert bench.arrived[:place] == bench.sent[:place]
    assert bench.arrived[place + 1 :] == bench.sent[place + 1 :]


def test_the_last_batch_is_of_the_last_instant() -> None:
    assert Bench(Drop(message="CGM_Reading", start="01:00")).run(12).steps_of("CGM_Reading") == [12]


def test_further_turns_do_not_advance_time() -> None:
    bench = Bench(
        Drop(message="PUMP_Ack", start="00:10", end="00:15"), Drop(message="CGM_Reading", start="00:15", end="00:20")
    ).run(6, turns=3)
    assert bench.steps_of("PUMP_Ack") == [2, 2, 2]
    assert bench.steps_of("CGM_Reading") == [3]
    ack = codec.message("PUMP_Ack")
    assert [ack.unpack(frame.data)["AckId"] for frame in bench.arrived if frame.can_id == ack.can_id] == (
        [0] * 3 + [1] * 3 + [3] * 3 + [4] * 3 + [5] * 3
    )


def test_a_count_runs_over_everything_the_fault_covers() -> None:
    bench = Bench(Drop(message="PUMP_Ack", start="00:05", count=4)).run(6, turns=3)
    assert bench.steps_of("PUMP_Ack") == [1, 1, 1, 2]


def test_the_roll_call_passes_untouched_however_often_it_is_called() -> None:
    """It is repeated by the wall clock; a count must not depend on that."""
    for calls in (1, 4):
        bench = Bench(Drop(message="HB_CTRL", count=2), Drop(message="SYNC_Done", start="00:10", count=1))
        bench.roll_call(calls)
        assert bench.dropped == []
        bench.step(0)
        bench.put(bench.device.frame("HB_CTRL"))
        assert bench.steps_of("HB_CTRL") == [1]


def test_faults_may_act_on_the_calibration() -> None:
    bench = Bench(Drop(message="MODE_Cmd", count=1), Drop(message="CFG_ParamEcho", count=1))
    bench.roll_call()
    assert bench.dropped == [("MODE_Cmd", 0), ("CFG_ParamEcho", 0)]


def test_a_done_that_answers_nothing_does_not_advance_time() -> None:
    bench = Bench(Drop(message="CGM_Reading", start="00:10", end="00:15"))
    bench.roll_call()
    bench.step(0)
    bench.done(0)  # once more
    bench.done(0xFFFFE)
    bench.put(Frame(codec.message("SYNC_Done").can_id, b"\0\0\0"))  # no SYNC_Done at all
    bench.step(1)
    bench.step(2)
    assert bench.steps_of("CGM_Reading") == [2]


def test_a_lost_done_does_not_advance_time() -> None:
    bench = Bench(
        Drop(message="SYNC_Done", start="00:05", count=1), Drop(message="CGM_Reading", start="00:10", count=1)
    )
    bench.roll_call()
    bench.step(0)
    bench.step(1)
    bench.batch(2)  # a plant would not go on; the gateway has no reason to think it did
    assert bench.steps_of("SYNC_Done") == [1]
    assert bench.steps_of("CGM_Reading") == []


@pytest.mark.parametrize("lost", [False, True])
def test_finished_only_after_the_answer_to_the_end(lost: bool) -> None:
    bench = Bench(*([Drop(message="SYNC_Done", start="00:10", count=1)] if lost else []))
    bench.roll_call()
    bench.step(0)
    bench.step(1)
    bench.token(Phase.END, 2, 600)
    bench.done(2 if lost else 1)  # lost on its way, or an answer to something else
    assert not bench.gateway.finished
    bench.done(2)
    assert bench.gateway.finished


def test_without_lockstep_the_token_tells_the_time() -> None:
    bench = Bench(
        Drop(message="CTRL_Status", start="00:10", end="00:20"), Drop(message="SYNC_Step", start="00:15", count=1)
    )
    kept = []
    for step in range(6):
        bench.token(Phase.STEP, step, step * STEP_SECONDS)
        kept.append(names(bench.put(bench.device.frame("CTRL_Status"))) == ["CTRL_Status"])
    assert kept == [True, True, False, False, True, True]
    assert bench.steps_of("SYNC_Step") == [3]  # its time passed all the same


def test_a_new_roll_call_is_a_new_run() -> None:
    bench = Bench(Drop(message="CGM_Reading", start="00:00", end="00:05"))
    for _ in range(2):
        bench.roll_call()
        bench.step(0)
        bench.step(1)
    assert bench.steps_of("CGM_Reading") == [0, 0]


# ---- as a process


@contextmanager
def gateway_process(*options: str) -> Iterator[subprocess.Popen[str]]:
    """The gateway, ready."""
    command = [sys.executable, "-m", "can_bus.gateway", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n", process.communicate()
            yield process
        finally:
            process.kill()


def until(link: Link, name: str, within: float = 20.0) -> list[Frame]:
    """Everything up to the first frame of this message."""
    frames: list[Frame] = []
    end = time.monotonic() + within
    while not frames or name_of(frames[-1]) != name:
        assert time.monotonic() < end, f"no {name}, but {names(frames)}"
        frames += link.recv(0.5)
    return frames


def play(plant: Link, device: Link, steps: int) -> tuple[list[Frame], list[Frame]]:
    """A short run by hand; what arrived at the device and at the plant."""
    ours, theirs = Transmitter(), Transmitter()
    at_device: list[Frame] = []
    at_plant: list[Frame] = []

    def turn(phase: Phase, step: int, *said: Frame) -> None:
        token = ours.frame("SYNC_Step", SyncPhase=phase, StepIndex=step, SimTime=step * STEP_SECONDS)
        plant.send([*said, token])
        at_device.extend(until(device, "SYNC_Step"))
        answers = [theirs.frame("PUMP_BasalCmd", BasalUntilStep=step % 128)] if phase == Phase.STEP else []
        device.send([*answers, theirs.frame("SYNC_Done", DoneStatus=0, DoneStepIndex=step, TxCount=len(answers) + 1)])
        at_plant.extend(until(plant, "SYNC_Done"))

    turn(Phase.INIT, 1, ours.frame("PLANT_Info"))
    turn(Phase.CONFIG, 0, ours.frame("MODE_Cmd"))
    for step in range(steps):
        turn(Phase.STEP, step, ours.frame("CGM_Reading", CgmSampleStep=step), ours.frame("PUMP_Status"))
    turn(Phase.END, steps)
    return at_device, at_plant


@pytest.mark.parametrize("hosted", [False, True], ids=["two hubs", "hosting the device's bus"])
def test_a_gateway_process_between_two_buses(tmp_path: Path, hosted: bool) -> None:
    urls = {side: f"unix:{tmp_path / side}" for side in ("plant", "device")}
    path = write(
        tmp_path,
        'faults:\n  - {kind: drop, message: CGM_Reading, start: "00:20", end: "00:30"}\n'
        '  - {kind: drop, message: PUMP_BasalCmd, start: "00:40", count: 1}\n',
    )
    options = ["--plant", urls["plant"], "--device", urls["device"], "--faults", str(path)]
    with (
        Hub(urls["plant"]).start(),
        Hub([] if hosted else urls["device"]).start(),
        gateway_process(*options, *(["--host"] if hosted else [])) as process,
        open_link(urls["plant"]) as plant,
        open_link(urls["device"]) as device,
    ):
        at_device, at_plant = play(plant, device, 12)
        assert process.wait(10) == 0
        assert process.communicate() == ("", "")
    cgm, basal = codec.message("CGM_Reading"), codec.message("PUMP_BasalCmd")
    steps = [cgm.unpack(frame.data)["CgmSampleStep"] for frame in at_device if frame.can_id == cgm.can_id]
    assert steps == [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]
    until_steps = [basal.unpack(frame.data)["BasalUntilStep"] for frame in at_plant if frame.can_id == basal.can_id]
    assert until_steps == [0, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11]
    inject = codec.message("FAULT_Inject")
    told = {
        side: [inject.unpack(frame.data)["FaultParam"] for frame in frames if frame.can_id == FAULT_ID]
        for side, frames in (("device", at_device), ("plant", at_plant))
    }
    assert told == {"device": [4, 5], "plant": [8]}
    assert names(at_device)[:4] == ["PLANT_Info", "SYNC_Step", "MODE_Cmd", "SYNC_Step"]
    assert names(at_device).count("PUMP_Status") == 12


def test_a_gateway_ends_loudly_when_a_bus_is_gone(tmp_path: Path) -> None:
    urls = {side: f"unix:{tmp_path / side}" for side in ("plant", "device")}
    with Hub(urls["device"]).start(), Hub(urls["plant"]) as hub:
        hub.start()
        with gateway_process("--plant", urls["plant"], "--device", urls["device"]) as process:
            hub.close()
            assert process.wait(10) == 3
            out, err = process.communicate()
    assert out == ""
    assert err.startswith(f"gateway: {urls['plant']}: ")
    assert err.count("\n") == 1


def test_wrong_usage_is_one_line_and_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, "faults:\n  - {kind: drop, message: CGM_Readng}\n")
    assert gateway.main(["--plant", "unix:/tmp/a", "--device", "unix:/tmp/b", "--faults", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"gateway: {path}:2: faults.0.message: ")
    assert error.count("\n") == 1
    assert gateway.main(["--plant", "nonsense", "--device", "unix:/tmp/b"]) == 2
    assert capsys.readouterr().err.startswith("gateway: 'nonsense': ")
    nobody = f"unix:{tmp_path / 'nobody'}"
    assert gateway.main(["--plant", nobody, "--device", nobody]) == 3
    assert capsys.readouterr().err.startswith(f"gateway: {nobody}: ")
