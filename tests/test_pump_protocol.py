"""The firmware's picture of the pump by itself: what it counts of answers, what it assumes when totals are missing."""

import pytest

from firmware_sim.pump import Op, Pump

BASAL = 1425


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
