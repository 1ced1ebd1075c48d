"""Simulated time and the turn travel in frames: the two ends of the lockstep, without any input or output.

One side at a time speaks. The plant puts everything of instant k on the bus and then the token `SYNC_Step(k)`; the
device answers with its commands and then `SYNC_Done(k)`, and is silent until the next token. Both frames are FIFO
barriers, so a run does not depend on load, on the transport, or on who is faster. A device that needs the pump's answer
within the same instant (the bolus protocol) says Continue and gets a further turn.

    roll call    PLANT_Info, SYNC_Step(Init, n)       ->  HB_CTRL, CTRL_Info, SYNC_Done(n)       (n counts the calls)
    calibration  CFG_Param .., MODE_Cmd, Step(Config) ->  CFG_ParamEcho .., SYNC_Done
    instant k    CGM_Reading, PUMP_.., SYNC_Step(k)   ->  PUMP_BasalCmd, CTRL_Status .., SYNC_Done(k)
    the end      last totals, SYNC_Step(End)          ->  SYNC_Done

A roll call starts a new run: both sides forget the counters of the E2E protection, so that a run's bytes do not depend
on how often the roll was called. This module does not know what the other frames mean.
"""

import enum
from collections.abc import Sequence
from typing import Protocol

from can_bus.codec import Transmitter
from can_bus.frame import Frame

STEP_SECONDS = 300
STEP_MINUTES = STEP_SECONDS // 60
STEPS_PER_DAY = 86400 // STEP_SECONDS
"""Of simulated time, from one sampling instant to the next."""

EXEC_TIME_SNA = 65535
EXEC_TIME_MAX = 65533
"""Of SYNC_Done, raw; 65534 is a code without a name."""

TURNS_PER_STEP = 32
"""Further turns a device may ask for in one instant before the plant calls it stuck."""


class Phase(enum.IntEnum):
    """SYNC_Step.SyncPhase."""

    INIT = 0
    STEP = 1
    PAUSE = 2
    RESUME = 3
    END = 4
    CONTINUE = 5
    CONFIG = 6


class Done(enum.IntEnum):
    """SYNC_Done.DoneStatus."""

    OK = 0
    OVERRUN = 1
    FAULT = 2
    CONTINUE = 3


class Node(Protocol):
    """Anything on the bus, as a function from a frame to the frames it answers with.

    Nodes never wait and never look at a clock, so the same node runs in a process of its own or beside the others.
    """

    @property
    def finished(self) -> bool:
        """True when the node has nothing more to do."""

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame and return what it makes the node send, in order."""


class Turn:
    """The device's side: collects what it sends in a turn and closes the turn with SYNC_Done."""

    def __init__(self, transmitter: Transmitter) -> None:
        self.transmitter = transmitter
        self._frames: list[Frame] = []

    def send(self, name: str, **values: int) -> None:
        """Queue a frame for this turn."""
        self._frames.append(self.transmitter.frame(name, **values))

    def take(self) -> list[Frame]:
        """All queued frames, for what is said out of turn: the heartbeat of a device that has just started."""
        frames = self._frames
        self._frames = []
        return frames

    def close(self, step: int, status: Done = Done.OK, work: int | None = None) -> list[Frame]:
        """All queued frames and SYNC_Done, whose TxCount counts them and itself; `work` is told as ExecTime."""
        frames = self.take()
        done = self.transmitter.frame(
            "SYNC_Done",
            DoneStatus=status,
            DoneStepIndex=step,
            ExecTime=EXEC_TIME_SNA if work is None else min(work, EXEC_TIME_MAX),
            TxCount=min(len(frames) + 1, 254),
        )
        return [*frames, done]
