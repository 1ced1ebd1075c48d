"""The serial console: lines in, key=value replies out. Pure logic; `serial_port` moves the bytes.

It can look at everything and change nothing that doses: there is no command for a dose, a limit or the calibration.
A reply is one line of key=value pairs (or several for a list), then `OK` or `ERR <number> <reason>`.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol

from .alarms import Code
from .history import STEPS, Record
from .ladder import State

LINE_MAX = 128
"""Characters of a line; a longer one is refused as a whole."""

LOG_LINES = 256
"""Log lines that wait for a reader; older ones are dropped and counted, for nothing here may ever wait."""

CLEAR_LINE = b"\r\x1b[K"
"""Wipes the prompt and what was typed behind it, before a log line takes their place."""

LEVELS = ("off", "error", "warn", "info", "debug")

ERR_UNKNOWN, ERR_USAGE, ERR_READ_ONLY, ERR_LINE, ERR_REFUSED = 1, 2, 3, 4, 5

HELP = (
    ("help", "this list"),
    ("status", "state, mode, doses and counters of the newest step"),
    ("get [NAME]", "a calibration parameter as stored, raw; without a name all of them"),
    ("set NAME=VALUE", "a setting of the console: echo=on|off, log=LEVEL; nothing else can be set"),
    ("log LEVEL", "log lines to show: " + " ".join(LEVELS)),
    ("echo on|off", "echo and prompt; off is the mode for machines"),
    ("version", "of the firmware and of the protocol"),
    ("faults", "alarms in force, highest first"),
    ("history [N]", "the last N steps, the newest last: doses, state, limits, alarms, resets; 12 if no N is given"),
    ("reset", "restart from the non-volatile memory after this turn"),
)

HISTORY_STEPS = 12
"""An hour, where nobody says how many."""

Pairs = Mapping[str, int | str]


class Device(Protocol):
    """What the console may ask a device."""

    def status(self) -> Pairs:
        """The newest step."""

    def parameters(self) -> Mapping[str, int]:
        """The calibration in force, raw values by DBC name."""

    def faults(self) -> Iterable[Pairs]:
        """Alarms in force."""

    def history(self) -> Sequence[Record]:
        """The last 24 h, the oldest step first."""

    def version(self) -> Pairs:
        """Of firmware and protocol."""

    def request_reset(self) -> bool:
        """Ask for a restart at the end of the turn; False: this device has no memory to restart from."""


class FirmwareView:
    """A device as the console's thread sees it: copies that the control loop leaves behind after a turn.

    The device's own dictionaries change while another thread would walk through them, and a status read in the middle
    of a step would mix two steps. A whole copy is put in place by one assignment, so neither side ever waits.

    Attributes:
        log: takes a line for every alarm that begins, changes or ends.
    """

    def __init__(self, device: Device) -> None:
        self.log: Callable[[str, int, str, str], None] = lambda _level, _seconds, _module, _text: None
        self._seen: dict[int | str, int | str] = {}
        self._version = dict(device.version())
        self.replace(device)

    def replace(self, device: Device) -> None:
        """Show another device, the one after a reset."""
        self._device = device
        self._seen.clear()  # its alarms begin anew
        self.publish()

    def publish(self) -> None:
        """Copy what the device says now; only ever called by the thread that runs the device."""
        status = dict(self._device.status())
        faults = tuple(dict(fault) for fault in self._device.faults())
        self._snapshot = status, dict(self._device.parameters()), faults, tuple(self._device.history())
        seen = {fault["code"]: fault["state"] for fault in faults}
        if seen != self._seen:
            seconds = int(status["time"])
            for code in self._seen.keys() - seen.keys():
                self.log("info", seconds, "alarm", f"{code} over")
            for fault in faults:
                if self._seen.get(fault["code"]) != fault["state"]:
                    self.log("warn", seconds, "alarm", f"{fault['code']} {fault['state']}")
        self._seen = seen

    def status(self) -> Pairs:
        """Of the newest whole step."""
        return self._snapshot[0]

    def parameters(self) -> Mapping[str, int]:
        """The calibration in force after that step."""
        return self._snapshot[1]

    def faults(self) -> Iterable[Pairs]:
        """Alarms in force after that step."""
        return self._snapshot[2]

    def history(self) -> Sequence[Record]:
        """The last 24 h up to that step, the oldest first."""
        return self._snapshot[3]

    def version(self) -> Pairs:
        """Of firmware and protocol."""
        return self._version

    def request_reset(self) -> bool:
        """Ask the device itself; it is one assignment there."""
        return self._device.request_reset()


class _Refused(Exception):
    def __init__(self, number: int, reason: str) -> None:
        self.number = number
        self.reason = reason
        super().__init__(reason)


def pairs(values: Pairs) -> str:
    """One line of key=value pairs."""
    return " ".join(f"{key}={value}" for key, value in values.items())


def history_line(record: Record) -> str:
    """One step as key=value pairs, with the names of state and alarms."""
    names = ",".join(code.name.lower() for code in Code if record.alarms >> code & 1)
    values: dict[str, int | str] = {**record._asdict(), "state": State(record.state).name.lower()}
    return pairs(values | {"alarms": names or "none"})


class Console:
    """One session on one port. `log` may be called by another thread than everything else.

    Attributes:
        unsent: bytes that the port had to drop, as told by whoever moves them.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._line = bytearray()
        self._overlong = False
        self._last = 0  # byte before, so that CR LF is one line end
        self._echo = True
        self._level = LEVELS.index("off")
        self._prompted = False  # the cursor stands behind a prompt
        # one thread appends, the other takes: a full deque drops its oldest by itself, so that neither can fail
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._offered = 0  # counted by the thread that logs
        self._taken = 0  # counted by the thread that reads
        self.unsent = 0
        self._commands: dict[str, Callable[[str], list[str]]] = {
            "help": self._help,
            "status": self._status,
            "get": self._get,
            "set": self._set,
            "log": self._set_level,
            "echo": self._set_echo,
            "version": self._version,
            "faults": self._faults,
            "history": self._history,
            "reset": self._reset,
        }

    def log(self, level: str, seconds: int, module: str, text: str) -> None:
        """Offer a log line, stamped with simulated time; it waits for the next `feed` or is dropped."""
        if level not in LEVELS[1 : self._level + 1]:
            return
        self._log.append(f"{level[0].upper()} ({seconds}) {module}: {text}")
        self._offered += 1  # after the line itself, or it would look dropped for a moment

    @property
    def dropped(self) -> int:
        """Log lines that nobody read in time."""
        return max(self._offered - self._taken - len(self._log), 0)

    def feed(self, data: bytes) -> bytes:
        """Take what was typed, any bytes; what is to be shown, waiting log lines first."""
        out = bytearray(self._log_lines())
        for byte in data:
            if byte in b"\r\n":
                if not (byte == 10 and self._last == 13):
                    out += self._end_of_line()
            elif byte in (8, 127):
                if self._line:
                    self._line.pop()
                    out += b"\b \b" if self._echo else b""
            elif len(self._line) == LINE_MAX:
                self._overlong = True
            else:
                self._line.append(byte)
                out += bytes([byte]) if self._echo and 32 <= byte < 127 else b""
            self._last = byte
        return bytes(out)

    def _log_lines(self) -> bytes:
        """The log lines that wait; they take the place of the prompt, which comes back below them."""
        lines = [self._log.popleft() for _ in range(len(self._log))]
        if not lines:
            return b""
        self._taken += len(lines)
        out = b"".join(text.encode("ascii", "replace") + b"\r\n" for text in lines)
        if not self._prompted:
            return out
        return CLEAR_LINE + out + b"> " + bytes(byte for byte in self._line if 32 <= byte < 127)

    def _end_of_line(self) -> bytes:
        line, overlong = bytes(self._line), self._overlong
        self._line.clear()
        self._overlong = False
        lines = self._answer(line, overlong)
        out = b"\r\n" if self._echo else b""
        out += b"".join(text.encode("ascii", "replace") + b"\r\n" for text in lines)
        self._prompted = self._echo
        return out + (b"> " if self._prompted else b"")

    def _answer(self, line: bytes, overlong: bool) -> list[str]:
        try:
            if overlong:
                raise _Refused(ERR_LINE, f"a line has at most {LINE_MAX} characters")
            if any(not 32 <= byte < 127 for byte in line):
                raise _Refused(ERR_LINE, "a line is plain ASCII text")
            name, _, rest = line.decode("ascii").strip().partition(" ")
            if not name:
                return []
            command = self._commands.get(name)
            if command is None:
                raise _Refused(ERR_UNKNOWN, "no such command, see help")
            return [*command(rest.strip()), "OK"]
        except _Refused as refused:
            return [f"ERR {refused.number} {refused.reason}"]

    # ---- commands

    def _nothing(self, rest: str, name: str) -> None:
        if rest:
            raise _Refused(ERR_USAGE, f"usage: {name}")

    def _help(self, rest: str) -> list[str]:
        self._nothing(rest, "help")
        return [f"{usage}: {what}" for usage, what in HELP]

    def _status(self, rest: str) -> list[str]:
        self._nothing(rest, "status")
        return [pairs({**self._device.status(), "dropped": self.dropped, "unsent": self.unsent})]

    def _get(self, rest: str) -> list[str]:
        parameters = self._device.parameters()
        if not rest:
            return [pairs({name: value}) for name, value in parameters.items()]
        if rest not in parameters:
            raise _Refused(ERR_USAGE, "no such parameter is stored, get lists them")
        return [pairs({rest: parameters[rest]})]

    def _set(self, rest: str) -> list[str]:
        name, equals, value = rest.partition("=")
        if not equals:
            raise _Refused(ERR_USAGE, "usage: set NAME=VALUE")
        if name == "log":
            return self._set_level(value)
        if name != "echo":
            raise _Refused(ERR_READ_ONLY, "only echo and log can be set here, nothing that doses")
        return self._set_echo(value)

    def _set_echo(self, rest: str) -> list[str]:
        if rest not in ("on", "off"):
            raise _Refused(ERR_USAGE, "usage: echo on|off")
        self._echo = rest == "on"
        return []

    def _set_level(self, rest: str) -> list[str]:
        if rest not in LEVELS:
            raise _Refused(ERR_USAGE, "usage: log " + "|".join(LEVELS))
        self._level = LEVELS.index(rest)
        return []

    def _version(self, rest: str) -> list[str]:
        self._nothing(rest, "version")
        return [pairs(self._device.version())]

    def _faults(self, rest: str) -> list[str]:
        self._nothing(rest, "faults")
        return [pairs(fault) for fault in self._device.faults()]

    def _history(self, rest: str) -> list[str]:
        steps = int(rest) if rest.isdecimal() else HISTORY_STEPS if not rest else 0
        if not 0 < steps <= STEPS:
            raise _Refused(ERR_USAGE, f"usage: history [N], N from 1 to {STEPS}")
        return [history_line(record) for record in self._device.history()[-steps:]]

    def _reset(self, rest: str) -> list[str]:
        self._nothing(rest, "reset")
        if not self._device.request_reset():
            raise _Refused(ERR_REFUSED, "there is no non-volatile memory to restart from")
        return []
