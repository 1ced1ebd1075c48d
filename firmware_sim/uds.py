"""Diagnostics for a service tool: the part of UDS (ISO 14229-1) that reads, clears, restarts and tests. It never doses.

There is no service here that writes a value or moves an output, in any session; docs/diagnostics.md has the tables.
Like the transport below it the server knows no clock: the extended session ends when a whole step passes without a
request, where the standard says five seconds.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from .alarms import Alarms, Code
from .history import STEPS, History, pack

POSITIVE = 0x40
NEGATIVE = 0x7F
SUPPRESS = 0x80
"""Bit of a sub-function that asks for no positive answer."""

SESSION_CONTROL, RESET, CLEAR, READ_DTC, READ_DATA, ROUTINE, TESTER_PRESENT = 0x10, 0x11, 0x14, 0x19, 0x22, 0x31, 0x3E

WITH_SUBFUNCTION = (SESSION_CONTROL, RESET, READ_DTC, ROUTINE, TESTER_PRESENT)

NO_SERVICE, NO_SUBFUNCTION, WRONG_LENGTH = 0x11, 0x12, 0x13
NOT_NOW, SEQUENCE, OUT_OF_RANGE, NOT_IN_SESSION = 0x22, 0x24, 0x31, 0x7F
"""Negative response codes."""

DEFAULT, EXTENDED = 1, 3
P2_MS, P2_STAR_10MS = 50, 500
"""What the answer to SessionControl promises; the device answers at once."""

HARD_RESET, SOFT_RESET = 1, 3

BY_MASK_COUNT, BY_MASK, SUPPORTED = 0x01, 0x02, 0x0A
FORMAT_ISO_14229 = 1
ALL_DTCS = 0xFFFFFF

START, RESULTS = 1, 3
SELF_TEST, LOAD = 0x0200, 0x0201
"""Routines: the self test; more work for a task in the next step, to test the watchdog."""

FAILED, FAILED_THIS_CYCLE, CONFIRMED, FAILED_SINCE_CLEAR = 0x01, 0x02, 0x08, 0x20
AVAILABLE = FAILED | FAILED_THIS_CYCLE | CONFIRMED | FAILED_SINCE_CLEAR
"""Bits of a DTC's status that the device keeps."""

DTC_BASE = 0xF00000
"""A DTC is U30xx-00 with the alarm's code as xx: the range of ISO 15031-6 that is the manufacturer's own."""

SESSION_DID = 0xF186

HISTORY_DID = 0x4000
"""Of the record in place 0 of the history; the others follow."""

DIDS_AT_MOST = 8
"""Of one request, so that the longest answer is known."""


def dtc(code: Code) -> int:
    """The three bytes of an alarm's DTC."""
    return DTC_BASE | code << 8


class Device(Protocol):
    """What diagnostics may see and ask for."""

    def identification(self) -> Mapping[int, bytes]:
        """Data by identifier."""

    def may_restart(self) -> bool:
        """Whether nothing is under way that a restart would make uncertain."""

    def request_reset(self) -> bool:
        """Restart with the next token; False without a memory to restart from."""

    def self_test(self) -> int:
        """Run it; bits of what failed."""

    def load(self, task: int, work: int) -> bool:
        """Give a task more work in its next run; False if there is no such task."""


class _Refused(Exception):
    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(code)


class Uds:
    """Answers requests, one after the other."""

    def __init__(self, device: Device, alarms: Alarms, history: History) -> None:
        self._device = device
        self._alarms = alarms
        self._history = history
        self._session = DEFAULT
        self._heard = False  # a request came in this step
        self._result: int | None = None  # of the last self test
        self._services: dict[int, Callable[[bytes], bytes]] = {
            SESSION_CONTROL: self._on_session,
            RESET: self._on_reset,
            CLEAR: self._on_clear,
            READ_DTC: self._on_read_dtc,
            READ_DATA: self._on_read_data,
            ROUTINE: self._on_routine,
            TESTER_PRESENT: self._on_tester_present,
        }

    def tick(self) -> None:
        """A new step: a tester that was silent for the whole last one is gone."""
        if not self._heard:
            self._session = DEFAULT
        self._heard = False

    def answer(self, request: bytes) -> bytes:
        """The answer to a request of at least one byte; empty where none was asked for."""
        self._heard = True
        service = request[0]
        handler = self._services.get(service)
        try:
            if handler is None:
                raise _Refused(NO_SERVICE)
            data = handler(request[1:])
        except _Refused as refused:
            return bytes([NEGATIVE, service, refused.code])
        quiet = service in WITH_SUBFUNCTION and request[1] & SUPPRESS
        return b"" if quiet else bytes([service | POSITIVE]) + data

    def _subfunction(self, data: bytes, length: int, known: tuple[int, ...]) -> int:
        """The sub-function of a request of this many bytes after the service."""
        if not data:
            raise _Refused(WRONG_LENGTH)
        subfunction = data[0] & ~SUPPRESS
        if subfunction not in known:
            raise _Refused(NO_SUBFUNCTION)
        if len(data) != length:
            raise _Refused(WRONG_LENGTH)
        return subfunction

    def _on_session(self, data: bytes) -> bytes:
        self._session = self._subfunction(data, 1, (DEFAULT, EXTENDED))
        return bytes([self._session]) + P2_MS.to_bytes(2, "big") + P2_STAR_10MS.to_bytes(2, "big")

    def _on_tester_present(self, data: bytes) -> bytes:
        return bytes([self._subfunction(data, 1, (0,))])

    def _on_reset(self, data: bytes) -> bytes:
        self._need_extended()
        subfunction = self._subfunction(data, 1, (HARD_RESET, SOFT_RESET))
        if not self._device.may_restart() or not self._device.request_reset():
            raise _Refused(NOT_NOW)
        return bytes([subfunction])

    def _on_clear(self, data: bytes) -> bytes:
        if len(data) != 3:
            raise _Refused(WRONG_LENGTH)
        group = int.from_bytes(data, "big")
        codes = tuple(code for code in Code if group in (ALL_DTCS, dtc(code)))
        if not codes:
            raise _Refused(OUT_OF_RANGE)
        for code in codes:
            self._alarms.clear(code)
        return b""

    def _on_read_dtc(self, data: bytes) -> bytes:
        supported = bool(data) and data[0] & ~SUPPRESS == SUPPORTED
        subfunction = self._subfunction(data, 1 if supported else 2, (BY_MASK_COUNT, BY_MASK, SUPPORTED))
        found = [(dtc(code), self._dtc_status(code)) for code in Code]
        if not supported:
            found = [(number, status) for number, status in found if status & data[1] & AVAILABLE]
        if subfunction == BY_MASK_COUNT:
            return bytes([subfunction, AVAILABLE, FORMAT_ISO_14229]) + len(found).to_bytes(2, "big")
        listed = b"".join(number.to_bytes(3, "big") + bytes([status]) for number, status in found)
        return bytes([subfunction, AVAILABLE]) + listed

    def _dtc_status(self, code: Code) -> int:
        in_force, since_boot, since_clear = self._alarms.history(code)
        kept = CONFIRMED | FAILED_SINCE_CLEAR if since_clear else 0
        return (FAILED if in_force else 0) | (FAILED_THIS_CYCLE if since_boot else 0) | kept

    def _on_read_data(self, data: bytes) -> bytes:
        if not data or len(data) % 2 or len(data) > 2 * DIDS_AT_MOST:
            raise _Refused(WRONG_LENGTH)
        known = {**self._device.identification(), SESSION_DID: bytes([self._session])}
        found = b""
        for name in (data[i : i + 2] for i in range(0, len(data), 2)):
            number = int.from_bytes(name, "big")
            in_history = HISTORY_DID <= number < HISTORY_DID + STEPS
            value = self._record(number - HISTORY_DID) if in_history else known.get(number, b"")
            found += name + value if value else b""
        if not found:
            raise _Refused(OUT_OF_RANGE)
        return found

    def _record(self, place: int) -> bytes:
        """The packed record in a place of the history; empty where there is none."""
        record = self._history.at(place)
        return b"" if record is None else pack(record)

    def _on_routine(self, data: bytes) -> bytes:
        self._need_extended()
        if data[1:3] == LOAD.to_bytes(2, "big"):
            return self._on_load(data)
        subfunction = self._subfunction(data, 3, (START, RESULTS))
        if int.from_bytes(data[1:], "big") != SELF_TEST:
            raise _Refused(OUT_OF_RANGE)
        if subfunction == START:
            self._result = self._device.self_test()
        if self._result is None:
            raise _Refused(SEQUENCE)
        return data + bytes([self._result])

    def _on_load(self, data: bytes) -> bytes:
        """Start alone: the number of a task and two bytes of work."""
        self._subfunction(data, 6, (START,))
        if not self._device.load(data[3], int.from_bytes(data[4:], "big")):
            raise _Refused(OUT_OF_RANGE)
        return data[:3]

    def _need_extended(self) -> None:
        if self._session != EXTENDED:
            raise _Refused(NOT_IN_SESSION)
