"""What checks of several groups bring a device into, and hold it to there."""

from collections.abc import Sequence

from can_bus import codec
from can_bus.frame import Frame
from pumpbench.conformance.driver import HIGH, Bench, State, Turn, expect
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import Dut, NotOffered

RETURN = 8
"""Good steps in which a device is back in Auto: two rungs, two samples, and the window of the E2E check (E2E-03)."""

EXTENDED_SESSION = bytes.fromhex("021003")
MORE_WORK = bytes.fromhex("073101020100FFFF")
"""UDS RoutineControl 0201 (docs/diagnostics.md): 65535 units of work more for task 0."""


# ---- what is sent


def damaged(frame: Frame) -> Frame:
    """The same frame with a CRC that does not fit."""
    return frame._replace(data=bytes([frame.data[0] ^ 0x55]) + frame.data[1:])


def idle_boluses(bench: Bench) -> list[Frame]:
    """PUMP_BolusState of both drugs, neither of which has a bolus."""
    nothing = {"BolusPhase": 0, "BolusDeliveredRaw": 0, "BolusProgrammedRaw": 0}
    return [bench.frame("PUMP_BolusState", BolusStateHormone=drug, **nothing) for drug in (1, 2)]


def whole_batch(bench: Bench) -> list[Frame]:
    """What comes in every step and the bench does not send by itself."""
    toggle = bench.k % 2
    return [
        *idle_boluses(bench),
        bench.frame("HB_PUMP", NmtPump=5, TogglePump=toggle, ResetCausePump=0, BootPump=0),
        bench.frame("HB_CGM", NmtCgm=5, ToggleCgm=toggle, ResetCauseCgm=0, BootCgm=0),
    ]


# ---- situations


def dosing(dut: Dut, steps: int = 12, glucose: int = HIGH, **how: object) -> Bench:
    """A bench whose device gives insulin above the schedule, on account of a high glucose."""
    bench = dut.bench(**how)
    turn = bench.run(steps, glucose)
    expect(turn.state == State.AUTO, f"Auto after {steps} good samples; {turn.state_name} came")
    expect(turn.rate > bench.schedule, f"more than the schedule at {glucose / 10:g} mg/dL; {turn.rate} came")
    return bench


def overload(loop: Loop) -> None:
    """Make the step that begins now an overrun, by the routine that is there for tests.

    Raises:
        NotOffered: the device does not have it.
    """
    for ask in (EXTENDED_SESSION, MORE_WORK):
        said = loop.device.receive(Frame(codec.message("UDS_Request").can_id, ask.ljust(8, b"\xcc")))
        if not any(frame.data[1] == ask[1] + 0x40 for frame in said):
            raise NotOffered("the UDS routine 0201, which overloads a task")


# ---- what must be so


def expect_state(turn: Turn, state: State, when: str) -> None:
    """The device says it is in this state."""
    expect(turn.state == state, f"CtrlState {state.name} {when}; {turn.state_name} came")


def expect_unused(bench: Bench, turn: Turn, before: int, what: str) -> None:
    """The sample of this turn must not have been used."""
    expect(
        turn.used == before, f"{what} is not used in step {bench.k - 1}; LastCgmSeq went from {before} to {turn.used}"
    )


Said = Sequence[tuple[str, Values]]


def difference(before: Said, after: Said) -> str:
    """The first frame in which two turns differ, in words; empty if they do not."""
    for (name, old), (other, new) in zip(before, after, strict=False):
        if name != other:
            return f"{other} came in place of {name}"
        changed = [f"{key} {value} in place of {old[key]}" for key, value in new.items() if value != old[key]]
        if changed:
            return f"{name} came with {', '.join(changed)}"
    if len(before) == len(after):
        return ""
    return f"{before[len(after)][0]} did not come" if len(before) > len(after) else f"{after[len(before)][0]} came, too"
