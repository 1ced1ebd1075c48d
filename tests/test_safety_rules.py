"""Rules of the supervisor that no other page covers: plausibility, caution, the pump's troubles, the clock."""

import itertools

import pytest
from bench import GLUCOSE, NMA, S2, Bench, calibration
from pumpbench.calibration import SAFE, calibrate

from firmware_sim.alarms import Code
from firmware_sim.cgm import Cgm
from firmware_sim.day import HOURS, STEPS_PER_HOUR, Day
from firmware_sim.ladder import State
from firmware_sim.meals import Meals
from plant_server.physiology import load_patient


def sample(k: int, glucose: int, state: int = 1) -> dict[str, int]:
    return {"CgmState": state, "GlucoseConc": glucose, "CgmSampleSeq": k, "CgmSampleStep": k % 256}


# ---- plausibility of samples


@pytest.mark.parametrize(("rise", "used"), [(500, True), (501, False), (-1000, True)])
def test_a_steep_rise_waits_and_a_fall_does_not(rise: int, used: bool) -> None:
    cgm = Cgm()
    cgm.judge([sample(0, 1500)], 0)
    assert (cgm.judge([sample(1, 1500 + rise)], 1).glucose >= 0) == used
    assert cgm.waiting != used


@pytest.mark.parametrize(("second", "used"), [(3000, True), (3500, True), (3501, False), (2501, True)])
def test_a_rise_is_believed_when_the_next_sample_agrees(second: int, used: bool) -> None:
    cgm = Cgm()
    cgm.judge([sample(0, 1500)], 0)
    assert cgm.judge([sample(1, 3000)], 1).glucose == -1
    assert (cgm.judge([sample(2, second)], 2).glucose == second) == used


def test_after_missing_samples_a_rise_may_be_as_much_higher() -> None:
    cgm = Cgm()
    cgm.judge([sample(0, 1500)], 0)
    assert cgm.judge([sample(3, 3000)], 3).glucose == 3000


def test_ten_equal_values_are_a_stuck_sensor_and_one_other_value_ends_it() -> None:
    cgm = Cgm()
    cgm.stuck_limit = 10
    verdicts = [cgm.judge([sample(k, 1500)], k).glucose for k in range(14)]
    assert verdicts == [1500] * 9 + [-1] * 5
    assert cgm.judge([sample(14, 1501)], 14).glucose == 1501


def test_a_limit_of_one_calls_every_value_stuck() -> None:
    cgm = Cgm()
    cgm.stuck_limit = 1
    assert [cgm.judge([sample(k, 1500 + k)], k).glucose for k in range(3)] == [-1] * 3


WARM_UP = 2
AGAIN = sample(0, 1500) | {"CgmSampleStep": 4}


@pytest.mark.parametrize(
    ("samples", "told"),
    [
        ([sample(1, 0, WARM_UP), sample(2, 0, WARM_UP), sample(3, 1500)], {"refused": 2, "glucose": 1500}),
        ([AGAIN, AGAIN, sample(1, 1510)], {"repeated": 2, "glucose": 1510}),
        ([sample(1, 3000), sample(2, 4500), sample(3, 1500)], {"refused": 2, "glucose": 1500}),  # two jumps
        ([sample(1, 1500), sample(2, 1500), sample(3, 1510)], {"refused": 1, "glucose": 1510}),  # the third in a row
        ([sample(2, 1510), sample(4, 1520)], {"missing": 2, "glucose": 1520}),
        ([sample(1, 0, WARM_UP), sample(3, 1510)], {"refused": 1, "missing": 1, "glucose": 1510}),
        ([sample(1, 3000), sample(2, 4500), sample(4, 1510)], {"refused": 2, "missing": 1, "glucose": 1510}),
    ],
)
def test_of_several_samples_in_a_step_each_is_counted_and_the_last_good_one_used(
    samples: list[dict[str, int]], told: dict[str, int]
) -> None:
    cgm = Cgm()
    cgm.stuck_limit = 3
    cgm.judge([sample(0, 1500)], 0)
    verdict = cgm.judge(samples, 4)
    counts = ("refused", "repeated", "missing", "glucose")
    assert {name: getattr(verdict, name) for name in counts} == dict.fromkeys(counts, 0) | told


@pytest.mark.parametrize("state", [4, 5])
def test_beyond_the_range_a_value_may_stay(state: int) -> None:
    cgm = Cgm()
    cgm.stuck_limit = 10
    verdicts = {cgm.judge([sample(k, 0, state)], k).glucose for k in range(30)}
    assert verdicts == {400 if state == 4 else 4000}


@pytest.mark.parametrize(
    ("fields", "cautious"),
    [
        ({"CgmNoise": 30}, False),
        ({"CgmNoise": 31}, True),
        ({"CgmNoise": 252}, True),
        ({"CgmNoise": 255}, False),
        ({"CgmFaultBits": 1}, True),
        ({"CgmFaultBits": 2}, True),
        ({"CgmFaultBits": 4}, False),
        ({"CgmFaultBits": 8}, True),
    ],
)
def test_a_sensor_that_doubts_itself_keeps_insulin_at_the_schedule(fields: dict[str, int], cautious: bool) -> None:
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 400)
    status = {"CgmFaultBits": 0, "CgmSessionId": 1, "CgmSensorAge": 10, "CgmNoise": 0, "CgmDropCount": 0, **fields}
    turn = bench.step(GLUCOSE + 450, also=[bench.frame("CGM_Status", **status)])
    assert (turn.rate <= bench.basal // 5) == cautious


def test_another_sensor_starts_trends_anew() -> None:
    cgm = Cgm()
    cgm.status({"CgmFaultBits": 0, "CgmNoise": 0, "CgmSessionId": 1})
    for k in range(5):
        cgm.judge([sample(k, 1500)], k)
    assert not cgm.settling
    cgm.status({"CgmFaultBits": 0, "CgmNoise": 0, "CgmSessionId": 1})
    assert not cgm.settling
    cgm.status({"CgmFaultBits": 0, "CgmNoise": 0, "CgmSessionId": 2})
    assert cgm.settling
    assert cgm.judge([sample(5, 3000)], 5).glucose == 3000  # no rise of the old sensor's


# ---- clock, low glucose, user


@pytest.mark.parametrize(("off", "cautious"), [(60, False), (61, True), (-60, False), (-61, True), (3600, True)])
def test_a_jump_of_the_clock_is_told_and_holds_insulin_at_the_schedule(off: int, cautious: bool) -> None:
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 400)
    bench.give(bench.sample(GLUCOSE + 400), bench.status(), bench.delivered())
    turn = bench.token(1, bench.k, bench.k * 300 + off)
    bench.obey(turn)
    bench.k += 1
    assert bool(turn.alarms(Code.CLOCK_JUMP)) == cautious
    rates = [turn.rate, *(bench.step(GLUCOSE + 400).rate for _ in range(3))]
    assert [rate <= bench.basal // 5 for rate in rates] == [cautious] * 3 + [False]


@pytest.mark.parametrize(("glucose", "urgent"), [(549, True), (550, False)])
@pytest.mark.parametrize("suspended", [False, True])
def test_urgent_low_is_told_in_every_state(glucose: int, urgent: bool, suspended: bool) -> None:
    bench = Bench(mode=NMA)
    bench.run(5)
    if suspended:
        bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=1)
    turn = bench.step(glucose)
    assert (turn.state == State.SUSPENDED) == suspended
    assert bool(turn.alarms(Code.URGENT_LOW)) == urgent


def test_suspending_and_resuming_are_told_in_the_same_step() -> None:
    bench = Bench(mode=NMA)
    bench.run(5)
    for request, number in ((1, 1), (2, 2)):
        bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=number, SuspendRequest=request)
        turn = bench.step()
        assert [alarm["CtrlAlarmAux"] for alarm in turn.alarms(Code.STATE_CHANGE)] == [turn.state]
        bench.run(8)


@pytest.mark.parametrize(("minutes", "degraded_at"), [(0, 1), (5, 2), (10, 3), (15, 4), (120, 4)])
def test_the_stale_limit_can_only_be_tightened(minutes: int, degraded_at: int) -> None:
    bench = Bench(flash=calibration(CfgStaleCgmLimit=minutes))
    bench.run(10)
    states = [bench.step(drop=True).state for _ in range(5)]
    assert states.index(State.DEGRADED) == degraded_at - 1


# ---- the tight limits of a product


@pytest.fixture
def safe() -> Bench:
    bench = Bench(mode=S2, flash=calibrate(load_patient("adult#001"), SAFE))
    for k in range(12):
        bench.step(GLUCOSE + k % 2)  # no value twice: the sensor is not stuck
    return bench


def test_below_the_limit_insulin_stops_at_once_and_predicted_below_it_stays_at_the_schedule(safe: Bench) -> None:
    rates = {glucose: safe.step(glucose) for glucose in range(1180, 640, -20)}
    assert all(turn.rate == 0 == turn.command["PramlintideRate"] for glucose, turn in rates.items() if glucose < 700)
    assert rates[700].rate <= safe.basal // 5


def test_a_low_that_stays_keeps_insulin_off_where_the_law_alone_would_give_some(safe: Bench) -> None:
    loose = Bench(mode=S2)
    loose.run(12)
    for k in range(12):
        turn, other = safe.step(690 + k % 2), loose.step(690 + k % 2)
    assert turn.rate == 0 < other.rate
    assert turn.status["LimiterBits"] & 8


def test_insulin_rises_by_at_most_2_u_per_h_and_falls_at_once(safe: Bench) -> None:
    rates = [safe.step(GLUCOSE + 450 + 30 * k).rate for k in range(8)]
    assert all(b - a <= 400 for a, b in itertools.pairwise(rates))
    assert max(rates) <= 4 * safe.basal // 5
    assert safe.step(650).rate == 0


# ---- the pump's troubles


@pytest.mark.parametrize(
    ("fields", "insulin_blocked", "pram_blocked"),
    [
        ({"InsulinOcclusion": 2}, True, True),
        ({"InsulinReservoir": 0}, True, True),
        ({"PumpState": 5}, True, True),
        ({"PramOcclusion": 2}, False, True),
        ({"PramReservoir": 0}, False, True),
        ({"InsulinOcclusion": 1, "PramOcclusion": 1}, False, False),
    ],
)
def test_a_fault_of_pramlintide_never_stops_insulin(
    fields: dict[str, int], insulin_blocked: bool, pram_blocked: bool
) -> None:
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 400)
    usual = {"PumpState": 3, "InsulinReservoir": 2000, "PramReservoir": 2000, "PumpBattery": 90}
    turn = bench.step(GLUCOSE + 450, status=False, also=[bench.frame("PUMP_Status", **(usual | fields))])
    assert (turn.rate <= bench.basal // 5) == insulin_blocked
    assert (turn.command["PramlintideRate"] == 0) == pram_blocked


def test_a_pump_that_runs_another_set_point_is_told() -> None:
    bench = Bench(mode=S2)
    usual = {"PumpState": 3, "InsulinReservoir": 2000, "PramReservoir": 2000, "PumpBattery": 90}
    told = []
    for k in range(10):
        shown = bench.firmware._pump._sequence if k < 6 else 1000  # type: ignore[attr-defined]
        status = bench.frame("PUMP_Status", PumpLastBasalSeq=shown, **usual)
        told.append(bool(bench.step(status=False, also=[status]).alarms(Code.DELIVERY_UNCERTAIN)))
    assert told == [False] * 7 + [True] * 3


def test_rates_stay_within_what_the_pump_last_accepted() -> None:
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 400)
    number = bench.firmware._pump._sequence  # type: ignore[attr-defined]
    ack = bench.frame("PUMP_Ack", AckFor=1, AckResult=3, AckId=number, AckEchoRaw=900, AckLimitRaw=300)
    assert bench.step(GLUCOSE + 450, also=[ack]).rate == 300


def test_a_limit_of_the_pump_holds_until_the_pump_takes_it_back() -> None:
    """And both drugs keep their ratio, down to nothing of either (requirements CMD-07, TWO-01, TWO-02)."""
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 400)
    pump = bench.firmware._pump  # type: ignore[attr-defined]

    def ack(result: int, limit: int) -> list:
        asked = {"AckId": pump._sequence, "AckEchoRaw": pump._rates[1]}
        return [
            bench.frame("PUMP_Ack", AckFor=1, AckResult=result, AckLimitRaw=limit, **asked),
            bench.frame("PUMP_Ack", AckFor=8, AckResult=0, AckLimitRaw=3000, **asked),
        ]

    turn = bench.step(GLUCOSE + 450, also=ack(3, 0))
    assert (turn.rate, turn.command["PramlintideRate"]) == (0, 0)
    assert turn.status["LimiterBits"] & 1
    turn = bench.step(GLUCOSE + 460, also=ack(0, 0))
    assert turn.rate == 0
    turn = bench.step(GLUCOSE + 470, also=ack(0, 200))
    assert turn.rate == 200
    assert abs(turn.command["PramlintideRate"] - 100) <= 1  # 10 ug/U
    assert bench.step(GLUCOSE + 480, also=ack(0, 6000)).rate > 300


def test_a_skipped_step_does_not_stop_insulin() -> None:
    """What is caught up knows how much the day leaves (requirement TIM-02)."""
    bench = Bench(mode=NMA)
    bench.run(20, GLUCOSE + 100)
    bench.k += 1
    bench.total += bench.basal
    assert bench.step(cgm=()).rate == bench.basal // 5


def test_resuming_soon_after_a_confirmed_suspension_is_told() -> None:
    bench = Bench(mode=NMA)
    bench.run(5)
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=1, SuspendRequest=1)
    (alarm,) = bench.step().alarms(Code.STATE_CHANGE)
    bench.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=1, AlarmAckInstance=alarm["CtrlAlarmInstance"])
    bench.step()
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=2, SuspendRequest=2)
    assert [alarm["CtrlAlarmState"] for alarm in bench.step().alarms(Code.STATE_CHANGE)] == [1]


# ---- meals and days


def announced(number: int, kind: int = 1, carbs: int = 80, offset: int = 0) -> dict[str, int]:
    return {"MealId": number, "MealKind": kind, "CarbsEst": carbs, "MealOffset": offset}


def test_a_meal_is_taken_once_and_an_older_one_never() -> None:
    meals = Meals()
    for number, taken in ((250, True), (250, False), (249, False), (3, True), (254, False), (100, True)):
        meals.hear(announced(number))
        assert (meals.take() != (0, 0)) == taken, number
    assert meals.repeated == 2
    assert meals.last == 100


@pytest.mark.parametrize(
    ("meal", "taken", "refused"),
    [
        (announced(1, 1, 300), (1, 300), False),
        (announced(1, 1, 301), (0, 0), True),
        (announced(1, 1, 1023), (0, 0), True),
        (announced(1, 2, 1023), (2, 0), False),
        (announced(1, 3, 30), (3, 30), False),
        (announced(1, 4, 30), (0, 0), False),
        (announced(1, 5, 30), (0, 0), False),
        (announced(1, 0, 30), (0, 0), True),
        (announced(1, 6, 30), (0, 0), True),
        (announced(1, 1, 80, 60), (1, 80), False),
        (announced(1, 1, 80, 61), (0, 0), True),
        (announced(1, 1, 80, -128), (0, 0), True),
    ],
)
def test_what_counts_as_a_meal(meal: dict[str, int], taken: tuple[int, int], refused: bool) -> None:
    meals = Meals()
    meals.hear(meal)
    assert (meals.take(), meals.refused, meals.last) == (taken, refused, 1)


def test_a_day_forgets_by_the_hour_and_never_too_early() -> None:
    day, given = Day(), []
    for step in [*range(0, 900, 7), 1500, 1501, 9000]:
        day.add(step % 13, step)
        given.append((step, step % 13))
        hour = step // STEPS_PER_HOUR
        assert day.total == sum(amount for at, amount in given if hour - at // STEPS_PER_HOUR < HOURS)
    other = Day()
    other.restore(iter(day.save()))
    assert other.total == day.total


# ---- alarms that last


@pytest.mark.parametrize("action", [1, 2])
def test_an_alarm_whose_cause_stays_comes_back_half_an_hour_after_it_was_confirmed(action: int) -> None:
    """Requirement ALM-04: neither confirming nor snoozing removes the cause."""
    bench = Bench(mode=NMA)
    bench.run(5)
    for _ in range(4):
        turn = bench.step(drop=True)
    (alarm,) = turn.alarms(Code.CGM_LOST)
    number = alarm["CtrlAlarmInstance"]
    bench.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=action, AlarmAckInstance=number)
    states = []
    for _ in range(9):
        told = bench.step(drop=True).alarms(Code.CGM_LOST)
        states.append(told[0]["CtrlAlarmState"] if told else None)
        assert not told or told[0]["CtrlAlarmInstance"] == number
    pending = states.index(1)
    assert pending == 6
    assert states[pending:] == [1] * (9 - pending)
