"""Campaigns: the same table however they are run, nothing run twice, and what is wrong is said in one line."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import Pumpbench
from pumpbench import campaign
from pumpbench.calibration import Tuning
from pumpbench.campaign import CampaignError, ClusterError, Job, Results, execute, grid, parameter_grid, seed_list

PATIENTS = ("adult#001", "adult#004")


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "BATCH", 3)


def jobs(**changes: object) -> list[Job]:
    return grid(PATIENTS, ("nma", "s2", "s3"), (1, 2), 1, **changes)  # type: ignore[arg-type]


def table(results: Results, of: list[Job]) -> str:
    """Every bit of the rows: NaN is itself in a text."""
    return repr(results.table(of).to_pylist())


# ---- what is asked for


def test_seeds_as_people_write_them() -> None:
    assert seed_list("1-3,7, 9") == [1, 2, 3, 7, 9]
    for wrong in ("", "a", "1-", "-3", "3-1", "1,3-2", "1.5"):
        with pytest.raises(CampaignError, match="seeds"):
            seed_list(wrong)


def test_parameters_as_people_write_them() -> None:
    assert parameter_grid([]) == [("", {})]
    assert parameter_grid(["gain=0.5,0.7", "peak_lockout=6"]) == [
        ("gain=0.5 peak_lockout=6", {"gain": 0.5, "peak_lockout": 6}),
        ("gain=0.7 peak_lockout=6", {"gain": 0.7, "peak_lockout": 6}),
    ]
    for wrong in ("gain", "gane=1", "gain=x", "peak_lockout=0.5"):
        with pytest.raises(CampaignError, match=f"--set '{wrong}'"):
            parameter_grid([wrong])


def test_every_combination_once_and_every_field_in_the_key() -> None:
    found = jobs(tunings=[("a", {"gain": 0.5}), ("b", {"gain": 0.6})])
    assert len({job.key for job in found}) == len(found) == 2 * 3 * 2 * 2
    one = found[0]
    others = {
        "patient": "adult#002", "mode": "ma", "seed": 9, "days": 2, "part": "x", "label": "x", "scenario": "tuning",
        "sensor": "ideal", "pramlintide": "P4", "variability": (), "physiology": "S2013", "tuning": Tuning(theta=11.0),
        "swept": (("z1", 1.0),), "series": True,
    }  # fmt: skip
    assert set(others) | {"model"} == {field.name for field in dataclasses.fields(Job)}
    for name, value in others.items():
        assert dataclasses.replace(one, **{name: value}).key != one.key, name  # type: ignore[arg-type]


# ---- the same results


def test_one_process_two_processes_and_in_any_order(tmp_path: Path) -> None:
    wanted = jobs()
    one = table(execute(wanted, tmp_path / "one", workers=1), wanted)
    two = table(execute(list(reversed(wanted)), tmp_path / "two", workers=2), wanted)
    assert one == two
    rows = Results(tmp_path / "two").table(wanted).to_pylist()
    assert [(row["patient"], row["mode"], row["seed"]) for row in rows] == [(j.patient, j.mode, j.seed) for j in wanted]


def test_the_nodes_on_a_bus_give_the_same_row(tmp_path: Path) -> None:
    job = dataclasses.replace(jobs()[2], tuning=Tuning(gain=0.6), series=True)
    columns = [name for name in campaign.SCHEMA.names if name not in ("plasma_insulin", "plasma_pramlintide")]
    compiled = execute([job], tmp_path / "compiled", workers=1).table([job], columns)
    on_bus = execute([job], tmp_path / "bus", workers=1, via="inproc").table([job], columns)
    for name in columns:
        assert repr(on_bus.column(name).to_pylist()) == repr(compiled.column(name).to_pylist()), name


def test_curves_are_kept_where_asked(tmp_path: Path) -> None:
    job = dataclasses.replace(jobs()[1], series=True)
    (row,) = execute([job], tmp_path, workers=1).table([job], campaign.SERIES).to_pylist()
    assert [len(row[name]) for name in campaign.SERIES] == [288] * 3
    assert 40 < min(row["cgm"]) < max(row["cgm"]) < 400
    assert max(row["plasma_pramlintide"]) > 10


# ---- going on


def test_what_is_done_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = jobs()
    seen: list[tuple[int, int]] = []
    execute(wanted[:5], tmp_path, workers=1)
    ran: list[str] = []
    run = campaign.run_job
    monkeypatch.setattr(campaign, "run_job", lambda job, via: (ran.append(job.key), run(job, via))[1])
    results = execute(wanted, tmp_path, workers=1, progress=lambda done, of: seen.append((done, of)))
    assert ran == [job.key for job in wanted[5:]]
    assert seen[0] == (5, 12) and seen[-1] == (12, 12)
    execute(wanted, tmp_path, workers=1)
    assert len(ran) == 7
    assert results.table(wanted).num_rows == 12


def test_an_interrupted_campaign_keeps_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = jobs()
    run = campaign.run_job

    def fails(job: Job, via: str) -> dict[str, object]:
        if job.key == wanted[7].key:
            raise KeyboardInterrupt
        return run(job, via)

    monkeypatch.setattr(campaign, "run_job", fails)
    with pytest.raises(KeyboardInterrupt):
        execute(wanted, tmp_path, workers=1)
    assert Results(tmp_path).keys() == {job.key for job in wanted[:6]}  # whole batches
    assert not list(tmp_path.glob("*.partial"))


def test_a_result_that_is_missing_is_an_error(tmp_path: Path) -> None:
    wanted = jobs()
    results = execute(wanted[:2], tmp_path, workers=1)
    with pytest.raises(CampaignError, match="10 of 12 results are missing"):
        results.table(wanted)


@pytest.mark.parametrize("content", [b"", b"PAR1 and then nothing", b"\x00" * 1000])
def test_a_corrupt_file_is_named_and_may_be_removed(tmp_path: Path, content: bytes) -> None:
    wanted = jobs()[:4]
    execute(wanted, tmp_path, workers=1)
    path = sorted(tmp_path.glob("part-*"))[0]
    path.write_bytes(content)
    with pytest.raises(CampaignError, match=f"{path.name}: no results of this version.*remove it"):
        execute(wanted, tmp_path, workers=1)
    path.unlink()
    assert execute(wanted, tmp_path, workers=1).table(wanted).num_rows == 4


def test_a_file_of_something_else_is_named(tmp_path: Path) -> None:
    pq.write_table(pa.table({"a": [1]}), tmp_path / "part-x.parquet")
    with pytest.raises(CampaignError, match=r"part-x\.parquet: no results"):
        execute(jobs()[:1], tmp_path, workers=1)


# ---- on a cluster


@pytest.fixture
def cluster(tmp_path: Path):  # type: ignore[no-untyped-def]
    """A real scheduler and two workers on the loopback: its address and the workers' processes."""
    python = [sys.executable, "-m", "distributed.cli"]
    environment = os.environ | {"DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "20s"}
    logs = (tmp_path / "dask.log").open("wb")
    file = tmp_path / "scheduler.json"
    options = {"stdout": logs, "stderr": logs, "env": environment, "cwd": tmp_path}
    scheduler = subprocess.Popen(
        [*python[:2], "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
         "--scheduler-file", str(file)], **options,
    )  # fmt: skip
    workers = [
        subprocess.Popen(
            [*python[:2], "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny",
             "--host", "127.0.0.1", "--no-dashboard", "--name", name], **options,
        )
        for name in ("one", "two")
    ]  # fmt: skip
    try:
        end = time.monotonic() + 60
        while not file.exists() or not file.stat().st_size:
            assert time.monotonic() < end, "no scheduler"
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        from distributed import Client

        with Client(address, timeout=30, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()
        logs.close()


@pytest.mark.filterwarnings("ignore")  # distributed's own, of threads that end late
def test_a_cluster_gives_the_same_table_although_a_worker_dies(tmp_path: Path, cluster) -> None:  # type: ignore[no-untyped-def]
    address, workers = cluster
    wanted = grid(PATIENTS, ("nma", "s2", "s3"), range(1, 9), 3)
    killed: list[int] = []

    def progress(done: int, _of: int) -> None:
        if done and not killed:
            workers[0].send_signal(signal.SIGKILL)  # in the middle of a batch
            killed.append(done)

    remote = execute(wanted, tmp_path / "cluster", cluster=address, progress=progress)
    assert killed and killed[0] < len(wanted)
    stored = [key for path in (tmp_path / "cluster").glob("part-*") for key in pq.read_table(path)["key"].to_pylist()]
    assert sorted(stored) == sorted(job.key for job in wanted)  # nothing lost, nothing twice
    here = execute(wanted, tmp_path / "here", workers=1)
    assert table(remote, wanted) == table(here, wanted)


def test_a_cluster_that_is_not_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "CONNECT_SECONDS", 1)
    with pytest.raises(ClusterError, match=r"tcp://127\.0\.0\.1:1: no dask scheduler answers"):
        execute(jobs()[:1], tmp_path, cluster="tcp://127.0.0.1:1")
    with pytest.raises(ClusterError, match="nonsense: no dask scheduler answers"):
        execute(jobs()[:1], tmp_path, cluster="nonsense")


def test_a_worker_of_another_version_is_refused() -> None:
    with pytest.raises(ClusterError, match=r"a worker runs pumpbench .*, but this campaign is of 0\.0"):
        campaign._run_batch(jobs()[:1], "compiled", "0.0")


# ---- the command


def test_the_command(pumpbench: Pumpbench, runs: Path) -> None:
    out = runs / "campaign"
    arguments = (
        "--patient",
        "adult#001",
        "--modes",
        "nma,s2",
        "--seeds",
        "1-2",
        "--days",
        "1",
        "--set",
        "gain=0.5,0.7",
    )
    done = pumpbench("campaign", *arguments, "--out", out)
    assert done.returncode == 0, done.stderr
    rows = pq.read_table(out / "results.parquet").to_pylist()
    assert len(rows) == 8
    assert {row["label"] for row in rows} == {"gain=0.5", "gain=0.7"}
    assert all(50 < row["tir_70_180"] <= 100 for row in rows)


@pytest.mark.parametrize(
    ("option", "value", "status", "words"),
    [
        ("--seeds", "x", 2, "seeds 'x'"),
        ("--set", "gain=", 2, "--set 'gain='"),
        ("--modes", "s9", 2, "s9"),
        ("--scenario", "nothing", 2, "nothing"),
        ("--patient", "adult#011", 2, "adult#011"),
        ("--sensor", "x.yaml", 2, "x.yaml"),
        ("--via", "unix:/nowhere/at/all", 3, "unix:/nowhere/at/all"),
    ],
)
def test_what_is_wrong_is_one_line(
    pumpbench: Pumpbench, runs: Path, option: str, value: str, status: int, words: str
) -> None:
    base = {"--patient": "adult#001", "--modes": "nma", "--days": "1", "--workers": "1", "--out": str(runs / "c")}
    done = pumpbench("campaign", *(text for pair in ({**base, option: value}).items() for text in pair))
    assert done.returncode == status, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert words in done.stderr
