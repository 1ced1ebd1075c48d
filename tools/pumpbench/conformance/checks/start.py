"""Start-up and self test (STA): what has to be there before a device gives more than the schedule."""

from collections.abc import Callable
from typing import Final

from firmware_sim.calibration import parameter_names
from pumpbench.calibration import with_crc
from pumpbench.conformance.boluses import COMMIT, PROGRAM, bolus_steps, meal_mode
from pumpbench.conformance.driver import HIGH, Bench, Turn, calibration, expect
from pumpbench.conformance.registry import Dut, check

TEN: Final = range(10)
"""CfgIndex of the parameters without which nothing is dosed: CfgBasal to CfgStaleCgmLimit."""

STEPS: Final = 8
"""With a high glucose a device that has everything gives more than the schedule by then."""


@check("STA-01")
def one_thing_missing(dut: Dut) -> None:
    """What a start needs is held back, one thing at a time, with a high glucose: at most the schedule, and no bolus."""
    complete = dut.bench()
    rate = complete.commanded(complete.run(STEPS, HIGH))
    expect(
        rate > complete.schedule, f"more than the schedule of {complete.schedule} with nothing missing; {rate:g} came"
    )
    for index in TEN:
        flash = {number: raw for number, raw in calibration().items() if number != index}
        _expect_at_most_schedule(dut.bench(flash=with_crc(flash)), f"without {parameter_names()[index]}")
    _expect_at_most_schedule(dut.bench(flash=calibration(CfgCarbRatio=0)), "with a CfgCarbRatio of 0")
    _expect_at_most_schedule(dut.bench(), "without PUMP_Status", lambda bench: bench.step(HIGH, status=False))
    _expect_at_most_schedule(dut.bench(), "without PUMP_Delivered", lambda bench: bench.step(HIGH, totals=False))
    few = dut.settings.start.samples - 1
    _expect_at_most_schedule(
        dut.bench(), f"after {few} samples", lambda bench: bench.step(HIGH, cgm=None if bench.k < few else [])
    )
    if "boluses" in dut.offers:
        loop = dut.loop(meal_mode(dut), meals=[(6, 60.0)], steps=10)
        loop.to_device = lambda name, _values, _frame: [] if name == "PUMP_BolusState" else None
        loop.play()
        begun = bolus_steps(loop, PROGRAM, COMMIT)
        expect(not begun, f"no bolus before a PUMP_BolusState was heard; one came in step {begun[:1]}")


def _expect_at_most_schedule(
    bench: Bench, what: str, step: Callable[[Bench], Turn] = lambda bench: bench.step(HIGH)
) -> None:
    schedule = calibration()[0] / 5  # of the patient, where the device knows none
    for _ in range(STEPS):
        turn = step(bench)
        rate = bench.commanded(turn) if turn.all("PUMP_BasalCmd") else 0.0
        expect(rate <= schedule, f"at most the schedule of {schedule:g} {what}; {rate:g} came in step {bench.k - 1}")
