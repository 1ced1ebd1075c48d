"""Boluses at the pump: two stages, one id delivered at most once, and every stroke of it accounted for."""

import dataclasses
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_bus import codec
from can_bus.batch import Batch
from can_bus.codec import Receiver, Transmitter
from plant_server import mechanism
from plant_server.bolus import IDS, AckResult, DrugBolus, Op, Phase
from plant_server.chamber import INSULIN, PRAMLINTIDE, Chamber
from plant_server.mechanism import COMMANDED, FLUID, HELD, LOST, PENDING
from plant_server.pump import REPORT, AckFor, Pump, PumpSettings

BASAL = 1200  # 1.2 U/h
INS, PRAM = 1, 2
PROGRAM, COMMIT, CANCEL = Op.PROGRAM, Op.COMMIT, Op.CANCEL
ACCEPTED, DUPLICATE, EXPIRED = AckResult.ACCEPTED, AckResult.DUPLICATE, AckResult.EXPIRED
OVER_LIMIT, WRONG_STATE, BUSY = AckResult.OVER_LIMIT, AckResult.WRONG_STATE, AckResult.BUSY
MALFORMED, COMPLETED = AckResult.MALFORMED, AckResult.COMPLETED


class Bench:
    """A pump without a schedule of its own, unless told otherwise, and its frames decoded."""

    def __init__(self, **changes: object) -> None:
        plain = PumpSettings(basal_milliunits_per_h=0, change_every_steps=0)
        self.pump = Pump(dataclasses.replace(plain, **changes))
        self.transmitter = Transmitter()
        self.receiver = Receiver(["PUMP_Ack", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "PUMP_Alarm"])
        self.step = 0

    def ack(self, op: int, number: int, dose: int = 200, *, drug: int = INS, until: int | None = None) -> dict:
        values = {"BolusHormone": drug, "BolusOp": op, "BolusId": number}
        values["BolusUntilStep"] = (self.step + 1 if until is None else until) % 256
        values["PramlintideBolus" if drug == PRAM else "InsulinBolus"] = dose
        (frame,) = self.pump.bolus(values, self.step, self.transmitter)
        return self.receiver.receive(frame).values

    def say(self, op: int, number: int, dose: int = 200, **others: int) -> int:
        return self.ack(op, number, dose, **others)["AckResult"]

    def give(self, number: int, dose: int = 200, *, drug: int = INS) -> None:
        assert self.say(PROGRAM, number, dose, drug=drug) == ACCEPTED
        assert self.say(COMMIT, number, dose, drug=drug) == ACCEPTED

    def set_point(self, op: int, number: int, rate: int = 0) -> None:
        values = {"BasalOp": op, "BasalCmdSeq": number, "BasalUntilStep": (self.step + 12) % 128}
        values |= {"InsulinRate": rate, "PramlintideRate": 0}
        for frame in self.pump.command(values, self.step, self.transmitter):
            self.receiver.receive(frame)

    def run(self, steps: int = 1) -> float:
        """Insulin (U) that reaches the patient."""
        total = 0.0
        for _ in range(steps):
            total += float(self.pump.deliver(self.step)[0].sum())
            self.step += 1
            for chamber in (self.pump.insulin, self.pump.pramlintide):
                assert mechanism.ledger_closes(chamber.words), chamber.words
        return total

    def report(self) -> list[tuple[str, dict[str, int]]]:
        frames = Batch(self.transmitter, REPORT).frames(self.pump.values())
        found = [self.receiver.receive(frame) for frame in frames]
        return [(one.name, one.values) for one in found]

    def state(self, drug: int = INS) -> tuple[int, int, int, int]:
        """Phase, id, delivered and programmed raw, as told."""
        (one,) = [v for name, v in self.report() if name == "PUMP_BolusState" and v["BolusStateHormone"] == drug]
        return one["BolusPhase"], one["BolusStateId"], one["BolusDeliveredRaw"], one["BolusProgrammedRaw"]

    def totals(self) -> dict[str, int]:
        return dict(self.report())["PUMP_Delivered"]


# ---- the ordinary course


@pytest.mark.parametrize("drug", [INS, PRAM])
def test_before_the_first_bolus_there_is_none(drug: int) -> None:
    assert Bench().state(drug) == (Phase.IDLE, 65535, 0, 0)


@pytest.mark.parametrize(
    ("drug", "purposes", "limit", "total"),
    [
        (INS, (AckFor.INSULIN_BOLUS_PROGRAM, AckFor.INSULIN_BOLUS_COMMIT), 3000, ("InsulinTotal", 2000)),
        (PRAM, (AckFor.PRAM_BOLUS_PROGRAM, AckFor.PRAM_BOLUS_COMMIT), 3000, ("PramTotal", 2000)),
    ],
)
def test_program_commit_delivery(drug: int, purposes: tuple[int, int], limit: int, total: tuple[str, int]) -> None:
    bench = Bench()
    expected = {"AckResult": ACCEPTED, "AckId": 7, "AckEchoRaw": 200, "AckLimitRaw": limit}
    assert bench.ack(PROGRAM, 7, drug=drug) == expected | {"AckFor": purposes[0]}
    assert bench.state(drug) == (Phase.PROGRAMMED, 7, 0, 200)
    bench.run()
    assert bench.totals()[total[0]] == 0  # nothing without a Commit
    assert bench.ack(COMMIT, 7, drug=drug) == expected | {"AckFor": purposes[1]}
    assert bench.state(drug) == (Phase.DELIVERING, 7, 0, 200)
    bench.run()
    assert bench.state(drug) == (Phase.DONE, 7, 200, 200)
    assert bench.totals()[total[0]] == total[1]
    other = PRAM if drug == INS else INS
    assert bench.state(other) == (Phase.IDLE, 65535, 0, 0)


def test_the_motor_makes_fifteen_strokes_in_30_s_from_the_instant_of_the_commit_on() -> None:
    bench = Bench()
    bench.give(1, 1000)  # 200 strokes
    insulin, _ = bench.pump.deliver(0)
    assert insulin.tolist() == pytest.approx([0.75] * 10)
    assert bench.state() == (Phase.DELIVERING, 1, 750, 1000)
    bench.run()
    assert bench.state() == (Phase.DONE, 1, 1000, 1000)


@pytest.mark.parametrize(("dose", "delivered"), [(1, 0), (4, 0), (5, 5), (203, 200)])
def test_a_rest_below_a_stroke_is_not_delivered(dose: int, delivered: int) -> None:
    bench = Bench()
    bench.give(1, dose)
    bench.run()
    assert bench.state() == (Phase.DONE, 1, delivered, dose)
    assert bench.totals()["InsulinTotal"] == delivered * 10


def test_a_bolus_below_a_stroke_shows_nothing_of_the_one_before() -> None:
    bench = Bench()
    bench.give(1, 200)
    bench.run()
    bench.give(2, 3)
    assert bench.state() == (Phase.DONE, 2, 0, 3)
    bench.say(PROGRAM, 3, 100)
    assert bench.state() == (Phase.PROGRAMMED, 3, 0, 100)


def test_bolus_strokes_come_before_those_of_the_rate_and_none_is_lost() -> None:
    bench = Bench(basal_milliunits_per_h=30000)  # 50 strokes in five minutes
    bench.give(1, 600)  # 120 strokes, the motor makes 150
    assert bench.run() == pytest.approx(150 * 0.05)
    assert bench.state() == (Phase.DONE, 1, 600, 600)
    assert bench.pump.insulin.words[PENDING] == 20
    assert bench.run() == pytest.approx(70 * 0.05)


def test_the_two_drugs_do_not_wait_for_each_other() -> None:
    bench = Bench()
    bench.give(1, 1000)
    bench.give(1, 100, drug=PRAM)
    bench.run()
    assert bench.state() == (Phase.DELIVERING, 1, 750, 1000)
    assert bench.state(PRAM) == (Phase.DONE, 1, 100, 100)


# ---- what is refused


@pytest.mark.parametrize(
    ("others", "result"),
    [
        ({"dose": 0}, MALFORMED),
        ({"dose": 4001}, MALFORMED),
        ({"dose": 4095}, MALFORMED),
        ({"dose": 4000}, OVER_LIMIT),
        ({"dose": 3001}, OVER_LIMIT),
        ({"dose": 3000}, ACCEPTED),
        ({"dose": 3001, "drug": PRAM}, OVER_LIMIT),
        ({"dose": 3000, "drug": PRAM}, ACCEPTED),
        ({"op": 0}, MALFORMED),
        ({"op": 15}, MALFORMED),
        ({"drug": 0}, MALFORMED),
        ({"drug": 15}, MALFORMED),
        ({"number": 65535}, MALFORMED),
        ({"number": 65534}, ACCEPTED),
        ({"until": 10}, ACCEPTED),
        ({"until": 12}, ACCEPTED),
        ({"until": 13}, MALFORMED),
        ({"until": 10 + 127}, MALFORMED),
        ({"until": 10 + 128}, EXPIRED),
        ({"until": 9}, EXPIRED),
    ],
)
def test_a_program_is_judged(others: dict[str, int], result: int) -> None:
    bench = Bench()
    bench.step = 10
    ack = bench.ack(**({"op": PROGRAM, "number": 1} | others))
    assert ack["AckResult"] == result
    if result != ACCEPTED:
        assert bench.state(PRAM if others.get("drug") == PRAM else INS)[0] == Phase.IDLE
        if others.get("op", PROGRAM) == PROGRAM:
            assert bench.say(COMMIT, others.get("number", 1), others.get("dose", 200) or 1) in (
                WRONG_STATE, MALFORMED, OVER_LIMIT,
            )  # fmt: skip
        assert bench.run(3) == 0


def test_what_cannot_be_understood_is_acknowledged_for_nothing() -> None:
    bench = Bench()
    for others in ({"drug": 5, "op": PROGRAM}, {"drug": INS, "op": 9}):
        assert bench.ack(number=3, **others)["AckFor"] == AckFor.NONE


def test_a_commit_after_its_expiry_makes_no_stroke() -> None:
    bench = Bench()
    assert bench.say(PROGRAM, 1, until=2) == ACCEPTED
    bench.step = 2
    late = Bench()
    late.pump, late.step = bench.pump, 3
    assert late.say(COMMIT, 1, until=2) == EXPIRED
    assert late.run(2) == 0
    assert late.state()[0] == Phase.PROGRAMMED


def test_an_expiry_is_compared_across_the_end_of_its_circle() -> None:
    bench = Bench()
    bench.step = 255
    assert bench.say(PROGRAM, 1, until=256) == ACCEPTED
    bench.step = 256
    assert bench.say(COMMIT, 1, until=256) == ACCEPTED


def test_a_commit_needs_its_own_program() -> None:
    bench = Bench()
    assert bench.say(COMMIT, 1) == WRONG_STATE
    bench.say(PROGRAM, 1)
    assert bench.say(COMMIT, 2) == WRONG_STATE
    assert bench.say(COMMIT, 1, 201) == MALFORMED
    assert bench.run() == 0
    assert bench.say(COMMIT, 1) == ACCEPTED


def test_the_same_id_with_another_dose_does_nothing() -> None:
    bench = Bench()
    bench.give(1, 200)
    for op in (PROGRAM, COMMIT):
        ack = bench.ack(op, 1, 300)
        assert (ack["AckResult"], ack["AckEchoRaw"]) == (MALFORMED, 300)
    assert bench.run() == pytest.approx(2.0)
    assert bench.say(COMMIT, 1, 300) == MALFORMED
    assert bench.run(3) == 0


def test_duplicates_get_the_original_echo_even_when_it_is_over() -> None:
    bench = Bench()
    bench.give(1, 200)
    for _ in range(4):
        for op in (PROGRAM, COMMIT):
            ack = bench.ack(op, 1, 200, until=1)  # a retry repeats its expiry
            assert (ack["AckResult"], ack["AckEchoRaw"]) == (DUPLICATE, 200)
        bench.run()
    assert bench.totals()["InsulinTotal"] == 2000


@pytest.mark.parametrize("newest", [0, 5, 40000, IDS - 1])
def test_ids_are_compared_on_a_circle(newest: int) -> None:
    bench = Bench()
    bench.give(newest)
    bench.run()
    for behind in (1, 2, 1000, IDS // 2):
        assert bench.say(PROGRAM, (newest - behind) % IDS) == EXPIRED
        assert bench.say(COMMIT, (newest - behind) % IDS) == EXPIRED
    assert bench.run() == 0
    assert bench.say(PROGRAM, (newest + IDS // 2) % IDS) == ACCEPTED


def test_an_id_that_was_refused_is_remembered_too() -> None:
    bench = Bench()
    assert bench.say(PROGRAM, 5, 3500) == OVER_LIMIT
    assert bench.say(PROGRAM, 4) == EXPIRED


def test_a_newer_program_replaces_one_that_was_not_committed() -> None:
    bench = Bench()
    bench.say(PROGRAM, 1, 200)
    assert bench.say(PROGRAM, 2, 300) == ACCEPTED
    assert bench.say(COMMIT, 1, 200) == EXPIRED
    assert bench.say(COMMIT, 2, 300) == ACCEPTED
    assert bench.run() == pytest.approx(3.0)


def test_one_at_a_time() -> None:
    bench = Bench()
    bench.give(1, 1000)
    bench.run()
    assert bench.say(PROGRAM, 2) == BUSY
    assert bench.say(COMMIT, 2) == BUSY
    assert bench.say(COMMIT, 1, 1000) == DUPLICATE
    bench.run()
    assert bench.say(PROGRAM, 2) == ACCEPTED


def test_what_is_left_in_the_reservoir_limits_a_bolus() -> None:
    bench = Bench(insulin=dataclasses.replace(INSULIN, capacity=40))
    ack = bench.ack(PROGRAM, 1, 201)
    assert (ack["AckResult"], ack["AckLimitRaw"]) == (OVER_LIMIT, 200)
    bench.give(2, 150)
    assert bench.ack(PROGRAM, 3, 60)["AckLimitRaw"] == 50  # what is commanded already is taken off
    bench.run()
    assert bench.ack(PROGRAM, 4, 51)["AckResult"] == OVER_LIMIT


def test_a_reservoir_that_ran_low_since_the_program() -> None:
    bench = Bench()
    bench.say(PROGRAM, 1, 200)
    bench.pump.insulin.words[FLUID] = 10
    assert bench.say(COMMIT, 1, 200) == OVER_LIMIT


# ---- a pump that cannot


def test_suspended_stopped_or_without_power_it_gives_none() -> None:
    for spoil in ("suspend", "occlusion", "battery"):
        bench = Bench()
        bench.say(PROGRAM, 1)
        if spoil == "suspend":
            bench.set_point(2, 0)
        elif spoil == "occlusion":
            bench.pump.insulin.stopped = True
        else:
            bench.pump.battery = 0.0
        assert bench.say(COMMIT, 1) == WRONG_STATE, spoil
        assert bench.say(PROGRAM, 2) == WRONG_STATE, spoil
        assert bench.say(PROGRAM, 1, drug=PRAM) == (ACCEPTED if spoil == "occlusion" else WRONG_STATE), spoil
        assert bench.run() == 0


def test_a_suspension_that_has_expired_hinders_nothing() -> None:
    bench = Bench()
    bench.set_point(2, 0)
    bench.step = 13
    assert bench.say(PROGRAM, 1) == ACCEPTED


def test_a_co_formulation_has_no_bolus_of_pramlintide() -> None:
    bench = Bench(coformulation_ug_per_u=10.0)
    assert bench.say(PROGRAM, 1, drug=PRAM) == WRONG_STATE
    bench.give(1, 100)
    insulin, pramlintide = bench.pump.deliver(0)
    assert (insulin.sum(), pramlintide.sum()) == (pytest.approx(1.0), pytest.approx(10.0))


# ---- bolus that ends early


def ended(bench: Bench, delivered: int, lost: int, pending: int = 0) -> None:
    words = bench.pump.insulin.words
    phase, _, raw, _ = bench.state()
    assert (phase, raw) == (Phase.ABORTED, delivered * 5)
    assert (words[LOST], words[PENDING]) == (lost, pending)
    assert bench.say(COMMIT, 1, 1500) == DUPLICATE
    before = bench.totals()["InsulinTotal"]
    bench.run(2)
    assert bench.totals()["InsulinTotal"] == before


@pytest.mark.parametrize("how", ["cancel", "suspend", "battery"])
def test_a_bolus_ended_under_way(how: str) -> None:
    bench = Bench()
    bench.give(1, 1500)
    bench.run()
    if how == "cancel":
        ack = bench.ack(CANCEL, 1, 1500)
        assert (ack["AckFor"], ack["AckResult"]) == (AckFor.CANCEL, ACCEPTED)
        assert bench.say(CANCEL, 1, 1500) == DUPLICATE
    elif how == "suspend":
        bench.set_point(2, 0)
    else:
        bench.pump.battery = 0.0
        bench.run()
    ended(bench, delivered=150, lost=150)


def test_cancelled_in_the_instant_of_its_commit_nothing_comes() -> None:
    bench = Bench()
    bench.give(1, 1500)
    assert bench.say(CANCEL, 1, 1500) == ACCEPTED
    assert bench.run(3) == 0
    ended(bench, delivered=0, lost=300)


def test_cancel_before_commit_after_the_end_and_of_nothing() -> None:
    bench = Bench()
    assert bench.say(CANCEL, 1) == WRONG_STATE
    bench.say(PROGRAM, 1)
    assert bench.say(CANCEL, 2) == WRONG_STATE
    assert bench.say(CANCEL, 1) == ACCEPTED
    assert bench.say(COMMIT, 1) == WRONG_STATE
    bench.give(2)
    bench.run()
    for _ in range(2):
        assert bench.say(CANCEL, 2) == COMPLETED
    assert bench.state() == (Phase.DONE, 2, 200, 200)
    assert bench.say(CANCEL, 65535) == MALFORMED


def test_cancel_leaves_the_strokes_of_the_rate_alone() -> None:
    bench = Bench(basal_milliunits_per_h=30000)
    bench.give(1, 1500)
    bench.run()
    waiting = int(bench.pump.insulin.words[PENDING])
    bench.say(CANCEL, 1, 1500)
    assert bench.pump.insulin.words[LOST] == 150
    assert bench.pump.insulin.words[PENDING] == waiting - 150 == 50


def test_an_occlusion_ends_it_and_what_it_held_back_counts_when_it_comes() -> None:
    bench = Bench()
    bench.give(1, 1500)
    bench.run()
    bench.pump.insulin.occlude()
    bench.run()
    held = int(bench.pump.insulin.words[HELD])
    assert held >= 60
    assert bench.state()[:3] == (Phase.ABORTED, 1, 750)
    ended(bench, delivered=150, lost=150 - held, pending=held)
    bench.pump.insulin.release()
    assert bench.run() == pytest.approx(held * 0.05)
    assert bench.state() == (Phase.ABORTED, 1, 750 + held * 5, 1500)


def test_a_small_bolus_behind_an_occlusion_waits_for_its_end() -> None:
    for lost in (False, True):
        bench = Bench()
        bench.pump.insulin.occlude()
        bench.give(1, 100)
        bench.run()
        assert bench.state() == (Phase.DELIVERING, 1, 0, 100)
        bench.pump.insulin.release(lost=lost)
        bench.run()
        assert bench.state() == ((Phase.ABORTED, 1, 0, 100) if lost else (Phase.DONE, 1, 100, 100))


def test_strokes_of_the_rate_held_back_before_are_not_the_bolus() -> None:
    bench = Bench(basal_milliunits_per_h=6000)
    bench.pump.insulin.occlude()
    bench.run()
    held = int(bench.pump.insulin.words[HELD])
    assert held == 10
    bench.give(1, 1500)
    bench.say(CANCEL, 1, 1500)
    bench.pump.insulin.release()
    assert bench.run() >= held * 0.05
    assert bench.state() == (Phase.ABORTED, 1, 0, 1500)


def test_an_empty_reservoir_ends_it() -> None:
    bench = Bench()
    bench.give(1, 1500)
    bench.pump.insulin.words[FLUID] = 100
    bench.run()
    ended(bench, delivered=100, lost=200)


def test_air_is_not_counted_as_delivered() -> None:
    bench = Bench()
    bench.pump.insulin.insert_air(30)
    bench.give(1, 200)
    bench.run()
    assert bench.state() == (Phase.ABORTED, 1, 50, 200)
    assert bench.totals()["InsulinTotal"] == 500


def test_a_suspended_pump_makes_no_stroke_that_waited_for_the_motor() -> None:
    bench = Bench(basal_milliunits_per_h=30000)
    bench.give(1, 1500)
    bench.run()
    bench.set_point(2, 0)
    assert bench.run(2) == 0
    assert bench.pump.insulin.words[PENDING] == 0


# ---- reset


def test_a_reset_restarts_totals_and_ends_boluses_but_forgets_no_number() -> None:
    bench = Bench(basal_milliunits_per_h=BASAL)
    bench.set_point(1, 5, rate=400)
    bench.give(9, 1500)
    bench.say(PROGRAM, 4, 100, drug=PRAM)
    bench.run()
    before = int(bench.pump.insulin.words[COMMANDED])
    assert bench.pump.heartbeat() == (5, 0)
    bench.pump.reset()
    assert bench.totals() == {"PumpBootCount": 1, "InsulinTotal": 0, "PramTotal": 0}
    assert bench.pump.heartbeat() == (0, 1)  # BootUp, once
    assert bench.pump.heartbeat() == (5, 1)
    assert bench.state() == (Phase.ABORTED, 9, 750, 1500)
    assert bench.state(PRAM) == (Phase.ABORTED, 4, 0, 100)
    assert bench.say(COMMIT, 4, 100, drug=PRAM) == WRONG_STATE
    assert bench.say(PROGRAM, 9, 1500) == bench.say(COMMIT, 9, 1500) == DUPLICATE
    assert bench.say(PROGRAM, 8, 1500) == EXPIRED
    status = dict(bench.report())["PUMP_Status"]
    assert (status["PumpLastBasalSeq"], status["TbrActive"]) == (5, 0)
    bench.set_point(1, 5, rate=4000)  # the last one again: a duplicate
    assert bench.run(12) == pytest.approx(BASAL / 1000 + 3 * 0.05, abs=0.2)  # with what waited for the motor
    assert bench.pump.insulin.words[COMMANDED] - before == BASAL // 50


def test_boot_counts_wrap_below_their_reserved_code() -> None:
    bench = Bench()
    for _ in range(15):
        bench.pump.reset()
    assert bench.totals()["PumpBootCount"] == 0
    assert bench.pump.heartbeat() == (0, 15)


def test_enumerations_are_the_dbcs() -> None:
    for enumeration, message, signal in (
        (Op, "PUMP_BolusCmd", "BolusOp"),
        (Phase, "PUMP_BolusState", "BolusPhase"),
        (AckResult, "PUMP_Ack", "AckResult"),
        (AckFor, "PUMP_Ack", "AckFor"),
    ):
        for member in enumeration:
            assert codec.choice(message, signal, member.name.title().replace("_", "")) == member


# ---- whatever happens

DOSES = (100, 250, 900)
FRAME = st.tuples(st.integers(0, 5), st.sampled_from([PROGRAM, COMMIT, CANCEL]), st.integers(0, 6))
"""BolusId, operation, steps for which it is held back on its way; the content is that of the id."""

EVENT = st.sampled_from(["none", "none", "none", "occlude", "release", "lose", "air", "suspend", "resume", "reset"])


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.lists(FRAME, max_size=5), EVENT), min_size=1, max_size=14),
    st.integers(0, IDS - 1),
    st.integers(20, 6000),
    st.sampled_from([0, 1200, 30000]),
)
def test_one_id_is_delivered_at_most_once_whatever_comes(
    plan: list[tuple[list[tuple[int, int, int]], str]], first: int, fluid: int, basal: int
) -> None:
    """Commands of six boluses, doubled, delayed, out of order, while the pump is spoilt in every way."""
    bench = Bench(basal_milliunits_per_h=basal, insulin=dataclasses.replace(INSULIN, capacity=fluid))
    arriving: dict[int, list[tuple[int, int, int]]] = {}
    for step, (frames, _) in enumerate(plan):
        for index, op, delay in frames:
            arriving.setdefault(step + delay, []).append((index, op, step))
    committed: Counter[int] = Counter()
    requested = 0
    words = bench.pump.insulin.words
    known: dict[int, int] = {}  # id -> raw delivered, as last told
    for step in range(len(plan) + 8):
        event = plan[step][1] if step < len(plan) else "none"
        if event == "occlude":
            bench.pump.insulin.occlude()
        elif event in ("release", "lose"):
            bench.pump.insulin.release(lost=event == "lose")
        elif event == "air":
            bench.pump.insulin.insert_air(7)
        elif event in ("suspend", "resume"):
            bench.set_point(2 if event == "suspend" else 3, step)
        elif event == "reset":
            bench.pump.reset()
        for index, op, sent in arriving.get(step, ()):
            number, dose = (first + index) % IDS, DOSES[index % 3]
            before = int(words[COMMANDED])
            result = bench.say(op, number, dose, until=sent + 1)
            if op == COMMIT and result == ACCEPTED:
                assert step <= sent + 1
                committed[number] += 1
                requested += dose // 5
                assert words[COMMANDED] == before + dose // 5
            else:
                assert words[COMMANDED] == before
            assert mechanism.ledger_closes(words)
        bench.run()
        phase, number, delivered, programmed = bench.state()
        assert 0 <= delivered <= programmed
        assert delivered >= known.get(number, 0)
        assert delivered == 0 or committed[number] == 1
        assert phase != Phase.DONE or delivered == programmed
        known[number] = delivered
    assert all(count == 1 for count in committed.values())
    assert sum(known.values()) <= requested * 5
    if basal == 0:
        assert words[COMMANDED] == requested
        assert bench.pump.insulin.delivered * 5 == sum(known.values())


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(*(st.integers(0, top) for top in (15, 15, 65535, 4095, 255))), max_size=40))
def test_any_frame_at_all_is_answered_and_keeps_to_the_limits(frames: list[tuple[int, ...]]) -> None:
    bench = Bench()
    for drug, op, number, dose, until in frames:
        ack = bench.ack(op, number, dose, drug=drug, until=until)
        assert ack["AckResult"] != ACCEPTED or op == CANCEL or dose <= 3000
        bench.run()


def test_a_bolus_of_a_chamber_is_judged_without_a_pump() -> None:
    bolus = DrugBolus(Chamber(PRAMLINTIDE), 1200)
    assert bolus.judge(PROGRAM, 0, 150, 1, 0, ready=True) == (ACCEPTED, 150)
    assert bolus.judge(PROGRAM, 0, 150, 1, 200, ready=False) == (DUPLICATE, 150)
