"""Fallback ladder (FAL): a device without its sensor, its pump, the user's leave or its own soundness."""

from collections.abc import Callable, Collection, Sequence
from typing import Final

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from plant_server import mechanism
from plant_server.physiology import load_patient
from pumpbench.calibration import MODES, SAFE, calibrate
from pumpbench.conformance.boluses import CANCEL, COMMIT, PROGRAM, bolus_steps, meal_mode
from pumpbench.conformance.driver import GLUCOSE, HIGH, NMA, PENDING, RESUME, SUSPEND, Bench, State, Turn, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import RETURN, damaged, dosing, expect_state, overload

CAUSES: Final[dict[int, frozenset[str]]] = {
    State.INIT: frozenset({"StateChange"}),
    State.AUTO: frozenset(),
    State.DEGRADED: frozenset({"CgmLost", "CgmImplausible"}),
    State.SAFE_BASAL: frozenset({"CgmLost", "CgmImplausible", "NodeReset"}),
    State.SUSPENDED: frozenset({"StateChange"}),
    State.FAULT: frozenset({"Watchdog", "SelfTest"}),
    State.DELIVERY_UNCERTAIN: frozenset({"PumpLost", "DeliveryUncertain"}),
}
"""What may tell why a state is entered or left."""


def steps_beyond(minutes: float) -> int:
    """The first step at which something that happens once per step has been missing for more than so many minutes."""
    return int(minutes * 60) // STEP_SECONDS + 1


def expect_schedule(bench: Bench, turn: Turn, when: str) -> None:
    """Exactly the schedule and no pramlintide; a set-point may be as much lower as its resolution makes it."""
    rate, drug = bench.commanded(turn), turn.pramlintide
    what = f"exactly the schedule of {bench.basal / 5:g} {when}"
    expect(bench.basal / 5 - 1 < rate <= bench.basal / 5, f"{what}; {rate:g} came")
    expect(drug == 0, f"no pramlintide {when}; {drug} came")


def lose(loop: Loop, names: Collection[str], first: int, last: int) -> None:
    """Lose these messages on their way to the device from one step to before another one."""

    def wire(name: str, _values: Values, _frame: Frame) -> Sequence[Frame] | None:
        return [] if name in names and first <= loop.plant.step < last else None

    loop.to_device = wire


# ---- the checks


@check("FAL-01")
def a_sensor_gone_for_20_minutes(dut: Dut) -> None:
    """Samples stop: Degraded and CgmLost at the limit, at most the schedule; a meal then is refused and not dosed."""
    ladder = dut.settings.ladder
    bench = dosing(dut)
    for age in range(1, ladder.safe):
        turn = bench.step(cgm=[])
        if age < ladder.degraded:
            continue
        when = f"when the newest sample is {age} steps old"
        expect_state(turn, State.DEGRADED, when)
        rate = bench.commanded(turn)
        expect(rate <= bench.basal / 5, f"at most the schedule of {bench.basal / 5:g} {when}; {rate:g} came")
        expect(age > ladder.degraded or turn.pending("CgmLost"), f"the alarm CgmLost {when}; it did not come")
    if "boluses" not in dut.offers:
        return
    gone, meal, back = 20, 20 + ladder.degraded, 20 + ladder.safe - 1
    loop = dut.loop(meal_mode(dut), meals=[(meal, 60.0)], steps=back + RETURN)
    lose(loop, ["CGM_Reading"], gone, back)
    loop.play()
    dosed = bolus_steps(loop, PROGRAM, COMMIT)
    expect(
        not dosed,
        f"no bolus for a meal of step {meal} without a sensor since step {gone}; one came in step {dosed[:1]}",
    )
    told = [step for step, _ in _alarms(loop, "DoseRejected")]
    expect(bool(told) and told[0] <= meal + 1, f"DoseRejected for the meal of step {meal}; it came in steps {told[:3]}")


def _alarms(loop: Loop, code: str) -> list[tuple[int, Values]]:
    number = codec.choice("CTRL_Alarm", "CtrlAlarmCode", code)
    return [(step, values) for step, values in loop.steps_of("CTRL_Alarm") if values["CtrlAlarmCode"] == number]


@check("FAL-02")
def a_sensor_gone_for_two_hours(dut: Dut) -> None:
    """Samples stop in a low, with insulin off, and in a high: either way exactly the schedule and no pramlintide."""
    low = dut.bench(flash=calibrate(load_patient("adult#001"), SAFE))
    for glucose in (*[GLUCOSE, GLUCOSE + 10] * 5, 900, 600, 610, 600):
        turn = low.step(glucose)
    expect(low.commanded(turn) == 0, f"no insulin at 60 mg/dL; {low.commanded(turn):g} came")
    _expect_safe_basal(dut, low, 24)
    high = dosing(dut, mode=MODES["s2"] if "s2" in dut.offers else NMA)
    _expect_safe_basal(dut, high, dut.settings.ladder.safe + 2)


def _expect_safe_basal(dut: Dut, bench: Bench, steps: int) -> None:
    """So many steps without a sample."""
    for age in range(1, steps + 1):
        turn = bench.step(cgm=[])
        if age >= dut.settings.ladder.safe:
            when = f"when the newest sample is {age} steps old"
            expect_state(turn, State.SAFE_BASAL, when)
            expect_schedule(bench, turn, when)


@check("FAL-03")
def the_way_back_up(dut: Dut) -> None:
    """Single samples raise nothing; several do, rung by rung, without a dose to make up; flapping does not nag."""
    ladder = dut.settings.ladder
    bench = dosing(dut)
    before = bench.step(HIGH)
    for _ in range(ladder.safe + 1):
        bench.step(cgm=[])
    for k in range(4 * (ladder.up - 1) * 2):
        turn = bench.step(HIGH, cgm=[] if k % ladder.up == ladder.up - 1 else None)
        expect_state(turn, State.SAFE_BASAL, f"with never more than {ladder.up - 1} good samples in a row")
    bench.step(cgm=[])
    states, rates = [State.SAFE_BASAL], []
    for good in range(1, RETURN + 1):
        turn = bench.step(HIGH)
        climbed = states[-1] - turn.state
        expect(climbed <= 1, f"one rung per step; {states[-1].name} to {turn.state_name} came")
        expect(climbed <= 0 or good >= ladder.up, f"no rung up before {ladder.up} good samples; {turn.state_name} came")
        states.append(turn.state)
        rates.append(bench.commanded(turn))
    expect_state(turn, State.AUTO, f"after {RETURN} good samples")
    _expect_nothing_made_up(dut, before.rate, rates)
    _expect_no_nagging(dut, "every second sample is lost", 72, lambda bench, k: bench.step(HIGH, drop=k % 2 == 1))
    _expect_no_nagging(dut, "every fourth sample is damaged", 36, _fourth(lambda bench: damaged(bench.sample(HIGH))))
    _expect_no_nagging(dut, "every fourth sample is dated ahead", 36, _fourth(_ahead))


def _expect_nothing_made_up(dut: Dut, before: int, rates: Sequence[float]) -> None:
    """At most 10 % more than was given before the gap, or by a device that has nothing to make up for."""
    bench = dut.bench()
    bench.run(12)
    for _ in range(dut.settings.ladder.safe + 1):
        bench.step(cgm=[])
    fresh = [bench.commanded(bench.step(HIGH)) for _ in rates]
    most = max(before, *fresh) * 1.1
    expect(
        max(rates) <= most, f"no dose to make up for the time without a sensor, at most {most:g}; {max(rates):g} came"
    )


def _ahead(bench: Bench) -> Frame:
    return bench.sample(HIGH, CgmSampleStep=(bench.k + 5) % 256)


def _fourth(bad: Callable[[Bench], Frame]) -> Callable[[Bench, int], Turn]:
    return lambda bench, k: bench.step(HIGH, cgm=[bad(bench)] if k % 4 == 0 else None)


def _expect_no_nagging(dut: Dut, what: str, steps: int, step: Callable[[Bench, int], Turn]) -> None:
    """Hours of the same trouble, confirmed each time: one new alarm per code and half an hour, notes left out."""
    apart = dut.settings.ladder.alarms_apart * 60 // STEP_SECONDS
    bench = dosing(dut)
    waiting: set[int] = set()
    raised: dict[int, int] = {}  # code -> step of its newest alarm
    for k in range(steps):
        turn = step(bench, k)
        for alarm in turn.all("CTRL_Alarm"):
            instance, code = alarm["CtrlAlarmInstance"], alarm["CtrlAlarmCode"]
            is_new = alarm["CtrlAlarmState"] == PENDING and instance not in waiting
            (waiting.add if alarm["CtrlAlarmState"] == PENDING else waiting.discard)(instance)
            if not is_new or alarm["CtrlAlarmPriority"] == 0:
                continue
            since = k - raised.get(code, -apart)
            expect(
                since >= apart, f"alarms of one code {apart} steps apart when {what}; code {code} came after {since}"
            )
            raised[code] = k
        bench.confirm(turn)


@check("FAL-04")
def a_silent_pump(dut: Dut) -> None:
    """No status and no totals, in Auto and in Suspended: PumpLost, IOB as they left it, and back only with both."""
    silent = steps_beyond(dut.settings.ladder.pump_silent)
    heard = _with_insulin_on_board(dut)
    reference = [heard.step().status["InsulinOnBoard"] for _ in range(12)]
    lost = _with_insulin_on_board(dut)
    for k in range(1, 13):
        turn = lost.step(status=False, totals=False)
        if k < silent:
            expect(not turn.pending("PumpLost"), f"no PumpLost before {silent} steps of silence; it came after {k}")
        else:
            expect_state(turn, State.DELIVERY_UNCERTAIN, f"{k} steps after the pump's last frame")
            expect(k > silent or turn.pending("PumpLost"), f"the alarm PumpLost after {k} steps; it did not come")
        # what it may count besides is at most the insulin of the schedule, which it cannot see delivered either way
        open_, iob = round(lost.basal * k / 12 / 10) + 5, turn.iob
        expect(
            abs(iob - reference[k - 1]) <= open_,
            f"IOB of the last totals, {reference[k - 1]} within {open_}, {k} steps after them; {iob} came",
        )
    for there in ("status", "totals"):
        for k in range(silent + 1):
            turn = lost.step(status=there == "status", totals=there == "totals")
            if there == "status" or k == silent:  # a status of a step or two ago still counts
                expect_state(turn, State.DELIVERY_UNCERTAIN, f"with the {there} alone")
    turn = lost.run(4)
    expect(turn.state != State.DELIVERY_UNCERTAIN, "an end of DeliveryUncertain with status and totals; it stayed")
    lost.request(1, SUSPEND)
    told = [lost.step(status=False, totals=False).pending("PumpLost") for _ in range(silent + 1)]
    expect(any(told), f"the alarm PumpLost after {silent} steps of silence in Suspended, too; it did not come")
    if "boluses" not in dut.offers:
        return
    loop = dut.loop(meal_mode(dut), meals=[(24, 60.0)], steps=32 + RETURN)
    lose(loop, ["PUMP_Ack", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState"], 20, 32)
    loop.play()
    dosed = [step for step in bolus_steps(loop, PROGRAM, COMMIT) if step < 32]
    expect(not dosed, f"no bolus in steps 20 to 31 without the pump's frames; one came in step {dosed[:1]}")
    state = loop.states()[-1]
    expect(state == State.AUTO, f"Auto {RETURN} steps after the pump's frames came back; CtrlState {state} came")


def _with_insulin_on_board(dut: Dut) -> Bench:
    """A device that has seen 3 U delivered above the schedule, in the step before."""
    bench = dut.bench()
    bench.run(6)
    bench.total += 3000 * 12
    bench.step()
    return bench


@check("FAL-05")
def the_user_suspends(dut: Dut) -> None:
    """Suspending stops both drugs and a bolus under way in that step, and nothing but resuming ends it."""
    mode = MODES["s2"] if "s2" in dut.offers else NMA
    bench = dosing(dut, mode=mode)
    bench.request(1, SUSPEND, mode)
    for k in range(18):
        if k == 6:
            bench.request(2, 0, mode)
        turn = bench.step(HIGH)
        rate, drug = bench.commanded(turn), turn.pramlintide
        expect_state(turn, State.SUSPENDED, f"{k} steps after the user suspended")
        expect(rate == drug == 0, f"neither drug {k} steps after the user suspended; {rate:g} and {drug} came")
    bench.request(3, RESUME, mode)
    turn = bench.step(HIGH)
    expect(turn.state != State.SUSPENDED, "an end of Suspended in the step in which the user resumes; it stayed")
    if "boluses" in dut.offers:
        _suspend_within_a_bolus(dut, meal_mode(dut))


def _suspend_within_a_bolus(dut: Dut, mode: str) -> None:
    """A slow motor has just begun a meal's bolus."""
    meal = 20
    loop = dut.loop(mode, meals=[(meal, 60.0)], steps=meal + 6)
    loop.plant.pump.insulin.words[mechanism.SLOWED] = mechanism.STROKES_PER_SUBSTEP - 1
    counters = codec.Transmitter()
    counters.counters["MODE_Cmd"] = 1  # the plant has sent the first one

    def wire(name: str, values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name != "SYNC_Step" or values["SyncPhase"] != Phase.STEP or values["StepIndex"] != meal + 1:
            return None
        return [counters.frame("MODE_Cmd", ModeRequest=MODES[mode], ModeCmdSeq=1, SuspendRequest=SUSPEND), frame]

    loop.to_device = wire
    loop.play()
    begun, ended = bolus_steps(loop, COMMIT), bolus_steps(loop, CANCEL)
    expect(meal in begun, f"a bolus for the meal of step {meal}, to be cancelled; Commits came in steps {begun}")
    expect(meal + 1 in ended, f"Cancel in step {meal + 1}, in which the user suspends; it came in steps {ended}")
    after = [step for step in bolus_steps(loop, PROGRAM, COMMIT) if step > meal]
    expect(not after, f"no bolus after the user suspended in step {meal + 1}; one came in step {after[:1]}")


TOUR: Final = (
    ("", 4), ("sensor", 5), ("", 5), ("sensor", 9), ("", 6), ("pump", 4), ("", 5), ("user", 2), ("", 3),
    ("sensor", 5), ("sensor user", 1), ("sensor", 1), ("sensor user", 3), ("sensor", 1), ("sensor pump", 4),
    ("sensor", 4), ("", 6), ("pump", 4), ("pump user", 2), ("pump", 2), ("sensor pump", 2), ("sensor", 4), ("", 6),
)  # fmt: skip
"""What is missing, and for how many steps: all states that a wire can bring about, from each other."""


@check("FAL-06")
def every_change_is_told(dut: Dut) -> None:
    """A tour through the states with a user who confirms every alarm: each change comes with a frame that says why."""
    bench = dut.bench()
    number, suspended, before = 0, False, State.INIT
    for missing, steps in TOUR:
        if ("user" in missing) != suspended:
            suspended, number = not suspended, number + 1
            bench.request(number, SUSPEND if suspended else RESUME)
        for _ in range(steps):
            there = "pump" not in missing
            turn = bench.step(cgm=[] if "sensor" in missing else None, status=there, totals=there)
            causes = CAUSES[before] | CAUSES[turn.state]
            expect(
                turn.state == before or any(turn.alarms(cause) for cause in causes),
                f"{' or '.join(sorted(causes))} with the change from {before.name} to {turn.state_name} "
                f"in step {bench.k - 1}; no such frame came",
            )
            before = turn.state
            bench.confirm(turn)


@check("FAL-07", needs=["uds"])
def a_fault_of_its_own(dut: Dut) -> None:
    """Overruns in three steps in a row, by the UDS routine for tests: Fault, no command, the pump on its schedule."""
    first, expiry = 20, dut.settings.commands.rate_expiry
    loop = dut.loop("nma", steps=first + 3 + expiry + 4)

    def wire(name: str, values: Values, _frame: Frame) -> None:
        if name == "SYNC_Step" and values["SyncPhase"] == Phase.STEP and first <= values["StepIndex"] < first + 3:
            overload(loop)

    loop.to_device = wire
    loop.play()
    states = {step: values["CtrlState"] for step, values in loop.steps_of("CTRL_Status")}
    fault = next((step for step, state in states.items() if state == State.FAULT), None)
    expect(
        fault is not None and fault <= first + 3, f"Fault after overruns in steps {first} to {first + 2}; {fault} came"
    )
    assert fault is not None
    left = [step for step, state in states.items() if step > fault and state != State.FAULT]
    expect(not left, f"Fault until a restart; it was left in step {left[:1]}")
    commands = [step for name in ("PUMP_BasalCmd", "PUMP_BolusCmd") for step, _ in loop.steps_of(name) if step >= fault]
    expect(not commands, f"no command from step {fault} on, in Fault; one came in step {commands[:1]}")
    expect(
        any(step == fault for step, _ in _alarms(loop, "Watchdog")),
        f"the alarm Watchdog in step {fault}; it did not come",
    )
    expect(
        loop.all("PUMP_Status")[-1]["TbrActive"] == 0, f"the pump on its schedule {expiry} steps after the last command"
    )
