"""`pumpbench console PORT`: talk to the serial console of a running firmware, by hand or from a script."""

import os
import sys
import threading
import time
from collections.abc import Iterable

import serial

QUIET_SECONDS = 0.1
"""Silence after which nothing of an earlier session is still on its way."""


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
        return serial.serial_for_url(port, timeout=timeout, write_timeout=timeout)
    except (serial.SerialException, ValueError, OSError) as error:
        raise ConsoleError(2, f"{port}: {error}") from None


def ask(line: serial.SerialBase, command: str, timeout: float) -> list[str]:
    """Send one command; the lines of its reply, the last of which is OK or ERR.

    Raises:
        ConsoleError: no whole reply came in time, however much else did.
    """
    end = time.monotonic() + timeout
    line.write(command.encode("ascii", "replace") + b"\r")
    reply: list[str] = []
    while not reply or not (reply[-1] == "OK" or reply[-1].startswith("ERR ")):
        line.timeout = max(end - time.monotonic(), 0.0)
        text = line.read_until(b"\r\n")
        if not text.endswith(b"\r\n"):
            raise ConsoleError(3, f"no answer to {command!r} within {timeout:g} s")
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
        quiet(line, timeout)
        for command in (part.strip() for text in commands for part in text.splitlines()):
            if not command:
                continue
            reply = ask(line, command, timeout)
            print("\n".join(reply), flush=True)
            refused |= reply[-1] != "OK"
    return 1 if refused else 0


def quiet(line: serial.SerialBase, timeout: float) -> None:
    """Switch echo and prompt off, and let pass what an earlier session has asked for and not read.

    Raises:
        ConsoleError: the device does not answer.
    """
    line.write(b"set echo=off\r")
    if not line.read_until(b"OK\r\n").endswith(b"OK\r\n"):
        raise ConsoleError(3, f"nobody answers on this port within {timeout:g} s")
    end = time.monotonic() + timeout
    line.timeout = QUIET_SECONDS
    while line.read(4096) and time.monotonic() < end:
        pass


def interactive(port: str, timeout: float) -> int:
    """Pass lines of the terminal on until its end (Ctrl-D), and show what the device says as it comes.

    Raises:
        ConsoleError: see `connect` and `quiet`.
        OSError: the device went away, which ends the session at once.
    """
    with connect(port, timeout) as line:
        line.write(b"\r")
        quiet(line, timeout)
        # the thread is the one that waits for the user: it may wait for ever, the device must not be waited for
        typing = threading.Thread(target=_type, args=(line,), daemon=True)
        typing.start()
        while typing.is_alive():
            _show(line)
        end = time.monotonic() + timeout
        while _show(line) and time.monotonic() < end:  # the answer to the last line
            pass
    return 0


def _type(line: serial.SerialBase) -> None:
    try:
        while text := os.read(sys.stdin.fileno(), 4096):
            line.write(text.replace(b"\n", b"\r"))
    except OSError:  # the reader meets the same error and tells it
        return


def _show(line: serial.SerialBase) -> bool:
    # what is there at once, else the first byte: a large read would hold back a short answer until its time-out
    text: bytes = line.read(max(line.in_waiting, 1))
    sys.stdout.write(text.decode("ascii", "replace").replace("\r\n", "\n"))
    sys.stdout.flush()
    return bool(text)
