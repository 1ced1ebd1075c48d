"""Outcome metrics against values worked by hand and against two independent packages."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from plant_server.metrics import glycaemic, percent, risk


def constant(value: float, count: int = 10) -> np.ndarray:
    return np.full(count, value)


@pytest.mark.parametrize(
    ("glucose", "low", "high"),
    [
        # 1.509 (ln(140)^1.084 - 5.381) = 1.509 (4.941642^1.084 - 5.381) = 1.509 * 0.270405 = 0.40804; 10 f^2 = 1.6650
        (140.0, 0.0, 1.6650),
        # ln(70)^1.084 = 4.797413: f = -0.88063
        (70.0, 7.7551, 0.0),
        # ln(50)^1.084 = 4.386955: f = -1.50001
        (50.0, 22.5004, 0.0),
        # ln(180)^1.084 = 5.963614: f = 0.87917
        (180.0, 0.0, 7.7293),
        # the scale is made so that 20 and 600 mg/dL have the greatest risk, 100, and 112.5 none
        (20.0, 100.0, 0.0),
        (600.0, 0.0, 100.0),
        (112.5, 0.0, 0.0),
    ],
)
def test_risk_of_constants_by_hand(glucose: float, low: float, high: float) -> None:
    assert risk(constant(glucose)) == pytest.approx((low, high), rel=1e-3, abs=1e-3)


def test_risk_is_a_mean_over_all_samples() -> None:
    lbgi, hbgi = risk(np.array([70.0, 140.0, 140.0, 112.5]))
    assert (lbgi, hbgi) == pytest.approx((7.7551 / 4, 2 * 1.6650 / 4), rel=1e-3)


def test_times_by_hand() -> None:
    got = glycaemic(np.array([53.9, 54.0, 69.9, 70.0, 100.0, 180.0, 180.1, 250.0, 250.1, 300.0]))
    assert got["tbr_54"] == pytest.approx(10)
    assert got["tbr_70"] == pytest.approx(30)
    assert got["tir_70_180"] == pytest.approx(30)
    assert got["tar_180"] == pytest.approx(40)
    assert got["tar_250"] == pytest.approx(20)
    # 3.0 * 10 + 2.4 * 20 + 1.6 * 20 + 0.8 * 20 = 126, but at most 100
    assert got["gri"] == 100


def test_gri_by_hand() -> None:
    glucose = np.array([50.0] * 2 + [60.0] * 3 + [100.0] * 80 + [200.0] * 10 + [260.0] * 5)
    assert glycaemic(glucose)["gri"] == pytest.approx(3.0 * 2 + 2.4 * 3 + 1.6 * 5 + 0.8 * 10)


def test_mean_variation_and_gmi_by_hand() -> None:
    got = glycaemic(np.array([100.0, 120.0, 140.0]))
    assert got["mean_glucose"] == pytest.approx(120)
    assert got["cv"] == pytest.approx(100 * 20 / 120), "standard deviation of a sample, n - 1"
    assert got["gmi"] == pytest.approx(6.1804)  # 3.31 + 0.02392 * 120
    # Bergenstal 2018, table: mean glucose and GMI
    for mean, gmi in ((100, 5.7), (125, 6.3), (150, 6.9), (175, 7.5), (200, 8.1)):
        assert round(glycaemic(constant(mean))["gmi"], 1) == gmi
    assert glycaemic(constant(100.0, 1))["cv"] == 0


K = np.arange(14 * 288)
SERIES = {
    "lows": np.round(75 + 25 * np.sin(2 * np.pi * K / 60), 1),
    "mixed": np.maximum(
        np.round(
            150
            + 70 * np.sin(2 * np.pi * K / 97)
            + 45 * np.sin(2 * np.pi * K / 288 + 1)
            + 20 * np.cos(2 * np.pi * K / 1009),
            1,
        ),
        35.0,
    ),
}

OTHERS = {
    # iglu_python 0.4.3: lbgi, hbgi, gri, gmi, cv_glu, mean_glu, in_range_percent, above_percent, below_percent.
    # py_agata 0.0.8 gives the same lbgi, hbgi, gmi, cv and mean; in its times a value *on* a limit is out of range
    # (seven of the 4032 samples of "mixed" are).
    # Neither is a dependency: both bring pandas and more for nine numbers. To repeat: install them into an environment
    # of their own, and call them with these series at 5 min.
    "lows": {
        "lbgi": 8.501183831804484,
        "hbgi": 0.0,
        "gri": 100.0,
        "gmi": 5.1049070853174605,
        "cv": 23.562367802548266,
        "mean_glucose": 75.03792162698413,
        "tir_70_180": 55.13392857142857,
        "tbr_54": 18.278769841269842,
        "tbr_70": 44.86607142857143,
        "tar_180": 0.0,
        "tar_250": 0.0,
    },
    "mixed": {
        "lbgi": 3.1001888172482217,
        "hbgi": 6.354351987143671,
        "gri": 60.749007936507944,
        "gmi": 6.914083708333333,
        "cv": 40.25792143813134,
        "mean_glucose": 150.67239583333333,
        "tir_70_180": 55.729166666666664,
        "tbr_54": 6.076388888888888,
        "tbr_70": 10.863095238095239,
        "tar_180": 33.407738095238095,
        "tar_250": 5.381944444444445,
    },
}


@pytest.mark.parametrize("name", SERIES)
def test_two_other_packages_say_the_same(name: str) -> None:
    # their split between low and high is at 112.5, ours where the risk is zero (112.51): a part in 10^10
    assert glycaemic(SERIES[name]) == pytest.approx(OTHERS[name], rel=1e-9)


GLUCOSE = arrays.arrays(np.float64, st.integers(1, 200), elements=st.floats(10, 600))


@given(GLUCOSE)
def test_what_holds_for_every_run(glucose: np.ndarray) -> None:
    got = glycaemic(glucose)
    assert got["tbr_70"] + got["tir_70_180"] + got["tar_180"] == pytest.approx(100)
    assert got["tbr_54"] <= got["tbr_70"]
    assert got["tar_250"] <= got["tar_180"]
    assert 0 <= got["gri"] <= 100
    assert got["lbgi"] >= 0
    assert got["hbgi"] >= 0
    shuffled = glycaemic(glucose[::-1].copy())
    assert shuffled == pytest.approx(got)


def test_almost_no_glucose_has_a_finite_risk() -> None:
    assert np.isfinite(glycaemic(constant(0.3))["lbgi"])


@pytest.mark.parametrize("glucose", [[], [100.0, np.nan], [100.0, np.inf], [100.0, 0.0], [100.0, -5.0]])
def test_metrics_need_numbers(glucose: list[float]) -> None:
    with pytest.raises(ValueError, match="at least one sample, all of them positive"):
        glycaemic(np.array(glucose))


def test_percent() -> None:
    assert percent(np.array([True, False, False, False])) == 25
