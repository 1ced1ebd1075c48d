"""Listening to the buses of a run until it is over on all of them."""

import select
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from can_bus import codec
from can_bus.link import Link
from can_bus.lockstep import Phase
from pumpbench.capture import Capture

COALESCE_SECONDS: Final = 0.005
"""On a hub nothing is lost while we sleep, and one wake-up then fetches many frames."""


class Ending:
    """Knows from the frames of one bus when the run is over: SYNC_Done after SYNC_Step(End).

    Args:
        free_running: the device does not answer; SYNC_Step(End) is the end.
    """

    def __init__(self, *, free_running: bool = False) -> None:
        self._free_running = free_running
        self._step_id = codec.message("SYNC_Step").can_id
        self._done_id = codec.message("SYNC_Done").can_id
        self._ending = False
        self.over = False

    def watch(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Look at frames in passing."""
        for can_id, data in frames:
            if can_id == self._step_id and len(data) == 8:
                self._ending = data[1] >> 4 == Phase.END
                self.over |= self._ending and self._free_running
            elif can_id == self._done_id and self._ending:
                self.over = True


def listen(
    links: Sequence[Link], capture: Capture, watch: Mapping[int, Callable[[], bool]], *, free_running: bool = False
) -> bool:
    """Collect frames until the run is over on every bus; False if told to end before.

    Args:
        links: the buses, the device's first.
        capture: gets the frames.
        watch: other descriptors, and what to do once one of them becomes readable; True ends the recording.
        free_running: the device answers no token.

    Raises:
        BusLost: a bus is gone or frames were lost.
        NotWritten: a frame could not be kept.
    """
    endings = [Ending(free_running=free_running) for _ in links]
    buses = {link.fileno(): channel for channel, link in enumerate(links)}
    others = dict(watch)
    lossless = all(link.url.startswith(("unix:", "tcp:", "inproc:")) for link in links)

    def collect(channel: int) -> None:
        frames = links[channel].recv(0)
        capture.extend(channel, frames)
        endings[channel].watch(frames)

    while buses:
        ready, _, _ = select.select([*buses, *others], [], [])
        told = [others.pop(descriptor)() for descriptor in ready if descriptor in others]
        stop = any(told)
        for descriptor, channel in list(buses.items()):
            if descriptor in ready or stop:
                collect(channel)
            if endings[channel].over:  # this bus may be closed now while the other one still talks
                del buses[descriptor]
        if stop:
            return not buses
        if lossless:
            time.sleep(COALESCE_SECONDS)
    return True
