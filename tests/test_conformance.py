"""The conformance suite as a whole: verdicts that can be trusted, also of firmware that misbehaves."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conformance_devices import Changed, Values, check_all
from conftest import ROOT, Pumpbench
from pumpbench.conformance import report as reports
from pumpbench.conformance import settings, suite
from pumpbench.conformance.registry import checks
from pumpbench.conformance.requirements import catalogue, requirements
from pumpbench.conformance.suite import Verdict

from can_bus.yaml_file import FileError

BAD = Path(__file__).with_name("bad_firmware.py")


# ---- the catalogue


def test_every_requirement_is_checked_or_says_why_not() -> None:
    for each in requirements().values():
        ways = [each.id in checks(), each.evidence is not None, each.open is not None]
        assert sum(ways) == 1, f"{each.id}: a check, evidence elsewhere or a reason, and only one of them"


def test_no_check_without_a_requirement_or_without_words() -> None:
    assert set(checks()) <= set(requirements())
    for name, found in checks().items():
        assert len(found.how) > 20, f"{name} does not say how it checks"


def test_evidence_exists() -> None:
    for each in requirements().values():
        for word in (each.evidence or "").split():
            if word.startswith("tests/"):
                path, _, function = word.strip(",;").partition("::")
                assert (ROOT / path).is_file(), each.id
                assert not function or f"def {function}" in (ROOT / path).read_text()


def test_sources_are_told() -> None:
    known = " ".join(catalogue().sources)
    assert "TPLC" in known
    assert all(each.source for each in requirements().values())


@pytest.mark.parametrize(("names", "count"), [([], 90), (["SEN"], 11), (["SEN-01"], 1), (["TIM", "SEN-03"], 6)])
def test_select(names: list[str], count: int) -> None:
    assert len(suite.select(names)) == count


@pytest.mark.parametrize("name", ["SEN-99", "XXX", "sen"])
def test_select_what_is_not_there(name: str) -> None:
    with pytest.raises(ValueError, match=f"no requirement '{name}'; give ids such as SEN-01"):
        suite.select([name])


def test_a_settings_file_with_a_wrong_key_names_it(tmp_path: Path) -> None:
    wrong = tmp_path / "mine.yaml"
    wrong.write_text(settings.DEFAULT.read_text().replace("raise_age: 3", "raise_old: 3"))
    with pytest.raises(FileError, match=r"mine.yaml:\d+: sensor.raise_(age|old)"):
        settings.load(wrong)


# ---- verdicts and reports


def always_high(name: str, values: Values) -> Values:
    """Takes every sample for one of 250 mg/dL."""
    return values | {"GlucoseConc": 2500} if name == "CGM_Reading" else values


def test_reports_of_a_device_that_fails(tmp_path: Path) -> None:
    report = check_all(Changed(always_high), ["SEN-04", "SEN-09", "SEN-11"])
    failed = report.of(Verdict.FAILED)
    assert [each.requirement.id for each in failed] == ["SEN-04"]
    assert not report.holds
    reports.write(report, tmp_path / "out", {"firmware": "changed"})
    told = json.loads((tmp_path / "out" / "report.json").read_text())
    assert told["holds"] is False
    assert told["firmware"] == "changed"
    assert {each["id"]: each["verdict"] for each in told["requirements"]}["SEN-04"] == "failed"
    tests = ElementTree.parse(tmp_path / "out" / "junit.xml").getroot()
    assert (tests.get("tests"), tests.get("failures"), tests.get("skipped")) == ("3", "1", "0")
    case = next(case for case in tests if case.find("failure") is not None)
    assert (case.get("name") or "").startswith("SEN-04 ")
    assert "| SEN-04 |" in (tmp_path / "out" / "report.md").read_text()
    story = (tmp_path / "out" / "SEN-04.txt").read_text()
    assert "CTRL_Status" in story
    lines = (tmp_path / "out" / "SEN-04.log").read_text().splitlines()
    assert len(lines) == len(failed[0].frames) > 100
    assert lines[0].startswith("(0.000000) can0 ")


def test_a_mended_device_leaves_no_old_logs(tmp_path: Path) -> None:
    reports.write(check_all(Changed(always_high), ["SEN-04"]), tmp_path, {})
    assert (tmp_path / "SEN-04.log").exists()
    reports.write(check_all(Changed(), ["SEN-04"]), tmp_path, {})
    assert not list(tmp_path.glob("SEN-04.*"))


def test_what_a_device_cannot_do_is_not_applicable_unless_it_must() -> None:
    def only_nma(name: str, values: Values) -> Values:
        return values | {"ModeRequest": 2} if name == "MODE_Cmd" else values

    report = check_all(Changed(only_nma), ["SEN-01"])
    assert "nma" in report.offers
    assert not report.offers & {"s1", "s3", "sma", "boluses"}
    must = suite.run(Changed(only_nma), settings.load(), wanted=[], must=["s3"])
    assert {"s3", "boluses", "pramlintide"} <= must.offers


# ---- the command


def test_the_command_on_the_reference(pumpbench: Pumpbench, tmp_path: Path) -> None:
    done = pumpbench(
        "conformance", "--only", "SEN-02,SEN-03", "--out", tmp_path / "report", "--junit", tmp_path / "j.xml"
    )
    assert done.returncode == 0, done.stderr
    assert "2 passed" in done.stdout
    assert (tmp_path / "j.xml").read_bytes() == (tmp_path / "report" / "junit.xml").read_bytes()


def test_the_command_on_a_process(pumpbench: Pumpbench) -> None:
    done = pumpbench("conformance", "--bus", "hub", "--only", "SEN-02", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert {"nma", "s3", "uds", "restart", "memory"} <= set(json.loads(done.stdout)["offers"])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--only", "SEN-77"], "there is no requirement 'SEN-77'"),
        (["--modes", "s9"], "there is no mode 's9'"),
        (["--firmware", "x"], "for another one give --bus hub"),
        (["--bus", "hub", "--firmware", "none"], "give its URL with --bus"),
        (["--settings", "/nowhere.yaml"], "cannot read /nowhere.yaml"),
        (["--bus", "unix"], "expected unix:/path"),
    ],
)
def test_wrong_usage(pumpbench: Pumpbench, options: list[str], text: str) -> None:
    done = pumpbench("conformance", *options)
    assert done.returncode == 2, done.stderr
    assert text in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


# ---- firmware that misbehaves: a verdict, no hang, nothing left running


def processes(word: str) -> list[str]:
    listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
    return [line for line in listed.stdout.splitlines() if word in line and "pumpbench conformance" not in line]


@pytest.fixture
def verdict(pumpbench: Pumpbench, tmp_path: Path) -> Callable[[str], "tuple[int, str]"]:
    def run(kind: str) -> tuple[int, str]:
        mark = tmp_path / "bus.sock"
        firmware = f"{sys.executable} {BAD} '{kind}' {{bus}} {mark}"
        options = ["--bus", "hub", "--firmware", firmware, "--timeout", "1", "--connect-timeout", "3"]
        began = time.monotonic()
        done = pumpbench("conformance", *options, "--only", "SEN-02,TIM-01")
        assert time.monotonic() - began < 100
        assert not processes(str(mark))
        return done.returncode, done.stdout + done.stderr

    return run


def test_a_firmware_that_never_answers(verdict: Callable[[str], "tuple[int, str]"]) -> None:
    status, text = verdict("mute")
    assert status == 3
    assert "nobody answers the roll call" in text


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("garbage", "good CRC"),
        ("floods", "the device does not stop"),
        ("other step", "it names"),
        ("hangs", "SYNC_Done within 1 s"),
        ("dies", "ended with status 7"),
    ],
)
def test_a_firmware_that_misbehaves(verdict: Callable[[str], "tuple[int, str]"], kind: str, text: str) -> None:
    status, told = verdict(kind)
    assert status == 1, told
    assert text in told
    assert "Traceback" not in told
