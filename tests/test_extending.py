"""docs/extending.md: every worked example is applied to a copy of this repository, and does what the page says."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml
from conftest import ROOT

EXAMPLES = ROOT / "examples" / "extending"
AT_MOST = 40
NO_COMPILER = {"NUMBA_DISABLE_JIT": "1"}
"""To compile a copy takes longer than to run it as it is; both give the same bits (tests/test_compiled_loop.py)."""


def changed_lines(patch: Path) -> int:
    lines = patch.read_text(encoding="utf-8").splitlines()
    return sum(line[:1] in ("+", "-") and line[:3] not in ("+++", "---") for line in lines)


class Copy:
    """The packages as they are here, somewhere else."""

    def __init__(self, place: Path) -> None:
        self.place = place
        for room in ("can_bus", "dbc", "plant_server", "firmware_sim", "tools", "examples"):
            shutil.copytree(ROOT / room, place / room, ignore=shutil.ignore_patterns("__pycache__", "build"))

    def apply(self, patch: str) -> None:
        command = ["git", "apply", str(EXAMPLES / patch)]
        done = subprocess.run(command, cwd=self.place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{patch} has to be made anew: {done.stderr}"

    def pumpbench(self, *arguments: str, path: str = "") -> str:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "pumpbench", *arguments],
            cwd=self.place,
            env=os.environ | {"PYTHONPATH": f"{self.place}:{self.place / 'tools'}:{path}"} | NO_COMPILER,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def run(self, name: str, *arguments: str, path: str = "") -> Path:
        self.pumpbench("run", *arguments, "--out", name, path=path)
        return self.place / name


@pytest.fixture
def copy(tmp_path: Path) -> Copy:
    return Copy(tmp_path)


def sha(folder: Path) -> str:
    return str(json.loads((folder / "run.json").read_text())["trace_sha256"])


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.p*")), ids=lambda path: path.name)
def test_an_example_is_short(path: Path) -> None:
    lines = changed_lines(path) if path.suffix == ".patch" else len(path.read_text(encoding="utf-8").splitlines())
    assert 0 < lines <= AT_MOST


def test_a_strategy(copy: Copy) -> None:
    copy.apply("strategy.patch")
    grid = ("--patient", "adult#001", "--modes", "s2,s5", "--days", "1")
    copy.pumpbench("campaign", "--out", "c", *grid)  # the compiled core
    copy.pumpbench("campaign", "--out", "b", *grid, "--via", "inproc")  # the firmware
    tables = [pq.read_table(copy.place / name / "results.parquet").to_pylist() for name in ("c", "b")]
    doses = [{row["mode"]: row["pramlintide_ug_per_day"] for row in table} for table in tables]
    assert doses[0] == doses[1]
    assert 0 < doses[0]["s5"] < doses[0]["s2"]


def test_a_sensor(copy: Copy) -> None:
    copy.apply("sensor.patch")
    (copy.place / "quiet.yaml").write_text("model: {name: white, sd: 0}\n")
    noisy, quiet, ideal = (
        copy.run(name.split(".")[0], "--bus", "inproc", "--days", "0.25", "--sensor", name)
        for name in ("white", "quiet.yaml", "ideal")
    )
    readings = [
        pq.read_table(folder / "trace.parquet")["GlucoseConc"].to_pylist()[1:72] for folder in (noisy, quiet, ideal)
    ]
    assert readings[1] == readings[2] != readings[0]


def test_a_fault(copy: Copy) -> None:
    copy.apply("fault.patch")
    fault = {"kind": "reversed_bytes", "message": "CGM_Reading", "start": "02:00", "end": "02:40"}
    (copy.place / "faults.yaml").write_text(yaml.safe_dump({"faults": [fault]}))
    trace = pq.read_table(
        copy.run("run", "--days", "0.25", "--bus", "inproc", "--faults", "faults.yaml") / "trace.parquet"
    )
    errors = trace["E2eErrorCount"].to_pylist()
    assert errors[23] == 0 and errors[40] == 8
    listed = copy.pumpbench("faults")
    assert "reversed_bytes   The payload comes back to front" in listed


def test_a_transport(copy: Copy) -> None:
    """As pip installs it: the module, and a line that python-can finds it by."""
    site = copy.place / "site"
    shutil.copytree(EXAMPLES / "filebus", site)
    about = site / "filebus-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: filebus\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[can.interface]\nfilebus = filebus:FileBus\n")
    on_file = copy.run("file", "--days", "0.25", "--bus", f"filebus:{copy.place / 'bus'}", path=str(site))
    assert sha(on_file) == sha(copy.run("inproc", "--days", "0.25", "--bus", "inproc"))
    assert (copy.place / "bus").stat().st_size > 0


def test_a_patient_is_on_the_page() -> None:
    """tests/test_docs.py types what the page says about a patient."""
    assert "heavier.py > mine.csv" in (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
