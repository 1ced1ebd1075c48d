"""How much of a drug was delivered within the last 24 hours (requirement LIM-06)."""

from collections.abc import Iterator

STEPS_PER_HOUR = 12
HOURS = 25
"""The hour that runs, and 24 before it: never less than 24 hours are counted."""


class Day:
    """A rolling sum by the hour."""

    def __init__(self) -> None:
        self._hours = [0] * HOURS
        self._hour = 0

    def add(self, amount: int, step: int) -> None:
        """Count what was delivered until instant `step`; steps that were skipped age what is there."""
        hour = step // STEPS_PER_HOUR
        for passed in range(min(hour - self._hour, HOURS)):
            self._hours[(hour - passed) % HOURS] = 0
        self._hour = max(hour, self._hour)
        self._hours[self._hour % HOURS] += amount

    @property
    def total(self) -> int:
        """What the window holds."""
        return sum(self._hours)

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""
        return [self._hour, *self._hours]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""
        self._hour = next(words)
        self._hours = [next(words) for _ in range(HOURS)]
