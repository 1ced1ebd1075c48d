"""How a gateway in a process of its own gets the device's power switched: by a command, or by whoever started both.

Requests are words: `cut`, `start kept`, `start torn`, `start lost`, `freeze`, `thaw` (`can_bus.faults.NodeControl`).
"""

import shlex
import socket
import subprocess
from typing import cast, get_args

from can_bus.faults import MemoryState, NodeControl

ANSWER_SECONDS = 60.0


class NodeControlError(OSError):
    """The device's power could not be switched; the text says by whom and why."""


class _Words:
    """A control whose requests are words."""

    def ask(self, request: str) -> None:
        """Have it done.

        Raises:
            NodeControlError: it was not.
        """
        raise NotImplementedError

    def cut(self) -> None:
        """See `NodeControl`; so for all that follow."""
        self.ask("cut")

    def start(self, memory: MemoryState) -> None:
        """Power again."""
        self.ask(f"start {memory}")

    def freeze(self) -> None:
        """Stand still."""
        self.ask("freeze")

    def thaw(self) -> None:
        """Go on."""
        self.ask("thaw")


class CommandControl(_Words):
    """A command that is run with the request as its last words, and has done it when it ends with status 0."""

    def __init__(self, command: str) -> None:
        self._command = shlex.split(command)
        if not self._command:
            raise ValueError("the command that switches the device is empty")

    def ask(self, request: str) -> None:
        """Run it."""
        command = [*self._command, *request.split()]
        try:
            done = subprocess.run(
                command, timeout=ANSWER_SECONDS, check=False, capture_output=True, text=True, stdin=subprocess.DEVNULL
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NodeControlError(f"{shlex.join(command)}: {error}") from error
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()
            raise NodeControlError(
                f"{shlex.join(command)} ended with status {done.returncode}{': ' + said[-1] if said else ''}"
            )


class SocketControl(_Words):
    """Whoever holds the other end of a stream socket: a line asks, a line answers, "ok" or what went wrong."""

    def __init__(self, connection: socket.socket) -> None:
        connection.settimeout(ANSWER_SECONDS)
        self._connection = connection
        self._lines = connection.makefile("r", encoding="utf-8")

    def ask(self, request: str) -> None:
        """Send it and wait."""
        try:
            self._connection.sendall(f"{request}\n".encode())
            answer = self._lines.readline().strip()
        except OSError as error:
            raise NodeControlError(f"{request}: nobody switches the device: {error}") from error
        if answer != "ok":
            raise NodeControlError(f"{request}: {answer or 'nobody switches the device any more'}")


def attend(connection: socket.socket, control: NodeControl) -> None:
    """Do what a `SocketControl` asks for until its end is closed; what fails is answered, not raised."""
    with connection, connection.makefile("r", encoding="utf-8") as lines:
        for line in lines:
            try:
                _do(line.split(), control)
                answer = "ok"
            except Exception as error:
                answer = " ".join(str(error).split()) or type(error).__name__
            connection.sendall(f"{answer}\n".encode())


def _do(words: list[str], control: NodeControl) -> None:
    match words:
        case ["cut"]:
            control.cut()
        case ["start", memory] if memory in get_args(MemoryState):
            control.start(cast(MemoryState, memory))
        case ["freeze"]:
            control.freeze()
        case ["thaw"]:
            control.thaw()
        case _:
            raise ValueError(f"unknown request {' '.join(words)!r}")
