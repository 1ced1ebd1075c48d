"""User input and configuration (USR): meals, modes and parameters, and what is refused of them."""

from collections.abc import Sequence
from typing import Final

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Phase
from firmware_sim.calibration import parameter_names
from pumpbench.calibration import MODES, with_crc
from pumpbench.conformance.boluses import ACK_OF, COMMIT, INSULIN, PROGRAM, PowerCut, carbs_mode, meal_mode
from pumpbench.conformance.driver import (
    HIGH,
    NMA,
    SUSPEND,
    Bench,
    State,
    Turn,
    calibration,
    expect,
)
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, NotOffered, check
from pumpbench.conformance.situations import idle_boluses

CARBS_ESTIMATED: Final = codec.choice("MEAL_Announce", "MealKind", "CarbsEstimated")
HYPO_TREATMENT: Final = codec.choice("MEAL_Announce", "MealKind", "HypoTreatment")
CANCEL: Final = codec.choice("MEAL_Announce", "MealKind", "Cancel")
PROGRAMMED: Final = codec.choice("PUMP_BolusState", "BolusPhase", "Programmed")

MODE_CODES: Final = 16
MODES_KNOWN: Final = frozenset(range(9))
SEQ_SNA: Final = 255

SET_CRC: Final = 63
"""CfgIndex that activates a set."""

RAW_BITS: Final = 0x3FFFFFFF
"""CFG_ParamEcho.EchoRaw has 30 bits."""

MUST_NOT_BE_ZERO: Final = {1: "CfgCarbRatio", 2: "CfgGlucoseTarget"}


def ready_for_meals(dut: Dut) -> Bench:
    """A device in a mode with boluses for announced carbohydrates, that has heard all it needs for one.

    Raises:
        NotOffered: it has no such mode.
    """
    strategy = carbs_mode(dut)
    if strategy is None:
        raise NotOffered("a mode with boluses for announced carbohydrates")
    bench = dut.bench(mode=MODES[strategy])
    for _ in range(4):
        bench.step(also=idle_boluses(bench))
    return bench


def meal(bench: Bench, number: int, kind: int = CARBS_ESTIMATED, **fields: int) -> Frame:
    """The announcement of 50 g now, or with fields of one's own, be they allowed or not."""
    usual = bench.frame("MEAL_Announce", MealKind=kind, MealId=number, CarbsEst=100, MealOffset=0)
    return bench.forge(usual, **fields) if fields else usual


def tell(bench: Bench, *frames: Frame) -> Turn:
    """A step in which the user says something."""
    return bench.step(also=[*idle_boluses(bench), *frames])


# ---- the checks


@check("USR-01", needs=["boluses"])
def a_meal_acts_once(dut: Dut) -> None:
    """A meal that is told three times in every step for an hour, for its echo is lost: one bolus, and an echo.

    Also over a restart, where the device can be restarted and has a memory.
    """
    for restart in (False, True) if {"restart", "nvm"} <= dut.offers else (False,):
        loop = _nagged(dut, restart)
        doses = loop.commits(1)
        what = "with a restart between" if restart else "however often it is told"
        expect(len(doses) == 1, f"one insulin bolus for one meal {what}; {doses} were committed")
        echoes = [values["LastMealId"] for step, values in loop.steps_of("CTRL_Status") if step > MEAL]
        expect(set(echoes) == {0}, f"LastMealId 0 from step {MEAL + 1} on {what}; {echoes} came")


MEAL: Final = 10


def _nagged(dut: Dut, restart: bool) -> Loop:
    """A run in which the user never sees that a meal was heard."""
    loop = dut.loop(meal_mode(dut), [(MEAL, 60.0)], MEAL + 12)
    counters = codec.Transmitter()

    def thrice(name: str, values: Values, _frame: Frame) -> Sequence[Frame] | None:
        return [counters.frame(name, **values) for _ in range(3)] if name == "MEAL_Announce" else None

    def deaf(name: str, values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name != "CTRL_Status":
            return None
        message = codec.message(name)
        word = message.pack(values | {"LastMealId": 255})
        return [Frame(frame.can_id, codec.protect(message, word, frame.data[1] & 0xF))]

    loop.to_device, loop.to_plant = thrice, deaf
    if restart:
        loop.device = PowerCut(
            dut, loop.device, lambda name, _values: name == "MEAL_Announce" and loop.plant.step == MEAL + 3
        )
    return loop.play()


@check("USR-02", needs=["boluses"])
def meals_that_cannot_be(dut: Dut) -> None:
    """More carbohydrates than allowed, SNA, reserved codes, and offsets beyond an hour: DoseRejected and no bolus.

    The largest amount and the largest offsets that are allowed are dosed.
    """
    carbs, offset = 2 * dut.settings.user.carbs, dut.settings.user.offset
    refused = [{"CarbsEst": raw} for raw in (carbs + 1, 1000, 1001, 1022, 1023)]
    refused += [{"MealOffset": minutes} for minutes in (offset + 1, -offset - 1, 127, -128)]
    for fields in refused:
        bench = ready_for_meals(dut)
        turn = tell(bench, meal(bench, 0, **fields))
        told = ", ".join(f"{name} {raw}" for name, raw in fields.items())
        begun = turn.all("PUMP_BolusCmd")
        expect(not begun, f"no bolus for a meal with {told}; {begun[:1]} came")
        expect(bool(turn.alarms("DoseRejected")), f"the alarm DoseRejected for a meal with {told}")
    for fields in ({"CarbsEst": carbs}, {"MealOffset": offset}, {"MealOffset": -offset}):
        bench = ready_for_meals(dut)
        begun = tell(bench, meal(bench, 0, **fields)).all("PUMP_BolusCmd")
        expect(bool(begun), f"a bolus for a meal with {fields}, which is allowed")


@check("USR-03", needs=["boluses"])
def no_meals(dut: Dut) -> None:
    """Sugar against a low gives no bolus. Cancel beside a meal, and after a Program without answer: no Commit."""
    bench = ready_for_meals(dut)
    turns = [tell(bench, meal(bench, 0, HYPO_TREATMENT)), tell(bench), tell(bench)]
    _expect_none(turns, [PROGRAM, COMMIT], "for HypoTreatment")
    expect(turns[0].status["LastMealId"] == 0, f"LastMealId 0, heard; {turns[0].status['LastMealId']} came")
    for number in (0, 1):  # the number of the meal, or one of its own
        bench = ready_for_meals(dut)
        turns = [tell(bench, meal(bench, 0), meal(bench, number, CANCEL)), tell(bench), tell(bench)]
        _expect_none(turns, [PROGRAM, COMMIT], f"for a meal that is cancelled in its step, with MealId {number}")
    bench = ready_for_meals(dut)
    begun = tell(bench, meal(bench, 0)).all("PUMP_BolusCmd")
    expect(bool(begun), "a bolus for a meal of 50 g")
    turns = []
    for k in range(3):
        state = _programmed(bench, begun[0])
        late = bench.frame(
            "PUMP_Ack",
            AckFor=ACK_OF[INSULIN, PROGRAM],
            AckResult=0,
            AckId=begun[0]["BolusId"],
            AckEchoRaw=begun[0]["InsulinBolus"],
            AckLimitRaw=4000,
        )
        cancel = [meal(bench, 1, CANCEL)] if k == 0 else []
        turns.append(bench.step(also=[late, state, idle_boluses(bench)[1], *cancel]))
    _expect_none(turns, [COMMIT], "for a meal that is cancelled before the pump's answer has come")


def _programmed(bench: Bench, command: Values) -> Frame:
    """PUMP_BolusState of a bolus that the pump has agreed to."""
    return bench.frame(
        "PUMP_BolusState",
        BolusStateHormone=1,
        BolusPhase=PROGRAMMED,
        BolusStateId=command["BolusId"],
        BolusDeliveredRaw=0,
        BolusProgrammedRaw=command["InsulinBolus"],
    )


def _expect_none(turns: Sequence[Turn], operations: Sequence[int], what: str) -> None:
    found = [each for turn in turns for each in turn.all("PUMP_BolusCmd") if each["BolusOp"] in operations]
    expect(not found, f"no bolus {what}; {found[:1]} came")


@check("USR-04")
def modes(dut: Dut) -> None:
    """All sixteen codes, and numbers that are old or SNA: what is unknown or old is ignored, and nothing is dosed.

    Nor is a meal dosed that was announced in a mode without boluses.
    """
    bench = dut.bench()
    for _ in range(6):
        turn = tell(bench)
    for code in range(MODE_CODES):
        before = turn.status["CtrlMode"]
        request = bench.frame("MODE_Cmd", ModeRequest=0, ModeCmdSeq=code + 1, SuspendRequest=0)
        turn = tell(bench, bench.forge(request, ModeRequest=code))
        begun = turn.all("PUMP_BolusCmd")
        expect(not begun, f"no bolus for ModeRequest {code}; {begun[:1]} came")
        allowed = {before, code} if code in MODES_KNOWN else {before}
        found = turn.status["CtrlMode"]
        expect(found in allowed, f"CtrlMode {sorted(allowed)} after ModeRequest {code}; {found} came")
        rate = bench.commanded(turn)
        expect(rate <= bench.basal / 5 + 1, f"at most the schedule at the target, ModeRequest {code}; {rate:g} came")
    bench = dut.bench()
    bench.run(4)
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=5, SuspendRequest=0)
    bench.step()
    for number in (4, 5, 0, SEQ_SNA):
        bench.send("MODE_Cmd", ModeRequest=0, ModeCmdSeq=number, SuspendRequest=SUSPEND)
        turn = bench.step()
        found = turn.status["CtrlMode"]
        expect(found == NMA, f"CtrlMode {NMA} after a MODE_Cmd {number}, the last one being 5; {found} came")
        expect(
            turn.state == State.AUTO, f"Auto after a MODE_Cmd {number}, the last one being 5; {turn.state_name} came"
        )
    strategy = carbs_mode(dut)
    if strategy is not None:
        bench = dut.bench()
        for _ in range(4):
            tell(bench)
        tell(bench, meal(bench, 0))
        change = bench.frame("MODE_Cmd", ModeRequest=MODES[strategy], ModeCmdSeq=1, SuspendRequest=0)
        turns = [tell(bench, change), tell(bench), tell(bench)]
        _expect_none(turns, [PROGRAM, COMMIT], "for a meal of the mode before")


@check("USR-05")
def parameters(dut: Dut) -> None:
    """Every parameter in range and, where its field can say so, out of it; zeros; a wrong CRC; a looser stale limit.

    The echo shows what is stored, the refused ones change nothing, and the set is active with its own CRC only.
    """
    bench = dut.bench(start=False)
    bench.call_roll()
    good, stored = calibration(), dict[int, int]()
    expected: list[tuple[int, int, int]] = []
    for index, raw in good.items():
        if index == SET_CRC:
            continue
        field = codec.message("CFG_Param").pages[index][0]
        _flash(bench, index, raw)
        stored[index] = raw
        bad = [field.high + 1] if field.high < field.mask and not field.sign else []
        bad += [0] if index in MUST_NOT_BE_ZERO else []
        for wrong in bad:
            _flash(bench, index, wrong)
        expected += [(index, raw & RAW_BITS, with_crc(stored)[SET_CRC])] * (1 + len(bad))
    _flash(bench, SET_CRC, good[SET_CRC] ^ 1)
    _flash(bench, SET_CRC, good[SET_CRC])
    *echoes, wrong_set, right_set = _configured(bench)
    expect(len(echoes) == len(expected), f"an echo for each CFG_Param, {len(expected)}; {len(echoes)} came")
    for found, (index, raw, crc) in zip(echoes, expected, strict=True):
        expect(
            found == {"EchoIndex": index, "EchoRaw": raw, "EchoSetCrc": crc},
            f"the echo of {parameter_names()[index]} as stored, {raw} in a set with CRC {crc}; {found} came",
        )
    crc = good[SET_CRC]
    expect(wrong_set["EchoRaw"] != crc ^ 1, "no set active under a CRC that is not its own")
    expect(right_set["EchoRaw"] == crc, f"the set active with its CRC {crc}; EchoRaw {right_set['EchoRaw']} came")
    _expect_stale(dut, 60, dut.settings.ladder.degraded)
    _expect_stale(dut, 5, 2)


def _flash(bench: Bench, index: int, raw: int) -> None:
    """A CFG_Param with any value."""
    name = parameter_names()[index]
    bench.give(bench.forge(bench.frame("CFG_Param", CfgIndex=index, **{name: 0}), **{name: raw}))


def _configured(bench: Bench) -> list[Values]:
    """The echoes of what was flashed."""
    return bench.token(Phase.CONFIG, 0).all("CFG_ParamEcho")


def _expect_stale(dut: Dut, minutes: int, age: int) -> None:
    """With this CfgStaleCgmLimit at most the schedule from this age on, and more before."""
    bench = dut.bench(flash=calibration(CfgStaleCgmLimit=minutes))
    turn = bench.run(12, HIGH)
    expect(turn.rate > bench.schedule, f"more than the schedule at {HIGH / 10:g} mg/dL; {turn.rate} came")
    for _ in range(age):
        turn = bench.step(drop=True)
    rate = bench.commanded(turn)
    expect(
        rate <= bench.basal / 5,
        f"at most the schedule of {bench.basal / 5:g} {age} steps after the newest sample with a CfgStaleCgmLimit "
        f"of {minutes} min; {rate:g} came",
    )
