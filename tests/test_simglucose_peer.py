"""simglucose as a peer: the day both do, the figures, and what is said where it cannot be had."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from pumpbench.benchmark import closed_loop
from pumpbench.benchmark import simglucose_peer as peer

from plant_server import physiology

PATIENT = physiology.load_patient("adult#001", basal_glucose=None)


def simglucose_state(patient: physiology.Patient) -> list[float]:
    return [float(patient.x0[i]) for i in peer._STATES]


def fake_environment(place: Path, script: str) -> None:
    """A complete environment whose Python is a shell script."""
    python = place / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    (place / "pumpbench-complete.json").write_text(json.dumps(peer.REQUIREMENTS))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PUMPBENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.parametrize(
    ("environment", "place"),
    [
        ({"PUMPBENCH_CACHE": "/a", "XDG_CACHE_HOME": "/b"}, "/a/simglucose"),
        ({"XDG_CACHE_HOME": "/b"}, "/b/pumpbench/simglucose"),
        ({"PUMPBENCH_CACHE": "", "XDG_CACHE_HOME": ""}, str(Path.home() / ".cache/pumpbench/simglucose")),
        ({}, str(Path.home() / ".cache/pumpbench/simglucose")),
    ],
)
def test_where_it_is_kept(environment: dict[str, str], place: str) -> None:
    assert peer.cache_directory(environment) == Path(place)


def test_a_meal_is_eaten_at_5_g_per_min_after_the_one_before() -> None:
    carbs = np.zeros(20)
    carbs[[2, 4, 12]] = 12.0, 6.0, 5.0
    assert peer.eaten(carbs).tolist() == [0, 0, 5, 5, 5, 3, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0]


def test_the_day_has_its_meals_and_boluses() -> None:
    day = peer.a_day(1.2, 10.0, {60: 40.0})
    assert day.carbs_g.sum() == day.carbs_g[60] == 40.0
    assert day.insulin_u[60] - 4.0 == pytest.approx(day.insulin_u[61])
    assert (day.insulin_u > 0.0).all()
    assert len(set(day.insulin_u.round(9))) > 40
    assert day.insulin_u.sum() == pytest.approx(24 * 1.2 + 4.0, rel=0.02)


def test_ours_at_rest_stays_and_follows_the_meal_rule() -> None:
    state = simglucose_state(PATIENT)
    rest = peer.Day(np.zeros(120), np.full(120, PATIENT.basal_u_per_h / 60))
    trace = peer.our_trace(PATIENT, rest, state)
    assert len(trace.plasma) == len(trace.subcutaneous) == 25
    assert trace.plasma == pytest.approx([PATIENT.basal_glucose] * 25)

    # what is eaten in one minute has one size from the start, whichever rule
    carbs = np.zeros(120)
    carbs[10] = 5.0
    day = rest._replace(carbs_g=carbs)
    x = PATIENT.x0.copy()
    expected = []
    for minute in range(120):
        if carbs[minute]:
            physiology.begin_meal(x, PATIENT.params, 5000.0)
        physiology.advance(
            x, PATIENT.params, minute, np.full(2, day.insulin_u[0] / 2), np.zeros(2), np.full(2, carbs[minute] * 500)
        )
        expected.append(physiology.glucose(x, PATIENT.params))
    assert peer.our_trace(PATIENT, day, state).plasma[1:] == pytest.approx(expected[4::5], abs=1e-9)


def test_a_growing_meal_differs_from_one_known_at_its_start() -> None:
    """The rule of simglucose matters: without it the comparison would show the rule, not the integration."""
    state = simglucose_state(PATIENT)
    day = peer.a_day(PATIENT.basal_u_per_h, PATIENT.carb_ratio_g_per_u, {60: 80.0})
    growing = peer.our_trace(PATIENT, day, state)
    x, known = PATIENT.x0.copy(), []
    grams = peer.eaten(day.carbs_g)
    for minute in range(peer.MINUTES):
        if minute == 60:
            physiology.begin_meal(x, PATIENT.params, 80e3)
        insulin, carbs = np.full(2, day.insulin_u[minute] / 2), np.full(2, grams[minute] * 500)
        physiology.advance(x, PATIENT.params, minute, insulin, np.zeros(2), carbs)
        known.append(physiology.glucose(x, PATIENT.params))
    assert np.abs(np.subtract(growing.plasma[1:], known[4::5])).max() > 10 * peer.ALLOWED_ERROR


def test_figures() -> None:
    trace = peer.Trace(1.0, [], [100.0, 110.0], [100.0, 105.0])
    other = trace._replace(plasma=[100.0, 110.01], subcutaneous=[99.98, 105.0])
    assert peer.difference(trace, other) == pytest.approx(0.02)
    assert peer.speed_figure([900.0, 1000.0, 1100.0], [0.2, 0.25, 0.5]) == {
        "name": "plant/vs-simglucose",
        "value": 1000.0,
        "unit": "patient-days/s",
        "ceiling": 0.25,
        "ratio": 4000.0,
        "runs": 3,
    }
    assert peer.error_figure([0.01, 0.025]) == {
        "name": "plant/vs-simglucose/error",
        "value": 0.025,
        "unit": "mg/dL",
        "ceiling": 0.05,
        "ratio": 0.5,
        "runs": 2,
    }


def test_our_rate_does_whole_days() -> None:
    day = peer.a_day(PATIENT.basal_u_per_h, PATIENT.carb_ratio_g_per_u)
    assert peer.our_rate(PATIENT, day, 2) > 1.0


# ---- where it cannot be had


def refused(capsys: pytest.CaptureFixture[str]) -> str:
    assert peer.compare(runs=1, days=1) == []
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("no figures beside simglucose: ")
    return err


def test_no_python_for_it(cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(peer, "PYTHON", (3, 2))
    assert "it needs Python 3.2" in refused(capsys)
    assert not cache.exists()


@pytest.mark.skipif(sys.version_info[:2] != peer.PYTHON, reason="elsewhere that Python is missing already")
def test_pip_finds_nothing(cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    assert "python -m pip failed: ERROR: No matching distribution found for simglucose==0.2.11" in refused(capsys)
    assert list(cache.iterdir()) == [], "half an environment was left"


def test_no_place_for_it(cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(peer, "find_python", lambda: sys.executable)
    cache.write_text("a file")
    assert "cannot write to" in refused(capsys)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("echo Traceback >&2; echo ImportError: no such thing >&2; exit 1", "its day failed: ImportError"),
        ("exit 3", "its day failed: status 3"),
        ("cat > /dev/null; echo hello", "its day gave no trace: 'hello"),
        ("cat > /dev/null; echo '{}'", "its day gave no trace"),
    ],
)
def test_it_does_not_do_its_day(cache: Path, capsys: pytest.CaptureFixture[str], script: str, words: str) -> None:
    fake_environment(cache / "simglucose", script)
    assert words in refused(capsys)


def test_a_complete_environment_is_reused_and_a_broken_one_replaced(cache: Path) -> None:
    place, building = cache / "simglucose", cache / "building"
    fake_environment(place, "exit 0")
    assert peer.environment_python() == place / "bin" / "python"

    (place / "pumpbench-complete.json").unlink()
    fake_environment(building, "exit 1")
    peer._move(building, place)
    assert (place / "bin" / "python").read_text().endswith("exit 1\n")
    assert peer.environment_python() == place / "bin" / "python"

    # another process was first: its environment stays
    fake_environment(building, "exit 2")
    peer._move(building, place)
    assert (place / "bin" / "python").read_text().endswith("exit 1\n")


def test_the_benchmark_asks_only_when_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for name in ("plant_alone", "round_trips", "_in_guest"):
        monkeypatch.setattr(closed_loop, name, lambda *_, **__: [])
    monkeypatch.setattr(closed_loop, "closed_loop", lambda *_, **__: [])
    for module in (closed_loop.parts, closed_loop.beside):
        monkeypatch.setattr(module, "figures", lambda **_: [])
    monkeypatch.setattr(closed_loop, "vcan_available", lambda: False)
    monkeypatch.setattr(peer, "compare", lambda **options: asked.append(options) or ["peer"])
    assert "peer" not in closed_loop.all_figures(quick=True, peers=False)
    assert asked == []
    assert "peer" in closed_loop.all_figures(quick=True)
    assert len(asked) == 1


@pytest.mark.skipif(os.environ.get("PUMPBENCH_PEERS") != "1", reason="installs simglucose: PUMPBENCH_PEERS=1")
def test_the_real_one() -> None:
    speed, error = peer.compare(runs=2, days=20)
    assert speed["ratio"] > 1000
    assert error["value"] < peer.ALLOWED_ERROR
