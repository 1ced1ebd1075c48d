"""An instant of a run as a folder of its own: to be kept, sent, looked into, and forked any number of times.

    checkpoint.json   what was run (its run.json), the instant, the programs, and hashes of the other files
    bus.log         every frame up to the instant, candump format: whoever hears them again is in the same state
    state.json      that state in words: patient, sensor, pump, user, gateway, and the reference firmware's RAM
    memory.bin      its non-volatile memory, as `python -m firmware_sim --nvm` takes it

A fork does the frames again (`pumpbench.rewind`) and then holds the state it has come to against state.json.
"""

import contextlib
import enum
import hashlib
import itertools
import json
import random
import shutil
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel

import can_bus
import dbc
import firmware_sim
import plant_server
from plant_server.physiology import STATES
from pumpbench import fork, rig
from pumpbench.candump import read_candump, write_candump
from pumpbench.capture import Capture
from pumpbench.identity import BUILT_IN
from pumpbench.rewind import Diverged, RewoundPlant, before
from pumpbench.rig.power import InProcess

CHECKPOINT, LOG, STATE, MEMORY = "checkpoint.json", "bus.log", "state.json", "memory.bin"
FORMAT: Final = "pumpbench checkpoint 1"

NO_STATE: Final = {
    "pumpbench.rewind.RewoundPlant": (
        "run", "_with_reading", "_without_reading", "_pump_faults",
        "_call", "_roll", "late_answers",  # of the roll call, which the wall clock repeats
        "_origin", "_record", "_record_steps", "_row", "_said", "_rewinding", "_answers", "_otherwise", "_done",
        "arrived",
    ),
    "plant_server.body.Body": ("_nominal", "_variability", "_carbs", "_meals", "_rules"),
    "plant_server.sensor.Sensor": (
        "settings", "wear", "errors", "_gain", "_offset", "_session", "_states", "_every", "_before", "_after",
        "_last_stages", "_faults",
    ),
    "plant_server.pump.Pump": ("settings", "_mixed"),
    "plant_server.set_point.SetPoint": ("_schedule", "_limits", "_ratio"),
    "plant_server.chamber.Chamber": ("settings", "_out"),
    "plant_server.bolus.DrugBolus": ("chamber",),
    "plant_server.user.User": ("_plans", "_planned", "_scenario", "_policy"),
    "can_bus.codec.Transmitter": ("_codecs",),
    "can_bus.codec.Receiver": ("_codecs",),
    "can_bus.faults.injector.Injector": ("_by_id", "_on_bus", "_off", "_watched"),
    "can_bus.gateway.Clock": ("_token", "_done"),
    "can_bus.gateway.Stamp": ("_codec",),
    "can_bus.gateway._Device": ("_control",),
    "firmware_sim.firmware.Firmware": ("log", "_handlers", "_nvm"),
    "firmware_sim.history.History": ("_memory",),
    "firmware_sim.uds.Uds": ("_device", "_services"),
    "firmware_sim.scheduler.Scheduler": ("_tasks",),
    "firmware_sim.calibration.Calibration": ("_names", "_fields"),
}  # fmt: skip
"""Attributes that follow from what is run, or lead to other nodes; everything else that a node has is its state."""

ROOMS: Final = ("can_bus.", "plant_server.", "firmware_sim.", "pumpbench.")
"""Whose objects are nodes and parts of them."""

OF_FAULTS: Final = ("bus", "effects", "memory_sha256")
"""Parts of a state that other faults to come change: what they have seen pass, and whether a memory is needed."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the text names the file and what is wrong with it."""


def programs() -> str:
    """Hash over the source of everything that has a state, and the wire."""
    digest = hashlib.sha256()
    for room in (dbc, can_bus, plant_server, firmware_sim):
        folder = Path(str(room.__file__)).parent
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".py", ".dbc", ".csv"):
                digest.update(f"{folder.name}/{path.relative_to(folder)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


# ---- the state of the nodes


def plain(value: Any, place: str) -> Any:
    """A node, or something of it, as JSON has it.

    Raises:
        TypeError: something without a state that anybody knows of; `NO_STATE` has those that have none.
    """
    match value:
        case None | bool() | int() | float() | str():
            return int(value) if isinstance(value, enum.IntEnum) else value
        case enum.Enum():
            return value.name
        case bytes() | bytearray():
            return value.hex()
        case np.ndarray() | np.generic():
            return value.tolist()
        case random.Random():
            return hashlib.sha256(repr(value.getstate()).encode()).hexdigest()
        case BaseModel():
            return value.model_dump(mode="json", exclude_defaults=True) | {"kind": getattr(value, "kind", "")}
        case Mapping():
            return {str(getattr(key, "name", key)): plain(each, f"{place}[{key}]") for key, each in value.items()}
        case set() | frozenset():
            return sorted(plain(each, place) for each in value)
        case tuple() if hasattr(value, "_asdict"):
            return plain(value._asdict(), place)
        case list() | tuple() | deque():
            return [plain(each, f"{place}[{number}]") for number, each in enumerate(value)]
    if callable(value) or not type(value).__module__.startswith(ROOMS):
        raise TypeError(f"{place}: {type(value).__name__} is nothing that a checkpoint can hold")
    names = list(vars(value)) if hasattr(value, "__dict__") else list(type(value).__slots__)
    left_out = NO_STATE.get(f"{type(value).__module__}.{type(value).__name__}", ())
    for name in left_out:
        names.remove(name)
    return {name.lstrip("_"): plain(getattr(value, name), f"{place}.{name}") for name in names}


def state(plant: Any, gateway: Any = None, device: InProcess | None = None) -> dict[str, Any]:
    """What the nodes of a run know, besides what they are made of.

    Args:
        plant: at the instant.
        gateway: if there is one.
        device: the reference firmware in this process; None: the device is elsewhere, and the gateway too.
    """
    known = plain(plant, "plant")
    body = known.pop("patient")
    body["x"] = dict(zip((each.name for each in STATES), body["x"], strict=True))
    known["receiver"] = {"last": known["receiver"]["last"]}  # its counts are also of the roll call
    running = [*plant._sensor._before, *plant._sensor._after, *plant._sensor._last_stages]
    found = {
        "patient": body,
        "sensor": known.pop("sensor"),
        "pump": known.pop("pump"),
        "user": known.pop("user"),
        "plant": known,
        "effects": [[plain(each.effect, "effect"), each.memory.held] for each in running],
    }
    if device is None:
        return found
    return found | {
        "bus": plain(gateway, "bus"),
        "firmware": plain(device.firmware, "firmware"),
        "memory_sha256": hashlib.sha256(device.memory).hexdigest(),
    }


def differences(one: Any, other: Any, place: str = "") -> Iterator[str]:
    """Where two states differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in one.keys() | other.keys():
            yield from differences(one.get(name), other.get(name), f"{place}.{name}" if place else name)
    elif isinstance(one, list) and isinstance(other, list):
        for number, pair in enumerate(itertools.zip_longest(one, other)):
            yield from differences(*pair, f"{place}[{number}]")
    elif one != other:
        yield f"{place} was {one}, is {other}"


def check(stored: Mapping[str, Any], now: Mapping[str, Any], *, other_faults: bool) -> None:
    """Hold the state that nodes have come to against a stored one.

    Args:
        stored: as read from a file.
        now: of the nodes that are in this process.
        other_faults: the run goes on with others than it had.

    Raises:
        Diverged: they are not the same.
    """
    names = [name for name in now if not (other_faults and name in OF_FAULTS)]
    mine = json.loads(json.dumps({name: now[name] for name in names}))  # as it looks when it has been a file
    found = min(differences({name: stored.get(name) for name in names}, mine), default=None)
    if found is not None:
        raise Diverged(f"not in the state of the checkpoint: {found}")


# ---- the folder


class _Arrived(Exception):
    """The run has come to the instant."""


def take(instant: fork.Instant, out: Path) -> None:
    """Do a run with the reference firmware again up to an instant and write what it has come to.

    Raises:
        CheckpointError: the folder is in the way, or the firmware is another one, whose state nobody can read.
        ForkError, Diverged: the run cannot be done again.
        OSError: the folder cannot be written.
    """
    info = instant.info
    if out.exists():
        raise CheckpointError(f"{out} exists already; choose another folder")
    if info["firmware"] != BUILT_IN:
        raise CheckpointError(
            f"{instant.name}: the firmware was {info['firmware']!r}, whose state nobody can read; "
            f"fork the run itself: --from {instant.name}@{instant.at}"
        )
    length = max(int(info["steps"]), instant.step + 1)
    prepared = rig.prepare(fork.fork(instant, Path("unwritten"), bus="inproc", steps=length))
    wires = rig.wires(prepared, Capture(), memory=True)
    assert isinstance(wires.plant, RewoundPlant) and isinstance(wires.device, InProcess)

    def stop() -> None:
        raise _Arrived

    wires.plant.arrived = stop
    with contextlib.suppress(_Arrived):
        wires.run(lambda step: None)
    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_candump(instant.frames.select(before(instant.frames, instant.step)), partial / LOG)
    now = state(wires.plant, wires.gateway, wires.device)
    (partial / STATE).write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    (partial / MEMORY).write_bytes(wires.device.memory)
    header = {
        "format": FORMAT,
        "at": instant.at,
        "programs": programs(),
        "files": {name: _sha256(partial / name) for name in (LOG, STATE, MEMORY)},
        "run": dict(info),
    }
    (partial / CHECKPOINT).write_text(json.dumps(header, indent=2) + "\n", encoding="utf-8")
    partial.rename(out)


def load(folder: Path, at: str | None = None) -> fork.Instant:
    """The instant of a checkpoint, or an earlier one of the same run.

    Raises:
        CheckpointError: a file is missing or was changed, or it was taken by other programs.
        ForkError: there is no such instant in it.
    """
    try:
        header = json.loads((folder / CHECKPOINT).read_text(encoding="utf-8"))
        kind, its_programs, files, info = (header[name] for name in ("format", "programs", "files", "run"))
        last = str(header["at"])
        if kind != FORMAT:
            raise CheckpointError(f"{folder}: expected a {FORMAT!r}, found {kind!r}")
        if its_programs != programs():
            raise CheckpointError(
                f"{folder} was taken by other programs ({its_programs[:12]}, these are {programs()[:12]}): "
                "fork the run that it was taken from, which is compared frame by frame"
            )
        for name in (LOG, STATE, MEMORY):
            if _sha256(folder / name) != files[name]:
                raise CheckpointError(
                    f"{folder / name} was changed: it does not have the hash that {CHECKPOINT} states"
                )
        frames = read_candump(folder / LOG)
        stored = json.loads((folder / STATE).read_text(encoding="utf-8"))
    except OSError as error:
        raise CheckpointError(f"cannot read {error.filename}: {error.strerror}") from None
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / CHECKPOINT} is damaged: {error}") from None
    end = fork.Instant.of(str(folder), frames, info, last, state=stored)
    if at is None:
        return end
    instant = fork.Instant.of(str(folder), frames, info, at)
    if instant.step > end.step:
        raise fork.ForkError(f"{folder}@{at}: the checkpoint ends at {last}")
    return end if instant.step == end.step else instant


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
