"""Boluses end to end: both sides of the protocol, over a wire that fails, with power that fails."""

import random
from collections.abc import Sequence

import pytest
from bench import SENT_BY_CTRL
from pair import TOKENS, Pair, Values
from pumpbench.calibration import MODES, Tuning

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from firmware_sim.alarms import Code
from firmware_sim.control import layout
from firmware_sim.ladder import State

INSULIN, PRAMLINTIDE = 1, 2
PROGRAM, COMMIT, CANCEL = 1, 2, 3

MEAL = [(20, 60.0)]
DOSE = int(0.8 * 60 / 12.3 * 100)
"""0.01 U: nu CHO / CIR of adult#001."""


def dose_of(pair: Pair) -> int:
    (dose,) = pair.commits(INSULIN).values()
    return dose


# ---- the normal way


@pytest.mark.parametrize("strategy", ["ma", "s3"])
def test_a_meal_is_one_bolus_programmed_echoed_and_committed_in_its_own_step(strategy: str) -> None:
    pair = Pair(strategy, MEAL).play()
    told = [(step, values["BolusOp"]) for step, name, values in pair.heard if name == "PUMP_BolusCmd"]
    drugs = 2 if strategy == "s3" else 1
    assert told == [(20, PROGRAM)] * drugs + [(20, COMMIT)] * drugs
    assert dose_of(pair) == pytest.approx(DOSE, abs=2)
    assert pair.bolus_strokes(INSULIN) == dose_of(pair) // 5
    assert pair.bolus_strokes(PRAMLINTIDE) == (30 if strategy == "s3" else 0)  # 15 ug
    assert len(pair.all("MEAL_Announce")) == 1  # echoed at once
    assert pair.ledgers_close()
    assert not pair.alarms(Code.DELIVERY_UNCERTAIN)


@pytest.mark.parametrize("strategy", MODES)
def test_which_modes_give_which_boluses(strategy: str) -> None:
    """Requirement TWO-03, and strategy 4's ratio on the bolus."""
    pair = Pair(strategy, MEAL, steps=24).play()
    assert bool(pair.commits(INSULIN)) == (strategy in ("ma", "sma", "s3", "s4"))
    assert bool(pair.commits(PRAMLINTIDE)) == (strategy in ("s3", "s4"))
    if strategy == "s4":
        assert list(pair.commits(PRAMLINTIDE).values()) == [dose_of(pair) * 10 // 10]  # 10 ug/U


def test_strategy_1_gives_its_bolus_at_the_peak_of_the_infusion() -> None:
    pair = Pair("s1", [(20, 90.0)], steps=60).play()
    (dose,) = pair.commits(PRAMLINTIDE).values()
    assert dose == 300
    rates = {step: values["InsulinRate"] for step, name, values in pair.heard if name == "PUMP_BasalCmd"}
    (at,) = {step for step, name, _ in pair.heard if name == "PUMP_BolusCmd"}
    assert rates[at] < rates[at - 1] > rates[at - 2]
    assert rates[at] > 2 * 285


def test_insulin_on_board_rises_by_the_bolus_and_never_counts_it_twice() -> None:
    pair = Pair("ma", MEAL).play()
    iob = pair.iob()
    assert iob[20] - iob[19] == pytest.approx(dose_of(pair), abs=20)
    assert max(iob) <= iob[19] + dose_of(pair) * 5 // 4  # the rest is the feedback's


def test_the_feedback_leaves_out_what_the_bolus_has_given() -> None:
    """Non-interaction: with it the meal gets less insulin in all than without."""
    totals = []
    for deduction in (0.85, 0.0):
        pair = Pair("ma", MEAL, steps=80, tuning=Tuning(bolus_deduction=deduction)).play()
        totals.append(pair.all("PUMP_Delivered")[-1]["InsulinTotal"])
    assert totals[1] - totals[0] > 1000  # mU


# ---- limits


def test_a_bolus_is_cut_at_its_largest_and_says_so() -> None:
    pair = Pair("ma", MEAL, steps=24, tuning=Tuning(max_bolus=2.0)).play()
    assert dose_of(pair) == 200
    assert any(values["LimiterBits"] & 2 for values in pair.all("CTRL_Status"))
    assert pair.alarms(Code.DOSE_LIMITED)


def test_insulin_on_board_is_kept_below_its_limit() -> None:
    meals = [(20, 60.0), (21, 60.0), (22, 60.0), (23, 60.0), (24, 60.0)]
    pair = Pair("ma", meals, steps=60, tuning=Tuning(max_iob=6.0)).play()
    assert max(pair.iob()) <= 600
    assert any(values["LimiterBits"] & 4 for values in pair.all("CTRL_Status"))


def test_two_meals_in_one_step_are_one_bolus_with_the_lockout_of_a_product() -> None:
    pair = Pair("s3", [(20, 40.0), (20, 30.0)], steps=40, tuning=Tuning(bolus_lockout=3)).play()
    assert len(pair.commits(INSULIN)) == len(pair.commits(PRAMLINTIDE)) == 1
    assert any(values["LimiterBits"] & 32 for values in pair.all("CTRL_Status"))
    assert pair.alarms(Code.DOSE_REJECTED)


def test_no_more_than_twice_the_daily_dose_in_a_day() -> None:
    meals = [(10 + 6 * k, 140.0) for k in range(20)]
    pair = Pair("ma", meals, steps=290, tuning=Tuning(max_iob=40.0)).play()
    limit = 2 * 24 * 1.425 * 2 * 1000
    assert pair.all("PUMP_Delivered")[-1]["InsulinTotal"] <= limit
    assert any(values["LimiterBits"] & 64 for values in pair.all("CTRL_Status"))


def test_a_refused_meal_gives_neither_drug() -> None:
    """The estimate is above 150 g (requirements CMD-10, USR-02)."""
    pair = Pair("s3", [(20, 200.0)], steps=30).play()
    assert not pair.all("PUMP_BolusCmd")
    assert pair.alarms(Code.DOSE_REJECTED)
    assert len(pair.all("MEAL_Announce")) == 1  # heard and refused, not ignored


def test_the_pumps_own_limit_is_respected() -> None:
    """Its refusal ends the meal's other drug too, and the next bolus is within it (requirement CMD-07)."""
    pair = Pair("s3", [(20, 60.0), (30, 60.0)], steps=40)
    pair.plant.pump.boluses[INSULIN].max_raw = 200
    pair.play()
    assert list(pair.commits(INSULIN).values()) == [200]
    assert len(pair.commits(PRAMLINTIDE)) == 1
    assert pair.alarms(Code.DOSE_REJECTED)


def test_suspending_cancels_a_bolus_under_way_in_the_same_step() -> None:
    """Requirement FAL-05: 9.7 U take more than a step; what is left of them at the suspension is never given."""
    pair = Pair("ma", [(20, 149.0)], steps=40)
    sent: list[int] = []

    def wire(name: str, _values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name == "SYNC_Step" and pair.plant.step == 21 and not sent:
            sent.append(21)
            suspend = pair.plant._transmitter.frame("MODE_Cmd", ModeRequest=MODES["ma"], ModeCmdSeq=1, SuspendRequest=1)
            return [suspend, frame]
        return None

    pair.to_device = wire
    pair.play()
    cancels = [step for step, name, values in pair.heard if name == "PUMP_BolusCmd" and values["BolusOp"] == CANCEL]
    assert set(cancels) == {21}
    last = [values for values in pair.all("PUMP_BolusState") if values["BolusStateHormone"] == INSULIN][-1]
    assert 0 < last["BolusDeliveredRaw"] < last["BolusProgrammedRaw"]
    assert not pair.alarms(Code.DELIVERY_UNCERTAIN)
    assert pair.states()[-1] == State.SUSPENDED
    assert pair.ledgers_close()


# ---- a wire that fails


def lose(pair: Pair, message: str, count: int) -> None:
    """The next frames of one message, from step 20 on, do not arrive."""
    left = [count]

    def wire(name: str, _values: Values, _frame: Frame) -> Sequence[Frame] | None:
        if name == message and pair.plant.step >= 20 and left[0] > 0:
            left[0] -= 1
            return ()
        return None

    pair.to_device = pair.to_plant = wire


@pytest.mark.parametrize("lost", [1, 2])
@pytest.mark.parametrize("message", ["PUMP_BolusCmd", "PUMP_Ack"])
def test_a_lost_frame_is_said_again_with_the_same_id_and_the_bolus_is_given_once(message: str, lost: int) -> None:
    pair = Pair("ma", MEAL)
    lose(pair, message, lost)
    pair.play()
    assert len(pair.commits(INSULIN)) == 1
    assert pair.bolus_strokes(INSULIN) == dose_of(pair) // 5
    payloads = {
        (values["BolusOp"], values["BolusId"], values["InsulinBolus"], values["BolusUntilStep"])
        for values in pair.all("PUMP_BolusCmd")
    }
    assert len(payloads) == 2


def test_no_answer_is_uncertain_until_the_pump_tells() -> None:
    """Commit arrives, its acknowledgements do not (requirements CMD-05, CMD-06)."""
    pair = Pair("ma", [(20, 60.0), (21, 30.0)], steps=40)

    def wire(name: str, values: Values, _frame: Frame) -> Sequence[Frame] | None:
        return () if name == "PUMP_Ack" and values["AckFor"] == 3 and pair.plant.step == 20 else None

    pair.to_device = wire
    pair.play()
    first = next(iter(pair.commits(INSULIN).values()))
    assert pair.iob()[20] - pair.iob()[19] >= first - 20  # counted in full while nobody knows
    assert pair.alarms(Code.DELIVERY_UNCERTAIN)
    sent = [values for values in pair.all("PUMP_BolusCmd") if values["BolusOp"] == COMMIT]
    assert [values["BolusId"] for values in sent[:3]] == [0, 0, 0]
    assert pair.bolus_strokes(INSULIN) == sum(dose // 5 for dose in pair.commits(INSULIN).values())


def test_while_uncertain_nothing_more_is_programmed() -> None:
    pair = Pair("ma", [(20, 60.0), (22, 60.0), (24, 60.0)], steps=40)

    def wire(name: str, _values: Values, _frame: Frame) -> Sequence[Frame] | None:
        return () if name in ("PUMP_Ack", "PUMP_BolusState") and 20 <= pair.plant.step < 28 else None

    pair.to_device = wire
    pair.play()
    assert {values["BolusId"] for values in pair.all("PUMP_BolusCmd")} == {0}
    assert State.DELIVERY_UNCERTAIN in pair.states()
    assert pair.states()[-1] == State.AUTO  # and the way back up


@pytest.mark.parametrize("change", [-1, 1])
def test_a_wrong_echo_is_cancelled_not_committed(change: int) -> None:
    """The pump understood another dose than was sent (requirement CMD-01)."""
    pair = Pair("ma", MEAL)
    transmitter = codec.Transmitter()

    def wire(name: str, values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name != "PUMP_Ack" or values["AckFor"] != 2:
            return None
        wrong = {**values, "AckEchoRaw": values["AckEchoRaw"] + change}
        transmitter.counters["PUMP_Ack"] = wrong.pop("COUNTER", frame.data[1] & 0xF)
        wrong.pop("CHECKSUM", None)
        return [transmitter.frame("PUMP_Ack", **wrong)]

    pair.to_device = wire
    pair.play()
    assert [values["BolusOp"] for values in pair.all("PUMP_BolusCmd")] == [PROGRAM, CANCEL]
    assert pair.bolus_strokes(INSULIN) == 0
    assert pair.alarms(Code.DOSE_REJECTED)


@pytest.mark.parametrize("seed", range(12))
def test_no_mix_of_lost_doubled_and_late_frames_makes_one_bolus_two(seed: int) -> None:
    draw = random.Random(seed)
    pair = Pair("s3", [(14, 50.0), (24, 30.0), (25, 60.0), (40, 20.0)], steps=70)
    late: list[tuple[int, str, Frame]] = []

    def wire(name: str, _values: Values, frame: Frame) -> Sequence[Frame] | None:
        to_device = name in ("PUMP_Ack", "PUMP_BolusState", "PUMP_Delivered", "PUMP_Status", "MEAL_Announce")
        if name in TOKENS or not (to_device or name in ("PUMP_BolusCmd", "PUMP_BasalCmd")):
            return None
        due = [held for at, said, held in late if at <= pair.plant.step and said == name]
        late[:] = [each for each in late if not (each[0] <= pair.plant.step and each[1] == name)]
        fate = draw.random()
        if fate < 0.2:
            return due
        if fate < 0.3:
            return [frame, frame, *due]
        if fate < 0.4:
            late.append((pair.plant.step + draw.randint(0, 3), name, frame))
            return due
        return [frame, *due]

    pair.to_device = pair.to_plant = wire
    pair.play()
    for drug in (INSULIN, PRAMLINTIDE):
        assert pair.bolus_strokes(drug) <= sum(dose // 5 for dose in pair.commits(drug).values())
    for values in pair.all("PUMP_BolusState"):
        assert values["BolusDeliveredRaw"] <= values["BolusProgrammedRaw"]
    assert pair.ledgers_close()


# ---- power that fails


def check_after_a_cut(pair: Pair) -> None:
    """One meal, one bolus of each drug at most, every stroke accounted for, and the firmware back at work."""
    for drug in (INSULIN, PRAMLINTIDE):
        assert len(pair.commits(drug)) <= 1
        assert pair.bolus_strokes(drug) <= sum(dose // 5 for dose in pair.commits(drug).values())
    assert pair.ledgers_close()
    assert pair.states()[-1] == State.AUTO
    assert pair.alarms(Code.NODE_RESET)
    told = [values["LastMealId"] for values in pair.all("CTRL_Status")]
    assert told[-1] == 0


def frames_of_the_meal() -> range:
    """Numbers of the frames that reach the device from the meal's step to the one after."""
    pair = Pair("s3", [(6, 60.0)], steps=9)
    numbers = []

    def wire(_name: str, _values: Values, _frame: Frame) -> None:
        if 6 <= pair.plant.step <= 7:
            numbers.append(pair.frames_in)

    pair.to_device = wire
    pair.play()
    return range(numbers[0], numbers[-1] + 1)


def test_a_cut_at_every_frame_around_a_bolus() -> None:
    numbers = frames_of_the_meal()
    assert len(numbers) > 20
    for number in numbers:
        pair = Pair("s3", [(6, 60.0)], steps=16)
        pair.cut_at_frame = number
        pair.play()
        assert pair.boots == 1
        check_after_a_cut(pair)


def test_a_cut_at_every_write_to_the_memory_around_a_bolus() -> None:
    """The bytes at which the supply fails go through the step with the meal: every write, and inside of writes."""
    probe = Pair("s3", [(6, 60.0)], steps=9)
    marks: list[int] = []

    def wire(_name: str, _values: Values, _frame: Frame) -> None:
        if probe.plant.step in (6, 8) and len(marks) < (1 if probe.plant.step == 6 else 2):
            marks.append(probe.memory.bytes_written)

    probe.to_device = wire
    probe.play()
    first, last = marks
    assert last - first > 2000
    for count in range(first, last, 61):
        pair = Pair("s3", [(6, 60.0)], steps=16)
        pair.memory.power_fails_after(count)
        pair.play()
        assert pair.boots == 1
        check_after_a_cut(pair)


def test_what_survives_a_reset() -> None:
    """Insulin on board, mode, numbers and the meal: as if nothing had happened, but for the pause (RST-01)."""
    pair = Pair("s3", MEAL, steps=60)
    twin = Pair("s3", MEAL, steps=60).play()

    def wire(name: str, _values: Values, _frame: Frame) -> None:
        if name == "PUMP_Status" and pair.plant.step == 24 and not pair.boots:
            pair.cut_at_frame = pair.frames_in

    pair.to_device = wire
    pair.play()
    assert pair.boots == 1
    for step in range(25, 30):
        assert pair.iob()[step] == pytest.approx(twin.iob()[step], abs=40)
        assert pair.iob()[step] > 200
    assert {values["CtrlMode"] for values in pair.all("CTRL_Status")} == {MODES["s3"]}
    numbers = [values["BasalCmdSeq"] for values in pair.all("PUMP_BasalCmd")]
    assert len(set(numbers)) == len(numbers)


def test_a_reset_pump_voids_what_was_programmed_and_totals_start_anew() -> None:
    """Requirements RST-05 and LED-03: the insulin on board does not fall with the totals."""
    pair = Pair("ma", MEAL, steps=50)
    resets: list[int] = []

    def wire(name: str, _values: Values, _frame: Frame) -> None:
        if name == "SYNC_Step" and pair.plant.step == 23 and not resets:
            resets.append(23)
            pair.plant.pump.reset()

    pair.to_device = wire
    pair.play()
    assert pair.all("PUMP_Delivered")[-1]["PumpBootCount"] == 1
    iob = pair.iob()
    assert iob[24] > iob[22] - 60
    assert pair.states()[-1] == State.AUTO


def test_five_resets_in_an_hour_hold_the_schedule() -> None:
    """Until the user resumes (requirement RST-04)."""
    pair = Pair("nma", steps=40)

    def wire(name: str, _values: Values, _frame: Frame) -> None:
        if name == "PUMP_Status" and 10 <= pair.plant.step < 15 and pair.boots < pair.plant.step - 9:
            pair.cut_at_frame = pair.frames_in

    pair.to_device = wire
    pair.play()
    assert pair.boots == 5
    assert set(pair.states()[-20:]) == {State.SAFE_BASAL}


def test_a_pump_that_accepts_no_bolus_at_all_is_asked_once_and_then_told_as_limited() -> None:
    pair = Pair("ma", meals=[(10, 60.0), (30, 60.0)], steps=40)
    pair.plant.pump.boluses[INSULIN].max_raw = 0
    pair.play()
    programs = [values for values in pair.all("PUMP_BolusCmd") if values["BolusOp"] == 1]
    assert {values["BolusId"] for values in programs} == {0}
    assert pair.commits(INSULIN) == {}
    limiters = [values["LimiterBits"] for values in pair.all("CTRL_Status")]
    assert limiters[30] & layout.LIMITER_MAX_BOLUS
    assert pair.alarms(Code.DOSE_LIMITED) and pair.ledgers_close()


@pytest.mark.parametrize("name", [name for name in SENT_BY_CTRL if name != "SYNC_Done"])
def test_while_somebody_sends_in_its_place_no_bolus_is_given(name: str) -> None:
    """Requirement E2E-05: a node never hears itself, so a frame with an id of its own is somebody else's."""
    pair = Pair("ma", meals=[(10, 60.0), (13, 60.0)], steps=16)
    forged = Transmitter().frame(name)
    pair.to_device = lambda name, _, frame: [forged, frame] if name == "CGM_Reading" and pair.plant.step == 10 else None
    pair.play()
    steps = [step for step, said, values in pair.heard if said == "PUMP_BolusCmd" and values["BolusOp"] == 2]
    assert set(steps) == {13}
    assert [values["E2eErrorCount"] for values in pair.all("CTRL_Diag")][9:12] == [0, 1, 1]
    assert {values["CtrlAlarmState"] for values in pair.alarms(Code.E2E_FAULT)} >= {1}
    assert pair.alarms(Code.DOSE_REJECTED)


def test_a_bolus_stays_on_board_although_the_total_that_holds_it_is_lost() -> None:
    """PUMP_BolusState settles the bolus in a step whose PUMP_Delivered never came (found by hostile sequences)."""
    pair = Pair("ma", meals=[(10, 60.0)], steps=16)
    pair.to_device = lambda name, *_: [] if name == "PUMP_Delivered" and pair.plant.step == 11 else None
    pair.play()
    (dose,) = pair.commits(INSULIN).values()
    assert all(iob > 0.85 * dose for iob in pair.iob()[10:14])
