"""Robustness (ROB): what is no frame of this bus, what is disturbed on it, and long runs."""

import random
from collections.abc import Callable, Sequence
from typing import Final

from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.faults import Fault as WireFault
from can_bus.frame import CAN_RTR_FLAG, Frame
from can_bus.gateway import Gateway, Side
from can_bus.lockstep import STEPS_PER_DAY
from pumpbench import catalogue
from pumpbench.conformance.driver import GLUCOSE, State, expect
from pumpbench.conformance.loop import Values, Wire
from pumpbench.conformance.registry import Dut, check
from pumpbench.hazards import Monitor

BABBLE: Final = 2000
"""Frames of id 0: what a node that babbles gets through in a second at 250 kbit/s and every frame of which wins."""

NOISE: Final = 150
"""Random frames per step, 20 steps: 3,000 in all; in the long form a hundred thousand."""

HEARD: Final = ("CGM_Reading", "PUMP_Status", "PUMP_Delivered", "PUMP_Ack", "PUMP_BolusState", "MEAL_Announce")
HARD: Final = ("drop", "delay", "replay", "stuck_frame", "misroute", "masquerade")

Watch = Callable[[Sequence[Frame]], None]


@check("ROB-01")
def babble_and_bus_off(dut: Dut) -> None:
    """A flood of id 0 before a token; then nothing at all for a step, as in a bus-off: the device goes on by itself."""
    bench = dut.bench()
    bench.run(12)
    bench.give(*[Frame(0, b"\x00" * 8)] * BABBLE)
    turn = bench.step()
    expect(turn.state == State.AUTO, f"Auto after {BABBLE} frames of id 0; {turn.state_name} came")
    turn = bench.step(drop=True, status=False, totals=False)
    expect(bool(turn.all("CTRL_Status")), "an answer in a step in which only the token came through")
    bench.run(3)
    turn = bench.step()
    expect(turn.state == State.AUTO, f"Auto four steps after the bus is back; {turn.state_name} came")


@check("ROB-02")
def random_frames(dut: Dut) -> None:
    """Random ids, lengths and bytes, remote frames among them, ahead of every token: the same set-points as without."""
    steps, noise = 20, 5000 if dut.long else NOISE
    commands = [_commands(dut, steps, count) for count in (0, noise)]
    expect(commands[0] == commands[1], f"the same set-points with {noise} random frames in every step as without")


def _commands(dut: Dut, steps: int, noise: int) -> list[tuple[int, int]]:
    rng = random.Random(2)
    bench = dut.bench()
    said = []
    for k in range(steps):
        bench.give(*(_nonsense(rng) for _ in range(noise)))
        command = bench.step(GLUCOSE + 20 * k).command
        said.append((command["InsulinRate"], command["PramlintideRate"]))
    return said


def _nonsense(rng: random.Random) -> Frame:
    """A frame that no node would take for one of this bus: by its CRC, its length or its kind."""
    reader = Receiver(name for name, message in codec.messages().items() if message.data_ids is not None)
    while True:
        can_id = rng.choice([rng.randrange(0x800), rng.choice(list(codec.messages_by_id()))])
        if can_id == codec.message("UDS_Request").can_id:
            continue  # a tester's request is answered, whatever it asks for
        frame = Frame(can_id | (CAN_RTR_FLAG if rng.random() < 0.1 else 0), rng.randbytes(rng.randrange(9)))
        message = codec.messages_by_id().get(can_id)
        spoken = message is not None and message.data_ids is None and len(frame.data) == message.length
        if not spoken and reader.receive(frame).check > Check.WRONG_SEQUENCE:
            return frame


@check("ROB-03")
def single_faults(dut: Dut) -> None:
    """Faults of the catalogue on the wire, one at a time, on a day with a meal: the monitor of hazards counts none.

    Six kinds that a device bears least; in the long form all that act on what it hears.
    """
    strategy = next((name for name in ("s3", "sma") if name in dut.offers), "nma")
    seen: set[str] = set()
    for entry in catalogue.entries():
        fault = entry.fault
        if not isinstance(fault, WireFault) or getattr(fault, "message", None) not in HEARD:
            continue
        if not dut.long and (fault.kind not in HARD or fault.kind in seen):
            continue
        seen.add(fault.kind)
        gateway, monitor = Gateway([fault]), Monitor()
        loop = dut.loop(strategy, [(20, 60.0)], 48)
        loop.watch = _both(loop.watch, monitor.watch)
        loop.to_device = _through(gateway)
        loop.play()
        counted = {name: count for name, count in monitor.hazards.items() if count}
        expect(
            not counted,
            f"no hazard with {entry.name!r}; {counted} was counted, first in step {monitor.hazards.found[:1]}",
        )
        expect(loop.ledgers_close(), f"that the ledger closes with {entry.name!r}")


def _both(one: Watch, other: Watch) -> Watch:
    def watch(frames: Sequence[Frame]) -> None:
        one(frames)
        other(frames)

    return watch


def _through(gateway: Gateway) -> Wire:
    return lambda _name, _values, frame: gateway.forward(frame, Side.PLANT).device


@check("ROB-04")
def twice_the_same(dut: Dut) -> None:
    """The same run twice, a day or in the long form a fortnight: the device says the same, byte by byte."""
    strategy = "s3" if "s3" in dut.offers else "nma"
    steps = 14 * STEPS_PER_DAY if dut.long else 96
    said: list[list[tuple[int, str, Values]]] = []
    for _ in range(2):
        loop = dut.loop(strategy, [(20, 60.0), (70, 40.0)], steps)
        loop.play()
        said.append(loop.heard)
    expect(said[0] == said[1], f"the same frames in two runs of {steps} steps")
