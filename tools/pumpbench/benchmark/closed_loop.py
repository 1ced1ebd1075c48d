"""How fast the closed loop runs, beside what its transport would allow and what its plant costs.

`closed-loop/BUS` stands beside what the transport gives when every frame is a round trip of its own: raw round trips
per second divided by the frames of a step. A ratio above 1 is the gain of handing over a step's frames as one batch.
`closed-loop/BUS/exchange` stands beside the bare exchange of those batches, the same number of frames in both
directions between the same number of processes, prebuilt bytes on raw sockets, nothing packed, checked, integrated or
decided: what is missing to 1 is what plant, firmware and codec cost. The ceiling of the loop in one process is the
plant alone, and so is that of the compiled loop of campaigns (`closed-loop/compiled`, whole cases with everything
random drawn anew per seed): it may lie above 1, for it calls its plant from machine code. `closed-loop/compiled/2` is
the same from two processes at once, beside twice one process: what is missing to 1 is what they take from each other.
Beside simglucose (`plant/vs-simglucose`) the "ceiling" is the peer: see `simglucose_peer`.
"""

import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEPS_PER_DAY
from plant_server import physiology
from plant_server.mechanism import SUBSTEPS
from pumpbench import rig
from pumpbench.benchmark import beside, parts, simglucose_peer
from pumpbench.benchmark.figure import Figure, figure
from pumpbench.benchmark.round_trips import CEILING_OF, measure, round_trips, vcan_available
from pumpbench.calibration import MODES
from pumpbench.closed_loop import Case, simulate
from pumpbench.signals import decode

PATIENT = "adult#002"
STRATEGY = "s2"
UNIT = "patient-days/s"
WITH_VCAN = Path(__file__).parents[3] / "tools" / "with_vcan"


def plant_alone(*, days: int = 100, runs: int = 5) -> list[Figure]:
    """Patient-days per second of the integration alone, pramlintide and variability on.

    In calls of one sampling interval, as the bench makes them; the ceiling is one call per day.
    """
    patient = physiology.load_patient(PATIENT)
    p = physiology.Variability(1, PATIENT).apply(patient.params)

    def rate(chunk: int) -> float:
        x = patient.x0.copy()
        insulin = np.full(chunk, patient.basal_u_per_h / 120)
        pramlintide = np.full(chunk, 10 * patient.basal_u_per_h / 120)
        carbs = np.zeros(chunk)
        calls = days * STEPS_PER_DAY * SUBSTEPS // chunk
        minutes = chunk * physiology.STEP_MIN
        start = time.perf_counter()
        for call in range(calls):
            if call * minutes % 360 == 0:
                physiology.begin_meal(x, p, 50000.0)
            physiology.advance(x, p, call * minutes, insulin, pramlintide, carbs)
        return days / (time.perf_counter() - start)

    rate(SUBSTEPS)
    values = [rate(SUBSTEPS) for _ in range(runs)]
    ceilings = [rate(STEPS_PER_DAY * SUBSTEPS) for _ in range(runs)]
    return [figure("plant/alone", UNIT, values, ceilings)]


def closed_loop(kind: str, *, days: int, runs: int = 3) -> list[Figure]:
    """Patient-days per second of whole runs on one kind of bus: `inproc`, `hub` or `vcan`, recorder listening.

    Start-up and the writing of the run folder are left out. `compiled` is the loop without a bus.
    """
    if kind == "compiled":
        return compiled_loop(days=days, runs=runs)
    bus = {"vcan": "socketcan:vcan0"}.get(kind, kind)
    values, ceilings, exchanges = [], [], []
    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory:
        for number in range(runs):
            out = Path(directory) / f"{kind}-{number}"
            stamps: list[tuple[int, float]] = []
            request = rig.Request(
                patient=PATIENT,
                out=out,
                strategy=STRATEGY,
                steps=days * STEPS_PER_DAY,
                bus=bus,
            )

            def stamp(step: int, _of: int, stamps: list[tuple[int, float]] = stamps) -> None:
                stamps.append((step, time.perf_counter()))

            rig.execute(rig.prepare(request), stamp)
            (first, started), (last, ended) = stamps[1], stamps[-1]
            values.append((last - first) / STEPS_PER_DAY / (ended - started))
            if kind != "inproc":
                to_device, back = _frames_per_step(out)
                single = measure(CEILING_OF[kind], 2000)
                ceilings.append(single.rate / (to_device + back) / STEPS_PER_DAY)
                whole = measure(CEILING_OF[kind], 2000, to_device, back, listener=True)
                exchanges.append(whole.rate / STEPS_PER_DAY)
    if kind == "inproc":
        return [figure("closed-loop/inproc", UNIT, values, [plant_alone(days=20, runs=3)[0]["value"]])]
    name = f"closed-loop/{kind}"
    return [figure(name, UNIT, values, ceilings), figure(f"{name}/exchange", UNIT, values, exchanges)]


def compiled_loop(*, days: int = 14, runs: int = 5) -> list[Figure]:
    """Patient-days per second of the compiled loop, on one core and on two.

    A run is one patient and one seed in all seven modes, from the case to its metrics; only the machine code is there
    already.
    """
    _seven_modes((0, 1))
    values = [_rate(seed, days) for seed in range(1, runs + 1)]
    ceilings = [plant_alone(days=20, runs=3)[0]["value"]]
    context = multiprocessing.get_context("spawn")
    both = []
    with context.Pool(2, initializer=_seven_modes, initargs=((0, 1),)) as pool:
        pool.map(_seven_modes, [(0, 1)] * 8, chunksize=1)  # both processes are up
        for seed in range(runs + 1, 3 * runs + 1, 2):
            start = time.perf_counter()
            pool.map(_seven_modes, [(seed, days), (seed + 1, days)], chunksize=1)
            both.append(2 * len(MODES) * days / (time.perf_counter() - start))
    return [
        figure("closed-loop/compiled", UNIT, values, ceilings),
        figure("closed-loop/compiled/2", UNIT, both, [2 * value for value in values]),
    ]


def _seven_modes(run: tuple[int, int]) -> None:
    """One patient and one seed in every mode; `run` is the seed and the days."""
    seed, days = run
    for mode in MODES:
        simulate(Case(PATIENT, mode=mode, seed=seed, days=days)).metrics()


def _rate(seed: int, days: int) -> float:
    start = time.perf_counter()
    _seven_modes((seed, days))
    return len(MODES) * days / (time.perf_counter() - start)


def _frames_per_step(folder: Path) -> tuple[int, int]:
    """How many frames go to the device and come back in a usual step of this run."""
    from pumpbench.runfolder import RunFolder  # noqa: PLC0415

    frames = RunFolder.load(folder).frames
    senders = {codec_.can_id: codec_.sender for codec_ in codec.messages().values()}
    from_device = np.isin(frames.can_id, [can_id for can_id, sender in senders.items() if sender == "CTRL"])
    steps = len(decode(frames, "SYNC_Done").rows)
    return round(float(np.sum(~from_device)) / steps), round(float(np.sum(from_device)) / steps)


def all_figures(*, quick: bool, only_vcan: bool = False, peers: bool = True) -> list[Figure]:
    """Every figure this machine can give; on a kernel without CAN those of vcan come from `tools/with_vcan`.

    Args:
        quick: one short run of each.
        only_vcan: nothing but the figures of this kernel's vcan0.
        peers: other simulators too, which pip installs at the first time.
    """
    runs, days = (1, 1) if quick else (5, 5)
    steps = 500 if quick else 5000
    if only_vcan:
        return [
            *round_trips("vcan", steps=steps // 2, runs=runs),
            *closed_loop("vcan", days=1, runs=min(runs, 3)),
        ]
    figures = plant_alone(days=10 if quick else 100, runs=runs)
    figures += closed_loop("compiled", days=2 if quick else 14, runs=runs)
    figures += parts.figures(quick=quick)
    figures += beside.figures(days=days, runs=runs)
    if peers:
        figures += simglucose_peer.compare(runs=1 if quick else 3, days=10 if quick else 100)
    figures += round_trips("hub", steps=steps, runs=runs)
    figures += [*closed_loop("inproc", days=days, runs=runs), *closed_loop("hub", days=days, runs=runs)]
    if vcan_available():
        return figures + all_figures(quick=quick, only_vcan=True)
    return figures + _in_guest(quick=quick)


def _in_guest(*, quick: bool) -> list[Figure]:
    if not WITH_VCAN.exists():
        return []
    command = [str(WITH_VCAN), "--", sys.executable, "-m", "pumpbench", "benchmark", "--only-vcan", "--json", "-"]
    done = subprocess.run([*command, "--quick"] if quick else command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        return []
    figures: list[Figure] = json.loads(done.stdout)
    return figures


def as_json(figures: list[Figure]) -> str:
    """The figures as a JSON list of objects with name, value, unit, ceiling, ratio, runs."""
    return json.dumps([dict(figure) for figure in figures], indent=1)
