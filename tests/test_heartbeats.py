"""E2E-07: a cyclic message that falls silent ends Auto at its timeout, with an alarm, and not before."""

import pytest
from bench import GLUCOSE, S2, Bench, Turn
from pumpbench import bench as bench_api
from pumpbench import faults
from pumpbench.bench import Outcome

import dbc
from can_bus.lockstep import STEP_SECONDS
from firmware_sim import heartbeat
from firmware_sim.alarms import Code
from firmware_sim.firmware import Firmware
from firmware_sim.heartbeat import Heartbeat
from firmware_sim.ladder import PUMP_SILENT, Ladder, State
from firmware_sim.wire import subscriptions

TOGGLE = {"HB_PUMP": "TogglePump", "HB_CGM": "ToggleCgm"}
NODES = {"HB_PUMP": (State.DELIVERY_UNCERTAIN, Code.PUMP_LOST), "HB_CGM": (State.DEGRADED, Code.CGM_LOST)}


def silences(steps: str) -> str:
    """Steps without a heartbeat, after each step; a step is the toggle bits that came in it, or - for none."""
    beat, told = Heartbeat(), ""
    for step, came in enumerate(steps.split()):
        for bit in came.strip("-"):
            beat.hear(int(bit))
        beat.close(step)
        told += str(beat.silence(step))
    return told


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("- - - -", "0000"),  # never heard, never missed
        ("0 1 0 1", "0000"),
        ("1 - - - -", "01234"),
        ("0 1 - 1 0", "00100"),  # a single lost one; the bit of the next one stands where it was
        ("0 - 0 - 0", "01010"),  # every second one lost: the bit proves nothing
        ("0 - - 1 0", "01200"),
        ("0 0 0 0 1", "01230"),  # a bit that stands still
        ("0 - 0 0 0 0", "010123"),
        ("0 00 00 0", "0123"),
        ("0 01 1 0", "0010"),  # two in a step, the second before its time
        ("0 11 1", "001"),  # two in a step, the second of which repeats the first
        ("- 1 1", "001"),
    ],
)
def test_a_heartbeat_is_a_bit_that_moves_or_comes_after_a_pause(steps: str, expected: str) -> None:
    assert silences(steps) == expected


def test_the_timeout_is_that_of_the_wire_and_of_the_pump() -> None:
    for name in TOGGLE:
        timeout = dbc.load().get_message_by_name(name).dbc.attributes["MsgTimeoutTime"].value
        assert (heartbeat.TIMEOUT - 1) * STEP_SECONDS * 1000 < timeout < heartbeat.TIMEOUT * STEP_SECONDS * 1000
    assert heartbeat.TIMEOUT == PUMP_SILENT
    assert set(TOGGLE) <= set(subscriptions())


# ---- in the firmware


def beating(steps: str, name: str, glucose: int = GLUCOSE) -> tuple[Bench, list[Turn]]:
    """20 steps with both heartbeats, then these: bits of one node's heartbeats as above; the other's go on."""
    bench, turns = Bench(mode=S2), []
    for k, came in enumerate(["ok"] * 20 + steps.split()):
        also = []
        for each, toggle in TOGGLE.items():
            usual = str(k % 2)
            bits = usual if came == "ok" or each != name else came.strip("-")
            also += [bench.frame(each, **{toggle: int(bit)}) for bit in bits]
        turns.append(bench.step(glucose + k % 2, also=also))
    return bench, turns[20:]


@pytest.mark.parametrize("name", TOGGLE)
@pytest.mark.parametrize("steps", ["- - - - 0 1", "1 1 1 1 0 1"])
def test_auto_ends_with_the_third_step_without_a_heartbeat(name: str, steps: str) -> None:
    bench, turns = beating(steps, name, GLUCOSE + 400)
    state, code = NODES[name]
    assert [turn.state for turn in turns] == [State.AUTO, State.AUTO, state, state, State.AUTO, State.AUTO]
    assert [bool(turn.alarms(code)) for turn in turns] == [False, False, *[True] * 4]  # it lasts half an hour at least
    assert all(turn.rate > bench.basal // 5 for turn in turns[:2])
    assert all(turn.rate <= bench.basal // 5 for turn in turns[2:4])


@pytest.mark.parametrize("name", TOGGLE)
@pytest.mark.parametrize("steps", ["- 1 0 1", "- - 0 1", "- 1 - 1 - 1 -"])
def test_less_is_no_silence(name: str, steps: str) -> None:
    _, turns = beating(steps, name)
    assert {turn.state for turn in turns} == {State.AUTO}
    assert not any(turn.alarms(NODES[name][1]) for turn in turns)


def test_a_silent_sensor_is_told_of_in_every_state() -> None:
    bench, _ = beating("0", "HB_CGM")
    bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=1, SuspendRequest=1)
    told = [bool(bench.step().alarms(Code.CGM_LOST)) for _ in range(4)]
    assert told == [False, False, True, True]
    assert bench.step().state == State.SUSPENDED


def test_a_device_that_never_heard_one_misses_none() -> None:
    assert Bench(mode=S2).run(40).state == State.AUTO


def test_a_reset_forgets_them_like_everything_that_was_heard() -> None:
    assert Firmware()._wire.silence("HB_PUMP", 100) == 0


def test_the_first_samples_do_not_lead_to_auto_while_the_sensor_is_silent() -> None:
    fields = {"calibrated": True, "suspended": False, "age": 0, "streak": 2, "pump_age": 0}
    ladder = Ladder()
    assert ladder.update(**fields, sensor_silent=True) == State.DEGRADED  # type: ignore[arg-type]
    assert ladder.rung == State.DEGRADED
    assert ladder.update(**fields) == State.AUTO  # type: ignore[arg-type]


# ---- on the bus

CYCLIC = {
    "CGM_Reading": ("CgmLost", State.DEGRADED, 4),  # the age of the last usable sample: 20 min (SEN-01)
    "PUMP_Status": ("PumpLost", State.DELIVERY_UNCERTAIN, 3),
    "PUMP_Delivered": ("PumpLost", State.DELIVERY_UNCERTAIN, 3),
    "HB_PUMP": ("PumpLost", State.DELIVERY_UNCERTAIN, 3),
    "HB_CGM": ("CgmLost", State.DEGRADED, 3),
}


def without(name: str, count: int) -> tuple[Outcome, list[State]]:
    outcome = bench_api.run(strategy="s2", hours=5, faults=[faults.drop(name, start="02:00", count=count)])
    outcome.assert_no_hazards()
    return outcome, [State(int(state)) for state in outcome.trace.get("CtrlState")[:-1]]


@pytest.mark.parametrize("name", CYCLIC)
def test_silence_beyond_the_timeout_ends_auto_at_once_with_an_alarm(name: str) -> None:
    alarm, state, steps = CYCLIC[name]
    outcome, states = without(name, 12)
    first = next(step for step in range(24, 60) if states[step] != State.AUTO)
    assert first == 24 + steps - 1
    assert states[first] == state
    assert int(next(event.time_s for event in outcome.alarms if event.code == alarm)) // STEP_SECONDS == first
    assert states[50:] == [State.AUTO] * len(states[50:])


@pytest.mark.parametrize("name", CYCLIC)
@pytest.mark.parametrize("lost", [1, 2])
def test_shorter_silence_is_none(name: str, lost: int) -> None:
    alarm, _, _ = CYCLIC[name]
    outcome, states = without(name, lost)
    assert states[24:] == [State.AUTO] * len(states[24:])
    assert alarm not in {event.code for event in outcome.alarms}


@pytest.mark.parametrize("name", TOGGLE)
def test_a_frozen_heartbeat_is_silence(name: str) -> None:
    alarm, state, _ = CYCLIC[name]
    stuck = faults.stuck_frame(name, start="02:00", end="03:00")
    outcome = bench_api.run(strategy="s3", hours=5, faults=[stuck])
    outcome.assert_no_hazards()
    outcome.assert_alarm(alarm, after="02:00", within="00:20")
    states = [State(int(value)) for value in outcome.trace.get("CtrlState")[:-1]]
    assert states[27:36] == [state] * 9  # the frame that is stuck was itself a heartbeat
    assert states[40:] == [State.AUTO] * len(states[40:])
