"""What our pump has to do, over the wire: the bench is the patient, the sensor, the pump and the clock."""

import pytest
from pumpbench.faults import drop, flip_bits

PATIENTS = ["adult#001", "adult#004"]


@pytest.mark.parametrize("patient", PATIENTS)
def test_a_day_at_rest(bench, patient):
    outcome = bench.run(patient=patient, strategy="nma", scenario="fasting", hours=24)
    outcome.assert_no_hazards()
    outcome.assert_ledger_closes()
    assert outcome.minutes_below(70) == 0


def test_two_hours_without_a_sensor(bench):
    outcome = bench.run(strategy="nma", hours=6, faults=[drop("CGM_Reading", start="02:00", end="04:00")])
    outcome.assert_alarm("CgmLost", after="02:00", within="00:25")
    outcome.assert_state("SafeBasal", at="03:00")
    outcome.assert_back_to("Auto", after="04:00", within="00:30")
    outcome.assert_no_hazards()


def test_a_noisy_bus(bench):
    outcome = bench.run(strategy="nma", hours=6, faults=[flip_bits("CGM_Reading", bits=[20], probability=0.2)])
    assert outcome.counters["e2e_errors"] > 0
    outcome.assert_no_hazards()
