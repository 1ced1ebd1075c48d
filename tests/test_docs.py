"""What README and docs tell a reader to type does what they say: run here, with its output where the page shows it.

A `yaml` block that begins with its name is a file, an `sh` block a script, a `console` block a dialogue whose answers
must come as printed (`...` stands for anything). A page is one session: what a command leaves behind is there for the
next one.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import typer
from conftest import ROOT
from pumpbench.cli import app

PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/[!_]*.md", "examples/*.md", "examples/*/README.md")
    for path in ROOT.glob(pattern)
)
NOT_HERE = {
    "make test": "this is it",
    "tools/run_": "of a clone; this is a part of it",
    "make docs": "of a clone; tools/run_lint holds the pages",
    "make run": "sets up a clone of its own; what it runs is run",
    "/dev/tty": "a board",
    "can0 ": "a board",
    "socketcan:can0": "a board",
    "/dev/pts/": "the name of a terminal that one gets",
    "sudo ": "root",
    "tcp://": "a cluster",
    "clang": "another compiler",
    "make     ": "tests/test_c_firmware.py builds it",
    "make sanitize": "tests/test_c_firmware.py builds it",
    "own.csv": "patients of one's own",
    "qemu-system-arm": "shown for its options; run.py runs it",
    "cortex": "tests/test_cortex_m3.py builds and runs it",
    "29536 --host": "waits for somebody else's firmware",
    "/tmp/bus --host": "waits for somebody else's firmware",
    "--bus unix:": "waits for the plant of the line above",
    "ssh -L": "another machine",
    "--serve 9876": "its ports may be taken; tests/test_live_recorder.py and test_web_viewer.py watch runs",
    "--repair": "tests/test_live_recorder.py kills and repairs",
    "console /tmp/pump": "tests/test_console.py talks to it",
    ". .venv/bin/activate": "is active",
    "cd ../..": "is there",
    "git apply": "tests/test_extending.py applies them",
    "extending/filebus": "tests/test_extending.py installs it",
    "filebus:": "tests/test_extending.py runs on it",
    "pumpbench view": "waits for whoever looks; tests/test_looks.py",
    'pytest --pumpbench-bus hub --pumpbench-firmware "./build/firmware': "tests/test_example_repository.py does it",
}
"""Parts of commands that are not run here, and why not; their options are looked up all the same."""
ON_VCAN = ("vcan", "candump", "cansend", "cangen", "canplayer", "cangw", "shown.log")
"""Parts of commands that need a CAN: tests/test_can_utils.py and tests/test_with_vcan.py run them."""
LONG = (
    "hunt --out hunt --runs 1000",
    "pumpbench benchmark",
    "study --out study",
    "campaign --modes nma,s2 --seeds 1-20",
    "campaign --patient all",
    "run --patient all",
    "--days 14 --seed 1",
    "conformance --bus hub",
)
"""Parts of commands that take minutes: run with PUMPBENCH_NIGHTLY=1."""


EVERY_TIME = ("README.md", "docs/troubleshooting.md")
"""Pages that are typed in `make test`; the others in a job of their own in CI, and in `make nightly`."""


class Block(NamedTuple):
    line: int
    language: str
    text: str


def blocks(page: str) -> list[Block]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return [
        Block(text.count("\n", 0, found.start()) + 1, found[1], found[2])
        for found in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    ]


def shown(pages: list[str], *languages: str) -> list[object]:
    """The pages with such a block, as parameters."""
    found = [page for page in pages if any(block.language in languages for block in blocks(page))]
    return [pytest.param(page, marks=[] if page in EVERY_TIME else [pytest.mark.nightly]) for page in found]


def lines(block: Block) -> Iterator[str]:
    """The commands of a `sh` block without their comments, continued lines joined."""
    for line in block.text.replace("\\\n", " ").splitlines():
        command = re.sub(r"(^|\s)#\s.*$", "", line)
        if command.strip():
            yield command


def is_run(command: str) -> bool:
    if any(part in command + "  " for part in LONG):
        return bool(os.environ.get("PUMPBENCH_NIGHTLY"))
    return not any(part in command for part in (*NOT_HERE, *ON_VCAN))


def dialogues(block: Block) -> list[tuple[str, str]]:
    """The commands of a `console` block, each with the output below it."""
    found = re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block.text, re.MULTILINE)
    assert "".join(f"$ {command}\n{output}" for command, output in found) == block.text, "begins with no command"
    return [(command.strip(), output) for command, output in found]


def as_pattern(output: str) -> str:
    """What an output must match: the words as they stand, however they are spaced, and anything for `...`."""
    words = [re.escape(part).replace(r"\.\.\.", r".*?") for part in output.split()]
    return r"\s*" + r"\s+".join(words) + r"\s*"


OWN_TEST = """
def test_ten_minutes(bench):
    bench.run(strategy="nma", hours=1).assert_no_hazards()
"""


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory as a reader has it who has cloned the repository: with a firmware, a test and a run of their own."""
    for name in ("tools", "dbc", "docs", "Makefile", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("build"))
    (tmp_path / "test_own.py").write_text(OWN_TEST)
    (tmp_path / "pytest.ini").write_text("[pytest]\nnorecursedirs = examples\n")
    firmware = tmp_path / "my_firmware"
    firmware.write_text(f'#!/bin/sh\nexec {sys.executable} -m firmware_sim --bus "$1"\n')
    firmware.chmod(0o755)
    for place in (tmp_path, *(tmp_path / "examples").glob("*_*/")):
        (place / "build").mkdir()
        (place / "build" / "firmware").symlink_to(firmware)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    older = tmp_path / "python3.9"
    older.write_text(
        f"#!{sys.executable}\nimport sys\n"
        "sys.version_info, sys.version = (3, 9, 2), '3.9.2 (default)'\nexec(sys.argv[2])\n"
    )
    older.chmod(0o755)
    monkeypatch.setenv("COLUMNS", "120")
    for name in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL"):  # of the make that runs the tests
        monkeypatch.delenv(name, raising=False)
    subprocess.run(["pumpbench", "run", "--days", "0.1", "--bus", "inproc"], cwd=tmp_path, check=True, timeout=60)
    return tmp_path


def bash(script: str, folder: Path, options: str = "-euo") -> "subprocess.CompletedProcess[str]":
    newest = "RUN=$(ls -td runs/*/ 2>/dev/null | head -n 1)\n"
    text = re.sub(r"\bruns/RUN\b", '"$RUN"', script)
    return subprocess.run(
        ["bash", options, "pipefail", "-c", (newest if "$RUN" in text else "") + text],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=1800 if os.environ.get("PUMPBENCH_NIGHTLY") else 120,
        check=False,
    )


@pytest.mark.timeout(3600 if os.environ.get("PUMPBENCH_NIGHTLY") else 240)
@pytest.mark.parametrize("page", shown(PAGES, "sh", "console"))
def test_a_page_is_a_session_that_works(page: str, desk: Path) -> None:
    place = desk / (Path(page).parent if page.startswith("examples/") else "")
    for block in blocks(page):
        where = f"{page}:{block.line}"
        if block.language == "yaml" and (name := re.match(r"# (\w+\.yaml)$", block.text, re.MULTILINE)):
            (place / name[1]).write_text(block.text, encoding="utf-8")
        if block.language == "sh":
            for command in filter(is_run, lines(block)):
                done = bash(command, place)
                assert done.returncode == 0, f"{where}: {command}\n{done.stdout}"
        elif block.language == "console":
            for command, output in dialogues(block):
                if is_run(command):
                    done = bash(command, place, "-uo")
                    assert re.fullmatch(as_pattern(output), done.stdout, re.DOTALL), (
                        f"{where}: $ {command}\n{done.stdout}\nis not what the page shows:\n{output}"
                    )


@pytest.mark.parametrize("page", shown(PAGES, "python"))
def test_python_on_a_page_runs(page: str, desk: Path) -> None:
    for number, block in enumerate(block for block in blocks(page) if block.language == "python"):
        where = f"{page}:{block.line}"
        compile(block.text, where, "exec")
        if "def test_" in block.text:
            file = desk / f"test_page_{number}.py"
            file.write_text(block.text)
            command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)]
        elif block.text.startswith("from pumpbench"):
            command = [sys.executable, "-c", block.text]
        else:
            continue  # a fragment, or a script for files that are not here
        done = subprocess.run(command, cwd=desk, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, f"{where}:\n{done.stdout}{done.stderr}"


# ---- the options of every command that is shown anywhere


def invocations(text: str) -> Iterator[str]:
    """Every `pumpbench COMMAND --options`, whether in a block or in a line of text."""
    for found in re.finditer(r"\bpumpbench ((?:[a-z]+-?)+(?: [^`\n&|;]*)?)", text.replace("\\\n", " ")):
        yield re.sub(r"\s#\s.*$", "", found[1])


@pytest.mark.parametrize("page", PAGES)
def test_options_that_are_shown_exist(page: str) -> None:
    group = typer.main.get_command(app)
    known = set(group.commands)  # type: ignore[attr-defined]
    own_parser = {"firmware", "gateway", "record"}
    for block in blocks(page):
        if block.language not in ("sh", "yaml"):
            continue
        for text in invocations(block.text):
            name, *arguments = shlex.split(text, comments=True)
            assert name in known, f"{page}:{block.line}: there is no command {name}"
            if name in own_parser:
                continue
            options = {opt for param in group.commands[name].params for opt in (*param.opts, *param.secondary_opts)}  # type: ignore[attr-defined]
            for argument in arguments:
                if argument.startswith("--"):
                    assert argument.split("=")[0] in options, f"{page}:{block.line}: pumpbench {name} has no {argument}"


def test_every_reason_is_needed() -> None:
    """Nothing stands in the table above that no page needs any more."""
    typed = "\n".join(
        command for page in PAGES for block in blocks(page) if block.language == "sh" for command in lines(block)
    )
    typed += "\n".join(block.text for page in PAGES for block in blocks(page) if block.language == "console")
    for part in (*NOT_HERE, *ON_VCAN, *LONG):
        assert part in typed, f"no page shows {part!r}"


def test_an_output_that_differs_is_noticed() -> None:
    assert re.fullmatch(as_pattern("mean 123 ... done\n"), "mean   123\nthis and that\ndone\n", re.DOTALL)
    assert not re.fullmatch(as_pattern("mean 123 ... done\n"), "mean 124\ndone\n", re.DOTALL)
    assert not re.fullmatch(as_pattern("mean 123\n"), "mean 123\nTraceback\n", re.DOTALL)
