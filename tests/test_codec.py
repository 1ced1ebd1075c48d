"""Packing against cantools, E2E against an implementation of its own, and what a receiver makes of bad frames."""

import itertools
import random
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dbc
from can_bus import codec
from can_bus.codec import Check, CodecError, MessageCodec, Receiver, Transmitter
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame
from can_bus.lockstep import Done, Turn

NAMES = sorted(codec.messages())
PROTECTED = [name for name in NAMES if codec.message(name).data_ids]
UNPROTECTED = [name for name in NAMES if name not in PROTECTED]
EACH = settings(max_examples=20, deadline=None, database=None)

each_message = pytest.mark.parametrize("name", NAMES)
each_protected = pytest.mark.parametrize("name", PROTECTED)


def profile_2(data: bytes, ids: bytes) -> int:
    """AUTOSAR E2E Profile 2 from its description: the CRC that belongs into byte 0."""
    crc = 0xFF
    for byte in (*data[1:], ids[data[1] & 0xF]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x2F if crc & 0x80 else 0)) & 0xFF
    return crc ^ 0xFF


def table(name: str) -> Any:
    """The message as cantools knows it."""
    return dbc.load().get_message_by_name(name)


def signals_of(message: MessageCodec, page: int | None) -> list[codec.Field]:
    """The fields that exist on a page; without one, those outside the pages."""
    paged = {field.name: key for key, fields in message.pages.items() for field in fields}
    return [field for field in message.fields.values() if paged.get(field.name, page) == page]


@st.composite
def raw_values(draw: st.DrawFn, name: str) -> dict[str, int]:
    """A value for every signal of one page: within the range, or one of its named codes."""
    message = codec.message(name)
    page = draw(st.sampled_from(sorted(message.pages))) if message.pages else None
    values = {
        field.name: draw(
            st.integers(field.low, field.high) | st.sampled_from(sorted(field.reserved))
            if field.reserved
            else st.integers(field.low, field.high)
        )
        for field in signals_of(message, page)
    }
    if message.selector is not None and page is not None:
        values[message.selector] = page
    return values


def sample(name: str, seed: int = 0) -> dict[str, int]:
    """Some legal values."""
    generator = random.Random(f"{name} {seed}")
    message = codec.message(name)
    page = generator.choice(sorted(message.pages)) if message.pages else None
    values = {field.name: generator.randint(field.low, field.high) for field in signals_of(message, page)}
    if message.selector is not None and page is not None:
        values[message.selector] = page
    return values


def protected(name: str, counter: int, seed: int = 0) -> Frame:
    message = codec.message(name)
    return Frame(message.can_id, codec.protect(message, message.pack(sample(name, seed)), counter))


# ---- packing


@each_message
def test_packs_like_cantools(name: str) -> None:
    message, other = codec.message(name), table(name)
    hidden = {"CHECKSUM": 0, "COUNTER": 0} if message.data_ids else {}

    @EACH
    @given(raw_values(name))
    def check(values: dict[str, int]) -> None:
        expected = other.encode({**hidden, **values}, scaling=False, strict=False)
        assert message.pack(values).to_bytes(message.length, "little") == expected

    check()


@each_message
def test_unpacks_like_cantools(name: str) -> None:
    message, other = codec.message(name), table(name)

    @EACH
    @given(st.binary(min_size=message.length, max_size=message.length))
    def check(data: bytes) -> None:
        ours = message.unpack(data)
        if message.selector is not None and ours[message.selector] not in message.pages:
            assert set(ours) == {field.name for field in signals_of(message, None)}
            return
        theirs = other.decode(data, decode_choices=False, scaling=False)
        assert ours == {key: raw for key, raw in theirs.items() if not message.data_ids or key in message.fields}

    check()


@pytest.mark.parametrize(
    ("name", "page"), [(name, page) for name in NAMES for page in sorted(codec.message(name).pages)]
)
def test_every_page_goes_there_and_back(name: str, page: int) -> None:
    message = codec.message(name)
    assert message.selector is not None
    for end in ("low", "high"):
        values = {field.name: getattr(field, end) for field in signals_of(message, page)}
        values[message.selector] = page
        assert message.unpack(message.pack(values).to_bytes(message.length, "little")) == values
        hidden = {"CHECKSUM": 0, "COUNTER": 0} if message.data_ids else {}
        expected = table(name).encode({**hidden, **values}, scaling=False, strict=False)
        assert message.pack(values).to_bytes(message.length, "little") == expected


@each_message
def test_what_is_left_out_has_its_start_value(name: str) -> None:
    message = codec.message(name)
    for page in sorted(message.pages) or [None]:
        given_values = {} if page is None or message.selector is None else {message.selector: page}
        found = message.unpack(message.pack(given_values).to_bytes(message.length, "little"))
        for field in signals_of(message, page):
            stated = table(name).get_signal_by_name(field.name).dbc.attributes.get("GenSigStartValue")
            expected = given_values.get(field.name, int(stated.value) if stated else 0)
            assert found[field.name] == expected, field.name


def test_the_order_of_the_values_does_not_matter() -> None:
    values = sample("CGM_Reading")
    message = codec.message("CGM_Reading")
    for order in itertools.permutations(values):
        assert message.pack({key: values[key] for key in order}) == message.pack(values)


@each_message
def test_values_out_of_range_are_refused_and_named_codes_accepted(name: str) -> None:
    message = codec.message(name)
    for page in sorted(message.pages) or [None]:
        base = {} if page is None or message.selector is None else {message.selector: page}
        for field in signals_of(message, page):
            if field.name == message.selector:
                continue
            for code in field.reserved:
                word = message.pack({**base, field.name: code})
                assert message.unpack(word.to_bytes(message.length, "little"))[field.name] == code
            for value in (field.low - 1, field.high + 1, 1 << 40, -(1 << 40)):
                if value in field.reserved:
                    continue
                with pytest.raises(CodecError, match=rf"^{name}\.{field.name}: raw value {value} is outside"):
                    message.pack({**base, field.name: value})


def test_errors_name_message_and_signal() -> None:
    with pytest.raises(CodecError, match=r"CGM_Reading has no signal Glucose; it has CgmState, GlucoseConc,"):
        codec.message("CGM_Reading").pack({"Glucose": 1})
    for hidden in ("CHECKSUM", "COUNTER"):
        with pytest.raises(CodecError, match=f"CGM_Reading has no signal {hidden}"):
            codec.message("CGM_Reading").pack({hidden: 1})
    with pytest.raises(CodecError, match=r"the DBC has no message 'CGM_Readng'; it has SYNC_Step, "):
        codec.message("CGM_Readng")
    with pytest.raises(CodecError, match=r"the DBC has no message 'Nothing'"):
        Transmitter().frame("Nothing")
    with pytest.raises(CodecError, match=r"the DBC has no message 'Nothing'"):
        Receiver(["CGM_Reading", "Nothing"])
    with pytest.raises(CodecError, match=r"CTRL_Status\.CtrlState has no value named 'SafeBasl'"):
        codec.choice("CTRL_Status", "CtrlState", "SafeBasl")
    with pytest.raises(CodecError, match=r"CTRL_Status\.Nothing has no value named 'Auto'"):
        codec.choice("CTRL_Status", "Nothing", "Auto")
    with pytest.raises(CodecError, match=r"the DBC has no message 'CTRL_State'"):
        codec.choice("CTRL_State", "CtrlState", "Auto")


def test_a_signal_of_another_page_is_refused() -> None:
    message = codec.message("CFG_Param")
    with pytest.raises(CodecError, match=r"CFG_Param\.CfgCarbRatio does not exist when CfgIndex is 0"):
        message.pack({"CfgIndex": 0, "CfgCarbRatio": 5})
    with pytest.raises(CodecError, match=r"PUMP_BolusCmd\.InsulinBolus does not exist when BolusHormone is 15"):
        codec.message("PUMP_BolusCmd").pack({"BolusOp": 1, "BolusId": 1, "InsulinBolus": 100})  # which drug?
    assert message.unpack(message.pack({"CfgIndex": 60}).to_bytes(8, "little")) == {"CfgIndex": 60}


def test_named_values() -> None:
    assert codec.choice("CTRL_Status", "CtrlState", "SafeBasal") == 3
    assert codec.choice("CGM_Reading", "GlucoseRate", "SNA") == -1024


# ---- E2E


def test_the_crc_is_crc_8_autosar() -> None:
    """Its check value in the catalogue of CRCs, over a CHECKSUM that does not count, eight bytes and a data id."""
    text = b"123456789"
    assert profile_2(b"\0" + text[:-1], text[-1:] * 16) == 0xDF


@each_protected
def test_protects_like_profile_2(name: str) -> None:
    message = codec.message(name)
    assert message.data_ids is not None

    @EACH
    @given(raw_values(name), st.integers(0, 15))
    def check(values: dict[str, int], counter: int) -> None:
        data = codec.protect(message, message.pack(values), counter)
        assert data[1] & 0xF == counter
        assert data[0] == profile_2(data, message.data_ids)
        assert message.unpack(data) == values
        assert Receiver([name]).receive(Frame(message.can_id, data)) == (Check.OK, name, values, 0)

    check()


@each_protected
def test_refuses_what_profile_2_refuses(name: str) -> None:
    message = codec.message(name)
    assert message.data_ids is not None

    @EACH
    @given(st.binary(min_size=8, max_size=8))
    def check(data: bytes) -> None:
        right = data[0] == profile_2(data, message.data_ids)
        found = Receiver([name]).receive(Frame(message.can_id, data)).check
        assert found == (Check.OK if right else Check.ERROR)

    check()


@pytest.mark.parametrize("name", UNPROTECTED)
def test_unprotected_messages_are_sent_as_they_are(name: str) -> None:
    message = codec.message(name)
    values = sample(name)
    data = codec.protect(message, message.pack(values), 9)
    assert data == message.pack(values).to_bytes(message.length, "little")
    receiver = Receiver([name])
    for _ in range(2):  # nothing tells a repetition
        assert receiver.receive(Frame(message.can_id, data)) == (Check.OK, name, values, 0)


PATTERNS = [sum(1 << bit for bit in bits) for count in (1, 2, 3) for bits in itertools.combinations(range(64), count)]
"""All errors of one, two and three bits of a frame."""


@each_protected
def test_every_error_of_one_to_three_bits_is_noticed(name: str) -> None:
    """COUNTER included, where an error also selects another data id: the lists are chosen so that it cannot hide."""
    message = codec.message(name)
    counter = PROTECTED.index(name) % 16
    word = int.from_bytes(protected(name, counter).data, "little")
    assert codec.e2e_p02_check(word.to_bytes(8, "little"), message.data_ids)
    check, ids = codec.e2e_p02_check, message.data_ids
    missed = [pattern for pattern in PATTERNS if check((word ^ pattern).to_bytes(8, "little"), ids)]
    assert missed == []


@each_protected
def test_the_receiver_counts_every_broken_frame_and_uses_none(name: str) -> None:
    generator = random.Random(name)
    receiver = Receiver([name])
    receiver.receive(protected(name, 3))
    patterns = [*PATTERNS[:64], *generator.sample(PATTERNS[64:], 200)]
    for number, pattern in enumerate(patterns, start=1):
        frame = protected(name, number % 16, number)
        broken = Frame(frame.can_id, (int.from_bytes(frame.data, "little") ^ pattern).to_bytes(8, "little"))
        assert receiver.receive(broken) == (Check.ERROR, name, {}, 0)
        assert receiver.crc_errors == number
    assert receiver.receive(protected(name, 4)).check == Check.OK  # and the counter is where it was


@each_protected
def test_what_holds_for_one_counter_holds_for_all(name: str) -> None:
    """An error in COUNTER changes the data id by the same amount whatever COUNTER was, so one frame proves all."""
    ids = codec.message(name).data_ids
    assert ids is not None
    for error in range(16):
        assert len({ids[counter] ^ ids[counter ^ error] for counter in range(16)}) == 1


def test_a_frame_of_another_message_is_never_taken() -> None:
    for name, other in itertools.permutations(PROTECTED, 2):
        receiver = Receiver([name])
        for counter in range(16):
            forged = Frame(codec.message(name).can_id, protected(other, counter).data)
            assert receiver.receive(forged) == (Check.ERROR, name, {}, 0), other
        assert receiver.crc_errors == 16


# ---- the receiver


@each_protected
@pytest.mark.parametrize("step", range(16))
def test_verdict_by_the_step_of_the_counter(name: str, step: int) -> None:
    for first in range(16):
        receiver = Receiver([name])
        assert receiver.receive(protected(name, first)).check == Check.OK
        found = receiver.receive(protected(name, (first + step) % 16, seed=1))
        if step == 0:
            assert found == (Check.REPEATED, name, {}, 0)
            assert (receiver.sequence_errors, receiver.lost) == (1, 0)
        elif step == 1:
            assert found == (Check.OK, name, sample(name, 1), 0)
            assert (receiver.sequence_errors, receiver.lost) == (0, 0)
        elif step <= 3:
            assert found == (Check.OK_SOME_LOST, name, sample(name, 1), step - 1)
            assert (receiver.sequence_errors, receiver.lost) == (0, step - 1)
        else:
            assert found == (Check.WRONG_SEQUENCE, name, {}, step - 1)
            assert (receiver.sequence_errors, receiver.lost) == (1, step - 1)
        assert receiver.lost == receiver.lost_of(name)
        assert receiver.crc_errors == receiver.malformed == 0
        following = receiver.receive(protected(name, (first + step + 1) % 16, seed=2))
        assert following == (Check.OK, name, sample(name, 2), 0)


def test_sixteen_lost_frames_look_like_a_repetition() -> None:
    """What a 4-bit counter cannot see, application numbers have to."""
    receiver = Receiver(["CGM_Reading"])
    receiver.receive(protected("CGM_Reading", 7))
    assert receiver.receive(protected("CGM_Reading", 7, seed=1)).check == Check.REPEATED
    assert receiver.lost == 0


def test_losses_are_counted_by_message() -> None:
    receiver = Receiver(["CGM_Reading", "PUMP_Status", "PUMP_Ack"])
    for name, counters in {"CGM_Reading": (0, 2, 3), "PUMP_Status": (14, 1), "PUMP_Ack": (15, 0)}.items():
        for counter in counters:
            receiver.receive(protected(name, counter))
    assert [receiver.lost_of(name) for name in ("CGM_Reading", "PUMP_Status", "PUMP_Ack")] == [1, 2, 0]
    assert receiver.lost == 3


def test_reset_forgets_counters_but_not_counts() -> None:
    receiver = Receiver(["CGM_Reading"])
    receiver.receive(protected("CGM_Reading", 3))
    receiver.receive(protected("CGM_Reading", 5))
    receiver.reset()
    assert receiver.receive(protected("CGM_Reading", 5)).check == Check.OK
    assert receiver.lost == 1


@each_message
def test_wrong_lengths_are_refused_and_counted(name: str) -> None:
    message = codec.message(name)
    data = codec.protect(message, message.pack(sample(name)), 1)
    wrong = [length for length in range(9) if length != message.length]
    receiver = Receiver([name])
    for number, length in enumerate(wrong, start=1):
        assert receiver.receive(Frame(message.can_id, (data + bytes(8))[:length])) == (Check.MALFORMED, name, {}, 0)
        assert receiver.malformed == number
    assert receiver.crc_errors == receiver.lost == receiver.sequence_errors == 0


@each_message
@pytest.mark.parametrize("flags", [CAN_RTR_FLAG, CAN_EFF_FLAG, CAN_EFF_FLAG | CAN_RTR_FLAG])
def test_remote_and_29_bit_frames_with_a_known_id_are_refused_and_counted(name: str, flags: int) -> None:
    message = codec.message(name)
    data = codec.protect(message, message.pack(sample(name)), 1)
    receiver = Receiver([name])
    assert receiver.receive(Frame(message.can_id | flags, data)) == (Check.MALFORMED, name, {}, 0)
    assert receiver.malformed == 1
    assert receiver.receive(Frame(message.can_id, data)).check == Check.OK


def test_foreign_frames_are_nobodys() -> None:
    receiver = Receiver(["CGM_Reading"])
    cgm = codec.message("CGM_Reading").can_id
    foreign = [
        *(can_id for can_id in range(0x800) if can_id != cgm),
        CAN_EFF_FLAG | 0x18FF0000 | cgm,
        CAN_EFF_FLAG | CAN_RTR_FLAG | 1 << 11 | cgm,
        CAN_RTR_FLAG | 0x7FF,
    ]
    for can_id in foreign:
        assert receiver.receive(Frame(can_id, bytes(8))) == (Check.UNKNOWN, "", {}, 0)
    assert receiver.malformed == receiver.crc_errors == 0


def test_an_error_frame_is_nobodys_whatever_its_class() -> None:
    """The classes of an error frame stand where an identifier would: 0x100, "restarted", is no CGM_Reading."""
    receiver = Receiver(NAMES)
    for can_id in {1 << bit for bit in range(11)} | {codec.message(name).can_id for name in NAMES}:
        assert receiver.receive(Frame(CAN_ERR_FLAG | can_id, bytes(8))) == (Check.UNKNOWN, "", {}, 0)
    assert receiver.malformed == 0


@settings(max_examples=300, deadline=None, database=None)
@given(
    st.integers(0, 0xFFFFFFFF) | st.sampled_from([codec.message(name).can_id for name in NAMES]), st.binary(max_size=8)
)
def test_a_receiver_survives_everything(can_id: int, data: bytes) -> None:
    receiver = Receiver(NAMES)
    found = receiver.receive(Frame(can_id, data))
    assert (found.check <= Check.OK_SOME_LOST) or found.values == {}


# ---- the transmitter


def test_counters_count_by_message_and_wrap() -> None:
    transmitter = Transmitter()
    for number in range(40):
        assert transmitter.frame("PUMP_Status").data[1] & 0xF == number % 16
        if number % 3 == 0:
            assert transmitter.frame("PUMP_Delivered").data[1] & 0xF == number // 3 % 16


def test_a_refused_value_uses_up_no_count() -> None:
    transmitter = Transmitter()
    transmitter.frame("PUMP_Status")
    with pytest.raises(CodecError):
        transmitter.frame("PUMP_Status", PumpBattery=300)
    assert transmitter.frame("PUMP_Status").data[1] & 0xF == 1


def test_the_same_calls_give_the_same_bytes() -> None:
    calls = [(name, sample(name, seed)) for name in NAMES for seed in range(3)]
    runs = []
    for _ in range(2):
        transmitter = Transmitter()
        runs.append([transmitter.frame(name, **values) for name, values in calls])
    assert runs[0] == runs[1]


def test_a_turn_closes_with_a_count_of_its_frames() -> None:
    turn = Turn(Transmitter())
    turn.send("HB_CTRL", NmtCtrl=5)
    turn.send("CTRL_Status", CtrlMode=6)
    frames = turn.close(7, Done.CONTINUE)
    done = codec.message("SYNC_Done")
    assert [frame.can_id for frame in frames] == [0x701, 0x300, done.can_id]
    values = done.unpack(frames[-1].data)
    assert (values["TxCount"], values["DoneStepIndex"], values["DoneStatus"]) == (3, 7, Done.CONTINUE)
    assert done.unpack(turn.close(8)[-1].data)["TxCount"] == 1
    for _ in range(300):
        turn.send("HB_CTRL")
    assert done.unpack(turn.close(9)[-1].data)["TxCount"] == 254


# ---- the vectors other people check themselves against


def page() -> str:
    return (Path(__file__).resolve().parents[1] / "docs" / "protocol.md").read_text(encoding="utf-8")


def vectors() -> list[tuple[str, dict[str, int], int | None, bytes]]:
    found = re.findall(
        r"^\| (\w+) \| ((?:\w+=-?\d+ ?)+) \| (\d+|-) \| `([0-9a-f ]+)` \|$", page().split("## Test vectors")[1], re.M
    )
    return [
        (
            name,
            {key: int(raw) for key, raw in (pair.split("=") for pair in values.split())},
            None if counter == "-" else int(counter),
            bytes.fromhex(data),
        )
        for name, values, counter, data in found
    ]


def test_the_vectors_in_the_page_are_right_by_cantools_and_our_own_profile_2() -> None:
    found = vectors()
    assert len(found) == page().split("## Test vectors")[1].count("\n| ") - 1
    assert {"CGM_Reading", "PUMP_BasalCmd", "PUMP_BolusCmd", "SYNC_Done", "CFG_Param"} <= {v[0] for v in found}
    for name, values, counter, data in found:
        message = codec.message(name)
        decoded = table(name).decode(data, decode_choices=False, scaling=False)
        assert {key: decoded[key] for key in values} == values
        if counter is None:
            assert message.data_ids is None
        else:
            assert message.data_ids is not None
            assert decoded["COUNTER"] == counter
            assert decoded["CHECKSUM"] == profile_2(data, message.data_ids)


def test_the_data_ids_in_the_page_are_those_of_the_dbc() -> None:
    for name in PROTECTED:
        section = page().split(f"\n### {name}\n")[1].split("\n### ")[0]
        (ids,) = re.findall(r"data ids `([0-9a-f ]+)`", section)
        assert bytes.fromhex(ids) == codec.message(name).data_ids
