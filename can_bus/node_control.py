"""How a device's power or reset is switched: by a command, by a line of a serial port, or by whoever started it.

Requests are words: `cut`, `start kept`, `start torn`, `start lost`, `freeze`, `thaw` (`can_bus.faults.NodeControl`).
"""

import shlex
import socket
import subprocess
import time
from typing import Any, cast, get_args

import serial

from can_bus.faults import MemoryState, NodeControl

ANSWER_SECONDS = 60.0

LINES = ("dtr", "rts")

HOLD_SECONDS = 0.1
"""How long a reset line is held at least; reset inputs with a capacitor take some milliseconds."""


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


class LineControl:
    """A modem control line of a serial port that holds the device in reset while it is asserted.

    Development boards wire DTR or RTS of their console so. A line can neither stop a device without a reset nor touch
    its memory.

    Args:
        text: `dtr:PORT` or `rts:PORT`, a serial port or a pyserial URL.

    Raises:
        ValueError: it is neither.
        NodeControlError: the port cannot be opened.
    """

    def __init__(self, text: str) -> None:
        self._line, _, url = text.partition(":")
        if self._line not in LINES or not url:
            raise ValueError(f"{text!r}: expected dtr:PORT or rts:PORT, for instance rts:/dev/ttyUSB0")
        try:
            self._port: Any = serial.serial_for_url(url, do_not_open=True)
            self._port.dtr = self._port.rts = False  # opening asserts both otherwise: a reset that nobody asked for
            self._port.open()
        except (OSError, ValueError) as error:
            raise NodeControlError(f"{text}: {error}") from error
        self._url = url

    def _set(self, asserted: bool) -> None:
        try:
            setattr(self._port, self._line, asserted)
        except OSError as error:
            raise NodeControlError(f"{self._url} cannot set {self._line.upper()}: {error}") from error

    def cut(self) -> None:
        """Hold it in reset."""
        self._set(True)

    def start(self, memory: MemoryState) -> None:
        """Let it go."""
        if memory != "kept":
            raise NodeControlError(f"start {memory}: a reset line cannot touch the device's memory")
        time.sleep(HOLD_SECONDS)
        self._set(False)

    def freeze(self) -> None:
        """It cannot."""
        raise NodeControlError("freeze: a reset line cannot stop a device without resetting it")

    def thaw(self) -> None:
        """It cannot either."""
        raise NodeControlError("thaw: a reset line cannot stop a device without resetting it")

    def close(self) -> None:
        """Leave the port; both lines are let go."""
        self._port.close()


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
