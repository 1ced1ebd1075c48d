"""What single parts cost: the codec, the protection of frames, the recorder, starting, memory, many patients.

As everywhere in the benchmark a figure stands beside a ceiling or a peer of the same run: cantools for the codec, the
bare checksum for protected frames, the same run without a recorder, a bare interpreter, one patient.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from e2e.p02 import e2e_p02_protect

import dbc
from can_bus import codec
from can_bus.lockstep import STEPS_PER_DAY
from firmware_sim.firmware import Firmware
from plant_server.server import PlantServer
from pumpbench import rig
from pumpbench.benchmark.figure import Figure, figure
from pumpbench.capture import Capture
from pumpbench.closed_loop import Case, simulate
from pumpbench.recorder.writing import write
from pumpbench.runfolder import RunFolder

PATIENT = "adult#002"
MESSAGE = "CTRL_Status"
"""Six fields of all widths in a protected frame, sent in every step."""

MEMORY_CEILING_MIB = 1024.0
"""What a study may take in each of its processes."""


def figures(*, quick: bool) -> list[Figure]:
    """All of this module."""
    runs, count = (1, 2000) if quick else (5, 50000)
    days = 1 if quick else 5
    return [
        *codec_speed(count=count, runs=runs),
        *recorder(days=days, runs=min(runs, 3)),
        *start_up(runs=runs),
        memory(days=1 if quick else 14, patients=2 if quick else 10),
        patients(days=1 if quick else 14, runs=runs),
    ]


def _rate(work: Callable[[], object], count: int) -> float:
    """Calls per second."""
    start = time.perf_counter()
    for _ in range(count):
        work()
    return count / (time.perf_counter() - start)


def codec_speed(*, count: int, runs: int) -> list[Figure]:
    """Frames per second packed, unpacked and protected; beside cantools without scaling, and the bare checksum."""
    message, peer = codec.message(MESSAGE), dbc.load().get_message_by_name(MESSAGE)
    values = dict.fromkeys(message.fields, 1)
    theirs = values | {"CHECKSUM": 0, "COUNTER": 0}
    data = codec.Transmitter().frame(MESSAGE, **values).data
    transmitter, bare, ids = codec.Transmitter(), bytearray(data), message.data_ids or b""
    options = {"scaling": False, "decode_choices": False}
    pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "codec/pack": (lambda: message.pack(values), lambda: peer.encode(theirs, scaling=False, strict=False)),
        "codec/unpack": (lambda: message.unpack(data), lambda: peer.decode(data, **options)),
        "codec/protected": (lambda: transmitter.frame(MESSAGE, **values), lambda: e2e_p02_protect(bare, ids)),
    }
    found = []
    for name, (ours, other) in pairs.items():
        _rate(ours, 100), _rate(other, 100)
        samples = [(_rate(ours, count), _rate(other, count)) for _ in range(runs)]
        found.append(figure(name, "frames/s", [one for one, _ in samples], [one for _, one in samples]))
    return found


class _Deaf(Capture):
    """Hears nothing."""

    def extend(self, *_arguments: object) -> None:
        """Forget it."""


def recorder(*, days: int, runs: int) -> list[Figure]:
    """Patient-days per second with the recorder listening, beside without; and of writing the run folder."""
    listening: list[float] = []
    deaf: list[float] = []
    writing: list[float] = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory:
            request = rig.Request(
                patient=PATIENT, out=Path(directory) / "run", strategy="s2", steps=days * STEPS_PER_DAY, bus="inproc"
            )
            prepared = rig.prepare(request)
            for capture, rates in ((_Deaf(), []), (_Deaf(), deaf), (Capture(), listening)):  # the first one warms up
                start = time.perf_counter()
                rig.Wires(PlantServer(prepared.run), Firmware(), None, capture).run(lambda _step: None)
                rates.append(days / (time.perf_counter() - start))
            start = time.perf_counter()
            write(RunFolder.create(request.out), capture, prepared.info, complete=True)
            writing.append(days / (time.perf_counter() - start))
    unit = "patient-days/s"
    return [figure("recorder/listening", unit, listening, deaf), figure("recorder/writing", unit, writing, listening)]


def start_up(*, runs: int) -> list[Figure]:
    """Starts per second of the command line, the firmware's process and a campaign's worker; beside bare Python."""
    commands = {
        "start/pumpbench --version": ["-m", "pumpbench", "--version"],
        "start/firmware --help": ["-m", "firmware_sim", "--help"],
        "start/first compiled day": [
            "-c", "from pumpbench.closed_loop import Case, simulate; simulate(Case('adult#002', days=1))",
        ],
    }  # fmt: skip
    simulate(Case(PATIENT, days=1))  # its code is on disk from here on
    bare = [_started(["-c", "pass"]) for _ in range(runs)]
    return [
        figure(name, "starts/s", [_started(arguments) for _ in range(runs)], bare)
        for name, arguments in commands.items()
    ]


def _started(arguments: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
    return 1 / (time.perf_counter() - start)


def memory(*, days: int, patients: int) -> Figure:
    """Largest resident memory (MiB) of a process that has run a cohort in seven modes."""
    code = (
        "from pumpbench.campaign import grid, run_job; import resource, sys; "
        f"jobs = grid([f'adult#{{n:03d}}' for n in range(1, {patients + 1})], "
        f"['nma', 'sma', 'ma', 's1', 's2', 's3', 's4'], [1], {days}); "
        "[run_job(job) for job in jobs]; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True)
    unit = 1024.0 if sys.platform != "darwin" else 1024.0 * 1024.0
    return figure("memory/campaign", "MiB", [int(done.stdout) / unit], [MEMORY_CEILING_MIB])


def patients(*, days: int, runs: int) -> Figure:
    """Patient-days per second over the cohort, beside one patient alone: 1 is linear."""

    def rate(cases: list[tuple[str, int]]) -> float:
        start = time.perf_counter()
        for name, seed in cases:
            simulate(Case(name, "s2", days=days, seed=seed))
        return len(cases) * days / (time.perf_counter() - start)

    cohort = [f"adult#{number:03d}" for number in range(1, 11)]
    rate([(name, 0) for name in cohort])
    many = [rate([(name, run) for name in cohort]) for run in range(1, runs + 1)]
    one = [rate([(PATIENT, 100 * run + number) for number in range(10)]) for run in range(1, runs + 1)]
    return figure("scaling/ten patients", "patient-days/s", many, one)
