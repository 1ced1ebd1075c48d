"""Checkpoints: an instant of a run in a folder of its own, what it holds, and what is refused."""

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Pumpbench
from pumpbench import bench, checkpoint, faults, fork
from pumpbench.bench import Outcome
from pumpbench.checkpoint import CheckpointError, plain
from pumpbench.rewind import Diverged
from test_fork import DISTURBED, INSTANTS, OPEN_LOOP, first_difference, same, step

from firmware_sim.firmware import NVM_WORDS
from firmware_sim.nvm import Nvm, RamMemory
from plant_server import physiology


@pytest.fixture(scope="module")
def disturbed() -> Outcome:
    return bench.run(strategy="s4", scenario="six-hours", hours=6, faults=DISTURBED)


def take(outcome: Outcome, at: str, folder: Path) -> Path:
    info = {**outcome.info, "trace_sha256": outcome.frames.sha256()}
    checkpoint.take(fork.Instant.of("the run", outcome.frames, info, at), folder)
    return folder


@pytest.fixture(scope="module")
def taken(disturbed: Outcome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return take(disturbed, "03:25", tmp_path_factory.mktemp("taken") / "checkpoint")


@pytest.fixture
def copied(taken: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(taken, tmp_path / "copied"))


@pytest.mark.parametrize("at", INSTANTS, ids=list(INSTANTS.values()))
def test_it_is_enough_to_go_on_from(disturbed: Outcome, at: str, tmp_path: Path) -> None:
    assert same(bench.fork(take(disturbed, at, tmp_path / "checkpoint")).run(), disturbed)


def test_it_holds_the_state_of_every_node(disturbed: Outcome, taken: Path) -> None:
    state = json.loads((taken / "state.json").read_text())
    x, p = np.array(list(state["patient"]["x"].values())), np.array(state["patient"]["p"])
    assert abs(physiology.glucose(x, p) - disturbed.glucose[step("03:25")]) <= 0.02  # the truth page's resolution
    assert state["pump"]["boluses"]["1"]["dose"] > 0
    assert state["plant"]["transmitter"]["counters"]["CGM_Reading"] < 16
    waiting = state["bus"]["injector"]["lanes"]["plant"]["waiting"]
    assert waiting and all(each["frame"]["can_id"] == 0x200 and each["time"] >= 41 * 300 for each in waiting)
    assert state["bus"]["clock"]["time"] == 41 * 300
    assert state["firmware"]["step"] == 40 and state["firmware"]["user"]["mode"] == 8
    memory = RamMemory((taken / "memory.bin").stat().st_size)
    memory.write(0, (taken / "memory.bin").read_bytes())
    record = Nvm(memory, NVM_WORDS).load()
    assert record is not None and 40 in record
    assert state["memory_sha256"] == hashlib.sha256((taken / "memory.bin").read_bytes()).hexdigest()


def test_other_faults_and_modes_from_it(disturbed: Outcome, taken: Path) -> None:
    lost = [faults.drop("CGM_Reading", start="04:50", end="05:30")]
    whole = bench.fork(disturbed, "03:25")
    assert same(bench.fork(taken).run(faults=lost), whole.run(faults=lost))
    assert same(bench.fork(taken).run(strategy="nma"), whole.run(strategy="nma"))
    assert same(bench.fork(taken).run(scenario="fasting", hours=8), whole.run(scenario="fasting", hours=8))


def test_an_earlier_instant_of_it(disturbed: Outcome, taken: Path) -> None:
    earlier = bench.fork(taken, "02:20").run(strategy="nma")
    assert first_difference(earlier, disturbed) == step("02:20")


def test_the_end_of_a_run_that_goes_on_later(tmp_path: Path) -> None:
    short = bench.run(strategy="nma", scenario="six-hours", hours=3)
    longer = bench.run(strategy="nma", scenario="six-hours", hours=5)
    assert same(bench.fork(take(short, "03:00", tmp_path / "checkpoint")).run(hours=5), longer)


@pytest.mark.nightly
def test_by_command_and_on_a_hub(disturbed: Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    disturbed.write(runs / "whole")
    done = pumpbench("checkpoint", "whole@03:25", "--out", "instant")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "checkpoint of whole@03:25: instant\n"
    shutil.rmtree(runs / "whole")
    done = pumpbench("run", "--from", "instant", "--bus", "hub", "--out", "fork")
    assert done.returncode == 0, done.stderr
    info = json.loads((runs / "fork" / "run.json").read_text())
    assert info["trace_sha256"] == info["fork"]["of"] == disturbed.frames.sha256()
    done = pumpbench("checkpoint", "fork@03:30", "--out", "instant")
    assert done.returncode == 2
    assert done.stderr == "pumpbench: instant exists already; choose another folder\n"


# ---- what is refused


def reseal(folder: Path) -> None:
    """State the hashes of the files as they are."""
    header = json.loads((folder / "checkpoint.json").read_text())
    header["files"] = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in header["files"]}
    (folder / "checkpoint.json").write_text(json.dumps(header))


def header_with(**entries: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        header = json.loads((folder / "checkpoint.json").read_text())
        (folder / "checkpoint.json").write_text(json.dumps(header | entries))

    return change


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (header_with(programs="0" * 64), "was taken by other programs (000000000000, these are "),
        (
            header_with(format="pumpbench checkpoint 2"),
            "expected a 'pumpbench checkpoint 1', found 'pumpbench checkpoint 2'",
        ),
        (lambda folder: (folder / "checkpoint.json").write_text("{"), "checkpoint.json is damaged"),
        (lambda folder: (folder / "checkpoint.json").write_text("[]"), "checkpoint.json is damaged"),
        (lambda folder: (folder / "checkpoint.json").write_text("{}"), "checkpoint.json is damaged: 'format'"),
        (header_with(files=[]), "checkpoint.json is damaged"),
        (header_with(files={}), "checkpoint.json is damaged: 'bus.log'"),
        (lambda folder: (folder / "state.json").write_text("{}"), "state.json was changed: it does not have the hash"),
        (lambda folder: (folder / "memory.bin").unlink(), "memory.bin: No such file or directory"),
        (lambda folder: (folder / "bus.log").write_text(""), "bus.log was changed"),
    ],
)
def test_one_line_says_what_is_wrong(
    copied: Path, pumpbench: Pumpbench, change: Callable[[Path], None], text: str
) -> None:
    change(copied)
    done = pumpbench("run", "--from", copied, "--out", "fork")
    assert done.returncode == 2
    assert text in done.stderr and len(done.stderr.splitlines()) == 1


def test_nothing_beyond_its_end(taken: Path) -> None:
    with pytest.raises(fork.ForkError, match="the checkpoint ends at 03:25"):
        bench.fork(taken, "03:30")


@pytest.mark.parametrize(
    "place",
    [
        ("patient", "x", "Gp"), ("sensor", "last"), ("pump", "sequence"), ("user", "number"), ("plant", "mode"),
        ("bus", "clock", "time"), ("firmware", "step"), ("memory_sha256",),
    ],
)  # fmt: skip
def test_a_state_that_is_not_come_to_is_named(copied: Path, place: tuple[str, ...]) -> None:
    state = json.loads((copied / "state.json").read_text())
    part = state
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = -1
    (copied / "state.json").write_text(json.dumps(state))
    reseal(copied)
    with pytest.raises(Diverged, match=f"not in the state of the checkpoint: {'.'.join(place)} was -1, is "):
        bench.fork(copied).run()
    if place[0] in ("patient", "pump", "plant"):
        with pytest.raises(Diverged, match="not in the state"):
            bench.fork(copied).run(bus="hub")


def test_another_firmware_s_state_cannot_be_read(disturbed: Outcome, tmp_path: Path) -> None:
    info = {**disturbed.info, "firmware": OPEN_LOOP}
    with pytest.raises(CheckpointError, match="whose state nobody can read; fork the run itself: --from the run@03:25"):
        checkpoint.take(fork.Instant.of("the run", disturbed.frames, info, "03:25"), tmp_path / "checkpoint")
    assert not any(tmp_path.iterdir())


def test_something_without_a_known_state_is_no_silent_gap() -> None:
    with pytest.raises(TypeError, match=r"place\[a\]: Generator is nothing that a checkpoint can hold"):
        plain({"a": np.random.default_rng(1)}, "place")
    with pytest.raises(TypeError, match=r"place\[0\]: function is nothing"):
        plain([lambda: None], "place")
