"""A device on its own clock: nobody waits, commands are taken as they come, and the record says that it is no rerun."""

import json
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Pumpbench
from pumpbench import rig
from pumpbench.bench import Outcome
from pumpbench.calibration import MODES, calibrate
from pumpbench.faults import drop, dump

import dbc
from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from can_bus.gateway import Gateway, Side
from can_bus.lockstep import STEP_SECONDS, Phase
from plant_server import free_run
from plant_server.free_run import FreePlant, serve_free
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.serve import MemberSilent
from plant_server.server import PlantError, Run

PATIENT = load_patient("adult#001")
CALIBRATION = calibrate(PATIENT)
NMA = MODES["nma"]
MAJOR, _ = dbc.protocol_version()

OWN_CLOCK = """
import sys
import time
from can_bus import codec, open_link
from can_bus.codec import Check, Receiver, Transmitter
period, rate = float(sys.argv[2]), 600  # 3 U/h
said = Transmitter()
heard = Receiver(["SYNC_Step", "CFG_Param", "CGM_Reading"])
step = sequence = 0
due = time.monotonic()
with open_link(sys.argv[1]) as link:
    while True:
        for frame in link.recv(max(0.0, due - time.monotonic())):
            check, name, values, _ = heard.receive(frame)
            if check > Check.OK_SOME_LOST:
                continue
            if name == "SYNC_Step" and values["SyncPhase"] == 1:
                step = values["StepIndex"]
            if name == "CFG_Param":
                raw = next(raw for key, raw in values.items() if key != "CfgIndex") & 0x3FFFFFFF
                link.send([said.frame("CFG_ParamEcho", EchoIndex=values["CfgIndex"], EchoRaw=raw)])
        if time.monotonic() >= due:
            due += period
            sequence = (sequence + 1) % 1023
            link.send([
                said.frame("HB_CTRL", NmtCtrl=5),
                said.frame("CTRL_Status", CtrlMode=2, CtrlState=1),
                said.frame("PUMP_BasalCmd", BasalOp=1, BasalCmdSeq=sequence, InsulinRate=rate, PramlintideRate=0,
                           BasalUntilStep=(step + 12) % 128),
            ])
"""


def own_clock(folder: Path, speed: float) -> str:
    """The command of a device that does its task every five simulated minutes by the wall clock, and no lockstep."""
    path = folder / "own_clock.py"
    path.write_text(OWN_CLOCK, encoding="utf-8")
    return f"{sys.executable} {path} {{bus}} {STEP_SECONDS / speed / 2}"


# ---- by a clock that the test winds


class Clock:
    """Time goes on while somebody waits for frames."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


class Wire:
    """A link whose device is a function of what it hears."""

    def __init__(self, clock: Clock, device: Callable[[Frame], list[Frame]]) -> None:
        self._clock, self._device = clock, device
        self._waiting: list[Frame] = []
        self.sent: list[tuple[float, Frame]] = []

    def send(self, frames: list[Frame]) -> None:
        for frame in frames:
            self.sent.append((self._clock.now, frame))
            self._waiting += self._device(frame)

    def recv(self, timeout: float) -> list[Frame]:
        found, self._waiting = self._waiting, []
        self._clock.now += 0 if found else timeout
        return found

    def all(self, name: str) -> list[tuple[float, dict[str, int]]]:
        message = codec.message(name)
        return [(at, message.unpack(frame.data)) for at, frame in self.sent if frame.can_id == message.can_id]


class Device:
    """Says what it is told to, when it hears a message."""

    def __init__(self, *, echo: bool = True, version: tuple[int, int] | None = None, mode: int | None = NMA) -> None:
        self._said = Transmitter()
        self._echo, self._version, self._mode = echo, version, mode
        self.wrong: int | None = None  # CfgIndex

    def __call__(self, frame: Frame) -> list[Frame]:
        message = codec.messages_by_id()[frame.can_id]
        values = message.unpack(frame.data)
        if message.name == "PLANT_Info":
            said = [self._said.frame("HB_CTRL", NmtCtrl=5)]
            if self._version is not None:
                major, minor = self._version
                said.append(self._said.frame("CTRL_Info", CtrlProtocolMajor=major, CtrlProtocolMinor=minor))
            return said
        if message.name == "CFG_Param" and self._echo:
            raw = CALIBRATION[values["CfgIndex"]] & 0x3FFFFFFF
            raw += values["CfgIndex"] == self.wrong
            return [self._said.frame("CFG_ParamEcho", EchoIndex=values["CfgIndex"], EchoRaw=raw)]
        if message.name == "CGM_Reading":
            until = (values["CgmSampleStep"] + 3) % 128
            command = {"BasalOp": 1, "BasalCmdSeq": values["CgmSampleSeq"] % 1023, "BasalUntilStep": until}
            status = [self._said.frame("CTRL_Status", CtrlMode=self._mode, CtrlState=1)] if self._mode else []
            return [self._said.frame("PUMP_BasalCmd", InsulinRate=600, PramlintideRate=0, **command), *status]
        return []


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    wound = Clock()
    monkeypatch.setattr(free_run, "time", wound)
    yield wound


def run(clock: Clock, device: Callable[[Frame], list[Frame]], steps: int = 4, speed: float = 1.0) -> Wire:
    wire = Wire(clock, device)
    plant = FreePlant(Run(PATIENT, load_scenario("fasting"), steps, 1, NMA, CALIBRATION, "ideal", ()))
    serve_free(plant, wire, speed=speed)  # type: ignore[arg-type]
    assert plant.finished
    return wire


@pytest.mark.parametrize("speed", [1.0, 60.0])
def test_the_wall_clock_is_the_time(clock: Clock, speed: float) -> None:
    wire = run(clock, Device(), speed=speed)
    tokens = [(at, values) for at, values in wire.all("SYNC_Step") if values["SyncPhase"] in (Phase.STEP, Phase.END)]
    assert [values["StepIndex"] for _, values in tokens] == [0, 1, 2, 3, 4]
    assert [values["SyncPhase"] for _, values in tokens] == [Phase.STEP] * 4 + [Phase.END]
    first = tokens[0][0]
    assert [at - first for at, _ in tokens] == pytest.approx([k * STEP_SECONDS / speed for k in range(5)])


def test_commands_are_answered_at_once_and_act(clock: Clock) -> None:
    wire = run(clock, Device())
    readings, acks = wire.all("CGM_Reading"), wire.all("PUMP_Ack")
    assert [at for at, _ in acks] == [at for at, _ in readings[:4] for _ in range(2)]
    assert {values["AckResult"] for _, values in acks} == {codec.choice("PUMP_Ack", "AckResult", "Accepted")}
    assert wire.all("PUMP_Delivered")[-1][1]["InsulinTotal"] == 1000  # mU: 3 U/h for 20 minutes


def test_a_device_that_is_not_there(clock: Clock) -> None:
    with pytest.raises(MemberSilent, match="waited 10 s for a frame of CTRL: the firmware is not on this bus"):
        run(clock, lambda _frame: [])
    assert clock.now < 1012


def test_another_major_version_is_refused(clock: Clock) -> None:
    with pytest.raises(PlantError, match=rf"built for protocol {MAJOR + 1}\.0"):
        run(clock, Device(version=(MAJOR + 1, 0)))


def test_a_parameter_echoed_with_another_value_is_refused(clock: Clock) -> None:
    device = Device()
    device.wrong = 0
    with pytest.raises(PlantError, match="CTRL did not accept CfgBasal"):
        run(clock, device)


def test_another_mode_is_refused(clock: Clock) -> None:
    with pytest.raises(PlantError, match="CTRL did not take up the mode: it reports PramS2_RatioNMA"):
        run(clock, Device(mode=6))


def test_a_device_that_does_not_say_is_run_with_a_word_of_warning(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    run(clock, Device(echo=False, mode=None, version=(MAJOR, 62)))
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 3
    texts = [record.getMessage() for record in caplog.records]
    assert "does not know what was added" in texts[0]
    assert "echoed no parameter" in texts[1]
    assert "in which mode" in texts[2]


def test_a_machine_that_is_too_slow_says_so_once(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    device = Device()

    def slow(frame: Frame) -> list[Frame]:
        clock.now += 20 if frame.can_id == codec.message("CGM_Reading").can_id else 0
        return device(frame)

    run(clock, slow, steps=6, speed=60.0)
    assert [record.getMessage()[:37] for record in caplog.records] == ["this machine is too slow for this spe"]


def test_a_gateway_ends_with_the_last_token() -> None:
    plant = Transmitter()
    gateway = Gateway(free_running=True)
    for phase, step in ((Phase.CONFIG, 0), (Phase.STEP, 0), (Phase.END, 1)):
        assert not gateway.finished
        token = plant.frame("SYNC_Step", SyncPhase=phase, StepIndex=step, SimTime=step * STEP_SECONDS)
        assert gateway.forward(token, Side.PLANT).device == [token]
    assert gateway.finished


# ---- as processes

FREE = ("run", "--strategy", "nma", "--scenario", "six-hours", "--free-running", "--speed", 3000)


def test_a_device_that_never_closes_a_turn(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*FREE, "--days", 0.05, "--firmware", own_clock(runs, 3000), "--out", runs / "out")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    outcome = Outcome.load(runs / "out")
    info = json.loads((runs / "out" / "run.json").read_text())
    assert (info["free_running"], info["speed"], info["reproducible"]) == (True, 3000, False)
    assert len(outcome.trace) == 15
    assert np.isfinite(outcome.trace.get("GlucoseConc")).all()  # every batch is in its own step
    assert set(outcome.safety["hazards"].values()) == {None}
    outcome.assert_ledger_closes()
    commanded = [row for row in outcome.frames.frames() if row.can_id == codec.message("PUMP_BasalCmd").can_id]
    answered = [row for row in outcome.frames.frames() if row.can_id == codec.message("PUMP_Ack").can_id]
    assert len(commanded) > 5
    assert len(answered) == 2 * len(commanded)
    assert outcome.trace.basal_delivered("Insulin")[3:-1].mean() == pytest.approx(3.0, abs=0.2)


def test_a_device_that_could_do_lockstep_runs_free_too(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*FREE, "--days", 0.05, "--out", runs / "out")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    outcome = Outcome.load(runs / "out")
    assert outcome.states()[-1][1] == "Auto"


def test_faults_act_in_a_free_run(pumpbench: Pumpbench, runs: Path) -> None:
    faults = runs / "faults.yaml"
    faults.write_text(dump([drop("CGM_Reading", start="00:20", end="00:40")]), encoding="utf-8")
    device = own_clock(runs, 3000)
    done = pumpbench(*FREE, "--days", 0.05, "--firmware", device, "--faults", faults, "--out", runs / "out")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert Outcome.load(runs / "out").safety["faults_injected"] == 4


def test_nobody_there_is_one_line(pumpbench: Pumpbench, runs: Path) -> None:
    device = f"{sys.executable} -c 'import time; time.sleep(60)'"
    done = pumpbench(*FREE, "--firmware", device, "--connect-timeout", 1, "--out", runs / "out")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert "waited 1 s for a frame of CTRL" in done.stderr


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"speed": 2.0}, "--speed is that of a free run"),
        ({"free_running": True, "speed": 0.0}, "above 0"),
        ({"free_running": True, "bus": "inproc"}, "--bus inproc is lockstep"),
    ],
)
def test_what_is_refused_before_anything_starts(more: dict[str, object], text: str) -> None:
    with pytest.raises(rig.RigError, match=text):
        rig.prepare(rig.Request("adult#001", Path("x"), **more))  # type: ignore[arg-type]
