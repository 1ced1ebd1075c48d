"""A run as asked for, with everything looked up and checked before anything is started or written."""

import hashlib
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from can_bus.faults import Hang, NodeFault, Restart, clock
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY
from plant_server.physiology import SOURCES, Patient, load_patient
from plant_server.scenario import Scenario, load_scenario
from plant_server.sensor import load_sensor
from plant_server.sensors.ideal import Ideal
from plant_server.server import PlantServer, Run
from plant_server.user import Plan
from pumpbench.calibration import MODES, Tuning, calibrate, tuning_for
from pumpbench.controller_model import ControllerModel, model_of
from pumpbench.faults import Faults
from pumpbench.faults import load as load_fault_file
from pumpbench.identity import BUILT_IN, SOMEBODY_ELSES, firmware_sha256, versions
from pumpbench.recorder import live
from pumpbench.rewind import Origin


class RigError(ValueError):
    """What was asked for does not make a run; the text says what was expected."""


class Change(NamedTuple):
    """What holds from a sampling instant on."""

    step: int
    strategy: str
    scenario: str


Progress = Callable[[int, int], None]
"""Called with the steps that are done and with their number."""


def unseen(_done: int, _of: int) -> None:
    """A `Progress` that nobody looks at."""


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
        model = request.model or model_of(patient, request.controller, request.patient)
        tuning = request.tuning or tuning_for(request.strategy, noisy=not isinstance(sensor.model, Ideal))
        calibration = calibrate(patient, tuning, model)
    _check_speed(request)
    _check_view(request)
    _check_switch(request, [fault for fault in faults.wire if isinstance(fault, NodeFault)])
    mode = MODES[request.strategy]
    injected = faults.pump + faults.sensor
    run = Run(patient, scenario, request.steps, request.seed, mode, calibration, sensor, variability, injected, changes)
    PlantServer(run).rehearse()  # checks the rest, and loads compiled code before anybody waits on a bus
    info = _info(request, run, faults)
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


# ---- run.json


def _info(request: Request, run: Run, faults: Faults) -> dict[str, Any]:
    """What run.json says of a run before it has begun."""
    scenario = run.scenario.name
    return {
        **versions(),
        "patient": request.patient,
        "physiology": run.patient.physiology,
        "pramlintide": request.pramlintide,
        "variability": list(run.variability),
        "strategy": request.strategy,
        "scenario": scenario,
        **({"scenario_file": request.scenario} if request.scenario != scenario else {}),
        "days": request.steps / STEPS_PER_DAY,
        "steps": request.steps,
        "seed": request.seed,
        "sensor": request.sensor,
        "bus": request.bus,
        "firmware": request.firmware or BUILT_IN,
        "firmware_sha256": firmware_sha256(request.firmware),
        **({"reset": request.reset_hook or request.reset_line} if request.reset_hook or request.reset_line else {}),
        **({"free_running": True, "speed": request.speed, "reproducible": False} if request.free_running else {}),
        "faults": faults.as_json(),
        **({"changes": _changes(request, run.changes)} if run.changes else {}),
        **({"fork": _fork(request.origin)} if request.origin else {}),
        "parameters": {
            "patient_sha256": _sha256(run.patient.params.tobytes() + run.patient.x0.tobytes()),
            "scenario_sha256": _scenario_sha256(run.scenario),
            "sensor_sha256": _sha256(repr(run.sensor).encode()),
            "calibration_sha256": _sha256(repr(sorted(run.calibration.items())).encode()),
        },
    }


def _changes(request: Request, plans: Sequence[Plan]) -> list[dict[str, Any]]:
    found = []
    for change, plan in zip(request.changes, plans, strict=True):
        at = clock(change.step * STEP_SECONDS)
        found.append({"at": at, **change._asdict(), "scenario_sha256": _scenario_sha256(plan.scenario)})
    return found


def _fork(origin: Origin) -> dict[str, Any]:
    """Where a run comes from."""
    return {
        "of": origin.info.get("trace_sha256"),
        "at": clock(origin.step * STEP_SECONDS),
        "step": origin.step,
        **({"firmware_since": origin.since} if origin.since is not None else {}),
    }


def _scenario_sha256(scenario: Scenario) -> str:
    return _sha256(repr((scenario.meals, scenario.announcing, scenario.rescue)).encode())


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


# ---- what does not go together


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
