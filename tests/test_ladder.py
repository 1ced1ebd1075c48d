"""The fallback ladder, scripted: what the CGM does, and what the firmware then does, step by step."""

import itertools
import random
from collections import deque
from collections.abc import Callable, Iterator

import pytest
from bench import GLUCOSE, NMA, S2, Bench, Turn, calibration
from pumpbench.calibration import Tuning

from can_bus.frame import Frame
from firmware_sim.alarms import Code
from firmware_sim.alarms import State as AlarmState
from firmware_sim.control import layout
from firmware_sim.control.layout import LIMITER_STALE_CGM
from firmware_sim.ladder import Ladder, State
from firmware_sim.pump import Op

HIGH = 2500
"""0.1 mg/dL, at which the law asks for far more than the schedule."""

PER_HALF_HOUR = 6
"""Steps."""

AUTO, DEGRADED, SAFE_BASAL = State.AUTO, State.DEGRADED, State.SAFE_BASAL


def high(mode: int = S2) -> Bench:
    """A firmware that has been correcting high glucose for two hours."""
    bench = Bench(mode=mode)
    turn = bench.run(24, HIGH)
    assert turn.state == AUTO
    assert turn.rate > bench.basal // 5 + 100
    return bench


def refused_after(lost: int) -> bool:
    """Whether the counter of the first frame after a loss has jumped so far that E2E refuses it (by 4 or more)."""
    return lost % 16 >= 3  # 15: the counter is the old one again


def at_age(age: int) -> State:
    return AUTO if age <= 3 else DEGRADED if age <= 6 else SAFE_BASAL


def way_up(state: State) -> Iterator[State]:
    """States at the first, second, third .. usable sample: the second one in a row goes up, one rung a step."""
    yield state
    while True:
        state = State(max(state - 1, AUTO))
        yield state


def check_dose(bench: Bench, turn: Turn) -> None:
    """What each state may command: above the schedule only in Auto, exactly the schedule in SafeBasal."""
    command = turn.command
    if turn.state == SAFE_BASAL:
        assert command["BasalOp"] == Op.RESUME_SCHEDULE
        assert command["InsulinRate"] == command["PramlintideRate"] == 8191  # says nothing
    else:
        assert command["BasalOp"] == Op.SET_RATE
        if turn.state != AUTO:
            assert command["InsulinRate"] * 5 <= bench.basal
        assert abs(command["PramlintideRate"] - command["InsulinRate"] / 2) <= 1


# ---- samples that never come


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 6, 7, 12, 15, 16, 17, 18, 19, 32, 40])
def test_lost_samples(lost: int) -> None:
    bench = high()
    seen, expected = [], []
    for age in range(1, lost + 1):
        turn = bench.step(HIGH, drop=True)
        check_dose(bench, turn)
        seen.append(turn.state)
        expected.append(at_age(age))
        assert bool(turn.alarms(Code.CGM_LOST)) == (age >= 4)
        if turn.state == DEGRADED:
            assert turn.status["LimiterBits"] & LIMITER_STALE_CGM
        assert turn.diag["LostFrameCount"] == 0  # nobody can know yet
    refused = refused_after(lost)
    back = way_up(at_age(lost + refused))
    for k in range(8):
        turn = bench.step(HIGH)
        check_dose(bench, turn)
        seen.append(turn.state)
        expected.append(at_age(lost + 1) if k == 0 and refused else next(back))
        if k:
            # exact, also where the 4-bit counter of the frames sees nothing (16) or a gap of one (17)
            assert turn.diag["LostFrameCount"] == lost
            assert turn.diag["SequenceErrorCount"] == refused
            assert turn.diag["E2eErrorCount"] == 0
    assert seen == expected
    assert seen[-1] == AUTO


def test_counters_are_exact_over_any_pattern_of_losses() -> None:
    """Also while gaps are being heard of only in part, and never counting backwards."""
    bench, draw = high(), random.Random(12)
    lost = 0
    before: dict[str, int] = {}
    for _ in range(60):
        gap = draw.choice([1, 1, 2, 3, 5, 8, 15, 16, 17, 33])
        for _ in range(gap):
            bench.step(draw.randint(1000, 2500), drop=True)
        lost += gap
        for _ in range(draw.choice([1, 1, 2, 3, 4])):
            diag = bench.step(draw.randint(1000, 2500)).diag
            assert all(diag[name] >= value for name, value in before.items())
            before = diag
    for _ in range(3):
        turn = bench.step()
    assert turn.diag["LostFrameCount"] == lost


def test_samples_that_come_but_cannot_be_used_are_not_lost() -> None:
    bench = high()
    for _ in range(20):
        turn = bench.step(cgm=[bench.sample(CgmState=0)])  # warming up
    assert turn.state == SAFE_BASAL
    turn = bench.run(5, HIGH)
    assert turn.state == AUTO
    assert turn.diag["LostFrameCount"] == 0


def test_a_run_that_begins_without_a_sensor_runs_the_schedule() -> None:
    bench = Bench(mode=S2)
    for _ in range(5):
        turn = bench.step(drop=True)
        assert turn.state == SAFE_BASAL
        assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE
        assert turn.alarms(Code.CGM_LOST)
    states = [bench.step().state for _ in range(4)]
    # the first frame ever heard has no counter before it to be compared with
    assert states == [SAFE_BASAL, DEGRADED, AUTO, AUTO]


def test_the_first_two_samples_open_the_loop() -> None:
    bench = Bench()
    turn = bench.step()
    assert turn.state == State.INIT
    assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE
    assert bench.step().state == AUTO


def test_safe_basal_ends_a_low_rate_too() -> None:
    """The schedule, not the zero of the last low: a lost sensor must not leave the patient without insulin."""
    bench = Bench(mode=S2)
    bench.run(24)
    for k in range(8):
        turn = bench.step(1200 - 100 * k)
    assert turn.rate == turn.command["PramlintideRate"] == 0
    for age in range(1, 12):
        turn = bench.step(drop=True)
        if age >= 7:
            assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE


def test_nothing_is_made_up_for_afterwards() -> None:
    """Two hours in SafeBasal, then Auto: the rate is what the law asks for now, not the sum of what was missed."""
    bench = high()
    for _ in range(24):
        bench.step(HIGH, drop=True)
    rates = [turn.rate for turn in (bench.step(HIGH) for _ in range(30)) if turn.state == AUTO]
    tuning = Tuning()
    insulin_gain = bench.flash[11] / 1000
    ceiling = bench.basal / 5 + 60 * tuning.gain * (HIGH - GLUCOSE) / 10 / insulin_gain / 0.005
    # above the rate for glucose alone only by gamma times the insulin not yet seen to act, which is less than before
    assert max(rates) < 2 * ceiling


# ---- samples that come late, again, or from elsewhere


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_samples_up_to_15_min_old_are_used(delay: int) -> None:
    bench = high()
    late = deque([bench.sample(HIGH)])
    bench.step(cgm=[])
    for k in range(40):
        late.append(bench.sample(HIGH))
        arriving = [late.popleft()] if len(late) > delay else []
        turn = bench.step(cgm=arriving)
        assert turn.state == AUTO
        if k >= delay:
            assert turn.status["LastCgmSeq"] == (bench.k - 1 - delay) % 65535
    assert turn.diag["LostFrameCount"] == 0
    assert turn.diag["SequenceErrorCount"] == (0 if delay == 0 else 41 - delay)  # a late one is used, and counted


@pytest.mark.parametrize("late", [0, 1, 2, 3])
def test_age_counts_from_when_the_sample_was_taken(late: int) -> None:
    bench = high()
    fields = {"CgmSampleSeq": bench.k % 65535, "CgmSampleStep": bench.k % 256}
    for _ in range(late):
        bench.step(cgm=[])
    turn = bench.step(cgm=[bench.sample(HIGH, **fields)])
    assert turn.status["LastCgmSeq"] == fields["CgmSampleSeq"]
    for age in range(late + 1, 12):
        assert turn.state == at_age(age - 1)
        turn = bench.step(drop=True)


@pytest.mark.parametrize("delay", [4, 5, 15, 16, 100, 255])
def test_older_samples_are_not_used(delay: int) -> None:
    bench = high()
    last = bench.k - 1
    late: deque[Frame] = deque()
    for k in range(delay + 30):
        late.append(bench.sample(HIGH))
        arriving = [late.popleft()] if k >= delay else []
        turn = bench.step(cgm=arriving)
        assert turn.state == at_age(k + 1)
        assert turn.status["LastCgmSeq"] == last
        if arriving:
            assert any(a["CtrlAlarmCode"] == Code.CGM_IMPLAUSIBLE for a in turn.all("CTRL_Alarm"))


def test_a_sample_256_steps_old_looks_fresh_and_is_refused() -> None:
    """Its counter, its CRC and its sample step fit; its number does not."""
    bench = high()
    old = {}
    for k in range(256):
        old[bench.k] = bench.sample(HIGH)
        bench.step(cgm=[old[bench.k]])
        assert k >= 0
    last = bench.k - 1
    for age in range(1, 10):
        replayed = old[bench.k - 256]
        bench.sample(GLUCOSE)  # the true one is lost; its counter is the replayed one's
        turn = bench.step(cgm=[replayed])
        assert turn.status["LastCgmSeq"] == last
        assert turn.state == at_age(age)
        assert turn.alarms(Code.CGM_IMPLAUSIBLE)
        assert turn.diag["SequenceErrorCount"] == age


def test_a_duplicate_frame_counts_once() -> None:
    bench, undisturbed = high(), high()
    for k in range(30):
        glucose = HIGH + 10 * k
        sample = bench.sample(glucose)
        turn = bench.step(cgm=[sample] * 3)
        assert turn.command == undisturbed.step(glucose).command
        assert turn.diag["SequenceErrorCount"] == 2 * (k + 1)


def test_a_repeated_sample_in_a_fresh_frame_counts_once() -> None:
    """The transmitter sends its last sample again: no new sample, whatever it says now."""
    bench = high()
    last = bench.k - 1
    for age in range(1, 10):
        repeated = bench.sample(HIGH + 500, CgmSampleSeq=last, CgmSampleStep=bench.k % 256)
        turn = bench.step(cgm=[repeated])
        assert turn.state == at_age(age)
        assert turn.status["LastCgmSeq"] == last
        assert turn.diag["SequenceErrorCount"] == age


def test_a_frozen_counter_is_a_lost_sensor() -> None:
    bench = high()
    frozen = bench.transmitter.counters["CGM_Reading"]
    for age in range(10):
        bench.transmitter.counters["CGM_Reading"] = frozen
        turn = bench.step(HIGH)
        assert turn.state == at_age(age)
        assert turn.diag["SequenceErrorCount"] == age


@pytest.mark.parametrize("ahead", [1, 2, 100, 128, 252])
def test_a_sample_from_the_future_is_not_used(ahead: int) -> None:
    bench = high()
    last = bench.k - 1
    for age in range(1, 9):
        future = bench.sample(HIGH, CgmSampleStep=(bench.k + ahead) % 256)
        turn = bench.step(cgm=[future])
        assert turn.state == at_age(age)
        assert turn.status["LastCgmSeq"] == last
        assert turn.alarms(Code.CGM_IMPLAUSIBLE)


def test_numbers_that_jump_back_are_not_used_and_forward_are() -> None:
    bench = high()
    last = bench.k - 1
    back = bench.step(cgm=[bench.sample(HIGH, CgmSampleSeq=last - 1)])
    assert back.status["LastCgmSeq"] == last
    forward = bench.step(cgm=[bench.sample(HIGH, CgmSampleSeq=last + 500)])
    assert forward.status["LastCgmSeq"] == last + 500
    assert forward.diag["LostFrameCount"] == 499  # minus nothing: the repeated one stands for no number of these


def test_several_samples_at_once_are_taken_in_order() -> None:
    """A link that was away and delivers everything it kept: the newest one counts."""
    bench = high()
    kept = []
    for _ in range(3):
        kept.append(bench.sample(2000))
        bench.step(cgm=[])
    kept.append(bench.sample(2100))
    turn = bench.step(cgm=kept)
    assert turn.state == AUTO
    assert turn.status["LastCgmSeq"] == bench.k - 1
    assert (turn.diag["LostFrameCount"], turn.diag["SequenceErrorCount"]) == (0, 3)


# ---- trends after a gap


def rates_after(gap: int, *glucose: int) -> list[int]:
    bench = Bench(mode=NMA)
    bench.run(60)
    for _ in range(gap):
        bench.step(drop=True)
    turns = [bench.step(value) for value in glucose]
    return [turn.rate for turn in turns if turn.state == AUTO]


def without_trend(glucose: int) -> float:
    """Rate for a glucose that has always been there, 0.005 U/h."""
    flash = calibration()
    return flash[0] / 5 + 60 * Tuning().gain * (glucose - GLUCOSE) / 10 / (flash[11] / 1000) / 0.005


def test_a_step_of_glucose_kicks_when_nothing_was_missing() -> None:
    assert rates_after(0, 1600)[0] > without_trend(1600) + 200


@pytest.mark.parametrize("gap", [5, 16, 20])
def test_no_kick_after_a_gap(gap: int) -> None:
    """+40 mg/dL while nobody was looking: the first samples are dosed as if glucose had always been there."""
    rates = rates_after(gap, *[1600] * 8)
    assert len(rates) >= 5
    for rate in rates:
        assert rate == pytest.approx(without_trend(1600), abs=3)


def test_the_second_sample_after_a_gap_makes_no_trend_either() -> None:
    """5 lost, one refused for its counter; 40 mg/dL up, and 20 more in the next sample."""
    rates = rates_after(5, GLUCOSE, 1600, 1800, 1800, 1800)
    for rate in rates:
        assert rate == pytest.approx(without_trend(1800), abs=3)


@pytest.mark.parametrize(("missing", "settles"), [(2, False), (3, False), (4, True), (5, True)])
def test_trends_are_dropped_exactly_when_the_ladder_went_down(missing: int, settles: bool) -> None:
    """The sensor took no samples, so no counter tells of them; 40 mg/dL later it is back."""
    bench = Bench(mode=NMA)
    bench.run(60)
    states = [bench.step(cgm=[]).state for _ in range(missing)]
    assert (DEGRADED in states) == settles
    demands = []
    for _ in range(2):
        bench.step(1600)
        demands.append(bench.firmware._outputs[layout.OUT_DEMAND] >> 16)  # what the law asks for, whatever it may
    if settles:
        assert demands == pytest.approx([without_trend(1600)] * 2, abs=3)
    else:
        assert demands[0] > without_trend(1600) + 200


def test_a_short_gap_keeps_the_trend() -> None:
    """Two samples lost are bridged: the rise is real and is answered."""
    bench, gapless = Bench(), Bench()
    bench.run(60), gapless.run(60)
    for k in range(20):
        turn, other = bench.step(GLUCOSE + 50 * k, drop=k in (10, 11)), gapless.step(GLUCOSE + 50 * k)
    assert turn.rate == pytest.approx(other.rate, rel=0.1)


# ---- flapping


Frames = Callable[[Bench, int], Turn]


def raised(bench: Bench, steps: int, step: Frames) -> dict[int, list[int]]:
    """Run a script; the steps at which a new alarm came up, by code."""
    new: dict[int, list[int]] = {}
    instances = set()
    for k in range(steps):
        for alarm in step(bench, k).all("CTRL_Alarm"):
            if alarm["CtrlAlarmInstance"] not in instances:
                instances.add(alarm["CtrlAlarmInstance"])
                assert alarm["CtrlAlarmState"] == AlarmState.PENDING
                new.setdefault(alarm["CtrlAlarmCode"], []).append(k)
            if alarm["CtrlAlarmState"] == AlarmState.PENDING:
                bench.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=1, AlarmAckInstance=alarm["CtrlAlarmInstance"])
    return new


def at_most_one_in_half_an_hour(new: dict[int, list[int]]) -> None:
    for code, steps in new.items():
        apart = [later - earlier for earlier, later in itertools.pairwise(steps)]
        assert all(gap >= PER_HALF_HOUR for gap in apart), (Code(code).name, steps)


@pytest.mark.parametrize("down", [4, 7, 20])
def test_every_second_sample_for_six_hours_stays_down(down: int) -> None:
    bench = high()
    for _ in range(down):
        state = bench.step(HIGH, drop=True).state
    # the counter's jump costs the first frame after the loss, too
    bench.step(HIGH)
    bench.step(HIGH, drop=True)
    states = set()

    def every_second(bench: Bench, k: int) -> Turn:
        turn = bench.step(HIGH, drop=k % 2 == 1)
        check_dose(bench, turn)
        states.add(turn.state)
        return turn

    at_most_one_in_half_an_hour(raised(bench, 72, every_second))
    assert states == {state}
    assert state != AUTO
    assert bench.run(5, HIGH).state == AUTO  # two good ones in a row, and up


@pytest.mark.parametrize("lost", range(1, 10))
def test_flapping_raises_one_alarm_in_half_an_hour(lost: int) -> None:
    for good in range(1, 10):
        at_most_one_in_half_an_hour(
            raised(high(), 80, lambda bench, k, period=lost + good: bench.step(HIGH, drop=k % period < lost))
        )


@pytest.mark.parametrize("period", range(2, 12))
def test_other_causes_that_flap_raise_one_alarm_in_half_an_hour(period: int) -> None:
    def corrupt(bench: Bench, k: int) -> Turn:
        sample = bench.sample(HIGH)
        return bench.step(cgm=[sample._replace(data=bytes(8)) if k % period == 0 else sample])

    def implausible(bench: Bench, k: int) -> Turn:
        return bench.step(cgm=[bench.sample(HIGH, CgmState=6 if k % period == 0 else 1)])

    def late(bench: Bench, k: int) -> Turn:
        """A sample 15 min old now and then, nothing between."""
        fields = {"CgmSampleSeq": (bench.k - 3) % 65535, "CgmSampleStep": (bench.k - 3) % 256}
        return bench.step(cgm=[bench.sample(HIGH, **fields)] if k % period < 2 else [])

    def silent(bench: Bench, k: int) -> Turn:
        return bench.step(HIGH, status=k % period == 0)

    def refused(bench: Bench, k: int) -> Turn:
        request = bench.frame("MODE_Cmd", ModeRequest=9, ModeCmdSeq=k + 1, SuspendRequest=0)
        return bench.step(HIGH, also=[request] if k % period == 0 else [])

    for script in (corrupt, implausible, late, silent, refused):
        at_most_one_in_half_an_hour(raised(high(), 80, script))

    limited = Bench(flash=calibration(CfgMaxBasal=1430))
    new = raised(limited, 80, lambda bench, k: bench.step(GLUCOSE + 450 if k % period == 0 else GLUCOSE))
    assert new[Code.DOSE_LIMITED]
    at_most_one_in_half_an_hour(new)


# ---- the ladder by itself


def test_down_at_once_up_one_rung_at_a_time_whatever_happens() -> None:
    """100000 random steps of the ladder alone."""
    draw = random.Random(9)
    ladder = Ladder()
    taken, streak = -(1 << 20), 0
    state = State.INIT
    for k in range(100_000):
        if draw.random() < (0.5 if k // 500 % 2 else 0.9):
            taken, streak = k - draw.choice([0, 0, 0, 1, 3]), streak + 1
        else:
            streak = 0
        calibrated = k > 3
        suspended = k % 1000 in range(400, 420)
        pump_age = 3 if k % 700 in range(50, 60) else 0
        before = state
        state = ladder.update(
            calibrated=calibrated, suspended=suspended, age=k - taken, streak=streak, pump_age=pump_age
        )
        if not calibrated:
            assert state == State.INIT
        elif suspended:
            assert state == State.SUSPENDED
        elif pump_age:
            assert state == State.DELIVERY_UNCERTAIN
        else:
            if k - taken >= 7:
                assert state == SAFE_BASAL
            elif k - taken >= 4:
                assert state in (DEGRADED, SAFE_BASAL)
            if state < before and before in (DEGRADED, SAFE_BASAL):
                assert before - state == 1
                assert streak >= 2
        assert state != State.FAULT


@pytest.mark.parametrize("mode", [NMA, S2])
def test_no_dose_above_the_schedule_without_a_fresh_sample(mode: int) -> None:
    """Two thousand steps of everything at once; what matters is the age of the last sample that could be used."""
    bench, draw = high(mode), random.Random(33)
    taken, gone = bench.k - 1, 0
    for _ in range(2000):
        gone = gone - 1 if gone else draw.choice([0] * 20 + [1, 2, 4, 5, 8, 17])
        kind = draw.choice(["good"] * 12 + ["state", "low", "future", "old", "corrupt", "length", "double"])
        sample = bench.sample(HIGH)
        arriving = {
            "good": [sample],
            "state": [bench.sample(HIGH, CgmState=draw.choice([0, 2, 3, 6, 7, 8, 14, 15]))],
            "low": [bench.sample(draw.randint(0, 199))],
            "future": [bench.sample(HIGH, CgmSampleStep=(bench.k + 9) % 256)],
            "old": [bench.sample(HIGH, CgmSampleStep=(bench.k - 4) % 256)],
            "corrupt": [sample._replace(data=sample.data[:7] + bytes([sample.data[7] ^ 8]))],
            "length": [sample._replace(data=sample.data[:7])],
            "double": [sample, sample],
        }[kind]
        turn = bench.step(cgm=[] if gone else arriving, status=draw.random() < 0.9, totals=draw.random() < 0.9)
        if turn.status["LastCgmSeq"] == (bench.k - 1) % 65535:
            taken = bench.k - 1
        else:
            assert gone or kind not in ("good", "double") or turn.diag["SequenceErrorCount"] > 0
        age = bench.k - 1 - taken
        command = turn.command
        if age > 3 and command["BasalOp"] == Op.SET_RATE:
            assert command["InsulinRate"] * 5 <= bench.basal
        if age >= 7:
            assert command["BasalOp"] == Op.RESUME_SCHEDULE


def test_missing_samples_never_raise_insulin() -> None:
    """After a fall the held glucose looks like its end; the law alone would go from 0 to twice the schedule."""
    bench = Bench()
    for k in range(40):
        turn = bench.step(1500 - 20 * k)
    rates = [turn.command["InsulinRate"]]
    for _ in range(3):
        turn = bench.step(drop=True)
        assert turn.state == State.AUTO
        rates.append(turn.command["InsulinRate"])
    assert rates == sorted(rates, reverse=True)
    assert turn.status["LimiterBits"] & 16


def test_one_sample_and_no_more_is_not_a_start_for_ever() -> None:
    """The device waits for a second sample until the first one is too old for anything but the schedule."""
    bench = Bench()
    states = [bench.step().state, *(bench.step(drop=True).state for _ in range(8))]
    assert states == [State.INIT] * 7 + [SAFE_BASAL] * 2


@pytest.mark.parametrize("state", State)
def test_doubt_is_in_force_at_once_where_anything_is_dosed(state: State) -> None:
    ladder = Ladder()
    ladder.state = state
    ladder.doubt()
    doses = state in (State.AUTO, State.DEGRADED, State.SAFE_BASAL)
    assert ladder.state == (State.DELIVERY_UNCERTAIN if doses else state)
