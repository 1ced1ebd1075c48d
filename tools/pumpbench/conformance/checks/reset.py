"""Reset and memory (RST): a device that loses its power, and a pump that does."""

from collections.abc import Callable, Sequence
from typing import Final

from can_bus import codec
from can_bus.codec import Receiver
from can_bus.faults.nodes import MemoryState
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import ACK_OF, COMMIT, INSULIN, PROGRAM, PowerCut, bolus_steps, carbs_mode
from pumpbench.conformance.driver import (
    HIGH,
    NMA,
    RESUME,
    SENT_BY_CTRL,
    SUSPEND,
    Bench,
    State,
    Turn,
    calibration,
    expect,
    parameter_index,
)
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, NotOffered, check
from pumpbench.conformance.situations import RETURN, expect_state, expect_unused, idle_boluses

BOOT_COUNTS: Final = 32
"""HB_CTRL.BootCtrl has five bits."""

BOOT_UP: Final = codec.choice("HB_CTRL", "NmtCtrl", "BootUp")
CAUSES: Final = tuple(
    codec.choice("HB_CTRL", "ResetCauseCtrl", cause) for cause in ("PowerOn", "BrownOut", "Watchdog", "Software", "Pin")
)

SLACK: Final = 10
"""0.01 U: what the schedule of a step or two, which another device may count otherwise, makes of insulin on board."""

MEAL: Final = 10
"""The step of the meal around which the power is cut."""


def restarted(dut: Dut, bench: Bench, memory: MemoryState = "kept") -> Turn:
    """Power off and on in the middle of a run; what the device says by itself, with its counters from 0."""
    frames = dut.restart(memory)
    bench.receiver = Receiver(SENT_BY_CTRL)
    return bench.listen(frames)


def with_insulin(dut: Dut, **how: object) -> Bench:
    """A device that has seen 4 U delivered above the schedule."""
    bench = dut.bench(**how)
    bench.run(12)
    bench.total += 4000 * 12
    bench.step()
    return bench


# ---- power cuts within a meal


def _meal(dut: Dut, when: Callable[[str, Values], bool] = lambda *_: False) -> Loop:
    """A meal, and the power cut at a frame of it."""
    strategy = carbs_mode(dut)
    loop = dut.loop(strategy or "nma", [(MEAL, 60.0)], MEAL + 12)
    loop.device = PowerCut(dut, loop.device, when)
    return loop.play()


def _nth(place: int) -> Callable[[str, Values], bool]:
    """The frame at this place, counted from the announcement of the meal, or without one from its step."""
    seen: list[str] = []

    def when(name: str, values: Values) -> bool:
        if seen or name == "MEAL_Announce":
            seen.append(name)
        return len(seen) == place + 1

    return when


def _expect_safe(loop: Loop, calm: Loop, what: str) -> None:
    """A meal that was cut is dosed once or not at all, and the insulin of a dose is on board."""
    doses, most = loop.commits(1), calm.bolus_strokes(1)
    expect(len(doses) <= 1, f"one bolus for one meal {what}; {doses} were committed")
    strokes = loop.bolus_strokes(1)
    expect(strokes <= most, f"at most the {most} strokes of the meal {what}; {strokes} were delivered")
    begun = min(bolus_steps(loop, COMMIT), default=None)
    for step, values in loop.steps_of("CTRL_Status"):
        expect(
            begun is None
            or not begun < step < begun + 3
            or values["InsulinOnBoard"] >= 0.95 * doses[min(doses)] - SLACK,
            f"the bolus of step {begun} on board in step {step} {what}, {doses}; {values['InsulinOnBoard']} came",
        )
    modes = {values["CtrlMode"] for values in loop.all("CTRL_Status")}
    expect(len(modes) == 1, f"one mode {what}; {modes} came")
    state = loop.states()[-1]
    expect(state == State.AUTO, f"Auto in the end {what}; CtrlState {state} came")


# ---- the checks


@check("RST-01", needs=["restart", "nvm"])
def power_cuts(dut: Dut) -> None:
    """Restarts between two steps and at any frame of a step: mode, IOB, numbers, limits, suspension and alarms stay.

    With boluses also at the frames around a meal, in the long form at each of them.
    """
    bench = with_insulin(dut, mode=MODES["s2"] if "s2" in dut.offers else NMA)
    sample = bench.sample()
    bench.step(cgm=[sample])
    before = bench.step()
    restarted(dut, bench)
    turn = bench.step(cgm=[sample])
    expect_unused(bench, turn, before.used, "a sample that was used before the power was cut")
    _expect_kept(before, turn)
    for heard in (1, 2, 3):  # of sample, status and totals
        before = bench.step()
        frames = [bench.sample(), bench.status(), bench.delivered()]
        bench.give(*frames[:heard])
        restarted(dut, bench)
        _expect_kept(before, bench.step(cgm=[], status=heard < 2, totals=heard < 3))
    turn = bench.run(RETURN)
    expect_state(turn, State.AUTO, f"{RETURN} good steps after a restart")
    _limits_are_kept(dut)
    _suspension_and_alarms_are_kept(dut)
    if carbs_mode(dut) is not None:
        calm = _meal(dut)
        names = [name for step, name, _ in calm.heard if step >= MEAL and name in TO_DEVICE]
        first = names.index("MEAL_Announce")
        for place, name in enumerate(names[first : first + 45]):
            if dut.long or name in ("MEAL_Announce", "SYNC_Step"):
                _expect_safe(_meal(dut, _nth(place)), calm, f"with power cut at frame {place} of it, a {name}")


TO_DEVICE: Final = frozenset(message.name for message in codec.messages().values() if message.sender != "CTRL")


def _expect_kept(before: Turn, turn: Turn) -> None:
    """What the next step says goes on from the one before."""
    for name in ("CtrlMode", "LastMealId"):
        was, now = before.status[name], turn.status[name]
        expect(now == was, f"{name} {was} as before the power was cut; {now} came")
    was, now = before.status["InsulinOnBoard"], turn.iob
    least = was * 0.95 - SLACK
    expect(now >= least, f"at least {least:.0f} of insulin on board, {was} before the power was cut; {now} came")
    number, next_number = before.command["BasalCmdSeq"], turn.command["BasalCmdSeq"]
    ahead = (next_number - number) % BASAL_NUMBERS
    expect(0 < ahead < BASAL_NUMBERS // 2, f"a BasalCmdSeq that goes on from {number}; {next_number} came")


BASAL_NUMBERS: Final = 1023
"""BasalCmdSeq runs from 0 to 1022."""


def _limits_are_kept(dut: Dut) -> None:
    cap = calibration()[0] * 3 // 2
    bench = dut.bench(flash=calibration(CfgMaxBasal=cap))
    bench.run(8, HIGH)
    restarted(dut, bench)
    for _ in range(RETURN):
        turn = bench.step(HIGH)
        rate = bench.commanded(turn)
        expect(rate <= cap / 5, f"at most CfgMaxBasal, {cap / 5:g}, after a restart; {rate:g} came")
    expect(rate > bench.basal / 5, f"more than the schedule {RETURN} steps after a restart; {rate:g} came")


def _suspension_and_alarms_are_kept(dut: Dut) -> None:
    bench = dut.bench()
    bench.run(4)
    for _ in range(dut.settings.ladder.degraded + 1):
        turn = bench.step(drop=True)
    expect(turn.pending("CgmLost"), "the alarm CgmLost without samples")
    restarted(dut, bench)
    turn = bench.step(drop=True)
    expect(turn.pending("CgmLost"), "the alarm CgmLost also after a restart")
    bench.request(1, SUSPEND)
    bench.step()
    restarted(dut, bench)
    expect_state(bench.step(), State.SUSPENDED, "after a restart, as the user has it")


@check("RST-02", needs=["restart", "nvm", "memory"])
def a_damaged_memory(dut: Dut) -> None:
    """A record that is half written: mode and IOB as before. Nothing left: the schedule at most, and no bolus.

    A device that then still knows a calibration must count CfgMaxIob and tell of it with the alarm SelfTest.
    """
    strategy = carbs_mode(dut)
    bench = with_insulin(dut, mode=MODES[strategy or "nma"])
    before = bench.step()
    restarted(dut, bench, "torn")
    turn = bench.step()
    for name in ("CtrlMode", "InsulinOnBoard"):
        was, now = before.status[name], turn.status[name]
        expect(
            now == was if name == "CtrlMode" else now >= was * 0.95 - SLACK,
            f"{name} of at most one step ago after a torn write, {was}; {now} came",
        )
    expect_state(bench.run(RETURN), State.AUTO, f"{RETURN} good steps after a torn write")
    restarted(dut, bench, "lost")
    for k in range(dut.settings.reset.iob_hold * 3600 // STEP_SECONDS):
        turn = _announced(bench, k)
        begun = turn.all("PUMP_BolusCmd")
        expect(not begun, f"no bolus by a device that has lost its memory; {begun[:1]} came")
        rate = bench.commanded(turn) if turn.all("PUMP_BasalCmd") else 0.0
        expect(
            rate <= bench.basal / 5,
            f"at most the schedule of {bench.basal / 5:g} by a device that has lost its memory; {rate:g} came",
        )
        if turn.state not in (State.INIT, State.FAULT):
            iob = turn.iob
            expect(
                iob >= bench.flash[parameter_index("CfgMaxIob")],
                f"CfgMaxIob on board by a device that knows of none; {iob} came",
            )
            expect(bool(bench.raised("SelfTest")), "the alarm SelfTest by a device that has lost its memory")


@check("RST-03", needs=["restart", "nvm", "boluses"])
def boluses_after_a_restart(dut: Dut) -> None:
    """Meals after a restart, with status, totals or bolus states held back: no bolus before the last of them is there.

    And a restart between a Commit and its acknowledgement: no second dose.
    """
    strategy = carbs_mode(dut)
    if strategy is None:
        raise NotOffered("a mode with boluses for announced carbohydrates")
    for held in ("PUMP_Status", "PUMP_Delivered", "PUMP_BolusState"):
        bench = dut.bench(mode=MODES[strategy])
        for _ in range(8):
            bench.step(also=idle_boluses(bench))
        restarted(dut, bench)
        for number in range(RETURN):
            begun = _announced(bench, number, held).all("PUMP_BolusCmd")
            expect(not begun, f"no bolus after a restart before {held} was heard; {begun[:1]} came")
        for number in range(RETURN, 2 * RETURN):
            begun = _announced(bench, number).all("PUMP_BolusCmd")
            if begun:
                break
        expect(bool(begun), f"a bolus for a meal within {RETURN} steps after {held} was heard again")
    calm = _meal(dut)
    loop = _meal(dut, lambda name, values: name == "PUMP_Ack" and values["AckFor"] == ACK_OF[INSULIN, COMMIT])
    _expect_safe(loop, calm, "with a restart between Commit and acknowledgement")


def _announced(bench: Bench, meal: int, held: str = "") -> Turn:
    """A step with a meal, one of the pump's messages held back."""
    meal_frame = bench.frame("MEAL_Announce", MealKind=1, MealId=meal, CarbsEst=100, MealOffset=0)
    states = [] if held == "PUMP_BolusState" else idle_boluses(bench)
    return bench.step(HIGH, status=held != "PUMP_Status", totals=held != "PUMP_Delivered", also=[meal_frame, *states])


@check("RST-04", needs=["restart", "nvm"])
def resets_are_told(dut: Dut) -> None:
    """Restarts in a row: each is told by heartbeat and NodeReset; too many hold SafeBasal until the user resumes."""
    resets = dut.settings.reset.resets
    for number, held in ((resets - 1, False), (resets, True)):
        bench = dut.bench()
        boots = bench.run(6).one("HB_CTRL")["BootCtrl"]
        for _ in range(number):
            heartbeat = restarted(dut, bench).one("HB_CTRL")
            boots = (boots + 1) % BOOT_COUNTS
            expect(heartbeat["NmtCtrl"] == BOOT_UP, f"BootUp after a start; NmtCtrl {heartbeat['NmtCtrl']} came")
            expect(heartbeat["BootCtrl"] == boots, f"BootCtrl {boots}, one more; {heartbeat['BootCtrl']} came")
            cause = heartbeat["ResetCauseCtrl"]
            expect(cause in CAUSES, f"a ResetCauseCtrl of the DBC; {cause} came")
            expect(bool(bench.step().alarms("NodeReset")), "the alarm NodeReset in the step after a start")
        for k in range(HELD_STEPS):
            turn = bench.step(HIGH)
            if held:
                expect_state(turn, State.SAFE_BASAL, f"{k} steps after {number} resets within an hour")
        if not held:
            expect_state(turn, State.AUTO, f"{HELD_STEPS} steps after {number} resets within an hour")
    bench.request(1, RESUME)
    expect_state(bench.run(RETURN), State.AUTO, f"{RETURN} steps after the user has resumed")


HELD_STEPS: Final = 15
"""More than an hour."""


@check("RST-05", needs=["boluses"])
def a_reset_of_the_pump(dut: Dut) -> None:
    """The pump starts anew when it has just agreed to a bolus: that one is never committed any more.

    The rate is set again, and the next meal has another BolusId.
    """
    strategy = carbs_mode(dut)
    if strategy is None:
        raise NotOffered("a mode with boluses for announced carbohydrates")
    loop = dut.loop(strategy, [(MEAL, 60.0), (MEAL + 6, 40.0)], MEAL + 10)

    def wire(name: str, values: Values, _frame: Frame) -> Sequence[Frame] | None:
        if name != "PUMP_Ack" or values["AckFor"] != ACK_OF[INSULIN, PROGRAM] or loop.plant.step != MEAL:
            return None
        if loop.plant.pump.boots == 0:
            loop.plant.pump.reset()
        return []

    loop.to_device = wire
    loop.play()
    programmed = {
        step: values["BolusId"] for step, values in loop.steps_of("PUMP_BolusCmd") if values["BolusOp"] == PROGRAM
    }
    old = programmed.get(MEAL)
    expect(old is not None, f"a bolus for the meal of step {MEAL}; Programs came in steps {list(programmed)}")
    late = [
        step
        for step, values in loop.steps_of("PUMP_BolusCmd")
        if values["BolusOp"] == COMMIT and values["BolusId"] == old
    ]
    expect(not late, f"no Commit of a bolus that was programmed before the pump's reset; one came in step {late[:1]}")
    new = [number for step, number in programmed.items() if step > MEAL]
    expect(bool(new) and old not in new, f"another BolusId than {old} for the next meal; {new} came")
    active = [values["TbrActive"] for step, values in loop.steps_of("PUMP_Status") if step > MEAL]
    renew = dut.settings.commands.renew
    expect(
        1 in active[: renew + 1], f"the rate set again within {renew} steps of the pump's reset; TbrActive was {active}"
    )
