"""The firmware's picture of the pump by itself: what it counts of answers, what it assumes when totals are missing."""

import pytest

from firmware_sim.pump import SEQUENCES, Op, Pump

BASAL = 1425
SOUND = {"PumpState": 1, "InsulinOcclusion": 0, "InsulinReservoir": 99, "PramOcclusion": 0, "PramReservoir": 99}
"""PUMP_Status of a pump without trouble."""


class Wire:
    """Takes what is sent."""

    def __init__(self) -> None:
        self.sent: list[dict[str, int]] = []

    def send(self, _name: str, **values: int) -> None:
        self.sent.append(values)


def command(pump: Pump, op: Op, rate: int = 0, pramlintide: int = 0) -> tuple[bool, dict[str, int]]:
    wire = Wire()
    cut = pump.command(wire, op, 7, rate, pramlintide)  # type: ignore[arg-type]
    (values,) = wire.sent
    return cut, values


@pytest.mark.parametrize(
    ("op", "rate", "assumed"), [(Op.SET_RATE, 240, 100), (Op.SUSPEND, 0, 0), (Op.RESUME_SCHEDULE, 0, 119)]
)
def test_a_missing_total_is_assumed_from_the_command_in_force(op: Op, rate: int, assumed: int) -> None:
    pump = Pump()
    totals = {"PumpBootCount": 0, "InsulinTotal": 500, "PramTotal": 0}
    assert pump.delivered(totals, 0, BASAL) == -1
    command(pump, op, rate)
    assert pump.delivered(None, 1, BASAL) == assumed
    assert pump.delivered({**totals, "InsulinTotal": 500 + 300}, 2, BASAL) == 300 - assumed


@pytest.mark.parametrize("total", [30, 100, 130])
def test_after_a_reset_of_the_pump_nothing_that_was_assumed_comes_off_later(total: int) -> None:
    """Its total begins anew: what was assumed may have been delivered before, and is in no total any more."""
    pump = Pump()
    pump.delivered({"PumpBootCount": 0, "InsulinTotal": 500, "PramTotal": 0}, 0, BASAL)
    command(pump, Op.SET_RATE, 240)
    assert pump.delivered(None, 1, BASAL) == 100
    rebooted = {"PumpBootCount": 1, "InsulinTotal": total, "PramTotal": 0}
    assert pump.delivered(rebooted, 2, BASAL) == max(total - 100, 0)
    assert pump.delivered({**rebooted, "InsulinTotal": total + 90}, 3, BASAL) == 90


def test_another_set_point_than_the_last_one_is_told_in_the_second_step_that_shows_it() -> None:
    pump = Pump()
    command(pump, Op.SET_RATE, 240)
    told = []
    for step, shown in enumerate((pump._sequence + 9, pump._sequence, *[pump._sequence + 9] * 3, SEQUENCES)):
        pump.status({**SOUND, "PumpLastBasalSeq": shown}, step)
        told.append(pump.unlike)
    assert told == [False, False, False, True, True, False]


def test_refusals_are_counted_one_by_one_for_both_drugs() -> None:
    pump = Pump()
    command(pump, Op.SET_RATE, 240, 120)
    answer = {"AckId": pump._sequence, "AckEchoRaw": 0, "AckLimitRaw": 8000}
    for number, purpose in enumerate((1, 8, 1, 8), 1):
        pump.hear_ack({"AckFor": purpose, "AckResult": 7, **answer})
        assert pump.refused == number
    for purpose in (0, 2, 5, 6, 15):
        pump.hear_ack({"AckFor": purpose, "AckResult": 7, **answer})
    for purpose in (1, 8):
        pump.hear_ack({"AckFor": purpose, "AckResult": 0, **answer})
        pump.hear_ack({"AckFor": purpose, "AckResult": 1, **answer})
    assert pump.refused == 4
    pump.hear_ack({"AckFor": 3, "AckResult": 3, **answer, "AckLimitRaw": 5})
    assert (pump.rate_limit, pump.pram_rate_limit) == (8000, 8000)


@pytest.mark.parametrize(
    ("limits", "asked", "sent"),
    [
        ((8000, 8000), (100, 200), (100, 200)),
        ((100, 8000), (100, 200), (100, 200)),
        ((99, 8000), (100, 200), (99, 198)),
        ((0, 8000), (100, 200), (0, 0)),
        ((8000, 150), (100, 200), (100, 150)),
        ((50, 90), (100, 200), (50, 90)),
        ((200, 8000), (400, 100), (200, 50)),
        ((0, 0), (0, 0), (0, 0)),
    ],
)
def test_the_pumps_limits_cut_and_keep_the_ratio(
    limits: tuple[int, int], asked: tuple[int, int], sent: tuple[int, int]
) -> None:
    pump = Pump()
    pump.rate_limit, pump.pram_rate_limit = limits
    cut, values = command(pump, Op.SET_RATE, *asked)
    assert (values["InsulinRate"], values["PramlintideRate"]) == sent
    assert cut == (sent != asked)


def test_without_a_rate_no_limit_cuts_and_no_field_is_filled() -> None:
    pump = Pump()
    pump.rate_limit = pump.pram_rate_limit = 0
    for op in (Op.SUSPEND, Op.RESUME_SCHEDULE):
        wire = Wire()
        assert not pump.command(wire, op, 7)  # type: ignore[arg-type]
        (values,) = wire.sent
        assert "InsulinRate" not in values and "PramlintideRate" not in values


@pytest.mark.parametrize(("op", "rate"), [(Op.SET_RATE, 240), (Op.SUSPEND, 0), (Op.RESUME_SCHEDULE, -1)])
def test_the_rate_in_force_is_kept_over_a_reset(op: Op, rate: int) -> None:
    pump = Pump()
    command(pump, op, 240)
    assert pump.save()[-1] == rate


def test_a_bolus_the_pump_told_of_counts_although_its_total_is_missing() -> None:
    pump = Pump()
    totals = {"PumpBootCount": 0, "InsulinTotal": 500, "PramTotal": 0}
    pump.delivered(totals, 0, BASAL)
    command(pump, Op.SET_RATE, 240)
    assert pump.delivered(None, 1, BASAL, 1600) == 100 + 1600
    assert pump.delivered({**totals, "InsulinTotal": 500 + 1800}, 2, BASAL) == 100
    assert pump.delivered({**totals, "InsulinTotal": 500 + 3600}, 3, BASAL, 1700) == 1800  # the total has it already


# ---- totals that are not to be believed


def totals(insulin: int, pram: int = 0, boots: int = 0) -> dict[str, int]:
    return {"PumpBootCount": boots, "InsulinTotal": insulin, "PramTotal": pram}


LAST_TOTAL = (1 << 24) - 3  # the two codes above it are Error and SNA


def test_codes_are_no_totals_and_a_boot_count_of_sna_neither() -> None:
    pump = Pump()
    assert pump.delivered(totals(LAST_TOTAL + 1), 0, BASAL) == -1
    assert pump.delivered(totals(500, boots=15), 0, BASAL) == -1
    assert not pump.heard
    assert pump.delivered(totals(LAST_TOTAL), 0, BASAL) == -1  # the first one is a base, nothing to count from
    assert pump.delivered(totals(500, boots=14), 1, BASAL) == 500  # and this is another life of the pump


def test_a_total_that_falls_is_refused_each_time_and_counted() -> None:
    pump = Pump()
    pump.delivered(totals(500), 0, 0)
    for number in (1, 2, 3):
        assert pump.delivered(totals(499), number, 0) == 0
        assert pump.refused == number
    assert pump.delivered(totals(500), 4, 0) == 0  # equal is not less
    assert pump.delivered(totals(507), 5, 0) == 7
    assert pump.refused == 3


def test_what_was_assumed_adds_up_until_a_total_comes() -> None:
    pump = Pump()
    pump.delivered(totals(500), 0, BASAL)
    assumed = [pump.delivered(None, step, BASAL) for step in (1, 2, 3)]
    assert assumed == [119, 119, 119]
    assert pump.delivered(totals(500 + 400), 4, BASAL) == 400 - 3 * 119
    assumed = [pump.delivered(None, step, BASAL) for step in (5, 6)]
    assert pump.delivered(totals(900 + 100), 7, BASAL) == 0
    assert pump.delivered(totals(1000 + 300), 8, BASAL) == 300 - (sum(assumed) - 100)  # the rest comes off


@pytest.mark.parametrize(
    ("before", "now", "delivered"),
    [
        (totals(0, 0), totals(0, 40), 40),
        (totals(0, 100), totals(0, 100), 0),
        (totals(0, 100), totals(0, 99), 0),
        (totals(0, 100), totals(0, 99, boots=1), 99),
        (totals(0, 100), totals(0, 130, boots=1), 130),
        (totals(0, 100), totals(0, LAST_TOTAL + 1), 0),
        (totals(0, 100), totals(0, LAST_TOTAL), LAST_TOTAL - 100),
        (totals(0, 100), totals(0, 200, boots=15), 0),
        (totals(0, 100), None, 0),
    ],
)
def test_pramlintide_delivered(before: dict[str, int], now: dict[str, int] | None, delivered: int) -> None:
    pump = Pump()
    assert pump.pramlintide(before) == 0
    pump.delivered(before, 0, BASAL)
    assert pump.pramlintide(now) == delivered


def test_the_first_total_of_pramlintide_is_a_base() -> None:
    pump = Pump()
    assert pump.pramlintide(None) == 0
    assert pump.pramlintide(totals(0, 900)) == 0
    assert pump.pramlintide(totals(0, 900)) == 900  # the boot count is known from insulin's total only: not told yet
    pump.delivered(totals(0, 900), 0, BASAL)
    assert pump.pramlintide(totals(0, 910)) == 10


# ---- answers


def answer(pump: Pump, purpose: int, echo: int, result: int = 0) -> None:
    about = {"AckFor": purpose, "AckId": pump._sequence, "AckLimitRaw": 8000}
    pump.hear_ack({**about, "AckResult": result, "AckEchoRaw": echo})


def test_a_set_point_taken_for_another_is_counted_each_time() -> None:
    pump = Pump()
    for number in (1, 2, 3):
        command(pump, Op.SET_RATE, 240, 120)
        answer(pump, 1, 240)
        answer(pump, 8, 120)
        assert pump.misunderstood == 2 * (number - 1)
        answer(pump, 1, 241)
        answer(pump, 8, 240)
        assert pump.misunderstood == 2 * number
        answer(pump, 1, 0, result=2)  # what it has refused it has not taken for anything
        assert pump.misunderstood == 2 * number


def test_every_set_point_without_an_answer_is_counted() -> None:
    pump = Pump()
    command(pump, Op.SET_RATE, 240, 120)
    command(pump, Op.SET_RATE, 240, 120)
    assert pump.unanswered == 0  # a pump that never answers is one without acknowledgements
    answer(pump, 1, 240)
    for number in (1, 3, 5):
        command(pump, Op.SET_RATE, 240, 120)
        assert pump.unanswered == number  # of the one before pramlintide's, then both


def test_what_was_asked_for() -> None:
    pump = Pump()
    assert pump.asked(BASAL) == (BASAL, 0)
    command(pump, Op.SET_RATE, 240, 120)
    assert pump.asked(BASAL) == (1200, 1200)


@pytest.mark.parametrize("first", ["status", "totals"])
def test_the_pump_is_heard_when_status_and_totals_have_come(first: str) -> None:
    """Requirement RST-03: before that nothing is commanded."""
    pump = Pump()
    assert not pump.heard
    for what in (first, "totals" if first == "status" else "status"):
        assert not pump.heard
        if what == "status":
            pump.status({**SOUND, "PumpLastBasalSeq": SEQUENCES}, 3)
        else:
            pump.delivered({"PumpBootCount": 0, "InsulinTotal": 500, "PramTotal": 0}, 3, BASAL)
    assert pump.heard


def test_the_age_is_that_of_what_is_missed_longest() -> None:
    pump = Pump()
    pump.delivered(totals(0), 10, BASAL)
    pump.status({"PumpLastBasalSeq": 255, "PumpState": 3, "InsulinOcclusion": 0, "InsulinReservoir": 9,
                 "PramOcclusion": 0, "PramReservoir": 9}, 10)  # fmt: skip
    assert pump.age(12) == 2
    pump.bolus_state(1, 7)
    assert pump.age(12) == 5


@pytest.mark.parametrize("drug", ["insulin", "pram"])
def test_a_total_that_fell_without_a_reset_is_told_until_one_can_be_believed(drug: str) -> None:
    """Requirement LED-03."""
    pump = Pump()

    def hear(insulin: int, pram: int, boots: int = 0) -> bool:
        frame = totals(insulin, pram, boots=boots)
        pump.pramlintide(frame)
        pump.delivered(frame, 0, BASAL)
        return pump.fallen

    below = (99, 100) if drug == "insulin" else (100, 99)
    assert not hear(100, 100)
    assert hear(*below)
    assert hear(*below)
    assert not hear(100, 100)
    assert not hear(*below, boots=1)
