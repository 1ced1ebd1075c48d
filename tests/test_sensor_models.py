"""Error models of glucose sensors: their statistics against the published numbers, and the same numbers every time."""

import hashlib
import inspect
import re
from collections.abc import Callable

import numpy as np
import pytest

from plant_server.sensors import MODELS, Errors, Model, Wear
from plant_server.sensors.autoregression import AR2, WARM_UP
from plant_server.sensors.breton2008 import DELTA, GAMMA, LAMBDA, STATIONARY_SD, XI
from plant_server.sensors.coloured import Coloured
from plant_server.sensors.dexcom_g5 import DexcomG5
from plant_server.sensors.dexcom_g6 import DexcomG6
from plant_server.sensors.dissected import Dissected
from plant_server.sensors.facchinetti2014 import Facchinetti2014
from plant_server.sensors.vettoretti2019 import MEAN, NAMES, NOISE_SD_MAX, Vettoretti2019, covariance, draw_sensor
from plant_server.streams import stream

LONG = 200_000
DAY = 288
FORTNIGHT = 14 * DAY + 1


def streams(seed: int, patient: str = "adult#001") -> Callable[[str], np.random.Generator]:
    """As a sensor makes them."""
    return lambda purpose: stream(seed, patient, f"cgm {purpose}" if purpose else "cgm")


def draw(model: Model, count: int, seed: int = 1) -> Errors:
    return model.draw(Wear.whole_run(count), streams(seed))


def correlation(x: np.ndarray, lag: int) -> float:
    return float(np.corrcoef(x[:-lag], x[lag:])[0, 1])


# ---- coloured and breton: the very numbers that recordings were made with


@pytest.mark.parametrize(
    ("name", "seed", "patient", "start", "sha256"),
    [
        ("coloured", 1, "adult#001", [-1.1853342482893794, -0.6782227934162559], "7e0bb2ba8d78a5ec"),
        ("coloured", 7, "adult#009", [-2.4779310276925983, -6.237430359545419], "738bdf18d66d096c"),
        ("breton", 1, "adult#001", [-19.603954414999485, -14.81391125562191], "7e4bf7c5b31f4a54"),
        ("breton", 7, "adult#009", [-4.77332714304924, -4.654907011270523], "945cdcc3e6f684ec"),
    ],
)
def test_the_random_numbers_stay_the_same(name: str, seed: int, patient: str, start: list[float], sha256: str) -> None:
    error = MODELS[name]().draw(Wear.whole_run(FORTNIGHT), streams(seed, patient)).offset
    assert error[:2].tolist() == start
    assert hashlib.sha256(error.tobytes()).hexdigest().startswith(sha256)


# ---- autoregression


@pytest.mark.parametrize(("c1", "c2"), [(1.22, -0.331), (1.013, -0.2135), (0.5, 0.2), (0.0, 0.0)])
def test_an_autoregression_has_its_closed_form(c1: float, c2: float) -> None:
    process = AR2(c1, c2, 2.0)
    e = process.draw(LONG, np.random.default_rng(3))
    first = c1 / (1 - c2)
    assert np.std(e) == pytest.approx(process.sd, rel=0.02)
    assert correlation(e, 1) == pytest.approx(first, abs=0.01)
    assert correlation(e, 2) == pytest.approx(c1 * first + c2, abs=0.015)
    assert abs(np.mean(e)) < 4 * process.sd * np.sqrt((1 + first) / (1 - first) / LONG)


def test_an_autoregression_is_stationary_from_its_first_value_on() -> None:
    process = AR2(1.22, -0.331, 1.0)
    first = [process.draw(1, np.random.default_rng(seed))[0] for seed in range(2000)]
    assert np.std(first) == pytest.approx(process.sd, rel=0.06)


def test_an_autoregression_is_the_recursion_it_claims_to_be() -> None:
    process = AR2(1.2, -0.3, 2.0)
    w = np.random.default_rng(5).standard_normal(WARM_UP + 10) * 2.0
    e = [0.0, 0.0]
    for k in range(2, WARM_UP + 10):
        e.append(1.2 * e[k - 1] - 0.3 * e[k - 2] + w[k])
    assert process.draw(10, np.random.default_rng(5)).tolist() == e[WARM_UP:]


def test_steps_of_one_minute_forget_five_times_as_fast() -> None:
    process = AR2(1.22, -0.331, 1.0)
    slow = process.draw(LONG // 5, np.random.default_rng(3), 5)
    fast = process.draw(LONG // 5, np.random.default_rng(3), 1)
    assert len(slow) == len(fast)
    assert np.std(fast) == pytest.approx(np.std(slow), rel=0.05)
    assert correlation(slow, 5) == pytest.approx(correlation(fast, 1), abs=0.03)


@pytest.mark.parametrize(("c1", "c2", "stable"), [(1.22, -0.331, True), (1.4, -0.3, False), (0.0, 1.0, False)])
def test_stability(c1: float, c2: float, stable: bool) -> None:
    assert AR2(c1, c2, 1.0).stable is stable


# ---- the models' published numbers


def test_coloured_noise_has_5_mg_dl_and_the_g6s_memory() -> None:
    errors = draw(Coloured(), LONG)
    assert np.all(errors.gain == 1)
    assert np.std(errors.offset) == pytest.approx(5.0, rel=0.02)
    assert abs(np.mean(errors.offset)) < 0.15
    assert correlation(errors.offset, 1) == pytest.approx(1.22 / 1.331, abs=0.01)
    # where the 5 mg/dL come from: the sensor-specific part of the published G6 error
    assert DexcomG6.own.sd == pytest.approx(5.06, abs=0.005)


def test_breton_has_the_published_distribution() -> None:
    # Breton and Kovatchev 2008: mean of the sensor error 0.76 mg/dL, standard deviation 11, PACF cut off after lag 1
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    weights = weights / weights.sum()
    johnson = XI + LAMBDA * np.sinh((nodes - GAMMA) / DELTA)
    assert weights @ johnson == pytest.approx(0.76, abs=0.005)

    at_knots = XI + LAMBDA * np.sinh((nodes * np.sqrt(0.49 / 0.51) - GAMMA) / DELTA)
    mean = weights @ at_knots
    assert np.sqrt(weights @ (at_knots - mean) ** 2) == pytest.approx(STATIONARY_SD, abs=0.005)

    error = draw(MODELS["breton"](), LONG).offset
    knots = error[::3]
    assert np.mean(knots) == pytest.approx(mean, abs=0.3)
    assert np.std(knots) == pytest.approx(STATIONARY_SD, rel=0.02)
    e = GAMMA + DELTA * np.arcsinh((knots - XI) / LAMBDA)
    assert correlation(e, 1) == pytest.approx(0.7, abs=0.01)
    second = (correlation(e, 2) - correlation(e, 1) ** 2) / (1 - correlation(e, 1) ** 2)
    assert abs(second) < 0.015, "partial autocorrelation beyond lag 1"
    between = error[1:-2:3]
    assert between == pytest.approx(knots[:-1][: len(between)] * 2 / 3 + knots[1:][: len(between)] / 3)


@pytest.mark.parametrize(
    ("model", "own", "common"),
    [(Facchinetti2014(), 7.07, 7.69), (DexcomG5(), 6.81, 0.0), (DexcomG6(), 5.06, 6.15)],
)
def test_noise_of_the_padova_models(model: Dissected, own: float, common: float) -> None:
    assert model.own.sd == pytest.approx(own, abs=0.005)
    assert (model.common.sd if model.common else 0.0) == pytest.approx(common, abs=0.005)
    errors = draw(model, LONG)
    t = model.days(Wear.whole_run(LONG))
    noise = errors.offset - (model.b[0] + model.b[1] * t + model.b[2] * t**2)
    assert np.std(noise) == pytest.approx(np.hypot(own, common), rel=0.02)
    assert errors.noise_sd == pytest.approx(np.hypot(own, common), abs=0.01)
    assert abs(np.mean(noise)) < 0.3
    expected = sum(p.sd**2 * p.c1 / (1 - p.c2) for p in (model.own, model.common) if p) / np.hypot(own, common) ** 2
    assert correlation(noise, 1) == pytest.approx(expected, abs=0.01)


def test_the_two_noises_are_independent_streams() -> None:
    wear = Wear.whole_run(LONG)
    own = DexcomG6.own.draw(LONG, streams(1)(""))
    common = DexcomG6.common.draw(LONG, streams(1)("common"))
    assert abs(np.corrcoef(own, common)[0, 1]) < 0.03
    t = wear.age_days
    together = DexcomG6().draw(wear, streams(1)).offset
    assert together == pytest.approx(-6.398 + 6.179 * t - 0.448 * t**2 + own + common, rel=1e-9, abs=1e-6)


def test_a_factory_calibrated_sensor_drifts_over_its_life() -> None:
    # a and b of the published polynomials, worked by hand
    by_hand = {0: (1.048, -6.398), 5: (0.933, 13.297), 10: (0.918, 10.592)}
    gain = draw(DexcomG6(), 10 * DAY + 1).gain
    offset = np.mean([draw(DexcomG6(), 10 * DAY + 1, seed).offset for seed in range(150)], axis=0)
    for day, (a, b) in by_hand.items():
        assert gain[day * DAY] == pytest.approx(a)
        around = slice(max(day * DAY - 12, 0), day * DAY + 13)
        assert np.mean(gain[around] * 120 + offset[around]) == pytest.approx(a * 120 + b, abs=1.5)


def test_a_calibrated_sensor_starts_anew_every_twelve_hours() -> None:
    gain = draw(DexcomG5(), DAY + 1).gain
    assert gain[[0, 72, 143, 144, 288]] == pytest.approx([1.04, 1.045, 1.04 + 0.02 * 143 / 288, 1.04, 1.04])
    gain = draw(DexcomG5(calibration_hours=24), DAY + 1).gain
    assert gain[[144, 287, 288]] == pytest.approx([1.05, 1.04 + 0.02 * 287 / 288, 1.04])


# ---- every sensor another one


def test_vettoretti_draws_have_the_published_mean_and_our_covariance() -> None:
    generator = np.random.default_rng(11)
    drawn = np.array([draw_sensor(generator) for _ in range(4000)])
    deviation = np.sqrt(np.diag(covariance()))
    # parameters that no rule refuses keep mean and deviation
    for name in ("a0", "a1", "a2", "b0"):
        i = NAMES.index(name)
        assert np.mean(drawn[:, i]) == pytest.approx(MEAN[i], abs=4 * deviation[i] / np.sqrt(4000)), name
        assert np.std(drawn[:, i]) == pytest.approx(deviation[i], rel=0.05), name
    # the others lose their extremes: at most 10 mg/dL of noise
    for name in ("alpha1", "alpha2", "sigma"):
        i = NAMES.index(name)
        assert np.mean(drawn[:, i]) == pytest.approx(MEAN[i], abs=0.4 * deviation[i]), name
    sds = np.array([AR2(*row[4:]).sd for row in drawn])
    assert sds.max() <= NOISE_SD_MAX
    assert 6.0 < np.mean(sds) < 8.5
    assert AR2(*MEAN[4:]).sd == pytest.approx(8.1, abs=0.05)
    assert np.corrcoef(drawn[:, 1], drawn[:, 2])[0, 1] == pytest.approx(-0.95, abs=0.02)
    assert np.linalg.eigvalsh(covariance()).min() > 0


def test_vettoretti_sensors_err_as_much_as_the_g6_in_its_trial() -> None:
    # MARD 10.0 % (Shah et al. 2018); glucose as it is spread in people with type 1 diabetes
    glucose = 150 + 50 * np.sin(np.arange(10 * DAY) * 2 * np.pi / 97)
    relative = []
    for seed in range(60):
        errors = draw(Vettoretti2019(), 10 * DAY, seed)
        relative.append(np.mean(np.abs(errors.gain * glucose + errors.offset - glucose) / glucose))
    assert 0.085 < np.mean(relative) < 0.115
    assert np.std(relative) > 0.02, "sensors differ"


def test_a_new_vettoretti_sensor_is_a_new_draw_and_the_old_one_stays_as_it_was() -> None:
    whole = Wear.whole_run(2 * DAY)
    session = (np.arange(2 * DAY) >= DAY).astype(np.int64)
    two = Wear(session, np.arange(2 * DAY) - DAY * session)
    one_sensor, two_sensors = Vettoretti2019().draw(whole, streams(1)), Vettoretti2019().draw(two, streams(1))
    assert np.array_equal(one_sensor.offset[:DAY], two_sensors.offset[:DAY])
    assert two_sensors.gain[DAY] != two_sensors.gain[0]
    assert two_sensors.noise_sd[DAY] != two_sensors.noise_sd[0]


# ---- all of them


@pytest.mark.parametrize("name", MODELS)
def test_every_model(name: str) -> None:
    model = MODELS[name]()
    assert model.name == name  # type: ignore[attr-defined]
    once, again, other, shorter = (draw(model, n, seed) for n, seed in ((500, 1), (500, 1), (500, 2), (300, 1)))
    for one, same, beginning in zip(once, again, shorter, strict=True):
        assert one.shape == (500,)
        assert np.all(np.isfinite(one))
        assert np.array_equal(one, same)
        assert np.array_equal(one[:300], beginning), "a longer run begins with the errors of a shorter one"
    assert (name == "ideal") == np.array_equal(once.offset, other.offset)


@pytest.mark.parametrize("name", MODELS)
def test_every_model_tells_its_source_and_units(name: str) -> None:
    text = inspect.getmodule(MODELS[name]).__doc__
    if name != "ideal":
        assert "Source" in text
        assert "mg/dL" in text
        assert re.search(r"doi:10|PMC\d", text)


@pytest.mark.parametrize("name", ["facchinetti", "dexcom-g5", "dexcom-g6", "vettoretti"])
def test_the_step_of_the_noise_is_a_parameter(name: str) -> None:
    model = MODELS[name]
    slow, fast = draw(model(), LONG // 10), draw(model(ar_minutes=1), LONG // 10)
    assert np.array_equal(slow.gain, fast.gain)
    assert np.array_equal(slow.noise_sd, fast.noise_sd)
    rough = [float(np.std(np.diff(errors.offset))) for errors in (slow, fast)]
    assert rough[1] > 1.5 * rough[0]
    with pytest.raises(ValueError, match="1 or 5 min"):
        model(ar_minutes=2)
