"""ISO-TP: frame by frame against the standard, and message by message against can-isotp."""

from collections import deque

import isotp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_sim.isotp import RECEIVE_MAX, SEND_MAX, IsoTp

CTS = bytes([0x30, 0, 0]) + b"\xcc" * 5
FULL = bytes([0x32, 0, 0]) + b"\xcc" * 5


def take(tp: IsoTp, *frames: bytes) -> list[tuple[bytes | None, list[bytes]]]:
    return [tp.receive(frame) for frame in frames]


# ---- receiving


@pytest.mark.parametrize("padding", [b"", b"\x00\x00", b"\xcc" * 5])
def test_a_single_frame_with_or_without_padding(padding: bytes) -> None:
    assert IsoTp().receive(b"\x02\x3e\x00" + padding) == (b"\x3e\x00", [])
    assert IsoTp().receive(b"\x07abcdefg") == (b"abcdefg", [])


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\x00",
        b"\x00abc",
        b"\x03ab",
        b"\x08abcdefg",
        b"\x0fabcdefg",
        b"\x40abc",
        b"\xf0",
        b"\x30\x00",
        b"\x21abcdefg",
    ],
)
def test_what_makes_no_sense_is_ignored(frame: bytes) -> None:
    tp = IsoTp()
    assert tp.receive(frame) == (None, [])
    assert tp.receive(b"\x01\x3e") == (b"\x3e", [])


def test_a_long_request_is_put_together() -> None:
    answers = take(IsoTp(), b"\x10\x14abcdef", b"\x21ghijklm", b"\x22nopqrst\xcc"[:8])
    assert answers == [(None, [CTS]), (None, []), (b"abcdefghijklmnopqrst", [])]


def test_numbers_of_frames_wrap() -> None:
    message = bytes(range(RECEIVE_MAX))
    tp = IsoTp()
    assert tp.receive(bytes([0x10, RECEIVE_MAX]) + message[:6]) == (None, [CTS])
    rest = [message[i : i + 7] for i in range(6, RECEIVE_MAX, 7)]
    assert len(rest) > 16
    results = [tp.receive(bytes([0x20 | (i + 1) % 16]) + part)[0] for i, part in enumerate(rest)]
    assert results[:-1] == [None] * (len(rest) - 1)
    assert results[-1] == message


@pytest.mark.parametrize(
    "frames",
    [
        (b"\x10\x14abcdef", b"\x22nopqrst", b"\x21ghijklm", b"\x22nopqrst"),  # one is missing
        (b"\x10\x14abcdef", b"\x21ghijklm", b"\x21ghijklm", b"\x22nopqrst"),  # one came twice
        (b"\x10\x14abcdef", b"\x21ghijkl", b"\x22nopqrst"),  # one is short
        (b"\x10\x14abcde", b"\x21ghijklm", b"\x22nopqrst"),  # a first frame has eight bytes
        (b"\x10\x07abcdef", b"\x21ghijklm"),  # that would have been a single frame
        (b"\x10\x14abcdef", b"\x01\x3e", b"\x21ghijklm", b"\x22nopqrst"),  # another request in between
    ],
)
def test_a_transfer_that_goes_wrong_is_dropped_and_the_next_one_works(frames: tuple[bytes, ...]) -> None:
    tp = IsoTp()
    assert all(message in (None, b"\x3e") for message, _ in take(tp, *frames))
    assert take(tp, b"\x10\x09abcdef", b"\x21ghi")[-1] == (b"abcdefghi", [])


@pytest.mark.parametrize("first", [bytes([0x10, RECEIVE_MAX + 1]), b"\x1f\xff", b"\x10\x00"])
def test_a_request_that_is_too_long_is_told(first: bytes) -> None:
    tp = IsoTp()
    assert tp.receive(first + b"abcdef") == (None, [FULL])
    assert tp.receive(b"\x21ghijklm") == (None, [])


# ---- sending


def test_a_short_answer_is_padded() -> None:
    assert IsoTp().send(b"abc") == [b"\x03abc\xcc\xcc\xcc\xcc"]
    assert IsoTp().send(b"abcdefg") == [b"\x07abcdefg"]


def test_a_long_answer_waits_for_the_receiver() -> None:
    tp = IsoTp()
    assert tp.send(bytes(range(30))) == [b"\x10\x1e" + bytes(range(6))]
    assert tp.receive(b"\x31\x00\x00") == (None, [])  # not yet
    assert tp.receive(b"\x30\x02\x00") == (None, [b"\x21" + bytes(range(6, 13)), b"\x22" + bytes(range(13, 20))])
    assert tp.receive(b"\x30\x02\x14") == (
        None,
        [b"\x23" + bytes(range(20, 27)), b"\x24" + bytes(range(27, 30)) + b"\xcc" * 4],
    )
    assert tp.receive(b"\x30\x00\x00") == (None, [])


@pytest.mark.parametrize("status", [2, 3, 15])
def test_a_receiver_that_refuses_gets_no_more(status: int) -> None:
    tp = IsoTp()
    tp.send(bytes(30))
    assert tp.receive(bytes([0x30 | status, 0, 0])) == (None, [])
    assert tp.receive(b"\x30\x00\x00") == (None, [])


def test_a_new_request_ends_an_answer_that_is_half_sent() -> None:
    tp = IsoTp()
    tp.send(bytes(30))
    assert tp.receive(b"\x01\x3e") == (b"\x3e", [])
    assert tp.receive(b"\x30\x00\x00") == (None, [])


@pytest.mark.parametrize("length", [0, SEND_MAX + 1])
def test_what_cannot_be_sent_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=f"a message of {length} bytes"):
        IsoTp().send(bytes(length))


# ---- against can-isotp


@settings(max_examples=60, deadline=None)
@given(
    request=st.binary(min_size=1, max_size=RECEIVE_MAX),
    answer=st.binary(min_size=1, max_size=SEND_MAX),
    block=st.integers(0, 20),
    padded=st.booleans(),
)
def test_can_isotp_understands_and_is_understood(request: bytes, answer: bytes, block: int, padded: bool) -> None:
    ours, to_peer = IsoTp(), deque[bytes]()
    heard: list[bytes] = []

    def deliver(frame: isotp.CanMessage) -> None:
        message, frames = ours.receive(bytes(frame.data))
        to_peer.extend(frames)
        if message is not None:
            heard.append(message)
            to_peer.extend(ours.send(answer))

    def fetch(_timeout: float) -> isotp.CanMessage | None:
        return isotp.CanMessage(arbitration_id=0x7E8, data=to_peer.popleft(), dlc=8) if to_peer else None

    parameters = {"blocksize": block, "tx_padding": 0xAA if padded else None, "rx_consecutive_frame_timeout": 1000}
    address = isotp.Address(rxid=0x7E8, txid=0x7E0)
    peer = isotp.TransportLayerLogic(rxfn=fetch, txfn=deliver, address=address, params=parameters)
    peer.send(request)
    for _ in range(3000):
        peer.process()
        if peer.available():
            break
    assert heard == [request]
    assert peer.recv() == answer


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(max_size=8), max_size=30))
def test_any_frames_are_survived_and_answered_in_bounds(frames: list[bytes]) -> None:
    tp = IsoTp()
    for frame in frames:
        message, answers = tp.receive(frame)
        assert message is None or 0 < len(message) <= RECEIVE_MAX
        assert all(len(answer) == 8 for answer in answers)
        if message is not None:
            assert len(tp.send(message)[0]) == 8
