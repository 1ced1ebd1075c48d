"""What is handed out: the wheel has everything the programs open, and nothing of this checkout. tools/check_wheel.py
installs it into empty environments; here it is only unpacked."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGES = {"can_bus": "can_bus", "dbc": "dbc", "plant_server": "plant_server", "firmware_sim": "firmware_sim"}
PACKAGES |= {"tools/pumpbench": "pumpbench"}


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(place), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = place.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place / "site")
    return place / "site"


def test_it_has_every_file_of_the_packages_and_no_other(unpacked: Path) -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    wanted = {
        path.replace(room, package, 1)
        for path in listed
        for room, package in PACKAGES.items()
        if path.startswith(f"{room}/")
    }
    found = {str(path.relative_to(unpacked)) for path in unpacked.rglob("*") if path.is_file()}
    assert {path for path in found if ".dist-info/" not in path} == wanted
    licences = {path.rpartition("/")[2] for path in found if ".dist-info/licenses/" in path}
    assert licences == {"LICENSE", "NOTICE"}


@pytest.mark.nightly
def test_a_run_with_what_is_in_it(unpacked: Path, tmp_path: Path) -> None:
    """Whatever a run opens comes from the wheel: sources, the DBC, patients, controller models."""
    code = (
        "import dbc, sys, pumpbench.cli, pumpbench.rig\n"
        "ours = {'pumpbench', 'can_bus', 'plant_server', 'dbc'}\n"
        "print(dbc.DBC_PATH, *(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] in ours), sep='\\n')\n"
        "sys.argv = ['pumpbench', 'run', '--days', '0.05', '--out', 'run']\n"
        "print('then')\n"
        "pumpbench.cli.main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(unpacked)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    opened = done.stdout.split("then")[0].split()
    assert len(opened) > 20
    assert [path for path in opened if not path.startswith(str(unpacked))] == []
    assert (tmp_path / "run" / "recording.rrd").is_file()


def test_news_can_be_read() -> None:
    """Every fragment has a kind that towncrier knows, or it would be lost at the release."""
    kinds = {"added", "changed", "fixed", "removed"}
    for path in (ROOT / "docs" / "changelog.d").glob("[!.]*"):
        assert path.name.split(".")[-2] in kinds and path.suffix == ".md", path
        assert path.read_text(encoding="utf-8").strip()
    done = subprocess.run(
        [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "9.9"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "## 9.9" in done.stdout
