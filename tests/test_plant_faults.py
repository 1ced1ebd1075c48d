"""Faults of the pump's motor and of the sensor: counted in strokes, told on the bus, and who sees them."""

from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pumpbench import bench, rig
from pumpbench import faults as fault_files
from pumpbench.capture import Capture
from pumpbench.catalogue import entries
from pumpbench.faults import Faults
from pumpbench.signals import labels

from can_bus.yaml_file import FileError
from firmware_sim.firmware import Firmware
from plant_server import mechanism
from plant_server.chamber import INSULIN, PRAMLINTIDE, Chamber
from plant_server.faults import AnyPumpFault, DoubleStrokes, EmptyReservoir, MissedStrokes, Occlusion, SlowMotor
from plant_server.injected import Injected
from plant_server.mechanism import (
    ACCUMULATED,
    BOLUS_DELIVERED,
    COMMANDED,
    DELIVERED,
    DOUBLE_EVERY,
    FLUID,
    LOST,
    MISS_EVERY,
    PENDING,
    SLOWED,
)
from plant_server.sensor import Sensor, SensorSettings
from plant_server.sensors.effects import EFFECTS, CompressionLow, DropOut, Effect, Lag, Noise, Replacement, Stuck
from plant_server.server import PlantServer

KINDS: tuple[type[Injected], ...] = (*get_args(AnyPumpFault), *EFFECTS.values())
EXAMPLES = [entry.fault for entry in entries() if type(entry.fault) in KINDS]
EVERY = st.integers(1, 7)


def name_of(fault: Any) -> str:
    return " ".join(map(str, fault.model_dump(mode="json", exclude_defaults=True).values())) + f" {fault.kind}"


# ---- strokes, beside a sound motor that is asked for the same


def pair(**words: int) -> tuple[Chamber, Chamber]:
    """A sound chamber and one with these words set."""
    sound, faulty = Chamber(INSULIN), Chamber(INSULIN)
    for name, value in words.items():
        faulty.words[getattr(mechanism, name)] = value
    return sound, faulty


RATES = st.lists(st.integers(0, 30000), min_size=1, max_size=30)


@settings(max_examples=100, deadline=None)
@given(RATES, EVERY)
def test_missed_strokes_are_commanded_and_lost_and_nothing_else(rates: list[int], every: int) -> None:
    sound, faulty = pair(MISS_EVERY=every)
    for rate in rates:
        for chamber in (sound, faulty):
            chamber.run(rate)
        made = int(sound.words[DELIVERED])
        assert faulty.words[LOST] == made // every
        assert faulty.words[DELIVERED] == made - made // every
        assert faulty.words[FLUID] == INSULIN.capacity - faulty.words[DELIVERED]
        assert (faulty.words[[ACCUMULATED, COMMANDED, PENDING]] == sound.words[[ACCUMULATED, COMMANDED, PENDING]]).all()
        assert mechanism.ledger_closes(faulty.words)


@settings(max_examples=100, deadline=None)
@given(RATES, EVERY)
def test_double_strokes_are_commanded_by_the_motor_and_delivered(rates: list[int], every: int) -> None:
    sound, faulty = pair(DOUBLE_EVERY=every)
    for rate in rates:
        for chamber in (sound, faulty):
            chamber.run(rate)
        made = int(sound.words[DELIVERED])
        assert faulty.words[DELIVERED] == made + made // every
        assert faulty.words[COMMANDED] == sound.words[COMMANDED] + made // every
        assert faulty.words[FLUID] == INSULIN.capacity - faulty.words[DELIVERED]
        assert (faulty.words[LOST], faulty.words[PENDING]) == (0, sound.words[PENDING])
        assert mechanism.ledger_closes(faulty.words)


@pytest.mark.parametrize("strokes", [1, 4, 15])
def test_a_slow_motor_makes_its_strokes_later(strokes: int) -> None:
    sound, faulty = pair(SLOWED=15 - strokes)
    for chamber in (sound, faulty):
        mechanism.begin_bolus(chamber.words, 100)
    for _ in range(15):
        for chamber in (sound, faulty):
            chamber.run(2000)
        assert mechanism.ledger_closes(faulty.words)
        assert max(faulty._out) <= strokes * 0.05 + 1e-9
        assert faulty.words[LOST] == 0
        late = int(sound.words[DELIVERED] - faulty.words[DELIVERED])
        assert faulty.words[PENDING] == sound.words[PENDING] + late
    made = int(faulty.words[DELIVERED])
    assert made == min(150 * strokes, int(sound.words[DELIVERED]))
    faulty.mend()
    for chamber in (sound, faulty):
        chamber.run(2000)
    assert (faulty.words == sound.words).all()


def test_a_boluss_own_count_goes_by_what_was_asked_for() -> None:
    counts = []
    for words in ({"MISS_EVERY": 4}, {"DOUBLE_EVERY": 4}, {"MISS_EVERY": 1}):
        _, chamber = pair(**words)
        chamber.insert_air(8)
        mechanism.begin_bolus(chamber.words, 40)
        chamber.run(0)
        counts.append((int(chamber.words[BOLUS_DELIVERED]), chamber.delivered, int(chamber.words[LOST])))
    # 10 of the 40 slip and 8 volumes are air; 10 move twice as much, of the first 18 volumes 8 are air and at most a
    # stroke each is the bolus's; the motor turns and moves not even air
    assert counts == [(22, 22, 18), (35, 42, 8), (0, 0, 40)]


ACTIONS = st.sampled_from(
    ["run", "run", "bolus", "end", "occlude", "release", "lose", "air", "empty", "change", "miss", "double", "slow"]
)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(ACTIONS, st.integers(0, 40000)), max_size=60))
def test_the_ledger_closes_whatever_is_wrong_with_the_motor(actions: list[tuple[str, int]]) -> None:
    chamber = Chamber(PRAMLINTIDE)
    words = chamber.words
    arrived, bolus, bolus_open = 0.0, 0, False
    for action, number in actions:
        before = words.copy()
        if action == "run":
            arrived += float(chamber.run(number // 8).sum())
        elif action == "bolus" and not words[mechanism.BOLUS] and not words[mechanism.BOLUS_HELD]:
            bolus, bolus_open = number % 200, True
            mechanism.begin_bolus(words, bolus)
        elif action == "end":
            mechanism.end_bolus(words)
        elif action == "occlude":
            chamber.occlude()
        elif action in ("release", "lose"):
            chamber.release(lost=action == "lose")
        elif action == "air":
            chamber.insert_air(number % 50)
        elif action == "empty":
            words[FLUID] = 0
        elif action == "change":
            chamber.change()
        elif action in ("miss", "double"):
            every, since = (
                (MISS_EVERY, mechanism.MISS_SINCE) if action == "miss" else (DOUBLE_EVERY, mechanism.DOUBLE_SINCE)
            )
            words[every], words[since] = number % 5, 0
        elif action == "slow":
            words[SLOWED] = number % 15
        assert mechanism.ledger_closes(words), (action, number, words)
        for word in (COMMANDED, DELIVERED, LOST):
            assert words[word] >= before[word]
        assert not bolus_open or words[BOLUS_DELIVERED] <= bolus
        assert arrived == pytest.approx(chamber.delivered * 0.5)


# ---- in a run


class Watched(PlantServer):
    """The plant, and the words of its insulin motor at every instant."""

    def __init__(self, run: Any) -> None:
        super().__init__(run)
        self.words = [self.pump.insulin.words.copy()]

    def _advance(self) -> None:
        super()._advance()
        self.words.append(self.pump.insulin.words.copy())


def play(*faults: Any, mode: str = "ma", hours: int = 5, sensor: str = "coloured") -> tuple[bench.Outcome, np.ndarray]:
    request = rig.Request(
        "adult#003", Path("unwritten"), mode, "six-hours", hours * 12, faults=Faults.of(faults), sensor=sensor
    )
    prepared = rig.prepare(request)
    plant, capture = Watched(prepared.run), Capture()
    rig.Wires(plant, Firmware(), None, capture).run(lambda step: None)
    return bench.Outcome.of(capture.finish(), prepared.info), np.array(plant.words)


def since_start(words: np.ndarray, word: int, start: int) -> np.ndarray:
    return words[start:, word] - words[start, word]


def told(outcome: bench.Outcome) -> list[tuple[int, str, str, int]]:
    events = outcome.trace.faults
    assert all(event.param == event.time_s // 300 and event.count == 1 for event in events)
    return [(event.param, event.kind, event.target, event.count) for event in events]


@pytest.mark.parametrize("every", [1, 2, 5])
def test_strokes_missed_in_a_run(every: int) -> None:
    outcome, words = play(MissedStrokes(every=every, start="00:50", end="02:30"))
    lost, delivered = (since_start(words, word, 10) for word in (LOST, DELIVERED))
    assert (lost[:21] == (lost + delivered)[:21] // every).all()
    assert lost[20] > 20 // every  # a bolus and its basal insulin
    assert (lost[20:] == lost[20]).all()
    assert not words[:11, LOST].any()
    assert outcome.hazards == {}
    outcome.assert_ledger_closes()
    assert told(outcome) == [(step, "MissedStrokes", "PUMP", 1) for step in range(10, 30)]
    phase, programmed, got = (outcome.trace.get(f"{name}[Insulin]")[14] for name in
                              ("BolusPhase", "BolusProgrammedRaw", "BolusDeliveredRaw"))  # fmt: skip
    assert phase == 4  # Aborted: the pump tells what has arrived
    assert got == pytest.approx(programmed * (1 - 1 / every), abs=5)


@pytest.mark.parametrize("every", [1, 2, 5])
def test_strokes_doubled_in_a_run(every: int) -> None:
    outcome, words = play(DoubleStrokes(every=every, start="00:50", end="02:30"))
    commanded, delivered = (since_start(words, word, 10) for word in (COMMANDED, DELIVERED))
    motor = delivered[20] * every // (every + 1)  # made, of which every nth counts twice
    assert delivered[20] in (motor + motor // every, motor + 1 + (motor + 1) // every)
    assert not words[:, LOST].any()
    assert (commanded - delivered == words[10:, PENDING] - words[10, PENDING]).all()
    assert outcome.hazards == {}
    outcome.assert_ledger_closes()
    assert told(outcome) == [(step, "DoubleStrokes", "PUMP", 1) for step in range(10, 30)]
    trace = outcome.trace
    phase, programmed, got = (trace.get(f"{name}[Insulin]")[14] for name in
                              ("BolusPhase", "BolusProgrammedRaw", "BolusDeliveredRaw"))  # fmt: skip
    assert (phase, got) == (3, programmed // 5 * 5)  # a rest below a stroke is not given
    asked = got / 100 + np.nansum(trace.get("InsulinRate")[10:20]) / 12
    total = trace.get("InsulinTotal")[20] - trace.get("InsulinTotal")[10]  # what a careful controller could compare
    assert total == pytest.approx(asked * (1 + 1 / every), abs=0.15)


def test_a_slow_motor_in_a_run() -> None:
    outcome, words = play(SlowMotor(strokes_per_30s=1, start="00:50", end="01:15"))
    made = np.diff(words[:, DELIVERED])
    assert (made[12:15] == 10).all()  # of a bolus, ten strokes in five minutes
    assert made[15] >= words[15, PENDING] > 10  # the others are made afterwards
    assert not words[:, LOST].any()
    assert outcome.hazards == {}
    outcome.assert_ledger_closes()
    assert told(outcome) == [(step, "SlowMotor", "PUMP", 1) for step in range(10, 15)]


def test_the_other_drugs_motor_is_sound() -> None:
    outcome, _ = play(MissedStrokes(drug="pramlintide", start="01:00", end="03:00"), mode="s3")
    ledger = outcome.safety["ledger"]
    assert (ledger["insulin"]["lost"], ledger["pramlintide"]["lost"] > 0) == (0, True)


def test_several_at_once() -> None:
    windows = {"start": "01:00", "end": "03:00"}, {"start": "01:30", "end": "02:00"}
    one, inner = (MissedStrokes(every=every, **window) for every, window in zip((3, 2), windows, strict=True))
    _, words = play(one, inner)
    assert (words == play(inner, one)[1]).all()
    lost, made = since_start(words, LOST, 18), since_start(words, LOST, 18) + since_start(words, DELIVERED, 18)
    assert (lost[:7] == made[:7] // 2).all()  # the worse one, counting from its beginning
    tail = since_start(words, LOST, 24)[:13], since_start(words, DELIVERED, 24)[:13]
    assert tail[0][-1] == pytest.approx(sum(tail)[-1] / 3, abs=1)  # and then the other one again
    _, words = play(*(cls(start="01:00", end="02:00") for cls in (MissedStrokes, DoubleStrokes, SlowMotor)))
    assert max(np.diff(words[:, DELIVERED])[12:24]) <= 20
    assert [k for k in range(12, 25) if words[k, LOST] != words[12, LOST]]
    assert all(mechanism.ledger_closes(row) for row in words)


@pytest.mark.parametrize("kind", [MissedStrokes, DoubleStrokes, SlowMotor, Occlusion])
def test_what_follows_at_once_acts_whatever_the_order_in_the_list(kind: Any) -> None:
    first, second = kind(start="01:00", end="01:30"), kind(start="01:30", end="02:00")
    forwards, backwards = play(first, second)[1], play(second, first)[1]
    assert (forwards == backwards).all()
    assert (forwards != play(first)[1]).any()


@pytest.mark.parametrize("fault", EXAMPLES, ids=name_of)
def test_same_seed_same_bytes(fault: Any) -> None:
    once, again = (play(fault, mode="s4", hours=4)[0] for _ in range(2))
    assert once.frames.frames(0) == again.frames.frames(0)


# ---- reports


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_codes_are_the_dbcs(kind: type[Injected]) -> None:
    kinds = labels("FAULT_Inject", "FaultKind")
    name = kind.__name__ if kind.NODE == "PUMP" else f"Sensor{kind.__name__}"
    assert kinds[kind.CODE] == name


@pytest.mark.parametrize("fault", EXAMPLES, ids=name_of)
def test_a_fault_is_told_when_it_acts(fault: Any) -> None:
    outcome, _ = play(fault)
    events = outcome.trace.faults
    steps = [event.param for event in events]
    begin, end = fault.start // 300, (getattr(fault, "end", None) or fault.start + 300) // 300
    expected = list(range(begin, end))
    if isinstance(fault, DropOut):
        expected = [k for k in expected if np.isnan(outcome.trace.get("GlucoseConc")[k])]
    assert steps == expected
    assert {event.target for event in events} == {fault.NODE}
    assert {event.message for event in events} == {"CGM_Reading" if isinstance(fault, Effect) else ""}
    assert {event.kind for event in events} == {labels("FAULT_Inject", "FaultKind")[fault.CODE]}
    assert len(told(outcome)) == len(steps)


def test_a_sensors_own_effects_are_no_faults(tmp_path: Path) -> None:
    file = tmp_path / "sensor.yaml"
    file.write_text('effects: [{kind: stuck, start: "01:00", end: "02:00"}, {kind: noise, start: "02:00"}]\n')
    own, _ = play(sensor=str(file))
    injected, _ = play(Stuck(start="01:00", end="02:00"), Noise(start="02:00"))
    glucose = [outcome.trace.get("GlucoseConc") for outcome in (own, injected)]
    assert np.array_equal(*glucose)
    assert own.trace.faults == []
    kinds = [event.kind for event in injected.trace.faults]
    assert (kinds.count("SensorStuck"), kinds.count("SensorNoise")) == (12, 37)
    both, _ = play(Lag(start="04:00"), sensor=str(file))
    assert {event.kind for event in both.trace.faults} == {"SensorLag"}


@pytest.mark.parametrize("every", [5, 10])
def test_random_effects_are_told_where_they_act(every: int) -> None:
    settings = SensorSettings.model_validate({"model": "ideal", "sample_minutes": every})
    for fault in (CompressionLow(per_day=20), DropOut(probability=0.2, mean_samples=2), Replacement(start="00:05")):
        device = Sensor(settings, 288, 3, "adult#001", (fault,))
        acted, changed = [], []
        for step in range(288):
            sample = device.sample(step, 120.0)
            due = step * 5 % every == 0
            acted += [step] if device.faults_acting else []
            changed += [step] if due and (sample is None or sample.glucose != 120.0) else []
        if isinstance(fault, Replacement):
            assert (acted, changed) == ([1], [])
        else:
            assert 0 < len(acted) < 200
            assert acted == changed


def test_an_empty_battery_has_no_sample_to_lose() -> None:
    settings = SensorSettings.model_validate({"battery_days": 1, "battery_percent": 50, "renew": False})
    device = Sensor(settings, 200, 1, "adult#001", (DropOut(),))
    acted = [step for step in range(200) if device.sample(step, 120.0) is None and device.faults_acting]
    assert acted == list(range(144))


# ---- files


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ('{kind: missed_strokes, start: "01:00", every: 0}', "every"),
        ('{kind: double_strokes, start: "01:00", every: 1.5}', "every"),
        ('{kind: slow_motor, start: "01:00", strokes_per_30s: 0}', "strokes_per_30s"),
        ('{kind: slow_motor, start: "01:00", strokes_per_30s: 16}', "strokes_per_30s"),
        ('{kind: slow_motor, start: "01:00", every: 2}', "every"),
        ('{kind: missed_strokes, start: "01:00", end: "01:00"}', "end must be later than start"),
        ('{kind: double_strokes, start: "01:00", drug: glucagon}', "drug"),
        ("{kind: missed_strokes}", "start"),
    ],
)
def test_wrong_values_are_named(entry: str, expected: str, tmp_path: Path) -> None:
    file = tmp_path / "faults.yaml"
    file.write_text(f"faults:\n  - {entry}\n")
    with pytest.raises(FileError, match=expected):
        fault_files.load(file)


def test_a_run_with_an_empty_reservoir_and_double_strokes_loses_the_extra_ones() -> None:
    outcome, words = play(DoubleStrokes(start="01:00"), EmptyReservoir(start="02:00"))
    assert words[24, DELIVERED] == words[-1, DELIVERED]
    assert words[-1, LOST] > 0
    outcome.assert_ledger_closes()
