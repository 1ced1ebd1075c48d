"""The supervisor's rules at their boundaries and one beside the other; `test_safety_rules` has each by itself."""

import itertools

import pytest
from bench import GLUCOSE, MODE_OFF, NMA, OPEN_LOOP, S2, SENT_BY_CTRL, SIM_TIME_SNA, Bench, Turn, calibration
from hypothesis import given
from hypothesis import strategies as st

from can_bus.codec import Receiver
from can_bus.lockstep import Phase
from firmware_sim.alarms import STEPS_AT_LEAST, Alarms, Code
from firmware_sim.cgm import Cgm
from firmware_sim.control import layout
from firmware_sim.control.core import follow_trend
from firmware_sim.control.limits import limit_rate
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.ladder import Ladder, State
from firmware_sim.nvm import RamMemory
from firmware_sim.pump import Op

OK, BELOW, ABOVE = 1, 4, 5
HIGH = GLUCOSE + 400
USUAL = {"PumpState": 3, "InsulinReservoir": 2000, "PramReservoir": 2000, "PumpBattery": 90}
SENSOR = {"CgmFaultBits": 0, "CgmSessionId": 1, "CgmSensorAge": 10, "CgmNoise": 0, "CgmDropCount": 0}


def sample(number: int, glucose: int, state: int = OK, taken: int | None = None) -> dict[str, int]:
    taken = number if taken is None else taken
    return {"CgmState": state, "GlucoseConc": glucose, "CgmSampleSeq": number, "CgmSampleStep": taken % 256}


def heard(*glucoses: int) -> Cgm:
    cgm = Cgm()
    for k, glucose in enumerate(glucoses):
        cgm.judge([sample(k, glucose)], k)
    return cgm


def status_of(session: int = 1, noise: int = 0, faults: int = 0) -> dict[str, int]:
    return {"CgmSessionId": session, "CgmNoise": noise, "CgmFaultBits": faults}


def rising(mode: int = S2, **raws: int) -> Bench:
    """A bench whose law asks for more than the schedule, and goes on to do so while glucose is `HIGH`."""
    bench = Bench(mode=mode, flash=calibration(**raws))
    for k in range(20):
        turn = bench.step(HIGH + k % 2)
    assert turn.rate > bench.basal // 5
    return bench


def within_schedule(turn: Turn, bench: Bench) -> bool:
    return turn.rate <= bench.basal // 5


def reborn(cgm: Cgm) -> Cgm:
    other = Cgm()
    other.restore(iter(cgm.save()))
    return other


# ---- SEN-06: a steep rise


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_allowed_rise_is_50_for_every_step_since_the_last_sample(steps: int) -> None:
    for rise, used in ((500 * steps, True), (500 * steps + 1, False)):
        cgm = heard(1500)
        verdict = cgm.judge([sample(steps, 1500 + rise)], steps)
        assert (verdict.glucose >= 0) == used
        assert verdict.refused == (not used)


def test_what_counts_is_when_a_sample_was_taken_not_when_it_came() -> None:
    for taken, used in ((1, False), (2, True)):
        assert (heard(1500).judge([sample(1, 2500, taken=taken)], 3).glucose >= 0) == used


def test_after_more_than_15_min_any_rise_is_believed() -> None:
    assert heard(1500).judge([sample(4, 8000)], 4).glucose == 8000


@pytest.mark.parametrize(("second", "used"), [(2501, True), (2499, True), (3000, True), (3500, True), (3501, False)])
def test_a_waiting_rise_needs_a_sample_within_50_of_it(second: int, used: bool) -> None:
    """Lower than that it is no steep rise over two steps."""
    cgm = heard(1500)
    assert cgm.judge([sample(1, 3000)], 1).glucose == -1
    assert cgm.waiting
    assert cgm.age(1) == 1
    assert cgm.streak == 0
    assert (cgm.judge([sample(2, second)], 2).glucose == second) == used
    assert cgm.waiting != used


@pytest.mark.parametrize(("second", "used"), [(4500, True), (4499, False), (2500, True), (2501, False)])
def test_a_sample_more_than_50_below_a_waiting_rise_is_a_rise_of_its_own(second: int, used: bool) -> None:
    cgm = heard(1500)
    cgm.judge([sample(1, 5000)], 1)
    assert (cgm.judge([sample(2, second)], 2).glucose == second) == used
    if not used:  # and it is the one the next sample must agree with
        assert cgm.judge([sample(3, second + 501)], 3).glucose == -1
        assert cgm.judge([sample(3, second + 1001)], 3).glucose == second + 1001


def test_two_outliers_that_agree_in_the_same_step_are_not_told_from_a_rise() -> None:
    cgm = heard(1500)
    assert cgm.judge([sample(1, 3000), sample(2, 3100, taken=1)], 1).glucose == 3100


def test_an_outlier_is_forgotten_with_the_next_usable_sample() -> None:
    cgm = heard(1500)
    cgm.judge([sample(1, 3000)], 1)
    assert cgm.judge([sample(2, 1510)], 2).glucose == 1510
    assert not cgm.waiting
    assert cgm.judge([sample(3, 3000)], 3).glucose == -1


@given(st.integers(200, 8000), st.integers(0, 7800), st.integers(1, 3))
def test_a_fall_never_waits(before: int, fall: int, steps: int) -> None:
    after = max(before - fall, 200)
    assert heard(before).judge([sample(steps, after)], steps).glucose == after


def test_the_end_of_the_scale_counts_as_its_value() -> None:
    for last, used in ((3500, True), (3499, False)):
        assert (heard(last).judge([sample(1, 0, ABOVE)], 1).glucose == 4000) == used
    for after, used in ((900, True), (901, False)):
        cgm = heard(500)
        assert cgm.judge([sample(1, 0, BELOW)], 1).glucose == 400
        assert (cgm.judge([sample(2, after)], 2).glucose == after) == used


def test_a_rise_that_waits_is_told_and_raises_nothing() -> None:
    bench = rising()
    rate = bench.step(HIGH).rate
    turn = bench.step(HIGH + 501)
    assert turn.alarms(Code.CGM_IMPLAUSIBLE)
    assert turn.rate <= rate
    assert turn.status["LastCgmSeq"] == bench.k - 2
    turn = bench.step(HIGH + 600)
    assert turn.rate > rate
    assert turn.state == State.AUTO


# ---- SEN-07: a stuck sensor


@pytest.mark.parametrize("limit", [2, 3, 10, 15])
def test_so_many_equal_values_are_a_stuck_sensor(limit: int) -> None:
    cgm = Cgm()
    cgm.stuck_limit = limit
    used = [cgm.judge([sample(k, 1500)], k).glucose >= 0 for k in range(limit + 3)]
    assert used == [True] * (limit - 1) + [False] * 4
    assert cgm.age(limit + 2) == 4
    assert cgm.judge([sample(limit + 3, 1499)], limit + 3).glucose == 1499
    again = [cgm.judge([sample(k, 1499)], k).glucose >= 0 for k in range(limit + 4, 2 * limit + 4)]
    assert again == [True] * (limit - 2) + [False] * 2


def test_without_a_limit_a_value_may_stay_for_a_day() -> None:
    cgm = Cgm()
    assert all(cgm.judge([sample(k, 1500)], k).glucose == 1500 for k in range(288))


def test_a_repeated_sample_is_not_another_equal_value() -> None:
    cgm = Cgm()
    cgm.stuck_limit = 3
    for k in (0, 0, 0, 1, 1, 1):
        cgm.judge([sample(k, 1500)], k)
    assert cgm.sequence == 1


@pytest.mark.parametrize("limit", [0, 4])
def test_a_stuck_sensor_goes_down_the_ladder_like_a_lost_one(limit: int) -> None:
    bench = Bench(flash=calibration(CfgStuckSamples=limit))
    states = [bench.step().state for _ in range(12)]
    lower = [State.DEGRADED] * 3 + [State.SAFE_BASAL] * 3 if limit else [State.AUTO] * 6
    assert states == [State.INIT, *[State.AUTO] * 5, *lower]


# ---- SEN-08, SEN-09: what the sensor says of itself


@pytest.mark.parametrize("noise", range(256))
def test_noise_above_15_is_doubtful_and_reserved_codes_say_nothing(noise: int) -> None:
    cgm = Cgm()
    cgm.status(status_of(noise=noise))
    assert cgm.doubtful == (30 < noise < 254)
    cgm.status(status_of())
    assert not cgm.doubtful


@pytest.mark.parametrize("faults", range(16))
def test_every_fault_but_telemetry_is_doubtful(faults: int) -> None:
    cgm = Cgm()
    cgm.status(status_of(faults=faults))
    assert cgm.doubtful == bool(faults & 0b1011)


@pytest.mark.parametrize("fields", [{"CgmNoise": 31}, {"CgmFaultBits": 1}, {"CgmFaultBits": 2}, {"CgmFaultBits": 8}])
def test_doubt_lasts_until_the_sensor_takes_it_back(fields: dict[str, int]) -> None:
    bench = rising()
    for k in range(5):
        status = [bench.frame("CGM_Status", **(SENSOR | fields))] if k == 0 else []
        turn = bench.step(HIGH + k % 2, also=status)
        assert within_schedule(turn, bench)
        assert turn.state == State.AUTO
    turn = bench.step(HIGH, also=[bench.frame("CGM_Status", **(SENSOR | {"CgmFaultBits": 4, "CgmNoise": 30}))])
    assert not within_schedule(turn, bench)


def test_doubt_does_not_hold_back_a_cut() -> None:
    bench = rising()
    bench.step(HIGH, also=[bench.frame("CGM_Status", **(SENSOR | {"CgmFaultBits": 2}))])
    assert bench.step(700).rate == 0


def test_only_another_session_starts_anew() -> None:
    cgm = heard(1500, 1500, 1500)
    for session, anew in ((255, False), (7, False), (255, False), (7, False), (8, True), (255, False), (7, True)):
        cgm.status(status_of(session))
        assert cgm.settling == anew, session
        if anew:
            cgm.since_gap = 3


def test_after_a_change_of_session_three_samples_settle_and_no_rise_waits() -> None:
    cgm = heard(1500, 1500, 1500)
    cgm.status(status_of(1))
    cgm.judge([sample(3, 3000)], 3)
    assert cgm.waiting
    cgm.status(status_of(2))
    assert not cgm.waiting
    settling = []
    for k in range(4, 8):
        assert cgm.judge([sample(k, 4000)], k).glucose == 4000
        settling.append(cgm.settling)
    assert settling == [True, True, False, False]


def test_another_sensor_makes_no_kick() -> None:
    rates = []
    for session in (1, 2):
        bench = Bench(mode=S2)
        bench.step(also=[bench.frame("CGM_Status", **SENSOR)])
        bench.run(19)
        status = bench.frame("CGM_Status", **(SENSOR | {"CgmSessionId": session}))
        rates.append(bench.step(GLUCOSE + 500, also=[status]).rate)
    assert rates[1] < rates[0]


def test_what_the_sensor_said_survives_a_reset() -> None:
    cgm = heard(1500, 1500, 1500)
    cgm.status(status_of(9, noise=100))
    other = reborn(cgm)
    assert other.doubtful
    assert other.settling
    assert (other.sequence, other.age(5)) == (2, 3)
    assert other.judge([sample(2, 1500)], 3).repeated == 1
    assert other.judge([sample(3, 1500)], 3).glucose == 1500
    other.since_gap = 3
    other.status(status_of(9))
    assert not other.settling
    other.status(status_of(10))
    assert other.settling
    assert reborn(Cgm()).save() == Cgm().save()
    assert reborn(Cgm()).sequence is None
    assert reborn(Cgm()).age(0) == Cgm().age(0)


# ---- TIM-02, TIM-03: time


def at_time(bench: Bench, glucose: int, time: int, *, drop: bool = False) -> Turn:
    bench.give(*([] if drop else [bench.sample(glucose)]), bench.status(), bench.delivered())
    turn = bench.token(Phase.STEP, bench.k, time)
    bench.obey(turn)
    bench.k += 1
    return turn


def test_a_time_that_is_not_known_is_no_jump() -> None:
    bench = rising()
    turn = at_time(bench, HIGH, SIM_TIME_SNA)
    assert not turn.alarms(Code.CLOCK_JUMP)
    assert not within_schedule(turn, bench)


def test_caution_after_a_jump_counts_samples_not_steps() -> None:
    bench = rising()
    at_time(bench, HIGH, bench.k * 300 + 61)
    for _ in range(2):
        bench.step(drop=True)
    rates = [bench.step(HIGH + k % 2).rate <= bench.basal // 5 for k in range(4)]
    assert rates == [True, True, False, False]


def test_a_clock_that_stays_wrong_keeps_insulin_at_the_schedule_and_says_so_once() -> None:
    bench = rising()
    instances = set()
    for k in range(10):
        turn = at_time(bench, HIGH + k % 2, bench.k * 300 + 7200)
        assert within_schedule(turn, bench)
        assert turn.state == State.AUTO
        instances |= {alarm["CtrlAlarmInstance"] for alarm in turn.alarms(Code.CLOCK_JUMP)}
    assert len(instances) == 1
    assert turn.alarms(Code.CLOCK_JUMP)[0]["CtrlAlarmPriority"] == 1


def test_the_tolerance_at_the_start_of_a_run() -> None:
    for time, told in ((0, False), (60, False), (61, True)):
        bench = Bench()
        assert bool(at_time(bench, GLUCOSE, time).alarms(Code.CLOCK_JUMP)) == told


@pytest.mark.parametrize("skipped", [1, 5, 40, 287, 288, 289, 5000])
def test_skipped_steps_age_insulin_on_board_as_steps_without_insulin_would(skipped: int) -> None:
    """The pump ran its schedule meanwhile: nothing comes on board."""
    benches = Bench(mode=OPEN_LOOP), Bench(mode=OPEN_LOOP)
    for bench in benches:
        bench.run(5)
        bench.total += 8000 * 12
        before = bench.run(1).status["InsulinOnBoard"]
        assert before == pytest.approx(800, abs=5)
    gap, steady = benches
    gap.k += skipped
    gap.total += gap.basal * skipped
    after = gap.step().status["InsulinOnBoard"]
    assert after == pytest.approx(steady.run(min(skipped, 288) + 1).status["InsulinOnBoard"], abs=2)
    assert after < before


def test_insulin_of_the_gap_above_the_schedule_comes_on_board() -> None:
    bench = Bench(mode=OPEN_LOOP)
    bench.run(6)
    bench.k += 10
    bench.total += bench.basal * 10 + 5000 * 12
    assert bench.step().status["InsulinOnBoard"] == pytest.approx(500, abs=5)


def test_before_the_calibration_nothing_is_caught_up() -> None:
    bench = Bench(flash={})
    bench.run(3)
    bench.k += 20
    turn = bench.step()
    assert turn.state == State.INIT
    assert not turn.all("PUMP_BasalCmd")
    assert turn.status["InsulinOnBoard"] == 0


# ---- ALM-03, FAL-06, USR-05


@pytest.mark.parametrize("prepare", ["init", "off", "uncalibrated", "silent pump", "degraded"])
def test_urgent_low_needs_no_state(prepare: str) -> None:
    bench = Bench(mode=MODE_OFF if prepare == "off" else NMA, flash={} if prepare == "uncalibrated" else None)
    if prepare != "init":
        bench.run(6)
    if prepare == "degraded":
        for _ in range(5):
            bench.step(cgm=())  # nothing was sent: no gap for E2E
    if prepare == "silent pump":
        for _ in range(3):
            bench.step(status=False)
    turn = bench.step(549, status=prepare != "silent pump")
    assert turn.state == {
        "off": State.SUSPENDED,
        "silent pump": State.DELIVERY_UNCERTAIN,
        "degraded": State.DEGRADED,
    }.get(prepare, State.INIT)
    (alarm,) = turn.alarms(Code.URGENT_LOW)
    assert (alarm["CtrlAlarmPriority"], alarm["CtrlAlarmState"]) == (3, 1)


def test_urgent_low_stays_while_nothing_better_is_known_and_ends_with_the_cause() -> None:
    bench = Bench()
    bench.run(5)
    bench.step(540)
    told = [bool(bench.step(cgm=()).alarms(Code.URGENT_LOW)) for _ in range(8)]
    assert all(told)
    (alarm,) = bench.step(550).alarms(Code.URGENT_LOW)
    assert alarm["CtrlAlarmState"] == 0
    assert not bench.step(550).alarms(Code.URGENT_LOW)


def test_below_the_scale_is_urgent() -> None:
    bench = Bench()
    bench.run(5)
    assert bench.step(cgm=[bench.sample(CgmState=BELOW, GlucoseConc=8190)]).alarms(Code.URGENT_LOW)


@pytest.mark.parametrize("request_", [0, 3])
def test_only_suspend_and_resume_suspend_and_resume(request_: int) -> None:
    bench = Bench()
    bench.run(10)
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=request_)
    turn = bench.step()
    assert turn.state == State.AUTO
    assert not turn.alarms(Code.STATE_CHANGE)


def test_a_change_by_the_user_is_info_with_the_state_it_led_to() -> None:
    bench = Bench()
    bench.run(10)
    instances = []
    for number, request, state in ((1, 1, State.SUSPENDED), (2, 2, State.AUTO), (3, 1, State.SUSPENDED)):
        bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=number, SuspendRequest=request)
        turn = bench.step()
        (alarm,) = turn.alarms(Code.STATE_CHANGE)
        assert (alarm["CtrlAlarmPriority"], alarm["CtrlAlarmState"], alarm["CtrlAlarmAux"]) == (0, 1, state)
        assert turn.state == state
        instances.append(alarm["CtrlAlarmInstance"])
        later = [bench.step().alarms(Code.STATE_CHANGE) for _ in range(STEPS_AT_LEAST + 4)]
        assert bool(later[-1]) == (state == State.SUSPENDED)  # it is told as long as it lasts
    assert len(set(instances)) == 2  # resuming is a change of the alarm that tells of suspending


def test_the_user_is_reminded_of_suspended() -> None:
    bench = Bench()
    bench.run(10)
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=1)
    (alarm,) = bench.step().alarms(Code.STATE_CHANGE)
    bench.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=1, AlarmAckInstance=alarm["CtrlAlarmInstance"])
    told = [[alarm["CtrlAlarmState"] for alarm in bench.step().alarms(Code.STATE_CHANGE)] for _ in range(5)]
    assert told == [[2], [], [], [1], [1]]


def test_a_start_is_told_when_it_is_over() -> None:
    bench = Bench()
    assert not bench.step().alarms(Code.STATE_CHANGE)
    (alarm,) = bench.step().alarms(Code.STATE_CHANGE)
    assert (alarm["CtrlAlarmPriority"], alarm["CtrlAlarmAux"]) == (0, State.AUTO)


def test_a_pump_that_falls_silent_while_the_user_has_suspended_is_lost_too() -> None:
    bench = Bench()
    bench.run(10)
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=1)
    turns = [bench.step(status=False) for _ in range(3)]
    assert [turn.state for turn in turns] == [State.SUSPENDED] * 3
    assert [bool(turn.alarms(Code.PUMP_LOST)) for turn in turns] == [False, False, True]


def test_ladder_changes_alone_are_not_the_users() -> None:
    bench = Bench()
    bench.run(10)
    for _ in range(8):
        assert not bench.step(drop=True).alarms(Code.STATE_CHANGE)


@pytest.mark.parametrize(("minutes", "highest"), [(0, 0), (4, 0), (5, 1), (9, 1), (14, 2), (15, 3), (16, 3), (30, 3)])
def test_above_the_schedule_only_up_to_the_stale_limit(minutes: int, highest: int) -> None:
    bench = rising(CfgStaleCgmLimit=minutes)
    above = [not within_schedule(bench.step(drop=True), bench) for _ in range(6)]
    assert above == [True] * highest + [False] * (6 - highest)


# ---- CMD-07, CMD-09, TWO-04: the pump


def shown(bench: Bench, number: int) -> Turn:
    return bench.step(status=False, also=[bench.frame("PUMP_Status", PumpLastBasalSeq=number, **USUAL)])


def test_one_step_of_another_set_point_is_a_frame_under_way_two_are_an_alarm() -> None:
    bench = Bench()
    last = bench.run(5).command["BasalCmdSeq"]
    told = []
    for back in (1, 0, 1, 0, 1, 1, 1023):
        turn = shown(bench, 1023 if back == 1023 else last - back)
        last = turn.command["BasalCmdSeq"]
        told.append(bool(turn.alarms(Code.DELIVERY_UNCERTAIN)))
        assert turn.state == State.AUTO
    assert told == [False] * 5 + [True] * 2
    (alarm,) = turn.alarms(Code.DELIVERY_UNCERTAIN)
    assert alarm["CtrlAlarmPriority"] == 3
    ended = []
    for _ in range(STEPS_AT_LEAST):
        turn = shown(bench, last)
        last = turn.command["BasalCmdSeq"]
        ended += [alarm["CtrlAlarmState"] for alarm in turn.alarms(Code.DELIVERY_UNCERTAIN)]
    assert ended[-1] == 0
    assert not shown(bench, last).alarms(Code.DELIVERY_UNCERTAIN)


@pytest.mark.parametrize(
    ("fields", "insulin", "pramlintide"),
    [
        ({"InsulinOcclusion": 2}, False, False),
        ({"InsulinReservoir": 0}, False, False),
        ({"PumpState": 5}, False, False),
        ({"PumpState": 6}, False, False),
        ({"PumpState": 4}, True, True),
        ({"InsulinOcclusion": 3}, True, True),
        ({"InsulinReservoir": 1, "PramReservoir": 1}, True, True),
        ({"PramOcclusion": 2}, True, False),
        ({"PramReservoir": 0}, True, False),
        ({"PramOcclusion": 3}, True, True),
    ],
)
def test_a_blocked_line_stops_its_own_drug_and_insulins_stops_both(
    fields: dict[str, int], insulin: bool, pramlintide: bool
) -> None:
    bench, undisturbed = rising(), rising()
    usual = undisturbed.step(HIGH)
    turn = bench.step(HIGH, status=False, also=[bench.frame("PUMP_Status", **(USUAL | fields))])
    assert usual.command["PramlintideRate"] > 0
    if insulin:
        assert turn.rate == usual.rate
        assert turn.command["PramlintideRate"] == (usual.command["PramlintideRate"] if pramlintide else 0)
    else:
        assert turn.rate == bench.basal // 5
        assert turn.command["PramlintideRate"] == 0
    turn = bench.step(HIGH + 1, status=False)  # what was said last still holds
    assert within_schedule(turn, bench) == (not insulin)
    assert (turn.command["PramlintideRate"] > 0) == pramlintide
    turn = bench.step(HIGH)  # until it is taken back
    assert not within_schedule(turn, bench)
    assert turn.command["PramlintideRate"] > 0


def answer(bench: Bench, turn: Turn, purpose: int, result: int, limit: int, back: int = 0) -> Turn:
    number = turn.command["BasalCmdSeq"] - back
    acks = [bench.frame("PUMP_Ack", AckFor=purpose, AckResult=result, AckId=number, AckEchoRaw=900, AckLimitRaw=limit)]
    if purpose == 1:  # the other drug's has come all the same
        echo = turn.command["PramlintideRate"]
        acks.append(bench.frame("PUMP_Ack", AckFor=8, AckResult=0, AckId=number, AckEchoRaw=echo, AckLimitRaw=3000))
    return bench.step(HIGH + bench.k % 2, also=acks)


def test_a_rate_over_the_pumps_limit_is_never_asked_for_again() -> None:
    bench = rising()
    turn = bench.step(HIGH)
    assert turn.rate > 290
    errors = turn.diag["SequenceErrorCount"]
    turn = answer(bench, turn, 1, 3, 290)
    assert turn.rate == 290
    assert turn.command["PramlintideRate"] == pytest.approx(
        145, abs=1
    )  # the ratio of what is given, not of what is not
    assert turn.diag["SequenceErrorCount"] == errors + 1
    assert all(bench.step(HIGH + 5 * k).rate == 290 for k in range(6))
    turn = answer(bench, bench.step(HIGH), 1, 3, 0)
    assert turn.rate == 0


def test_pramlintide_whose_answer_is_missing_is_held_back_until_one_comes() -> None:
    """Requirement TWO-05: what the pump made of it is not known; insulin goes on."""
    bench = rising()
    asked = answer(bench, bench.step(HIGH), 1, 0, 8000)
    assert asked.command["PramlintideRate"] > 0
    ack = bench.frame("PUMP_Ack", AckFor=1, AckResult=0, AckId=asked.command["BasalCmdSeq"], AckEchoRaw=asked.rate)
    turn = bench.step(HIGH, also=[ack])
    assert (turn.rate > 290, turn.command["PramlintideRate"]) == (True, 0)
    assert turn.state == State.AUTO
    assert not turn.status["LimiterBits"] & layout.LIMITER_MAX_BASAL
    assert answer(bench, turn, 1, 0, 8000).command["PramlintideRate"] > 0


def test_each_drugs_limit_is_its_own() -> None:
    bench = rising()
    turn = bench.step(HIGH)
    rate = turn.rate
    turn = answer(bench, turn, 8, 3, 5)
    assert turn.command["PramlintideRate"] == 5
    assert turn.rate == pytest.approx(rate, abs=10)


@pytest.mark.parametrize(
    ("purpose", "result", "back"), [(1, 0, 0), (1, 1, 0), (1, 2, 0), (1, 5, 0), (1, 3, 1), (2, 3, 0), (6, 3, 0)]
)
def test_another_answer_is_no_limit(purpose: int, result: int, back: int) -> None:
    bench, undisturbed = rising(), rising()
    turn = answer(bench, bench.step(HIGH), purpose, result, 10, back)
    undisturbed.step(HIGH)
    assert turn.rate == undisturbed.step(HIGH + undisturbed.k % 2).rate


# ---- LIM-05, LIM-08: the limits of a product


def fed(glucoses: list[int], **raws: int) -> list[Turn]:
    bench = Bench(mode=S2, flash=calibration(**raws))
    bench.run(12)
    return [bench.step(glucose) for glucose in glucoses]


@pytest.mark.parametrize(("glucose", "stopped"), [(699, True), (700, False)])
def test_below_the_limit_nothing_is_given(glucose: int, stopped: bool) -> None:
    """After half an hour on one level the law alone asks for something again, so that only the limit can stop it."""
    turn = fed([glucose] * 16, CfgLowSuspend=700)[-1]
    other = fed([glucose] * 16, CfgLowSuspend=0)[-1]
    assert other.rate > 0
    assert (turn.rate == turn.command["PramlintideRate"] == 0) == stopped
    assert bool(turn.status["LimiterBits"] & 8) == stopped
    assert stopped or turn.rate == other.rate


def limits(low: int = 1300, rise: int = 100000) -> list[int]:
    """Parameters of the core with a schedule of 1 U/h, and only these limits within reach."""
    parameters = [0] * len(layout.PARAMETERS)
    parameters[layout.BASAL] = 1000
    for word in (layout.MAX_BASAL, layout.BASAL_FACTOR, layout.MAX_IOB):
        parameters[word] = 40000
    parameters[layout.LOW_SUSPEND], parameters[layout.MAX_RISE] = low, rise
    return parameters


def rate_of(parameters: list[int], state: list[int], demand: int, glucose: int = 1500) -> tuple[int, int]:
    """Rate and LimiterBits for a demand, both rates in 0.005 U/h."""
    inputs, outputs = [0] * len(layout.INPUTS), [0] * len(layout.OUTPUTS)
    inputs[layout.IN_GLUCOSE], inputs[layout.IN_INSULIN_LEFT] = glucose, 10**6
    return limit_rate(demand << 16, 0, state, parameters, inputs, outputs), outputs[layout.OUT_LIMITERS]


def followed(*glucoses: int) -> list[int]:
    """State of the core after these samples, -1 for a missing one."""
    state, inputs = [0] * len(layout.STATE), [0] * len(layout.INPUTS)
    for glucose in glucoses:
        inputs[layout.IN_GLUCOSE] = glucose
        follow_trend(state, inputs)
        if glucose >= 0:
            state[layout.GLUCOSE] = glucose
    return state


@pytest.mark.parametrize("slope", [1, 10, 20, 50, 200])
def test_a_line_that_crosses_the_limit_within_half_an_hour_keeps_to_the_schedule(slope: int) -> None:
    for above, expected in ((-1, (200, 8)), (0, (1000, 0)), (1, (1000, 0))):
        newest = 1300 + 6 * slope + above  # six steps are half an hour
        state = followed(newest + 2 * slope, newest + slope, newest)
        assert rate_of(limits(), state, 1000, newest) == expected
        state = followed(newest + 2 * slope, newest + slope, newest)
        assert rate_of(limits(), state, 150, newest) == (150, 0)  # what is below the schedule stays


def test_a_line_is_three_samples_in_a_row_and_a_gap_ends_it() -> None:
    row = [1700, 1600, 1500, 1400]
    for count in (1, 2, 3, 4):
        assert rate_of(limits(), followed(*row[:count]), 1000)[1] == (8 if count >= 3 else 0)
    assert rate_of(limits(), followed(1700, 1600, -1, 1500, 1400), 1000) == (1000, 0)
    assert rate_of(limits(), followed(1700, -1, 1600, 1500, 1400), 1000) == (200, 8)


def test_the_level_of_three_samples_counts_not_one_of_them() -> None:
    """The middle one moves the line by a third."""
    assert rate_of(limits(), followed(1500, 1475, 1450), 1000) == (1000, 0)
    assert rate_of(limits(), followed(1500, 1474, 1450), 1000) == (200, 8)


@pytest.mark.parametrize(("glucose", "expected"), [(1299, (0, 8)), (1300, (1000, 0))])
def test_a_sample_below_the_limit_stops_insulin_without_a_line(glucose: int, expected: tuple[int, int]) -> None:
    assert rate_of(limits(), followed(glucose), 1000, glucose) == expected
    assert rate_of(limits(), followed(glucose), 0, glucose) == (0, 0)  # nothing was cut


def test_the_rise_is_limited_to_the_unit_and_a_fall_is_not() -> None:
    state = followed(1500)
    state[layout.RATE] = 300
    assert rate_of(limits(rise=500), list(state), 400) == (400, 0)
    assert rate_of(limits(rise=500), list(state), 401) == (400, 128)
    assert rate_of(limits(rise=500), list(state), 0) == (0, 0)
    assert [rate_of(limits(rise=500), state, 1000)[0] for _ in range(4)] == [400, 500, 600, 700]
    assert rate_of(limits(rise=500), state, 0) == (0, 0)
    assert rate_of(limits(rise=500), state, 1000) == (100, 128)  # also from nothing up to the schedule
    assert rate_of(limits(rise=0), state, 1000) == (100, 128)


def test_insulin_rises_by_the_limit_and_not_more_and_falls_at_once() -> None:
    glucoses = [GLUCOSE, GLUCOSE + 500, GLUCOSE + 1000, GLUCOSE + 1500, GLUCOSE + 2000]
    limited, free = fed(glucoses, CfgMaxRise=500), fed(glucoses)
    assert [b.rate - a.rate for a, b in itertools.pairwise(limited)] == [100] * 4
    assert all(turn.status["LimiterBits"] & 128 for turn in limited[1:])
    assert all(turn.rate > other.rate for turn, other in zip(free[1:], limited[1:], strict=True))
    assert not any(turn.status["LimiterBits"] & 128 for turn in free)
    assert fed([*glucoses, GLUCOSE], CfgMaxRise=500)[-1].rate == 0


# ---- the ladder


QUIET = {"calibrated": True, "suspended": False, "age": 0, "streak": 2, "pump_age": 0}


def in_auto() -> Ladder:
    ladder = Ladder()
    assert ladder.update(**QUIET) == State.AUTO  # type: ignore[arg-type]
    return ladder


@pytest.mark.parametrize(
    ("fields", "state"),
    [
        ({"held": True}, State.SAFE_BASAL),
        ({"held": True, "uncertain": True}, State.DELIVERY_UNCERTAIN),
        ({"held": True, "pump_age": 3}, State.DELIVERY_UNCERTAIN),
        ({"held": True, "suspended": True}, State.SUSPENDED),
        ({"held": True, "calibrated": False}, State.INIT),
        ({"uncertain": True}, State.DELIVERY_UNCERTAIN),
        ({"uncertain": True, "suspended": True}, State.SUSPENDED),
        ({"pump_age": 2}, State.AUTO),
        ({"fault": True, "suspended": True, "uncertain": True, "calibrated": False}, State.FAULT),
    ],
)
def test_what_stands_above_what(fields: dict[str, bool | int], state: State) -> None:
    assert in_auto().update(**(QUIET | fields)) == state  # type: ignore[arg-type]


def test_uncertain_keeps_the_rung_and_returns_to_it_at_once() -> None:
    ladder = in_auto()
    ladder.update(**(QUIET | {"uncertain": True}))  # type: ignore[arg-type]
    assert ladder.rung == State.AUTO
    assert ladder.update(**QUIET) == State.AUTO  # type: ignore[arg-type]


def test_held_takes_the_ladder_to_its_foot_and_the_way_up_is_one_rung_at_a_time() -> None:
    ladder = in_auto()
    for _ in range(20):
        assert ladder.update(**(QUIET | {"held": True})) == State.SAFE_BASAL  # type: ignore[arg-type]
    up = [ladder.update(**QUIET) for _ in range(3)]  # type: ignore[arg-type]
    assert up == [State.DEGRADED, State.AUTO, State.AUTO]


def test_held_from_the_start_does_not_wait_for_samples() -> None:
    fields = QUIET | {"streak": 0, "age": 1 << 20, "held": True}
    assert Ladder().update(**fields) == State.SAFE_BASAL  # type: ignore[arg-type]


@pytest.mark.parametrize("limit", [1, 2, 3, 4, 5, 100])
def test_the_age_of_degraded_is_tightened_and_never_loosened(limit: int) -> None:
    for age in range(8):
        fields = QUIET | {"age": age, "streak": 0, "age_degraded": limit}
        expected = State.SAFE_BASAL if age >= 7 else State.DEGRADED if age >= min(limit, 4) else State.AUTO
        assert in_auto().update(**fields) == expected  # type: ignore[arg-type]


# ---- alarms


def test_instances_go_on_after_a_reset_and_wrap() -> None:
    alarms = Alarms()
    alarms.restore(iter([65534, 0]))
    alarms.hold(Code.CGM_LOST, True, 1)
    alarms.hold(Code.PUMP_LOST, True, 0x12345)
    listing = {alarm["code"]: alarm for alarm in alarms.listing()}
    assert listing["cgm_lost"]["instance"] == 65534
    assert listing["pump_lost"]["instance"] == 0
    assert listing["pump_lost"]["aux"] == 0x2345
    assert [alarm["code"] for alarm in alarms.listing()] == ["pump_lost", "cgm_lost"]
    other = Alarms()
    other.restore(iter(alarms.save()))
    assert not other.active(Code.CGM_LOST)  # a cause that still holds raises it anew
    assert other.save() == alarms.save() == [1, 1 << Code.CGM_LOST | 1 << Code.PUMP_LOST]
    other.hold(Code.CGM_LOST, True, 0)
    assert other.listing()[0]["instance"] == 1
    assert other.acknowledge(65534, confirm=True) is False


def test_a_reset_uses_no_instance_twice() -> None:
    memory = RamMemory(NVM_BYTES)
    bench = Bench(firmware=Firmware(memory))
    bench.run(5)
    (before,) = bench.step(540).alarms(Code.URGENT_LOW)
    firmware = Firmware(memory)
    assert firmware.start()
    bench.firmware, bench.receiver = firmware, Receiver(SENT_BY_CTRL)
    (after,) = bench.step(540).alarms(Code.URGENT_LOW)
    assert after["CtrlAlarmInstance"] > before["CtrlAlarmInstance"]


# ---- a set-point is always one the state allows


@given(
    st.lists(
        st.tuples(
            st.integers(400, 4000),
            st.sampled_from(["", "", "", "drop", "noise", "clean", "suspend", "resume", "blocked", "jump", "silent"]),
        ),
        max_size=40,
    )
)
def test_no_mix_of_troubles_is_answered_with_more_than_the_schedule(steps: list[tuple[int, str]]) -> None:
    bench, number, noisy = Bench(mode=S2), 0, False
    bench.run(4)
    for glucose, trouble in steps:
        also, time = [], bench.k * 300
        if trouble in ("noise", "clean"):
            noisy = trouble == "noise"
            also = [bench.frame("CGM_Status", **(SENSOR | {"CgmNoise": 60 * noisy}))]
        elif trouble in ("suspend", "resume"):
            number = (number + 1) % 255
            request = 1 if trouble == "suspend" else 2
            also = [bench.frame("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=number, SuspendRequest=request)]
        blocked = {"InsulinOcclusion": 2} if trouble == "blocked" else {}
        bench.give(
            *([] if trouble == "drop" else [bench.sample(glucose)]),
            *([] if trouble == "silent" else [bench.frame("PUMP_Status", **(USUAL | blocked)), bench.delivered()]),
            *also,
        )
        turn = bench.token(Phase.STEP, bench.k, time + (90 if trouble == "jump" else 0))
        bench.obey(turn)
        bench.k += 1
        op = turn.command["BasalOp"]
        assert (op == Op.SUSPEND) == (turn.state == State.SUSPENDED)
        if op == Op.SET_RATE and (noisy or trouble in ("blocked", "jump") or turn.state != State.AUTO):
            assert within_schedule(turn, bench)
