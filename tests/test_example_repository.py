"""examples/firmware_repo as somebody uses it who has copied it: its tests run, its workflows ask for what there is."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import ROOT, Pumpbench

HERE = ROOT / "examples" / "firmware_repo"
WORKFLOWS = sorted((HERE / ".github" / "workflows").glob("*.yml"))


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(HERE, tmp_path / "firmware"))


def run(folder: Path, firmware: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pumpbench-firmware", firmware]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.nightly
def test_its_tests_pass_on_the_reference(copied: Path) -> None:
    done = run(copied, f"{sys.executable} -m firmware_sim --bus {{bus}}")
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout
    assert not (copied / "pumpbench-failed").exists()


def test_a_firmware_that_is_wrong_leaves_recordings(copied: Path) -> None:
    """The open-loop example does nothing about a sensor that is lost."""
    done = run(copied, f"{sys.executable} {ROOT / 'examples' / 'open_loop_firmware.py'} {{bus}}")
    assert done.returncode == 1, done.stdout
    kept = next((copied / "pumpbench-failed").glob("*two_hours_without_a_sensor*"))
    assert {"recording.rrd", "summary.png", "bus.log"} <= {path.name for path in kept.iterdir()}
    assert list(kept.glob("fault-1-0200-Drop-CGM_Reading*.png"))
    assert "two_hours_without_a_sensor" in (copied / "pumpbench-failed" / "summary.md").read_text()


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=[path.stem for path in WORKFLOWS])
@pytest.mark.parametrize("failed", [True, False])
def test_workflows_show_what_there_is(workflow: Path, failed: bool, tmp_path: Path) -> None:
    """The step that writes GitHub's summary, run as GitHub runs it (bash -e), with and without failed tests."""
    (job,) = yaml.safe_load(workflow.read_text())["jobs"].values()
    (step,) = [step for step in job["steps"] if "GITHUB_STEP_SUMMARY" in step.get("run", "")]
    assert step["env"] == {"KEPT": "${{ steps.kept.outputs.artifact-url }}"}
    ids = [each.get("id") for each in job["steps"]]
    assert ids.index("kept") < job["steps"].index(step)
    if failed:
        for page in ("report/report.md", "pumpbench-failed/summary.md"):
            (tmp_path / page).parent.mkdir()
            (tmp_path / page).write_text(f"this is {page}\n")
    summary = tmp_path / "summary.md"
    environment = os.environ | {"GITHUB_STEP_SUMMARY": str(summary), "KEPT": "https://x.example/1" if failed else ""}
    subprocess.run(["bash", "-e", "-c", step["run"]], cwd=tmp_path, env=environment, check=True)
    expected = "this is report/report.md\nthis is pumpbench-failed/summary.md\n[Recordings and pictures](https://x.example/1)\n"
    assert (summary.read_text() if summary.exists() else "") == (expected if failed else "")


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=[path.stem for path in WORKFLOWS])
def test_workflows_ask_for_options_that_exist(workflow: Path, pumpbench: Pumpbench) -> None:
    jobs = yaml.safe_load(workflow.read_text())["jobs"]
    commands = [" ".join(step["run"].split()) for job in jobs.values() for step in job["steps"] if "run" in step]
    asked = [command for command in commands if "pumpbench conformance" in command]
    assert asked
    shown = pumpbench("conformance", "--help").stdout
    for option in re.findall(r"--[a-z-]+", " ".join(asked)):
        assert option in shown
    plugin = subprocess.run(
        [sys.executable, "-m", "pytest", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for option in re.findall(r"--pumpbench-[a-z-]+", " ".join(commands)):
        assert option in plugin
