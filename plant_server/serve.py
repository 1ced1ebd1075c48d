"""The plant on a real bus: waits for frames by the wall clock, and says who is missing when nothing comes."""

import time
from collections.abc import Callable

from can_bus.link import Link

from .server import PlantServer

ROLL_CALL_EVERY = 0.1
"""Seconds between two roll calls; twice as many whenever the device's answer comes too late for the newest one."""

WATCH_EVERY = 0.25
"""Seconds of silence after which the caller's `watch` is asked whether everybody is still alive."""


class MemberSilent(RuntimeError):
    """The device stopped answering; the text names the node and the step."""


def serve(
    plant: PlantServer,
    link: Link,
    *,
    connect_timeout: float = 10.0,
    step_timeout: float = 10.0,
    watch: Callable[[], None] = lambda: None,
    progress: Callable[[int], None] = lambda step: None,
) -> None:
    """Run the plant on a bus to the end of its run.

    Args:
        plant: a fresh plant.
        link: the plant's bus.
        connect_timeout: seconds of wall clock to wait for the first answer to the roll call.
        step_timeout: seconds of wall clock to wait for SYNC_Done.
        watch: called while waiting; raises when a process of the run has died.
        progress: called with the step number now and then.

    Raises:
        MemberSilent: no answer in time.
        PlantError: the device broke the protocol.
        BusLost: the bus is gone or lost frames.
    """
    calling = True
    every = ROLL_CALL_EVERY
    late = 0
    link.send(plant.call_roll())
    heard = called = time.monotonic()  # others may talk on the bus all the time: only what is answered counts
    while not plant.finished:
        frames = link.recv(min(every, WATCH_EVERY) if calling else WATCH_EVERY)
        answered = False
        for frame in frames:
            answer = list(plant.receive(frame))
            if answer:
                link.send(answer)
                answered = True
        if answered:
            calling = False
            heard = time.monotonic()
            if plant.step % 16 == 0:
                progress(plant.step)
            continue
        if not frames:
            watch()
        now = time.monotonic()
        patience = connect_timeout if calling else step_timeout
        if not plant.finished and now > heard + patience:
            raise MemberSilent(_silence(plant, patience, calling=calling))
        if calling and plant.late_answers > late:
            late = plant.late_answers
            every *= 2
        if calling and now >= called + every:
            called = now
            link.send(plant.call_roll())


def _silence(plant: PlantServer, seconds: float, *, calling: bool) -> str:
    why = (
        "the firmware is not on this bus, hangs, or speaks something else; `pumpbench doctor` looks closer"
        if calling
        else "the firmware hangs, forgot SYNC_Done, or lost a frame"
    )
    return f"waited {seconds:g} s for {plant.waiting_for}: {why}"
