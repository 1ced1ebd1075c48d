"""Bring up the device under test: in this process, as a process on a hub of its own, or where somebody has put it."""

import contextlib
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from can_bus.faults.nodes import MemoryState
from can_bus.hub import Hub
from can_bus.link import Link
from can_bus.url import open_link
from pumpbench.conformance.device import Device, Remote
from pumpbench.conformance.registry import Need
from pumpbench.identity import SOMEBODY_ELSES
from pumpbench.rig import Child, NodeDied, RigError, firmware_command
from pumpbench.rig.power import Process

RESET_SECONDS = 30.0
"""How long a command that resets a device may take."""


@contextlib.contextmanager
def connected(
    bus: str = "inproc",
    firmware: str | None = None,
    *,
    timeout: float = 5.0,
    reset_hook: str | None = None,
) -> Iterator[tuple[Device, frozenset[Need]]]:
    """A device, and what is known of its memory: whether it keeps one, and whether it can be lost or torn from outside.

    Args:
        bus: `inproc`, `hub`, or the URL of the device's bus.
        firmware: the command that starts it; None for the reference; "none" for a device that runs by itself.
        timeout: seconds to wait for the end of a turn.
        reset_hook: command that resets a device which runs by itself.

    Raises:
        RigError: these do not go together.
        BusUrlError, CanInitializationError: the bus cannot be opened.
    """
    if bus == "inproc":
        if firmware is not None:
            raise RigError("--bus inproc is the reference firmware in this process; for another one give --bus hub")
        from pumpbench.conformance.reference import reference  # noqa: PLC0415

        yield reference(), frozenset({"nvm", "memory"})
        return
    if bus == "hub" and firmware == SOMEBODY_ELSES:
        raise RigError("a device that runs by itself needs the bus it is on: give its URL with --bus")
    with tempfile.TemporaryDirectory(prefix="pumpbench-") as directory, contextlib.ExitStack() as stack:
        place = Path(directory)
        url = f"unix:{place / 'bus.sock'}" if bus == "hub" else bus
        if bus == "hub":
            stack.enter_context(Hub(url)).start()
        link = stack.enter_context(open_link(url))
        if firmware == SOMEBODY_ELSES:
            restart = None if reset_hook is None else _hook(reset_hook, url)
            yield Remote(link, timeout=timeout, restart=restart), frozenset({"nvm"})
        else:
            yield stack.enter_context(_started(link, url, firmware, place, timeout))


@contextlib.contextmanager
def _started(
    link: Link, url: str, firmware: str | None, place: Path, timeout: float
) -> Iterator[tuple[Device, frozenset[Need]]]:
    """A device as a child process, which has a memory where its command has a place for one."""
    nvm = place / "nvm"
    keeps = firmware is None or "{nvm}" in firmware
    with (place / "firmware.log").open("ab") as log:

        def launch(memory: MemoryState) -> Child:
            command = firmware_command(firmware, url, nvm if keeps else None, memory)
            return Child("firmware", command, url, log)

        process = Process(launch, nvm)

        def restart(memory: MemoryState) -> None:
            process.cut()
            process.start(memory)

        offers: set[Need] = {"nvm"} if keeps else set()
        if firmware is None:
            offers.add("memory")  # of another firmware nobody knows what a torn one looks like
        try:
            yield Remote(link, timeout=timeout, watch=process.check, restart=restart), frozenset(offers)
        finally:
            process.child.end()


def _hook(command: str, url: str) -> Callable[[MemoryState], None]:
    def restart(_memory: MemoryState) -> None:
        words = [word.replace("{bus}", url) for word in shlex.split(command)]
        try:
            done = subprocess.run(
                words, timeout=RESET_SECONDS, check=False, stdin=subprocess.DEVNULL, capture_output=True, text=True
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NodeDied(f"--reset-hook {command!r}: {error}") from error
        if done.returncode != 0:
            raise NodeDied(
                f"--reset-hook {command!r} ended with status {done.returncode}: {done.stderr.strip()[-200:]}"
            )

    return restart
