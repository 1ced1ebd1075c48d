"""The benchmark's parts run and are what they are called, and the page is made of the figures."""

import pytest
from pumpbench.benchmark import beside, page, parts
from pumpbench.benchmark.figure import Figure


def test_every_part_gives_a_figure_with_its_ceiling() -> None:
    found = parts.figures(quick=True)
    assert [each["name"] for each in found] == [
        "codec/pack", "codec/unpack", "codec/protected", "recorder/listening", "recorder/writing",
        "start/pumpbench --version", "start/firmware --help", "start/first compiled day", "memory/campaign",
        "scaling/ten patients",
    ]  # fmt: skip
    for each in found:
        assert set(each) == {"name", "value", "unit", "ceiling", "ratio", "runs"}
        assert each["value"] > 0 and each["ceiling"] > 0 and each["ratio"] > 0, each["name"]


@pytest.mark.nightly
def test_a_recorder_beside_the_loop() -> None:
    found = beside.figures(days=1, runs=1)
    assert [each["name"] for each in found] == ["recorder/beside", "recorder/watched"]
    assert all(each["value"] > 0 and each["ceiling"] > 0 for each in found)


def test_the_page_has_every_figure_and_the_machine() -> None:
    figure = Figure(name="closed-loop/x", value=1234.5, unit="patient-days/s", ceiling=2.5, ratio=493.8, runs=3)
    text = page.page([figure])
    assert "| `closed-loop/x` | 1,234.5 | patient-days/s | 2.5 | 493.8 | 3 |" in text
    assert page.machine() in text and "numba" in page.machine()


def test_what_others_wrote_below_the_figures_stays() -> None:
    figure = Figure(name="x", value=1.0, unit="1/s", ceiling=2.0, ratio=0.5, runs=1)
    clone = "\n## A fresh clone\n| `make run` | 0:50 |\n\n## More\ntext\n"
    before = page.page([figure]) + clone
    assert page.page([figure], before) == before
    newer = page.page([Figure(figure, value=3.0)], before)
    assert newer.endswith(clone) and newer.count("## ") == before.count("## ")
