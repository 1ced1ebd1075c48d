"""Time (TIM): steps that come twice, never or late, clocks that jump, numbers that wrap, the order within a turn."""

from collections.abc import Sequence
from typing import Final

from can_bus import codec
from can_bus.codec import messages_by_id
from can_bus.faults.fields import repaired, with_raw
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Node, Phase
from plant_server import mechanism
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import carbs_mode
from pumpbench.conformance.driver import GLUCOSE, HIGH, Bench, State, Turn, expect
from pumpbench.conformance.loop import Loop
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import difference, expect_unused, idle_boluses

LAST_STEP: Final = 1048574
"""The largest StepIndex, after 9.9 years."""

COMMANDS: Final = ("PUMP_BasalCmd", "PUMP_BolusCmd")

FLOOD: Final = 600
"""Heartbeats in one batch: more than any step has frames."""


def expect_command_of(bench: Bench, turn: Turn, most: int) -> None:
    """One set-point, which is valid from the newest step on for at least one step and at most so many."""
    step = bench.k - 1
    ahead = (turn.command["BasalUntilStep"] - step) % 128
    expect(1 <= ahead <= most, f"a set-point that expires 1 to {most} steps after step {step}; it was {ahead}")


# ---- the checks


@check("TIM-01")
def repeated_steps(dut: Dut) -> None:
    """A step again, and earlier ones, each with a high sample and a meal: SYNC_Done and no command.

    The same token byte by byte is not answered, and the next step is as if nothing had been.
    """
    mode = carbs_mode(dut)
    last: list[Turn] = []
    for repeated in (False, True):
        bench = dut.bench(mode=MODES[mode or "nma"])
        for _ in range(12):
            bench.step(HIGH, also=idle_boluses(bench))
        if repeated:
            for step in (bench.k - 1, bench.k - 2, 0):
                turn = bench.token(Phase.STEP, step, step * STEP_SECONDS)
                _expect_no_command(turn, f"step {step} after step {bench.k - 1}")
            bench.give(
                next(frame for frame in reversed(bench.log) if messages_by_id()[frame.can_id].name == "SYNC_Step")
            )
        last.append(bench.step(HIGH, also=idle_boluses(bench)))
    told = (*COMMANDS, "CTRL_Status")
    other = difference(*([each for each in turn.said if each[0] in told] for turn in last))
    expect(not other, f"the same in the next step as without repeated ones; {other}")
    bench.send("MEAL_Announce", MealKind=1, MealId=0, CarbsEst=120, MealOffset=0)
    bench.give(bench.sample(HIGH + 500), *idle_boluses(bench))
    turn = bench.token(Phase.STEP, bench.k - 1, (bench.k - 1) * STEP_SECONDS)
    _expect_no_command(turn, f"step {bench.k - 1} again with another sample and a meal")


def _expect_no_command(turn: Turn, what: str) -> None:
    commands = [name for name in turn.names if name in COMMANDS]
    expect(not commands, f"no command for {what}; {', '.join(commands)} came")


@check("TIM-02")
def skipped_steps(dut: Dut) -> None:
    """Steps that never come, with the sensor silent: the ladder, a late sample, expiry and IOB by the true distance."""
    ladder = dut.settings.ladder
    for skipped, state in ((ladder.degraded, State.DEGRADED), (ladder.safe, State.SAFE_BASAL)):
        bench = dut.bench()
        last = bench.run(12, HIGH).used
        late = bench.sample(HIGH)
        bench.total += bench.basal * (skipped - 1)
        bench.k += skipped - 1
        turn = bench.step(cgm=[late] if skipped > ladder.degraded else [])
        expect(turn.state == state, f"{state.name} after a jump by {skipped} steps; {turn.state_name} came")
        expect_unused(bench, turn, last, f"a sample of {skipped - 1} steps ago")
        expect_command_of(bench, turn, dut.settings.commands.rate_expiry)
        rate = bench.commanded(turn)
        expect(rate <= bench.basal / 5, f"at most the schedule of {bench.basal / 5:g} after the jump; {rate:g} came")
    iob = [_iob_after(dut, jump) for jump in (False, True)]
    expect(
        abs(iob[1] - iob[0]) <= 10 + iob[0] // 20,
        f"after a jump by {JUMP} steps the insulin on board of as many steps without a sensor, {iob[0]}; {iob[1]} came",
    )


JUMP: Final = 24


def _iob_after(dut: Dut, jump: bool) -> int:
    """InsulinOnBoard two hours after 4 U, the pump on its schedule meanwhile."""
    bench = dut.bench()
    bench.run(12)
    bench.total += 4000 * 12
    bench.step()
    total = bench.total
    for k in range(JUMP):
        if not jump or k == JUMP - 1:
            bench.total = total + bench.basal * k
            turn = bench.step(drop=True)
        else:
            bench.k += 1
    return turn.iob


@check("TIM-03")
def clock_jumps(dut: Dut) -> None:
    """SimTime off by an hour and by just more than the limit, in one step: ClockJump, and a pause above the schedule.

    Nothing else changes, a bolus under way included; off by just the limit nothing at all does.
    """
    clock, caution = dut.settings.time.clock, dut.settings.time.caution
    for off in (0, clock, -clock, clock + 1, -clock - 1, 3600, -3600):
        bench = dut.bench()
        bench.k = 100
        turn = bench.run(8, HIGH)
        expect(turn.rate > bench.schedule, f"more than the schedule at {HIGH / 10:g} mg/dL; {turn.rate} came")
        number = bench.number
        turn = bench.instant(bench.sample(HIGH), bench.status(), bench.delivered(), off=off)
        status = {name: turn.status[name] for name in ("CtrlState", "InsulinOnBoard", "LastCgmSeq")}
        if off == 0:
            calm = status
        expect(turn.used == number and status == calm, f"{calm} with a clock {off} s off; {status} came")
        told = bool(turn.alarms("ClockJump"))
        expect(told == (abs(off) > clock), f"ClockJump with more than {clock} s; with {off} s it was {told}")
        rates = [bench.commanded(turn), *(bench.commanded(bench.step(HIGH)) for _ in range(caution + 2))]
        if told:
            paused = max(rates[:caution])
            expect(
                paused <= bench.basal / 5,
                f"at most the schedule of {bench.basal / 5:g} for {caution} samples after the clock jumped by {off} s; "
                f"{paused:g} came",
            )
        expect(rates[-1] > bench.basal / 5, f"an end of the pause after {caution + 2} samples; {rates[-1]:g} came")
    strategy = carbs_mode(dut)
    if strategy is not None:
        calm_loop = _meal_with_clock(dut, strategy, 0)
        for off in (3600, -3600):
            loop = _meal_with_clock(dut, strategy, off)
            expect(
                loop.states() == calm_loop.states() and loop.bolus_strokes(1) == calm_loop.bolus_strokes(1),
                f"the same states and bolus with the clock {off} s off while it is delivered",
            )
            found, known = loop.iob()[: JUMPED + 1], calm_loop.iob()[: JUMPED + 1]
            expect(
                found == known, f"the same insulin on board with the clock {off} s off, {known[-2:]}; {found[-2:]} came"
            )


JUMPED: Final = 21
"""A step, late enough for a clock that goes back by an hour."""


def _meal_with_clock(dut: Dut, strategy: str, off: int) -> Loop:
    """A meal's bolus from a slow motor, and in the step after it a clock that is so many seconds off."""
    loop = dut.loop(strategy, [(JUMPED - 1, 60.0)], JUMPED + 7)
    loop.plant.pump.insulin.words[mechanism.SLOWED] = mechanism.STROKES_PER_SUBSTEP - 1
    token = codec.message("SYNC_Step")

    def wire(name: str, values: dict[str, int], frame: Frame) -> Sequence[Frame] | None:
        if name != "SYNC_Step" or values["SyncPhase"] != Phase.STEP or values["StepIndex"] != JUMPED:
            return None
        return [Frame(frame.can_id, repaired(token, with_raw(token, frame.data, {"SimTime": values["SimTime"] + off})))]

    loop.to_device = wire
    return loop.play()


@check("TIM-04")
def numbers_that_wrap(dut: Dut) -> None:
    """Runs over the ends of modulo 128 and 256, and to the largest StepIndex: nothing expires, nothing looks fresh."""
    for start in (120, 250, LAST_STEP - 14):
        bench = dut.bench()
        bench.k = start
        for k in range(15):
            turn = bench.step(GLUCOSE + 10 * (k % 2))
            expect_command_of(bench, turn, dut.settings.commands.rate_expiry)
            if k >= 3:
                expect(
                    turn.state == State.AUTO, f"Auto in step {bench.k - 1} with good samples; {turn.state_name} came"
                )
        expect(not turn.all("CTRL_Alarm"), f"no alarm in steps {start} to {bench.k - 1}; {turn.all('CTRL_Alarm')} came")
    degraded = dut.settings.ladder.degraded
    bench = dut.bench()
    bench.k = 250
    last = bench.run(4).used
    for age in range(1, degraded + 2):
        old = bench.sample(CgmSampleStep=(bench.k - 9) % 256)
        turn = bench.step(cgm=[old] if age > degraded else [])
        fresh = turn.state == State.AUTO
        expect(
            fresh == (age < degraded), f"Auto up to age {degraded - 1}, over step 256; at age {age} Auto was {fresh}"
        )
    expect_unused(bench, turn, last, "a sample of 9 steps ago, from before step 256,")
    strategy = carbs_mode(dut)
    if strategy is not None:
        bench = dut.bench(mode=MODES[strategy])
        bench.k = 250
        for _ in range(5):
            bench.step(also=idle_boluses(bench))
        meal = bench.frame("MEAL_Announce", MealKind=1, MealId=0, CarbsEst=120, MealOffset=0)
        turn = bench.step(also=[meal, *idle_boluses(bench)])
        ahead = [(command["BolusUntilStep"] - 255) % 256 for command in turn.all("PUMP_BolusCmd")]
        most = dut.settings.commands.bolus_expiry
        expect(
            bool(ahead) and max(ahead) <= most, f"a bolus in step 255 that expires within {most} steps; {ahead} came"
        )


@check("TIM-05")
def the_order_of_a_turn(dut: Dut) -> None:
    """Turns with boluses, a device that sleeps through three tokens, and a flood: commands first, and none is old."""
    loop = dut.loop(carbs_mode(dut) or "nma", [(10, 60.0)], 16)
    loop.device = _InTurn(loop.device)
    loop.play()
    bench = dut.bench()
    bench.run(12)
    for _ in range(3):
        bench.give(bench.sample(), bench.status(), bench.delivered())
        bench.k += 1
    _expect_nothing_stale(dut, bench, "after three tokens were missed")
    bench.give(
        *(bench.frame("HB_PUMP", NmtPump=5, TogglePump=k % 2, ResetCausePump=0, BootPump=0) for k in range(FLOOD))
    )
    for _ in range(2):
        _expect_nothing_stale(dut, bench, f"after {FLOOD} frames in a step")


def _expect_nothing_stale(dut: Dut, bench: Bench, when: str) -> None:
    number = bench.number
    turn = bench.step()
    expect_command_of(bench, turn, dut.settings.commands.rate_expiry)
    expect(turn.used == number, f"the newest sample is used {when}; LastCgmSeq {turn.used} came, not {number}")


class _InTurn:
    """A device whose turns must be closed as they should be."""

    finished = False

    def __init__(self, device: Node) -> None:
        self._device = device

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """What the device says.

        Raises:
            Violation: SYNC_Done is not the last of its frames, or does not count them.
        """
        said = self._device.receive(frame)
        done = codec.message("SYNC_Done")
        for place, each in enumerate(said, start=1):
            if each.can_id == done.can_id:
                count = done.unpack(each.data)["TxCount"]
                expect(place == len(said), f"SYNC_Done last in a turn; {len(said) - place} frames came behind it")
                expect(count == len(said), f"TxCount {len(said)}, the frames of this turn; {count} came")
        return said
