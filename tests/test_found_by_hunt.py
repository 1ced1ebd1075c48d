"""Shrunk cases of `pumpbench hunt` that still do harm; strict, so that whoever mends one has to move it."""

import pytest
from pumpbench import bench, faults


@pytest.mark.xfail(strict=True, reason="open: H3, random bytes on the pump's side that pass for a heartbeat of a boot")
def test_seed_1_case_6117() -> None:
    outcome = bench.run(
        patient="adult#001",
        strategy="sma",
        seed=1,
        scenario="validation-14d",
        hours=15.08,
        faults=[faults.babble(start="14:20", end="15:20", side="plant", message="HB_CTRL")],
    )
    outcome.assert_no_hazards()


@pytest.mark.xfail(strict=True, reason="open: H8, a memory torn in the first step of a run forgets the mode")
def test_seed_1_case_6137() -> None:
    outcome = bench.run(
        patient="adult#001",
        strategy="nma",
        seed=1,
        scenario="fasting",
        hours=1,
        faults=[faults.restart(start="00:05", memory="torn")],
    )
    outcome.assert_no_hazards()


@pytest.mark.xfail(strict=True, reason="open: H8, a torn memory while the pump's bolus states stand still")
def test_seed_1_case_8318() -> None:
    outcome = bench.run(
        patient="adult#001",
        strategy="s4",
        seed=1,
        scenario="six-hours",
        hours=4.75,
        faults=[
            faults.stuck_frame(start="04:15", end="04:30", message="PUMP_BolusState"),
            faults.restart(start="04:35", memory="torn"),
        ],
    )
    outcome.assert_no_hazards()
