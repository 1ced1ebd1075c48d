"""`pumpbench console PORT`: talk to the serial console of a running firmware, by hand or from a script."""

import sys
import threading
from collections.abc import Iterable

import serial

PROMPT = b"> "
END = (b"OK\r\n", b"ERR ")


class ConsoleError(Exception):
    """The port cannot be opened (exit status 2) or the device does not answer (3)."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


def connect(port: str, timeout: float) -> serial.SerialBase:
    """Open a port.

    Raises:
        ConsoleError: there is no such port.
    """
    try:
        return serial.serial_for_url(port, timeout=timeout)
    except (serial.SerialException, ValueError, OSError) as error:
        raise ConsoleError(2, f"{port}: {error}") from None


def ask(line: serial.SerialBase, command: str) -> list[str]:
    """Send one command; the lines of its reply, the last of which is OK or ERR.

    Raises:
        ConsoleError: no whole reply came in time.
    """
    line.write(command.encode("ascii", "replace") + b"\r")
    reply: list[str] = []
    while not reply or not (reply[-1] == "OK" or reply[-1].startswith("ERR ")):
        text = line.read_until(b"\r\n")
        if not text.endswith(b"\r\n"):
            raise ConsoleError(3, f"no answer to {command!r} within {line.timeout:g} s")
        reply.append(text.decode("ascii", "replace").rstrip())
    return reply


def script(port: str, commands: Iterable[str], timeout: float) -> int:
    """Run commands and print their replies.

    Returns:
        0 if all of them were OK, 1 if one was refused.

    Raises:
        ConsoleError: see `connect` and `ask`.
    """
    refused = False
    with connect(port, timeout) as line:
        line.write(b"\r")  # pyserial throws away what came before it opened, half a line of somebody else's too
        quiet(line)
        for command in commands:
            if not command.strip():
                continue
            reply = ask(line, command.strip())
            print("\n".join(reply))
            refused |= reply[-1] != "OK"
    return 1 if refused else 0


def quiet(line: serial.SerialBase) -> None:
    """Switch echo and prompt off.

    Raises:
        ConsoleError: the device does not answer.
    """
    line.write(b"set echo=off\r")
    if not line.read_until(b"OK\r\n").endswith(b"OK\r\n"):
        raise ConsoleError(3, f"nobody answers on this port within {line.timeout:g} s")


def interactive(port: str, timeout: float) -> int:
    """Pass lines of the terminal on until its end (Ctrl-D), and show what the device says as it comes.

    Raises:
        ConsoleError: see `connect`.
    """
    with connect(port, timeout) as line:
        over = threading.Event()
        line.timeout = 0.1

        def show() -> None:
            while not over.is_set():
                sys.stdout.write(line.read(4096).decode("ascii", "replace"))
                sys.stdout.flush()

        reader = threading.Thread(target=show, daemon=True)
        reader.start()
        line.write(b"\rset echo=off\r")
        try:
            for text in sys.stdin:
                line.write(text.rstrip("\n").encode("ascii", "replace") + b"\r")
        finally:
            over.set()
            reader.join()
    return 0
