"""Alarms (ALM): what the user is told, how urgently, when and for how long, and what follows from it."""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

import dbc
from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from plant_server import mechanism
from plant_server.chamber import Chamber, Occlusion
from plant_server.pump import Pump, PumpSettings
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import COMMIT, COMMIT_ACKS, PROGRAM, bolus_steps, meal_mode
from pumpbench.conformance.driver import GLUCOSE, HIGH, NMA, PENDING, SUSPEND, Bench, State, Turn, alarm_code, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, NotOffered, check
from pumpbench.conformance.situations import damaged, dosing, expect_state, overload

INACTIVE: Final = codec.choice("CTRL_Alarm", "CtrlAlarmState", "Inactive")
CONFIRMED: Final = codec.choice("CTRL_Alarm", "CtrlAlarmState", "Confirmed")
SNOOZED: Final = codec.choice("CTRL_Alarm", "CtrlAlarmState", "Snoozed")
ANSWERS: Final = {
    CONFIRMED: codec.choice("UI_AlarmAck", "AlarmAckAction", "Confirm"),
    SNOOZED: codec.choice("UI_AlarmAck", "AlarmAckAction", "Snooze"),
}
PRIORITIES: Final = ("Info", "Low", "Medium", "High")

SENSOR_FAULT: Final = codec.choice("CGM_Reading", "CgmState", "SensorFault")

WITHIN: Final = 1
"""Steps after the causing frame in which an alarm has to come at the latest (ALM-03)."""

COMMOTION: Final = ("UrgentLow", "PumpLost", "CgmImplausible", "E2EFault", "ClockJump")
"""What `commotion` gives cause for."""


# ---- causes


def commotion(bench: Bench) -> Turn:
    """A silent pump, and then in its third step all the causes of `COMMOTION` at once."""
    for _ in range(2):
        bench.instant(bench.sample())
    ahead = bench.sample(GLUCOSE, CgmSampleStep=(bench.k + 5) % 256)
    return bench.instant(ahead, bench.sample(500), damaged(bench.delivered()), off=3600)


class Listener:
    """Somebody who keeps the alarms of a device by instance, and holds every turn to the rules of ALM-01."""

    def __init__(self) -> None:
        self.state: dict[int, int] = {}  # instance -> its newest CtrlAlarmState
        self._code: dict[int, int] = {}

    def hear(self, turn: Turn, when: str) -> Turn:
        """Take the alarms of a turn; returns it."""
        alarms = turn.all("CTRL_Alarm")
        told = [alarm["CtrlAlarmInstance"] for alarm in alarms]
        expect(len(set(told)) == len(told), f"one frame per alarm in a turn {when}; instances {told} came")
        silent = [number for number, state in self.state.items() if state == PENDING and number not in told]
        expect(
            not silent, f"a pending alarm in every step until it is confirmed {when}; instances {silent} are missing"
        )
        urgency = [alarm["CtrlAlarmPriority"] for alarm in alarms if alarm["CtrlAlarmState"] == PENDING]
        expect(urgency == sorted(urgency, reverse=True), f"the highest priority first {when}; {urgency} came")
        for alarm in alarms:
            number, code, state = (alarm[f"CtrlAlarm{field}"] for field in ("Instance", "Code", "State"))
            first = self._code.setdefault(number, code)
            expect(first == code, f"an instance for one alarm {when}; {number} names codes {first} and {code}")
            over = self.state.get(number) == INACTIVE and state != INACTIVE
            expect(not over, f"another instance for an alarm that comes again {when}; {number} was over")
            self.state[number] = state
        return turn


def answer(bench: Bench, alarm: Values, state: int) -> None:
    """The user confirms or snoozes an alarm: it is to become that state."""
    number = alarm["CtrlAlarmInstance"]
    bench.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=ANSWERS[state], AlarmAckInstance=number)


# ---- the checks


@check("ALM-01")
def how_alarms_are_told(dut: Dut) -> None:
    """Five causes in one step, twice: all alarms are told, the highest first, in every step until the user answers."""
    bench, listener = dut.bench(), Listener()
    for attempt in range(2):
        bench.run(6)
        turns = [listener.hear(commotion(bench), "with five causes at once")]
        turns += [
            listener.hear(bench.instant(bench.sample(500)), "with five causes at once")
            for _ in range(dut.settings.alarms.out_within - 1)
        ]
        told = {alarm["CtrlAlarmCode"] for turn in turns for alarm in turn.all("CTRL_Alarm")}
        for code in COMMOTION:
            expect(alarm_code(code) in told, f"{code} within {len(turns)} steps; codes {sorted(told)} came")
        if attempt == 0:  # the second time nobody answers
            _answer_two(bench, listener, turns[-1])
        for _ in range(18):
            listener.hear(bench.step(), "after its cause has ended")
        still = [number for number, state in listener.state.items() if state == PENDING]
        expect(not still, f"every alarm over 90 min after its cause has ended; instances {still} are pending")


def _answer_two(bench: Bench, listener: Listener, turn: Turn) -> None:
    """Confirm UrgentLow and snooze PumpLost, whose causes stay for a while: both are told once and then keep still."""
    asked = {"UrgentLow": CONFIRMED, "PumpLost": SNOOZED}
    for code, state in asked.items():
        answer(bench, turn.alarms(code)[0], state)
    for k in range(3):
        turn = listener.hear(bench.instant(bench.sample(500)), "after the user has answered")
        for code, state in asked.items():
            states = [alarm["CtrlAlarmState"] for alarm in turn.alarms(code)]
            expect(
                k > 0 or states == [state], f"{code} told in state {state} when the user has answered; {states} came"
            )
            expect(PENDING not in states, f"{code} not pending {k} steps after the user has answered; it was")


@check("ALM-02")
def how_urgent_alarms_are(dut: Dut) -> None:
    """As many codes as can be provoked from outside, each with the priority of the table."""
    alarms = dut.settings.alarms
    wanted = dict.fromkeys(alarms.high, (3,)) | dict.fromkeys(alarms.medium, (2,))
    provoked = {*COMMOTION, "CgmLost", "StateChange"}
    found: list[Values] = []
    bench = dut.bench()
    bench.run(6)
    found += commotion(bench).all("CTRL_Alarm")
    found += bench.step().all("CTRL_Alarm")
    found += _of_a_tour(dut)
    if "boluses" in dut.offers:
        provoked.add("DeliveryUncertain")
        found += _of_missing_answers(dut)
    if "uds" in dut.offers:
        watchdog = _of_overruns(dut)
        provoked |= {"Watchdog"} if watchdog else set()
        found += watchdog
    for alarm in found:
        code, priority = _name(alarm["CtrlAlarmCode"]), alarm["CtrlAlarmPriority"]
        allowed = wanted.get(code, (0, 1))
        names = " or ".join(PRIORITIES[each] for each in allowed)
        expect(priority in allowed, f"{code} with the priority {names}; {PRIORITIES[priority]} came")
    missing = provoked - {_name(alarm["CtrlAlarmCode"]) for alarm in found}
    expect(not missing, f"the alarms {', '.join(sorted(provoked))}; {', '.join(sorted(missing))} did not come")


@functools.cache
def _names() -> dict[int, str]:
    """CtrlAlarmCode -> its name."""
    choices = dbc.load().get_message_by_name("CTRL_Alarm").get_signal_by_name("CtrlAlarmCode").choices or {}
    return {int(code): str(name) for code, name in choices.items()}


def _name(code: int) -> str:
    return _names().get(code, str(code))


def _of_a_tour(dut: Dut) -> list[Values]:
    """A lost sensor, and a user who suspends."""
    bench = dut.bench()
    bench.run(4)
    turns = [bench.step(cgm=[]) for _ in range(dut.settings.ladder.safe)]
    bench.request(1, SUSPEND)
    turns.append(bench.step())
    return [alarm for turn in turns for alarm in turn.all("CTRL_Alarm")]


def _of_missing_answers(dut: Dut) -> list[Values]:
    """A meal's bolus whose Commit nobody answers."""
    loop = dut.loop(meal_mode(dut), meals=[(12, 60.0)], steps=15)

    def wire(name: str, values: Values, _frame: Frame) -> Sequence[Frame] | None:
        return [] if name == "PUMP_Ack" and values["AckFor"] in COMMIT_ACKS else None

    loop.to_device = wire
    return loop.play().all("CTRL_Alarm")


def _of_overruns(dut: Dut) -> list[Values]:
    loop = dut.loop("nma", steps=16)

    def wire(name: str, values: Values, _frame: Frame) -> None:
        if name == "SYNC_Step" and values["SyncPhase"] == Phase.STEP and 10 <= values["StepIndex"] < 13:
            overload(loop)

    loop.to_device = wire
    try:
        return loop.play().all("CTRL_Alarm")
    except NotOffered:
        return []


@check("ALM-03")
def how_soon_alarms_come(dut: Dut) -> None:
    """A low just below the limit is told at once in every state, other causes in that step or the next one."""
    for state in (State.INIT, State.AUTO, State.DEGRADED, State.SAFE_BASAL, State.SUSPENDED, State.DELIVERY_UNCERTAIN):
        bench = _in_state(dut, state)
        low = dut.settings.alarms.urgent_low * 10 - 1
        pump_there = state != State.DELIVERY_UNCERTAIN
        turn = bench.step(low, status=pump_there, totals=pump_there)
        expect(
            turn.pending("UrgentLow"), f"UrgentLow in the step of {low / 10:g} mg/dL in {state.name}; it did not come"
        )
    bench = dosing(dut)
    _expect_alarm(_two(bench, damaged(bench.sample(HIGH))), "E2EFault", "a frame with a wrong CRC")
    bench = dosing(dut)
    _expect_alarm(
        _two(bench, bench.sample(HIGH, CgmSampleStep=(bench.k + 5) % 256)), "CgmImplausible", "a sample of later"
    )
    bench = dosing(dut)
    turns = [bench.instant(bench.sample(HIGH), bench.status(), bench.delivered(), off=3600), bench.step(HIGH)]
    _expect_alarm(turns, "ClockJump", "a clock that is an hour ahead")


def _two(bench: Bench, reading: Frame) -> list[Turn]:
    return [bench.step(cgm=[reading]), bench.step(HIGH)]


def _expect_alarm(turns: Iterable[Turn], code: str, cause: str) -> None:
    expect(
        any(turn.pending(code) for turn in turns), f"the alarm {code} within {WITHIN} step of {cause}; it did not come"
    )


def _in_state(dut: Dut, state: State) -> Bench:
    """A device brought into this state by what arrives; samples that say SensorFault keep the E2E check content."""
    bench = dut.bench(flash={}) if state == State.INIT else dut.bench()  # without a calibration it stays there
    turn = bench.run(6)
    faulty = {State.DEGRADED: dut.settings.ladder.degraded, State.SAFE_BASAL: dut.settings.ladder.safe}
    if state in faulty:
        for _ in range(faulty[state]):
            turn = bench.step(cgm=[bench.sample(CgmState=SENSOR_FAULT, GlucoseConc=8191)])
    elif state == State.SUSPENDED:
        bench.request(1, SUSPEND)
        turn = bench.step()
    elif state == State.DELIVERY_UNCERTAIN:
        for _ in range(4):
            turn = bench.step(status=False, totals=False)
    expect_state(turn, state, "by what was sent")
    return bench


@check("ALM-04")
def alarms_come_again(dut: Dut) -> None:
    """The sensor stays lost for two hours, and the user confirms or snoozes: pending again in time; so is Suspended."""
    alarms = dut.settings.alarms
    for state in (CONFIRMED, SNOOZED):
        bench = dosing(dut)
        for _ in range(dut.settings.ladder.degraded):
            turn = bench.step(cgm=[])
        _expect_again(bench, turn, "CgmLost", state, alarms.again, cgm=[])
    bench = dosing(dut)
    bench.request(1, SUSPEND)
    _expect_again(bench, bench.step(), "StateChange", CONFIRMED, alarms.suspended_again)


def _expect_again(
    bench: Bench, turn: Turn, code: str, state: int, minutes: int, *, cgm: Sequence[Frame] | None = None
) -> None:
    """Answer an alarm whenever it is pending, for two hours: it is never away for longer than that, and a step more."""
    limit = minutes * 60 // STEP_SECONDS + 1
    away = 0
    for _ in range(24):
        pending = [alarm for alarm in turn.alarms(code) if alarm["CtrlAlarmState"] == PENDING]
        away = 0 if pending else away + 1
        expect(
            away <= limit, f"{code} pending again {minutes} min after an answer (state {state}); {away * 5} min passed"
        )
        for alarm in pending:
            answer(bench, alarm, state)
        turn = bench.step(cgm=cgm)


@check("ALM-05")
def an_occlusion(dut: Dut) -> None:
    """An hour of an occluded insulin line: no bolus, no pramlintide, and nothing to make up afterwards."""
    mode = MODES["s2"] if "s2" in dut.offers else NMA
    bench = dut.bench(mode=mode)
    bench.run(12)
    for _ in range(12):
        before = bench.total
        turn = bench.instant(bench.sample(), bench.status(InsulinOcclusion=Occlusion.OCCLUDED), bench.delivered())
        bench.total = before  # nothing arrives
        drug = turn.pramlintide
        expect(drug == 0, f"no pramlintide while the insulin line is occluded; {drug} came")
    missed = bench.basal / 5
    extra = sum(max(bench.commanded(bench.step()) - missed, 0.0) for _ in range(12)) / 12
    expect(
        extra <= missed / 4,
        "nothing made up after an hour of occlusion at a steady glucose: within an hour at most a quarter of the "
        f"{missed:g} that were missed; {extra:g} came",
    )
    if "boluses" not in dut.offers:
        return
    loop = dut.loop(meal_mode(dut), meals=[(16, 60.0)], steps=36)
    line = loop.plant.pump.insulin
    _at_steps(loop, {9: lambda: _block(line), 21: lambda: line.release(lost=True)})
    loop.play()
    begun = bolus_steps(loop, PROGRAM, COMMIT)
    expect(
        not begun,
        f"no bolus for a meal while the line is occluded, nor later for that meal; one came in step {begun[:1]}",
    )
    expect(loop.ledgers_close(), "a ledger that closes after an occlusion")


def _block(line: Chamber) -> None:
    """The line is blocked, and the pump has just noticed."""
    line.occlude()
    line.stopped = True


@check("ALM-06")
def when_the_pump_notices(dut: Dut) -> None:
    """The simulated pump alone with a blocked line at 0.1, 1 and 5 U/h: Occluded when so much was missed, to a step."""
    missed = dut.settings.alarms.occluded
    for milliunits in (100, 1000, 5000):
        pump = Pump(PumpSettings(basal_milliunits_per_h=milliunits, change_every_steps=0, battery_percent_per_day=0.0))
        pump.insulin.occlude()
        expected = missed / (milliunits / 1000) * 12  # steps
        step = 0
        while pump.insulin.occlusion != Occlusion.OCCLUDED and step < 2 * expected:
            pump.deliver(step)
            step += 1
        rule = f"Occluded at {missed:g} U missed, after {expected * 5:g} min at {milliunits / 1000:g} U/h"
        expect(expected <= step <= expected + 1, f"{rule}; {step * 5} min came")


@check("ALM-07")
def what_runs_out(dut: Dut) -> None:
    """Reservoirs and battery at their limits and empty: somebody tells, and no bolus is larger than what is left."""
    alarms = dut.settings.alarms
    loop = dut.loop("nma", steps=24)
    insulin, drug = loop.plant.pump.insulin, loop.plant.pump.pramlintide
    _at_steps(
        loop,
        {
            6: lambda: _leave(insulin, alarms.reservoir_low + 0.2),
            10: lambda: _leave(drug, alarms.pramlintide_low),
            13: lambda: setattr(loop.plant.pump, "battery", float(alarms.battery_low)),
            16: lambda: _leave(insulin, 0),
            18: lambda: _leave(drug, 0),
            20: lambda: setattr(loop.plant.pump, "battery", 0.0),
        },
    )
    loop.play()
    for code, field, limit in (
        ("ReservoirLow", "InsulinReservoir", alarms.reservoir_low * 10),
        ("ReservoirLow", "PramReservoir", alarms.pramlintide_low),
        ("BatteryLow", "PumpBattery", alarms.battery_low),
        ("ReservoirEmpty", "InsulinReservoir", 0),
        ("ReservoirEmpty", "PramReservoir", 0),
        ("BatteryEmpty", "PumpBattery", 0),
    ):
        since = next(step for step, values in loop.steps_of("PUMP_Status") if values[field] <= limit)
        raised = _raised(loop, code)
        in_time = [step for step in raised if since <= step <= since + WITHIN]
        expect(bool(in_time), f"{code} in step {since}, with {field} at {limit}; it came in steps {raised}")
    expect(loop.ledgers_close(), "a ledger that closes when reservoirs and battery are empty")
    if "boluses" in dut.offers:
        _expect_bolus_within_what_is_left(dut)


def _leave(chamber: Chamber, volume: float) -> None:
    chamber.words[mechanism.FLUID] = round(volume / chamber.settings.stroke_volume)


def _at_steps(loop: Loop, deeds: Mapping[int, Callable[[], None]]) -> None:
    """Do something to the plant just before these steps' tokens; the pump tells of it in the step after."""

    def wire(name: str, values: Values, _frame: Frame) -> None:
        if name == "SYNC_Step" and values["SyncPhase"] == Phase.STEP and values["StepIndex"] in deeds:
            deeds[values["StepIndex"]]()

    loop.to_device = wire


def _raised(loop: Loop, code: str) -> list[int]:
    """Steps in which an alarm of this code came up, of pump or device."""
    first: dict[tuple[str, int], int] = {}
    for node in ("Pump", "Ctrl"):
        for step, values in loop.steps_of(f"{node.upper()}_Alarm"):
            if values[f"{node}AlarmCode"] == alarm_code(code):
                first.setdefault((node, values[f"{node}AlarmInstance"]), step)
    return sorted(first.values())


def _expect_bolus_within_what_is_left(dut: Dut) -> None:
    """A meal of 60 g with 2 U in the reservoir."""
    loop = dut.loop(meal_mode(dut), meals=[(12, 60.0)], steps=16)
    _at_steps(loop, {10: lambda: _leave(loop.plant.pump.insulin, 2.0)})
    loop.play()
    left = {step: values["InsulinReservoir"] * 10 for step, values in loop.steps_of("PUMP_Status")}  # 0.01 U
    for step, values in loop.steps_of("PUMP_BolusCmd"):
        if values["BolusOp"] == COMMIT and "InsulinBolus" in values:
            dose = values["InsulinBolus"]
            expect(
                dose <= left[step], f"no bolus beyond the {left[step] / 100:g} U that are left; {dose / 100:g} U came"
            )
    expect(loop.ledgers_close(), "a ledger that closes when the reservoir runs out in a bolus")
