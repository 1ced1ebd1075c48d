"""Variability: its ranges, and streams that never disturb one another."""

import math

import numpy as np
import pytest

from plant_server import physiology
from plant_server.physiology import NOMINAL, SOURCES, MealFactors, Variability, integrate
from plant_server.physiology import parameters as par


def test_ranges_and_spread():
    draws = np.array([Variability(seed, "adult#001").meal(index) for seed in range(40) for index in range(25)])
    for column, (low, high) in zip(draws.T, [(0.7, 1.3), (0.9, 1.1), (0.7, 1.3)], strict=True):
        assert low <= column.min() < low + 0.01 * (high - low) + 0.005
        assert high - 0.01 * (high - low) - 0.005 < column.max() < high
        assert column.mean() == pytest.approx(1.0, abs=0.02)
        assert column.std() == pytest.approx((high - low) / math.sqrt(12), rel=0.05)
    assert np.max(np.abs(np.corrcoef(draws.T) - np.eye(3))) < 0.1
    days = [Variability(seed, name) for seed in range(100) for name in physiology.cohort()]
    amplitudes = np.array([day.circadian_amplitude for day in days])
    phases = np.array([day.circadian_phase for day in days])
    assert -0.3 <= amplitudes.min() < -0.29 < 0.29 < amplitudes.max() < 0.3
    assert 0.0 <= phases.min() < 0.05 < 6.23 < phases.max() < 2 * math.pi
    assert abs(np.corrcoef(amplitudes, phases)[0, 1]) < 0.1


def test_same_seed_same_numbers_on_any_machine():
    """Written down once: they depend on sha256 and PCG64 alone."""
    variability = Variability(1, "adult#001")
    assert variability.meal(0) == pytest.approx(EXPECTED_MEAL, rel=1e-15)
    assert variability.circadian_amplitude == pytest.approx(EXPECTED_AMPLITUDE, rel=1e-15)


EXPECTED_MEAL = (0.7815528910011591, 1.0731281595704008, 0.9735130538937813)
EXPECTED_AMPLITUDE = -0.07488817123079167


def test_a_meal_is_the_same_whenever_it_is_asked_for():
    forward = [Variability(3, "adult#002").meal(index) for index in range(6)]
    backward = [Variability(3, "adult#002").meal(index) for index in reversed(range(6))]
    assert forward == backward[::-1]
    assert len(set(forward)) == 6


@pytest.mark.parametrize("off", SOURCES)
def test_switching_a_source_off_shifts_no_other(off):
    everything = Variability(9, "adult#003")
    without = Variability(9, "adult#003", SOURCES.keys() - {off})
    for index in range(4):
        a, b = everything.meal(index), without.meal(index)
        for field, source in (("k_abs", "k_abs"), ("f", "f"), ("insulin", "insulin_pk")):
            expected = 1.0 if source == off else getattr(a, field)
            assert getattr(b, field) == expected
    expected = 0.0 if off == "circadian" else everything.circadian_amplitude
    assert without.circadian_amplitude == expected


def test_patients_and_seeds_differ():
    values = {Variability(seed, name).meal(0) for seed in range(5) for name in physiology.cohort()}
    assert len(values) == 50


def test_all_off_changes_nothing():
    patient = physiology.load_patient("adult#004")
    variability = Variability(5, "adult#004", ())
    assert variability.meal(7) == NOMINAL
    assert np.array_equal(variability.apply(patient.params, variability.meal(7)), patient.params)


def test_apply_writes_a_copy():
    patient = physiology.load_patient("adult#004")
    before = patient.params.copy()
    variability = Variability(5, "adult#004")
    factors = MealFactors(k_abs=1.2, f=1.1, insulin=0.8)
    p = variability.apply(patient.params, factors)
    assert np.array_equal(patient.params, before)
    assert p.flags.writeable
    expected = before.copy()
    expected[par.K_ABS] *= 1.2
    expected[par.F] = 0.9 * 1.1
    expected[[par.KA1, par.KA2, par.KD]] *= 0.8
    expected[par.CIRCADIAN_AMPLITUDE] = variability.circadian_amplitude
    expected[par.CIRCADIAN_PHASE] = variability.circadian_phase
    assert np.array_equal(p, expected)
    out = np.empty_like(p)
    assert variability.apply(patient.params, factors, out) is out
    assert np.array_equal(out, expected)


def test_no_more_glucose_appears_than_was_eaten():
    p = physiology.load_patient("adult#001").params.copy()
    p[par.F] = 0.97
    assert Variability(1, "adult#001").apply(p, MealFactors(f=1.1))[par.F] == 1.0


def test_circadian_course():
    p = physiology.load_patient("adult#001").params.copy()
    assert integrate.circadian_factor(300.0, p) == 1.0
    p[par.CIRCADIAN_AMPLITUDE], p[par.CIRCADIAN_PHASE] = 0.25, math.pi / 2
    assert integrate.circadian_factor(0.0, p) == 1.25
    assert integrate.circadian_factor(360.0, p) == pytest.approx(1.0)
    assert integrate.circadian_factor(720.0, p) == pytest.approx(0.75)
    assert integrate.circadian_factor(1440.0 * 14, p) == pytest.approx(1.25)


def test_unknown_source():
    with pytest.raises(ValueError, match=r"'weather'.*circadian"):
        Variability(1, "adult#001", ["f", "weather"])
