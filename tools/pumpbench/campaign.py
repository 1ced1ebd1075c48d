"""Campaigns: many runs of the closed loop, spread over processes or machines, their results in one table.

A campaign is a list of jobs. Each is the same run wherever it is made: one process or many, this machine or a
dask cluster, the compiled loop or the nodes on a bus. Results are stored as they come, a file per batch, and a campaign
that was interrupted goes on with the jobs that have no result yet. Nothing is stored twice: a result is known by what
was asked for, by the version of the programs included.
"""

import concurrent.futures
import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import dbc
from can_bus.lockstep import STEPS_PER_DAY
from firmware_sim.selftest import PROGRAM_CRC
from plant_server.physiology import SOURCES
from pumpbench import __version__
from pumpbench.calibration import Tuning, tuning_for
from pumpbench.controller_model import ControllerModel
from pumpbench.parallel import cpus, pool

BATCH = 16
"""Jobs of one task: long enough that handing it over costs nothing, short enough that a stop loses little."""

CONNECT_SECONDS = 10

METRICS = (
    "tir_70_180", "tbr_54", "tbr_70", "tar_180", "tar_250", "lbgi", "hbgi", "mean_glucose", "cv", "gmi", "gri",
    "insulin_u_per_day", "pramlintide_ug_per_day", "limiter_steps",
)  # fmt: skip
"""Result columns, named as in metrics.json."""

SWEPT = ("phi_ug", "lambda_ug", "ratio_ug_per_u", "z1", "z2", "z3")
"""Columns for parameters of the strategies that a campaign varies; NaN where it does not."""

SERIES = ("cgm", "plasma_insulin", "plasma_pramlintide")
"""What a job with `series` keeps of every sampling instant: mg/dL, pmol/L, pmol/L."""


CGM_MAX_RAW = 8000
"""Largest CGM_Reading.GlucoseConc that is a value, 0.1 mg/dL."""


class CampaignError(ValueError):
    """A campaign cannot be started or read; the text names the place and what was expected."""


class ClusterError(ConnectionError):
    """The cluster cannot be reached, or its workers run something else."""


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        patient: name in the cohort, or file.csv#name.
        mode: of `calibration.MODES`.
        seed: of everything random.
        days: simulated.
        part: what it belongs to, e.g. tuning or validation.
        label: names the parameter set for people.
        scenario, sensor, pramlintide, variability, physiology: as for `pumpbench run`.
        tuning: of the controller.
        model: the controller's model of the patient; None: the one of the package.
        swept: values of `SWEPT` for the table.
        series: keep the curves too.
    """

    patient: str
    mode: str
    seed: int
    days: int
    part: str = ""
    label: str = ""
    scenario: str = "validation-14d"
    sensor: str = "coloured"
    pramlintide: str = "P2"
    variability: tuple[str, ...] = tuple(SOURCES)
    physiology: str | None = None
    tuning: Tuning = field(default_factory=Tuning)
    model: ControllerModel | None = None
    swept: tuple[tuple[str, float], ...] = ()
    series: bool = False

    @property
    def shared(self) -> dict[str, Any]:
        """What the compiled loop (`Case`) and the rig (`Request`) call by the same names."""
        names = (
            "patient", "seed", "scenario", "sensor", "pramlintide", "variability", "physiology", "tuning", "model",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}

    @property
    def key(self) -> str:
        """Of the result: everything that has a part in it, and the programs."""
        parts = {**dataclasses.asdict(self), "programs": programs()}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]


def programs() -> str:
    """Version of the package, of the wire and of the control path."""
    return f"{__version__}/{dbc.crc32():08x}/{PROGRAM_CRC:08x}"


def grid(
    patients: Iterable[str],
    modes: Iterable[str],
    seeds: Iterable[int],
    days: int,
    *,
    tunings: Iterable[tuple[str, dict[str, Any]]] = (("", {}),),
    **common: Any,
) -> list[Job]:
    """Every combination, patients and seeds outermost, so that a batch shares their meals and noise.

    Args:
        patients, modes, seeds, days: of the jobs.
        tunings: (label, changes to the mode's tuning by field name).
        **common: further fields of every job.
    """
    return [
        Job(
            patient, mode, seed, days,
            label=label, tuning=dataclasses.replace(tuning_for(mode), **changes), **common,
        )
        for patient, seed, (label, changes), mode in itertools.product(patients, seeds, tunings, modes)
    ]  # fmt: skip


def seed_list(text: str) -> list[int]:
    """Seeds as people write them: 1-10,42.

    Raises:
        CampaignError: that is no list of seeds.
    """
    seeds: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise CampaignError(f"seeds {text!r}: expected numbers and ranges, e.g. 1-10,42")
        found = range(int(first), int(last if dash else first) + 1)
        if not found:
            raise CampaignError(
                f"seeds {text!r}: a range goes from the smaller number to the greater, {part.strip()} not"
            )
        seeds += found
    return list(dict.fromkeys(seeds))


def parameter_grid(settings: Sequence[str]) -> list[tuple[str, dict[str, Any]]]:
    """Every combination of `NAME=V1,V2` settings of the tuning, each with a label.

    Raises:
        CampaignError: there is no such parameter, or a value is no number.
    """
    kinds = {name: type(value) for name, value in dataclasses.asdict(Tuning()).items()}
    axes: list[list[tuple[str, Any]]] = []
    for setting in settings:
        name, equals, values = setting.partition("=")
        if not equals or name not in kinds:
            raise CampaignError(f"--set {setting!r}: expected NAME=V1,V2 with NAME one of {', '.join(kinds)}")
        try:
            axes.append([(name, kinds[name](value)) for value in values.split(",")])
        except ValueError:
            raise CampaignError(f"--set {setting!r}: {values!r} is no list of {kinds[name].__name__}s") from None
    return [(" ".join(f"{name}={value:g}" for name, value in each), dict(each)) for each in itertools.product(*axes)]


# ---- one job


def run_job(job: Job, via: str = "compiled") -> dict[str, Any]:
    """Run it and give its row of the table.

    Args:
        job: what to run.
        via: `compiled`, or a bus of `pumpbench run` to run the nodes themselves on.
    """
    outcome, curves = _compiled(job) if via == "compiled" else _on_bus(job, via)
    swept = dict(job.swept)
    row: dict[str, Any] = {
        "key": job.key,
        "part": job.part,
        "patient": job.patient,
        "mode": job.mode,
        "seed": job.seed,
        "days": job.days,
        "label": job.label,
        "scenario": job.scenario,
        "sensor": job.sensor,
        "pramlintide": job.pramlintide,
        **{name: swept.get(name, math.nan) for name in SWEPT},
        **{name: float(outcome[name]) for name in METRICS},
    }
    return row | {name: curves[name] if job.series else None for name in SERIES}


def _run_batch(jobs: Sequence[Job], via: str, asked_by: str) -> list[dict[str, Any]]:
    if programs() != asked_by:  # a worker of a cluster with another installation
        raise ClusterError(f"a worker runs pumpbench {programs()}, but this campaign is of {asked_by}")
    return [run_job(job, via) for job in jobs]


def _compiled(job: Job) -> tuple[dict[str, Any], dict[str, Any]]:
    """The run as the compiled loop does it."""
    from pumpbench.closed_loop import Case, simulate  # noqa: PLC0415

    result = simulate(Case(mode=job.mode, days=job.days, **job.shared))
    if not job.series:
        return result.metrics(), {}
    cgm = np.where(result.cgm <= CGM_MAX_RAW, result.cgm * 0.1, np.nan)
    curves = (cgm, result.plasma_insulin, result.plasma_pramlintide)
    return result.metrics(), {name: curve.astype(np.float32) for name, curve in zip(SERIES, curves, strict=True)}


def _on_bus(job: Job, via: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The same run through plant, firmware and recorder, as `pumpbench run` does it."""
    from pumpbench import rig  # noqa: PLC0415
    from pumpbench.runfolder import RunFolder  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory:
        out, steps = Path(directory) / "run", job.days * STEPS_PER_DAY
        request = rig.Request(out=out, strategy=job.mode, steps=steps, bus=via, **job.shared)
        folder = rig.execute(rig.prepare(request))
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        trace = RunFolder.load(folder).trace
        columns = zip(SERIES, ("GlucoseConc", "TruthInsulin", "TruthPramlintide"), strict=True)
        curves = {name: np.asarray(trace.get(column)[:-1], np.float32) for name, column in columns}
    return metrics | {"limiter_steps": metrics["safety"]["limiter_steps"]}, curves


# ---- results on disk


SCHEMA = pa.schema(
    [
        *[(name, pa.string()) for name in ("key", "part", "patient", "mode")],
        ("seed", pa.int64()),
        ("days", pa.int64()),
        *[(name, pa.string()) for name in ("label", "scenario", "sensor", "pramlintide")],
        *[(name, pa.float64()) for name in (*SWEPT, *METRICS)],
        *[(name, pa.list_(pa.float32())) for name in SERIES],
    ]
)


class Results:
    """The results of a campaign in a folder: `part-*.parquet` as they come, each written whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._keys: dict[Path, set[str]] = {}  # of the files read so far, which never change
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Store the rows of a batch."""
        name = hashlib.sha256("".join(row["key"] for row in rows).encode()).hexdigest()[:16]
        path = self.folder / f"part-{name}.parquet"
        partial = path.with_suffix(".partial")
        try:
            pq.write_table(pa.Table.from_pylist(list(rows), schema=SCHEMA), partial)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)

    def keys(self) -> set[str]:
        """Of every result there is.

        Raises:
            CampaignError: a file cannot be read.
        """
        found = set(self.folder.glob("part-*.parquet"))
        self._keys = {path: keys for path, keys in self._keys.items() if path in found}
        for path in sorted(found - self._keys.keys()):
            self._keys[path] = set(self._read(path, ["key"]).column("key").to_pylist())
        return set().union(*self._keys.values())

    def table(self, jobs: Sequence[Job], columns: Sequence[str] | None = None) -> pa.Table:
        """The rows of these jobs in their order, whatever the order in which they came.

        Raises:
            CampaignError: a file cannot be read, or a result is missing.
        """
        names = list(columns) if columns else [name for name in SCHEMA.names if name not in SERIES]
        read, wanted = list(dict.fromkeys(["key", *names])), {job.key for job in jobs}
        self.keys()
        parts = [self._read(path, read) for path, keys in self._keys.items() if keys & wanted]
        found = pa.concat_tables([SCHEMA.empty_table().select(read), *parts])
        place = {key: number for number, key in enumerate(found.column("key").to_pylist())}
        missing = sum(job.key not in place for job in jobs)
        if missing:
            raise CampaignError(f"{self.folder}: {missing} of {len(jobs)} results are missing")
        return found.take([place[job.key] for job in jobs]).select(names)

    def write(self, jobs: Sequence[Job], path: Path) -> Path:
        """The rows of these jobs in one parquet file."""
        partial = path.with_name(path.name + ".partial")
        pq.write_table(self.table(jobs), partial)
        partial.replace(path)
        return path

    def _read(self, path: Path, columns: list[str]) -> pa.Table:
        try:
            return pq.read_table(path, columns=columns)
        except (OSError, pa.ArrowException, KeyError) as error:
            reason = str(error).splitlines()[0]
            raise CampaignError(
                f"{path}: no results of this version can be read from it ({reason}); "
                "remove it, and its runs are made again"
            ) from None


# ---- running


Progress = Callable[[int, int], None]
"""Called with the number of jobs that are done and of all."""


def execute(
    jobs: Sequence[Job],
    folder: Path | Results,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    via: str = "compiled",
    progress: Progress = lambda done, of: None,
) -> Results:
    """Make every run that has no result in `folder` yet.

    Args:
        jobs: what to run; the same one twice is run once.
        folder: of the results, or the results themselves where several campaigns share them.
        workers: processes on this machine; default: one per CPU. 1 runs in this process.
        cluster: address of a dask scheduler, e.g. tcp://127.0.0.1:8786, instead of this machine.
        via: as for `run_job`.
        progress: see `Progress`.

    Returns:
        The results, of these jobs at least.

    Raises:
        CampaignError, ClusterError: see there. What was done until then is kept.
    """
    results = folder if isinstance(folder, Results) else Results(folder)
    known = results.keys()
    wanted = {job.key: job for job in jobs}
    open_jobs = [job for key, job in wanted.items() if key not in known]
    done = len(wanted) - len(open_jobs)
    progress(done, len(wanted))
    batches = [open_jobs[i : i + BATCH] for i in range(0, len(open_jobs), BATCH)]
    if not batches:
        return results
    for rows in _finished(batches, via, workers, cluster):
        results.add(rows)
        done += len(rows)
        progress(done, len(wanted))
    return results


def _finished(
    batches: Sequence[Sequence[Job]], via: str, workers: int | None, cluster: str | None
) -> Iterator[list[dict[str, Any]]]:
    """The rows of every batch, as they come."""
    count = min(workers or cpus(), len(batches))
    if cluster is None and count == 1:
        for batch in batches:
            yield _run_batch(batch, via, programs())
        return
    with _executor(count, cluster) as executor:
        futures = [executor.submit(_run_batch, batch, via, programs()) for batch in batches]
        try:
            for future in concurrent.futures.as_completed(futures):
                yield future.result()
        finally:
            for future in futures:  # an interrupted campaign leaves nothing running
                future.cancel()


@contextlib.contextmanager
def _executor(count: int, cluster: str | None) -> Iterator[concurrent.futures.Executor]:
    if cluster is None:
        with pool(count) as processes:
            yield processes
        return
    try:
        from distributed import Client  # noqa: PLC0415
    except ImportError:
        raise CampaignError("--cluster needs dask: pip install 'pumpbench[cluster]'") from None
    try:
        client = Client(cluster, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ClusterError(f"{cluster}: no dask scheduler answers there ({error})") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise ClusterError(f"{cluster}: the scheduler has no workers")
        yield client.get_executor(pure=False)
