"""The round-trip benchmark runs, and its figures are what they are called."""

from __future__ import annotations

import pytest
from pumpbench.benchmark.round_trips import CEILING_OF, measure, round_trips

KINDS = [pytest.param(kind, marks=[pytest.mark.vcan] if kind == "vcan" else []) for kind in CEILING_OF]


@pytest.mark.parametrize("kind", KINDS)
def test_round_trips_beside_their_ceiling(kind: str) -> None:
    rate, p50, p99 = figures = round_trips(kind, steps=100, runs=1)
    assert [figure["name"] for figure in figures] == [f"round-trips/{kind}{end}" for end in ("", "/p50", "/p99")]
    assert [figure["unit"] for figure in figures] == ["1/s", "us", "us"]
    assert p50["value"] <= p99["value"]
    assert rate["ratio"] == pytest.approx(rate["value"] / rate["ceiling"], rel=0.02)
    assert p50["ratio"] == pytest.approx(p50["ceiling"] / p50["value"], rel=0.1)
    assert rate["runs"] == 1


@pytest.mark.parametrize("kind", KINDS)
def test_the_ceiling_of_a_whole_step_has_a_listener_that_sees_every_frame(kind: str) -> None:
    rate, p50, p99 = measure(CEILING_OF[kind], 100, 3, 5, listener=True)
    assert rate > 0 and 0 < p50 <= p99


def test_a_process_that_does_not_start_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/bin/true")
    with pytest.raises(RuntimeError, match=r"a process of the benchmark \(can-member\) did not start"):
        measure("bare-can", 10)
