"""The rig: starts the nodes of one run, joins them, and sees that they all end.

`hub`, a URL or a python-can interface: firmware and recorder are processes of their own, the plant runs here and, on a
hub, is the switch itself, which saves two wake-ups per turn. With faults a gateway process stands between the device's
bus and the plant's. `inproc`: the same nodes in this process, the same frames, no wake-ups.
"""

import contextlib
import functools
import hashlib
import json
import logging
import os
import re
import select
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple, TypedDict

from can_bus.faults import Hang, MemoryState, NodeControl, NodeFault, Restart, clock
from can_bus.frame import Frame
from can_bus.gateway import Gateway, Side
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY, Node
from can_bus.node_control import CommandControl, LineControl, attend
from can_bus.url import open_link
from plant_server.free_run import FreePlant, serve_free
from plant_server.physiology import SOURCES, Patient, load_patient
from plant_server.scenario import Scenario, load_scenario
from plant_server.sensor import SensorSettings, load_sensor
from plant_server.sensors.ideal import Ideal
from plant_server.serve import serve
from plant_server.server import PlantServer, Run
from plant_server.user import Plan
from pumpbench import live
from pumpbench.calibration import MODES, Tuning, calibrate, tuning_for
from pumpbench.capture import Capture, write_candump
from pumpbench.controller_model import ControllerModel, ControllerModelError, read_models, shipped_models
from pumpbench.faults import Faults, write_wire
from pumpbench.faults import load as load_fault_file
from pumpbench.identity import SOMEBODY_ELSES, firmware_sha256, versions
from pumpbench.node import InProcess, Process
from pumpbench.recorder import write
from pumpbench.rewind import Origin, RewoundPlant
from pumpbench.runfolder import RunFolder

READY_SECONDS = 30.0
END_SECONDS = 5.0
PARTIAL_SECONDS = 60.0
"""What the recorder of a run that broke off may take to write what there is."""


SERIAL = "slcan:"
"""Buses that one program opens."""

WRITE_SECONDS = 600.0


class RigError(ValueError):
    """What was asked for does not make a run; the text says what was expected."""


class NodeDied(RuntimeError):
    """A process of the run ended or failed; the text names it and repeats its last words."""


class Change(NamedTuple):
    """What holds from a sampling instant on."""

    step: int
    strategy: str
    scenario: str


@dataclass(frozen=True)
class Request:
    """One run as asked for."""

    patient: str
    out: Path
    strategy: str = "nma"
    scenario: str = "validation-14d"
    steps: int = STEPS_PER_DAY
    seed: int = 1
    bus: str = "hub"
    device_bus: str | None = None
    faults: Path | Faults | None = None
    firmware: str | None = None
    reset_hook: str | None = None  # a command that switches the device, as `pumpbench gateway --node` takes one
    reset_line: str | None = None  # dtr:PORT or rts:PORT
    free_running: bool = False  # the device keeps time by itself
    speed: float = 1.0  # of the wall clock, in a free run
    sensor: str = "coloured"
    physiology: str | None = None  # None: what the patient's file says
    pramlintide: str = "P2"
    variability: tuple[str, ...] = tuple(SOURCES)
    controller: Path | None = None  # models of patients of one's own; None: those of the package
    model: ControllerModel | None = None  # one that is at hand, instead
    tuning: Tuning | None = None  # None: that of the strategy
    origin: Origin | None = None  # a recorded run that it begins with
    changes: tuple[Change, ...] = ()  # of strategy and scenario on the way
    overwrite: bool = False
    serve: int | None = None  # port of the live view
    web: int | None = None  # and of its page for browsers
    connect_timeout: float = 20.0
    step_timeout: float = 10.0
    progress: Callable[[int], None] = field(default=lambda step: None, compare=False)


@dataclass(frozen=True)
class Prepared:
    """A request with everything looked up and checked; nothing has been started or written."""

    request: Request
    run: Run
    faults: Faults
    info: dict[str, Any]


def variability_sources(text: str) -> tuple[str, ...]:
    """Read what varies in the patient: `all`, `none`, or a comma list of `physiology.SOURCES`, in any order.

    Raises:
        RigError: there is no such source.
    """
    if text == "none":
        return ()
    names = {name.strip() for name in text.split(",")}
    unknown = sorted(names - SOURCES.keys() - {"all"})
    if unknown or ("all" in names and len(names) > 1):
        what = f"there is no {unknown[0]!r}" if unknown else "all stands alone"
        raise RigError(f"--variability {text!r}: {what}; choose all, none, or a comma list of {', '.join(SOURCES)}")
    return tuple(source for source in SOURCES if source in names or "all" in names)


def prepare(request: Request) -> Prepared:
    """Look up patient, scenario, strategy, faults and calibration.

    Raises:
        RigError, PatientError, ScenarioError, SensorError, ControllerModelError, CalibrationError, FileError: what is
            wrong with the request.
    """
    for strategy in (request.strategy, *(change.strategy for change in request.changes)):
        if strategy not in MODES:
            raise RigError(f"there is no strategy {strategy!r}; choose one of {', '.join(MODES)}")
    if request.steps < 1:
        raise RigError("a run has at least one step of 5 min")
    if request.seed < 0:
        raise RigError("a seed is 0 or greater")
    if request.bus == "inproc" and request.firmware:
        raise RigError("--bus inproc runs the built-in firmware only; a --firmware command needs a bus, e.g. --bus hub")
    variability = variability_sources(",".join(request.variability) or "none")
    patient = load_patient(request.patient, physiology=request.physiology, pramlintide=request.pramlintide)
    scenario = _scenario(request.scenario, request, patient)
    changes = _plans(request, scenario, patient)
    faults = load_fault_file(request.faults) if isinstance(request.faults, Path) else request.faults or Faults()
    sensor = load_sensor(request.sensor)
    if request.origin is not None:
        calibration = request.origin.calibration()
    else:
        model = request.model or controller_model(request.patient, patient, request.controller)
        tuning = request.tuning or tuning_for(request.strategy, noisy=not isinstance(sensor.model, Ideal))
        calibration = calibrate(patient, tuning, model)
    _check_speed(request)
    _check_view(request)
    _check_switch(request, [fault for fault in faults.wire if isinstance(fault, NodeFault)])
    mode = MODES[request.strategy]
    injected = faults.pump + faults.sensor
    run = Run(patient, scenario, request.steps, request.seed, mode, calibration, sensor, variability, injected, changes)
    PlantServer(run).rehearse()  # checks the rest, and loads compiled code before anybody waits on a bus
    info = {
        **versions(),
        "patient": request.patient,
        "physiology": patient.physiology,
        "pramlintide": request.pramlintide,
        "variability": list(variability),
        "strategy": request.strategy,
        "scenario": scenario.name,
        **({"scenario_file": request.scenario} if request.scenario != scenario.name else {}),
        "days": request.steps / STEPS_PER_DAY,
        "steps": request.steps,
        "seed": request.seed,
        "sensor": request.sensor,
        "bus": request.bus,
        "firmware": request.firmware or "built-in",
        "firmware_sha256": firmware_sha256(request.firmware),
        **({"reset": request.reset_hook or request.reset_line} if request.reset_hook or request.reset_line else {}),
        **({"free_running": True, "speed": request.speed, "reproducible": False} if request.free_running else {}),
        "faults": faults.as_json(),
        **({"changes": _told(request, changes)} if changes else {}),
        **({"fork": _fork(request.origin)} if request.origin else {}),
        "parameters": {
            "patient_sha256": patient_sha256(patient),
            "scenario_sha256": scenario_sha256(scenario),
            "sensor_sha256": sensor_sha256(sensor),
            "calibration_sha256": _sha256(repr(sorted(calibration.items())).encode()),
        },
    }
    return Prepared(request, run, faults, info)


def _scenario(name: str, request: Request, patient: Patient) -> Scenario:
    """A scenario that is long enough.

    Raises:
        RigError, ScenarioError: it is not, or there is none.
    """
    days = request.steps / STEPS_PER_DAY
    scenario = load_scenario(name, seed=request.seed, patient=patient.name, days=days)
    if request.steps > scenario.days * STEPS_PER_DAY:
        raise RigError(f"scenario {scenario.name} has {scenario.days} days, asked for {days:g}")
    return scenario


def _plans(request: Request, scenario: Scenario, patient: Patient) -> tuple[Plan, ...]:
    """The changes of a request; the meals before each are those of the scenario before it."""
    name = request.scenario
    plans = []
    for change in request.changes:
        if change.scenario != name:
            name = change.scenario
            other = _scenario(name, request, patient)
            meals = [meal for meal in scenario.meals if meal.step < change.step]
            meals += [meal for meal in other.meals if meal.step >= change.step]
            scenario = other._replace(meals=tuple(meals))
        plans.append(Plan(change.step, MODES[change.strategy], scenario))
    return tuple(plans)


def _told(request: Request, plans: Sequence[Plan]) -> list[dict[str, Any]]:
    """The changes of a request for run.json."""
    return [
        {"at": clock(change.step * STEP_SECONDS), **change._asdict(), "scenario_sha256": scenario_sha256(plan.scenario)}
        for change, plan in zip(request.changes, plans, strict=True)
    ]


def _fork(origin: Origin) -> dict[str, Any]:
    """Where a run comes from, for run.json."""
    return {
        "of": origin.info.get("trace_sha256"),
        "at": clock(origin.step * STEP_SECONDS),
        "step": origin.step,
        **({"firmware_since": origin.since} if origin.since is not None else {}),
    }


def patient_sha256(patient: Patient) -> str:
    """Hash over a patient's parameters, as in run.json; so for the others."""
    return _sha256(patient.params.tobytes() + patient.x0.tobytes())


def scenario_sha256(scenario: Scenario) -> str:
    """Hash over meals and habits."""
    return _sha256(repr((scenario.meals, scenario.announcing, scenario.rescue)).encode())


def sensor_sha256(sensor: SensorSettings) -> str:
    """Hash over a sensor's settings."""
    return _sha256(repr(sensor).encode())


def _check_speed(request: Request) -> None:
    """Whether a free run can be had.

    Raises:
        RigError: it cannot, or a speed was given without it.
    """
    if not request.free_running and request.speed != 1.0:
        raise RigError("--speed is that of a free run (--free-running); lockstep is as fast as the device")
    if request.speed <= 0:
        raise RigError("--speed is simulated seconds in a second, above 0")
    if request.free_running and request.bus == "inproc":
        raise RigError("--bus inproc is lockstep; a free run needs a bus")


def _check_view(request: Request) -> None:
    """Whether the run can be watched.

    Raises:
        RigError: it cannot, or a port is taken.
    """
    if request.web is not None and request.serve is None:
        raise RigError("--web is a way to look at what --serve serves: give both")
    if request.serve is not None and request.bus == "inproc":
        raise RigError("--bus inproc has nobody to watch it; --serve needs a bus, e.g. --bus hub")
    try:
        live.check_ports(request.serve, request.web)
    except live.LiveError as error:
        raise RigError(str(error)) from None


def _check_switch(request: Request, faults: Sequence[NodeFault]) -> None:
    """Whether there is somebody who can do these faults to the device.

    Raises:
        RigError: there is not, or there are two.
    """
    hook, line = request.reset_hook, request.reset_line
    if hook is not None and line is not None:
        raise RigError("give --reset-hook or --reset-line: one of them switches the device")
    if (hook is not None or line is not None) and request.bus == "inproc":
        raise RigError("--bus inproc has no device to reset; --reset-hook and --reset-line need a bus")
    if hook is not None and not shlex.split(hook):
        raise RigError("--reset-hook is empty; give the command that switches the device")
    for fault in faults:
        if line is not None and (isinstance(fault, Hang) or (isinstance(fault, Restart) and fault.memory != "kept")):
            raise RigError(f"{fault.kind}: --reset-line can only restart a device, its memory kept; use --reset-hook")
        if request.firmware == SOMEBODY_ELSES and hook is None and line is None:
            raise RigError(
                f"{fault.kind}: somebody has to do this to the device: faults of the node need a firmware that this "
                "run starts (--firmware CMD), or --reset-hook or --reset-line for a device that runs by itself"
            )


def controller_model(asked: str, patient: Patient, file: Path | None) -> ControllerModel:
    """The model the controller works with for one patient.

    Args:
        asked: the patient's name as it was given, with its file if it has one of its own.
        patient: as loaded.
        file: of models, or None for those of the package.

    Raises:
        ControllerModelError: there is none.
    """
    models = shipped_models() if file is None else read_models(file)
    if file is None and asked not in models:
        raise ControllerModelError(
            f"{asked}: the package has controller models of {', '.join(models)} only; make one with "
            f"`pumpbench identify-controller {asked} --out models.csv`, and give it with --controller models.csv"
        )
    if patient.name not in models:
        raise ControllerModelError(f"{file}: no model of patient {patient.name!r}; it has {', '.join(models)}")
    return models[patient.name]


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def execute(prepared: Prepared) -> Path:
    """Do the run and write its run folder; returns the folder.

    Raises:
        NodeDied, MemberSilent, PlantError, BusLost: the run did not come to its end. No process of it is left.
        RunFolderError, OSError: the folder could not be written.
    """
    folder = RunFolder.create(prepared.request.out, overwrite=prepared.request.overwrite)
    try:
        if prepared.request.bus == "inproc":
            return _in_process(prepared, folder)
        return _processes(prepared)
    finally:
        if folder.partial.is_dir() and not any(folder.partial.iterdir()):
            folder.discard()


# ---- all in one process


class Wires:
    """The buses of a run in one process: hands every frame to every other node, in order.

    Args:
        plant: a fresh one.
        device: a node, or a firmware with its power switch.
        gateway: between the two, with the device behind it.
        capture: gets every frame.
    """

    def __init__(self, plant: PlantServer, device: Node | InProcess, gateway: Gateway | None, capture: Capture) -> None:
        self.plant = plant
        self.device = device
        self.gateway = gateway
        self.capture = capture

    def run(self, progress: Callable[[int], None]) -> None:
        """From the roll call to the end of the run.

        Raises:
            NodeDied: the firmware did not answer a token; in one process it never will.
        """
        from_plant: list[Frame] = self.plant.call_roll()
        while from_plant:
            from_plant = self._round(from_plant)
            if self.plant.step % 16 == 0:
                progress(self.plant.step)
        if not self.plant.finished:
            raise NodeDied(f"the firmware went silent: {self.plant.waiting_for}")

    def _round(self, from_plant: list[Frame]) -> list[Frame]:
        """What the plant sends after this, once everybody who is spoken to has answered."""
        if self.gateway is None:
            self.capture.extend(0, from_plant)
            said = self._tell_device(from_plant)
            self.capture.extend(0, said)
            return self._tell_plant(said)
        self.capture.extend(1, from_plant)
        answers: list[Frame] = []
        to_plant: list[Frame] = []
        for frame in from_plant:  # one by one: a fault may replace the device between two of them
            crossing = self.gateway.forward(frame, Side.PLANT)
            self.capture.extend(0, crossing.device)
            to_plant += crossing.plant
            answers += self._tell_device(crossing.device)
        while answers:
            self.capture.extend(0, answers)
            for frame in answers:
                to_plant += self.gateway.forward(frame, Side.DEVICE).plant
            answers = self._started()
        self.capture.extend(1, to_plant)
        return self._tell_plant(to_plant)

    def _tell_device(self, frames: Sequence[Frame]) -> list[Frame]:
        node = self.device.firmware if isinstance(self.device, InProcess) else self.device
        return [answer for frame in frames for answer in node.receive(frame)] + self._started()

    def _started(self) -> list[Frame]:
        """What a device says that a fault has just started."""
        if not isinstance(self.device, InProcess):
            return []
        said, self.device.said = self.device.said, []
        return said

    def _tell_plant(self, frames: Sequence[Frame]) -> list[Frame]:
        return [answer for frame in frames for answer in self.plant.receive(frame)]


def _in_process(prepared: Prepared, folder: RunFolder) -> Path:
    request = prepared.request
    capture = Capture()
    simulate(prepared, capture)
    write(folder, capture, prepared.info, complete=True, origin=request.origin)
    return request.out


def simulate(prepared: Prepared, capture: Capture) -> None:
    """Do the run in this process, with the built-in firmware; `capture` gets every frame and nothing is written.

    Raises:
        NodeDied, PlantError: the run did not come to its end.
    """
    wires(prepared, capture).run(prepared.request.progress)


def wires(prepared: Prepared, capture: Capture, *, memory: bool = False) -> Wires:
    """The nodes of a run in this process, joined.

    Args:
        prepared: the run.
        capture: gets every frame.
        memory: the firmware has a non-volatile memory, whether or not a fault needs one.
    """
    from firmware_sim.firmware import Firmware  # noqa: PLC0415

    wire, origin = prepared.faults.wire, prepared.request.origin
    memory |= origin is not None and origin.state is not None  # which has one
    memory |= any(isinstance(fault, NodeFault) for fault in wire)
    device: Node | InProcess = InProcess() if memory else Firmware()
    gateway = Gateway(wire, device if isinstance(device, InProcess) else None) if wire else None
    return Wires(_plant(prepared, gateway, device), device, gateway, capture)


def _plant(prepared: Prepared, gateway: Gateway | None = None, device: Node | InProcess | None = None) -> PlantServer:
    """The plant of a run; with the nodes of this process that a checkpoint says something about."""
    origin = prepared.request.origin
    if origin is None:
        return PlantServer(prepared.run)
    plant = RewoundPlant(prepared.run, origin)
    stored = origin.state
    if stored is not None:
        from pumpbench import checkpoint  # noqa: PLC0415

        other_faults = prepared.info["faults"] != origin.info["faults"]
        mine = device if isinstance(device, InProcess) else None
        plant.arrived = lambda: checkpoint.check(
            stored, checkpoint.state(plant, gateway, mine), other_faults=other_faults
        )
    return plant


# ---- processes on a bus


class Child:
    """A process of the run: ends with it, and its last words are kept."""

    def __init__(
        self,
        name: str,
        command: list[str],
        environment: dict[str, str],
        log: IO[bytes],
        ready: bool,
        keep: Sequence[int] = (),
        patience: float = 2.0,
    ) -> None:
        self.name = name
        self._patience = patience
        self._log = log
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if ready else log,
                stderr=log,
                env=environment,
                start_new_session=True,
                pass_fds=keep,
            )
        except OSError as error:
            raise NodeDied(f"cannot start the {name} ({shlex.join(command)}): {error.strerror}") from error

    def wait_ready(self, seconds: float, poll: Callable[[], None]) -> None:
        """Wait for the line "ready" while `poll` keeps the hub going."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            poll()
            if select.select([self.process.stdout], [], [], 0.01)[0]:
                if self.process.stdout.readline().strip() == b"ready":
                    return
                raise self.died()
        raise NodeDied(f"the {self.name} was not ready within {seconds:g} s{self._last_words()}")

    def kill(self) -> None:
        """SIGKILL, to the process and to everything it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def check(self) -> None:
        """Raise if the process has ended."""
        if self.process.poll() is not None:
            raise self.died()

    def died(self) -> NodeDied:
        """What to say of a process that ended too early."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)
        code = self.process.returncode
        how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else f"ended with status {code}"
        return NodeDied(f"the {self.name} {how} in the middle of the run{self._last_words()}")

    def finish(self, seconds: float) -> int | None:
        """Wait for a normal end; the exit status, None if it did not come."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def end(self) -> None:
        """End the process and everything it started."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
                os.killpg(self.process.pid, signal.SIGCONT)  # one that a fault has stopped would not end
            if self.finish(self._patience) is not None and number == signal.SIGTERM:
                # the leader has gone; whoever it started is in its session
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
                break
        if self.process.stdout is not None:
            self.process.stdout.close()

    def _last_words(self) -> str:
        self._log.flush()
        with Path(self._log.name).open("rb") as log:
            lines = log.read().decode(errors="replace").strip().splitlines()
        return f": {lines[-1]}" if lines else ""


@contextlib.contextmanager
def one_cpu() -> Iterator[frozenset[int]]:
    """Keep this process, and what it starts, on one CPU; yields the others, for those who need not wait their turn.

    In lockstep only one side runs at a time. Handing the turn over within a CPU takes a fifth of the time that waking
    another CPU does (measured in a virtual machine: 10 against 55 to 75 us there and back).
    """
    if not hasattr(os, "sched_setaffinity"):
        yield frozenset()
        return
    cpus = os.sched_getaffinity(0)
    mine = sorted(cpus)[os.getpid() % len(cpus)]
    os.sched_setaffinity(0, {mine})
    try:
        yield frozenset(cpus - {mine})
    finally:
        os.sched_setaffinity(0, cpus)


@contextlib.contextmanager
def _children() -> Iterator[list[Child]]:
    children: list[Child] = []
    try:
        yield children
    finally:
        for child in children:
            child.end()


class _Options(TypedDict):
    """What both ways to serve a plant take."""

    connect_timeout: float
    step_timeout: float
    watch: Callable[[], None]
    progress: Callable[[int], None]


class _Buses(NamedTuple):
    """The buses of a run as URLs."""

    plant: str
    device: str
    shown: str  # where a recorder sees what is on the device's
    private: bool  # the plant's is a hub of this run
    hosted: bool  # the device's is a hub of the gateway

    @classmethod
    def of(cls, request: Request, place: Path, *, faulty: bool) -> "_Buses":
        """Which buses a request needs; with faults there are two, and where only one program can open a bus.

        Raises:
            RigError: the device's bus is not told.
        """
        plant, second, tap = (f"unix:{place / name}.sock" for name in ("plant", "device", "tap"))
        if request.bus == "hub":
            device = request.device_bus or (second if faulty else plant)
        elif request.bus.startswith(SERIAL):
            device = request.bus
        else:
            plant = request.bus
            device = request.device_bus or (_second_bus(plant) if faulty else plant)
        private = request.bus == "hub" or request.bus.startswith(SERIAL)
        if not device.startswith(SERIAL):
            return cls(plant, device, device, private, hosted=device == second)
        if request.firmware is None:
            raise RigError(
                f"only one program can open {device}, and that is the bench: give --firmware "
                f"{SOMEBODY_ELSES} for a device that runs by itself, or the command that starts it at the other end"
            )
        return cls(plant, device, tap if faulty else plant, private, hosted=False)


def _second_bus(url: str) -> str:
    match = re.fullmatch(r"(socketcan:.*?)(\d+)", url)
    if match is None:
        raise RigError(
            f"faults need a second bus for the device: give --device-bus beside --bus {url} (a hub has one of its own)"
        )
    return f"{match[1]}{int(match[2]) + 1}"


def _processes(prepared: Prepared) -> Path:
    request = prepared.request
    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory, contextlib.ExitStack() as stack:
        place = Path(directory)
        other_cpus = stack.enter_context(one_cpu())
        children = stack.enter_context(_children())
        buses = _Buses.of(request, place, faulty=bool(prepared.faults.wire))
        hub: Hub | None = None
        if buses.private:
            # when a run breaks off, the reason is said once, by us; who then left frames unread does not matter
            logging.getLogger("can_bus.hub").addHandler(logging.NullHandler())
            hub = stack.enter_context(Hub(buses.plant))
            link: Link = stack.enter_context(hub.local_link())
        else:
            link = stack.enter_context(open_link(buses.plant))

        def start(name: str, command: list[str], *, ready: bool, keep: Sequence[int] = ()) -> Child:
            log = stack.enter_context((place / f"{name}.log").open("ab"))
            environment = os.environ | {"PUMPBENCH_BUS": buses.device, "PYTHONUNBUFFERED": "1"}
            patience = PARTIAL_SECONDS if name == "recorder" else 2.0
            child = Child(name, command, environment, log, ready, keep, patience)
            children.append(child)
            if name == "recorder" and other_cpus:
                os.sched_setaffinity(child.process.pid, other_cpus)
            if ready:
                child.wait_ready(READY_SECONDS, poll)
            return child

        def poll() -> None:
            if hub is not None:
                hub.poll(0)

        switch, ours = _switch(prepared, stack)
        recorder = _start_recorder_side(prepared, place, buses, start, switch)
        nvm = place / "nvm"

        def launch(memory: MemoryState) -> Child:
            command = firmware_command(request.firmware, buses.device, nvm if ours else None, memory)
            return start("firmware", command, ready=False)

        firmware = None if request.firmware == SOMEBODY_ELSES else Process(launch, nvm)
        board = _board(request, stack)
        if board is not None:
            board.cut()
            board.start("kept")
        switched = board or firmware
        if ours is not None and switched is not None:
            threading.Thread(target=attend, args=(ours, switched), daemon=True).start()

        def watch() -> None:
            for child in list(children):  # a dead gateway is why a firmware ends, not the other way round
                if child.name != "firmware":
                    child.check()
            if firmware is not None:
                firmware.check()

        try:
            options = _Options(
                connect_timeout=request.connect_timeout,
                step_timeout=request.step_timeout,
                watch=watch,
                progress=request.progress,
            )
            if request.free_running:
                serve_free(FreePlant(prepared.run), link, speed=request.speed, **options)
            else:
                serve(_plant(prepared), link, **options)
        except Exception:
            watch()  # a dead node is the better explanation
            raise
        _await_end(children, recorder, hub)
    return request.out


def _board(request: Request, stack: contextlib.ExitStack) -> NodeControl | None:
    """What switches a device that is no process of ours.

    Raises:
        RigError: there is no such line.
        NodeControlError: its port cannot be opened.
    """
    if request.reset_hook is not None:
        return CommandControl(request.reset_hook)
    if request.reset_line is None:
        return None
    try:
        return stack.enter_context(contextlib.closing(LineControl(request.reset_line)))
    except ValueError as error:
        raise RigError(f"--reset-line {error}") from None


def _switch(prepared: Prepared, stack: contextlib.ExitStack) -> tuple[socket.socket | None, socket.socket | None]:
    """A pair of sockets for faults of the node: the gateway asks at the first, we answer at the second."""
    if not any(isinstance(fault, NodeFault) for fault in prepared.faults.wire):
        return None, None
    asking, ours = socket.socketpair()
    stack.callback(ours.close)
    return asking, ours


def _start_recorder_side(
    prepared: Prepared, place: Path, buses: _Buses, start: Callable[..., Child], switch: socket.socket | None
) -> Child:
    """Start the gateway, if there are two buses, and the recorder."""
    if buses.device != buses.plant:
        wire = place / "faults.yaml"
        write_wire(prepared.faults, wire)
        command = [sys.executable, "-m", "can_bus.gateway", "--plant", buses.plant, "--device", buses.device]
        command += ["--faults", str(wire)]
        command += ["--host"] if buses.hosted else []
        command += ["--free-running"] if prepared.request.free_running else []
        command += ["--tap", buses.shown] if buses.shown not in (buses.device, buses.plant) else []
        if switch is None:
            start("gateway", command, ready=True)
        else:
            with switch:  # the gateway has its own copy
                start("gateway", [*command, "--node-socket", str(switch.fileno())], ready=True, keep=[switch.fileno()])
    info = place / "info.json"
    info.write_text(json.dumps(prepared.info), encoding="utf-8")
    command = [sys.executable, "-m", "pumpbench.recorder", "--bus", buses.shown, "--out", str(prepared.request.out)]
    command += ["--info", str(info), "--overwrite"]
    command += ["--free-running"] if prepared.request.free_running else []
    if buses.shown != buses.plant:
        command += ["--plant-bus", buses.plant]
    origin = prepared.request.origin
    if origin is not None:
        log = place / "origin.log"
        write_candump(origin.frames, log)
        command += ["--origin", str(log), "--origin-step", str(origin.step)]
        command += ["--firmware-since", str(origin.since)] if origin.since is not None else []
    command += ["--serve", str(prepared.request.serve)] if prepared.request.serve is not None else []
    command += ["--web", str(prepared.request.web)] if prepared.request.web is not None else []
    return start("recorder", command, ready=True)


def firmware_command(firmware: str | None, device_url: str, nvm: Path | None, memory: MemoryState) -> list[str]:
    """The command that starts a device.

    Args:
        firmware: somebody's command, with places `{bus}` and `{nvm}`; None for the reference firmware.
        device_url: the device's bus.
        nvm: the file of its memory, if it has one.
        memory: what has become of it.

    Raises:
        RigError: the command is empty.
    """
    if firmware is None:
        command = [sys.executable, "-m", "firmware_sim", "--bus", device_url]
        if nvm is not None:
            command += ["--nvm", str(nvm), "--reset-cause", "power_on" if memory == "kept" else "brown_out"]
        return command
    places = {"{bus}": device_url, "{nvm}": str(nvm or "")}
    command = [
        functools.reduce(lambda text, place: text.replace(*place), places.items(), part)
        for part in shlex.split(firmware)
    ]
    if not command:
        raise RigError("--firmware is empty; give the command that starts it, {bus} stands for the bus URL")
    return command


def _await_end(children: list[Child], recorder: Child, hub: Hub | None) -> None:
    """Let everybody read the end of the run; the recorder then writes, the firmware may as well just be ended."""
    stop = threading.Event()

    def keep_going() -> None:
        while hub is not None and not stop.is_set():
            hub.poll(0.05)

    pump = threading.Thread(target=keep_going)
    pump.start()
    try:
        status = recorder.finish(WRITE_SECONDS)
        if status != 0:
            raise recorder.died()
        for child in children:
            child.finish(END_SECONDS if child.name == "gateway" else 1.0)
    finally:
        stop.set()
        pump.join()
