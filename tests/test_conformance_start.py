"""The checks of start-up, and of a sensor at its worst: the reference passes each, and each can fail."""

from collections.abc import Callable
from pathlib import Path

import pytest
from conformance_devices import Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.requirements import requirements
from test_conformance_ladder import Patch

from firmware_sim import calibration
from firmware_sim.bolus import Boluses
from firmware_sim.cgm import Cgm
from firmware_sim.ladder import Ladder, State
from firmware_sim.pump import Pump

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("requirement", ["STA-01", "SEN-10"])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def test_what_no_wire_shows_is_tested_elsewhere() -> None:
    evidence = requirements()["STA-02"].evidence
    assert evidence is not None
    for path in evidence.split(", "):
        assert "Failure" in (ROOT / path).read_text(encoding="utf-8")


# ---- STA-01


def test_never_above_the_schedule_shows_nothing() -> None:
    def timid(name: str, values: Values) -> Values:
        is_rate = name == "PUMP_BasalCmd" and values["BasalOp"] == 1
        return values | {"InsulinRate": min(values["InsulinRate"], 285)} if is_rate else values

    expect_failed("STA-01", "more than the schedule of 285 with nothing missing", Changed(says=timid))


@pytest.mark.parametrize("index", [4, 6, 7, 9])
def test_a_parameter_is_not_missed(monkeypatch: Patch, index: int) -> None:
    monkeypatch.setattr(calibration, "NEEDED", tuple(set(calibration.NEEDED) - {index}))
    names = calibration.parameter_names()
    monkeypatch.setattr(
        calibration, "UNSET", calibration.UNSET | {names[index]: calibration.UNSET.get(names[index], 0)}
    )
    expect_failed("STA-01", f"at most the schedule of 285 without {names[index]}")


def test_a_ratio_of_nothing_is_taken(monkeypatch: Patch) -> None:
    monkeypatch.setattr(calibration, "LOWEST", {})
    expect_failed("STA-01", "with a CfgCarbRatio of 0")


@pytest.mark.parametrize(("there", "name"), [("totals", "PUMP_Status"), ("status", "PUMP_Delivered")])
def test_half_a_pump_is_enough(monkeypatch: Patch, there: str, name: str) -> None:
    monkeypatch.setattr(Pump, "age", lambda self, step: step - getattr(self, f"_{there}_step"))
    expect_failed("STA-01", f"at most the schedule of 285 without {name}")


def test_one_sample_is_enough(monkeypatch: Patch) -> None:
    update: Callable[..., State] = Ladder.update

    def hasty(self: Ladder, *, streak: int, age: int, **how: bool | int) -> State:
        return update(self, streak=2, age=0, **how)

    monkeypatch.setattr(Ladder, "update", hasty)
    expect_failed("STA-01", "at most the schedule of 285 after 1 samples")


def test_a_bolus_before_the_pump_has_told_of_its_own(monkeypatch: Patch) -> None:
    monkeypatch.setattr(Boluses, "known", property(lambda _self: True))
    expect_failed("STA-01", "no bolus before a PUMP_BolusState was heard")


# ---- SEN-10


def test_a_device_that_takes_noise_for_a_rise(monkeypatch: Patch) -> None:
    """It trusts what is high, and the more of it the noisier the sensor says it is."""
    glucose = Cgm._glucose
    noise = 0

    def hears(name: str, values: Values) -> Values:
        nonlocal noise
        noise = values["CgmNoise"] if name == "CGM_Status" else noise
        return values

    def trusting(sample: dict[str, int]) -> int:
        return min(glucose(sample) + noise * 150, 8000)

    monkeypatch.setattr(Cgm, "_glucose", staticmethod(trusting))
    expect_failed("SEN-10", "% of the time below 54 mg/dL for adult#001", Changed(hears=hears))


def test_a_device_with_a_hazard(monkeypatch: Patch) -> None:
    monkeypatch.setattr(Cgm, "_glucose", staticmethod(lambda sample: sample["GlucoseConc"]))

    def renumbered(name: str, values: Values) -> Values:
        return values | {"LastCgmSeq": values["LastCgmSeq"] + 1} if name == "CTRL_Status" else values

    expect_failed("SEN-10", "no hazard for adult#001; {'H3': ", Changed(says=renumbered))
