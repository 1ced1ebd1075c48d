"""Limits (LIM): what no dose may exceed, and that a cut is told; flashed tight, as a product has them."""

import itertools
from collections.abc import Callable, Sequence
from typing import Final

from can_bus import codec
from can_bus.codec import Transmitter
from plant_server.bolus import STROKE_RAW
from plant_server.mechanism import DELIVERED
from plant_server.pump import Pump, PumpSettings
from plant_server.server import PlantError
from pumpbench.calibration import MODES, with_crc
from pumpbench.conformance.boluses import (
    ACCEPTED,
    COMMIT,
    DOSE,
    DRUGS,
    FIRST,
    INSULIN,
    PRAMLINTIDE,
    PROGRAM,
    Forged,
    commands,
    flash,
    meal_mode,
    programs,
)
from pumpbench.conformance.driver import (
    GLUCOSE,
    HIGH,
    NMA,
    SUSPEND,
    Bench,
    Op,
    Turn,
    calibration,
    expect,
    parameter_index,
)
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import MEALTIME, Dut, check

ADULT: Final = "adult#001"

RATIO: Final = ("s2", "s4")
"""Modes with a pramlintide infusion."""

MAX_BASAL, MAX_BOLUS, MAX_IOB, LOW_GLUCOSE, LOCKOUT, DAY, RISE = (1 << bit for bit in (0, 1, 2, 3, 5, 6, 7))
"""LimiterBits."""


def tight(dut: Dut, **raws: int) -> dict[str, int]:
    """Raw calibration values by signal name: the limits of the settings, and others of one's own."""
    limits = dut.settings.limits
    return {
        "CfgBasalFactor": round(limits.basal_factor * 10),
        "CfgLowSuspend": limits.low * 10,
        "CfgBolusLockout": -(-limits.lockout // 5),
        "CfgMaxRise": round(limits.rise * 1000),
        "CfgPramTdd": limits.pramlintide_day * 10,
    } | raws


def rate_of(turn: Turn, schedule: int) -> int:
    """The insulin rate that this turn asks for, 0.005 U/h; without a set-point the schedule."""
    found = turn.all("PUMP_BasalCmd")
    if not found or found[-1]["BasalOp"] == Op.RESUME_SCHEDULE:
        return schedule
    return found[-1]["InsulinRate"] if found[-1]["BasalOp"] == Op.SET_RATE else 0


def climb(k: int) -> int:
    """Glucose of step k: from 120 to 400 mg/dL, without a jump."""
    return min(GLUCOSE + 400 * max(k - 3, 0), 4000)


def swing(k: int) -> int:
    """Glucose of step k: an hour up and down between 160 and 400 mg/dL."""
    return 4000 - 400 * abs(k % 12 - 6)


@check("LIM-01")
def rates(dut: Dut) -> None:
    """Three hours at 400 mg/dL with CfgMaxBasal far above and at twice the schedule."""
    basal = calibration()[0]
    factor = dut.settings.limits.basal_factor
    for most in (30000, 2 * basal):
        bench = dut.bench(flash=calibration(ADULT, **tight(dut, CfgMaxBasal=most)))
        cap = int(min(most, factor * basal)) // 5
        for k in range(36):
            rate = rate_of(bench.step(climb(k)), bench.schedule)
            expect(rate <= cap, f"at most the rate {cap} (0.005 U/h) with CfgMaxBasal {most}; {rate} came in step {k}")


@check("LIM-02", needs=["boluses"])
def boluses(dut: Dut) -> None:
    """Meals of 1 to 500 g in every mode with boluses, with largest doses of 2.03 U and 1.7 ug, no whole strokes."""
    largest = {INSULIN: 203, PRAMLINTIDE: 17}
    meals = [(FIRST + 4 * k, carbs) for k, carbs in enumerate((1.0, 30.0, 149.0, 150.0, 300.0, 500.0))]
    for mode in MEALTIME:
        if mode not in dut.offers:
            continue
        loop = dut.loop(mode, meals, steps=meals[-1][0] + 3)
        flash(loop, CfgMaxBolus=largest[INSULIN], CfgPramBolus=largest[PRAMLINTIDE])
        loop.play()
        expect(bool(programs(loop)), f"a bolus for one of {len(meals)} meals in mode {mode}; none was programmed")
        for each in commands(loop):
            expect(
                each.dose <= largest.get(each.drug, 0),
                f"a bolus of {DRUGS.get(each.drug)} of at most raw {largest.get(each.drug)} in mode {mode}; "
                f"{each.dose} came in step {each.step}",
            )


@check("LIM-03")
def insulin_on_board(dut: Dut) -> None:
    """Insulin that nobody asked for lifts InsulinOnBoard over CfgMaxIob; then five meals in half an hour try to.

    In the first case at most the schedule while it is above, in the second it never gets there.
    """
    bench = dut.bench(flash=calibration(CfgMaxIob=300))
    rate = rate_of(bench.run(12, HIGH), bench.schedule)
    expect(rate > bench.schedule, f"more than the schedule at {HIGH / 10:g} mg/dL before the limit; {rate} came")
    bench.total += 12 * 5000  # the pump has given 5 U more
    for _ in range(6):
        turn = bench.step(HIGH)
        rate, iob = rate_of(turn, bench.schedule), turn.iob
        expect(iob > 300, f"more than 3 U on board after 5 U; InsulinOnBoard {iob} came")
        expect(rate <= bench.schedule, f"at most the schedule with InsulinOnBoard {iob} above its limit; {rate} came")
    if "boluses" not in dut.offers:
        return  # it gives none
    meals = [(FIRST + k, 60.0) for k in range(5)]
    loop = dut.loop(meal_mode(dut), meals, steps=FIRST + 12)
    flash(loop, CfgMaxIob=200)
    loop.play()
    for step, iob in enumerate(loop.iob()):
        expect(
            iob <= 200 + STROKE_RAW, f"InsulinOnBoard of at most 200 (0.01 U) and a stroke; {iob} came in step {step}"
        )


@check("LIM-04")
def limits_not_set(dut: Dut) -> None:
    """CfgMaxBasal, CfgMaxBolus and CfgMaxIob left out one by one, then sent with a value that is out of range."""
    for name in ("CfgMaxBasal", "CfgMaxIob"):
        for invalid in (False, True):
            bench = dut.bench(start=False, flash=_without(name))
            bench.call_roll()
            if invalid:
                wrong = bench.frame("CFG_Param", CfgIndex=parameter_index(name), **{name: 0})
                bench.give(bench.forge(wrong, **{name: codec.message("CFG_Param").fields[name].mask}))
            bench.configure(bench.flash, NMA)
            for k in range(16):
                rate = rate_of(bench.step(climb(k)), bench.schedule)
                how = "out of range" if invalid else "not set"
                expect(rate <= bench.schedule, f"at most the schedule with {name} {how}; {rate} came in step {k}")
    if "boluses" not in dut.offers:
        return  # it gives none
    for name in ("CfgMaxBolus", "CfgMaxIob"):
        loop = dut.loop(meal_mode(dut), [(FIRST, 30.0)], steps=FIRST + 3)
        loop.plant.run = loop.plant.run._replace(calibration=_without(name))
        try:
            loop.play()
        except PlantError as error:
            expect("did not accept" in str(error), f"a run, or that the set without {name} is refused; {error}")
            continue
        asked = programs(loop, INSULIN)
        expect(not asked, f"no bolus with {name} not set; raw {asked[0].dose if asked else 0} was programmed")


def _without(name: str) -> dict[int, int]:
    return with_crc({index: raw for index, raw in calibration().items() if index != parameter_index(name)})


@check("LIM-05")
def low_glucose(dut: Dut) -> None:
    """From 180 mg/dL down by 15 in a step to just below the limit, where it stays; a meal is told on the way down.

    No insulin from the first sample below the limit on; before it, where the line through three samples gets there in
    time, at most the schedule and no bolus.
    """
    low, ahead = dut.settings.limits.low * 10, dut.settings.limits.ahead // 5
    bench = dut.bench(flash=calibration(ADULT, **tight(dut)))
    samples: list[int] = []
    for k in range(36):
        samples.append(max(1800 - 150 * max(k - 11, 0), low - 1) - k % 2)
        rate = rate_of(bench.step(samples[-1]), bench.schedule)
        if samples[-1] < low:
            expect(rate == 0, f"no insulin at {samples[-1] / 10} mg/dL; {rate} came in step {k}")
        elif len(samples) >= 3 and _line(samples[-3:], ahead) < low - 20:
            expect(rate <= bench.schedule, f"at most the schedule before a low; {rate} came in step {k}")
    if "boluses" not in dut.offers:
        return  # it gives none
    loop = dut.loop(meal_mode(dut), [(FIRST + 3, 30.0)], steps=FIRST + 6)
    flash(loop, **tight(dut))

    def falling(_name: str, reading: Values) -> Sequence[Values]:
        glucose = 1400 - 120 * max(loop.plant.step - FIRST, 0)
        return [reading | {"GlucoseConc": glucose, "GlucoseRate": -1024}]

    loop.to_device = Forged(falling, "CGM_Reading")
    loop.play()
    asked = programs(loop)
    expect(not asked, f"no bolus while a low is predicted within {5 * ahead} min; one was programmed")


def _line(samples: Sequence[int], ahead: int) -> float:
    """The line through three samples, so many steps after the last one."""
    return sum(samples) / 3 + (ahead + 1) * (samples[2] - samples[0]) / 2


@check("LIM-06")
def a_day(dut: Dut) -> None:
    """Glucose swinging up to 400 mg/dL with a usual day of 3 U, also with a reset on the way; a ratio mode.

    The pump's totals stay within what 24 h may hold of each drug.
    """
    most = round(300 * dut.settings.limits.tdd_factor) * 10  # mU

    def run(bench: Bench, steps: int) -> None:
        for _ in range(steps):
            bench.step(swing(bench.k))
            given = bench.total / 12
            expect(
                given <= most + 10, f"at most {most} mU of insulin in 24 h; {given:.0f} were given by step {bench.k}"
            )

    raws = tight(dut, CfgInsulinTdd=300)
    run(dut.bench(flash=calibration(ADULT, **raws)), 48)
    ratio = next((name for name in RATIO if name in dut.offers), None)
    if ratio is not None:
        day = dut.settings.limits.pramlintide_day
        fast = {"CfgPramTdd": day * 10, "CfgPramRatio": 4000, "CfgInsulinTdd": 16000, "CfgMaxBasal": 60000}
        bench = dut.bench(mode=MODES[ratio], flash=calibration(ADULT, **fast))
        for k in range(48):
            bench.step(swing(k))
            given = bench.pram_total / 1200
            expect(given <= day + 1, f"at most {day} ug of pramlintide in 24 h; {given:.0f} were given by step {k}")
    dut.require("restart", "nvm")
    bench = dut.bench(flash=calibration(ADULT, **raws))
    run(bench, 24)
    bench.reboot(dut.restart())
    run(bench, 24)


@check("LIM-07", needs=["boluses"])
def lockout(dut: Dut) -> None:
    """A meal in each of eight steps, and two in the first of them."""
    apart = tight(dut)["CfgBolusLockout"]
    for mode in MEALTIME:
        if mode not in dut.offers:
            continue
        loop = dut.loop(mode, [(FIRST + k, 10.0) for k in range(8)], steps=FIRST + 10)
        flash(loop, **tight(dut))

        def twice(_name: str, meal: Values, loop: Loop = loop) -> Sequence[Values]:
            return [meal, meal | {"MealId": meal["MealId"] + 1}] if loop.plant.step == FIRST else [meal]

        loop.to_device = Forged(twice, "MEAL_Announce")
        loop.play()
        for drug, name in DRUGS.items():
            steps = list({each.number: each.step for each in reversed(commands(loop, COMMIT, drug))}.values())
            for later, earlier in itertools.pairwise(steps):
                expect(
                    later - earlier >= apart,
                    f"boluses of {name} at least {apart} steps apart in mode {mode}; they came in steps {earlier} and "
                    f"{later}",
                )
        expect(bool(programs(loop)), f"a bolus for one of eight meals in mode {mode}; none was programmed")


@check("LIM-08")
def rise(dut: Dut) -> None:
    """Up to 400 mg/dL as fast as a sensor may rise, then to 65 at once; up again, and the user suspends."""
    raws = tight(dut, CfgBasalFactor=255)
    most = raws["CfgMaxRise"] // 5
    bench = dut.bench(flash=calibration(ADULT, **raws))
    before: int | None = None
    for k in range(12):
        rate = rate_of(bench.step(climb(k)), bench.schedule)
        expect(
            before is None or rate - before <= most,
            f"a rise of the rate by at most {most} (0.005 U/h) in a step; from {before} it came to {rate} in step {k}",
        )
        before = rate
    expect(rate > most, f"a rate above {most} after rising glucose; {rate} came")
    turn = bench.step(650)
    rate, bits = rate_of(turn, bench.schedule), turn.status["LimiterBits"]
    expect(rate == 0, f"no insulin at 65 mg/dL at once, from {before}; {rate} came")
    expect(bits & RISE == 0, f"bit 7 of LimiterBits for a rise only; it came with the fall from {before}")
    bench = dut.bench(flash=calibration(ADULT, **raws))
    for k in range(12):
        bench.step(climb(k))
    user = bench.frame("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=SUSPEND)
    rate = rate_of(bench.step(4000, also=[user]), bench.schedule)
    expect(rate == 0, f"no insulin in the step in which the user suspends; {rate} came")


# ---- a cut is told


def _staying_low(k: int) -> int:
    return max(GLUCOSE - 40 * max(k - 6, 0), 690)


CUTS: Final[tuple[tuple[int, dict[str, int], Callable[[int], int]], ...]] = (
    (MAX_BASAL, {"CfgMaxBasal": 2000}, climb),
    (MAX_BASAL, {"CfgBasalFactor": 15}, climb),
    (MAX_IOB, {"CfgMaxIob": 30}, climb),
    (LOW_GLUCOSE, {"CfgLowSuspend": 700}, _staying_low),
    (DAY, {"CfgInsulinTdd": 80}, climb),
    (RISE, {"CfgMaxRise": 200}, climb),
)
"""Bit, the limit that is made tight, glucose by step."""

BOLUS_CUTS: Final[tuple[tuple[int, dict[str, int]], ...]] = (
    (MAX_BOLUS, {"CfgMaxBolus": 100}),
    (MAX_IOB, {"CfgMaxIob": 100}),
    (LOCKOUT, {"CfgBolusLockout": 12}),
    (DAY, {"CfgInsulinTdd": 100}),
)


@check("LIM-09")
def cuts_are_told(dut: Dut) -> None:
    """The same run with loose limits and with one made tight, limit by limit: where the dose is less, it was cut.

    There its bit is set, DoseLimited is pending, and it is one alarm however long the cut lasts.
    """
    for bit, limit, glucose in CUTS:
        loose, bench = dut.bench(), None
        whole = [rate_of(loose.step(glucose(k)), loose.schedule) for k in range(24)]
        bench = dut.bench(flash=calibration(ADULT, **limit))
        for k, wanted in enumerate(whole):
            turn = bench.step(glucose(k))
            rate = rate_of(turn, bench.schedule)
            if rate < wanted:
                _expect_told(turn.status["LimiterBits"], bit, limit, k, f"the rate {rate} instead of {wanted}")
                _expect_one_alarm(bench, bench.run(3, glucose(k)), limit)
                break
        else:
            expect(False, f"a rate that {limit} cuts within {len(whole)} steps; none was")
    if "boluses" not in dut.offers:
        return  # it gives none
    meals = [(FIRST, 40.0), (FIRST + 4, 40.0)]
    whole_doses = _doses(dut.loop(meal_mode(dut), meals, steps=FIRST + 7))
    for bit, limit in BOLUS_CUTS:
        loop = dut.loop(meal_mode(dut), meals, steps=FIRST + 7)
        flash(loop, **limit)
        doses = _doses(loop)
        cut = next((step for step, dose in whole_doses.items() if doses.get(step, 0) < dose), None)
        expect(cut is not None, f"a bolus that {limit} cuts; none was")
        assert cut is not None
        bits = next(values["LimiterBits"] for step, values in loop.steps_of("CTRL_Status") if step == cut)
        _expect_told(bits, bit, limit, cut, f"a bolus of {doses.get(cut, 0)} instead of {whole_doses[cut]}")
        told = {values["CtrlAlarmInstance"] for values in loop.alarms("DoseLimited")}
        expect(len(told) > 0, f"DoseLimited for a bolus cut by {limit}; it never came")


def _expect_told(bits: int, bit: int, limit: dict[str, int], step: int, what: str) -> None:
    expect(
        bits & bit != 0, f"bit {bit.bit_length() - 1} of LimiterBits in step {step}: {limit} leaves {what}; {bits} came"
    )


def _expect_one_alarm(bench: Bench, turn: Turn, limit: dict[str, int]) -> None:
    pending = turn.alarms("DoseLimited")
    expect(bool(pending), f"DoseLimited pending while {limit} cuts the rate; it was not")
    told = {alarm["CtrlAlarmInstance"] for alarm in bench.raised("DoseLimited")}
    expect(len(told) == 1, f"one alarm DoseLimited for a cut by {limit}; {len(told)} instances came")


def _doses(loop: Loop) -> dict[int, int]:
    """Step -> raw insulin bolus that was programmed, of a run that is played now."""
    return {each.step: each.dose for each in programs(loop.play(), INSULIN)}


# ---- the simulated pump


@check("LIM-10")
def the_pumps_own(dut: Dut) -> None:
    """Rates and boluses of either drug around the pump's limits and up to the ends of their fields, to the pump.

    What is above is answered OverLimit, or Malformed where it is a reserved code; the drug runs as without it.
    """
    limits = PumpSettings(basal_milliunits_per_h=1200)
    rates = {"InsulinRate": limits.max_rate_raw, "PramlintideRate": limits.max_pramlintide_rate_raw}
    for place, (field, limit) in enumerate(rates.items()):
        for raw in (0, limit - 1, limit, limit + 1, 8000, 8001, 8190, 8191):
            pump = Pump(limits)
            command = {"BasalOp": Op.SET_RATE, "BasalCmdSeq": 1, "BasalUntilStep": 3} | dict.fromkeys(rates, 0)
            acks = pump.command(command | {field: raw}, 0, Transmitter())
            found = codec.message("PUMP_Ack").unpack(acks[place].data)["AckResult"]
            _expect_refused(found, raw, limit, 8000, field)
            pump.deliver(0)
            if raw > limit:
                made = [int(motor.words[DELIVERED]) for motor in (pump.insulin, pump.pramlintide)][place]
                wanted = 2 - 2 * place  # 1.2 U/h are two strokes of 0.05 U in 5 min
                expect(made == wanted, f"{wanted} strokes with {field} refused, the schedule or none; {made} were made")
    for drug, limit in ((INSULIN, limits.max_bolus_raw), (PRAMLINTIDE, limits.max_pramlintide_bolus_raw)):
        for raw in (1, limit, limit + 1, 4000, 4001, 4095):
            pump = Pump(PumpSettings(basal_milliunits_per_h=0))
            fields = {"BolusHormone": drug, "BolusId": 1, "BolusUntilStep": 1, DOSE[drug]: raw}
            results = []
            for op in (PROGRAM, COMMIT):
                (ack,) = pump.bolus(fields | {"BolusOp": op}, 0, Transmitter())
                results.append(codec.message("PUMP_Ack").unpack(ack.data)["AckResult"])
            _expect_refused(results[0], raw, limit, 4000, DOSE[drug])
            expect((results[1] == ACCEPTED) == (raw <= limit), f"no Commit of raw {raw}; AckResult {results[1]} came")
            pump.deliver(0)
            made = pump.boluses[drug].delivered_raw
            expect(made == 0 or raw <= limit, f"no stroke of a bolus of raw {raw}; {made} was delivered")


def _expect_refused(found: int, raw: int, limit: int, reserved: int, field: str) -> None:
    name = "Accepted" if raw <= limit else "OverLimit" if raw <= reserved else "Malformed"
    wanted = codec.choice("PUMP_Ack", "AckResult", name)
    expect(found == wanted, f"AckResult {name} to {field} {raw} with the limit {limit}; {found} came")
