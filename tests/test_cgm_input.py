"""What arrives from the sensor and the bus, over the whole range of every field, and garbage besides."""

import random

import pytest
from bench import GLUCOSE, NMA, S2, Bench, Turn, calibration

from can_bus import codec
from can_bus.codec import Check, Field
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from firmware_sim.alarms import Code
from firmware_sim.cgm import ABOVE_RANGE_ACTS_AS, AGE_USABLE, BELOW_RANGE_ACTS_AS, SEQUENCE_MODULUS, Cgm
from firmware_sim.control.layout import LIMITER_LOW_GLUCOSE
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from firmware_sim.pump import Op
from firmware_sim.wire import DIAGNOSTICS, subscriptions

OK, BELOW, ABOVE = 1, 4, 5
USABLE_RAW = range(200, 8001)

MAX_BASAL = 3000
"""0.001 U/h, a limit low enough to be met."""

CGM = codec.message("CGM_Reading")


def usable(state: int, raw: int) -> bool:
    """Requirement: states Ok, BelowRange and AboveRange, and under Ok 20 to 800 mg/dL."""
    return state in (BELOW, ABOVE) or (state == OK and raw in USABLE_RAW)


def raw_sample(k: int, state: int, glucose: int, rate: int = 0) -> int:
    """The payload of a CGM_Reading of step k with any codes, also those a sane encoder refuses."""
    return state << 12 | glucose << 16 | (rate & 0x7FF) << 29 | k % 65535 << 40 | k % 256 << 56


def limited_bench(mode: int = NMA) -> Bench:
    bench = Bench(mode=mode, flash=calibration(CfgMaxBasal=MAX_BASAL))
    bench.run(3)
    return bench


def check_limits(turn: Turn, bench: Bench, mode: int = S2) -> None:
    """Whatever came in: nothing goes out above the limits, nothing in a reserved code."""
    for command in turn.all("PUMP_BasalCmd"):
        if command["BasalOp"] == Op.SET_RATE:
            assert 0 <= command["InsulinRate"] * 5 <= max(MAX_BASAL, bench.basal)
            assert command["PramlintideRate"] <= (command["InsulinRate"] + 1) // 2 + 1 if mode == S2 else 0
            if command["InsulinRate"] == 0:
                assert command["PramlintideRate"] == 0
        else:
            assert command["BasalOp"] in (Op.SUSPEND, Op.RESUME_SCHEDULE)
    assert not turn.all("PUMP_BolusCmd")


class Fast:
    """The same bench without the decoding of every answer: for sweeps."""

    def __init__(self, mode: int = NMA) -> None:
        bench = limited_bench(mode)
        self.bench = bench
        self.firmware: Firmware = bench.firmware  # type: ignore[assignment]
        self.counter = bench.transmitter.counters["CGM_Reading"]
        self.command, self.status = codec.message("PUMP_BasalCmd"), codec.message("CTRL_Status")

    def step(self, word: int) -> tuple[dict[str, int], dict[str, int]]:
        """One instant with this payload of CGM_Reading; PUMP_BasalCmd and CTRL_Status."""
        bench, receive = self.bench, self.firmware.receive
        receive(Frame(CGM.can_id, codec.protect(CGM, word, self.counter)))
        self.counter = (self.counter + 1) % 16
        receive(bench.status())
        receive(bench.delivered())
        time = bench.k * STEP_SECONDS
        answers = receive(bench.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=bench.k, SimTime=time))
        command = next(frame for frame in answers if frame.can_id == self.command.can_id)
        status = next(frame for frame in answers if frame.can_id == self.status.can_id)
        bench.k += 1
        bench.total += bench.basal
        return self.command.unpack(command.data), self.status.unpack(status.data)


# ---- what is usable


@pytest.mark.parametrize("state", range(16))
def test_every_code_with_every_state_is_judged_as_required(state: int) -> None:
    """131072 combinations, each as the first sample of a sensor."""
    for raw in range(8192):
        cgm = Cgm()
        verdict = cgm.judge([{"CgmState": state, "GlucoseConc": raw, "CgmSampleSeq": 5, "CgmSampleStep": 7}], 7)
        expected = -1
        if usable(state, raw):
            expected = {BELOW: BELOW_RANGE_ACTS_AS, ABOVE: ABOVE_RANGE_ACTS_AS}.get(state, raw)
        assert verdict.glucose == expected
        assert verdict.refused == (expected < 0)
        assert cgm.sequence == (5 if expected >= 0 else None)


@pytest.mark.parametrize("state", range(16))
def test_no_code_of_glucose_doses_above_the_limits(state: int) -> None:
    """Every raw value in every state goes through the whole firmware; only usable ones become the newest sample."""
    fast = Fast(S2)
    basal, newest = fast.bench.basal, fast.bench.k - 1
    rates = set()
    for raw in range(8192):
        k = fast.bench.k
        command, status = fast.step(raw_sample(k, state, raw))
        if usable(state, raw) and not (state == ABOVE and raw == 0):  # the first rise waits to be confirmed
            newest = k
        assert status["LastCgmSeq"] == newest % 65535
        age = k - newest
        if command["BasalOp"] == Op.SET_RATE:
            rates.add(command["InsulinRate"])
            assert command["InsulinRate"] * 5 <= (MAX_BASAL if age <= AGE_USABLE else basal)
            assert command["PramlintideRate"] <= command["InsulinRate"] // 2 + 1
            assert age < 7
        else:
            assert command["BasalOp"] == Op.RESUME_SCHEDULE
    if state in (OK, ABOVE):
        assert MAX_BASAL // 5 in rates  # the limit was met
    if state == BELOW:
        assert rates == {0}


@pytest.mark.parametrize("code", [0, 8190, 8191, 1234])
def test_above_range_acts_as_400(code: int) -> None:
    """A value, not a gap, whatever stands in the field."""
    bench, other = Bench(mode=S2), Bench(mode=S2)
    bench.run(20), other.run(20)
    for step in range(12):
        frame = bench.sample()
        data = codec.protect(CGM, raw_sample(bench.k, ABOVE, code), frame.data[1] & 0xF)
        turn = bench.step(cgm=[frame._replace(data=data)])
        assert turn.frames == other.step(4000).frames
        assert turn.state == State.AUTO
        assert step != 1 or turn.rate > bench.basal // 5 + 200


@pytest.mark.parametrize("code", [0, 400, 8190, 8191, 2500])
def test_below_range_suspends_for_as_long_as_it_lasts(code: int) -> None:
    """The scale ends at 40 mg/dL: that glucose seems to fall no further must not look like a meal."""
    bench = Bench(mode=S2)
    bench.run(20, 2000)
    for _ in range(40):
        frame = bench.sample()
        data = codec.protect(CGM, raw_sample(bench.k, BELOW, code), frame.data[1] & 0xF)
        turn = bench.step(cgm=[frame._replace(data=data)])
        assert turn.state == State.AUTO
        assert turn.rate == turn.command["PramlintideRate"] == 0
        assert turn.status["LastCgmSeq"] == bench.k - 1
        if turn.status["LimiterBits"]:
            assert turn.status["LimiterBits"] == LIMITER_LOW_GLUCOSE
            assert turn.alarms(Code.DOSE_LIMITED)
    for age in range(1, 10):  # a sensor lost at its lowest: nothing, until the schedule is the lesser risk
        turn = bench.step(drop=True)
        if age < 7:
            assert turn.rate == turn.command["PramlintideRate"] == 0
        else:
            assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE
    assert bench.run(12).rate > 0


def test_a_sensor_that_is_not_ok_says_so() -> None:
    for state in sorted(set(range(16)) - {OK, BELOW, ABOVE}):
        bench = limited_bench()
        for age in range(1, 9):
            frame = bench.sample()
            data = codec.protect(CGM, raw_sample(bench.k, state, GLUCOSE), frame.data[1] & 0xF)
            turn = bench.step(cgm=[frame._replace(data=data)])
            assert turn.alarms(Code.CGM_IMPLAUSIBLE)
            assert turn.state == (State.AUTO if age < 4 else State.DEGRADED if age < 7 else State.SAFE_BASAL)


def test_every_sample_step_is_fresh_or_not_used() -> None:
    for taken in range(256):
        bench = limited_bench()
        k, last = bench.k, bench.k - 1
        turn = bench.step(cgm=[bench.sample(CgmSampleStep=taken)])
        fresh = (k - taken) % 256 <= AGE_USABLE
        assert turn.status["LastCgmSeq"] == (k if fresh else last)


def test_every_sample_number_is_newer_or_not_used() -> None:
    """Numbers run to 65534 and wrap; up to half the circle ahead is newer."""
    for last in (0, 1, 32767, 65534):
        for number in range(65536):
            cgm = Cgm()
            sample = {"CgmState": OK, "GlucoseConc": GLUCOSE, "CgmSampleSeq": last, "CgmSampleStep": 0}
            cgm.judge([sample], 0)
            verdict = cgm.judge([sample | {"CgmSampleSeq": number, "CgmSampleStep": 1}], 1)
            ahead = (number - last) % SEQUENCE_MODULUS
            newer = number < SEQUENCE_MODULUS and 0 < ahead < SEQUENCE_MODULUS // 2
            assert (verdict.glucose == GLUCOSE) == newer
            assert verdict.missing == (ahead - 1 if newer else 0)


def test_the_sensors_own_rate_does_not_matter() -> None:
    bench, undisturbed = limited_bench(), limited_bench()
    for rate in range(-1024, 1024, 7):
        frame = bench.sample()
        data = codec.protect(CGM, raw_sample(bench.k, OK, GLUCOSE, rate), frame.data[1] & 0xF)
        assert bench.step(cgm=[frame._replace(data=data)]).frames == undisturbed.step().frames


def test_numbers_wrap_without_a_gap() -> None:
    bench = Bench()
    bench.k = 65535 - 5
    for _ in range(12):
        turn = bench.step()
    assert turn.state == State.AUTO
    assert turn.diag["LostFrameCount"] == turn.diag["SequenceErrorCount"] == 0


# ---- E2E


def protected() -> list[str]:
    return [name for name in subscriptions() if codec.message(name).data_ids]


def flipped(data: bytes, *bits: int) -> bytes:
    word = int.from_bytes(data, "little")
    for bit in bits:
        word ^= 1 << bit
    return word.to_bytes(len(data), "little")


def good_frame(bench: Bench, name: str) -> Frame:
    """The next frame of a message, as good as can be: it would change something if it were taken."""
    if name == "CGM_Reading":
        return bench.sample(3900)
    if name == "PUMP_Delivered":
        return bench.delivered(InsulinTotal=bench.total // 12 + 5000)
    message = codec.message(name)
    values = {field.name: field.low for field in message.pages[0]} if 0 in message.pages else {}
    if name == "MODE_Cmd":
        values = {"ModeRequest": 0, "ModeCmdSeq": 9, "SuspendRequest": 1}
    if message.selector and not values:
        values = {message.selector: 1}
    return bench.frame(name, **values)


@pytest.mark.parametrize("name", protected())
def test_one_wrong_bit_is_one_error_and_nothing_else(name: str) -> None:
    """All 64 bits of every message it listens to; the doses are those of an undisturbed firmware."""
    bench, undisturbed = Bench(mode=S2), Bench(mode=S2)
    bench.run(5, 1800), undisturbed.run(5, 1800)
    bits = codec.message(name).length * 8
    counter = bench.transmitter.counters[name]
    for bit in range(bits):
        bench.transmitter.counters[name] = counter  # the good frame that comes later has this number
        frame = good_frame(bench, name)
        bench.transmitter.counters[name] = counter
        turn = bench.step(1800, also=[frame._replace(data=flipped(frame.data, bit))])
        counter = bench.transmitter.counters[name]
        other = undisturbed.step(1800)
        assert turn.command == other.command
        assert turn.status == other.status
        assert turn.diag["E2eErrorCount"] == bit + 1
        assert turn.diag["LostFrameCount"] == turn.diag["SequenceErrorCount"] == 0
        assert any(alarm["CtrlAlarmCode"] == Code.E2E_FAULT for alarm in turn.all("CTRL_Alarm"))


def test_two_or_three_wrong_bits_are_noticed_as_well() -> None:
    bench, undisturbed = Bench(), Bench()
    bench.run(5), undisturbed.run(5)
    draw = random.Random(2)
    for count in range(1000):
        message = codec.message(draw.choice(["CGM_Reading", "PUMP_Delivered", "MODE_Cmd"]))
        counter = bench.transmitter.counters[message.name]
        frame = good_frame(bench, message.name)
        bench.transmitter.counters[message.name] = counter
        wrong = flipped(frame.data, *draw.sample(range(message.length * 8), draw.choice((2, 3))))
        bench.give(frame._replace(data=wrong))
        if count % 100 == 99:
            turn = bench.step(1500)
            assert turn.command == undisturbed.step(1500).command
            assert turn.diag["E2eErrorCount"] == count + 1


def test_a_corrupt_sample_is_an_error_and_its_number_is_missing() -> None:
    bench = Bench()
    bench.run(10)
    last = bench.k - 1
    sample = bench.sample()
    turn = bench.step(cgm=[sample._replace(data=flipped(sample.data, 20))])
    assert turn.status["LastCgmSeq"] == last
    assert turn.diag["E2eErrorCount"] == 1
    turn = bench.step()
    assert (turn.diag["E2eErrorCount"], turn.diag["LostFrameCount"]) == (1, 1)


@pytest.mark.parametrize("name", protected())
def test_a_wrong_length_is_not_read(name: str) -> None:
    bench, undisturbed = Bench(mode=S2), Bench(mode=S2)
    bench.run(5, 1800), undisturbed.run(5, 1800)
    lengths = [length for length in range(9) if length != codec.message(name).length]
    counter = bench.transmitter.counters[name]
    frame = good_frame(bench, name)
    bench.transmitter.counters[name] = counter
    data = frame.data + bytes(8 - len(frame.data))
    turn = bench.step(1800, also=[frame._replace(data=data[:length]) for length in lengths])
    assert turn.command == undisturbed.step(1800).command
    assert turn.diag["E2eErrorCount"] == len(lengths)


def test_remote_and_29_bit_frames_with_a_known_id_are_counted_and_error_frames_too() -> None:
    bench, undisturbed = Bench(), Bench()
    bench.run(5), undisturbed.run(5)
    counter = bench.transmitter.counters["CGM_Reading"]
    sample = bench.sample(3900)
    bench.transmitter.counters["CGM_Reading"] = counter
    dressed = [
        Frame(CGM.can_id | CAN_RTR_FLAG, bytes(8)),
        Frame(CGM.can_id | CAN_EFF_FLAG, sample.data),
        Frame(CGM.can_id | CAN_EFF_FLAG | CAN_RTR_FLAG, bytes(8)),
    ]
    dressed.append(Frame(CGM.can_id | CAN_ERR_FLAG, sample.data))  # the controller tells of an error of the bus
    turn = bench.step(also=[*dressed, Frame(0x7FF, bytes(8))])
    assert turn.command == undisturbed.step().command
    assert turn.diag["E2eErrorCount"] == len(dressed)


@pytest.mark.parametrize("name", protected())
def test_a_frame_protected_for_another_id_is_rejected(name: str) -> None:
    bench, undisturbed = Bench(), Bench()
    bench.run(5), undisturbed.run(5)
    errors = 0
    for other in protected():
        if other == name or codec.message(other).length != codec.message(name).length:
            continue
        for counter in range(16):
            data = codec.protect(codec.message(other), 0, counter)
            bench.give(Frame(codec.message(name).can_id, data))
            errors += 1
    turn = bench.step()
    assert turn.command == undisturbed.step().command
    assert turn.diag["E2eErrorCount"] == errors


@pytest.mark.parametrize("step", range(16))
def test_use_of_a_frame_by_the_step_of_its_counter(step: int) -> None:
    """0 repeated and not used; 1 used; 2 and 3 used, and the loss counted; from 4 on a wrong sequence, not used."""
    bench = Bench()
    bench.run(5)
    last = bench.k - 1
    for _ in range((step - 1) % 16):
        bench.sample()
    turn = bench.step()
    used = step in (1, 2, 3)
    assert turn.status["LastCgmSeq"] == (last + 1 if used else last)
    assert turn.diag["SequenceErrorCount"] == (not used)
    if used:
        assert turn.diag["LostFrameCount"] == step - 1


# ---- every field, and garbage


def edges(field: Field) -> list[int]:
    """Raw codes of a field: all of a small one, the ends and some between of a large one."""
    bits = field.mask.bit_length()
    if bits <= 6:
        return list(range(field.mask + 1))
    draw = random.Random(field.name)
    near = [code & field.mask for code in (field.low - 1, field.low, field.high, field.high + 1)]
    powers = [1 << bit for bit in range(bits)] + [(1 << bit) - 1 for bit in range(bits + 1)]
    return sorted({*near, *powers, *(draw.randrange(field.mask + 1) for _ in range(20))})


@pytest.mark.parametrize("name", [name for name in subscriptions() if name not in ("SYNC_Step", DIAGNOSTICS)])
def test_any_code_in_any_field_is_survived(name: str) -> None:
    """CRC and counter are right; only plausibility can catch it."""
    message = codec.message(name)
    bench = limited_bench(S2)
    counter = bench.transmitter.counters[name]
    for field in message.fields.values():
        page = next((key for key, fields in message.pages.items() if field in fields), None)
        for raw in edges(field):
            word = (page or 0) << message.fields[message.selector].shift if message.selector else 0
            if name == "CGM_Reading":
                word = raw_sample(bench.k, OK, GLUCOSE)
            word = word & ~(field.mask << field.shift) | raw << field.shift
            data = codec.protect(message, word, counter)
            if message.data_ids:
                counter = (counter + 1) % 16
                bench.transmitter.counters[name] = counter
            bench.give(Frame(message.can_id, data))
            check_limits(bench.step(1000 + raw % 3000), bench)


def test_any_code_in_the_token_is_answered() -> None:
    """Also a token without a number, of no known phase, or from another year."""
    message = codec.message("SYNC_Step")
    for field in message.fields.values():
        for raw in edges(field):
            bench = limited_bench(S2)
            token = bench.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=bench.k, SimTime=0)
            word = int.from_bytes(token.data, "little") & ~0xFFF & ~(field.mask << field.shift) | raw << field.shift
            token = token._replace(data=codec.protect(message, word, token.data[1] & 0xF))
            if field.name == "SyncPhase" and raw == Phase.INIT:
                bench.receiver.reset()  # answered with fresh counters
            turn = bench.hand_over(token, raw if field.name == "StepIndex" else bench.k)
            check_limits(turn, bench)


def test_a_hundred_thousand_random_frames_change_no_dose() -> None:
    """Any id, any length, any bytes; where the CRC fits by chance, a bit is turned."""
    bench, undisturbed = Bench(mode=S2), Bench(mode=S2)
    bench.run(3), undisturbed.run(3)
    draw = random.Random(100)
    ids = [codec.message(name).can_id for name in subscriptions() if name != DIAGNOSTICS]
    heartbeats = {codec.message(name).can_id for name in subscriptions() if not codec.message(name).data_ids}
    bus = [can_id for can_id in ids if can_id not in heartbeats]
    expected = 0
    check = codec.Receiver(name for name in subscriptions() if name != DIAGNOSTICS)
    for k in range(200):
        for _ in range(500):
            can_id = draw.choice((draw.choice(bus), draw.randrange(0x800), draw.getrandbits(29) | CAN_EFF_FLAG))
            frame = Frame(can_id, draw.randbytes(draw.choice((8, 8, 8, draw.randrange(9)))))
            if check.receive(frame).check < Check.ERROR:
                frame = frame._replace(data=flipped(frame.data, 17)) if len(frame.data) == 8 else frame
            expected += check.receive(frame).check in (Check.ERROR, Check.MALFORMED)
            bench.give(frame)
        glucose = 1200 + 10 * (k % 100)
        turn, other = bench.step(glucose), undisturbed.step(glucose)
        assert turn.command == other.command
        assert turn.status == other.status
    assert turn.diag["E2eErrorCount"] == 4095  # it stays at its largest value
    assert expected > 4095


def test_a_hundred_thousand_well_protected_random_frames_dose_nothing_above_the_limits() -> None:
    """Right id, length, CRC and counter, random content: every message but the token and the calibration's CRC."""
    bench = limited_bench(S2)
    draw = random.Random(101)
    names = [name for name in subscriptions() if name not in ("SYNC_Step", DIAGNOSTICS)]
    states = set()
    counters = dict(bench.transmitter.counters)
    for k in range(100_000):
        name = draw.choice(names)
        message = codec.message(name)
        word = draw.getrandbits(message.length * 8)
        if message.data_ids:
            word &= ~0xFFF
        if name == "CFG_Param" and word >> 12 & 63 == 63:
            continue
        data = codec.protect(message, word, counters[name])
        if message.data_ids:
            counters[name] = (counters[name] + 1) % 16
        bench.give(Frame(message.can_id, data))
        if k % 100 == 0:
            bench.transmitter.counters.update(counters)
            turn = bench.step(draw.randint(0, 8000))
            counters = dict(bench.transmitter.counters)
            check_limits(turn, bench)
            states.add(turn.state)
    assert len(states) >= 2


def test_every_frame_that_could_not_be_read_is_no_lost_one() -> None:
    cgm = Cgm()
    sample = {"CgmState": 1, "GlucoseConc": 1200, "CgmSampleSeq": 5, "CgmSampleStep": 5}
    cgm.judge([sample], 5)
    cgm.skip(), cgm.skip()
    cgm.judge([], 6)
    assert cgm.judge([{**sample, "CgmSampleSeq": 8, "CgmSampleStep": 7}], 7).missing == 0
