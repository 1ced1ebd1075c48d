"""Two drugs (TWO): pramlintide goes with insulin, never instead of it, and neither is mistaken for the other."""

from collections.abc import Sequence
from typing import Final

import dbc
from can_bus import codec
from can_bus.frame import Frame
from plant_server.physiology import load_patient
from pumpbench.calibration import MODES, SAFE, calibrate
from pumpbench.conformance.boluses import (
    COMMIT,
    DOSE,
    INSULIN,
    PRAMLINTIDE,
    PROGRAM_ACKS,
    Forged,
    commands,
    programs,
)
from pumpbench.conformance.driver import GLUCOSE, Bench, Op, State, Turn, calibration, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, Need, check

HIGH: Final = GLUCOSE + 800
"""A glucose that calls for insulin above the schedule, 0.1 mg/dL."""

RATIO_MODES: Final[tuple[Need, ...]] = ("s2", "s4")
"""Modes in which pramlintide follows the insulin rate."""

BOLUS_MODES: Final[tuple[Need, ...]] = ("s1", "s3", "s4")
"""Modes with boluses of pramlintide: at the peak of the infusion, with the meal, in proportion to insulin's."""

OCCLUDED = codec.choice("PUMP_Status", "InsulinOcclusion", "Occluded")

PRAM_RATE_ACK: Final = 8
"""PUMP_Ack.AckFor of the rate of pramlintide."""

FIRST: Final = 6
"""Step of the first meal: the device is in Auto by then."""

STEPS_TO_NOTICE: Final = 3
"""Within so many steps a missing answer for pramlintide has to stop it."""


def ratio_mode(dut: Dut) -> str:
    """A mode of this device in which pramlintide follows insulin."""
    return next(name for name in RATIO_MODES if name in dut.offers)


def pramlintide(turn: Turn) -> int:
    """The commanded rate of pramlintide, 0.1 ug/h: nothing unless a set-point is sent."""
    return turn.command["PramlintideRate"] if turn.command["BasalOp"] == Op.SET_RATE else 0


def giving(dut: Dut, **how: object) -> Bench:
    """A bench whose device gives both drugs."""
    bench = dut.bench(mode=MODES[ratio_mode(dut)], **how)
    turn = bench.run(12, HIGH)
    expect(turn.rate > 0 and pramlintide(turn) > 0, f"both drugs at {HIGH / 10:g} mg/dL; {turn.command} came")
    return bench


@check("TWO-01", needs=["pramlintide"])
def never_alone(dut: Dut) -> None:
    """Glucose down to 60, a suspension by the user, a sensor that is lost: without insulin no pramlintide either."""
    safe = calibrate(load_patient("adult#001"), SAFE)
    mode = next((name for name in RATIO_MODES if name in dut.offers), None)
    if mode is not None:
        bench = giving(dut, flash=safe)
        falling = [bench.step(glucose) for glucose in range(HIGH, 590, -200)] + [bench.step(600 + k) for k in range(3)]
        expect(falling[-1].rate == 0, f"no insulin at 60 mg/dL; {falling[-1].rate} came")
        bench = giving(dut)
        bench.send("MODE_Cmd", ModeRequest=MODES[mode], ModeCmdSeq=1, SuspendRequest=1)
        suspended = [bench.step(HIGH) for _ in range(3)]
        expect(
            suspended[0].state == State.SUSPENDED, f"Suspended in the step of the request; {suspended[0].state_name}"
        )
        bench = giving(dut)
        lost = [bench.step(drop=True) for _ in range(dut.settings.ladder.safe + 1)]
        for turn in (*falling, *suspended, *lost):
            _expect_together(turn)
    for mode in (name for name in BOLUS_MODES if name in dut.offers):
        loop = dut.loop(mode, [(FIRST, 60.0)], steps=FIRST + 3)
        loop.to_device = _sensor_says(loop, 600)
        loop.play()
        asked = programs(loop, PRAMLINTIDE)
        expect(not asked, f"no bolus of pramlintide while glucose is 60 mg/dL in mode {mode}; {asked} came")


def _expect_together(turn: Turn) -> None:
    command = turn.command
    insulin = command["BasalOp"] == Op.SET_RATE and command["InsulinRate"] > 0
    alone = not insulin and command["BasalOp"] == Op.SET_RATE and command["PramlintideRate"] > 0
    safe = turn.state in (State.SAFE_BASAL, State.SUSPENDED) and pramlintide(turn) > 0
    expect(not alone and not safe, f"no pramlintide without insulin, and none in {turn.state_name}; {command} came")
    drugs = [bolus["BolusHormone"] for bolus in turn.all("PUMP_BolusCmd")]
    expect(insulin or PRAMLINTIDE not in drugs, "no bolus of pramlintide while insulin is suspended")


def _sensor_says(loop: Loop, glucose: int) -> Forged:
    """A wire on which the sensor's value is another one from the step before the meal on."""

    def change(_name: str, values: Values) -> Sequence[Values]:
        late = loop.plant.step >= FIRST - 1
        return [values | {"GlucoseConc": glucose + loop.plant.step} if late else values]

    return Forged(change, "CGM_Reading")


@check("TWO-02", needs=["pramlintide"])
def the_ratio(dut: Dut) -> None:
    """Glucose up and down, with room and with CfgMaxBasal in the way: pramlintide is the ratio times what is left."""
    signal = dbc.load().get_message_by_name("CFG_Param").get_signal_by_name("CfgPramRatio")
    rates = dbc.load().get_message_by_name("PUMP_BasalCmd")
    insulin_lsb, pram_lsb = (
        float(rates.get_signal_by_name(f"{drug}Rate").scale) for drug in ("Insulin", "Pramlintide")
    )
    for mode in (name for name in RATIO_MODES if name in dut.offers):
        for limit in (None, 2500):
            flash = calibration() if limit is None else calibration(CfgMaxBasal=limit)
            bench = dut.bench(mode=MODES[mode], flash=flash)
            ratio = flash[_index("CfgPramRatio")] * float(signal.scale)
            for k in range(24):
                turn = bench.step(GLUCOSE + 40 * min(k, 24 - k))
                if turn.state != State.AUTO or turn.command["BasalOp"] != Op.SET_RATE:
                    continue
                wanted = turn.rate * insulin_lsb * ratio / pram_lsb
                expect(
                    abs(pramlintide(turn) - wanted) <= 1,
                    f"{ratio:g} ug/U of raw {turn.rate}, which is raw {wanted:g}, in step {k} of mode {mode};"
                    f" {pramlintide(turn)} came",
                )
            expect(turn.state == State.AUTO, f"Auto after 24 good samples; {turn.state_name} came")


def _index(name: str) -> int:
    return next(number for number, fields in codec.message("CFG_Param").pages.items() if fields[0].name == name)


@check("TWO-03", needs=["pramlintide"])
def boluses_of_pramlintide(dut: Dut) -> None:
    """A meal in every mode: boluses of pramlintide in s1, s3 and s4 alone, one for a meal, none at 65 mg/dL."""
    for mode in (name for name in MODES if name in dut.offers):
        loop = dut.loop(mode, [(FIRST, 60.0)], steps=FIRST + 14)
        loop.play()
        asked = programs(loop, PRAMLINTIDE)
        most = 1 if mode in BOLUS_MODES else 0
        expect(
            len(asked) <= most, f"at most {most} boluses of pramlintide for a meal in mode {mode}; {len(asked)} came"
        )
        expect(mode != "s3" or bool(asked), "a bolus of pramlintide for an announced meal in mode s3; none came")
    low = dut.settings.drugs.pramlintide_low * 10
    if "s3" in dut.offers:
        loop = dut.loop("s3", [(FIRST, 60.0)], steps=FIRST + 3)
        loop.to_device = _sensor_says(loop, low - 50)
        loop.play()
        expect(not programs(loop, PRAMLINTIDE), f"no bolus of pramlintide below {low / 10:g} mg/dL")


@check("TWO-04", needs=["pramlintide"])
def faults_of_one_side(dut: Dut) -> None:
    """Each side's line blocked and its reservoir empty: insulin goes on alone, pramlintide never does."""
    bad = (("PramOcclusion", OCCLUDED), ("PramReservoir", 0), ("InsulinOcclusion", OCCLUDED), ("InsulinReservoir", 0))
    for name, value in bad:
        bench = giving(dut)
        turns = [bench.step(HIGH, status=False, also=[_pump_status(bench, **{name: value})]) for _ in range(3)]
        for turn in turns[1:]:
            if name.startswith("Pram"):
                rate = turn.command["InsulinRate"] if turn.command["BasalOp"] == Op.SET_RATE else bench.schedule
                expect(rate > 0, f"insulin goes on with {name}={value}; {turn.command} came")
            else:
                expect(pramlintide(turn) == 0, f"no pramlintide with {name}={value}; {pramlintide(turn)} came")


def _pump_status(bench: Bench, **fields: int) -> Frame:
    sound = {"PumpState": 3, "InsulinReservoir": 2000, "PramReservoir": 2000, "PumpBattery": 90}
    return bench.frame("PUMP_Status", **sound | fields)


@check("TWO-05", needs=["pramlintide"])
def answers_apart(dut: Dut) -> None:
    """The answers for pramlintide's rate are lost, those for insulin's come: insulin goes on, pramlintide stops."""
    loop = dut.loop(ratio_mode(dut), steps=30)
    lost_from = 15

    def change(_name: str, values: Values) -> Sequence[Values]:
        lost = values["AckFor"] == PRAM_RATE_ACK and loop.plant.step >= lost_from
        return [] if lost else [values]

    loop.to_device = Forged(change, "PUMP_Ack")
    loop.play()
    before = [each for step, each in loop.steps_of("PUMP_BasalCmd") if step < lost_from]
    after = [each for step, each in loop.steps_of("PUMP_BasalCmd") if step > lost_from + STEPS_TO_NOTICE]
    expect(any(each["PramlintideRate"] > 0 for each in before), "pramlintide while its answers come")
    expect(all(each["BasalOp"] == Op.SET_RATE for each in after), "set-points of insulin while its answers come")
    expect(any(each["InsulinRate"] > 0 for each in after), "insulin while its answers come")
    wrong = [each["PramlintideRate"] for each in after if each["PramlintideRate"] > 0]
    expect(not wrong, f"no pramlintide {STEPS_TO_NOTICE} steps after its answers stopped; {wrong[:3]} came")


@check("TWO-06", needs=["boluses", "pramlintide"])
def the_other_scale(dut: Dut) -> None:
    """The pump's echo of a bolus in the other drug's scale, ten times the number or a tenth: Cancel and no Commit."""
    mode = next((name for name in ("s3", "s4") if name in dut.offers), None)
    if mode is None:
        return
    for drug, factor in ((INSULIN, 10), (INSULIN, 0.1), (PRAMLINTIDE, 10), (PRAMLINTIDE, 0.1)):
        loop = dut.loop(mode, [(FIRST, 60.0)], steps=FIRST + 3)
        stage = next(ack for ack, of in PROGRAM_ACKS.items() if of == drug)

        def change(_name: str, values: Values, stage: int = stage, factor: float = factor) -> Sequence[Values]:
            if values["AckFor"] != stage:
                return [values]
            return [values | {"AckEchoRaw": round(values["AckEchoRaw"] * factor)}]

        loop.to_device = Forged(change, "PUMP_Ack")
        loop.play()
        committed = [each for each in commands(loop, drug=drug) if each.op == COMMIT]
        text = f"no Commit of a bolus in {DOSE[drug]} whose echo is {factor:g} times its dose; {len(committed)} came"
        expect(not committed, text)
