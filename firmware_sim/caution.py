"""Why the device gives no more than the schedule though sensor and pump are good: a clock that jumped, many resets."""

from collections.abc import Iterator

from can_bus.lockstep import STEP_SECONDS

SIM_TIME_SNA = 268435455

CLOCK_TOLERANCE = 60
"""Seconds that SimTime may be off the step it names (requirement TIM-03)."""

CLOCK_CAUTION = 3
"""Samples after a jump of the clock in which insulin stays at or below the schedule (project's choice)."""

RESETS_KEPT = 5
RESETS_WITHIN = 12
"""So many resets within so many steps hold SafeBasal until the user resumes (requirement RST-04)."""


class Caution:
    """What is held against the clock and against resets.

    Attributes:
        held: too many resets: nothing but the schedule until the user resumes.
    """

    def __init__(self) -> None:
        self.held = False
        self._samples = 0  # to come before the clock is trusted again
        self._resets: list[int] = []  # first steps after the last ones
        self._jump_step: int | None = None  # of the newest jump

    @property
    def clock_doubtful(self) -> bool:
        """Whether the clock has jumped a short while ago."""
        return self._samples > 0

    def check_clock(self, step: int, sim_time: int) -> bool:
        """Hold SimTime of a token against the step it names; whether it jumped."""
        off = sim_time - step * STEP_SECONDS
        if sim_time == SIM_TIME_SNA or -CLOCK_TOLERANCE <= off <= CLOCK_TOLERANCE:
            return False
        self._samples = CLOCK_CAUTION
        self._jump_step = step
        return True

    def sample(self, step: int) -> None:
        """A usable sample came; one in the step of the jump itself does not count."""
        if step != self._jump_step:
            self._samples = max(self._samples - 1, 0)

    def count_reset(self, step: int) -> None:
        """The first step after a reset within a run."""
        self._resets = [*self._resets, step][-RESETS_KEPT:]
        if len(self._resets) == RESETS_KEPT and step - self._resets[0] < RESETS_WITHIN:
            self.held = True

    def resume(self) -> None:
        """The user knows and goes on: resets are counted anew."""
        self.held = False
        self._resets.clear()

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""
        return [int(self.held), self._samples, *self._resets, *[-1] * (RESETS_KEPT - len(self._resets))]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""
        self.held = next(words) == 1
        self._samples = next(words)
        self._resets = [reset for reset in (next(words) for _ in range(RESETS_KEPT)) if reset >= 0]
