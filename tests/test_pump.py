"""The pump: whole strokes, every one accounted for; commands judged by number, expiry and the pump's own limits."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_bus import codec
from can_bus.batch import Batch
from can_bus.codec import Receiver, Transmitter
from plant_server import mechanism
from plant_server.chamber import INSULIN, PRAMLINTIDE, Chamber, Occlusion
from plant_server.mechanism import COMMANDED, DELIVERED, HELD, LOST, PENDING
from plant_server.pump import REPORT, Pump, PumpSettings
from plant_server.pump_alarms import Alarm

BASAL = 1200  # 1.2 U/h in 0.001 U/h


def new_pump(**changes: object) -> Pump:
    return Pump(dataclasses.replace(PumpSettings(basal_milliunits_per_h=BASAL, change_every_steps=0), **changes))


class Bench:
    """A pump with its frames decoded."""

    def __init__(self, pump: Pump) -> None:
        self.pump = pump
        self.transmitter = Transmitter()
        self.receiver = Receiver(["PUMP_Ack", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "PUMP_Alarm"])

    def command(self, step: int, number: int, *, op: int = 1, rate: int = 400, pram: int = 200, ahead: int = 3) -> list:
        values = {"BasalOp": op, "BasalCmdSeq": number, "BasalUntilStep": (step + ahead) % 128}
        values |= {"InsulinRate": rate, "PramlintideRate": pram}
        return [self.receiver.receive(frame).values for frame in self.pump.command(values, step, self.transmitter)]

    def report(self) -> dict[str, dict[str, int]]:
        frames = Batch(self.transmitter, REPORT).frames(self.pump.values())
        return {one.name: one.values for one in map(self.receiver.receive, frames)}

    def alarms(self) -> list[tuple[int, int, int]]:
        found = [self.receiver.receive(frame).values for frame in self.pump.report_alarms(self.transmitter)]
        return [tuple(one[key] for key in ("PumpAlarmCode", "PumpAlarmState", "PumpAlarmAux")) for one in found]


def results(acks: list[dict[str, int]]) -> list[int]:
    return [ack["AckResult"] for ack in acks]


# ---- strokes


@pytest.mark.parametrize("rate", [1, 7, 1425, 9999, 40000])
def test_a_rate_becomes_exactly_its_strokes(rate: int) -> None:
    chamber = Chamber(dataclasses.replace(INSULIN, capacity=30000))
    total = sum(float(chamber.run(rate).sum()) for _ in range(288))
    assert chamber.words[COMMANDED] == rate * 24 // 50  # 0.001 U/h over 24 h in strokes of 0.05 U
    assert total == pytest.approx(chamber.delivered * 0.05)
    assert chamber.words[COMMANDED] - chamber.delivered in (0, int(chamber.words[PENDING]))


def test_pramlintide_strokes_are_half_a_microgram() -> None:
    chamber = Chamber(PRAMLINTIDE)
    assert sum(float(chamber.run(120).sum()) for _ in range(12)) == pytest.approx(12.0)  # 12 ug/h


ACTIONS = st.sampled_from(["run", "occlude", "release", "lose", "air", "change", "bolus"])


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(ACTIONS, st.integers(0, 40000)), max_size=60), st.integers(0, 500))
def test_the_ledger_closes_whatever_happens(actions: list[tuple[str, int]], fluid: int) -> None:
    chamber = Chamber(dataclasses.replace(INSULIN, capacity=fluid))
    arrived = 0.0
    for action, number in actions:
        before = chamber.words.copy()
        if action == "run":
            arrived += float(chamber.run(number).sum())
        elif action == "occlude":
            chamber.occlude()
        elif action in ("release", "lose"):
            chamber.release(lost=action == "lose")
        elif action == "air":
            chamber.insert_air(number % 50)
        elif action == "change":
            chamber.change()
        assert mechanism.ledger_closes(chamber.words), (action, number, chamber.words)
        for word in (COMMANDED, DELIVERED, LOST):
            assert chamber.words[word] >= before[word]
        assert arrived == pytest.approx(chamber.delivered * 0.05)


def test_occlusion_holds_back_trips_at_three_units_and_releases() -> None:
    chamber = Chamber(INSULIN)
    chamber.run(1000)
    chamber.occlude()
    steps = 0
    while chamber.occlusion != Occlusion.OCCLUDED:
        assert chamber.run(1000).sum() == 0
        steps += 1
        expected = Occlusion.CLEAR if chamber.words[HELD] * 2 < 60 else Occlusion.SUSPECTED
        assert chamber.occlusion in (expected, Occlusion.OCCLUDED)
    assert steps == pytest.approx(36, abs=1)  # 3.0 U at 1 U/h
    held = int(chamber.words[HELD])
    chamber.run(1000)
    assert chamber.words[LOST] > 0  # the motor stands: what was asked for meanwhile is never caught up
    lost = int(chamber.words[LOST])
    chamber.release()
    assert chamber.run(0).sum() == pytest.approx(held * 0.05)
    assert chamber.words[LOST] == lost
    assert chamber.occlusion == Occlusion.CLEAR


@pytest.mark.parametrize(("rate", "hours"), [(100, 30), (1000, 3), (5000, 0.6)])
def test_time_to_detect_an_occlusion(rate: int, hours: float) -> None:
    chamber = Chamber(INSULIN)
    chamber.occlude()
    steps = 0
    while chamber.occlusion != Occlusion.OCCLUDED:
        chamber.run(rate)
        steps += 1
    assert steps / 12 == pytest.approx(hours, rel=0.15)


def test_a_changed_set_loses_what_was_held_and_costs_its_priming() -> None:
    chamber = Chamber(INSULIN)
    chamber.occlude()
    chamber.run(12000)
    held = int(chamber.words[HELD])
    assert held
    chamber.change()
    assert chamber.words[LOST] == held
    assert chamber.remaining == pytest.approx(300 - 0.5)
    assert chamber.run(12000).sum() > 0


def test_air_and_an_empty_reservoir_deliver_nothing() -> None:
    chamber = Chamber(dataclasses.replace(INSULIN, capacity=5))
    chamber.insert_air(3)
    delivered = sum(float(chamber.run(6000).sum()) for _ in range(3))  # 0.5 U per step: 30 strokes asked for
    assert delivered == pytest.approx(5 * 0.05)
    assert chamber.empty
    assert chamber.words[LOST] == 25


# ---- commands


def test_a_set_point_is_accepted_echoed_and_obeyed() -> None:
    bench = Bench(new_pump())
    insulin, pram = bench.command(0, 0, rate=400, pram=200)
    assert (insulin["AckFor"], insulin["AckResult"], insulin["AckId"], insulin["AckEchoRaw"]) == (1, 0, 0, 400)
    assert (pram["AckFor"], pram["AckResult"], pram["AckEchoRaw"]) == (8, 0, 200)
    assert insulin["AckLimitRaw"] == 6000
    for step in range(12):
        bench.command(step, step + 1, rate=400, pram=200)
        bench.pump.deliver(step)
    report = bench.report()
    assert report["PUMP_Delivered"]["InsulinTotal"] == 2000
    assert report["PUMP_Delivered"]["PramTotal"] == 2000
    assert report["PUMP_Status"]["TbrActive"] == 1
    assert report["PUMP_Status"]["PumpLastBasalSeq"] == 12


def test_a_set_point_expires_to_the_schedule_and_no_pramlintide() -> None:
    bench = Bench(new_pump())
    bench.command(0, 0, rate=0, pram=300, ahead=2)
    for step in range(3):
        bench.pump.deliver(step)
    before = bench.report()["PUMP_Delivered"]
    assert before["InsulinTotal"] == 0
    for step in range(3, 15):
        bench.pump.deliver(step)
    report = bench.report()
    assert report["PUMP_Status"]["TbrActive"] == 0
    assert report["PUMP_Delivered"]["InsulinTotal"] == BASAL
    assert report["PUMP_Delivered"]["PramTotal"] == before["PramTotal"]


def test_duplicates_are_answered_with_the_original_echo_and_do_nothing() -> None:
    bench = Bench(new_pump())
    bench.command(0, 5, rate=400, pram=200)
    acks = bench.command(1, 5, rate=4000, pram=2000)
    assert results(acks) == [1, 1]
    assert [ack["AckEchoRaw"] for ack in acks] == [400, 200]
    bench.pump.deliver(1)
    assert bench.report()["PUMP_Delivered"]["InsulinTotal"] <= 200


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"number": 4}, [2, 2]),  # older than the last one
        ({"number": 1023}, [7, 7]),  # SNA
        ({"number": 6, "ahead": 25}, [7, 7]),  # claims to hold longer than two hours
        ({"number": 6, "ahead": -1}, [2, 2]),  # held back in a gateway
        ({"number": 6, "op": 0}, [7, 7]),
        ({"number": 6, "op": 15}, [7, 7]),
        ({"number": 6, "rate": 6001}, [3, 0]),
        ({"number": 6, "pram": 3001}, [0, 3]),
        ({"number": 6, "rate": 8191}, [7, 0]),
        ({"number": 6, "pram": 8190}, [0, 7]),
    ],
)
def test_what_is_refused(change: dict[str, int], expected: list[int]) -> None:
    bench = Bench(new_pump())
    bench.command(0, 5, rate=100, pram=50)
    number = change.pop("number")
    assert results(bench.command(0, number, **change)) == expected
    assert bench.pump.insulin.words[COMMANDED] == 0
    delivered = sum(float(bench.pump.deliver(step)[0].sum()) for step in range(3))
    assert delivered <= 6000 * 0.005 / 4


def test_a_refused_drug_falls_back_and_the_other_goes_on() -> None:
    bench = Bench(new_pump())
    bench.command(0, 0, rate=7000, pram=600, ahead=12)
    for step in range(12):
        bench.pump.deliver(step)
    report = bench.report()["PUMP_Delivered"]
    assert report["InsulinTotal"] == BASAL
    assert report["PramTotal"] == 6000


def test_suspend_and_resume() -> None:
    bench = Bench(new_pump())
    bench.command(0, 0, op=2, rate=8191, pram=8191)
    bench.pump.deliver(0)
    report = bench.report()
    assert report["PUMP_Status"]["PumpState"] == 4
    assert report["PUMP_Delivered"]["InsulinTotal"] == 0
    bench.command(1, 1, op=3, rate=8191, pram=8191)
    for step in range(1, 13):
        bench.pump.deliver(step)
    report = bench.report()
    assert report["PUMP_Status"]["PumpState"] == 3
    assert report["PUMP_Status"]["TbrActive"] == 0
    assert report["PUMP_Delivered"]["InsulinTotal"] == BASAL


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(*(st.integers(0, limit) for limit in (15, 1023, 8191, 8191, 127, 40))), max_size=30))
def test_no_command_moves_more_than_the_pumps_own_limit(commands: list[tuple[int, ...]]) -> None:
    bench = Bench(new_pump())
    for step, (op, number, rate, pram, until, _) in enumerate(commands):
        values = {"BasalOp": op, "BasalCmdSeq": number, "InsulinRate": rate, "PramlintideRate": pram}
        acks = bench.pump.command(values | {"BasalUntilStep": until}, step, bench.transmitter)
        assert len(acks) == 2
        insulin, pramlintide = bench.pump.deliver(step)
        assert insulin.sum() <= 30 / 12 + 0.05
        assert pramlintide.sum() <= 300 / 12 + 0.5


# ---- status and alarms


def test_reservoir_low_then_empty_each_said_until_confirmed() -> None:
    small = dataclasses.replace(INSULIN, capacity=430)
    bench = Bench(new_pump(insulin=small))
    bench.command(0, 0, rate=6000, pram=0, ahead=24)
    assert bench.alarms() == []
    bench.pump.deliver(0)  # 2.5 U, 50 strokes
    assert bench.alarms() == [(Alarm.RESERVOIR_LOW, 1, 1)]
    assert bench.alarms() == [(Alarm.RESERVOIR_LOW, 1, 1)]
    (instance,) = bench.pump.alarms.pending()
    bench.pump.alarms.confirm(instance)
    assert bench.alarms() == [(Alarm.RESERVOIR_LOW, 2, 1)]
    assert bench.alarms() == []
    for step in range(1, 10):
        bench.pump.deliver(step)
    assert bench.alarms() == [(Alarm.RESERVOIR_EMPTY, 1, 1), (Alarm.RESERVOIR_LOW, 0, 1)]
    bench.pump.insulin.change()
    assert bench.alarms() == [(Alarm.RESERVOIR_EMPTY, 0, 1)]
    assert bench.alarms() == []


def test_occlusion_names_its_drug_in_status_and_alarm() -> None:
    bench = Bench(new_pump())
    bench.pump.pramlintide.occlude()
    bench.command(0, 0, rate=240, pram=3000, ahead=24)
    for step in range(3):
        bench.pump.deliver(step)
    report = bench.report()
    assert (report["PUMP_Status"]["InsulinOcclusion"], report["PUMP_Status"]["PramOcclusion"]) == (0, 2)
    assert report["PUMP_Status"]["PumpState"] == 3  # insulin goes on
    assert bench.alarms() == [(Alarm.OCCLUSION, 1, 2)]


def test_an_empty_battery_stops_the_pump_and_books_nothing() -> None:
    bench = Bench(new_pump(battery_percent_per_day=288.0))
    codes = []
    for step in range(120):
        bench.pump.deliver(step)
        codes += [code for code, state, _ in bench.alarms() if state == 1]
    assert set(codes) == {Alarm.BATTERY_LOW, Alarm.BATTERY_EMPTY}
    report = bench.report()
    assert report["PUMP_Status"]["PumpState"] == 5
    assert report["PUMP_Status"]["PumpBattery"] == 0
    assert report["PUMP_Delivered"]["InsulinTotal"] == pytest.approx(100 * 100, abs=100)  # 100 steps of 0.1 U
    assert mechanism.ledger_closes(bench.pump.insulin.words)
    assert bench.pump.insulin.words[LOST] == 0


def test_the_user_changes_reservoirs_and_battery_in_time() -> None:
    bench = Bench(new_pump(change_every_steps=864))
    for step in range(863):
        bench.pump.deliver(step)
    assert bench.report()["PUMP_Status"]["InsulinReservoir"] < 2200
    bench.pump.deliver(863)
    status = bench.report()["PUMP_Status"]
    assert status["PumpState"] == 1
    assert (status["InsulinReservoir"], status["PumpBattery"]) == (2995, 100)
    bench.pump.deliver(864)
    assert bench.report()["PUMP_Status"]["PumpState"] == 3


def test_a_co_formulation_gives_both_drugs_from_one_motor() -> None:
    bench = Bench(new_pump(coformulation_ug_per_u=10.0))
    assert results(bench.command(0, 0, rate=400, pram=200)) == [0, 0]  # 2 U/h with 20 ug/h
    for step in range(12):
        bench.command(step, step + 1, rate=400, pram=200)
        insulin, pramlintide = bench.pump.deliver(step)
        assert pramlintide.sum() == pytest.approx(10 * insulin.sum())
    totals = bench.report()["PUMP_Delivered"]
    assert (totals["InsulinTotal"], totals["PramTotal"]) == (2000, 2000)
    assert results(bench.command(12, 20, rate=400, pram=0)) == [0, 4]  # it cannot give insulin alone


def test_enumerations_are_the_dbcs() -> None:
    for code in Alarm:
        label = {Alarm.OCCLUSION: "Occlusion", Alarm.RESERVOIR_LOW: "ReservoirLow", Alarm.BATTERY_LOW: "BatteryLow"}
        if code in label:
            assert codec.choice("PUMP_Alarm", "PumpAlarmCode", label[code]) == code
