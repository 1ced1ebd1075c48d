"""Shrunk cases that `pumpbench hunt` found, kept when what they showed was mended."""

from pumpbench import bench, faults


def test_seed_1_case_6117() -> None:
    """Random bytes pass for a boot of the device; the answer to the token that the plant repeats ends no other step."""
    outcome = bench.run(
        patient="adult#001",
        strategy="sma",
        seed=1,
        scenario="validation-14d",
        hours=15.08,
        faults=[faults.babble(start="14:20", end="15:20", side="plant", message="HB_CTRL")],
    )
    outcome.assert_no_hazards()


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
