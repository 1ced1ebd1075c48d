"""Console and diagnostics (DIA): a tester may look, and changes nothing; what was done can be read afterwards."""

import random
from collections.abc import Callable
from typing import Final

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY, Phase
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import COMMIT, carbs_mode
from pumpbench.conformance.driver import GLUCOSE, Bench, Op, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import difference, idle_boluses
from pumpbench.signals import frame_text

REQUEST: Final = codec.message("UDS_Request")
RESPONSE: Final = codec.message("UDS_Response")

STEPS: Final = 16

READ_DATA: Final = 0x22
FIRST, FLOW_CONTROL = 1, 3
"""Kinds of frames of ISO-TP."""

HISTORY: Final = 0x4000
"""DID of the record whose step leaves nothing when divided by the 288 steps of a day; docs/diagnostics.md."""

RECORD: Final = (
    ("step", 4), ("boots", 2), ("cause", 1), ("state", 1), ("mode", 1), ("op", 1), ("glucose", 2), ("iob", 2),
    ("rate", 2), ("pram_rate", 2), ("bolus", 2), ("pram_bolus", 2), ("delivered", 4), ("pram_delivered", 4),
    ("limiters", 2), ("alarms", 4),
)  # fmt: skip
"""Fields and their bytes: signed, big-endian."""

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
    bench = dut.bench(mode=MODES[strategy or "nma"])
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


@check("DIA-02", needs=["uds", "restart", "nvm"])
def the_history(dut: Dut) -> None:
    """A run with a meal and lost samples, then a loss of power: each step's record is what was on the bus.

    Set-point, boluses, state, mode, limits and alarms of every step, in the long form of all that has to be kept.
    Glucose and delivered amounts are as the device takes them, and not compared.
    """
    steps = dut.settings.diagnostics.history * 3600 // STEP_SECONDS if dut.long else 24
    strategy = next((name for name in ("s3", "ma", "s1", "sma") if name in dut.offers), "nma")
    loop = dut.loop(strategy, [(step + 8, 60.0) for step in range(0, steps, 60)], steps)
    loop.to_device = lambda name, _values, _frame: (
        [] if name == "CGM_Reading" and 14 <= loop.plant.step % STEPS_PER_DAY < 20 else None
    )
    loop.play()
    dut.restart("kept")
    for step, expected in _of_the_bus(loop).items():
        found = _record(loop, HISTORY + step % STEPS_PER_DAY)
        other = {name: (value, found[name]) for name, value in expected.items() if found[name] != value}
        text = ", ".join(f"{name} {value} and not {wrong}" for name, (value, wrong) in other.items())
        expect(not other, f"the record of step {step} to say what was on the bus: {text}")


def _of_the_bus(loop: Loop) -> dict[int, dict[str, int]]:
    """What the frames say of each step, by the fields of a record."""
    said: dict[int, dict[str, int]] = {}
    alarms: dict[int, int] = {}  # CtrlAlarmCode -> its newest state
    committed: set[int] = set()
    fields: dict[str, int] = {}
    for _, name, values in loop.heard:
        if name == "SYNC_Step":
            if values["SyncPhase"] == Phase.STEP:
                fields = {"step": values["StepIndex"], "op": 0, "rate": 0, "pram_rate": 0, "bolus": 0, "pram_bolus": 0}
        elif name == "PUMP_BasalCmd":
            fields["op"] = values["BasalOp"]
            if values["BasalOp"] == Op.SET_RATE:
                fields |= {"rate": values["InsulinRate"], "pram_rate": values["PramlintideRate"]}
        elif name == "PUMP_BolusCmd" and values["BolusOp"] == COMMIT and values["BolusId"] not in committed:
            committed.add(values["BolusId"])
            fields |= {"bolus": values["InsulinBolus"]} if "InsulinBolus" in values else {}
            fields |= {"pram_bolus": values["PramlintideBolus"]} if "PramlintideBolus" in values else {}
        elif name == "CTRL_Alarm":
            alarms[values["CtrlAlarmCode"]] = values["CtrlAlarmState"]
        elif name == "CTRL_Status":
            fields |= {"state": values["CtrlState"], "mode": values["CtrlMode"], "limiters": values["LimiterBits"]}
            fields |= {"boots": 0, "alarms": sum(1 << code for code, state in alarms.items() if state)}
            said[fields["step"]] = fields
    return said


def _record(loop: Loop, did: int) -> dict[str, int]:
    """Read a record over ISO-TP: a first frame, flow control, and the frames that it lets through."""
    request = bytes([READ_DATA, did >> 8, did & 0xFF])
    answer = _converse(loop, _single(request))
    expect(len(answer) == 1 and answer[0][0] >> 4 == FIRST, f"a first frame for DID 0x{did:04X}; {_hex(answer)} came")
    length = (answer[0][0] & 0xF) << 8 | answer[0][1]
    data = answer[0][2:] + b"".join(frame[1:] for frame in _converse(loop, bytes([FLOW_CONTROL << 4, 0, 0])))
    size = 3 + sum(width for _, width in RECORD)
    expect(length == size <= len(data), f"{size} bytes in answer to DID 0x{did:04X}; {length} came")
    values, start = {}, 3
    for name, width in RECORD:
        values[name] = int.from_bytes(data[start : start + width], "big", signed=True)
        start += width
    return values


def _converse(loop: Loop, data: bytes) -> list[bytes]:
    """A tester's frame, and the device's."""
    request = Frame(REQUEST.can_id, data.ljust(REQUEST.length, b"\xcc"))
    loop.watch([request])
    answer = loop.give(request)
    loop.watch(answer)
    return [frame.data for frame in answer if frame.can_id == RESPONSE.can_id]


def _hex(frames: list[bytes]) -> str:
    return ", ".join(frame.hex(" ") for frame in frames) or "nothing"
