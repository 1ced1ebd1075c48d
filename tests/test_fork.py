"""Runs that begin as a recorded one: the same bytes when nothing is changed, and what may be changed from then on."""

import itertools
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, Pumpbench
from pumpbench import bench, faults
from pumpbench.bench import Outcome
from pumpbench.calibration import MODES
from pumpbench.fork import ForkError
from pumpbench.rewind import Diverged, Origin, before, join
from pumpbench.runfolder import RunFolder

from can_bus import codec
from can_bus.lockstep import STEP_SECONDS
from plant_server.sensors import MODELS

DISTURBED = [
    faults.flip_bits("CTRL_Status", random=3, start="05:20", end="05:40"),  # taken out by a fork with other faults
    faults.drop("CGM_Reading", start="02:00", end="02:40", probability=0.7),
    faults.restart(start="01:30", end="01:40"),
    faults.restart(start="01:50", after_frames=2),
    faults.delay("PUMP_BasalCmd", steps=3, start="03:00", end="04:00", probability=0.5),
    faults.replay("CGM_Reading", start="04:00", end="04:10"),
    faults.hang(start="04:10", end="04:20"),
    faults.slow_motor(start="01:00", end="01:25"),
    faults.occlusion(start="04:30", end="05:00"),
    faults.noise(start="02:30", end="05:30"),
    faults.babble(frames=3, start="03:20", end="03:30"),
]
INSTANTS = {
    "00:00": "before anything",
    "01:10": "a bolus is under way",
    "01:35": "the device has no power",
    "01:40": "it is about to have it again",
    "01:55": "it has restarted in the middle of a turn",
    "02:20": "samples are dropped",
    "03:25": "commands are delayed",
    "04:05": "samples are replayed",
    "04:15": "the device hangs",
    "04:45": "the line is blocked",
    "05:55": "the last step",
}
pytest_plugins = ["pytester"]

SIX_HOURS = ("run", "--strategy", "s4", "--scenario", "six-hours", "--days", "0.25")


@pytest.fixture(scope="module")
def disturbed() -> Outcome:
    return bench.run(strategy="s4", scenario="six-hours", hours=6, faults=DISTURBED)


@pytest.fixture(scope="module")
def plain() -> Outcome:
    return bench.run(strategy="s4", scenario="six-hours", hours=6)


@pytest.fixture(scope="module")
def written(plain: Outcome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the plain run."""
    return replace(plain).write(tmp_path_factory.mktemp("plain") / "whole")


def step(at: str) -> int:
    return faults.Faults.of([faults.drop("HB_PUMP", start=at)]).wire[0].start // STEP_SECONDS


def same(one: Outcome, other: Outcome) -> bool:
    return one.frames.sha256() == other.frames.sha256()


def first_difference(one: Outcome, other: Outcome) -> int:
    """The first step in which two runs differ on the device's bus."""
    ours, theirs = one.frames.frames(), other.frames.frames()
    row = next(row for row, pair in enumerate(itertools.zip_longest(ours, theirs)) if pair[0] != pair[1])
    longer = one if len(ours) > len(theirs) else other
    return int(longer.frames.step[longer.frames.channel == 0][row])


# ---- nothing is changed


@pytest.mark.parametrize("at", INSTANTS, ids=list(INSTANTS.values()))
def test_nothing_changed_is_the_same_run(disturbed: Outcome, at: str) -> None:
    assert same(bench.fork(disturbed, at).run(), disturbed)


def test_the_instants_are_what_they_are_called(disturbed: Outcome) -> None:
    """So that the test above tests what it says."""

    def state(message: str, signal: str, at: str) -> list[int]:
        chosen = disturbed.frames
        rows = np.flatnonzero(
            (chosen.channel == 0) & (chosen.step == step(at)) & (chosen.can_id == codec.message(message).can_id)
        )
        return [codec.message(message).unpack(chosen.frame(int(row)).data)[signal] for row in rows]

    assert 2 in state("PUMP_BolusState", "BolusPhase", "01:10")  # delivering
    acting = {(event.kind, int(event.time_s) // STEP_SECONDS) for event in disturbed.trace.faults}
    assert ("Drop", step("02:20") - 1) in acting or ("Drop", step("02:20")) in acting
    delayed = [at for kind, at in acting if kind == "Delay"]
    assert any(step("03:25") - 3 < at < step("03:25") for at in delayed)  # still pending at 03:25
    assert not state("CTRL_Status", "CtrlState", "01:35") and not state("CTRL_Status", "CtrlState", "04:15")
    assert state("PUMP_Status", "PumpState", "04:45") and ("Occlusion", step("04:45")) in acting


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_goes_on_as_it_was(mode: str) -> None:
    whole = bench.run(strategy=mode, scenario="six-hours", hours=5)
    assert same(bench.fork(whole, "03:05").run(), whole)


@pytest.mark.parametrize("sensor", MODELS)
def test_every_sensor_goes_on_with_its_noise(sensor: str) -> None:
    whole = bench.run(strategy="nma", scenario="six-hours", hours=5, sensor=sensor)
    assert same(bench.fork(whole, "02:05").run(), whole)


@pytest.mark.parametrize("scenario", ["validation-14d", "tuning", "camerlingo"])
def test_every_scenario_goes_on_over_midnight(scenario: str) -> None:
    whole = bench.run(strategy="ma", scenario=scenario, hours=30)
    assert same(bench.fork(whole, "1+00:10").run(), whole)


def test_a_fork_of_a_fork_of_a_fork(disturbed: Outcome) -> None:
    """What was changed on the way is done again, too."""
    once = bench.fork(disturbed, "02:10").run(faults=[faults.drop("CGM_Reading", start="03:00", end="03:20")])
    twice = bench.fork(once, "03:10").run(strategy="nma")
    thrice = bench.fork(twice, "04:00").run(scenario="fasting", hours=8)
    assert same(bench.fork(twice, "05:00").run(), twice)
    assert same(bench.fork(thrice, "06:30").run(), thrice)
    assert same(bench.fork(thrice, "01:00").run(), thrice)  # changes to come stay, too


def test_the_folder_is_that_of_the_whole_run(disturbed: Outcome, tmp_path: Path) -> None:
    folder = disturbed.write(tmp_path / "whole")
    fork = bench.fork(folder, "03:25").run(out=tmp_path / "fork")
    again = RunFolder.load(tmp_path / "fork")
    assert again.info["trace_sha256"] == disturbed.frames.sha256()
    assert again.info["fork"] == {"of": disturbed.frames.sha256(), "at": "03:25", "step": 41}
    assert (tmp_path / "fork" / "bus.log").read_bytes() == (folder / "bus.log").read_bytes()
    assert again.metrics == RunFolder.load(folder).metrics
    assert fork.folder == tmp_path / "fork"


# ---- on a bus, each node a process


def fault_file(folder: Path, given: list[object]) -> Path:
    path = folder / "faults.yaml"
    path.write_text(faults.dump(given), encoding="utf-8")
    return path


@pytest.mark.nightly
def test_on_a_hub_the_same_bytes(disturbed: Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench(*SIX_HOURS, "--faults", fault_file(runs, DISTURBED), "--out", "whole")
    assert done.returncode == 0, done.stderr
    for at in ("00:00", "01:35", "03:25", "04:45"):
        done = pumpbench("run", "--from", f"whole@{at}", "--out", "fork", "--overwrite")
        assert done.returncode == 0, done.stderr
        assert RunFolder.load(runs / "fork").info["trace_sha256"] == disturbed.frames.sha256()
    done = pumpbench("run", "--from", "whole@03:25", "--bus", "inproc", "--out", "inproc")
    assert done.returncode == 0, done.stderr
    assert RunFolder.load(runs / "inproc").info["trace_sha256"] == disturbed.frames.sha256()


def test_a_gateway_that_comes_with_the_fork(plain: Outcome, tmp_path: Path) -> None:
    """Before the instant both its buses are the one of the record."""
    lost = [faults.drop("CGM_Reading", start="03:00", end="03:40")]
    here = bench.fork(plain, "02:30").run(faults=lost)
    there = bench.fork(plain, "02:30").run(faults=lost, bus="hub", out=tmp_path / "fork")
    assert same(here, there)
    assert {0, 1} == set(here.frames.channel.tolist())
    assert first_difference(here, plain) == step("03:00")
    gone = bench.fork(there, "02:45").run(faults=[], bus="hub", out=tmp_path / "gone")
    assert same(gone, plain)


@pytest.mark.vcan
def test_between_vcan0_and_vcan1_the_same_bytes(disturbed: Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    bus = ("--bus", "socketcan:vcan0")
    done = pumpbench(*SIX_HOURS, *bus, "--faults", fault_file(runs, DISTURBED), "--out", "whole")
    assert done.returncode == 0, done.stderr
    done = pumpbench("run", "--from", "whole@03:25", "--out", "fork")
    assert done.returncode == 0, done.stderr
    fork = RunFolder.load(runs / "fork")
    assert fork.info["bus"] == "socketcan:vcan0"
    assert fork.info["trace_sha256"] == disturbed.frames.sha256()


# ---- other faults


def test_another_fault_changes_what_comes_after_it_and_nothing_before(disturbed: Outcome) -> None:
    lost = [faults.drop("CGM_Reading", start="04:50", end="05:30")]
    fork = bench.fork(disturbed, "03:25")
    one, other = fork.run(faults=lost), fork.run(faults=lost)
    assert same(one, other)
    assert first_difference(one, disturbed) == step("04:00")  # the replay that had not begun is gone
    one.assert_alarm("CgmLost", after="04:50", within="00:25")
    assert not [event for event in one.raised("Occlusion", "PUMP") if event.time_s > 4 * 3600]


def test_a_fault_that_has_begun_goes_on_to_its_end_with_its_own_random_numbers(disturbed: Outcome) -> None:
    """Also when one that stood before it in the list is taken out."""
    fork = bench.fork(disturbed, "03:25").run(faults=[])
    kinds = [(fault["kind"], fault.get("place")) for fault in fork.info["faults"]]
    wire = [("drop", 1), ("restart", None), ("restart", None), ("delay", 2), ("babble", 4)]
    assert kinds == [*wire, ("slow_motor", None), ("noise", None)]
    assert first_difference(fork, disturbed) == step("04:00")


def test_of_two_faults_of_a_kind_each_draws_its_own_numbers(plain: Outcome) -> None:
    """The new one does not take the place of one that goes on."""
    begun = bench.fork(plain, "01:00").run(faults=[faults.drop("HB_CGM", start="01:00", probability=0.5)])
    both = bench.fork(begun, "03:00").run(faults=[faults.drop("HB_PUMP", start="03:00", probability=0.5)])
    hit: dict[int, list[int]] = {}
    inject = codec.message("FAULT_Inject")
    chosen = both.frames.select((both.frames.channel == 0) & (both.frames.can_id == inject.can_id))
    for frame, at in zip(chosen.frames(), chosen.step.tolist(), strict=True):
        hit.setdefault(inject.unpack(frame.data)["FaultCanId"], []).append(at)
    old, new = ({at - min(hit[can_id]) for at in hit[can_id]} for can_id in (0x703, 0x702))
    assert new != {at for at in old if at <= max(new)}


def test_faults_of_pump_and_sensor_from_the_instant_on(plain: Outcome) -> None:
    fork = bench.fork(plain, "02:00")
    blocked = fork.run(faults=[faults.occlusion(start="02:00")])
    blocked.assert_alarm("Occlusion", node="PUMP", after="02:00", within="03:30")
    assert first_difference(blocked, plain) == step("02:00")
    stuck = fork.run(faults=[faults.stuck(value=200, start="03:00", end="03:20")])
    assert first_difference(stuck, plain) == step("03:00")
    replaced = fork.run(faults=[faults.replacement(start="03:00")], hours=5)
    assert first_difference(replaced, plain) == step("03:00")


def test_a_device_that_dies_in_the_fork(plain: Outcome) -> None:
    dead = bench.fork(plain, "02:00").run(faults=[faults.kill(start="03:00")])
    dead.assert_alarm("CtrlLost", node="PUMP", after="03:00", within="00:25")
    assert first_difference(dead, plain) == step("03:00")


# ---- another strategy, scenario, length


def test_another_strategy_by_mode_cmd(plain: Outcome) -> None:
    fork = bench.fork(plain, "02:30").run(strategy="nma")
    assert first_difference(fork, plain) == step("02:30")
    modes = fork.trace.get("CtrlMode")
    assert modes[step("02:25")] == MODES["s4"] and modes[step("02:30")] == MODES["nma"]
    fork.assert_no_hazards()
    assert "PumpbenchS4" not in fork.title
    announced = [step for step, frame in enumerate(fork.trace.get("LastMealId")) if frame == 1]
    assert not announced  # nobody tells nma of the meal at 04:30
    assert fork.info["strategy"] == "s4"
    assert [(each["at"], each["strategy"]) for each in fork.info["changes"]] == [("02:30", "nma")]


def test_a_device_that_does_not_take_up_the_mode(plain: Outcome) -> None:
    from plant_server.server import PlantError

    deaf = [faults.drop("MODE_Cmd", start="02:30", end="02:35")]
    with pytest.raises(PlantError, match="did not take up mode InsulinNMA: it reports PramS4_RatioSMA"):
        bench.fork(plain, "02:30").run(strategy="nma", faults=deaf)


def test_other_meals_from_the_instant_on(plain: Outcome, tmp_path: Path) -> None:
    path = tmp_path / "late.yaml"
    path.write_text(
        'meals:\n  - {day: 1, time: "01:10", type: Snack, carbs: 50}\n'
        '  - {day: 1, time: "02:30", type: Lunch, carbs: 80}\n'
        "announcements: {ahead_minutes: 15}\n"
    )
    fork = bench.fork(plain, "02:20").run(scenario=str(path))
    told = [at for at, carbs in enumerate(fork.trace.get("TruthMealCarbs")) if carbs > 0]
    assert told == [step("01:00"), step("02:30")]  # the snack at 01:10 is past, the one at 03:00 is of the old scenario
    assert first_difference(fork, plain) == step("02:20")  # told at once: it would have been told at 02:15
    assert same(bench.fork(fork, "03:00").run(), fork)
    path.write_text('meals:\n  - {day: 1, time: "02:30", type: Lunch, carbs: 81}\n')
    with pytest.raises(ForkError, match="a scenario of it is not what it was"):
        bench.fork(fork, "03:00").run()


def test_sugar_against_lows_from_the_instant_on(plain: Outcome, tmp_path: Path) -> None:
    path = tmp_path / "careful.yaml"
    path.write_text("based_on: six-hours\nrescue: {below: 100, samples: 1, lockout_minutes: 1440}\n")
    high = [faults.set_value("CGM_Reading", "GlucoseConc", 300, start="02:20")]
    without = bench.fork(plain, "02:20").run(faults=high)
    fork = bench.fork(plain, "02:20").run(scenario=str(path), faults=high)
    below = int(np.flatnonzero(without.glucose[step("02:20") :] < 100)[0]) + step("02:20")
    eaten = fork.trace.get("TruthMealCarbs") - without.trace.get("TruthMealCarbs")
    assert np.flatnonzero(eaten).tolist() == [below] and eaten[below] == 15.0
    assert same(bench.fork(fork, "05:50").run(), fork)


def test_a_longer_run_and_a_shorter_one(plain: Outcome) -> None:
    longer = bench.run(strategy="s4", scenario="six-hours", hours=9)
    assert same(bench.fork(plain, "06:00").run(hours=9), longer)
    assert same(bench.fork(longer, "04:00").run(hours=6), plain)


# ---- another firmware


OPEN_LOOP = f"{sys.executable} {ROOT / 'examples' / 'open_loop_firmware.py'} {{bus}}"
REFERENCE = f"{sys.executable} -m firmware_sim --bus {{bus}}"


@pytest.fixture(scope="module")
def lost(plain: Outcome) -> Outcome:
    return bench.fork(plain, "00:00").run(
        faults=[faults.drop("CGM_Reading", start="01:00", end="01:10")], strategy="nma"
    )


def test_another_build_that_does_the_same_is_the_same_run(lost: Outcome) -> None:
    assert same(bench.fork(lost, "03:00").run(firmware=REFERENCE, bus="hub"), lost)


@pytest.mark.nightly
def test_another_firmware_takes_over_at_the_instant(lost: Outcome, caplog: pytest.LogCaptureFixture) -> None:
    fork = bench.fork(lost, "03:00").run(firmware=OPEN_LOOP, bus="hub")
    assert "answers otherwise than the recorded one since 00:00: CFG_ParamEcho" in caplog.text
    assert first_difference(fork, lost) == step("03:00")
    assert fork.info["fork"]["firmware_since"] == step("03:00")
    assert fork.state("02:55") == "Auto" and fork.state("03:00") == "SafeBasal"
    assert same(bench.fork(fork, "04:00").run(bus="hub"), fork)
    with pytest.raises(ForkError, match="its firmware answers from 03:00 on only"):
        bench.fork(fork, "02:00").run(bus="hub")
    back = bench.fork(fork, "04:00").run(bus="hub", firmware="built-in")
    assert back.info["firmware"] == "built-in"
    assert first_difference(back, fork) == step("04:00")


COUNTS_FROM_SEVEN = """
import sys
sys.path.insert(0, sys.argv[2])
import open_loop_firmware as firmware

class Counters(dict):
    def get(self, name, default):
        return super().get(name, 7)

def reset(device, before=firmware.Device.reset):
    before(device)
    device.counters = Counters()

firmware.Device.reset = reset
with firmware.open_bus(sys.argv[1]) as bus:
    firmware.Device(bus).run()
"""


def test_a_firmware_whose_files_have_changed_is_another_one(lost: Outcome) -> None:
    info = {**lost.info, "firmware_sha256": {"firmware_sim": "0"}}
    rebuilt = Outcome(lost.frames, lost.trace, lost.metrics, None, info)
    with pytest.raises(ForkError, match=r"the files of its firmware \(built-in\) are not what they were"):
        bench.fork(rebuilt, "03:00").run()
    assert same(bench.fork(rebuilt, "03:00").run(firmware="built-in"), lost)


def test_whoever_takes_over_has_counted_its_own_frames(lost: Outcome, tmp_path: Path) -> None:
    """Its COUNTER has nothing to do with that of the recorded device."""
    (tmp_path / "seven.py").write_text(COUNTS_FROM_SEVEN)
    command = f"{sys.executable} {tmp_path / 'seven.py'} {{bus}} {ROOT / 'examples'}"
    fork = bench.fork(lost, "03:00").run(firmware=command, bus="hub")
    assert fork.state("03:00") == "SafeBasal"
    assert not fork.raised("CtrlLost", "PUMP")
    last = fork.frames.select((fork.frames.channel == 1) & (fork.frames.step == step("03:00") + 1))
    acks = [
        codec.message("PUMP_Ack").unpack(frame.data)
        for frame in last.frames(1)
        if frame.can_id == codec.message("PUMP_Ack").can_id
    ]
    assert acks and all(ack["AckResult"] == 0 for ack in acks)


# ---- what is refused


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["whole@03:02"], "the instants of a run are 5 min apart; give a multiple, e.g. 03:00"),
        (["whole@06:05"], "whole@06:05: the run has instants from 00:00 to 06:00"),
        (["whole@06:00"], "nothing comes after the end at 06:00; give more --days"),
        (["whole@03:00", "--days", "0.125"], "nothing comes after the end at 03:00"),
        (["whole@noon"], 'a time is "hh:mm"'),
        (["whole"], "expected RUN@hh:mm or RUN@days+hh:mm"),
        (["nowhere@03:00"], "there is no run folder nowhere"),
        (["cut.partial@03:00"], "cut.partial is unfinished"),
        (["changed@03:00"], "was changed: its frames do not have the hash"),
        (["whole@03:00", "--faults", "faults.yaml"], "drop starts at 02:55, before the fork at 03:00"),
        (["whole@03:00", "--seed", "2"], "--seed cannot change on the way"),
        (["whole@03:00", "--patient", "adult#002"], "--patient cannot change on the way"),
        (["whole@03:00", "--scenario", "nowhere"], "there is no scenario 'nowhere'"),
        (["foreign@03:00"], "was recorded with another pumpbench.dbc: CRC-32 00000000"),
        (["free@03:00"], "was a free run"),
        (["heard@03:00"], "heard: its run.json does not say how long the run was"),
    ],
)
def test_one_line_says_what_is_wrong(
    written: Path, pumpbench: Pumpbench, runs: Path, arguments: list[str], text: str
) -> None:
    name = arguments[0].partition("@")[0]
    whole = runs / (name if name in ("changed", "foreign", "free", "heard") else "whole")
    shutil.copytree(written, whole)
    info = json.loads((whole / "run.json").read_text())
    info |= {"foreign": {"dbc_crc32": "00000000"}, "free": {"free_running": True}}.get(name, {})
    if name == "heard":
        del info["steps"]
    (whole / "run.json").write_text(json.dumps(info))
    if name == "changed":
        log = whole / "bus.log"
        log.write_text(log.read_text().replace("\n", "\n(0.000001) can0 7FF#\n", 1))
    (runs / "cut.partial").mkdir()
    fault_file(runs, [faults.drop("CGM_Reading", start="02:55")])
    done = pumpbench("run", "--from", *arguments, "--out", "fork")
    assert done.returncode == 2, done.stdout + done.stderr
    assert text in done.stderr and len(done.stderr.splitlines()) == 1
    assert not (runs / "fork").exists() and not (runs / "fork.partial").exists()


def changed(outcome: Outcome, message: str, at: str, channel: int = 0) -> Outcome:
    """The run with one byte of its record changed."""
    frames = outcome.frames
    data = frames.data.copy()
    chosen = (frames.can_id == codec.message(message).can_id) & (frames.step == step(at)) & (frames.channel == channel)
    data[np.flatnonzero(chosen)[0], 5] ^= 1
    return Outcome(replace(frames, data=data), outcome.trace, outcome.metrics, None, outcome.info)


@pytest.mark.parametrize(
    ("message", "who"), [("CTRL_Status", "the device"), ("PUMP_Status", "the plant"), ("CFG_ParamEcho", "the device")]
)
def test_what_does_not_come_out_as_recorded_is_named(plain: Outcome, message: str, who: str) -> None:
    at = "00:00" if message == "CFG_ParamEcho" else "02:00"
    other = changed(plain, message, at)
    expected = rf"not as recorded at {at} \(step {step(at)}\): the record has {message} .*, now {who} says {message} "
    with pytest.raises(Diverged, match=expected):
        bench.fork(other, "03:00").run()
    if at != "00:00":
        bench.fork(other, "01:55").run()  # what comes later is none of its business


def test_on_a_bus_it_is_named_too(plain: Outcome, pumpbench: Pumpbench, runs: Path) -> None:
    changed(plain, "CTRL_Status", "02:00").write(runs / "whole")
    done = pumpbench("run", "--from", "whole@03:00", "--bus", "hub", "--out", "fork")
    assert done.returncode == 3
    assert done.stderr.startswith("pumpbench: not as recorded at 02:00 (step 24): the record has CTRL_Status ")
    assert len(done.stderr.splitlines()) == 1


def test_the_device_s_bus_is_compared_as_well(disturbed: Outcome) -> None:
    """A frame that the gateway kept from the plant."""
    origin = Origin(changed(disturbed, "PUMP_BasalCmd", "02:00").frames, step("03:00"))
    with pytest.raises(Diverged, match=r"step 24\): the record has PUMP_BasalCmd .*, now the bus had PUMP_BasalCmd "):
        join(origin, disturbed.frames)
    shorter = disturbed.frames.select(~before(disturbed.frames, 0))
    with pytest.raises(Diverged, match=r"step 0\): the record has HB_PUMP "):
        join(Origin(disturbed.frames, step("03:00")), shorter)


def test_a_run_json_that_says_too_little(plain: Outcome) -> None:
    info = {name: value for name, value in plain.info.items() if name != "sensor"}
    old = Outcome(plain.frames, plain.trace, plain.metrics, None, info)
    with pytest.raises(ForkError, match="does not say what the run was made of"):
        bench.fork(old, "03:00").run()
    other = {**plain.info, "parameters": {**plain.info["parameters"], "patient_sha256": "0"}}
    with pytest.raises(ForkError, match="its patient is not what it was when the run was made"):
        bench.fork(Outcome(plain.frames, plain.trace, plain.metrics, None, other), "03:00").run()


# ---- in the tests of a firmware


TEST = """
import pytest
from pumpbench.faults import drop

@pytest.fixture(scope="module")
def red(request):
    from pumpbench import bench
    return bench.run(strategy="nma", scenario="six-hours", hours=3)

@pytest.mark.parametrize("minutes", [10, 20, 30])
def test_sensor_lost(bench, red, minutes):
    outcome = bench.fork(red, at="02:00").run(faults=[drop("CGM_Reading", start="02:00", end=f"02:{minutes}")])
    assert outcome.frames.step.max() == 36
    if minutes > 15:
        outcome.assert_alarm("CgmLost", after="02:00", within="00:25")
    assert outcome.info["bus"] == "hub" and outcome.folder is not None
    assert minutes < 30, "to see what is kept"
"""


@pytest.mark.nightly
def test_continuations_in_the_pytest_plugin(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(TEST)
    result = pytester.runpytest_subprocess(
        "-p", "no:cacheprovider", "--pumpbench-bus", "hub", "--pumpbench-firmware", REFERENCE
    )
    result.assert_outcomes(passed=2, failed=1)
    result.stdout.fnmatch_lines(["*pumpbench run 0*", "recording: *recording.rrd"])
