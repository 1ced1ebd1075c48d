"""Two drugs (TWO): pramlintide goes with insulin, never instead of it, and neither is mistaken for the other."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import dbc
from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from plant_server.chamber import Occlusion
from plant_server.physiology import load_patient
from pumpbench.calibration import MODES, SAFE, calibrate
from pumpbench.conformance.boluses import (
    COMMIT,
    DOSE,
    DRUGS,
    FIRST,
    INSULIN,
    PRAMLINTIDE,
    PROGRAM_ACKS,
    Forged,
    commands,
    programs,
)
from pumpbench.conformance.driver import (
    GLUCOSE,
    HIGH,
    SUSPEND,
    Bench,
    Op,
    State,
    Turn,
    calibration,
    expect,
    parameter_index,
)
from pumpbench.conformance.loop import Loop, Values, Wire
from pumpbench.conformance.registry import Dut, Need, NotOffered, check

RATIO_MODES: Final[tuple[Need, ...]] = ("s2", "s4")
"""Modes in which pramlintide follows the insulin rate."""

BOLUS_MODES: Final[tuple[Need, ...]] = ("s1", "s3", "s4")
"""Modes with boluses of pramlintide: at the peak of the infusion, with the meal, in proportion to insulin's."""

PRAM_RATE_ACK: Final = 8
"""PUMP_Ack.AckFor of the rate of pramlintide."""

MEALS: Final = tuple(
    codec.choice("MEAL_Announce", "MealKind", kind) for kind in ("CarbsEstimated", "SimpleMeal", "Snack")
)
NO_MEALS: Final = tuple(codec.choice("MEAL_Announce", "MealKind", kind) for kind in ("HypoTreatment", "Cancel"))

STEPS_TO_NOTICE: Final = 3
"""Within so many steps a missing answer for pramlintide has to stop it."""


def ratio_mode(dut: Dut) -> str:
    """A mode of this device in which pramlintide follows insulin.

    Raises:
        NotOffered: it has none.
    """
    for name in RATIO_MODES:
        if name in dut.offers:
            return name
    raise NotOffered("a mode in which pramlintide follows insulin")


def giving(dut: Dut, **how: object) -> Bench:
    """A bench whose device gives both drugs."""
    bench = dut.bench(mode=MODES[ratio_mode(dut)], **how)
    turn = bench.run(12, HIGH)
    expect(turn.rate > 0 and turn.pramlintide > 0, f"both drugs at {HIGH / 10:g} mg/dL; {turn.command} came")
    return bench


@check("TWO-01", needs=["pramlintide"])
def never_alone(dut: Dut) -> None:
    """Glucose down to 60, a suspension by the user, a sensor that is lost: no pramlintide, not for a meal either."""
    safe = calibrate(load_patient("adult#001"), SAFE)
    mode = next((name for name in RATIO_MODES if name in dut.offers), None)
    if mode is not None:
        bench = giving(dut, flash=safe)
        falling = [bench.step(glucose) for glucose in range(HIGH, 590, -200)] + [bench.step(600 + k) for k in range(3)]
        expect(falling[-1].rate == 0, f"no insulin at 60 mg/dL; {falling[-1].rate} came")
        bench = giving(dut)
        bench.request(1, SUSPEND, MODES[mode])
        suspended = [bench.step(HIGH) for _ in range(3)]
        expect(
            suspended[0].state == State.SUSPENDED, f"Suspended in the step of the request; {suspended[0].state_name}"
        )
        bench = giving(dut)
        lost = [bench.step(drop=True) for _ in range(dut.settings.ladder.safe + 1)]
        for turn in (*falling, *suspended, *lost):
            _expect_together(turn)
    late = FIRST + dut.settings.ladder.safe
    for mode in (name for name in BOLUS_MODES if name in dut.offers):
        for why, meal, wire in (
            ("glucose is 60 mg/dL", FIRST, _sensor_says(600)),
            ("the sensor is lost", late, _sensor_lost),
            ("the user suspends", late, _user_suspends),
        ):
            loop = dut.loop(mode, [(meal, 60.0)], steps=meal + 3)
            loop.to_device = wire(loop)
            loop.play()
            asked = programs(loop, PRAMLINTIDE)
            expect(not asked, f"no bolus of pramlintide while {why} in mode {mode}; {len(asked)} came")


def _expect_together(turn: Turn) -> None:
    command = turn.command
    insulin = command["BasalOp"] == Op.SET_RATE and command["InsulinRate"] > 0
    alone = not insulin and command["BasalOp"] == Op.SET_RATE and command["PramlintideRate"] > 0
    safe = turn.state in (State.SAFE_BASAL, State.SUSPENDED) and turn.pramlintide > 0
    expect(not alone and not safe, f"no pramlintide without insulin, and none in {turn.state_name}; {command} came")
    drugs = [bolus["BolusHormone"] for bolus in turn.all("PUMP_BolusCmd")]
    expect(insulin or PRAMLINTIDE not in drugs, "no bolus of pramlintide while insulin is suspended")


def _sensor_says(glucose: int) -> Callable[[Loop], Wire]:
    """A wire on which the sensor's value is another one from the step before the meal on."""

    def wire(loop: Loop) -> Wire:
        def change(_name: str, values: Values) -> Sequence[Values]:
            late = loop.plant.step >= FIRST - 1
            return [values | {"GlucoseConc": glucose + loop.plant.step} if late else values]

        return Forged(change, "CGM_Reading")

    return wire


def _sensor_lost(loop: Loop) -> Wire:
    """A wire on which no sample arrives from the step of the first meal on."""
    return Forged(lambda _name, values: [] if loop.plant.step >= FIRST else [values], "CGM_Reading")


def _user_suspends(loop: Loop) -> Wire:
    """A wire on which the user suspends in the step of the first meal."""
    user = Transmitter()
    user.frame("MODE_Cmd")  # the plant has sent one with the calibration

    def wire(name: str, _values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name != "SYNC_Step" or loop.plant.step != FIRST:
            return None
        request = {"ModeRequest": loop.plant.run.mode, "ModeCmdSeq": 1, "SuspendRequest": SUSPEND}
        return [user.frame("MODE_Cmd", **request), frame]

    return wire


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
            ratio = flash[parameter_index("CfgPramRatio")] * float(signal.scale)
            for k in range(24):
                turn = bench.step(GLUCOSE + 40 * min(k, 24 - k))
                if turn.state != State.AUTO or turn.command["BasalOp"] != Op.SET_RATE:
                    continue
                wanted = turn.rate * insulin_lsb * ratio / pram_lsb
                expect(
                    abs(turn.pramlintide - wanted) <= 1,
                    f"{ratio:g} ug/U of raw {turn.rate}, which is raw {wanted:g}, in step {k} of mode {mode};"
                    f" {turn.pramlintide} came",
                )
            expect(turn.state == State.AUTO, f"Auto after 24 good samples; {turn.state_name} came")


@check("TWO-03", needs=["pramlintide"])
def boluses_of_pramlintide(dut: Dut) -> None:
    """Announcements of every kind, each one twice, in every mode: boluses of pramlintide in s1, s3 and s4 alone.

    There is at most one for each meal, none for sugar or a Cancel, and none at 65 mg/dL.
    """
    meals = {FIRST + 4 * k: kind for k, kind in enumerate(MEALS + NO_MEALS)}
    for mode in (name for name in MODES if name in dut.offers):
        loop = dut.loop(mode, steps=max(meals) + 3)
        loop.to_device = _announced(loop, meals)
        loop.play()
        asked = programs(loop, PRAMLINTIDE)
        if mode == "s1":
            continue  # boluses at the peaks of its infusion, which no meal asks for
        most = len(MEALS) if mode in BOLUS_MODES else 0
        expect(
            len(asked) <= most,
            f"at most {most} boluses of pramlintide for {len(MEALS)} meals in mode {mode}; {len(asked)} came",
        )
        told = [max((step for step in meals if step <= each.step), default=-1) for each in asked]
        expect(
            len(set(told)) == len(told) and all(meals.get(step) in MEALS for step in told),
            f"one bolus of pramlintide at most after each meal told, MealKind {meals}, in mode {mode}; they came after "
            f"those of steps {told}",
        )
        expect(mode != "s3" or bool(asked), "a bolus of pramlintide for an announced meal in mode s3; none came")
    low = dut.settings.drugs.pramlintide_low * 10
    if "s3" in dut.offers:
        loop = dut.loop("s3", [(FIRST, 60.0)], steps=FIRST + 3)
        loop.to_device = _sensor_says(low - 50)(loop)
        loop.play()
        expect(not programs(loop, PRAMLINTIDE), f"no bolus of pramlintide below {low / 10:g} mg/dL")


def _announced(loop: Loop, meals: Mapping[int, int]) -> Wire:
    """A wire on which the user tells of meals of 10 g, step -> MealKind, in two steps each."""
    user, first = Transmitter(), min(meals)

    def wire(name: str, _values: Values, frame: Frame) -> Sequence[Frame] | None:
        step = loop.plant.step
        kind = meals.get(step, meals.get(step - 1))
        if name != "SYNC_Step" or kind is None:
            return None
        meal = {"MealKind": kind, "MealId": (step - first) // 2, "MealOffset": 0, "CarbsEst": 20}
        return [user.frame("MEAL_Announce", **meal), frame]

    return wire


@check("TWO-04", needs=["pramlintide"])
def faults_of_one_side(dut: Dut) -> None:
    """Each side's line blocked and its reservoir empty, also at a meal: insulin goes on alone, the other not."""
    bad = (
        ("PramOcclusion", Occlusion.OCCLUDED),
        ("PramReservoir", 0),
        ("InsulinOcclusion", Occlusion.OCCLUDED),
        ("InsulinReservoir", 0),
    )
    for name, value in bad if any(mode in dut.offers for mode in RATIO_MODES) else ():
        bench = giving(dut)
        turns = [bench.step(HIGH, status=False, also=[bench.status(**{name: value})]) for _ in range(3)]
        for turn in turns[1:]:
            if name.startswith("Pram"):
                rate = turn.command["InsulinRate"] if turn.command["BasalOp"] == Op.SET_RATE else bench.schedule
                expect(rate > 0, f"insulin goes on with {name}={value}; {turn.command} came")
            else:
                expect(turn.pramlintide == 0, f"no pramlintide with {name}={value}; {turn.pramlintide} came")

    for mode in (name for name in ("s3", "s4") if name in dut.offers):
        for drug in (INSULIN, PRAMLINTIDE):
            loop = dut.loop(mode, [(FIRST, 40.0)], steps=FIRST + 3)
            loop.plant.pump.boluses[drug].chamber.stopped = True
            loop.play()
            given = len(loop.commits(INSULIN)), len(loop.commits(PRAMLINTIDE))
            expect(
                given == ((0, 0) if drug == INSULIN else (1, 0)),
                f"insulin alone for a meal while the pump gives no pramlintide, and nothing without insulin, in mode "
                f"{mode}; {given} were committed with {DRUGS[drug]} stopped",
            )


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
    """The pump's echo of a bolus is ten times the number or a tenth; then the command itself becomes the other drug's.

    No Commit follows, and not a stroke of either drug.
    """
    mode = next((name for name in ("s3", "s4") if name in dut.offers), None)
    if mode is None:
        raise NotOffered("a mode with boluses of both drugs")
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

    loop = dut.loop(mode, [(FIRST, 60.0)], steps=FIRST + 4)
    loop.to_plant = Forged(_of_the_other_drug, "PUMP_BolusCmd")
    loop.play()
    committed = commands(loop, COMMIT)
    expect(not committed, f"no Commit of a bolus that the pump took for the other drug's; {len(committed)} came")
    given = [loop.bolus_strokes(drug) for drug in (INSULIN, PRAMLINTIDE)]
    expect(given == [0, 0], f"no stroke of a bolus that the pump took for the other drug's; {given} were made")


def _of_the_other_drug(_name: str, values: Values) -> Sequence[Values]:
    drug = values["BolusHormone"]
    other = {INSULIN: PRAMLINTIDE, PRAMLINTIDE: INSULIN}[drug]
    return [
        {name: raw for name, raw in values.items() if name != DOSE[drug]}
        | {"BolusHormone": other, DOSE[other]: values[DOSE[drug]]}
    ]
