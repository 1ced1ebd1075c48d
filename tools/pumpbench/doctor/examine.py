"""The doctor's visit to a device, from opening the bus to the report.

He plays a short run with the plant itself (`plant_server.server.PlantServer`): roll call, calibration, some
steps, the end. Beside the plant, which has to overlook what a device does wrong, it listens with ears of its own and
keeps count. After every answer it waits a moment, so that what is said behind SYNC_Done is heard as such.
"""

import contextlib
import logging
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can

import dbc
from can_bus import codec
from can_bus.frame import Frame
from can_bus.hub import Hub
from can_bus.link import BusLost, Link
from can_bus.slcan import SlcanLink
from can_bus.url import open_link
from plant_server.serve import ROLL_CALL_EVERY
from plant_server.server import PlantError, PlantServer
from pumpbench import rig
from pumpbench.doctor import wiring
from pumpbench.doctor.checkup import Check, Heard, Latency, Mark, Request, Stage, judge
from pumpbench.doctor.ears import Ears

QUIET = 0.02
"""Seconds of silence after SYNC_Done that show that the turn is over."""

QUIET_ROLL_CALL = 0.25
"""The same after the roll call: a second device may be slower than the first."""

DIAGNOSTICS_SECONDS = 0.5
"""How long a device may take to answer a diagnostic request; many have no diagnostics."""

ADAPTER_SECONDS = 0.2
"""The same for an adapter that is asked for its status."""

WATCH_EVERY = 0.25

HEARTBEAT = codec.message("HB_CTRL").can_id

READ_DBC_CRC = bytes.fromhex("03 22 01 01 CC CC CC CC")
"""UDS ReadDataByIdentifier 0101, as a single frame of ISO-TP (docs/diagnostics.md)."""


@dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        request: what was looked at.
        checks: in the order in which a device gets them right.
        latencies: seconds from the token of a step to its SYNC_Done, further turns included.
        bus_failed: the bus could not be opened or was lost, or the device's process ended.
    """

    request: Request
    checks: list[Check]
    latencies: list[float] = field(default_factory=list)
    bus_failed: bool = False

    @property
    def failed(self) -> list[Check]:
        """The checks that were not passed."""
        return [check for check in self.checks if check.mark == Mark.FAILED]

    def as_json(self) -> dict[str, Any]:
        """For machines; times in ms and s, None where nothing was measured."""
        latency = Latency.of(self.latencies) if self.latencies else None
        return {
            "bus": self.request.bus,
            "firmware": self.request.firmware,
            "protocol": ".".join(map(str, dbc.protocol_version())),
            "dbc_crc32": f"{dbc.crc32():08x}",
            "passed": not self.failed,
            "checks": [check._asdict() for check in self.checks],
            "steps": len(self.latencies),
            "latency_ms": latency and {"median": latency.median * 1e3, "worst": latency.worst * 1e3},
            "patient_day_s": latency and latency.patient_day,
        }


def examine(request: Request) -> Report:
    """Look at a device; ends within a few time-outs, whatever the device does, and leaves no process.

    Raises:
        BusUrlError, RigError: what is wrong with the request.
    """
    for name in ("can_bus.hub", "can_bus.slcan", "plant_server.server"):
        logging.getLogger(name).addHandler(logging.NullHandler())  # what they warn of is in the report
    run = rig.prepare(rig.Request("adult#001", Path(), strategy=request.strategy, steps=request.steps)).run
    with tempfile.TemporaryDirectory(prefix="pumpbench-doctor-") as directory, contextlib.ExitStack() as stack:
        place = Path(directory)
        url = f"unix:{place / 'bus.sock'}" if request.bus == "hub" else request.bus
        hub = request.bus == "hub" or request.host
        obstacle = None if hub else wiring.obstacle(url)
        if obstacle is not None:
            return Report(request, [Check("bus", Mark.FAILED, *obstacle)], bus_failed=True)
        try:
            link = stack.enter_context(_open(url, stack, hub=hub))
        except (can.CanError, OSError) as error:
            checks = [Check("bus", Mark.FAILED, str(error), wiring.advice_to_open(url))]
            return Report(request, checks, bus_failed=True)
        session = _Session(PlantServer(run), link, request)
        lost = died = None
        try:
            if request.starts_device:
                session.watch = _start(request, url, place, stack).check
            session.play()
        except BusLost as error:
            lost = str(error)
        except rig.NodeDied as error:
            died = str(error)
        checks = judge(session.heard(lost, died))
        return Report(request, checks, session.latencies, bus_failed=lost is not None or died is not None)


def _open(url: str, stack: contextlib.ExitStack, *, hub: bool) -> Link:
    return stack.enter_context(Hub(url)).local_link() if hub else open_link(url)


def _start(request: Request, url: str, place: Path, stack: contextlib.ExitStack) -> rig.Child:
    command = rig.firmware_command(request.firmware, url, place / "nvm", "kept")
    log = stack.enter_context((place / "firmware.log").open("ab"))
    child = rig.Child("firmware", command, url, log)
    stack.callback(child.end)
    return child


class _Silent(Exception):
    """No answer in time."""


class _Session:
    """The beginning of a run with a device, and what was heard of it.

    Attributes:
        watch: called while waiting; raises when the device's process has ended.
        latencies: see `Report`.
    """

    def __init__(self, plant: PlantServer, link: Link, request: Request) -> None:
        self.watch: Callable[[], None] = lambda: None
        self.latencies: list[float] = []
        self._plant = plant
        self._link = link
        self._request = request
        self._ears = Ears()
        self._inbox: deque[Frame] = deque()
        self._reached = Stage.ROLL_CALL
        self._silent = False
        self._refused: str | None = None  # what the plant says of a device it does not go on with
        self._adapter_status: int | None = None
        self._adapter_refusals = 0

    # ---- talking

    def play(self) -> None:
        """From the roll call to the end of the run, or as far as it goes.

        Raises:
            BusLost: the bus is gone.
            NodeDied: the device's process has ended.
        """
        try:
            batch = self._call_roll()
            if self._ears.answers:
                return
            self._reached = Stage.CALIBRATION
            self._ask_for_dbc()
            batch, _ = self._turn(batch)
            self._reached = Stage.STEPS
            spent = 0.0
            while not self._plant.finished:
                step = self._plant.step
                if step == self._request.steps:
                    self._reached = Stage.END
                    self.watch = lambda: None  # a process may end with the run
                batch, seconds = self._turn(batch)
                spent += seconds
                if self._plant.step != step:
                    self.latencies.append(spent)
                    spent = 0.0
            self._reached = Stage.OVER
        except _Silent:
            self._silent = True
        except PlantError as error:
            self._refused = str(error)
            self._overhear(QUIET)
        if isinstance(self._link, SlcanLink):
            self._ask_adapter(self._link)

    def _call_roll(self) -> list[Frame]:
        """Call until the newest call is answered; what the plant sends next."""
        deadline = time.monotonic() + self._request.timeout
        every = ROLL_CALL_EVERY
        calls = late = 0
        while time.monotonic() < deadline:
            calls += 1
            call = self._plant.call_roll()
            self._ears.give_turn(calls, call, running=False)
            self._link.send(call)
            for frame in self._frames(min(every, deadline - time.monotonic())):
                answer = list(self._plant.receive(frame))
                if answer:
                    self._overhear(QUIET_ROLL_CALL)
                    return answer
            if self._plant.late_answers > late:
                late = self._plant.late_answers
                every *= 2
        raise _Silent

    def _turn(self, batch: Sequence[Frame]) -> tuple[list[Frame], float]:
        """Send a batch with its token; what the plant sends next, and the seconds until the turn was over."""
        self._ears.give_turn(self._plant.step, batch, running=True)
        start = time.perf_counter()
        self._link.send(batch)
        for frame in self._frames(self._request.timeout):
            answer = list(self._plant.receive(frame))
            if answer and frame.can_id == HEARTBEAT:  # it has restarted, and gets its token again
                self._ears.note_sent(answer)
                self._link.send(answer)
            elif answer or self._plant.finished:
                seconds = time.perf_counter() - start
                self._overhear(QUIET)
                return answer, seconds
        raise _Silent

    def _ask_for_dbc(self) -> None:
        """Ask for the CRC of the DBC the device was built with, as a service tool does."""
        request = Frame(codec.message("UDS_Request").can_id, READ_DBC_CRC)
        self._ears.note_sent([request])
        self._link.send([request])
        for frame in self._frames(min(DIAGNOSTICS_SECONDS, self._request.timeout)):
            self._plant.receive(frame)
            if self._ears.diagnosis is not None:
                return

    def _ask_adapter(self, adapter: SlcanLink) -> None:
        self._adapter_refusals = adapter.refusals
        adapter.ask_status()
        self._overhear(ADAPTER_SECONDS)
        self._adapter_status = adapter.status

    def _overhear(self, seconds: float) -> None:
        """What comes while nobody has the turn."""
        for frame in self._frames(seconds):
            self._plant.receive(frame)

    def _frames(self, seconds: float) -> Iterator[Frame]:
        """The frames that come within a time, one by one; a caller that has enough leaves the rest for the next one."""
        deadline = time.monotonic() + seconds
        while True:
            while self._inbox:
                frame = self._inbox.popleft()
                self._ears.hear(frame)
                yield frame
            left = deadline - time.monotonic()
            if left <= 0:
                return
            self._inbox.extend(self._link.recv(min(left, WATCH_EVERY)))
            if not self._inbox:
                self.watch()

    def heard(self, lost: str | None, died: str | None) -> Heard:
        """What is known now.

        Args:
            lost: why the bus is gone; None: it is there.
            died: why the device's process is gone.
        """
        return Heard(
            request=self._request,
            ears=self._ears,
            reached=self._reached,
            silent=self._silent,
            refused=self._refused,
            lost=lost,
            died=died,
            step=self._plant.step,
            latencies=self.latencies,
            adapter_status=self._adapter_status,
            adapter_refusals=self._adapter_refusals,
        )
