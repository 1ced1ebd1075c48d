"""The sensor around the model: range, age, what happens to it, what it says of itself, and its file."""

import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import plant_server.sensor
from can_bus import codec
from can_bus.codec import Receiver
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.sensor import (
    STATE_ABOVE_RANGE,
    STATE_BELOW_RANGE,
    STATE_OK,
    Sample,
    Sensor,
    SensorError,
    SensorSettings,
    Status,
    load_sensor,
)
from plant_server.sensors import MODELS
from plant_server.sensors.effects import (
    EFFECTS,
    Bias,
    CompressionLow,
    Drift,
    DropOut,
    Effect,
    FaultBit,
    Lag,
    Noise,
    Replacement,
    State,
    Stuck,
)
from plant_server.server import PlantServer, Run

DAY = 288
STATES = {name: codec.choice("CGM_Reading", "CgmState", name) for name in ("Warmup", "SensorFault", "Expired")}


def sensor(*effects: Effect, count: int = DAY, model: str = "ideal", seed: int = 1, **settings: object) -> Sensor:
    return Sensor(
        SensorSettings.model_validate({"model": model, "effects": effects} | settings), count, seed, "adult#001"
    )


def play(device: Sensor, glucose: float | np.ndarray = 120.0) -> tuple[list[Sample | None], list[Status | None]]:
    true = np.broadcast_to(glucose, len(device.wear.session))
    both = [(device.sample(k, float(g)), device.status(k)) for k, g in enumerate(true)]
    return [sample for sample, _ in both], [status for _, status in both]


def shown(device: Sensor, glucose: float | np.ndarray = 120.0) -> np.ndarray:
    samples, _ = play(device, glucose)
    return np.array([np.nan if s is None or s.glucose is None else s.glucose for s in samples])


# ---- readings


def test_an_ideal_sensor_shows_what_is_there_and_how_it_changes() -> None:
    samples, _ = play(sensor(count=4), np.array([100.0, 110.0, 105.0, 105.0]))
    assert samples == [
        Sample(STATE_OK, 100.0, None, 0),
        Sample(STATE_OK, 110.0, 2.0, 1),
        Sample(STATE_OK, 105.0, -1.0, 2),
        Sample(STATE_OK, 105.0, 0.0, 3),
    ]


def test_beyond_the_range_the_state_tells() -> None:
    samples, _ = play(sensor(count=6), np.array([39.9, 40.0, 400.0, 400.1, 300.0, 300.0]))
    assert [s.state for s in samples if s] == [
        STATE_BELOW_RANGE, STATE_OK, STATE_OK, STATE_ABOVE_RANGE, STATE_OK, STATE_OK
    ]  # fmt: skip
    assert [s.glucose for s in samples if s] == [40.0, 40.0, 400.0, 400.0, 300.0, 300.0]
    assert [s.rate for s in samples if s] == [None, None, 72.0, 0.0, None, 0.0], "no rate from a number that is none"
    wide = sensor(count=2, range=(20.0, 500.0))
    assert shown(wide, np.array([21.0, 499.0])).tolist() == [21.0, 499.0]


def test_a_reading_is_gain_times_interstitial_plus_offset() -> None:
    device = sensor(model="dexcom-g6", range=(0.0, 800.0))
    assert device.additive_only
    errors = device.errors
    assert shown(device, 150.0).tolist() == (errors.gain * 150.0 + errors.offset).tolist()
    assert not sensor(Bias(offset=1)).additive_only
    assert not sensor(warmup_minutes=120).additive_only
    assert not sensor(sample_minutes=10).additive_only


def test_a_slower_sensor_sends_less_often_and_numbers_what_it_sends() -> None:
    samples, _ = play(sensor(count=7, sample_minutes=15), np.arange(100.0, 170.0, 10.0))
    assert [k for k, s in enumerate(samples) if s] == [0, 3, 6]
    assert [s for s in samples if s] == [
        Sample(STATE_OK, 100.0, None, 0),
        Sample(STATE_OK, 130.0, 2.0, 1),
        Sample(STATE_OK, 160.0, 2.0, 2),
    ]


# ---- age


def test_a_sensor_warms_up_after_every_insertion() -> None:
    device = sensor(Replacement(start="12:00"), count=2 * DAY, warmup_minutes=120)
    samples, statuses = play(device)
    warm = [k for k, s in enumerate(samples) if s and s.state == STATES["Warmup"]]
    assert warm == [*range(24), *range(144, 168)]
    assert all(samples[k].glucose is None and samples[k].rate is None for k in warm)  # type: ignore[union-attr]
    assert samples[168].rate is None  # type: ignore[union-attr]
    assert [s.session for s in statuses if s] == [0] * 12 + [1] * 36
    assert statuses[144].age_minutes == 0  # type: ignore[union-attr]
    assert statuses[156].age_minutes == 60  # type: ignore[union-attr]


def test_a_replacement_is_told_at_once() -> None:
    _, statuses = play(sensor(Replacement(start="10:05")))
    assert statuses[121] is not None
    assert (statuses[121].session, statuses[121].age_minutes) == (1, 0)
    assert [k for k, s in enumerate(statuses) if s] == sorted({*range(0, DAY, 12), 121})


def test_at_the_end_of_its_life_a_sensor_is_renewed_or_expires() -> None:
    renewed = sensor(model="dexcom-g6", count=25 * DAY)
    assert np.flatnonzero(np.diff(renewed.wear.session)).tolist() == [10 * DAY - 1, 20 * DAY - 1]
    assert renewed.wear.age.max() == 10 * DAY - 1
    kept = sensor(count=25 * DAY)
    assert (kept.wear.session.max(), kept.wear.age.max()) == (0, 25 * DAY - 1)

    samples, _ = play(sensor(count=2 * DAY, lifetime_days=1, renew=False))
    assert all(s and s.state == STATE_OK for s in samples[:DAY])
    assert all(s and (s.state, s.glucose) == (STATES["Expired"], None) for s in samples[DAY:])


def test_a_worn_sensor_comes_with_its_age() -> None:
    device = sensor(model="dexcom-g6", count=2 * DAY, worn_minutes=9 * 1440, warmup_minutes=120)
    samples, statuses = play(device)
    assert statuses[0].age_minutes == 9 * 1440  # type: ignore[union-attr]
    assert device.errors.gain[0] == pytest.approx(1.048 - 0.033 * 9 + 0.002 * 81)
    assert samples[0].state == STATE_OK  # type: ignore[union-attr]
    assert samples[DAY].state == STATES["Warmup"]  # type: ignore[union-attr]


# ---- what happens to a sensor


def test_a_lag_delays_as_a_first_order_does() -> None:
    step = np.where(np.arange(60) < 12, 100.0, 200.0)
    got = shown(sensor(Lag(minutes=10, start="00:30"), count=60), step)
    k = np.arange(48)
    assert got[:12].tolist() == [100.0] * 12
    assert got[12:] == pytest.approx(200 - 100 * np.exp(-0.5 * (k + 1)))


def test_a_compression_low_is_an_episode_with_ramps() -> None:
    got = shown(sensor(CompressionLow(start="02:00", end="03:00", depth=0.5, ramp_minutes=10)), 100.0)
    assert got[22:38].tolist() == [100, 100, 75, *[50] * 10, 75, 100, 100]


def test_compression_lows_at_random_come_as_often_as_asked() -> None:
    device = sensor(CompressionLow(per_day=1.71, depth=0.4, minutes=40), count=200 * DAY)
    pressed = shown(device, 100.0) < 99.9
    begins = np.flatnonzero(pressed[1:] & ~pressed[:-1])
    assert len(begins) / 200 == pytest.approx(1.71, rel=0.2)
    assert pressed.sum() * 5 / len(begins) == pytest.approx(40, abs=5)
    assert shown(device, 100.0).min() == pytest.approx(60.0)


def test_bias_and_drift() -> None:
    got = shown(sensor(Bias(gain=1.1, offset=-5, start="01:00", end="02:00")), 100.0)
    assert got[[11, 12, 23, 24]] == pytest.approx([100, 105, 105, 100])
    got = shown(sensor(Drift(offset_per_hour=6, gain_per_hour=-0.01, start="01:00", end="20:00")), 100.0)
    assert got[[12, 24, 36, 240]] == pytest.approx([100, 105, 110, 100])


def test_noise_has_its_deviation_and_correlation() -> None:
    got = shown(sensor(Noise(sd=12, correlation=0.6), count=40_000, range=(0, 800)), 300.0)
    assert np.std(got) == pytest.approx(12, rel=0.03)
    assert np.corrcoef(got[:-1], got[1:])[0, 1] == pytest.approx(0.6, abs=0.02)


def test_a_stuck_sensor_repeats_its_number_and_goes_on_counting() -> None:
    true = np.arange(100.0, 130.0)
    samples, _ = play(sensor(Stuck(start="00:50", end="01:40"), count=30), true)
    assert [s.glucose for s in samples if s] == [*range(100, 110), *[109] * 10, *range(120, 130)]
    assert [s.number for s in samples if s] == list(range(30))
    assert set(shown(sensor(Stuck(value=250), count=9), true[:9])) == {250.0}
    assert set(shown(sensor(Stuck(), count=9), true[:9])) == {100.0}


@pytest.mark.parametrize("state", ["Warmup", "CalibrationNeeded", "TempInvalid", "SensorFault", "Expired"])
def test_a_sensor_that_says_it_has_nothing(state: str) -> None:
    samples, _ = play(sensor(State.model_validate({"state": state, "start": "01:00", "end": "02:00"})))
    code = codec.choice("CGM_Reading", "CgmState", state)
    assert [k for k, s in enumerate(samples) if s == Sample(code, None, None, k)] == list(range(12, 24))
    assert samples[24] == Sample(STATE_OK, 120.0, None, 24)
    assert samples[25] == Sample(STATE_OK, 120.0, 0.0, 25)


def test_a_drop_out_loses_all_of_its_window() -> None:
    samples, statuses = play(sensor(DropOut(start="02:00", end="03:00")))
    assert [k for k, s in enumerate(samples) if s is None] == list(range(24, 36))
    assert samples[36].number == 36  # type: ignore[union-attr]
    assert [s.dropped for s in statuses if s][:4] == [0, 0, 12, 12]


def test_drop_outs_at_random_have_their_share_and_length() -> None:
    samples, statuses = play(sensor(DropOut(probability=0.1, mean_samples=4), count=60_000))
    lost = np.array([s is None for s in samples])
    assert lost.mean() == pytest.approx(0.1, rel=0.08)
    assert lost.sum() / np.sum(lost[1:] & ~lost[:-1]) == pytest.approx(4, rel=0.08)
    assert [s for s in statuses if s][-1].dropped == pytest.approx(lost.sum(), abs=12)


def test_effects_act_in_the_order_of_the_signal_whatever_the_order_in_the_list() -> None:
    effects = [
        Stuck(start="01:00"),
        Drift(gain_per_hour=0.1),
        Bias(offset=10),
        CompressionLow(end="23:00"),
        Noise(sd=3),
    ]
    forwards, backwards = shown(sensor(*effects)), shown(sensor(*reversed(effects)))
    assert np.array_equal(forwards, backwards)
    assert np.ptp(forwards[12:]) == 0


def test_a_stuck_sensor_beyond_its_range_stays_there() -> None:
    samples, _ = play(sensor(Stuck(start="00:10"), count=6), np.array([100.0, 30.0, 100.0, 100.0, 100.0, 100.0]))
    assert [s.state for s in samples if s] == [STATE_OK] + [STATE_BELOW_RANGE] * 5


# ---- random numbers


RANDOM = (
    Noise(sd=8),
    Noise(sd=8, name="second"),
    CompressionLow(per_day=5),
    DropOut(probability=0.2, mean_samples=2),
)


def test_the_same_seed_gives_the_same_sensor() -> None:
    for model in MODELS:
        once, again = (play(sensor(*RANDOM, model=model)) for _ in range(2))
        assert once == again
        assert play(sensor(*RANDOM, model=model, seed=2)) != once


@pytest.mark.parametrize("off", range(len(RANDOM)))
def test_switching_one_effect_off_shifts_no_other(off: int) -> None:
    rest = tuple(effect for k, effect in enumerate(RANDOM) if k != off)
    with_all, without = sensor(*RANDOM), sensor(*rest)
    numbers = {(run.effect.kind, run.effect.name): run.numbers for run in _running(with_all)}
    for run in _running(without):
        assert run.numbers == numbers[run.effect.kind, run.effect.name]
    assert np.array_equal(with_all.errors.offset, without.errors.offset)


def test_the_streams_of_effects_and_model_are_independent() -> None:
    device = sensor(*RANDOM, model="coloured", count=20_000)
    numbers = [run.numbers for run in _running(device)] + [device.errors.offset.tolist()]
    matrix = np.corrcoef(numbers)
    assert np.abs(matrix - np.eye(len(numbers))).max() < 0.05


def _running(device: Sensor) -> list[plant_server.sensor._Running]:
    return [*device._before, *device._after, *device._last_stages]


def test_moving_a_window_shifts_no_numbers() -> None:
    early, late = (sensor(Noise(sd=8, start=start), model="ideal") for start in ("00:00", "06:00"))
    assert np.array_equal(shown(early)[72:], shown(late)[72:])
    assert np.array_equal(shown(late)[:72], np.full(72, 120.0))


def test_a_longer_run_begins_as_a_shorter_one() -> None:
    short, long = (shown(sensor(*RANDOM, model="dexcom-g6", count=count)) for count in (DAY, 3 * DAY))
    assert np.array_equal(short, long[:DAY], equal_nan=True)


# ---- what it says of itself


def test_status_comes_once_an_hour() -> None:
    _, statuses = play(sensor(model="coloured", count=25))
    assert [k for k, s in enumerate(statuses) if s] == [0, 12, 24]
    battery = [100 - 100 * k / (90 * DAY) for k in (0, 12, 24)]
    assert [s for s in statuses if s] == [
        Status(0, 0, minutes, 5.0, left, 0) for minutes, left in zip((0, 60, 120), battery, strict=True)
    ]


def test_what_a_sensor_notices_of_its_faults() -> None:
    def told(*effects: Effect) -> dict[int, int]:
        _, statuses = play(sensor(*effects, count=72))
        return {k: s.fault_bits for k, s in enumerate(statuses) if s}

    window = {"start": "01:10", "end": "03:00"}
    noise = told(Noise(sd=8, **window))
    assert noise == {0: 0, 12: 0, 14: 1, 24: 1, 36: 1, 48: 0, 60: 0}, "at once, then hourly until it is over"
    assert told(Noise(sd=8, noticed=False, **window)) == dict.fromkeys(range(0, 72, 12), 0)
    assert told(CompressionLow(**window)) == dict.fromkeys(range(0, 72, 12), 0)
    assert told(CompressionLow(noticed=True, **window))[14] == FaultBit.COMPRESSION
    assert told(Bias(offset=5, noticed=True, **window))[14] == FaultBit.CALIBRATION
    dropped = told(DropOut(**window))
    assert dropped == {0: 0, 12: 0, 36: FaultBit.TELEMETRY, 48: 0, 60: 0}, "what fell into the drop-out comes after it"


def test_noise_a_sensor_knows_of_is_in_its_estimate() -> None:
    _, statuses = play(sensor(Noise(sd=12, start="01:00", end="02:00"), model="coloured", count=37))
    assert [statuses[k].noise for k in (0, 12, 24, 36)] == [5.0, 13.0, 5.0, 5.0]  # type: ignore[union-attr]


def test_an_empty_battery_ends_the_sending() -> None:
    device = sensor(count=DAY + 12, battery_days=10, battery_percent=10, renew=False)
    samples, statuses = play(device)
    assert all(s is not None for s in samples[:DAY])
    assert all(s is None for s in samples[DAY:])
    assert all(s is None for s in statuses[DAY:])
    assert statuses[144].battery == pytest.approx(5.0)  # type: ignore[union-attr]
    samples, statuses = play(sensor(count=DAY + 12, battery_days=10, battery_percent=10))
    assert all(samples)
    assert [statuses[k].battery for k in (276, 288)] == pytest.approx([10 / 24, 100])  # type: ignore[union-attr]


# ---- on the bus


def test_the_plant_sends_what_the_sensor_says() -> None:
    settings = SensorSettings.model_validate(
        {"model": "coloured", "effects": [State(start="00:10", end="00:15"), DropOut(start="00:15", end="00:20")]}
    )
    run = Run(load_patient("adult#001"), load_scenario("fasting"), 5, 1, 2, {}, sensor=settings)
    plant = PlantServer(run)
    receiver = Receiver(["CGM_Reading", "CGM_Status"])
    batches = []
    for step in range(5):
        plant.step = step
        found = [receiver.receive(frame)[1:3] for frame in plant._open_step()]
        batches.append([one for one in found if one[0]])
    names = [[name for name, _ in batch] for batch in batches]
    assert names == [["CGM_Status", "CGM_Reading"], ["CGM_Reading"], ["CGM_Reading"], [], ["CGM_Status", "CGM_Reading"]]
    assert batches[0][0][1] == {
        "CgmFaultBits": 0,
        "CgmSessionId": 0,
        "CgmSensorAge": 0,
        "CgmNoise": 10,
        "CgmBattery": 200,
        "CgmDropCount": 0,
    }
    assert batches[2][0][1] == {
        "CgmState": STATES["SensorFault"],
        "GlucoseConc": 8191,
        "GlucoseRate": -1024,
        "CgmSampleSeq": 2,
        "CgmSampleStep": 2,
    }
    assert batches[4][1][1]["CgmSampleSeq"] == 4
    assert (batches[4][0][1]["CgmFaultBits"], batches[4][0][1]["CgmDropCount"]) == (FaultBit.TELEMETRY, 1)


# ---- names, files, mistakes


def test_names_and_files_are_the_same_sensor(tmp_path: Path) -> None:
    for name in MODELS:
        assert load_sensor(name).model.name == name
    file = tmp_path / "mine.yaml"
    file.write_text(
        """
model: {name: dexcom-g6, ar_minutes: 1}
sample_minutes: 10
range: [39, 500]
warmup_minutes: 120
effects:
  - {kind: drop_out, start: "1+02:00", end: "1+03:30"}
  - {kind: compression_low, per_day: 2}
"""
    )
    settings = load_sensor(str(file))
    assert settings == SensorSettings.model_validate(
        {
            "model": {"name": "dexcom-g6", "ar_minutes": 1},
            "sample_minutes": 10,
            "range": (39, 500),
            "warmup_minutes": 120,
            "effects": (DropOut(start="1+02:00", end="1+03:30"), CompressionLow(per_day=2)),
        }
    )
    assert hash(settings) == hash(load_sensor(str(file)))
    assert "drop_out" in repr(settings)


WRONG = {
    "model: dexcom-g7": "1: model: ",
    "model: {name: dexcom-g6, ar_minutes: 2}": "an AR step is 1 or 5 min",
    "sample_minutes: 7": "1: sample_minutes: the bench's instants are 5 min apart; give a multiple",
    "range: [400, 40]": "a range is [low, high] within 0 to 800 mg/dL",
    "warm_up: 3": "1: warm_up: unknown key; expected one of model, sample_minutes",
    "effects:\n  - {kind: drop_out}\n  - {kind: drift, start: 25:00}": '3: effects.1.start: a time is "hh:mm"',
    "effects: [{kind: noise, sd: 0}]": "1: effects.0.sd",
    "effects: [{kind: noice}]": "1: effects.0",
    "effects: [{kind: noise, loud: 1}]": "loud: unknown key; expected one of kind, name, start, end, sd, correlation",
    'effects: [{kind: noise, start: "02:00", end: "01:00"}]': "end must be later than start",
    "effects: [{kind: compression_low}]": "give the episode's end, or per_day",
    "effects: [{kind: noise}, {kind: noise, sd: 3}]": "give them different names",
    "effects: [{kind: replacement, start: '02:00', end: '03:00'}]": "end",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_one_clear_error(text: str, tmp_path: Path) -> None:
    file = tmp_path / "sensor.yaml"
    file.write_text(text)
    with pytest.raises(SensorError) as error:
        load_sensor(str(file))
    assert str(error.value).startswith(f"{file}:")
    assert WRONG[text] in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nose", "there is no sensor 'nose'; choose one of coloured, ideal"),
        ("dexcom-g5 ", "did you mean dexcom-g5?"),
        ("no.yaml", "cannot read no.yaml"),
    ],
)
def test_a_wrong_name_is_one_clear_error(name: str, text: str) -> None:
    with pytest.raises(SensorError, match=text.replace("?", r"\?")):
        Sensor(name, 10, 1, "adult#001")


def test_effects_are_listed_in_the_order_in_which_they_act() -> None:
    assert [effect.stage for effect in EFFECTS.values()] == sorted(effect.stage for effect in EFFECTS.values())
    page = (Path(__file__).parents[1] / "docs" / "sensors-and-scenarios.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([a-z_]+)` \|", page.split("### Effects")[1].split("## ")[0], re.M) == list(EFFECTS)


def test_effects_are_values_with_a_name() -> None:
    for kind, effect in EFFECTS.items():
        assert effect.model_fields["kind"].default == kind
        assert (effect.__doc__ or "").strip()
    assert DropOut(start="01:00").start == 3600
    assert DropOut(start="01:00") == DropOut(start="0+01:00:00")
    assert len({Noise(), Noise(), Noise(sd=3)}) == 2
    with pytest.raises(ValidationError, match="in quotes"):
        Noise(start=780)  # what YAML makes of 13:00 without quotes
    with pytest.raises(ValidationError, match="frozen"):
        Noise().sd = 3
    for bit in FaultBit:
        assert bit.name
    comment = codec.message("CGM_Status").fields["CgmFaultBits"]
    assert comment.mask == sum(FaultBit)
