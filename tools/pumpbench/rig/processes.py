"""The processes of a run: started here, watched while it is on, and ended with it."""

import contextlib
import os
import select
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

READY_SECONDS: Final = 30.0
PATIENCE_SECONDS: Final = 2.0

DEVICE: Final = "firmware"
"""What the device's process is called."""


class NodeDied(RuntimeError):
    """A process of the run ended or failed; the text names it and repeats its last words."""


class Child:
    """A process of the run: ends with it, and its last words are kept.

    Args:
        name: what to call it.
        command: that starts it.
        bus: the URL of the device's bus, for its environment variable PUMPBENCH_BUS.
        log: gets what it prints.
        ready: it says "ready" on its standard output, which `wait_ready` reads.
        keep: descriptors that it inherits.
        cpus: that it may run on; none: those of this process.
        patience: seconds it may take to end when it is asked to.

    Raises:
        NodeDied: it cannot be started.
    """

    def __init__(
        self,
        name: str,
        command: list[str],
        bus: str,
        log: IO[bytes],
        *,
        ready: bool = False,
        keep: Sequence[int] = (),
        cpus: Collection[int] = (),
        patience: float = PATIENCE_SECONDS,
    ) -> None:
        self.name = name
        self._patience = patience
        self._log = log
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if ready else log,
                stderr=log,
                env=os.environ | {"PUMPBENCH_BUS": bus, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,
                pass_fds=keep,
            )
        except OSError as error:
            raise NodeDied(f"cannot start the {name} ({shlex.join(command)}): {error.strerror}") from error
        if cpus:
            os.sched_setaffinity(self.process.pid, cpus)

    def wait_ready(self, seconds: float, poll: Callable[[], None]) -> None:
        """Wait for the line "ready" while `poll` keeps the hub going."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            poll()
            if select.select([self.process.stdout], [], [], 0.01)[0]:
                if self.process.stdout.readline().strip() == b"ready":
                    return
                raise self.died()
        raise NodeDied(f"the {self.name} was not ready within {seconds:g} s{self._last_words()}")

    def kill(self) -> None:
        """SIGKILL, to the process and to everything it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def check(self) -> None:
        """Raise if the process has ended."""
        if self.process.poll() is not None:
            raise self.died()

    def died(self) -> NodeDied:
        """What to say of a process that ended too early."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)
        code = self.process.returncode
        how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else f"ended with status {code}"
        return NodeDied(f"the {self.name} {how} in the middle of the run{self._last_words()}")

    def finish(self, seconds: float) -> int | None:
        """Wait for a normal end; the exit status, None if it did not come."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def end(self) -> None:
        """End the process and everything it started."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
                os.killpg(self.process.pid, signal.SIGCONT)  # one that a fault has stopped would not end
            if self.finish(self._patience) is not None and number == signal.SIGTERM:
                # the leader has gone; whoever it started is in its session
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
                break
        if self.process.stdout is not None:
            self.process.stdout.close()

    def _last_words(self) -> str:
        self._log.flush()
        with Path(self._log.name).open("rb") as log:
            lines = log.read().decode(errors="replace").strip().splitlines()
        return f": {lines[-1]}" if lines else ""


class Crew:
    """All processes of a run. It is a context: whoever is left at its end is ended.

    Args:
        place: a folder for what they print.
        bus: the URL of the device's bus.
        poll: called while one of them starts, e.g. to keep a hub of this process going.
    """

    def __init__(self, place: Path, bus: str, poll: Callable[[], None]) -> None:
        self.members: list[Child] = []
        self._place = place
        self._bus = bus
        self._poll = poll
        self._logs = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for child in self.members:
            child.end()
        self._logs.close()

    def start(self, name: str, command: list[str], **keys: Any) -> Child:
        """Start a process; `keys` are those of `Child`.

        Raises:
            NodeDied: it cannot be started, or ends before it is ready.
        """
        log = self._logs.enter_context((self._place / f"{name}.log").open("ab"))
        child = Child(name, command, self._bus, log, **keys)
        self.members.append(child)
        if keys.get("ready"):
            child.wait_ready(READY_SECONDS, self._poll)
        return child

    def check(self) -> None:
        """Raise if a process but the device's has ended; that one may have been switched off.

        Raises:
            NodeDied: one has.
        """
        for child in list(self.members):  # another thread may start the device anew
            if child.name != DEVICE:
                child.check()


@contextlib.contextmanager
def one_cpu() -> Iterator[frozenset[int]]:
    """Keep this process, and what it starts, on one CPU; yields the others, for those who need not wait their turn.

    In lockstep only one side runs at a time. Handing the turn over within a CPU takes a fifth of the time that waking
    another CPU does (measured in a virtual machine: 10 against 55 to 75 us there and back).
    """
    if not hasattr(os, "sched_setaffinity"):
        yield frozenset()
        return
    cpus = os.sched_getaffinity(0)
    mine = sorted(cpus)[os.getpid() % len(cpus)]
    os.sched_setaffinity(0, {mine})
    try:
        yield frozenset(cpus - {mine})
    finally:
        os.sched_setaffinity(0, cpus)
