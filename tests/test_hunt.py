"""The hunt: cases by seed, what fails made small and kept as a test, and a hunt that goes on where it stopped."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import faults, hunt
from pumpbench.faults import KINDS
from pumpbench.hunt import CASES, Found, HuntError, Log, Settings, as_test, case, shrink
from pumpbench.parallel import cpus
from pumpbench.probe import Probe, Verdict

CASES_HUNTED = 10_000 if os.environ.get("PUMPBENCH_NIGHTLY") else 60

CLEAN = Verdict({}, None, frozenset(), 1)
DROP = faults.drop("CGM_Reading", start="02:00", end="04:00", probability=0.5)
NOISE = faults.noise(sd=20, start="01:00")


def bad(hazard: str = "H3", step: int = 30) -> Verdict:
    return Verdict({hazard: 1}, (step, hazard), frozenset(), 1)


# ---- drawing


def test_a_case_is_always_the_same() -> None:
    assert case(1, 7) == case(1, 7) != case(1, 8)
    assert case(2, 7) != case(1, 7)
    assert {case(1, index, modes=("s4",)).mode for index in range(20)} == {"s4"}
    assert {case(1, index, patients=("adult#004",)).patient for index in range(9)} == {"adult#004"}


def test_every_kind_is_drawn_and_every_fault_acts_within_the_run() -> None:
    cases = [case(3, index) for index in range(600)]
    drawn = [fault for each in cases for fault in each.faults]
    assert {fault.kind for fault in drawn} == set(KINDS)
    assert all(fault.start < each.hours * 3600 for each in cases for fault in each.faults)
    assert all(fault.start >= 300 for fault in drawn)  # the calibration is not aimed at
    assert {len(each.faults) for each in cases} == {1, 2, 3, 4}
    aimed = {getattr(fault, "message", None) for fault in drawn} - {None, "SYNC_Step"}
    assert aimed == set(hunt.TRAFFIC)


# ---- the reference firmware


def test_a_hunt_for_the_reference_firmware_catches_nothing(tmp_path: Path) -> None:
    result = hunt.run(Settings(tmp_path, CASES_HUNTED, jobs=cpus()))
    failed = [entry for entry in lines(tmp_path)[1:] if entry["hazards"] or entry["error"]]
    assert failed == [] and result.failed == 0
    assert result.injected > CASES_HUNTED


def lines(folder: Path) -> list[dict]:  # type: ignore[type-arg]
    return [json.loads(line) for line in (folder / CASES).read_text().splitlines()]


# ---- shrinking


def test_what_is_not_needed_goes() -> None:
    """Only a dropped sample at 02:30 matters; the rest goes, and the window shrinks around it."""
    tried: list[Probe] = []

    def judged(probe: Probe) -> Verdict:
        tried.append(probe)
        matters = [f for f in probe.faults if f.kind == "drop" and f.start <= 9000 < (f.end or 10**9)]
        return bad() if matters and probe.hours >= 2.6 else CLEAN

    start = Probe("adult#007", "s4", 99, "camerlingo", 24.0, (NOISE, DROP, faults.restart(start="05:00")))
    left, verdict = shrink(start, bad(), judged)
    (fault,) = left.faults
    assert (left.patient, left.mode, left.seed, left.scenario) == ("adult#001", "nma", 1, "fasting")
    assert left.hours == pytest.approx(32 / 12, abs=0.01)
    assert fault.start == 9000 and fault.end == 9300 and fault.probability == 1.0
    assert verdict == bad() and len(tried) <= hunt.SHRINK_AT_MOST


def test_another_failure_on_the_way_is_not_followed() -> None:
    def judged(probe: Probe) -> Verdict:
        return bad("H6") if len(probe.faults) == 1 else bad("H3")

    start = Probe(faults=(NOISE, DROP))
    left, _ = shrink(start, bad("H3"), judged)
    assert len(left.faults) == 2


def test_shrinking_ends() -> None:
    count = 0

    def judged(_probe: Probe) -> Verdict:
        nonlocal count
        count += 1
        return CLEAN

    start = Probe(faults=(NOISE, DROP))
    assert shrink(start, bad(), judged, tries=5) == (start, bad()) and count == 5


def test_a_run_that_broke_off_shrinks_too() -> None:
    broken = Verdict({}, None, frozenset(), 0, error="PlantError: CTRL asked for more")

    def judged(probe: Probe) -> Verdict:
        return broken if any(fault.kind == "noise" for fault in probe.faults) else CLEAN

    left, verdict = shrink(Probe(hours=24, faults=(NOISE, DROP)), broken, judged)
    assert [fault.kind for fault in left.faults] == ["noise"] and left.hours == 1 and verdict == broken


# ---- a hunt


def half_bad(probe: Probe, *, signs: bool) -> Verdict:
    """Cases with a fault of the pump's frames fail."""
    guilty = any(getattr(fault, "message", "").startswith("PUMP") for fault in probe.faults)
    return bad() if guilty else CLEAN._replace(low=float(probe.seed))


def test_what_fails_is_kept_as_a_test_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hunt, "judge", half_bad)
    caught: list[tuple[Found, Path]] = []
    result = hunt.run(Settings(tmp_path, 40), caught=lambda found, path: caught.append((found, path)))
    assert 0 < result.failed == len(caught) < 40
    found, path = caught[0]
    assert len(found.left.faults) == 1 <= len(found.drawn.faults)
    assert path.name == f"test_hunt_1_{found.number}.py"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(path)],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout  # the real firmware does no harm there
    assert result.lowest[0][1] >= result.lowest[-1][1] > 0
    monkeypatch.setattr(hunt, "judge", lambda probe, signs: pytest.fail("judged again"))
    assert hunt.run(Settings(tmp_path, 40)) == result


def test_a_hunt_goes_on_where_it_was_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hunt, "judge", half_bad)
    whole = hunt.run(Settings(tmp_path / "whole", 20))
    hunt.run(Settings(tmp_path / "cut", 12))
    log = tmp_path / "cut" / CASES
    log.write_text(log.read_text()[:-9])  # the last line is not whole
    told: list[tuple[int, int]] = []
    assert hunt.run(Settings(tmp_path / "cut", 20), told=lambda done, of: told.append((done, of))) == whole
    assert told[0] == (12, 20) and told[-1] == (20, 20)
    assert sorted(Log(tmp_path / "cut", lines(tmp_path / "cut")[0]).done) == list(range(20))


def test_a_hunt_that_was_cut_off_in_its_first_line_begins_anew(tmp_path: Path) -> None:
    (tmp_path / CASES).write_text('{"seed": 1, "mo')
    log = Log(tmp_path, {"seed": 2})
    log.add(0, CLEAN)
    assert sorted(Log(tmp_path, {"seed": 2}).done) == [0]


def test_a_line_that_is_no_verdict_is_named(tmp_path: Path) -> None:
    (tmp_path / CASES).write_text('{"seed": 1}\nrubbish\n')
    with pytest.raises(HuntError, match=r"cases\.jsonl:2: not a verdict: 'rubbish'"):
        Log(tmp_path, {"seed": 1})


def test_the_folder_of_another_hunt_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hunt, "judge", half_bad)
    hunt.run(Settings(tmp_path, 2))
    with pytest.raises(HuntError, match="is of another hunt"):
        hunt.run(Settings(tmp_path, 2, seed=5))
    assert sorted(Log(tmp_path, lines(tmp_path)[0]).done) == [0, 1]


def test_too_much_time_low_or_high_is_a_failure_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hunt, "judge", lambda probe, signs: CLEAN._replace(low=30.0, high=10.0))
    assert hunt.run(Settings(tmp_path / "a", 3)).failed == 0
    assert hunt.run(Settings(tmp_path / "b", 3, max_low=30.0, max_high=10.0)).failed == 0
    caught: list[Found] = []
    result = hunt.run(Settings(tmp_path / "c", 3, max_low=29.0), caught=lambda found, _path: caught.append(found))
    assert result.failed == 3 and caught[0].verdict.error == "Outcome: 30 min below 54 mg/dL"
    assert "Outcome: 30 min below 54" in as_test(caught[0], 1)


def test_on_the_command_line(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("hunt", "--out", runs / "hunt", "--runs", "6", "--jobs", "1", "--modes", "nma")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("6 cases, ") and "0 failures" in done.stdout
    wrong = pumpbench("hunt", "--out", runs / "hunt", "--runs", "6", "--seed", "2")
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1) and "another hunt" in wrong.stderr


def test_on_a_bus_with_another_firmware(pumpbench: Pumpbench, runs: Path) -> None:
    firmware = f"{sys.executable} -m firmware_sim --bus {{bus}}"
    options = ("--runs", "1", "--seed", "4", "--bus", "hub", "--firmware", firmware)
    done = pumpbench("hunt", "--out", runs / "hunt", *options)
    assert done.returncode == 0, done.stderr
