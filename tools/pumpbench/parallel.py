"""Work spread over processes of this machine."""

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Final, TypeVar

AT_ONCE: Final = 4
"""Items that a process gets at once."""

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def cpus() -> int:
    """How many this process may use, which in a container are not all there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """So many processes, for as long as the context lasts; what waits when it is left is not begun any more.

    They are spawned, not forked: this process may have threads (a progress bar's, numba's).
    """
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as executor:
        try:
            yield executor
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def in_parallel(
    function: Callable[[Item], Answer],
    items: Sequence[Item],
    processes: int,
    told: Callable[[int], None] = lambda done: None,
) -> Iterator[Answer]:
    """The answers in the order of the items; one process is this one.

    Args:
        function: of a module, so that another process finds it.
        items: to be asked about.
        processes: how many work on them.
        told: called with the number of items done.
    """
    if processes == 1:
        for done, item in enumerate(items, 1):
            yield function(item)
            told(done)
        return
    with pool(processes) as executor:
        for done, answer in enumerate(executor.map(function, items, chunksize=AT_ONCE), 1):
            yield answer
            told(done)
