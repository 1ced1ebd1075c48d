"""The plugin as a firmware repository meets it: tests of its own, options, and what a failed test leaves."""

import re
import sys

import pytest
from pumpbench.runfolder import RunFolder

pytest_plugins = ["pytester"]

TEST = """
from pumpbench.faults import drop

LOST = drop("CGM_Reading", start="01:00", end="01:40")

def test_holds(bench):
    outcome = bench.run(strategy="nma", scenario="six-hours", hours=3, faults=[LOST])
    outcome.assert_alarm("CgmLost", after="01:00", within="00:20")

def test_fails(bench):
    bench.run(strategy="nma", scenario="fasting", hours=0.5)
    outcome = bench.run(strategy="nma", scenario="six-hours", hours=3, faults=[LOST])
    outcome.assert_alarm("Occlusion", node="PUMP")

def test_fails_without_a_run(bench):
    assert False
"""


def test_a_failed_test_tells_the_story_and_leaves_its_recordings(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(TEST)
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=1, failed=2)
    result.stdout.fnmatch_lines(
        [
            "E       AssertionError: PUMP did not raise Occlusion after 00:00; it raised: nothing",
            "*pumpbench run 0*",
            "patient adult#001, strategy nma, scenario fasting*",
            "*pumpbench run 1*",
            "01:00  fault Drop CGM_Reading",
            "01:15  CTRL raises CgmLost (Medium)",
            "recording: *test_fails-1/recording.rrd",
            "picture:   *test_fails-1/summary.png",
            "picture:   *test_fails-1/fault-1-0100-Drop-CGM_Reading-CgmLost.png",
        ]
    )
    assert "def assert_alarm" not in result.stdout.str()  # the traceback ends in the test
    kept = sorted(path for path in (pytester.path / "pumpbench-failed").iterdir() if path.is_dir())
    assert [path.name.rpartition("-test_")[2] for path in kept] == ["fails-0", "fails-1"]
    for path in kept:
        assert RunFolder.load(path).summary.read_bytes().startswith(b"\x89PNG")
    assert not list(kept[0].glob("fault-*.png"))
    assert len(list(kept[1].glob("fault-*.png"))) == 1


@pytest.mark.nightly
def test_a_page_for_the_summary_of_ci_tells_of_this_session_only(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(TEST)
    for _ in range(2):
        pytester.runpytest_subprocess("-p", "no:cacheprovider", "-k", "test_fails").assert_outcomes(failed=2)
    page = (pytester.path / "pumpbench-failed" / "summary.md").read_text()
    headings = [line for line in page.splitlines() if line.startswith("### ")]
    assert [heading.rpartition("::")[2] for heading in headings] == ["test_fails, run 0", "test_fails, run 1"]
    assert "AssertionError: PUMP did not raise Occlusion after 00:00; it raised: nothing" in page
    assert "01:15  CTRL raises CgmLost (Medium)" in page
    assert "<summary>01:00 Drop CGM_Reading, CgmLost</summary>" in page
    assert "| d0 01:00 | fault | Drop CGM_Reading for 40 min |" in page
    for name in re.findall(r"`([^` ]+\.(?:png|rrd))`", page):
        assert (pytester.path / "pumpbench-failed" / name).is_file(), name
    pytester.runpytest_subprocess("-p", "no:cacheprovider", "-k", "test_holds").assert_outcomes(passed=1)
    assert not (pytester.path / "pumpbench-failed" / "summary.md").exists()


def test_bus_firmware_and_folder_are_options_and_ini_keys(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def test_bus(bench):
            outcome = bench.run(strategy="nma", scenario="fasting", hours=0.5)
            assert outcome.info["bus"] == "hub" and "firmware_sim" in outcome.info["firmware"]
            assert outcome.folder.is_dir()
            assert bench.run(strategy="nma", scenario="fasting", hours=0.5, bus="inproc", firmware=None).folder is None
            assert False, "to see what is kept"
        """
    )
    pytester.makeini("[pytest]\npumpbench_bus = hub\npumpbench_out = kept")
    firmware = f"{sys.executable} -m firmware_sim --bus {{bus}}"
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--pumpbench-firmware", firmware)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["E       AssertionError: to see what is kept"])
    assert len([path for path in (pytester.path / "kept").iterdir() if path.is_dir()]) == 2


def test_a_disk_that_is_full_hides_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(TEST)
    (pytester.path / "in-the-way").write_text("")
    result = pytester.runpytest_subprocess(
        "-p", "no:cacheprovider", "--pumpbench-out", "in-the-way", "-k", "test_fails"
    )
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*PUMP did not raise Occlusion*", "the run could not be kept: *"])


def test_the_plugin_costs_a_project_without_a_bench_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import sys
        def test_light():
            assert "pumpbench.pytest_plugin" in sys.modules
            assert not {"numpy", "numba", "rerun", "matplotlib", "can"} & set(sys.modules)
        """
    )
    pytester.runpytest_subprocess("-p", "no:cacheprovider", "-p", "no:hypothesispytest").assert_outcomes(passed=1)
