"""Delivery ledger (LED): what was delivered counts, once, whatever was asked for."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from can_bus import codec
from can_bus.frame import Frame
from plant_server.mechanism import SLOWED, STROKES_PER_SUBSTEP
from plant_server.pump import Pump
from pumpbench.conformance.boluses import COMMIT_ACKS, FIRST, INSULIN, Forged, flash, meal_mode, programs
from pumpbench.conformance.driver import GLUCOSE, HIGH, Bench, Turn, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, Need, check

CLOSE: Final = 5
"""0.01 U, a stroke: amounts that differ by no more are the same."""


MADE_IN_A_STEP: Final = 50
"""0.01 U of a slow motor: a stroke of 0.05 U in every 30 s."""


def expect_alike(found: Sequence[int], wanted: Sequence[int], after: str) -> None:
    """InsulinOnBoard step by step, as in another run."""
    expect(
        all(abs(one - other) <= CLOSE for one, other in zip(found, wanted, strict=True)),
        f"InsulinOnBoard of about {wanted} (0.01 U) in the steps after {after}; {found} came",
    )


# ---- the simulated pump


class Book(NamedTuple):
    """Where the bus tells of one drug's strokes."""

    total: str  # of PUMP_Delivered
    pages: str  # what the signals of PLANT_Truth begin with


BOOKS: Final = {
    codec.choice("PLANT_Truth", "TruthSel", "InsulinLedger"): Book("InsulinTotal", "TruthInsulin"),
    codec.choice("PLANT_Truth", "TruthSel", "PramLedger"): Book("PramTotal", "TruthPram"),
}

STROKE_OF_TOTAL: Final = 50
"""0.05 U in 0.001 U, and 0.5 ug in 0.01 ug."""

MODULUS: Final = 16384
"""PLANT_Truth counts lost strokes modulo this."""

BUSY_MODES: Final[tuple[Need, ...]] = ("s4", "s3", "s2", "ma", "sma", "nma")
"""The more drugs and boluses, the better."""


@check("LED-01")
def every_stroke(dut: Dut) -> None:
    """Occlusions of both lines, air, a reset of the pump and a change of sets, with a bolus where there can be one.

    In every step PLANT_Truth and PUMP_Delivered account for every stroke of both drugs.
    """
    mode = next(name for name in BUSY_MODES if name in dut.offers)
    loop = dut.loop(mode, [(FIRST, 60.0)], steps=FIRST + 26)
    pump = loop.plant.pump
    events: dict[int, Callable[[], None]] = {
        FIRST: pump.insulin.occlude,
        FIRST + 4: lambda: pump.insulin.release(lost=True),
        FIRST + 6: lambda: pump.insulin.insert_air(5),
        FIRST + 8: pump.reset,
        FIRST + 10: pump.pramlintide.occlude,
        FIRST + 16: pump.pramlintide.release,
        FIRST + 20: pump.insulin.change,
    }

    def wire(name: str, _values: Values, _frame: Frame) -> None:
        if name == "SYNC_Step":  # the pump has told of this instant, and runs after it
            events.pop(loop.plant.step, lambda: None)()

    loop.to_device = wire
    loop.play()
    made, before, boots = dict.fromkeys(BOOKS, 0), dict.fromkeys(BOOKS, 0), 0
    for step, name, values in loop.heard:
        if name == "PUMP_Delivered":
            for page, book in BOOKS.items():
                before[page] += made[page] if values["PumpBootCount"] != boots else 0  # totals begin anew
                made[page] = values[book.total] // STROKE_OF_TOTAL
            boots = values["PumpBootCount"]
        elif name == "PLANT_Truth" and values["TruthSel"] in BOOKS:
            page = values["TruthSel"]
            commanded, pending, lost = (values[BOOKS[page].pages + what] for what in ("Commanded", "Pending", "Lost"))
            delivered = before[page] + made[page]
            expect(
                (commanded - delivered - pending - lost) % MODULUS == 0,
                f"commanded = delivered + pending + lost of {BOOKS[page].pages} in step {step}; "
                f"{commanded} = {delivered} + {pending} + {lost} came",
            )


# ---- insulin on board


@check("LED-02")
def totals_not_commands(dut: Dut) -> None:
    """The pump gives nothing of a rate above the schedule for an hour, nothing of the schedule, and 2 U unasked.

    InsulinOnBoard does not rise, stays at nothing even when the schedule is back, and rises by what came.
    """
    bench = dut.bench()
    bench.run(12, HIGH)
    last, *turns = _without_delivery(bench, HIGH)  # the first still tells of the step before
    expect(last.iob > 0, f"insulin on board after an hour above the schedule; InsulinOnBoard {last.iob} came")
    for k, turn in enumerate(turns):
        expect(
            turn.iob <= last.iob + 1,
            f"InsulinOnBoard not above the {last.iob} (0.01 U) of the step before while the pump gives nothing; "
            f"{turn.iob} came in step {13 + k}",
        )
        last = turn
    bench = dut.bench()
    bench.run(FIRST)
    for turn in (*_without_delivery(bench, GLUCOSE), *(bench.step() for _ in range(6))):
        expect(turn.iob <= CLOSE, f"nothing on board of a schedule that was missed; {turn.iob} came")
    bench = dut.bench()
    bench.run(FIRST)
    bench.total += 12 * 2000
    found = bench.step().iob
    expect(abs(found - 200) <= 20, f"InsulinOnBoard of about 200 (0.01 U) once 2 U came unasked; {found} came")


def _without_delivery(bench: Bench, glucose: int) -> Iterable[Turn]:
    """An hour in which the pump's totals stand still, whatever is asked for."""
    for _ in range(12):
        total, turn = bench.total, bench.step(glucose)
        bench.total = total
        yield turn


@check("LED-03")
def totals_that_fall(dut: Dut) -> None:
    """Totals that fall to nothing in one frame without a new PumpBootCount; then resets of the pump, in a bolus too.

    InsulinOnBoard goes on as if nothing had happened, and the fall without a reset is an alarm.
    """
    bench = dut.bench()
    bench.run(12, HIGH)
    wanted = [bench.step(HIGH).iob for _ in range(4)]
    usual = _pending(bench)

    bench = dut.bench()
    bench.run(12, HIGH)
    fallen = bench.delivered(InsulinTotal=0, PramTotal=0)
    found = [bench.step(HIGH, totals=fallen).iob, *(bench.step(HIGH).iob for _ in range(3))]
    expect_alike(found, wanted, "a total that fell without a reset of the pump")
    expect(bool(_pending(bench) - usual), "an alarm for a total that fell without a reset of the pump; none came")

    bench = dut.bench()
    last = bench.run(11, HIGH)
    bench.boot_count, bench.total, told = 1, 0, bench.total  # the pump resets when it has told its totals
    last = bench.step(HIGH, totals=bench.delivered(PumpBootCount=0, InsulinTotal=told // 12))
    found = [bench.step(HIGH).iob for _ in range(4)]
    expect(last.iob > 0, f"insulin on board before the reset of the pump; {last.iob} came")
    expect_alike(found, wanted, "a reset of the pump")
    if "boluses" not in dut.offers:
        return  # it gives none

    whole = _slow_bolus(dut, FIRST + 5)
    flash(whole, CfgMaxBolus=2 * MADE_IN_A_STEP)
    wanted = _levels_after(whole, FIRST + 2)
    found = _levels_after(_slow_bolus(dut, FIRST + 5, at=FIRST + 2, event=Pump.reset), FIRST + 2)
    expect_alike(found, wanted, f"a reset of the pump that had made {2 * MADE_IN_A_STEP} of a bolus")


def _pending(bench: Bench) -> set[int]:
    """CtrlAlarmCode of all alarms so far."""
    message = codec.message("CTRL_Alarm")
    return {message.unpack(frame.data)["CtrlAlarmCode"] for frame in bench.log if frame.can_id == message.can_id}


@check("LED-04", needs=["boluses"])
def broken_off(dut: Dut) -> None:
    """A bolus broken off when 0.5 U and 1.5 U of it are made (long: 1 U as well), its acknowledgements lost or not.

    In the two steps after it InsulinOnBoard is that of a bolus of just what was made, which went well.
    """
    for steps in (1, 2, 3) if dut.long else (1, 3):
        whole = _slow_bolus(dut, FIRST + steps + 3)
        made = steps * MADE_IN_A_STEP
        flash(whole, CfgMaxBolus=made)
        wanted = _levels_after(whole, FIRST + steps)
        expect(
            0.7 * made - CLOSE <= wanted[0] <= 1.2 * made + CLOSE,  # some may be used up, some added for the meal
            f"InsulinOnBoard of about {made} (0.01 U) after a bolus of it; {wanted[0]} came",
        )
        for lost in (False, True):
            loop = _slow_bolus(dut, FIRST + steps + 3, at=FIRST + steps, lost=lost)
            found = _levels_after(loop, FIRST + steps)
            (asked,) = programs(loop, INSULIN)
            expect(
                asked.dose > made, f"a bolus of more than raw {made} for a meal of 30 g; {asked.dose} was programmed"
            )
            how = "with its acknowledgements lost" if lost else "that was acknowledged"
            expect_alike(found, wanted, f"a bolus of {asked.dose} {how} was broken off at {made}")


def _break_off(pump: Pump) -> None:
    pump.boluses[INSULIN].abort()


def _slow_bolus(
    dut: Dut, end: int, *, at: int | None = None, event: Callable[[Pump], None] = _break_off, lost: bool = False
) -> Loop:
    """A run with a meal of 30 g whose bolus the pump makes slowly, until what happens when it has told of step `at`."""
    loop = dut.loop(meal_mode(dut), [(FIRST, 30.0)], steps=end)
    pump = loop.plant.pump

    def change(name: str, values: Values) -> Sequence[Values]:
        pump.insulin.words[SLOWED] = STROKES_PER_SUBSTEP - 1
        if name == "PUMP_Delivered" and loop.plant.step == at:
            event(pump)
        return [] if lost and values.get("AckFor") in COMMIT_ACKS else [values]

    loop.to_device = Forged(change, "PUMP_Ack", "PUMP_Delivered")
    return loop


def _levels_after(loop: Loop, step: int) -> list[int]:
    """InsulinOnBoard of the steps after this one, of a run that is played now."""
    loop.play()
    expect(len(programs(loop, INSULIN)) == 1, f"one bolus of insulin for the meal of step {FIRST}")
    return loop.iob()[step + 1 :]
