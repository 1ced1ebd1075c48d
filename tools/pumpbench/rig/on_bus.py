"""A run on a bus: firmware, gateway and recorder as processes of their own, the plant here.

On a hub the plant is the switch itself, which saves two wake-ups per turn. With faults a gateway stands between the
device's bus and the plant's.
"""

import contextlib
import functools
import json
import logging
import shlex
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final, TypedDict

from can_bus.faults import MemoryState, NodeControl, NodeFault
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.node_control import CommandControl, LineControl, attend
from can_bus.url import open_link
from plant_server.free_run import FreePlant, serve_free
from plant_server.serve import serve
from pumpbench.candump import write_candump
from pumpbench.faults import write_wire
from pumpbench.identity import SOMEBODY_ELSES
from pumpbench.rig.buses import Buses
from pumpbench.rig.plant import plant_of
from pumpbench.rig.power import Process
from pumpbench.rig.processes import DEVICE, Child, Crew, one_cpu
from pumpbench.rig.request import Prepared, Progress, Request, RigError

END_SECONDS: Final = 5.0
PARTIAL_SECONDS: Final = 60.0
"""What the recorder of a run that broke off may take to write what there is."""

WRITE_SECONDS: Final = 600.0


class _Options(TypedDict):
    """What both ways to serve a plant take."""

    connect_timeout: float
    step_timeout: float
    watch: Callable[[], None]
    progress: Callable[[int], None]


def run_on_bus(prepared: Prepared, progress: Progress) -> None:
    """Do the run; the recorder writes its folder.

    Raises:
        NodeDied, MemberSilent, PlantError, BusLost: it did not come to its end.
    """
    request = prepared.request
    hub: Hub | None = None

    def poll() -> None:
        if hub is not None:
            hub.poll(0)

    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory, contextlib.ExitStack() as stack:
        place = Path(directory)
        other_cpus = stack.enter_context(one_cpu())
        buses = Buses.of(request, place, faulty=bool(prepared.faults.wire))
        crew = stack.enter_context(Crew(place, buses.device, poll))
        if buses.private:
            # when a run breaks off, the reason is said once, by us; who then left frames unread does not matter
            logging.getLogger("can_bus.hub").addHandler(logging.NullHandler())
            hub = stack.enter_context(Hub(buses.plant))
            link: Link = stack.enter_context(hub.local_link())
        else:
            link = stack.enter_context(open_link(buses.plant))
        switch, ours = _switch(prepared, stack)
        if buses.device != buses.plant:
            _start_gateway(crew, prepared, place, buses, switch)
        recorder = _start_recorder(crew, prepared, place, buses, other_cpus)
        nvm = place / "nvm"

        def launch(memory: MemoryState) -> Child:
            return crew.start(DEVICE, firmware_command(request.firmware, buses.device, nvm if ours else None, memory))

        firmware = None if request.firmware == SOMEBODY_ELSES else Process(launch, nvm)
        board = _board(request, stack)
        if board is not None:
            board.cut()
            board.start("kept")
        switched = board or firmware
        if ours is not None and switched is not None:
            threading.Thread(target=attend, args=(ours, switched), daemon=True).start()

        def watch() -> None:
            crew.check()  # a dead gateway is why a firmware ends, not the other way round
            if firmware is not None:
                firmware.check()

        try:
            options = _Options(
                connect_timeout=request.connect_timeout,
                step_timeout=request.step_timeout,
                watch=watch,
                progress=lambda step: progress(step, request.steps),
            )
            if request.free_running:
                serve_free(FreePlant(prepared.run), link, speed=request.speed, **options)
            else:
                serve(plant_of(prepared), link, **options)
        except Exception:
            watch()  # a dead node is the better explanation
            raise
        _await_end(crew, recorder, hub)


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


def _start_gateway(crew: Crew, prepared: Prepared, place: Path, buses: Buses, switch: socket.socket | None) -> None:
    """Join the two buses; with faults of the node the gateway asks for them at `switch`."""
    wire = place / "faults.yaml"
    write_wire(prepared.faults, wire)
    command = [sys.executable, "-m", "can_bus.gateway", "--plant", buses.plant, "--device", buses.device]
    command += ["--faults", str(wire)]
    command += ["--host"] if buses.hosted else []
    command += ["--free-running"] if prepared.request.free_running else []
    command += ["--tap", buses.shown] if buses.shown not in (buses.device, buses.plant) else []
    if switch is None:
        crew.start("gateway", command, ready=True)
        return
    with switch:  # the gateway has its own copy
        command += ["--node-socket", str(switch.fileno())]
        crew.start("gateway", command, ready=True, keep=[switch.fileno()])


def _start_recorder(crew: Crew, prepared: Prepared, place: Path, buses: Buses, cpus: Collection[int]) -> Child:
    """Start the recorder, which listens on every bus before anybody speaks."""
    request = prepared.request
    info = place / "info.json"
    info.write_text(json.dumps(prepared.info), encoding="utf-8")
    command = [sys.executable, "-m", "pumpbench.recorder", "--bus", buses.shown, "--out", str(request.out)]
    command += ["--info", str(info), "--overwrite"]
    command += ["--free-running"] if request.free_running else []
    command += ["--plant-bus", buses.plant] if buses.shown != buses.plant else []
    origin = request.origin
    if origin is not None:
        log = place / "origin.log"
        write_candump(origin.frames, log)
        command += ["--origin", str(log), "--origin-step", str(origin.step)]
        command += ["--firmware-since", str(origin.since)] if origin.since is not None else []
    command += ["--serve", str(request.serve)] if request.serve is not None else []
    command += ["--web", str(request.web)] if request.web is not None else []
    return crew.start("recorder", command, ready=True, cpus=cpus, patience=PARTIAL_SECONDS)


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


def _await_end(crew: Crew, recorder: Child, hub: Hub | None) -> None:
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
        for child in crew.members:
            child.finish(END_SECONDS if child.name == "gateway" else 1.0)
    finally:
        stop.set()
        pump.join()
