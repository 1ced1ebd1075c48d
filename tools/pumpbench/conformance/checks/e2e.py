"""E2E and sequence (E2E): frames that are damaged, lost, foreign or missing, and those that the device itself sends."""

import random
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from typing import Final

from can_bus import codec
from can_bus.codec import COUNTER_MODULUS, Check, Receiver
from can_bus.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, MAX_DATA, Frame
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY, Node, Phase
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import carbs_mode
from pumpbench.conformance.driver import (
    GLUCOSE,
    HEARD_BY_CTRL,
    NMA,
    SENT_BY_CTRL,
    SUSPEND,
    Bench,
    State,
    Turn,
    alarm_code,
    expect,
)
from pumpbench.conformance.loop import Values
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import difference, expect_unused, whole_batch
from pumpbench.signals import frame_text

PROTECTED: Final = tuple(each.name for each in HEARD_BY_CTRL if codec.message(each.name).data_ids is not None)

CYCLIC: Final = frozenset(each.name for each in HEARD_BY_CTRL if each.send_type in ("Cyclic", "CyclicAndOnChange"))

WATCHED: Final = tuple(each.name for each in HEARD_BY_CTRL if "MsgTimeoutTime" in each.dbc.attributes)
"""What CTRL has to miss when it does not come."""

EVENTS_PER_STEP: Final = 16
"""Bad frames in a step, of messages that have no window of checks (E2E-03)."""


def skip_counter(bench: Bench, name: str, frames: int) -> None:
    """As if so many frames of a message had been lost, or repeated if negative."""
    counters = bench.transmitter.counters
    counters[name] = (counters[name] + frames) % COUNTER_MODULUS


# ---- bad frames


def _tempting(bench: Bench) -> dict[str, Frame]:
    """The next frame of every message: one that would change something, if its receiver let it pass."""
    k = bench.k
    fields: dict[str, dict[str, int]] = {
        "SYNC_Step": {"SyncPhase": Phase.STEP, "StepIndex": k + 7, "SimTime": (k + 7) * STEP_SECONDS},
        "PLANT_Info": {"PlantProtocolMajor": 62, "PlantProtocolMinor": 0},
        "PUMP_Alarm": {"PumpAlarmState": 1, "PumpAlarmPriority": 3, "PumpAlarmCode": 5, "PumpAlarmInstance": 1},
        "CGM_Reading": {"CgmState": 1, "GlucoseConc": 600, "CgmSampleSeq": bench.number, "CgmSampleStep": k % 256},
        "CGM_Status": {"CgmFaultBits": 1, "CgmSessionId": 9, "CgmNoise": 200},
        "MEAL_Announce": {"MealKind": 1, "MealId": 7, "CarbsEst": 120, "MealOffset": 0},
        "UI_AlarmAck": {"AlarmAckNode": 1, "AlarmAckAction": 1, "AlarmAckInstance": 0},
        "PUMP_Ack": {"AckFor": 1, "AckResult": 3, "AckId": k, "AckEchoRaw": 1, "AckLimitRaw": 1},
        "PUMP_Status": {"PumpState": 6, "InsulinReservoir": 0, "PramReservoir": 0, "PumpBattery": 0},
        "PUMP_Delivered": {"PumpBootCount": 0, "InsulinTotal": bench.total // 12 + 9000, "PramTotal": 0},
        "PUMP_BolusState": {"BolusStateHormone": 1, "BolusPhase": 2, "BolusStateId": 0, "BolusDeliveredRaw": 500},
        "MODE_Cmd": {"ModeRequest": 0, "ModeCmdSeq": 1, "SuspendRequest": SUSPEND},
        "CFG_Param": {"CfgIndex": 0, "CfgBasal": 30000},
        "HB_PUMP": {"NmtPump": 0, "TogglePump": 0, "ResetCausePump": 1, "BootPump": 1},
        "HB_CGM": {"NmtCgm": 0, "ToggleCgm": 0, "ResetCauseCgm": 1, "BootCgm": 1},
    }
    return {name: _next_frame(bench, name, values) for name, values in fields.items()}


def _next_frame(bench: Bench, name: str, values: dict[str, int]) -> Frame:
    """A frame with the counter that comes next, which stays the next one."""
    message = codec.message(name)
    return Frame(message.can_id, codec.protect(message, message.pack(values), bench.transmitter.counters[name]))


Spoil = Callable[[Frame], Frame]


def _expect_no_effect(dut: Dut, bad: Sequence[tuple[str, Spoil]], what: str) -> None:
    """A run with bad frames ahead of the good ones, and one without: the same but for the error counts.

    The filter of a CAN controller may keep remote frames and 29-bit identifiers away, so that nobody can count them.
    """
    cyclic = {name: [spoil for victim, spoil in bad if victim == name] for name in CYCLIC}
    events = iter([each for each in bad if each[0] not in CYCLIC])
    apart = dut.settings.e2e.window + 1  # bad frames beside good ones must not add up to a message that is not valid
    strategy = carbs_mode(dut)
    mode = MODES[strategy or "nma"]
    calm = dut.bench(mode=mode)
    expected = [_instant(calm, k) for k in range(_steps(bad, apart))]
    spoiled, before = dut.bench(mode=mode), 0
    for k, told in enumerate(expected):
        tempting = _tempting(spoiled)
        frames = [spoil(tempting[name]) for name, spoil in islice(events, EVENTS_PER_STEP)] if k >= apart else []
        if k >= apart and k % apart == 0:
            frames += [spoils.pop()(tempting[name]) for name, spoils in cyclic.items() if spoils]
        spoiled.give(*frames)
        turn = _instant(spoiled, k)
        other = difference(_deeds(told), _deeds(turn))
        expect(not other, f"{what} to change nothing in step {k}; {other}")
        counted = turn.diag["E2eErrorCount"] - before
        filtered = sum(frame.is_extended or frame.is_remote for frame in frames)
        expect(
            len(frames) - filtered <= counted <= len(frames),
            f"E2eErrorCount to count {what} once each, {len(frames)} in step {k}; {counted} came",
        )
        before = turn.diag["E2eErrorCount"]


def _steps(bad: Sequence[tuple[str, Spoil]], apart: int) -> int:
    """Steps in which all of them find room."""
    victims = Counter(name for name, _ in bad)
    most = max(victims[name] for name in CYCLIC)
    events = sum(number for name, number in victims.items() if name not in CYCLIC)
    return apart + max(most * apart, -(-events // EVENTS_PER_STEP))


def _instant(bench: Bench, k: int) -> Turn:
    return bench.step(GLUCOSE + 10 * (k % 7), also=whole_batch(bench))


def _deeds(turn: Turn) -> list[tuple[str, dict[str, int]]]:
    """What the device says, but for the error counts and the alarm that tells of them."""
    numbers = {
        "CTRL_Alarm": ("CtrlAlarmInstance",),
        "SYNC_Done": ("TxCount", "ExecTime"),
        "CTRL_Diag": ("E2eErrorCount",),
    }
    fault = alarm_code("E2EFault")
    return [
        (name, {key: value for key, value in values.items() if key not in numbers.get(name, ())})
        for name, values in turn.said
        if values.get("CtrlAlarmCode") != fault
    ]


# ---- the checks


@check("E2E-01")
def wrong_checksums(dut: Dut) -> None:
    """One to three wrong bits, ahead of the good frame: nothing changes but E2eErrorCount, by one for each.

    Of messages that come in every step some single bits, of the others all; in the long form all of both.
    """
    rng = random.Random(1)
    bad: list[tuple[str, Spoil]] = []
    for name in PROTECTED:
        bits = 8 * codec.message(name).length
        single = range(bits) if dut.long or name not in CYCLIC else rng.sample(range(bits), 10)
        several = [rng.sample(range(bits), rng.choice((2, 3))) for _ in range(200 if dut.long else 6)]
        bad += [(name, _flipping(places)) for places in ([bit] for bit in single)]
        bad += [(name, _flipping(places)) for places in several]
    _expect_no_effect(dut, bad, "frames with one to three wrong bits")


def _flipping(places: Sequence[int]) -> Spoil:
    word = sum(1 << place for place in places)
    return lambda frame: frame._replace(
        data=(int.from_bytes(frame.data, "little") ^ word).to_bytes(len(frame.data), "little")
    )


@check("E2E-02")
def counter_steps(dut: Dut) -> None:
    """A sample, and a command of the user, with every step of the counter: used up to the limit, else not; counted."""
    limit = dut.settings.e2e.max_lost
    bench = dut.bench()
    bench.run(6)
    for step in range(COUNTER_MODULUS):
        before = bench.run(dut.settings.e2e.window + 1)
        skip_counter(bench, "CGM_Reading", step - 1)
        number = bench.number
        turn = bench.step()
        if 1 <= step <= limit + 1:
            expect(turn.used == number, f"a sample {step} ahead by its counter is used; LastCgmSeq {turn.used} came")
        else:
            expect_unused(bench, turn, before.used, f"a sample {step} ahead by its counter")
        lost = turn.diag["LostFrameCount"] - before.diag["LostFrameCount"]
        missing = max(step - 1, 0)
        expect(
            lost == missing, f"LostFrameCount to grow by {missing} with a counter that goes up by {step}; {lost} came"
        )
    for number, step in enumerate((limit + 1, limit + 2, 0, 1), start=1):
        bench = dut.bench()
        bench.run(3)
        skip_counter(bench, "MODE_Cmd", step - 1)
        bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=number, SuspendRequest=SUSPEND)
        suspended = bench.step().state == State.SUSPENDED
        obeyed = 1 <= step <= limit + 1
        what = "obeyed" if obeyed else "not obeyed"
        expect(suspended == obeyed, f"a MODE_Cmd {step} ahead by its counter is {what}; Suspended was {suspended}")


@check("E2E-03")
def windows(dut: Dut) -> None:
    """Errors in place of good frames, and lost ones: what comes next is used only when the window of checks allows it.

    Samples by LastCgmSeq, totals by the insulin on board that they add.
    """
    window, errors = dut.settings.e2e.window, dut.settings.e2e.errors
    bad = [DAMAGED] * errors
    still_seen = window - errors  # good frames in a row that find too many errors in the window before them
    for message in (_expect_samples_used, _expect_totals_used):
        message(dut, bad[1:], 0, 1, f"after {errors - 1} wrong ones in a row")
        message(dut, bad, still_seen, still_seen + 1, f"after {errors} wrong ones in a row")
        # the first one's counter is too far ahead (E2E-02); whether the lost ones were checks without data is open
        message(dut, [LOST] * window, 1, 3, f"after {window} lost ones")


DAMAGED: Final = "damaged"
LOST: Final = "lost"


def _expect_samples_used(dut: Dut, script: Sequence[str], unused: int, latest: int, when: str) -> None:
    """After a disturbance so many good samples are not used; the `latest` one is, counted from 1."""
    bench = dut.bench()
    last = bench.run(12).used
    for kind in script:
        sample = bench.sample()
        bench.step(cgm=[_flipping([30])(sample)] if kind == DAMAGED else [])
    for good in range(1, latest + 1):
        number = bench.number
        turn = bench.step()
        if good <= unused:
            expect_unused(bench, turn, last, f"good sample {good} {when}")
        elif good == latest:
            expect(turn.used == number, f"good sample {good} {when} is used; LastCgmSeq {turn.used} came")


def _expect_totals_used(dut: Dut, script: Sequence[str], unused: int, latest: int, when: str) -> None:
    """The same with totals, that show 3 U more once they are good again."""
    bench = dut.bench()
    before = bench.run(12).iob
    for kind in script:
        totals = bench.delivered()
        bench.step(totals=_flipping([30])(totals) if kind == DAMAGED else False)
    bench.total += 3000 * 12
    for good in range(1, latest + 1):
        more = bench.step().iob - before
        what = f"PUMP_Delivered with 3 U more, good frame {good} {when},"
        if good <= unused:
            expect(more < 200, f"{what} is not used; IOB rose by {more}")
        elif good == latest:
            expect(more > 200, f"{what} is used; IOB rose by {more}")


@check("E2E-04")
def sixteen_lost(dut: Dut) -> None:
    """Sixteen samples are lost, so that the counter fits; and a frame comes again when its counter comes round."""
    bench = dut.bench()
    before = bench.run(12).diag["LostFrameCount"]
    for _ in range(COUNTER_MODULUS):
        bench.step(drop=True)
    expect(bool(bench.raised("CgmLost")), f"the alarm CgmLost while {COUNTER_MODULUS} samples are lost")
    lost = bench.run(dut.settings.e2e.window).diag["LostFrameCount"] - before
    expect(lost == COUNTER_MODULUS, f"LostFrameCount to grow by {COUNTER_MODULUS} lost samples; {lost} came")
    bench = dut.bench()
    bench.run(4)
    old = bench.sample()
    bench.step(cgm=[old])
    last = bench.run(COUNTER_MODULUS - 1).used
    turn = bench.step(cgm=[old])
    expect_unused(bench, turn, last, f"a sample that is {COUNTER_MODULUS} frames old")


@check("E2E-05")
def masquerade(dut: Dut) -> None:
    """Frames of one message under the id of another change nothing; somebody with an id of CTRL is told of.

    If the device has boluses, none is begun in the step in which that happens.
    """
    bad = [
        (name, _posing_as(name, other))
        for name in PROTECTED
        for other, message in codec.messages().items()
        if message.data_ids is not None and other != name
    ]
    if not dut.long:
        few = random.Random(5)
        bad = [each for each in bad if each[0] not in CYCLIC or few.random() < 0.5]
    _expect_no_effect(dut, bad, "frames of another message")
    for name in SENT_BY_CTRL:
        bench = dut.bench()
        bench.run(3)
        turn = bench.step(also=[Frame(codec.message(name).can_id, bytes(codec.message(name).length))])
        expect(bool(turn.alarms("E2EFault")), f"the alarm E2EFault for a {name} that CTRL did not send; none came")
    strategy = carbs_mode(dut)
    if strategy is not None:
        expect(bool(_boluses_begun(dut, strategy)), "a bolus for a meal of 60 g")
        begun = _boluses_begun(dut, strategy, [Frame(codec.message("PUMP_BolusCmd").can_id, bytes(8))])
        expect(not begun, f"no bolus in the step in which somebody else sends PUMP_BolusCmd; {begun[:1]} came")


def _posing_as(name: str, other: str) -> Spoil:
    """A frame of `other` with the id of `name`."""
    message = codec.message(other)
    data = codec.protect(message, message.pack({}), 3)
    return lambda _frame: Frame(codec.message(name).can_id, data)


def _boluses_begun(dut: Dut, strategy: str, beside: Sequence[Frame] = ()) -> list[Values]:
    """The bolus commands for a meal of 60 g; `beside` comes with its announcement."""
    loop = dut.loop(strategy, [(10, 60.0)], 11)
    loop.to_device = lambda name, _values, frame: [*beside, frame] if name == "MEAL_Announce" else None
    return loop.play().all("PUMP_BolusCmd")


@check("E2E-06")
def malformed_frames(dut: Dut) -> None:
    """Every other length, remote frames and 29-bit ids of all messages that CTRL hears: counted, and no effect."""
    bad: list[tuple[str, Spoil]] = []
    for each in HEARD_BY_CTRL:
        bad += [(each.name, _with_length(size)) for size in range(MAX_DATA + 1) if size != each.length]
        bad += [(each.name, _with_flag(flag)) for flag in (CAN_RTR_FLAG, CAN_EFF_FLAG)]
    _expect_no_effect(dut, bad, "frames of another length or kind")


def _with_length(size: int) -> Spoil:
    return lambda frame: frame._replace(data=frame.data.ljust(size, b"\0")[:size])


def _with_flag(flag: int) -> Spoil:
    return lambda frame: frame._replace(can_id=frame.can_id | flag)


@check("E2E-07")
def silence(dut: Dut) -> None:
    """Each message that has a time-out is missing alone: Auto up to the time-out, and one step later no more."""
    patience = dut.settings.e2e.timeout // STEP_SECONDS
    for name in WATCHED:
        bench = dut.bench()
        for _ in range(6):
            turn = bench.step(also=whole_batch(bench))
        expect(turn.state == State.AUTO, f"Auto while everything comes; {turn.state_name} came")
        for missing in range(1, patience + 3):
            others = [frame for frame in whole_batch(bench) if frame.can_id != codec.message(name).can_id]
            turn = bench.step(
                drop=name == "CGM_Reading",
                status=name != "PUMP_Status",
                totals=name != "PUMP_Delivered",
                also=others,
            )
            if missing <= patience:
                expect(turn.state == State.AUTO, f"Auto {missing} steps after the last {name}; {turn.state_name} came")
        expect(turn.state != State.AUTO, f"another state than Auto {missing} steps after the last {name}")


@check("E2E-08")
def what_ctrl_sends(dut: Dut) -> None:
    """A day with a meal and a lost sensor, in the long form a fortnight: each frame of CTRL is one that it may send.

    With its id, its length, its checksum, and the counter that comes next.
    """
    strategy = next((name for name in ("s3", "ma", "sma") if name in dut.offers), "nma")
    days = range(14 if dut.long else 1)
    steps = len(days) * STEPS_PER_DAY if dut.long else 80
    loop = dut.loop(strategy, [(day * STEPS_PER_DAY + 10, 60.0) for day in days], steps)
    loop.device = _Listened(loop.device)
    loop.to_device = lambda name, _values, _frame: (
        [] if name == "CGM_Reading" and 30 <= loop.plant.step % STEPS_PER_DAY < 40 else None
    )
    loop.play()


class _Listened:
    """A device whose frames are all held to the DBC."""

    finished = False

    def __init__(self, device: Node) -> None:
        self._device = device
        self._receiver = Receiver(SENT_BY_CTRL)

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """What the device says.

        Raises:
            Violation: a frame is none that it may send.
        """
        said = self._device.receive(frame)
        if frame.can_id == codec.message("CFG_Param").can_id:
            self._receiver.reset()  # the counters of the roll call are not those of the run
        for each in said:
            judged = self._receiver.receive(each).check
            expect(judged == Check.OK, f"frames of CTRL alone, whole and in order; {frame_text(each)}: {judged.name}")
        return said
