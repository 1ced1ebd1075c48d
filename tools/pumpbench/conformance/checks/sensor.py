"""Sensor input (SEN): which samples may be used, and what for."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import STEPS_PER_DAY
from plant_server.physiology import cohort, load_patient
from plant_server.sensor import SensorSettings
from plant_server.sensors.coloured import Coloured
from plant_server.sensors.effects import Bias, Lag
from plant_server.sensors.ideal import Ideal
from plant_server.sensors.vettoretti2019 import Vettoretti2019
from pumpbench.calibration import SAFE, calibrate
from pumpbench.conformance.driver import GLUCOSE, HIGH, calibration, expect
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import dosing, expect_unused
from pumpbench.hazards import Monitor

OK = codec.choice("CGM_Reading", "CgmState", "Ok")
BELOW = codec.choice("CGM_Reading", "CgmState", "BelowRange")
ABOVE = codec.choice("CGM_Reading", "CgmState", "AboveRange")
STALE_BIT: Final = 1 << 4


@check("SEN-01")
def old_samples(dut: Dut) -> None:
    """Samples come with their age growing by one step each: above the schedule up to the limit, never beyond it."""
    limit = dut.settings.sensor.raise_age
    bench = dosing(dut)
    for age in range(1, 7):
        turn = bench.step(drop=True)
        expect(
            age <= limit or turn.rate <= bench.schedule,
            f"at most the schedule of {bench.schedule} when the newest sample is {age} steps old; {turn.rate} came",
        )
    bench = dosing(dut)
    for lag in range(4, 7):  # a sample that was delayed on its way is as old as it says
        late = bench.sample(HIGH, CgmSampleSeq=bench.k - lag, CgmSampleStep=(bench.k - lag) % 256)
        turn = bench.step(cgm=[late] if lag > 4 else [])
    turn = bench.step(cgm=[bench.sample(HIGH, CgmSampleSeq=bench.k - 5, CgmSampleStep=(bench.k - 5) % 256)])
    expect(turn.rate <= bench.schedule, f"at most the schedule with samples that come 5 steps late; {turn.rate} came")
    expect(turn.status["LimiterBits"] & STALE_BIT != 0, "bit 4 of LimiterBits while a sample is too old")


@check("SEN-02")
def samples_of_the_future(dut: Dut) -> None:
    """A good frame whose CgmSampleStep is ahead by 1, 5 and 128 steps; then an alarm names the sensor."""
    for ahead in (1, 5, 128):
        bench = dosing(dut)
        before = bench.step(HIGH).used
        turn = bench.step(cgm=[bench.sample(HIGH, CgmSampleStep=(bench.k + ahead) % 256)])
        expect_unused(bench, turn, before, f"a sample dated {ahead} steps ahead")
        expect(bool(turn.alarms("CgmImplausible")), f"the alarm CgmImplausible for a sample dated {ahead} steps ahead")


@check("SEN-03")
def old_sequence_numbers(dut: Dut) -> None:
    """A frame that looks fresh (counter, CRC, CgmSampleStep) but has a CgmSampleSeq that was there already."""
    for behind in (0, 1, 10):
        bench = dosing(dut)
        before = bench.step(HIGH).used
        turn = bench.step(cgm=[bench.sample(HIGH, CgmSampleSeq=before - behind)])
        expect_unused(bench, turn, before, f"a sample whose CgmSampleSeq is {behind} behind the newest one")


@check("SEN-04")
def states_and_values(dut: Dut) -> None:
    """All 16 states, and values around the ends of the range, CRC right: only what is usable is used."""
    sensor = dut.settings.sensor
    bench = dosing(dut)
    for state in range(16):
        before = bench.step(HIGH).used
        turn = bench.step(cgm=[bench.forge(bench.sample(HIGH), CgmState=state)])
        if state not in (OK, BELOW, ABOVE):
            expect_unused(bench, turn, before, f"a sample with CgmState {state}")
        bench.run(3, HIGH)
    for glucose in (0, 1, sensor.low * 10 - 1, 8001, 8100, 8189, 8190, 8191):
        bench.run(2, HIGH)
        before = bench.step(HIGH).used
        for _ in range(2):  # the second agrees with the first: it is not the jump that is refused
            turn = bench.step(cgm=[bench.forge(bench.sample(), GlucoseConc=glucose)])
            expect_unused(bench, turn, before, f"a sample of raw {glucose}")
    for glucose in (sensor.low * 10, 390):
        bench.run(4, GLUCOSE)
        number = bench.number
        turn = bench.step(glucose)
        expect(turn.used == number, f"a sample of {glucose / 10:g} mg/dL is used; LastCgmSeq {turn.used} came")


@check("SEN-05")
def beyond_the_range(dut: Dut) -> None:
    """An hour of BelowRange and one of AboveRange: nothing and much, and never a sample that is missing."""
    safe = calibrate(load_patient("adult#001"), SAFE)
    bench = dut.bench(flash=safe)
    bench.run(12)
    for _ in range(12):
        turn = bench.step(cgm=[bench.sample(0, CgmState=BELOW)])
        expect(turn.rate == 0, f"no insulin below the sensor's range; {turn.rate} came")
    expect(not bench.raised("CgmLost"), "no CgmLost while the sensor is below its range")
    high, four_hundred = dut.bench(), []
    for reading in ({"CgmState": ABOVE, "GlucoseConc": 0}, {"GlucoseConc": 4000}):
        high = dut.bench()
        high.run(12)
        rates = [high.step(cgm=[high.sample(**reading)]).rate for _ in range(12)]
        expect(not high.raised("CgmLost"), "no CgmLost while the sensor is above its range")
        four_hundred.append(rates)
    expect(
        four_hundred[0] == four_hundred[1],
        f"the same doses for AboveRange as for 400 mg/dL, {four_hundred[1]}; {four_hundred[0]} came",
    )


@check("SEN-06")
def a_jump(dut: Dut) -> None:
    """One sample 180 mg/dL above its neighbours raises nothing; a second one that agrees is believed."""
    bench = dut.bench()
    bench.run(12)
    before = bench.step().rate
    turn = bench.step(GLUCOSE + 1800)
    expect(turn.rate <= before, f"no more than {before} after a single jump; {turn.rate} came")
    number = bench.number
    turn = bench.step(GLUCOSE + 1810)
    expect(turn.used == number, f"the second sample after a jump agrees and is used; LastCgmSeq {turn.used} came")
    bench = dut.bench()
    bench.run(12)
    number = bench.number
    turn = bench.step(GLUCOSE - 600)
    expect(turn.used == number, "a sample that falls by 60 mg/dL is used at once: it can only withhold")


@check("SEN-07")
def a_stuck_sensor(dut: Dut) -> None:
    """The same value again and again with a good sequence: unusable at the limit, and one other value ends it."""
    limit = dut.settings.sensor.stuck
    bench = dut.bench(flash=calibration(CfgStuckSamples=limit))
    for k in range(12):
        bench.step(HIGH + k % 2 * 10)
    last = 0
    for repeated in range(1, limit + 4):
        number = bench.number
        turn = bench.step(HIGH + 50)
        if repeated < limit:
            expect(turn.used == number, f"{repeated} equal samples are used, {limit} are a stuck sensor")
            last = number
        else:
            expect_unused(bench, turn, last, f"sample {repeated} of the same value")
    expect(bool(bench.raised("CgmImplausible")), f"the alarm CgmImplausible within {limit + 3} equal samples")


@check("SEN-08")
def trends_after_a_gap(dut: Dut) -> None:
    """Another level after a gap: the first doses are those for a steady glucose there, for one point is no trend."""
    settle, gap = dut.settings.sensor.settle, dut.settings.sensor.gap
    rates = []
    for before in (HIGH, GLUCOSE):
        bench = dut.bench()
        bench.run(12, before)
        for _ in range(gap + 2):
            bench.step(drop=True)
        rates.append([bench.step(HIGH).rate for _ in range(settle)])
    steady, risen = rates
    expect(
        all(after <= 1.1 * level for after, level in zip(risen, steady, strict=True)),
        f"after a gap no more for a glucose that has risen than for one that was there, {steady}; {risen} came",
    )


@check("SEN-09")
def a_sensor_in_doubt(dut: Dut) -> None:
    """CgmNoise above the limit, and the fault bits noise, compression and calibration: nothing above the schedule."""
    noisy = dut.settings.sensor.noise * 2
    quiet = {"CgmFaultBits": 0, "CgmSessionId": 1, "CgmSensorAge": 10, "CgmNoise": 0, "CgmDropCount": 0}
    for doubt in ({"CgmNoise": noisy + 1}, {"CgmFaultBits": 1}, {"CgmFaultBits": 2}, {"CgmFaultBits": 8}):
        bench = dosing(dut)
        turn = bench.step(HIGH, also=[bench.frame("CGM_Status", **quiet | doubt)])
        told = ", ".join(f"{name}={value}" for name, value in doubt.items())
        expect(turn.rate <= bench.schedule, f"at most the schedule with {told}; {turn.rate} came")
    bench = dosing(dut)
    turn = bench.step(HIGH, also=[bench.frame("CGM_Status", **quiet | {"CgmNoise": noisy})])
    expect(turn.rate > bench.schedule, f"CgmNoise of just the limit forbids nothing; {turn.rate} came")


@check("SEN-11")
def the_benchs_own_frames(dut: Dut) -> None:
    """PLANT_Truth and FAULT_Inject with wild values, and without them: the device's frames are the same."""
    said: list[list[Frame]] = []
    for wild in (False, True):
        bench = dut.bench()
        frames: list[Frame] = []
        for k in range(20):
            also = [
                bench.frame("PLANT_Truth", TruthSel=0, TruthStep=k, TruthGlucose=400 + k, TruthInterstitial=9000),
                bench.frame("FAULT_Inject", FaultTarget=1, FaultKind=1, FaultCanId=0x100, FaultCount=9, FaultParam=k),
            ]
            frames += bench.step(GLUCOSE + 10 * k, also=also if wild else []).frames
        said.append(frames)
    expect(said[0] == said[1], "the same frames whatever PLANT_Truth and FAULT_Inject say")


WORST: Final = SensorSettings(model=Coloured(), effects=(Lag(minutes=5.0), Bias(gain=1.1)))
"""10 % high, 5 min late and with noise of 5 mg/dL: as far off as an iCGM may be with that noise (21 CFR 862.1355)."""

LIMITS: Final = replace(SAFE, stuck_samples=0)
"""An exact sensor may well say the same for 45 min."""

MEALS: Final = ((7 * 12, 45.0), (13 * 12, 70.0), (19 * 12, 80.0))
"""Of a day: step and g of carbohydrates."""


@check("SEN-10")
def a_sensor_at_its_worst(dut: Dut) -> None:
    """A day of an adult with a sensor at its worst, long: a fortnight of ten, and sensors of another make besides.

    No hazard, and hardly more time below 54 mg/dL than with an exact sensor.
    """
    sensor = dut.settings.sensor
    for name in cohort() if dut.long else ["adult#001"]:
        exact = _share_below_54(dut, name, SensorSettings(model=Ideal()))
        most = sensor.low_factor * exact + sensor.low_extra
        for settings in (WORST, SensorSettings(model=Vettoretti2019())) if dut.long else (WORST,):
            share = _share_below_54(dut, name, settings)
            expect(
                share <= most,
                f"at most {most:.2f} % of the time below 54 mg/dL for {name} with a sensor of the model "
                f"{settings.model.name}; {share:.2f} % came",
            )


def _share_below_54(dut: Dut, name: str, sensor: SensorSettings) -> float:
    """Percent of the time; no hazard must be counted."""
    days = 14 if dut.long else 1
    meals = [(day * STEPS_PER_DAY + step, carbs) for day in range(days) for step, carbs in MEALS]
    patient = load_patient(name)
    loop = dut.loop("nma", meals, days * STEPS_PER_DAY, sensor=sensor, patient=patient, tuning=LIMITS)
    record, monitor = loop.watch, Monitor()

    def watch(frames: Sequence[Frame]) -> None:
        record(frames)
        monitor.watch(frames)

    loop.watch = watch
    loop.play()
    found = {hazard: count for hazard, count in monitor.hazards.items() if count}
    expect(not found, f"no hazard for {name}; {found} were counted, the first in step {monitor.hazards.found[:1]}")
    glucose = [page["TruthGlucose"] * 0.02 for page in loop.all("PLANT_Truth") if "TruthGlucose" in page]
    return 100 * sum(value < 54 for value in glucose) / len(glucose)
