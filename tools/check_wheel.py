#!/usr/bin/env python3
"""Build the wheel and use it as somebody does who has never seen this repository.

    tools/check_wheel.py [PYTHON...]     each gets an empty environment; default: every python3.N >= 3.11 on the PATH

In each: the wheel alone is installed, a run is done and its folder is whole, a missing extra is one line that names it.
With the first Python, a firmware repository made from examples/ builds its firmware, runs its tests on a vcan
(tools/with_vcan) against it and, with a firmware that is wrong, leaves recordings. Nothing of this checkout is in the
environments. Exit status 0 if all of it works; about a minute per Python, and downloads.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
NEWEST = 20
"""The highest minor version that is looked for."""


def network() -> dict[str, str]:
    """What this environment says of where packages are fetched from, and how."""
    prefixes = ("PIP_", "SSL_", "http", "HTTP", "no_proxy", "NO_PROXY")
    return {name: value for name, value in os.environ.items() if name.startswith(prefixes)}


def run(command: list[str | Path], folder: Path, *, status: int = 0, said: str = "", **variables: str) -> str:
    """Run a command away from this checkout; returns what it said.

    Raises:
        SystemExit: its status or its words are not as expected.
    """
    environment = {name: os.environ[name] for name in ("PATH", "PUMPBENCH_CACHE", "LANG") if name in os.environ}
    environment |= network() | {
        "HOME": str(folder / "home"),
        "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")),
    }
    (folder / "home").mkdir(exist_ok=True)
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment | variables,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
    )
    if done.returncode != status or said not in done.stdout:
        sys.exit(
            f"check_wheel: {' '.join(map(str, command))}\nexit status {done.returncode}, expected {status}"
            f"{f' and {said!r}' if said else ''}:\n{done.stdout}"
        )
    return done.stdout


def build(place: Path) -> Path:
    """The wheel of this checkout."""
    run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", place, ROOT], place)
    (wheel,) = place.glob("*.whl")
    return wheel


def install(python: str, wheel: Path, place: Path, *more: str) -> Path:
    """An environment with the wheel and what it asks for; returns its bin/."""
    run([python, "-m", "venv", place / "venv"], place)
    binaries = place / "venv" / "bin"
    constraints = ROOT / "constraints.txt"
    run([binaries / "python", "-m", "pip", "install", "--quiet", "-c", constraints, wheel, *more], place)
    return binaries


def use(binaries: Path, place: Path) -> None:
    """What a newcomer does first."""
    pumpbench = binaries / "pumpbench"
    run([pumpbench, "--version"], place, said="pumpbench 0")
    run([pumpbench, "run", "--days", "0.25", "--out", "first"], place, said="recording: first/recording.rrd")
    found = {path.name for path in (place / "first").iterdir()}
    wanted = {"run.json", "bus.log", "trace.parquet", "recording.rrd", "metrics.json", "summary.png"}
    if not wanted <= found:
        sys.exit(f"check_wheel: {sorted(wanted - found)} missing in the run folder")
    run([pumpbench, "study", "--out", "study"], place, status=2, said="pip install 'pumpbench[study]'")
    hint = "pip install 'pumpbench[cluster]'"
    run([pumpbench, "campaign", "--out", "c", "--cluster", "tcp://127.0.0.1:1"], place, status=2, said=hint)
    run([pumpbench, "conformance", "--only", "STA,NUM"], place, said="passed")


def firmware_repository(binaries: Path, place: Path) -> None:
    """A repository of somebody's firmware, with examples/ as its beginning: on a vcan, as its workflow does it."""
    repository = Path(shutil.copytree(ROOT / "examples" / "firmware_repo", place / "firmware"))
    for name in ("c_firmware", "open_loop_firmware.py"):
        source = ROOT / "examples" / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, repository / name)
    dbc_path = run([binaries / "python", "-c", "import dbc; print(dbc.DBC_PATH)"], place).strip()
    make = [
        "make",
        "-C",
        "c_firmware",
        f"BUILD={repository / 'build'}",
        f"PYTHON={binaries / 'python'}",
        f"DBC={dbc_path}",
    ]
    run(make, repository)
    buses = ["--pumpbench-bus", "socketcan:vcan0", "--pumpbench-device-bus", "socketcan:vcan1"]
    test = [
        ROOT / "tools" / "with_vcan",
        "--",
        binaries / "python",
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        *buses,
    ]
    run([*test, "--pumpbench-firmware", "build/firmware {bus}"], repository, said="passed", VCAN_RW=str(place))
    wrong = f"{binaries / 'python'} open_loop_firmware.py {{bus}}"
    run([*test, "--pumpbench-firmware", wrong], repository, status=1, said="recording.rrd", VCAN_RW=str(place))
    if not list((repository / "pumpbench-failed").glob("*/recording.rrd")):
        sys.exit("check_wheel: the failed test left no recording")


def main(pythons: list[str]) -> None:
    """Check the wheel with each of these."""
    found = pythons or [name for minor in range(11, NEWEST) if (name := shutil.which(f"python3.{minor}"))]
    with tempfile.TemporaryDirectory(prefix="check_wheel-") as scratch:
        wheel = build(Path(scratch))
        print(wheel.name)
        for number, python in enumerate(found):
            place = Path(scratch) / str(number)
            place.mkdir()
            version = subprocess.run([python, "--version"], capture_output=True, text=True, check=False)
            if version.returncode:
                print(f"{python}: does not run here, left out: {version.stderr.strip()[:80]}")
                continue
            began = time.monotonic()
            binaries = install(python, wheel, place, "pytest")
            installed = time.monotonic()
            use(binaries, place)
            if number == 0:
                firmware_repository(binaries, place)
            took = f"installed in {installed - began:.0f} s, used in {time.monotonic() - installed:.0f} s"
            print(f"{version.stdout.strip()}: {took}")


if __name__ == "__main__":
    main(sys.argv[1:])
