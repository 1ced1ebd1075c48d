"""The checks of sensor input: the reference passes each, and each can fail."""

import pytest
from conformance_devices import Change, Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from firmware_sim import cgm
from firmware_sim.cgm import Cgm
from firmware_sim.ladder import Ladder, State


@pytest.mark.parametrize("requirement", [each.id for each in select(["SEN"]) if each.id != "SEN-10"])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def at_face_value(**fields: int) -> Change:
    """A device that takes these fields of every sample for what is given, 'seq' for the sample's number."""

    def hears(name: str, values: Values) -> Values:
        return values | fields if name == "CGM_Reading" else values

    return hears


def test_old_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgm, "AGE_USABLE", 9)
    monkeypatch.setattr(Ladder, "_next_rung", lambda *_: State.AUTO)
    expect_failed("SEN-01", "at most the schedule")


def test_samples_of_the_future() -> None:
    def undated(name: str, values: Values) -> Values:
        return values | {"CgmSampleStep": values["CgmSampleSeq"] % 256} if name == "CGM_Reading" else values

    expect_failed("SEN-02", "a sample dated 1 steps ahead is not used", Changed(undated))


def test_old_sequence_numbers() -> None:
    numbers = iter(range(1000))

    def renumbered(name: str, values: Values) -> Values:
        return values | {"CgmSampleSeq": next(numbers)} if name == "CGM_Reading" else values

    expect_failed("SEN-03", "CgmSampleSeq is 0 behind", Changed(renumbered))


def test_states_and_values() -> None:
    expect_failed("SEN-04", "CgmState 0 is not used", Changed(at_face_value(CgmState=1)))


def test_values_out_of_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgm, "GLUCOSE_HIGH", 8191)
    expect_failed("SEN-04", "a sample of raw 8001 is not used")


@pytest.mark.parametrize(("state", "text"), [(4, "no insulin below"), (5, "a set-point")])
def test_beyond_the_range(state: int, text: str) -> None:
    def missing(name: str, values: Values) -> Values | None:
        return None if name == "CGM_Reading" and values["CgmState"] == state else values

    expect_failed("SEN-05", text, Changed(missing))


def test_a_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgm, "JUMP", 5000)
    expect_failed("SEN-06", "after a single jump")


def test_a_jump_that_is_never_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cgm, "_jumped", lambda self, glucose, _taken: glucose > self._glucose_last + 500 > 500)
    expect_failed("SEN-06", "the second sample after a jump")


def test_a_stuck_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cgm, "_stuck", lambda *_: False)
    expect_failed("SEN-07", "sample 10 of the same value is not used")


def test_trends_after_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgm, "SETTLING_SAMPLES", 0)
    expect_failed("SEN-08", "after a gap")


def test_a_sensor_in_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cgm, "status", lambda *_: None)
    expect_failed("SEN-09", "at most the schedule with CgmNoise=31")


def test_the_benchs_own_frames() -> None:
    truth: Values = {}

    def peeping(name: str, values: Values) -> Values:
        if name == "PLANT_Truth":
            truth["GlucoseConc"] = 1800
        return values | truth if name == "CGM_Reading" else values

    expect_failed("SEN-11", "whatever PLANT_Truth", Changed(peeping))
