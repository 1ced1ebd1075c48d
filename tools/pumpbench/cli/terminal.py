"""What all commands share: where they print, how they fail, how they show progress."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console

EXIT_WRONG, EXIT_USAGE, EXIT_DEAD, EXIT_INTERRUPTED = 1, 2, 3, 130

console = Console(highlight=False, emoji=False, width=None if sys.stdout.isatty() else 120)
errors = Console(stderr=True, highlight=False, emoji=False, soft_wrap=True)


class Failed(Exception):
    """A command has failed with this exit status; the text is the one line the user gets."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[str], Callable[[int, int], None]]]:
    """A bar with an estimate of the end, for a count of things done; what begins next takes its place."""
    from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn  # noqa: PLC0415

    columns = (*Progress.get_default_columns()[:3], MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:

        def begin(what: str) -> Callable[[int, int], None]:
            for over in bar.task_ids:
                bar.remove_task(over)
            task = bar.add_task(what, total=None)
            return lambda done, of: bar.update(task, completed=done, total=of)

        yield begin
