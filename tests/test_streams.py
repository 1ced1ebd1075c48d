"""Random streams: one for every purpose, the same everywhere and always."""

import itertools

import numpy as np
import pytest

from plant_server.streams import stream


def test_a_stream_is_the_same_everywhere_and_always() -> None:
    words = [11238110456586516430, 6462324755329566321, 5863919033606409003]
    assert stream(1, "adult#001", "cgm").bit_generator.random_raw(3).tolist() == words


def test_another_seed_patient_or_purpose_is_another_stream() -> None:
    names = list(itertools.product((0, 1, 2), ("adult#001", "adult#002", ""), ("cgm", "cgm common", "tuning times")))
    numbers = np.array([stream(*name).standard_normal(4000) for name in names])
    between = np.corrcoef(numbers) - np.eye(len(names))
    assert np.abs(between).max() < 0.075, "of 351 pairs none is correlated"


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_fewer_numbers_are_the_beginning_of_more(count: int) -> None:
    for draw in ("random", "standard_normal"):
        short, long = (getattr(stream(3, "adult#001", "x"), draw)(n) for n in (count, 2000))
        assert np.array_equal(short, long[:count])
