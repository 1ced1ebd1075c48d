"""A run followed while it is on: the same frames, steps and times as afterwards, each frame once."""

import random
from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import pytest
from pumpbench.capture import Capture, Follower, NewRun
from pumpbench.frames import Frames
from synthetic_capture import Loop, dropping

from can_bus import codec
from can_bus.frame import Frame, pack
from can_bus.lockstep import Done

Sent = list[tuple[int, Frame]]


def finish(sent: Sent) -> Frames:
    capture = Capture()
    for channel, frame in sent:
        capture.extend(channel, [frame])
    return capture.finish()


def follow(sent: Sent, seed: int, *, longest: int = 90) -> Iterator[tuple[int, Frames]]:
    """What comes after how many frames, when they arrive in batches of random lengths."""
    rng = random.Random(seed)
    follower = Follower(1 + max(channel for channel, _ in sent))
    position = 0
    while position < len(sent):
        batch = sent[position : position + rng.randint(1, longest)]
        position += len(batch)
        for channel, frame in batch:
            follower.extend(channel, pack([frame]))
        yield position, follower.take()
    yield position, follower.take(over=True)


def joined(parts: Iterator[tuple[int, Frames]]) -> Frames:
    frames = [each for _, each in parts]
    return Frames(*(np.concatenate([getattr(each, f.name) for each in frames]) for f in fields(Frames))).in_order()


def same(one: Frames, other: Frames) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Frames))


@pytest.fixture(scope="module")
def gateway() -> Sent:
    """With an announced meal in step 96, whose bolus takes further turns."""
    return Loop(100, occlusion=range(40, 44), faults=dropping("CGM_Reading", range(24, 36))).run_frames()


@pytest.mark.parametrize("seed", range(8))
def test_followed_or_finished_the_frames_are_the_same(gateway: Sent, seed: int) -> None:
    assert same(joined(follow(gateway, seed)), finish(gateway))


@pytest.mark.parametrize("name", ["SYNC_Step", "SYNC_Done"])
def test_with_lost_tokens_and_lost_answers(name: str) -> None:
    sent = Loop(60, faults=dropping(name, range(24, 36, 5))).run_frames()
    for seed in range(4):
        assert same(joined(follow(sent, seed)), finish(sent))


def test_a_step_is_handed_out_when_the_device_has_closed_it(gateway: Sent) -> None:
    sent = [(0, frame) for channel, frame in gateway if channel == 0]
    done = codec.message("SYNC_Done")
    follower, steps = Follower(1), []
    for channel, frame in sent:
        follower.extend(channel, pack([frame]))
        frames = follower.take()
        closes = frame.can_id == done.can_id and done.unpack(frame.data)["DoneStatus"] != Done.CONTINUE
        if len(frames):
            assert closes
            assert frames.frame(len(frames) - 1) == frame
            steps += sorted(set(frames.step.tolist()))
    assert steps == list(range(101))


def test_a_device_that_answers_no_token_is_one_step_behind() -> None:
    done = codec.message("SYNC_Done").can_id
    sent = [(0, frame) for _, frame in Loop(20).run_frames() if frame.can_id != done]
    for seed in range(4):
        parts = list(follow(sent, seed, longest=20))
        assert same(joined(iter(parts)), finish(sent))
        assert sum(len(frames) > 0 for _, frames in parts) > 10


def test_only_a_window_is_kept(gateway: Sent) -> None:
    follower = Follower(2)
    for position, (channel, frame) in enumerate(gateway):
        follower.extend(channel, pack([frame]))
        if position % 50 == 0:
            follower.take()
    assert max(len(raw) for raw in follower._raw) < 16 * 200


def test_a_new_run_on_the_same_bus_is_told_apart() -> None:
    aborted, again = Loop(10, seed=1).run_frames()[:-20], Loop(5, seed=2).run_frames()
    sent = [*aborted, *again]
    with pytest.raises(NewRun) as raised:
        list(follow(sent, 1))
    (taken,) = raised.value.taken
    assert 0 < taken <= len(aborted)
    assert same(joined(follow(sent[taken:], 1)), finish(sent))
    assert same(finish(sent), finish(again))


@pytest.mark.parametrize("seed", range(4))
def test_no_traffic_breaks_it(seed: int) -> None:
    rng = random.Random(seed)
    sent = [(0, Frame(rng.randrange(2048), rng.randbytes(rng.randrange(9)))) for _ in range(3000)]
    assert same(joined(follow(sent, seed, longest=400)), finish(sent))
