"""Command protocol (CMD): boluses in two stages, retries, set-points with an expiry; what an answer means."""

import random
from collections.abc import Callable, Container, Iterable, Sequence
from typing import Final, NamedTuple

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from plant_server.mechanism import DELIVERED, SLOWED, STROKES_PER_SUBSTEP
from plant_server.pump import Pump, PumpSettings
from pumpbench.conformance.boluses import (
    ACCEPTED,
    ACK_OF,
    CANCEL,
    COMMIT,
    COMMIT_ACKS,
    DOSE,
    DRUGS,
    DUPLICATE,
    FIRST,
    INSULIN,
    PROGRAM,
    PROGRAM_ACKS,
    Change,
    Command,
    Forged,
    PowerCut,
    commands,
    flash,
    meal_mode,
    programs,
)
from pumpbench.conformance.driver import GLUCOSE, Op, State, alarm_code, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import MEALTIME, Dut, check

EVERY: Final = 4
"""Steps between two meals, so that what became of one is settled before the next."""


def result(name: str) -> int:
    """PUMP_Ack.AckResult by its name."""
    return codec.choice("PUMP_Ack", "AckResult", name)


def name_of(command: Command) -> str:
    """A command in words."""
    op = {PROGRAM: "Program", COMMIT: "Commit", CANCEL: "Cancel"}.get(command.op, f"BolusOp {command.op}")
    return f"{op} of {DRUGS.get(command.drug, 'no drug')} {command.number}, raw {command.dose}"


def expect_confirmed(frames: Iterable[Frame]) -> None:
    """Every Commit on the device's bus must follow an agreement to just that bolus.

    Duplicate agrees as well: it answers a Program that was repeated because the first answer was lost.
    """
    agreed: set[tuple[int, int, int]] = set()
    for frame in frames:
        message = codec.messages_by_id().get(frame.can_id)
        if message is None or len(frame.data) != message.length:
            continue
        values = message.unpack(frame.data)
        if message.name == "PUMP_Ack" and values["AckResult"] in (ACCEPTED, DUPLICATE):
            drug = PROGRAM_ACKS.get(values["AckFor"])
            if drug is not None:
                agreed.add((drug, values["AckId"], values["AckEchoRaw"]))
        elif message.name == "PUMP_BolusCmd" and values["BolusOp"] == COMMIT:
            drug, number = values["BolusHormone"], values["BolusId"]
            dose = values[DOSE[drug]]
            expect(
                (drug, number, dose) in agreed,
                f"a Commit only after an Accepted Program of {DRUGS[drug]} {number} with the echo {dose}; "
                "it came without",
            )


Spoil = Callable[[Values], Values]

REFUSALS: Final = ("Expired", "OverLimit", "WrongState", "Busy", "E2EError", "Malformed")

SPOILT: Final[tuple[Spoil, ...]] = (
    lambda ack: {"AckEchoRaw": ack["AckEchoRaw"] + 1},
    lambda ack: {"AckEchoRaw": ack["AckEchoRaw"] - 1},
    lambda ack: {"AckEchoRaw": 0},
    lambda ack: {"AckId": ack["AckId"] + 1},
    lambda ack: {"AckFor": ack["AckFor"] + 1},  # the Commit's
    lambda ack: {"AckFor": {2: 4, 4: 2}[ack["AckFor"]]},  # the other drug's
    lambda _ack: {"AckFor": 6},  # Cancel's
    lambda _ack: {"AckFor": 1},  # a rate's
    *(lambda _ack, name=name: {"AckResult": result(name)} for name in (*REFUSALS, "Completed", "Cancelled", "SNA")),
)
"""What becomes of the answer to a Program: none of these agrees to it."""


@check("CMD-01", needs=["boluses"])
def what_confirms(dut: Dut) -> None:
    """Answers to Program with another echo, id, stage, drug or result; then late ones, and doubled ones for Commit's.

    No Commit follows any of them, and an answer to Program that comes again is none to Commit.
    """
    meals = [(FIRST + EVERY * k, 10.0) for k in range(len(SPOILT))]
    loop = dut.loop(meal_mode(dut), meals, steps=meals[-1][0] + EVERY)
    seen: list[int] = []

    def spoil(_name: str, ack: Values) -> Sequence[Values]:
        if ack["AckFor"] not in PROGRAM_ACKS:
            return [ack]
        if ack["AckId"] not in seen:
            seen.append(ack["AckId"])
        return [ack | SPOILT[seen.index(ack["AckId"]) % len(SPOILT)](ack)]

    loop.to_device = Forged(spoil, "PUMP_Ack")
    loop.play()
    expect_confirmed(dut.record())
    expect(len(seen) >= len(SPOILT), f"a bolus for each of {len(SPOILT)} meals; {len(seen)} were programmed")

    loop = dut.loop(meal_mode(dut), meals[:3], steps=meals[3][0])
    loop.to_device = Forged(_late(), "PUMP_Ack")
    loop.play()
    expect_confirmed(dut.record())

    loop = dut.loop(meal_mode(dut), meals[:1], steps=meals[1][0])
    newest: dict[int, Values] = {}

    def doubled(_name: str, ack: Values) -> Sequence[Values]:
        if ack["AckFor"] in PROGRAM_ACKS:
            newest[PROGRAM_ACKS[ack["AckFor"]]] = ack
            return [ack]
        return [newest[COMMIT_ACKS[ack["AckFor"]]]] if ack["AckFor"] in COMMIT_ACKS else [ack]

    loop.to_device = Forged(doubled, "PUMP_Ack")
    loop.play()
    expect(
        bool(loop.alarms("DeliveryUncertain")),
        "DeliveryUncertain when the answer to Program comes again in place of that to Commit; no such alarm came",
    )


def _late() -> Change:
    """Every answer about a bolus is held back until the next one comes."""
    held: list[Values] = []

    def change(_name: str, ack: Values) -> Sequence[Values]:
        if ack["AckFor"] not in (*PROGRAM_ACKS, *COMMIT_ACKS):
            return [ack]
        held.append(ack)
        return [held.pop(0)] if len(held) > 1 else []

    return change


def expect_ids_and_retries(loop: Loop, sends: int) -> None:
    """One BolusId is one bolus, and a stage is not said too often."""
    first: dict[int, Command] = {}
    said: dict[tuple[int, int], int] = {}
    for each in commands(loop):
        if each.op not in (PROGRAM, COMMIT):
            continue
        began = first.setdefault(each.number, each)
        same = (each.drug, each.dose, each.until) == (began.drug, began.dose, began.until)
        expect(
            same,
            f"drug, dose and expiry {began.drug}, {began.dose}, {began.until} of BolusId {each.number} whenever it is "
            f"said; {each.drug}, {each.dose}, {each.until} came in step {each.step}",
        )
        said[each.number, each.op] = said.get((each.number, each.op), 0) + 1
        expect(
            said[each.number, each.op] <= sends,
            f"a stage of a bolus at most {sends} times; once more came in step {each.step}: {name_of(each)}",
        )


@check("CMD-02", needs=["boluses"])
def ids_and_retries(dut: Dut) -> None:
    """Meals whose answers are lost at either stage; then power that fails in the midst of a bolus, and another meal.

    A BolusId always means the same drug, dose and expiry, and no stage is said too often.
    """
    sends = dut.settings.commands.sends
    meals = [(FIRST, 30.0), (FIRST + EVERY, 20.0), (FIRST + 2 * EVERY, 25.0)]
    for lost in (PROGRAM_ACKS, COMMIT_ACKS):
        loop = dut.loop(meal_mode(dut), meals, steps=meals[-1][0] + EVERY)
        loop.to_device = Forged(_without(lost), "PUMP_Ack")
        loop.play()
        expect_ids_and_retries(loop, sends)
        expect(bool(programs(loop)), "a bolus for a meal; none was programmed")
        for step in {each.step for each in programs(loop)}:  # every try for a meal is the same bolus
            tries = [each for each in programs(loop) if each.step == step]
            drugs = {each.drug for each in tries}
            ids = [each.number for each in tries]
            expect(
                len(ids) == len(drugs),
                f"one BolusId for each drug in step {step}, however often it is said; {ids} came",
            )
    dut.require("restart", "nvm")
    for answer in range(1, 3):  # the one to Program, the one to Commit
        loop = dut.loop(meal_mode(dut), meals, steps=meals[-1][0] + EVERY)
        loop.device = PowerCut(dut, loop.device, _nth("PUMP_Ack", answer, lambda ack: ack["AckFor"] in ACK_OF.values()))
        loop.play()
        expect_ids_and_retries(loop, sends)


def _without(lost: Container[int]) -> Change:
    """Acknowledgements of these kinds are lost."""
    return lambda _name, ack: [] if ack["AckFor"] in lost else [ack]


def _nth(name: str, count: int, which: Callable[[Values], bool]) -> Callable[[str, Values], bool]:
    """Whether a frame is the nth of these."""
    left = count

    def is_it(said: str, values: Values) -> bool:
        nonlocal left
        left -= said == name and which(values)
        return left == 0

    return is_it


# ---- the simulated pump


class Asked(NamedTuple):
    """A bolus as a controller might ask for it."""

    number: int
    dose: int
    until: int


def _values(op: int, asked: Asked, drug: int = INSULIN) -> Values:
    return {
        "BolusHormone": drug,
        "BolusOp": op,
        "BolusId": asked.number,
        "BolusUntilStep": asked.until % 256,
        DOSE[drug]: asked.dose,
    }


def answer(pump: Pump, values: Values, step: int) -> int:
    """AckResult of the pump to a bolus command."""
    (ack,) = pump.bolus(values, step, Transmitter())
    return codec.message("PUMP_Ack").unpack(ack.data)["AckResult"]


@check("CMD-03")
def at_most_once(dut: Dut) -> None:
    """Boluses whose commands are lost, doubled, late and replayed at random (100 runs; long: 1000), to the pump.

    What its motor makes of all of them is never more than was programmed, and never more than once for an id.
    """
    for seed in range(1000 if dut.long else 100):
        draw = random.Random(seed)
        pump = Pump(PumpSettings(basal_milliunits_per_h=0))
        began = draw.randint(0, 60000)
        boluses = [Asked(began + k, draw.randint(1, 300), k + draw.randint(0, 2)) for k in range(20)]
        given = dict.fromkeys((each.number for each in boluses), 0)
        arriving: list[tuple[int, Values]] = []  # when, and what
        for step, each in enumerate(boluses):
            arriving += [
                (step + draw.choice((0, 0, 0, 0, 1, 2, 9)), _values(op, each))
                for op in (PROGRAM, PROGRAM, COMMIT, COMMIT)
                if draw.random() > 0.2
            ]
            arriving += [(step, draw.choice(arriving[-9:])[1]) for _ in range(draw.randint(0, 4)) if arriving]
            for at, values in arriving:
                if at == step:
                    given[values["BolusId"]] += answer(pump, values, step) == ACCEPTED and values["BolusOp"] == COMMIT
            pump.deliver(step)
        twice = [number for number, times in given.items() if times > 1]
        expect(not twice, f"no BolusId begun twice; {twice} were, in random run {seed}")
        most = sum(each.dose // 5 for each in boluses if given[each.number])
        made = int(pump.insulin.words[DELIVERED])
        expect(made <= most, f"at most the {most} strokes that were programmed; {made} were made, in random run {seed}")


@check("CMD-04")
def bolus_expiry(dut: Dut) -> None:
    """Program and Commit come to the pump 0 to 3 steps late, around the wrap too; then the expiry the device sets."""
    for began in (10, 253):
        for op in (PROGRAM, COMMIT):
            for late in (0, 1, 3, 100):
                pump = Pump(PumpSettings(basal_milliunits_per_h=0))
                asked = Asked(7, 100, began + 1)
                if op == COMMIT:
                    answer(pump, _values(PROGRAM, asked), began)
                found = answer(pump, _values(op, asked), asked.until + late)
                wanted = result("Expired") if late else ACCEPTED
                expect(
                    found == wanted, f"AckResult {wanted} to BolusOp {op}, {late} steps after its expiry; {found} came"
                )
                pump.deliver(asked.until + late)
                made = int(pump.insulin.words[DELIVERED])
                expect(
                    not made or not late, f"no stroke {late} steps after the expiry of BolusOp {op}; {made} were made"
                )
    if "boluses" not in dut.offers:
        return  # it never asks for one
    most = dut.settings.commands.bolus_expiry
    loop = dut.loop(meal_mode(dut), [(FIRST, 30.0)], steps=FIRST + EVERY).play()
    for each in commands(loop):
        expect(
            each.op == CANCEL or each.ahead <= most,
            f"a bolus that expires 0..{most} steps ahead; {each.ahead} came in step {each.step}: {name_of(each)}",
        )


# ---- no answer


@check("CMD-05", needs=["boluses"])
def no_answer(dut: Dut) -> None:
    """The answers to Program, or to Commit, and PUMP_BolusState are lost for six steps in which two more meals come.

    DeliveryUncertain and its alarm as soon as nothing has come after the last try, and no other bolus before the pump
    has told of the first one.
    """
    until = FIRST + 6
    for lost, stage in ((PROGRAM_ACKS, PROGRAM), (COMMIT_ACKS, COMMIT)):
        loop = dut.loop(meal_mode(dut), [(FIRST, 30.0), (FIRST + 1, 20.0), (FIRST + 4, 20.0)], steps=until + 4)

        def wire(name: str, values: Values, loop: Loop = loop, lost: dict[int, int] = lost) -> Sequence[Values]:
            silent = FIRST <= loop.plant.step < until
            return [] if silent and (name == "PUMP_BolusState" or values.get("AckFor") in lost) else [values]

        loop.to_device = Forged(wire, "PUMP_Ack", "PUMP_BolusState")
        loop.play()
        tries = [each for each in commands(loop, stage) if each.step < until]
        expect(bool(tries), f"a bolus for the meal of step {FIRST}; none was asked for")
        number = tries[0].number
        last = [each for each in tries if each.number == number][-1]
        state = _state_after(loop, last.at)
        expect(
            state == State.DELIVERY_UNCERTAIN,
            f"DeliveryUncertain once nothing has come after the last try, {name_of(last)}; CtrlState {state} came",
        )
        expect(bool(loop.alarms("DeliveryUncertain")), "the alarm DeliveryUncertain; it never came")
        ids = {each.number for each in programs(loop) if each.step == last.step}
        others = [each for each in programs(loop) if each.number not in ids and each.step < until]
        expect(
            not others,
            f"no other bolus before the pump has told of {number}; in step "
            + ", ".join(f"{each.step} came {name_of(each)}" for each in others[:1]),
        )


def _state_after(loop: Loop, at: int) -> int | None:
    """CtrlState in the first status that follows the first token after a place in the record."""
    given = False
    for _, name, values in loop.heard[at:]:
        given |= name == "SYNC_Step"
        if given and name == "CTRL_Status":
            return values["CtrlState"]
    return None


@check("CMD-06", needs=["boluses"])
def uncertain_insulin(dut: Dut) -> None:
    """A bolus that the pump makes slowly and breaks off, with its answers and states lost for three steps.

    While nobody knows, InsulinOnBoard has all of it; once the pump has told, as much as of a bolus of just what came.
    """
    told, made = FIRST + 3, 50
    whole = dut.loop(meal_mode(dut), [(FIRST, 30.0)], steps=told + 4)
    flash(whole, CfgMaxBolus=made)
    whole.to_device = _slowly(whole)
    whole.play()
    loop = dut.loop(meal_mode(dut), [(FIRST, 30.0)], steps=told + 4)
    slowly = _slowly(loop)

    def lossy(name: str, values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name == "PUMP_Delivered" and loop.plant.step == FIRST + 1:
            loop.plant.pump.boluses[INSULIN].abort()
        bolus = name == "PUMP_BolusState" or values.get("AckFor") in COMMIT_ACKS
        return [] if bolus and FIRST <= loop.plant.step < told else slowly(name, values, frame)

    loop.to_device = lossy
    loop.play()
    dose = sum(each.dose for each in programs(loop, INSULIN))
    expect(dose >= 3 * made, f"a bolus of more than a unit for the meal of step {FIRST}; raw {dose} was programmed")
    for step in range(FIRST, told):
        least = loop.iob()[FIRST - 1] + 0.8 * dose  # some of it may have been used up
        expect(
            loop.iob()[step] >= least,
            f"InsulinOnBoard of at least {least:.0f} (0.01 U) in step {step}, while a bolus of {dose} may have been "
            f"given; {loop.iob()[step]} came",
        )
    for step in range(told + 1, told + 4):
        expect(
            abs(loop.iob()[step] - whole.iob()[step]) <= 0.15 * dose,
            f"InsulinOnBoard of about {whole.iob()[step]} (0.01 U) in step {step}, as after a bolus of the {made} that "
            f"were given; {loop.iob()[step]} came",
        )


def _slowly(loop: Loop) -> Forged:
    """A sound wire, beside which the pump makes a stroke of insulin in 30 s and no more."""

    def change(_name: str, values: Values) -> Sequence[Values]:
        loop.plant.pump.insulin.words[SLOWED] = STROKES_PER_SUBSTEP - 1
        return [values]

    return Forged(change, "PUMP_Ack", "PUMP_BolusState", "PUMP_Delivered")


# ---- refusals


@check("CMD-07", needs=["boluses"])
def refusals(dut: Dut) -> None:
    """Refused at Program by each result, at Commit, and because the pump's limit is 0.8 U.

    The request ends, the user is told, and what is asked for later is within the pump's limit.
    """
    kinds = ("OverLimit", "Busy", "WrongState", "Malformed")
    meals = [(FIRST + EVERY * k, 30.0) for k in range(len(kinds) + 1)]
    loop = dut.loop(meal_mode(dut), meals, steps=meals[-1][0] + EVERY)
    limit = loop.plant.pump.boluses[INSULIN].max_raw
    refused: dict[tuple[int, int], int] = {}  # (drug, id) -> place in the record

    def refuse(_name: str, ack: Values) -> Sequence[Values]:
        drug = PROGRAM_ACKS.get(ack["AckFor"])
        if drug is None or loop.plant.step >= meals[len(kinds)][0]:
            return [ack]
        kind = kinds[(loop.plant.step - FIRST) // EVERY]
        refused.setdefault((drug, ack["AckId"]), len(loop.heard))
        return [ack | {"AckResult": result(kind), "AckLimitRaw": limit}]

    def refuse_commit(_name: str, _values: Values, frame: Frame) -> None:
        message = codec.message("PUMP_BolusCmd")
        if frame.can_id == message.can_id and message.unpack(frame.data)["BolusOp"] == COMMIT:
            values = message.unpack(frame.data)
            refused.setdefault((values["BolusHormone"], values["BolusId"]), len(loop.heard))
            loop.plant.pump.boluses[values["BolusHormone"]].abort()  # so that there is nothing to commit

    loop.to_device, loop.to_plant = Forged(refuse, "PUMP_Ack"), refuse_commit
    loop.play()
    expect(bool(refused), "a bolus for one of the meals; none was asked for")
    for each in commands(loop):
        place = refused.get((each.drug, each.number))
        expect(
            place is None or each.at < place or each.op == CANCEL,
            f"nothing more of a bolus that was refused; {name_of(each)} came in step {each.step}",
        )
    expect(bool(loop.alarms("DoseRejected")), "the alarm DoseRejected for boluses that were refused; it never came")

    loop = dut.loop(meal_mode(dut), [(FIRST, 40.0), (FIRST + EVERY, 40.0)], steps=FIRST + 2 * EVERY)
    loop.plant.pump.boluses[INSULIN].max_raw = 80
    loop.play()
    asked = programs(loop, INSULIN)
    expect(len(asked) > 0 and asked[0].dose > 80, "more than 0.8 U asked for at a meal of 40 g")
    told = loop.alarms("DoseRejected") or loop.alarms("DoseLimited")
    expect(bool(told), "DoseRejected or DoseLimited for a bolus above the pump's limit; neither came")
    for each in asked[1:]:
        expect(each.dose <= 80, f"a bolus within the limit of raw 80 that the pump has told; {name_of(each)} came")


# ---- set-points


@check("CMD-08")
def set_points(dut: Dut) -> None:
    """A run with a high, lost samples and a low: every set-point expires and is renewed in time.

    Then the pump without a controller: at the expiry it runs its schedule, and no pramlintide.
    """
    settings = dut.settings.commands
    bench, last = dut.bench(), None
    for k in range(40):
        turn = bench.step(GLUCOSE + 60 * k if k < 15 else 690, drop=15 <= k < 25)
        for values in turn.all("PUMP_BasalCmd"):
            last = (k, values)
            ahead = (values["BasalUntilStep"] - k) % 128
            lowest = 0 if values["BasalOp"] == Op.RESUME_SCHEDULE else 1  # the schedule has nothing to expire
            expect(
                lowest <= ahead <= settings.rate_expiry,
                f"a set-point that expires 1..{settings.rate_expiry} steps ahead; {ahead} came in step {k}",
            )
        if last is not None and last[1]["BasalOp"] != Op.RESUME_SCHEDULE:
            expect(
                k - last[0] < settings.renew,
                f"a set-point at least every {settings.renew} steps; none came from step {last[0] + 1} to {k}",
            )
    expect(last is not None, "a set-point in 40 steps; none came")
    for ahead in (1, 3, 24):
        pump = Pump(PumpSettings(basal_milliunits_per_h=1200))
        command = {"BasalOp": Op.SET_RATE, "BasalCmdSeq": 5, "InsulinRate": 1000, "PramlintideRate": 300}
        pump.command(command | {"BasalUntilStep": (120 + ahead) % 128}, 120, Transmitter())
        for step in range(120, 120 + ahead + 30):
            before = pump.insulin.words[DELIVERED], pump.pramlintide.words[DELIVERED]
            pump.deliver(step)
            expired = step > 120 + ahead
            active = pump.values()[7]
            expect(active == (not expired), f"TbrActive {int(not expired)} {step - 120} steps on; {active} came")
            made = int(pump.insulin.words[DELIVERED] - before[0]), int(pump.pramlintide.words[DELIVERED] - before[1])
            # 1.2 U/h are two strokes of 0.05 U in 5 min, 5 U/h eight or nine; 30 ug/h five of 0.5 ug
            expect(
                (made[0] == 2 and made[1] == 0) if expired else made[0] > 7,
                f"{'the schedule and no pramlintide' if expired else 'the set-point'} {step - 120} steps on; strokes "
                f"{made} were made",
            )


@check("CMD-09")
def another_set_point(dut: Dut) -> None:
    """PUMP_Status shows a set-point of six steps ago, though the pump has answered all newer ones with Accepted.

    After two such steps the set-point is said again, or a newer one, and an alarm tells.
    """
    steps = dut.settings.commands.unlike
    wrong = range(12, 12 + steps + 2)
    loop = dut.loop("nma", steps=wrong.stop + 1)
    shown: list[int] = []

    def stale(_name: str, values: Values) -> Sequence[Values]:
        shown.append(values["PumpLastBasalSeq"])
        return [values | ({"PumpLastBasalSeq": shown[6]} if loop.plant.step in wrong else {})]

    loop.to_device = Forged(stale, "PUMP_Status")
    loop.play()
    accepted = [values["AckId"] for step, values in loop.steps_of("PUMP_Ack") if step <= wrong.start]
    expect(shown[6] not in accepted[-1:], "another set-point accepted within six steps; none was")
    again = [values for step, values in loop.steps_of("PUMP_BasalCmd") if step in wrong[steps - 1 :]]
    expect(bool(again), f"the set-point once more from step {wrong[steps - 1]} on; no PUMP_BasalCmd came")
    alarms = [alarm_code(name) for name in ("DeliveryUncertain", "PumpLost")]
    raised = [step for step, values in loop.steps_of("CTRL_Alarm") if values["CtrlAlarmCode"] in alarms]
    expect(
        any(step in wrong for step in raised),
        f"the alarm DeliveryUncertain or PumpLost by step {wrong[-1]}, as PumpLastBasalSeq is not that of the last "
        f"accepted set-point from step {wrong.start} on; none came",
    )
    early = [step for step in raised if step < wrong.start]
    expect(not early, f"no such alarm while PumpLastBasalSeq is right; it came in step {early[:1]}")


TOO_MUCH: Final = {"MealKind": codec.choice("MEAL_Announce", "MealKind", "CarbsEstimated"), "CarbsEst": 800}
"""400 g, in the fields of MEAL_Announce."""


@check("CMD-10", needs=["boluses"])
def all_or_nothing(dut: Dut) -> None:
    """A meal of 400 g; then one whose insulin the pump does not accept, in the modes that give both drugs.

    DoseRejected, and nothing of either drug.
    """
    for mode in MEALTIME:
        if mode not in dut.offers:
            continue
        loop = dut.loop(mode, [(FIRST, 400.0)], steps=FIRST + 2)
        loop.to_device = Forged(lambda _name, meal: [meal | TOO_MUCH], "MEAL_Announce")
        loop.play()
        asked = commands(loop)
        expect(
            not asked, f"no bolus for a meal of 400 g in mode {mode}; there came {name_of(asked[0]) if asked else ''}"
        )
        expect(
            bool(loop.alarms("DoseRejected")), f"the alarm DoseRejected for a meal of 400 g in mode {mode}; none came"
        )
        if mode not in ("s3", "s4"):
            continue
        loop = dut.loop(mode, [(FIRST, 30.0)], steps=FIRST + EVERY)
        loop.plant.pump.boluses[INSULIN].max_raw = 0
        loop.play()
        expect(
            bool(programs(loop, INSULIN)), f"a bolus of insulin for a meal of 30 g in mode {mode}; none was programmed"
        )
        given = commands(loop, COMMIT)
        expect(
            not given,
            f"no pramlintide for a meal whose insulin the pump refused in mode {mode}; there came "
            f"{name_of(given[0]) if given else ''}",
        )
