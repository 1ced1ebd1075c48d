#!/usr/bin/env python3
"""Do what somebody does who clones this repository for the first time, and say how long it takes.

    tools/check_clone.py [--tests] [--markdown docs/performance.md]

The last commit is cloned; the home directory is empty, so no package, no compiled code and no emulator is at hand, and
the PATH has only this Python besides the system's directories. `make setup` and `make run` follow, with --tests
`make test` too. With --markdown the times take the place of the page's section. What packages are fetched from is
taken from the environment (PIP_INDEX_URL and the like): downloads are part of the times.
"""

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from check_wheel import network

ROOT = Path(__file__).resolve().parent.parent
SYSTEM = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

HEADING = "## A fresh clone"
STEPS = {
    "git clone": "the repository, from this disk",
    "make setup": "all packages, downloaded",
    "make run": "one day on the embedded bus: the first recording",
    "make test": "linters and all tests, here and on a vcan, whose emulators are downloaded",
}


def environment(home: Path) -> dict[str, str]:
    """Of a machine that has Python, make and a compiler, and nothing of ours."""
    python = Path(sys.executable).resolve().parent
    return network() | {"HOME": str(home), "PATH": f"{python}:{SYSTEM}", "LANG": "C.UTF-8", "CI": "true"}


def timed(command: list[str], place: Path, variables: dict[str, str]) -> float:
    """Seconds a command takes.

    Raises:
        SystemExit: it fails.
    """
    print(f"$ {' '.join(command)}", flush=True)
    began = time.monotonic()
    done = subprocess.run(command, cwd=place, env=variables, check=False)
    if done.returncode:
        sys.exit(f"check_clone: {' '.join(command)} ended with status {done.returncode}")
    return time.monotonic() - began


def section(seconds: dict[str, float]) -> str:
    """The times as a section of docs/performance.md."""
    rows, since = [], 0.0
    for step, taken in seconds.items():
        since += taken
        rows.append(f"| `{step}` | {STEPS[step]} | {minutes(taken)} | {minutes(since)} |")
    machine = f"{os.cpu_count()} CPUs, Linux {platform.release()}, Python {platform.python_version()}"
    return f"""{HEADING}
Written by `tools/check_clone.py --tests --markdown docs/performance.md`: an empty home directory, no cache. {machine}.

| step | what it does | min:s | since the start |
|---|---|---:|---:|
{chr(10).join(rows)}
"""


def minutes(seconds: float) -> str:
    """Seconds as m:ss."""
    return f"{round(seconds) // 60}:{round(seconds) % 60:02}"


def main() -> None:
    """Clone, set up, run, test, and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", action="store_true", help="make test too")
    parser.add_argument("--markdown", type=Path, help="page whose section is replaced")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="check_clone-") as scratch:
        home, clone = Path(scratch) / "home", Path(scratch) / "pumpbench"
        home.mkdir()
        variables = environment(home)
        seconds = {"git clone": timed(["git", "clone", "--quiet", f"file://{ROOT}", str(clone)], home, variables)}
        for step in ("make setup", "make run", *(["make test"] if options.tests else [])):
            seconds[step] = timed(step.split(), clone, variables)
    text = section(seconds)
    print(text)
    if options.markdown:
        page = options.markdown.read_text(encoding="utf-8").partition(HEADING)[0].rstrip()
        options.markdown.write_text(f"{page}\n\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
