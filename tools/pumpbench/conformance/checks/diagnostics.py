"""Console and diagnostics (DIA): a tester may look, and changes nothing."""

import random
from collections.abc import Callable
from typing import Final

from can_bus import codec
from can_bus.frame import Frame
from pumpbench.bench import frame_text
from pumpbench.calibration import MODES
from pumpbench.conformance.checks.e2e import carbs_mode, difference, idle_boluses
from pumpbench.conformance.driver import GLUCOSE, NMA, Bench, expect
from pumpbench.conformance.loop import Values
from pumpbench.conformance.registry import Dut, check

REQUEST: Final = codec.message("UDS_Request")
RESPONSE: Final = codec.message("UDS_Response")

STEPS: Final = 16

SESSION_CONTROL, ECU_RESET = 0x10, 0x11

SERVICES: Final = (
    "14FFFFFF", "1902FF", "190A", "22F195", "2301000000000008", "2701", "280300", "2A01F195",
    "2C01F301", "2E010000", "2E011000", "2F010003", "3101020000", "31010201", "31FF00", "34004400",
    "3601", "37", "3D0000", "3E00", "3E80", "8301", "850200", "8701", "BA00",
)  # fmt: skip
"""What a tester without a session of its own may try: clear, write, control, stop the communication, load a program."""


@check("DIA-01", needs=["uds"])
def a_tester_who_tries_everything(dut: Dut) -> None:
    """Requests of every service of UDS but sessions and resets, and frames that are none, all through a run.

    Every other frame is the same as without. The serial console is no part of the bus: tests/test_console.py.
    """
    rng = random.Random(1)
    tries = [bytes.fromhex(text) for text in SERVICES]
    tries += [_anything(rng) for _ in range(400 if dut.long else 15)]
    frames = [_single(each) if len(each) < 8 else each for each in tries]
    rng.shuffle(frames)
    apart = -(-len(frames) // STEPS)
    calm = _run(dut, lambda _bench, _k: None)
    asked = _run(dut, lambda bench, k: _ask(bench, frames[k * apart : (k + 1) * apart]))
    for k, (expected, found) in enumerate(zip(calm, asked, strict=True)):
        other = difference(expected, found)
        expect(not other, f"the same frames in step {k} whatever a tester asks for; {other}")


def _single(request: bytes) -> bytes:
    """A request in a single frame of ISO-TP."""
    return bytes([len(request)]) + request


def _anything(rng: random.Random) -> bytes:
    """Eight bytes that are no request for a session or a reset."""
    while True:
        data = rng.randbytes(8)
        single = data[0] >> 4 == 0
        if not single or data[1] not in (SESSION_CONTROL, ECU_RESET):
            return data


def _run(dut: Dut, ask: Callable[[Bench, int], None]) -> list[list[tuple[str, Values]]]:
    """What the device says in its turns, with a tester before each."""
    strategy = carbs_mode(dut)
    bench = dut.bench(mode=NMA if strategy is None else MODES[strategy])
    said = []
    for k in range(STEPS):
        if k == STEPS // 2:
            bench.total += 3000 * 12  # insulin on board, for somebody to clear
        ask(bench, k)
        said.append(bench.step(GLUCOSE + 60 * k, also=idle_boluses(bench)).said)
    return said


def _ask(bench: Bench, requests: list[bytes]) -> None:
    for data in requests:
        request = Frame(REQUEST.can_id, data.ljust(REQUEST.length, b"\xcc"))
        bench.log.append(request)
        for frame in bench.firmware.receive(request):
            bench.log.append(frame)
            expect(frame.can_id == RESPONSE.can_id, f"nothing but UDS_Response out of turn; {frame_text(frame)} came")
