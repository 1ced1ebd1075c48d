"""The plant beside a device that keeps time by itself: nobody waits for anybody, and no two runs are the same.

The wall clock, times a speed, is the simulated time. SYNC_Step tells it, behind everything of its instant, and is not
answered; commands are taken whenever they come, answered at once, and act in the interval in which they came.
"""

import logging
import time
from collections.abc import Callable, Sequence

from can_bus.frame import Frame
from can_bus.link import Link
from can_bus.lockstep import STEP_SECONDS, Done, Phase

from .pump import NMT_BOOT_UP
from .serve import WATCH_EVERY, MemberSilent
from .server import PlantError, PlantServer, judge_version

_log = logging.getLogger("plant_server.free_run")

CALL_EVERY = 1.0
"""Seconds between two roll calls: it takes no answer, only somebody who listens."""


class FreePlant(PlantServer):
    """A plant that does not wait. Its turns are `begin`, `open_first` and then `tick` every five minutes."""

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame of the device; what the pump answers goes out at once.

        Raises:
            PlantError: see `PlantServer.receive`.
        """
        super().receive(frame)
        answers, self._outbox = self._outbox, []
        return answers

    def _hear_heartbeat(self, values: dict[str, int]) -> list[Frame]:
        if values["NmtCtrl"] == NMT_BOOT_UP:
            self._receiver.reset()
        return []

    def _on_done(self, values: dict[str, int]) -> list[Frame]:
        return []  # a device that could do lockstep, too

    def begin(self) -> list[Frame]:
        """Somebody was heard: the calibration, to be sent.

        Raises:
            PlantError: it speaks another protocol version.
        """
        warning = judge_version(self._version, Done.OK)
        if warning is not None:
            _log.warning("%s", warning)
        return self._configure()

    @property
    def calibrated(self) -> bool:
        """Whether every parameter was echoed."""
        return self._echoes.keys() >= self.run.calibration.keys()

    def open_first(self) -> list[Frame]:
        """The calibration had its time: the batch of instant 0.

        Raises:
            PlantError: a parameter was echoed with another value, or not at all where others were.
        """
        if self._echoes:
            self._check_calibration()
        else:
            _log.warning("CTRL echoed no parameter of the calibration: it doses by one of its own")
        return self._open_step()

    def tick(self) -> list[Frame]:
        """Five minutes have passed: the batch of the next instant; `finished` when it was the last one.

        Raises:
            PlantError: the device runs in another mode than it was asked for.
        """
        if self.step == 0 and self._mode_seen != self.run.mode:
            if self._mode_seen is not None:
                raise PlantError(f"CTRL did not take up the mode: {self._mode_found()}")
            _log.warning("CTRL has not said in which mode it is: no CTRL_Status came in the first five minutes")
        self._advance()
        batch = self._open_step()
        self.finished = self._phase == Phase.END
        return batch


def serve_free(
    plant: FreePlant,
    link: Link,
    *,
    speed: float = 1.0,
    connect_timeout: float = 10.0,
    step_timeout: float = 10.0,
    watch: Callable[[], None] = lambda: None,
    progress: Callable[[int], None] = lambda step: None,
) -> None:
    """Run the plant by the wall clock to the end of its run.

    Args:
        plant: a fresh one.
        link: the plant's bus.
        speed: simulated seconds in a second of wall clock.
        connect_timeout: seconds of wall clock to wait for the first frame of the device.
        step_timeout: seconds the device has for the echoes of its calibration.
        watch: called while waiting; raises when a process of the run has died.
        progress: called with the number of every step.

    Raises:
        MemberSilent: nothing was heard of the device.
        PlantError: the device broke the protocol.
        BusLost: the bus is gone or lost frames.
    """
    start = time.monotonic()
    while not plant.heard:
        if time.monotonic() >= start + connect_timeout:
            raise MemberSilent(f"waited {connect_timeout:g} s for a frame of CTRL: the firmware is not on this bus")
        link.send(plant.call_roll())
        _listen(plant, link, time.monotonic() + CALL_EVERY, watch, lambda: plant.heard)
    link.send(plant.begin())
    _listen(plant, link, time.monotonic() + step_timeout, watch, lambda: plant.calibrated)
    start = time.monotonic()
    link.send(plant.open_first())
    late = False
    while not plant.finished:
        due = start + (plant.step + 1) * STEP_SECONDS / speed
        _listen(plant, link, due, watch, lambda: False)
        link.send(plant.tick())
        progress(plant.step)
        behind = (time.monotonic() - due) * speed
        if behind > STEP_SECONDS and not late:
            late = True
            _log.warning("this machine is too slow for this speed: step %d came %.0f s late", plant.step, behind)


def _listen(plant: FreePlant, link: Link, until: float, watch: Callable[[], None], enough: Callable[[], bool]) -> None:
    """Take frames and answer them until a moment of the wall clock, at least those that are there."""
    while True:
        left = max(until - time.monotonic(), 0.0)
        frames = link.recv(min(left, WATCH_EVERY))
        for frame in frames:
            answer = plant.receive(frame)
            if answer:
                link.send(answer)
        if not frames:
            watch()
        if enough() or time.monotonic() >= until:
            return
