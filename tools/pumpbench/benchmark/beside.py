"""What a recorder costs the loop beside which it listens, and what watching the run costs on top.

A lockstep run on a hub, plant and firmware on one CPU as `pumpbench run` has them: without a recorder, with one, and
with one that is watched (`--serve`). All three are measured in turn, run after run.
"""

import contextlib
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from can_bus.hub import Hub
from can_bus.lockstep import STEPS_PER_DAY
from plant_server.serve import serve
from plant_server.server import PlantServer
from pumpbench import rig
from pumpbench.benchmark.figure import Figure, figure

PATIENT = "adult#002"
LIMIT = 60.0


def figures(*, days: int, runs: int) -> list[Figure]:
    """Patient-days per second with a recorder, and with one that is watched; beside the same run without."""
    alone: list[float] = []
    beside: list[float] = []
    watched: list[float] = []
    for _ in range(runs):
        alone.append(_rate(days, []))
        beside.append(_rate(days, [[]]))
        watched.append(_rate(days, [["--serve", str(_free_port())]]))
    unit = "patient-days/s"
    return [figure("recorder/beside", unit, beside, alone), figure("recorder/watched", unit, watched, alone)]


def _rate(days: int, recorders: list[list[str]]) -> float:
    """Patient-days per second of the loop while recorders with these options listen."""
    stamps: list[tuple[int, float]] = []
    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory, contextlib.ExitStack() as stack:
        place = Path(directory)
        request = rig.Request(PATIENT, place / "run", strategy="s2", steps=days * STEPS_PER_DAY)
        prepared = rig.prepare(request)
        hub = stack.enter_context(Hub(f"unix:{place}/bus.sock"))
        link = stack.enter_context(hub.local_link())
        listening = [
            stack.enter_context(_recorder(hub, place / f"run{number}", options))
            for number, options in enumerate(recorders)
        ]
        stack.enter_context(rig.one_cpu())
        firmware = subprocess.Popen([sys.executable, "-m", "firmware_sim", "--bus", hub.urls[0]])
        stack.callback(firmware.wait)
        stack.callback(firmware.kill)
        serve(
            PlantServer(prepared.run),
            link,
            connect_timeout=LIMIT,
            step_timeout=LIMIT,
            progress=lambda step: stamps.append((step, time.perf_counter())),
        )
        for process in listening:
            while process.poll() is None:
                hub.poll(0.02)
            if process.returncode:
                raise RuntimeError(f"the recorder ended with status {process.returncode}")
    (first, started), (last, ended) = stamps[1], stamps[-1]
    return (last - first) / STEPS_PER_DAY / (ended - started)


@contextlib.contextmanager
def _recorder(hub: Hub, out: Path, options: list[str]) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "pumpbench.recorder", "--bus", hub.urls[0], "--out", str(out), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    ready = threading.Thread(target=process.stdout.readline)
    ready.start()
    try:
        while ready.is_alive():
            hub.poll(0.02)
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
