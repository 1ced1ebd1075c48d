"""The firmware's side of the bolus protocol by itself: what is said, how often, and what each answer makes of it."""

from typing import Any

import pytest

from firmware_sim.bolus import EXPIRES_AFTER, SENDS, STROKE, Boluses, Drug, Op, Phase
from firmware_sim.pump import accepted_limit

INSULIN, PRAMLINTIDE = Drug.INSULIN, Drug.PRAMLINTIDE
ACCEPTED, DUPLICATE, EXPIRED, OVER_LIMIT, WRONG_STATE, BUSY, MALFORMED = 0, 1, 2, 3, 4, 5, 7


class Talk:
    """Boluses and what they say; the answers are the test's."""

    def __init__(self, *doses: tuple[Drug, int], step: int = 10) -> None:
        self.boluses = Boluses()
        self.said: list[tuple[Drug, Op, int, int]] = []
        self.step = step
        self.tell_idle()
        self.boluses.open_step(step)
        for drug, dose in doses:
            self.boluses.start(drug, dose, step)

    def send(self, _name: str, **values: int) -> None:
        dose = values["InsulinBolus" if values["BolusHormone"] == INSULIN else "PramlintideBolus"]
        self.said.append((Drug(values["BolusHormone"]), Op(values["BolusOp"]), values["BolusId"], dose))

    def speak(self) -> list[tuple[Drug, Op]]:
        """What is said in this turn."""
        self.said.clear()
        assert self.boluses.speak(self) == bool(self.said)  # type: ignore[arg-type]
        return [(drug, op) for drug, op, _, _ in self.said]

    def ack(self, drug: Drug, op: Op, result: int = ACCEPTED, *, echo: int | None = None, **fields: int) -> None:
        purpose = 6 if op == Op.CANCEL else {INSULIN: 1, PRAMLINTIDE: 3}[drug] + op
        bolus = self.boluses._open[drug]
        known = {"AckId": bolus.number, "AckEchoRaw": bolus.dose if echo is None else echo, "AckLimitRaw": 4000}
        self.boluses.hear_ack({"AckFor": purpose, "AckResult": result} | known | fields)

    def tell(self, drug: Drug, phase: Phase, number: int = 65535, delivered: int = 0) -> None:
        values = {"BolusStateHormone": drug, "BolusPhase": phase, "BolusStateId": number}
        self.boluses.hear_state(values | {"BolusDeliveredRaw": delivered})

    def tell_idle(self) -> None:
        for drug in Drug:
            self.tell(drug, Phase.IDLE)

    def next(self) -> list[tuple[Drug, int]]:
        self.step += 1
        return self.boluses.open_step(self.step)


def test_program_then_commit_then_nothing() -> None:
    talk = Talk((INSULIN, 250))
    assert talk.speak() == [(INSULIN, Op.PROGRAM)]
    assert talk.said[0][2:] == (0, 250)
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.boluses.remaining(INSULIN) == 0  # nothing is committed yet
    assert talk.speak() == [(INSULIN, Op.COMMIT)]
    assert talk.boluses.remaining(INSULIN) == 250
    talk.ack(INSULIN, Op.COMMIT)
    talk.boluses.listen()
    assert talk.speak() == []
    assert not talk.boluses.ready(INSULIN)
    assert talk.boluses.ready(PRAMLINTIDE)
    assert talk.boluses.refused == 0


@pytest.mark.parametrize("stage", [Op.PROGRAM, Op.COMMIT])
def test_each_stage_is_said_three_times_and_then_uncertain(stage: Op) -> None:
    talk = Talk((INSULIN, 250))
    if stage == Op.COMMIT:
        talk.speak()
        talk.ack(INSULIN, Op.PROGRAM)
        talk.boluses.listen()
    for _ in range(SENDS):
        assert not talk.boluses.uncertain
        assert talk.speak() == [(INSULIN, stage)]
        talk.boluses.listen()
    assert talk.boluses.uncertain
    assert talk.speak() == []
    assert talk.boluses.remaining(INSULIN) == (250 if stage == Op.COMMIT else 0)
    assert not talk.boluses.ready(PRAMLINTIDE)


@pytest.mark.parametrize("result", [EXPIRED, OVER_LIMIT, WRONG_STATE, BUSY, MALFORMED])
@pytest.mark.parametrize("stage", [Op.PROGRAM, Op.COMMIT])
def test_a_refusal_ends_it_and_counts_once(stage: Op, result: int) -> None:
    talk = Talk((INSULIN, 250))
    for number in range(1, 4):
        talk.speak()
        if stage == Op.COMMIT:
            talk.ack(INSULIN, Op.PROGRAM)
            talk.boluses.listen()
            talk.speak()
        talk.ack(INSULIN, stage, result)
        talk.boluses.listen()
        assert talk.boluses.refused == number
        assert talk.boluses.ready(INSULIN)
        talk.boluses.start(INSULIN, 250, talk.step)


def test_a_wrong_echo_is_cancelled_and_counts_once_each() -> None:
    talk = Talk((INSULIN, 250))
    for number in range(1, 4):
        talk.speak()
        talk.ack(INSULIN, Op.PROGRAM, echo=251)
        talk.boluses.listen()
        assert talk.speak() == [(INSULIN, Op.CANCEL)]
        talk.ack(INSULIN, Op.CANCEL)
        talk.boluses.listen()
        assert talk.boluses.refused == number
        assert talk.boluses.ready(INSULIN)
        talk.boluses.start(INSULIN, 250, talk.step)


@pytest.mark.parametrize(
    "wrong",
    [{"AckId": 7}, {"AckFor": 3}, {"AckFor": 4}, {"AckFor": 6}, {"AckFor": 0}, {"AckFor": 15}, {"AckFor": 1}],
)
def test_an_answer_to_something_else_confirms_nothing(wrong: dict[str, int]) -> None:
    talk = Talk((INSULIN, 250))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM, **wrong)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.PROGRAM)]


def test_a_late_answer_to_program_does_not_confirm_commit() -> None:
    talk = Talk((INSULIN, 250))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT)]


# ---- a meal of two drugs


def test_pramlintide_waits_for_the_insulin_of_its_meal() -> None:
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 150))
    assert talk.speak() == [(INSULIN, Op.PROGRAM), (PRAMLINTIDE, Op.PROGRAM)]
    talk.ack(PRAMLINTIDE, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.PROGRAM)]  # said again; pramlintide is agreed and waits
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT), (PRAMLINTIDE, Op.COMMIT)]


def test_insulin_does_not_wait_for_pramlintide() -> None:
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 150))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT), (PRAMLINTIDE, Op.PROGRAM)]


def test_pramlintide_of_its_own_waits_for_nobody() -> None:
    talk = Talk((PRAMLINTIDE, 300))
    talk.speak()
    talk.ack(PRAMLINTIDE, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(PRAMLINTIDE, Op.COMMIT)]


@pytest.mark.parametrize("answer", [{"result": WRONG_STATE}, {"echo": 249}])
def test_a_meal_whose_insulin_is_refused_gets_no_pramlintide(answer: dict[str, int]) -> None:
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 150))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM, **answer)
    talk.ack(PRAMLINTIDE, Op.PROGRAM)
    talk.boluses.listen()
    for _ in range(SENDS):
        assert (PRAMLINTIDE, Op.CANCEL) in talk.speak()
        if "echo" in answer and INSULIN in talk.boluses._open and talk.boluses._open[INSULIN].op == Op.CANCEL:
            talk.ack(INSULIN, Op.CANCEL)
        talk.boluses.listen()
    assert talk.speak() == []
    assert not talk.boluses.uncertain  # it was never committed


def test_a_meal_whose_pramlintide_is_refused_keeps_its_insulin() -> None:
    """Requirement TWO-04."""
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 150))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.ack(PRAMLINTIDE, Op.PROGRAM, WRONG_STATE)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT)]


def test_insulin_alone_that_is_agreed_leaves_a_programmed_pramlintide_alone() -> None:
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 150))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.ack(PRAMLINTIDE, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT), (PRAMLINTIDE, Op.COMMIT)]


# ---- what the pump tells


def committed(dose: int = 250) -> Talk:
    """A bolus whose Commit was never answered."""
    talk = Talk((INSULIN, dose))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.boluses.listen()
    for _ in range(SENDS):
        talk.speak()
        talk.boluses.listen()
    return talk


def test_a_bolus_is_followed_to_its_end_and_counted_once() -> None:
    talk = committed()
    for delivered, new, left in ((100, 100, 150), (100, 0, 150), (180, 80, 70)):
        talk.tell(INSULIN, Phase.DELIVERING, 0, delivered)
        assert talk.next() == ([(INSULIN, new)] if new else [])
        assert talk.boluses.remaining(INSULIN) == left
        assert not talk.boluses.uncertain
        assert not talk.boluses.ready(INSULIN)
    talk.tell(INSULIN, Phase.DONE, 0, 250)
    assert talk.next() == [(INSULIN, 70)]
    assert talk.boluses.ready(INSULIN)
    assert talk.boluses.remaining(INSULIN) == 0


def test_an_aborted_bolus_counts_what_was_delivered_and_never_more_than_was_asked_for() -> None:
    talk = committed()
    talk.tell(INSULIN, Phase.ABORTED, 0, 120)
    assert talk.next() == [(INSULIN, 120)]
    assert talk.boluses.ready(INSULIN)
    talk = committed()
    talk.tell(INSULIN, Phase.DONE, 0, 4000)
    assert talk.next() == [(INSULIN, 250)]


def test_a_bolus_the_pump_never_saw_is_settled_when_it_can_no_longer_come() -> None:
    talk = committed()
    for _ in range(EXPIRES_AFTER):
        talk.tell(INSULIN, Phase.IDLE)
        talk.next()
        assert talk.boluses.uncertain
        assert talk.boluses.remaining(INSULIN) == 250
    talk.tell(INSULIN, Phase.IDLE)
    assert talk.next() == []
    assert talk.boluses.ready(INSULIN)


def test_without_a_word_of_the_pump_it_stays_uncertain() -> None:
    talk = committed()
    for _ in range(50):
        talk.next()
        assert talk.boluses.uncertain
    talk.tell(PRAMLINTIDE, Phase.IDLE)
    talk.next()
    assert talk.boluses.uncertain


def test_a_bolus_that_is_only_programmed_is_cancelled_and_stays_uncertain_until_then() -> None:
    talk = committed()
    talk.tell(INSULIN, Phase.PROGRAMMED, 0)
    talk.next()
    assert talk.boluses.uncertain
    assert talk.speak() == [(INSULIN, Op.CANCEL)]
    talk.ack(INSULIN, Op.CANCEL)
    talk.boluses.listen()
    assert talk.speak() == []
    assert not talk.boluses.ready(INSULIN)  # what was delivered, the pump tells
    talk.tell(INSULIN, Phase.ABORTED, 0, 0)
    assert talk.next() == []
    assert talk.boluses.ready(INSULIN)


def test_an_unanswered_program_that_the_pump_has_is_cancelled_without_alarm() -> None:
    talk = Talk((INSULIN, 250))
    for _ in range(SENDS):
        talk.speak()
        talk.boluses.listen()
    talk.tell(INSULIN, Phase.PROGRAMMED, 0)
    talk.next()
    assert not talk.boluses.uncertain
    assert talk.speak() == [(INSULIN, Op.CANCEL)]
    talk.ack(INSULIN, Op.CANCEL)
    talk.boluses.listen()
    assert talk.boluses.ready(INSULIN)


def test_a_bolus_found_delivering_after_a_reset_counts_although_nothing_was_stored_of_its_commit() -> None:
    talk = Talk((INSULIN, 250))
    again = Boluses()
    again.restore(iter(talk.boluses.save()))
    talk.boluses = again
    talk.tell(INSULIN, Phase.DELIVERING, 0, 50)
    talk.next()
    assert again.remaining(INSULIN) == 200


def test_a_step_that_broke_off_in_the_middle_is_uncertain() -> None:
    talk = Talk((INSULIN, 250))
    talk.speak()
    talk.next()
    assert talk.boluses.uncertain
    assert talk.speak() == []


@pytest.mark.parametrize("heard", [(), (INSULIN,), (PRAMLINTIDE,)])
def test_nothing_is_ready_before_the_pump_has_told_of_both_drugs(heard: tuple[Drug, ...]) -> None:
    boluses = Boluses()
    for drug in heard:
        boluses.hear_state({"BolusStateHormone": drug, "BolusPhase": 0, "BolusStateId": 65535, "BolusDeliveredRaw": 0})
    assert not boluses.known
    assert not boluses.ready(INSULIN) and not boluses.ready(PRAMLINTIDE)


@pytest.mark.parametrize("wrong", [{"BolusStateHormone": 0}, {"BolusStateHormone": 3}, {"BolusPhase": 5}])
def test_a_state_that_makes_no_sense_is_not_heard(wrong: dict[str, int]) -> None:
    boluses = Boluses()
    usual: dict[str, Any] = {"BolusStateHormone": 1, "BolusPhase": 0, "BolusStateId": 65535, "BolusDeliveredRaw": 0}
    boluses.hear_state(usual | wrong)
    assert not boluses._heard


# ---- the pump's limits


@pytest.mark.parametrize(
    ("result", "told", "after"),
    [
        (OVER_LIMIT, 200, 200),
        (OVER_LIMIT, 400, 400),
        (ACCEPTED, 200, 300),
        (ACCEPTED, 400, 400),
        (DUPLICATE, 400, 400),
        (EXPIRED, 400, 300),
        (WRONG_STATE, 200, 300),
    ],
)
def test_a_refusal_lowers_the_limit_and_what_was_accepted_may_raise_it(result: int, told: int, after: int) -> None:
    assert accepted_limit({"AckResult": result, "AckLimitRaw": told}, 300) == after
    talk = Talk((INSULIN, 100))
    talk.boluses.limit[INSULIN] = 300
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM, result, AckLimitRaw=told)
    assert talk.boluses.limit == {INSULIN: after, PRAMLINTIDE: 4000}


def test_a_phase_the_firmware_does_not_know_settles_nothing() -> None:
    talk = committed()
    talk.tell(INSULIN, Phase.IDLE, number=0)
    assert talk.next() == []
    assert talk.boluses.remaining(INSULIN) == 250


def test_pramlintide_that_is_refused_itself_does_not_end_the_insulin_of_its_meal() -> None:
    talk = Talk((INSULIN, 250), (PRAMLINTIDE, 300))
    talk.speak()
    talk.ack(INSULIN, Op.PROGRAM)
    talk.ack(PRAMLINTIDE, Op.PROGRAM, echo=299)
    talk.boluses.listen()
    assert talk.speak() == [(INSULIN, Op.COMMIT), (PRAMLINTIDE, Op.CANCEL)]


def test_a_bolus_that_goes_on_does_not_hold_up_the_other_drug() -> None:
    talk = committed()
    talk.tell(INSULIN, Phase.DELIVERING, number=0, delivered=100)
    talk.next()
    talk.boluses.start(PRAMLINTIDE, 300, talk.step)
    assert talk.speak() == [(PRAMLINTIDE, Op.PROGRAM)]
    talk.ack(PRAMLINTIDE, Op.PROGRAM)
    talk.boluses.listen()
    assert talk.speak() == [(PRAMLINTIDE, Op.COMMIT)]


def test_of_two_boluses_the_one_the_pump_tells_of_is_followed() -> None:
    for silent, told in ((INSULIN, PRAMLINTIDE), (PRAMLINTIDE, INSULIN)):
        talk = Talk((INSULIN, 250), (PRAMLINTIDE, 300))
        for op in (Op.PROGRAM, Op.COMMIT):
            talk.speak()
            talk.ack(INSULIN, op)
            talk.ack(PRAMLINTIDE, op)
            talk.boluses.listen()
        talk.tell(told, Phase.DELIVERING, number=talk.boluses._open[told].number, delivered=100)
        assert talk.next() == [(told, 100)]
        assert talk.boluses.remaining(silent) > 0
        assert not talk.boluses.uncertain  # agreed by both sides: a lost PUMP_BolusState changes nothing


def test_a_cancel_without_an_answer_is_said_three_times_in_every_step() -> None:
    talk = committed()
    for _ in range(2):
        talk.tell(INSULIN, Phase.PROGRAMMED, 0)
        talk.next()
        for _ in range(SENDS):
            assert talk.speak() == [(INSULIN, Op.CANCEL)]
            talk.boluses.listen()
        assert talk.speak() == []


def test_what_is_stored_of_an_open_bolus() -> None:
    talk = committed()
    assert talk.boluses.save() == [1, 1, 0, 250, 10 + EXPIRES_AFTER, 1, 250, 0, 0, 0, 0, 0, 0]


# ---- what is counted


def test_every_command_without_an_answer_is_counted() -> None:
    talk = Talk((INSULIN, 160), (PRAMLINTIDE, 300))
    for count in (2, 4, 6):
        assert talk.speak()
        talk.boluses.listen()
        assert talk.boluses.unanswered == count
    assert talk.boluses.uncertain
    assert not talk.speak()
    talk.boluses.listen()
    assert talk.boluses.unanswered == 6  # nothing was said


@pytest.mark.parametrize(
    ("phase", "left", "short"),
    [
        (Phase.DONE, 0, 0),
        (Phase.DONE, STROKE - 1, 0),
        (Phase.DONE, STROKE, STROKE),
        (Phase.ABORTED, 60, 60),
        (Phase.DELIVERING, 60, 0),
    ],
)
def test_a_bolus_that_ended_early_is_short_by_the_rest(phase: Phase, left: int, short: int) -> None:
    talk = Talk((INSULIN, 160))
    for number in (0, 1):  # what was short before stays
        talk.tell(INSULIN, phase, number, 160 - left)
        talk.next()
        assert talk.boluses.short == {INSULIN: (number + 1) * short, PRAMLINTIDE: 0}
        assert not talk.boluses.uncertain
        talk.boluses.start(INSULIN, 160, talk.step)


def test_a_bolus_that_was_given_up_is_not_short() -> None:
    talk = Talk((INSULIN, 160))
    talk.boluses.cancel()
    talk.tell(INSULIN, Phase.ABORTED, 0, 40)
    talk.next()
    assert talk.boluses.short == {INSULIN: 0, PRAMLINTIDE: 0}
