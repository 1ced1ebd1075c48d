"""A batch says to the bit what its transmitter would say frame by frame."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_bus import codec
from can_bus.batch import Batch
from can_bus.codec import CodecError, Transmitter
from plant_server.pump import REPORT
from plant_server.server import HEARTBEATS, READING, TOKEN, TRUTH

LAYOUT = (*READING, *REPORT, *HEARTBEATS, *TRUTH, *TOKEN)


def fields() -> list[codec.Field]:
    return [codec.message(name).fields[signal] for name, signals, _ in LAYOUT for signal in signals]


def any_values(reserved: bool) -> st.SearchStrategy[tuple[int, ...]]:
    def one(field: codec.Field) -> st.SearchStrategy[int]:
        inside = st.integers(field.low, field.high)
        codes = sorted(field.reserved)
        return inside | st.sampled_from(codes) if reserved and codes else inside

    return st.tuples(*map(one, fields()))


@settings(max_examples=60, deadline=None)
@given(st.lists(any_values(reserved=True), min_size=1, max_size=20))
def test_same_bytes_as_one_by_one(steps: list[tuple[int, ...]]) -> None:
    ours, theirs = Transmitter(), Transmitter()
    batch = Batch(ours, LAYOUT)
    for raws in steps:
        rest = iter(raws)
        expected = [
            theirs.frame(name, **constants, **{signal: next(rest) for signal in signals})
            for name, signals, constants in LAYOUT
        ]
        assert batch.frames(raws) == expected
        # the counters are the transmitter's: other frames in between keep their place
        assert ours.frame("HB_PUMP", NmtPump=0) == theirs.frame("HB_PUMP", NmtPump=0)
        assert ours.frame("SYNC_Step", SyncPhase=5) == theirs.frame("SYNC_Step", SyncPhase=5)


def test_a_value_out_of_range_is_named_and_uses_up_no_count() -> None:
    transmitter = Transmitter()
    batch = Batch(transmitter, TOKEN)
    with pytest.raises(CodecError, match=r"SYNC_Step\.SimTime: raw value -1 is outside"):
        batch.frames([1, 0, -1])
    assert transmitter.counters["SYNC_Step"] == 0


def test_a_layout_is_checked_against_the_dbc() -> None:
    with pytest.raises((CodecError, KeyError), match="NoSuchSignal"):
        Batch(Transmitter(), [("SYNC_Step", ("NoSuchSignal",), {})])
    with pytest.raises(CodecError, match="does not exist when TruthSel is 1"):
        Batch(Transmitter(), [("PLANT_Truth", ("TruthGlucose",), {"TruthSel": 1})])
