"""Sensors and scenarios in the closed loop, by the names that --sensor and --scenario take; nothing is written."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pumpbench import rig
from pumpbench.capture import Capture
from pumpbench.cli import options
from pumpbench.cli.statuses import status_of
from pumpbench.cli.terminal import EXIT_USAGE
from pumpbench.trace import Trace

from can_bus import codec
from can_bus.frame import Frame
from firmware_sim.firmware import Firmware
from plant_server.scenario import ScenarioError, built_in
from plant_server.sensor import SensorError
from plant_server.sensors import MODELS
from plant_server.server import PlantServer


def prepared(tmp_path: Path, **request: object) -> rig.Prepared:
    return rig.prepare(rig.Request(**({"patient": "adult#003", "out": tmp_path / "x", "steps": 25} | request)))  # type: ignore[arg-type]


def play(one: rig.Prepared) -> tuple[list[Frame], Trace]:
    capture = Capture()
    rig.Wires(PlantServer(one.run), Firmware(), None, capture).run(lambda step: None)
    frames = capture.finish()
    return frames.frames(0), Trace.from_frames(frames)


def count(frames: list[Frame]) -> Counter[str]:
    names = {codec.message(name).can_id: name for name in codec.messages()}
    return Counter(names[frame.can_id] for frame in frames)


@pytest.mark.parametrize("name", MODELS)
def test_every_sensor_runs_and_tells_its_status_hourly(name: str, tmp_path: Path) -> None:
    one = prepared(tmp_path, sensor=name)
    frames, trace = play(one)
    assert frames == play(one)[0]
    counted = count(frames)
    assert (counted["CGM_Reading"], counted["CGM_Status"]) == (26, 3)
    error = trace.get("GlucoseConc") - trace.get("TruthInterstitial")
    assert (np.nanmax(np.abs(error)) > 1) == (name != "ideal")
    ids = [frame.can_id for frame in frames]
    status = codec.message("CGM_Status").can_id
    assert all(ids[k + 1] == codec.message("CGM_Reading").can_id for k, can_id in enumerate(ids) if can_id == status)
    assert name in options.SENSORS


@pytest.mark.parametrize("name", built_in())
def test_every_scenario_runs(name: str, tmp_path: Path) -> None:
    one = prepared(tmp_path, scenario=name, steps=144, seed=5)
    assert one.run.scenario.name == name
    assert name in options.SCENARIOS
    _, trace = play(one)
    planned = sum(meal.carbs_g for meal in one.run.scenario.meals if meal.step <= 144)
    assert sum(meal.carbs_g for meal in trace.meals) == pytest.approx(planned, abs=0.1)
    other = prepared(tmp_path, scenario=name, steps=144, seed=6)
    drawn = name in ("tuning", "camerlingo")
    assert (other.run.scenario.meals != one.run.scenario.meals) == drawn
    hashes = [x.info["parameters"]["scenario_sha256"] for x in (one, other)]
    assert (hashes[0] != hashes[1]) == drawn


def test_a_sensor_file_reaches_the_bus(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        "model: dexcom-g6\nwarmup_minutes: 30\n"
        'effects: [{kind: drop_out, start: "01:00", end: "01:30"}, {kind: stuck, start: "01:30"}]\n'
    )
    one = prepared(tmp_path, sensor=str(file))
    frames, trace = play(one)
    assert count(frames)["CGM_Reading"] == 20
    glucose = trace.get("GlucoseConc")
    assert np.isnan(glucose[:6]).all()
    assert np.isnan(glucose[12:18]).all()
    assert len(set(glucose[18:])) == 1
    assert len(set(glucose[6:12])) == 6
    assert one.info["sensor"] == str(file)
    assert one.info["parameters"]["sensor_sha256"] != prepared(tmp_path).info["parameters"]["sensor_sha256"]


def test_sugar_against_a_low_is_in_the_record(tmp_path: Path) -> None:
    scenario, sensor = tmp_path / "scenario.yaml", tmp_path / "sensor.yaml"
    scenario.write_text("based_on: fasting\nrescue: {below: 80, samples: 2, carbs: 12, lockout_minutes: 60}\n")
    sensor.write_text("model: ideal\neffects: [{kind: bias, gain: 2.5}]\n")  # drives the patient low
    one = prepared(tmp_path, scenario=str(scenario), steps=144, sensor=str(sensor))
    frames, trace = play(one)
    glucose = trace.get("TruthGlucose")
    assert len(trace.meals) >= 2
    for meal in trace.meals:
        k = round(meal.time_s / 300)
        assert meal.carbs_g == pytest.approx(12, abs=0.02)
        assert max(glucose[k - 1], glucose[k]) < 80
    assert np.diff([meal.time_s for meal in trace.meals]).min() >= 3600
    assert play(one)[0] == frames


def test_days_beyond_a_fixed_scenario_are_an_error(tmp_path: Path) -> None:
    for name in ("tuning", "validation-14d"):
        with pytest.raises(rig.RigError, match=f"scenario {name} has 14 days, asked for 15"):
            prepared(tmp_path, scenario=name, steps=15 * 288)
    assert prepared(tmp_path, scenario="camerlingo", steps=15 * 288).run.scenario.days == 15


def test_wrong_names_are_usage_errors(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match="did you mean dexcom-g6"):
        prepared(tmp_path, sensor="dexcom-g66")
    with pytest.raises(ScenarioError, match="did you mean tuning"):
        prepared(tmp_path, scenario="tunning")
    for error in (SensorError("x"), ScenarioError("x")):
        assert status_of(error) == EXIT_USAGE


PAGE = (Path(__file__).parents[1] / "docs" / "sensors-and-scenarios.md").read_text(encoding="utf-8")


def test_the_page_has_every_sensor_and_scenario() -> None:
    sensors, scenarios = PAGE.split("\n## Scenarios")
    rows = r"^\| `([a-z0-9-]+)`"
    assert re.findall(rows, sensors.split("### Effects")[0], re.M) == list(MODELS)
    assert sorted(re.findall(rows, scenarios, re.M)) == sorted(built_in())


@pytest.mark.parametrize("option", ["sensor", "scenario"])
def test_the_pages_examples_run(option: str, tmp_path: Path) -> None:
    example = next(text for text in re.findall(r"```yaml\n(.*?)```", PAGE, re.S) if text.startswith(f"# {option}.yaml"))
    file = tmp_path / f"{option}.yaml"
    file.write_text(example)
    play(prepared(tmp_path, **{option: str(file)}))
