"""Whether a node is alive, by its heartbeat (requirement E2E-07).

A heartbeat comes once per step with a bit that toggles. It has neither CRC nor counter, so all that can be told is that
nothing comes, or always the same: a heartbeat of the very next step whose bit stands still is none. After a step
without one the bit proves nothing, so a single lost heartbeat costs one step and not two.

A node that has never sent one is not missed: a bench may have none, and what dosing rests on has timeouts of its own.
"""

TIMEOUT = 3
"""Steps since the last heartbeat, more than 660 s (MsgTimeoutTime in the DBC), after which the node is silent."""

NEVER = -(1 << 20)


class Heartbeat:
    """The heartbeats of one node."""

    def __init__(self) -> None:
        self._toggle = -1  # of the newest one
        self._came = False  # since the last step
        self._moved = False
        self._came_step = NEVER
        self._alive_step = NEVER

    def hear(self, toggle: int) -> None:
        """One came."""
        self._came = True
        self._moved |= toggle != self._toggle
        self._toggle = toggle

    def close(self, step: int) -> None:
        """Judge what came for instant `step`."""
        if self._came:
            if self._moved or step - self._came_step > 1:
                self._alive_step = step
            self._came_step = step
        self._came = self._moved = False

    def silence(self, step: int) -> int:
        """Steps since the node was last alive; 0 if it has never told."""
        return 0 if self._alive_step == NEVER else step - self._alive_step
