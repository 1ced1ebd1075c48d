"""The device loses power, hangs, dies: in this process, as a process, on a kernel's CAN, behind a serial adapter."""

import os
import socket
import sys
import threading
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import bench
from pumpbench.faults import (
    Faults,
    drop,
    dump,
    duplicate,
    extended_id,
    hang,
    kill,
    load,
    remote_frame,
    restart,
    set_value,
    slow_task,
)
from pumpbench.rig.power import tear
from pumpbench.runfolder import RunFolder
from serial_cable import cable

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.faults import MemoryState
from can_bus.frame import Frame
from can_bus.gateway import Gateway, Side
from can_bus.lockstep import Done, Phase
from can_bus.node_control import CommandControl, NodeControlError, SocketControl, attend
from firmware_sim.firmware import NVM_BYTES, NVM_WORDS
from firmware_sim.nvm import Nvm, RamMemory
from plant_server.physiology import load_patient

MIXED = [
    drop("CGM_Reading", start="00:30", end="00:50"),
    restart(start="01:00", after_frames=2),
    restart(start="01:30"),
    restart(start="01:40", memory="torn"),
    hang(start="02:00", end="03:35"),  # long enough for every counter to come round
    restart(start="04:00", end="04:20"),
    slow_task(task=1, start="04:40", end="04:45"),
    duplicate("PUMP_BolusCmd"),
    set_value("CGM_Reading", "GlucoseConc", 350, start="05:00", end="05:10"),
    extended_id("PUMP_Status", start="05:40", count=1),  # what no DBC has must be heard, or not, by all alike
    remote_frame("PUMP_Status", start="05:45", count=1),
]
RUN = ("run", "--strategy", "sma", "--scenario", "six-hours", "--days", "0.25")


@pytest.fixture(scope="module")
def mixed() -> bench.Outcome:
    return bench.run(strategy="sma", scenario="six-hours", hours=6, faults=MIXED)


def fault_file(folder: Path, faults: list[object]) -> Path:
    path = folder / "faults.yaml"
    path.write_text(dump(faults), encoding="utf-8")
    return path


# ---- what the device does, in this process


def test_the_run_goes_on_and_every_stroke_is_accounted_for(mixed: bench.Outcome) -> None:
    mixed.assert_no_hazards()
    mixed.assert_ledger_closes()
    assert len(mixed.raised("NodeReset")) == 4
    mixed.assert_back_to("Auto", after="05:10", within="00:20")


def test_a_device_without_power_is_missed_by_the_pump() -> None:
    outcome = bench.run(strategy="nma", scenario="six-hours", hours=4, faults=[restart(start="01:00", end="01:40")])
    outcome.assert_alarm("CtrlLost", node="PUMP", after="01:00", within="00:25")
    outcome.assert_alarm("NodeReset", after="01:40", within="00:05")
    outcome.assert_back_to("Auto", after="01:40", within="00:20")
    assert outcome.state("01:35") == outcome.state("00:55")  # it says nothing


def test_a_device_that_dies_leaves_the_pump_to_its_schedule() -> None:
    outcome = bench.run(strategy="nma", scenario="six-hours", hours=6, faults=[kill(start="01:00")])
    outcome.assert_no_hazards()
    outcome.assert_alarm("CtrlLost", node="PUMP", after="01:00", within="00:25")
    assert scheduled(outcome, 20)


def scheduled(outcome: bench.Outcome, since: int) -> bool:
    """Whether from a step on the pump gave adult#001's basal rate, to a stroke of 0.05 U."""
    rates = outcome.trace.basal_delivered("Insulin")[since:-1]
    return bool(abs(rates.sum() - load_patient("adult#001").basal_u_per_h * len(rates)) / 12 <= 0.05)


def test_a_hung_device_goes_on_where_it_was() -> None:
    outcome = bench.run(strategy="nma", scenario="six-hours", hours=3, faults=[hang(start="01:00", end="01:30")])
    assert not outcome.raised("NodeReset")
    outcome.assert_alarm("CgmLost", after="01:30", within="00:05")
    outcome.assert_back_to("Auto", after="01:30", within="00:20")


def test_a_blank_memory_is_a_device_that_commands_nothing() -> None:
    outcome = bench.run(strategy="sma", scenario="six-hours", hours=6, faults=[restart(start="00:50", memory="lost")])
    outcome.assert_no_hazards()
    assert outcome.states()[-1][1] == "Init"
    assert "NodeMemoryLost" in {event.kind for event in outcome.trace.faults}
    assert scheduled(outcome, 16)


@pytest.mark.parametrize("after", range(8))
def test_power_lost_behind_each_frame_of_a_meal(after: int) -> None:
    """The turn in which a bolus begins is cut anywhere; what the pump did not hear is not given, the rest once."""
    outcome = bench.run(
        strategy="sma", scenario="six-hours", hours=2.5, faults=[restart(start="01:00", after_frames=after)]
    )
    outcome.assert_no_hazards()
    outcome.assert_ledger_closes()
    outcome.assert_alarm("NodeReset", after="01:00", within="00:06")
    outcome.assert_back_to("Auto", after="01:05", within="00:25")
    given = outcome.trace.get("InsulinBolusDelivered")[:30]
    assert 0 <= given[given == given].sum() < 5


def test_a_torn_write_leaves_the_record_before_it() -> None:
    memory = RamMemory(NVM_BYTES)
    tear(memory, NVM_WORDS)  # nothing to tear
    assert memory.read(0, memory.size) == b"\xff" * memory.size
    nvm = Nvm(memory, NVM_WORDS)
    for number in range(5):
        nvm.store([number] * 30)
        copy = RamMemory(memory.size)
        copy.write(0, memory.read(0, memory.size))
        tear(copy, NVM_WORDS)
        again = Nvm(copy, NVM_WORDS)
        assert again.load() == [number] * 30 and again.fallbacks == 1


# ---- the same bytes everywhere


def test_as_processes_on_hubs_the_same_bytes(mixed: bench.Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*RUN, "--faults", fault_file(runs, MIXED), "--out", runs / "hub")
    assert done.returncode == 0, done.stderr
    folder = RunFolder.load(runs / "hub")
    assert folder.info["trace_sha256"] == mixed.frames.sha256()
    assert folder.info["faults"] == Faults.of(MIXED).as_json()


@pytest.mark.vcan
def test_between_vcan0_and_vcan1_the_same_bytes(mixed: bench.Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*RUN, "--faults", fault_file(runs, MIXED), "--out", runs / "vcan", "--bus", "socketcan:vcan0")
    assert done.returncode == 0, done.stderr
    assert RunFolder.load(runs / "vcan").info["trace_sha256"] == mixed.frames.sha256()


@pytest.mark.parametrize("faulty", [True, False])
def test_behind_a_serial_adapter_the_same_bytes(
    mixed: bench.Outcome, pumpbench: Pumpbench, runs: Path, faulty: bool
) -> None:
    with cable() as (ours, theirs):
        firmware = f"{sys.executable} -m firmware_sim --bus {theirs}"
        options = ["--faults", fault_file(runs, MIXED)] if faulty else []
        if faulty:
            firmware += " --nvm {nvm}"
        done = pumpbench(*RUN, *options, "--bus", ours, "--firmware", firmware, "--out", runs / "slcan")
    assert done.returncode == 0, done.stderr
    expected = mixed if faulty else bench.run(strategy="sma", scenario="six-hours", hours=6)
    found = RunFolder.load(runs / "slcan").info["trace_sha256"]
    if faulty:  # told by the command that starts it, where ours is told by the rig
        assert found == with_cause(mixed, RunFolder.load(runs / "slcan"))
    else:
        assert found == expected.frames.sha256()


def with_cause(mixed: bench.Outcome, folder: RunFolder) -> str:
    """Hash of a run but for HB_CTRL's ResetCauseCtrl, which another firmware command does not get told."""
    heartbeat = codec.message("HB_CTRL").can_id
    theirs, ours = folder.frames, mixed.frames
    rows = theirs.can_id == heartbeat
    assert len(theirs) == len(ours) and (ours.data[~rows] == theirs.data[~rows]).all()
    return str(folder.info["trace_sha256"])


# ---- what cannot be


def test_a_port_that_only_the_bench_can_open_needs_a_firmware_of_its_own(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*RUN, "--bus", "slcan:/dev/null@500000", "--out", runs / "x")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "only one program can open slcan:/dev/null@500000" in done.stderr and "--firmware none" in done.stderr


def test_nobody_can_cut_the_power_of_a_device_that_runs_by_itself(pumpbench: Pumpbench, runs: Path) -> None:
    faults = fault_file(runs, [restart(start="01:00")])
    done = pumpbench(*RUN, "--firmware", "none", "--faults", faults, "--out", runs / "x")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "need a firmware that this run starts" in done.stderr and "--reset-hook" in done.stderr


def test_a_gateway_needs_somebody_who_switches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="hang: a fault of the device needs somebody who runs it"):
        Gateway([hang(start="01:00")])
    from can_bus.gateway import main

    path = fault_file(tmp_path, [kill(start="01:00")])
    assert main(["--plant", "unix:/a", "--device", "unix:/b", "--faults", str(path)]) == 2
    assert capsys.readouterr().err.startswith("gateway: kill: a fault of the device needs somebody who runs it")
    assert main(["--plant", "unix:/a", "--device", "unix:/b", "--node", ""]) == 2
    assert "empty" in capsys.readouterr().err


def test_a_fault_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    assert load(fault_file(tmp_path, MIXED)) == Faults.of(MIXED)
    assert dump([]) == "faults: []\n"


# ---- the switch


class Switch:
    """Notes what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def cut(self) -> None:
        self.asked.append("cut")

    def start(self, memory: MemoryState) -> None:
        self.asked.append(f"start {memory}")

    def freeze(self) -> None:
        self.asked.append("freeze")

    def thaw(self) -> None:
        raise RuntimeError("the relay\nis stuck")


def test_a_switch_at_the_other_end_of_a_socket() -> None:
    ours, theirs = socket.socketpair()
    switch = Switch()
    thread = threading.Thread(target=attend, args=(theirs, switch))
    thread.start()
    control = SocketControl(ours)
    control.cut()
    control.start("torn")
    control.freeze()
    assert switch.asked == ["cut", "start torn", "freeze"]
    with pytest.raises(NodeControlError, match="thaw: the relay is stuck"):
        control.thaw()
    with pytest.raises(NodeControlError, match="explode: unknown request 'explode'"):
        control.ask("explode")
    ours.shutdown(socket.SHUT_RDWR)
    thread.join()
    with pytest.raises(NodeControlError, match=r"cut: .*nobody switches the device"):
        control.cut()
    ours.close()


def test_a_command_as_a_switch(tmp_path: Path) -> None:
    log = tmp_path / "asked"
    script = tmp_path / "switch.sh"
    script.write_text(f'#!/bin/sh\necho "$@" >> {log}\n[ "$2" != thaw ] || {{ echo no such relay >&2; exit 4; }}\n')
    script.chmod(0o755)
    control = CommandControl(f"{script} board-7")
    control.cut()
    control.start("kept")
    control.freeze()
    assert log.read_text().splitlines() == ["board-7 cut", "board-7 start kept", "board-7 freeze"]
    with pytest.raises(NodeControlError, match="board-7 thaw ended with status 4: no such relay"):
        control.thaw()
    with pytest.raises(NodeControlError, match="No such file"):
        CommandControl("/nowhere/at/all").cut()


# ---- the turn of a device that is not there


def names(frames: list[Frame]) -> list[str]:
    return [codec.messages_by_id()[frame.can_id].name for frame in frames]


class Wire:
    """A plant and a device by hand, on either side of a gateway."""

    def __init__(self, *faults: object) -> None:
        self.switch = Switch()
        self.gateway = Gateway(list(faults), self.switch)  # type: ignore[arg-type]
        self.plant, self.device = Transmitter(), Transmitter()
        self.to_device: list[Frame] = []
        self.to_plant: list[Frame] = []
        self.token(Phase.INIT, 1)
        self.done(1)
        self.token(Phase.CONFIG, 0)
        self.done(0)

    def put(self, frame: Frame, side: Side) -> None:
        crossing = self.gateway.forward(frame, side)
        self.to_device += crossing.device
        self.to_plant += crossing.plant

    def token(self, phase: Phase, step: int) -> None:
        self.put(self.plant.frame("SYNC_Step", SyncPhase=phase, StepIndex=step, SimTime=step * 300), Side.PLANT)

    def done(self, step: int, status: Done = Done.OK) -> None:
        self.put(self.device.frame("SYNC_Done", DoneStatus=status, DoneStepIndex=step, TxCount=1), Side.DEVICE)

    def boot(self) -> None:
        self.device = Transmitter()
        self.put(self.device.frame("HB_CTRL", NmtCtrl=0), Side.DEVICE)

    def take(self) -> tuple[list[str], list[str]]:
        """Names of what reached the device and the plant since the last call."""
        to_device, to_plant = self.to_device, self.to_plant
        self.to_device, self.to_plant = [], []
        return names(to_device), names(to_plant)

    def counters(self, name: str, frames: list[Frame]) -> list[int]:
        return [frame.data[1] & 0xF for frame in frames if frame.can_id == codec.message(name).can_id]


def test_the_gateway_takes_the_turn_and_numbers_go_on() -> None:
    wire = Wire(hang(start="00:10", end="00:20"))
    for step in range(2):
        wire.token(Phase.STEP, step)
        wire.done(step)
    all_done = wire.counters("SYNC_Done", wire.to_plant)
    all_tokens = wire.counters("SYNC_Step", wire.to_device)
    wire.take()
    for step in (2, 3):
        wire.put(wire.plant.frame("CGM_Reading"), Side.PLANT)
        wire.token(Phase.STEP, step)
        all_done += wire.counters("SYNC_Done", wire.to_plant)
        reached = ["CGM_Reading"] if step == 2 else []  # it hangs from its token on
        assert wire.take() == (reached, ["FAULT_Inject", "SYNC_Done"])
    assert wire.switch.asked == ["freeze"]
    with pytest.raises(RuntimeError, match="relay"):
        wire.token(Phase.STEP, 4)  # it is thawed then
    wire.token(Phase.STEP, 4)
    all_tokens += wire.counters("SYNC_Step", wire.to_device)
    wire.done(4)
    wire.token(Phase.STEP, 5)
    wire.done(5)
    all_done += wire.counters("SYNC_Done", wire.to_plant)
    all_tokens += wire.counters("SYNC_Step", wire.to_device)[1:]
    for counters in (all_done, all_tokens):
        assert counters == list(range(counters[0], counters[0] + len(counters)))


def test_a_device_that_starts_anew_is_waited_for() -> None:
    wire = Wire(restart(start="00:05"))
    wire.token(Phase.STEP, 0)
    wire.done(0)
    wire.take()
    wire.token(Phase.STEP, 1)
    assert wire.take() == ([], []) and wire.switch.asked == ["cut", "start kept"]
    wire.done(1)  # the last words of the old one
    wire.put(wire.device.frame("HB_CTRL", NmtCtrl=5), Side.DEVICE)
    assert wire.take() == ([], [])
    wire.boot()
    assert wire.take() == ([], ["HB_CTRL"])
    wire.token(Phase.STEP, 1)  # the plant repeats it
    assert wire.take() == (["FAULT_Inject", "SYNC_Step"], [])
    wire.done(1)
    assert wire.take() == ([], ["SYNC_Done"])


def test_a_turn_that_is_over_before_the_power_goes_is_whole() -> None:
    wire = Wire(restart(start="00:05", after_frames=9))
    wire.token(Phase.STEP, 0)
    wire.done(0)
    wire.token(Phase.STEP, 1)
    wire.done(1)
    assert wire.take()[1] == ["SYNC_Done"] * 4 and wire.switch.asked == []
    wire.token(Phase.STEP, 2)
    assert wire.take() == ([], []) and wire.switch.asked == ["cut", "start kept"]


def test_the_end_comes_without_the_device_too() -> None:
    wire = Wire(kill(start="00:00"))
    wire.token(Phase.STEP, 0)
    assert wire.take()[1][-2:] == ["FAULT_Inject", "SYNC_Done"]
    wire.token(Phase.END, 1)
    assert wire.gateway.finished and wire.take()[1] == ["FAULT_Inject", "SYNC_Done"]


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="signals")
def test_a_killed_gateway_ends_the_run(pumpbench: Pumpbench, runs: Path) -> None:
    """Whoever dies, the run ends with a line that names it."""
    faults = fault_file(runs, [drop("CGM_Reading", start="01:00", count=1)])
    script = (
        "import os, signal, sys, psutil, threading, time\n"
        "from pumpbench.cli import main\n"
        "def reaper():\n"
        "    while not any('firmware_sim' in child.cmdline() for child in psutil.Process().children()):\n"
        "        time.sleep(0.05)\n"
        "    time.sleep(0.5)\n"
        "    next(c for c in psutil.Process().children() if 'can_bus.gateway' in c.cmdline()).kill()\n"
        "threading.Thread(target=reaper, daemon=True).start()\n"
        "main()\n"
    )
    import subprocess

    done = subprocess.run(
        [sys.executable, "-c", script, "run", "--days", "14", "--faults", str(faults), "--out", str(runs / "x")],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "the gateway was killed by SIGKILL" in done.stderr and done.stderr.count("\n") == 1


def test_a_device_that_starts_anew_raises_nothing_of_its_earlier_life() -> None:
    lost = drop("CGM_Reading", start="00:30", end="01:20")
    for memory in ("kept", "lost"):
        given = [lost, restart(start="01:00", memory=memory)]
        outcome = bench.run(strategy="nma", scenario="fasting", hours=2, faults=given)
        first = [event for event in outcome.alarms if event.code == "CgmLost" and event.node == "CTRL"]
        assert first[0].state == "Pending"
        ends = [event.time_s for event in first if event.instance == first[0].instance and event.state == "Inactive"]
        assert 3600 <= ends[0] < 3601
