"""Cooperative tasks on 1-s ticks of simulated time, each with a budget of counted work, and a watchdog.

Work is counted, not timed: frames handled, core steps done, words stored. So the counts are the same on every machine,
and a flood, an endless catch-up or a stuck task shows as what it is.
"""

from collections.abc import Callable
from typing import NamedTuple

BITES_AFTER = 3
"""Overruns in a row after which the watchdog bites: the device goes to Fault (project's choice)."""

NEVER = -(1 << 30)


class Task(NamedTuple):
    """One task.

    Attributes:
        name: as it is reported.
        period: ticks between two runs.
        budget: most work of one run.
        work: does it and returns how much it was.
    """

    name: str
    period: int
    budget: int
    work: Callable[[], int]


class Scheduler:
    """Runs what is due, in the order of the list.

    Attributes:
        overruns: runs beyond their budget, so far.
        late: name of the task that broke its budget in this tick, or "".
    """

    def __init__(self, tasks: tuple[Task, ...]) -> None:
        self._tasks = tasks
        self._last = [NEVER] * len(tasks)
        self.overruns = 0
        self.late = ""
        self._in_a_row = 0
        self._load = [0] * len(tasks)

    @property
    def bitten(self) -> bool:
        """Whether the watchdog has bitten: it does not let go until the device restarts."""
        return self._in_a_row >= BITES_AFTER

    def load(self, index: int, work: int) -> bool:
        """Let a task take so much more work in its next run; False if there is no such task."""
        if index >= len(self._tasks):
            return False
        self._load[index] = work
        return True

    def run(self, tick: int) -> int:
        """Run every task whose period has passed; the work done in all."""
        self.late = ""
        total = 0
        for index, task in enumerate(self._tasks):
            if tick - self._last[index] < task.period:
                continue
            self._last[index] = tick
            work = task.work() + self._load[index]
            self._load[index] = 0
            total += work
            if work > task.budget:
                self.overruns += 1
                self.late = task.name
        if not self.bitten:
            self._in_a_row = self._in_a_row + 1 if self.late else 0
        return total
