"""E2E-03: the values of a cyclic message are used only while its last checks are good enough."""

import itertools

import pytest
from bench import GLUCOSE, S2, Bench, Turn
from pumpbench import bench as bench_api
from pumpbench import faults

from can_bus.codec import Check
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from firmware_sim.alarms import Code
from firmware_sim.e2e_window import E2eWindow, Validity
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.ladder import State
from firmware_sim.nvm import RamMemory
from firmware_sim.wire import CYCLIC

CHECKS = {
    "g": (Check.OK,),
    "l": (Check.OK_SOME_LOST,),
    "r": (Check.REPEATED,),
    "s": (Check.WRONG_SEQUENCE,),
    "c": (Check.ERROR,),
    "m": (Check.MALFORMED,),
    "n": (Check.ERROR, Check.OK, Check.MALFORMED, Check.WRONG_SEQUENCE),  # noise beside a good frame
    "x": (Check.REPEATED, Check.ERROR),
    "-": (),
}


def states(steps: str) -> str:
    """The state after each step: 0 no data, v valid, i invalid."""
    window = E2eWindow()
    found = ""
    for step in steps:
        for check in CHECKS[step]:
            window.hear(check)
        assert window.close() == (window.state == Validity.VALID)
        found += "0vi"[window.state]
    return found


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("----", "0000"),
        ("g", "v"),  # the first frame of a run is used
        ("-l", "0v"),
        ("rrg", "00v"),
        ("cg", "0v"),
        ("csgggg", "0000vv"),  # not with two errors among the last four
        ("gcg", "vvv"),
        ("gcc", "vvi"),
        ("gsgm", "vvvi"),
        ("gcgggc", "vvvvvv"),  # the first error has left the window
        ("gcggc", "vvvvi"),
        ("gcgc", "vvvi"),
        ("gccggg", "vviiiv"),  # two good frames are not enough while two errors are there
        ("gcccggg", "vviiiiv"),
        ("gccrrg", "vviiii"),
        ("gccrrgg", "vviiiiv"),  # one good frame may be chance
        ("grrr", "vvvv"),
        ("grrrr", "vvvvi"),  # no good one among the last four
        ("grrrrggg", "vvvviivv"),
        ("g--------s", "vvvvvvvvvv"),  # silence is no check
        ("gc----c", "vvvvvvi"),
        ("gcc----g", "vviiiiii"),
        ("gnnnn", "vvvvv"),  # noise beside good frames takes nothing away
        ("n", "v"),
        ("gxx", "vvi"),
    ],
)
def test_the_state_machine(steps: str, expected: str) -> None:
    assert states(steps) == expected


def test_every_sequence_of_seven_checks_against_the_rules_in_words() -> None:
    for letters in itertools.product("gcr", repeat=7):
        steps = "".join(letters)
        valid, told = False, ""
        for end in range(1, 8):
            last = steps[max(end - 4, 0) : end]
            good, bad = last.count("g"), last.count("c")
            needed = 2 if "v" in told and not valid else 1
            valid = good >= needed and bad <= 1
            told += "v" if valid else "i" if "v" in told else "0"
        assert states(steps) == told, steps


# ---- in the firmware


def damaged(frame: Frame) -> Frame:
    return Frame(frame.can_id, bytes([*frame.data[:-1], frame.data[-1] ^ 0x10]))


def disturb(bench: Bench, name: str, pattern: str, glucose: int = GLUCOSE) -> list[Turn]:
    """Steps in which one message comes good (g), damaged (c) or not at all (-); the others as usual."""
    turns = []
    for step in pattern:
        frames = dict(zip(CYCLIC, (bench.sample(glucose), bench.status(), bench.delivered()), strict=True))
        if step == "c":
            frames[name] = damaged(frames[name])
        elif step == "-":
            del frames[name]
        bench.give(*frames.values())
        turns.append(bench.token(Phase.STEP, bench.k, bench.k * STEP_SECONDS))
        bench.obey(turns[-1])
        bench.k += 1
    return turns


def test_samples_are_not_used_until_the_window_is_good_again() -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    before = bench.k - 1
    turns = disturb(bench, "CGM_Reading", "gcgcgggg")
    used = [turn.status["LastCgmSeq"] - before for turn in turns]
    assert used == [1, 1, 3, 3, 3, 6, 7, 8]  # the fifth step's sample is good and not used: two errors in four
    assert [turn.state for turn in turns] == [State.AUTO] * 8
    assert turns[-1].diag["E2eErrorCount"] == 2
    assert turns[-1].diag["LostFrameCount"] == 2  # the damaged ones; what was not used had not been lost
    assert not any(turn.alarms(Code.CGM_IMPLAUSIBLE) for turn in turns)


def test_a_burst_of_errors_goes_down_the_ladder_by_the_age_of_the_last_used_sample() -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    turns = disturb(bench, "CGM_Reading", "ccgggg")
    assert [turn.state for turn in turns] == [
        State.AUTO, State.AUTO, State.AUTO, State.DEGRADED, State.DEGRADED, State.AUTO
    ]  # fmt: skip
    assert [bool(turn.alarms(Code.CGM_LOST)) for turn in turns[:4]] == [False] * 3 + [True]
    assert turns[3].alarms(Code.CGM_LOST)[0]["CtrlAlarmAux"] == 4


@pytest.mark.parametrize("name", ["PUMP_Status", "PUMP_Delivered"])
def test_a_pump_whose_frames_are_not_valid_counts_as_silent(name: str) -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    turns = disturb(bench, name, "ccggggg")
    uncertain = State.DELIVERY_UNCERTAIN
    assert [turn.state for turn in turns] == [State.AUTO, State.AUTO, uncertain, uncertain, *[State.AUTO] * 3]
    assert turns[2].alarms(Code.PUMP_LOST)


def test_totals_that_are_not_valid_are_made_up_for_later() -> None:
    bench, undisturbed = Bench(mode=S2), Bench(mode=S2)
    for each in (bench, undisturbed):
        each.run(20, 2000)
    disturb(bench, "PUMP_Delivered", "ccgggg", 2000)
    disturb(undisturbed, "PUMP_Delivered", "gggggg", 2000)
    for each in (bench, undisturbed):
        each.run(40)
    assert bench.firmware._delivery.insulin_day.total == pytest.approx(bench.total // 12, abs=bench.basal)  # type: ignore[attr-defined]


def test_what_the_pump_says_while_it_is_not_valid_is_not_believed() -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    disturb(bench, "PUMP_Status", "gcc")
    blocked = bench.frame("PUMP_Status", PumpState=3, InsulinReservoir=0, PramReservoir=2000, PumpBattery=90)
    bench.step(status=False, also=[blocked])
    assert not bench.firmware._pump.insulin_blocked  # type: ignore[attr-defined]
    disturb(bench, "PUMP_Status", "ggg")
    blocked = bench.frame("PUMP_Status", PumpState=3, InsulinReservoir=0, PramReservoir=2000, PumpBattery=90)
    bench.step(status=False, also=[blocked])
    assert bench.firmware._pump.insulin_blocked  # type: ignore[attr-defined]


def test_a_reset_begins_without_data() -> None:
    memory = RamMemory(NVM_BYTES)
    bench = Bench(mode=S2, firmware=Firmware(memory))
    bench.run(5)
    disturb(bench, "CGM_Reading", "gcc")
    windows = bench.firmware._wire._windows  # type: ignore[attr-defined]
    assert [windows[name].state for name in CYCLIC] == [Validity.INVALID, Validity.VALID, Validity.VALID]
    assert {window.state for window in Firmware(memory)._wire._windows.values()} == {Validity.NO_DATA}


# ---- bursts on the bus


@pytest.mark.parametrize("kind", ["drop", "corrupt", "replay", "stuck"])
@pytest.mark.parametrize("message", CYCLIC)
def test_after_a_burst_nothing_is_hurt_and_auto_comes_back(message: str, kind: str) -> None:
    fault = {
        "drop": faults.drop(message, start="02:00", end="02:40"),
        "corrupt": faults.flip_bits(message, bits=[21], start="02:00", end="02:40"),
        "replay": faults.replay(message, back=4, start="02:00", end="02:40"),
        "stuck": faults.stuck_frame(message, start="02:00", end="02:40"),
    }[kind]
    outcome = bench_api.run(strategy="s2", hours=6, faults=[fault])
    outcome.assert_no_hazards()
    states = [State(int(state)) for state in outcome.trace.get("CtrlState")[:-1]]
    away = [step for step, state in enumerate(states) if state != State.AUTO and step > 2]
    if (message, kind) == ("PUMP_Status", "replay"):  # in order among themselves: what they say gives them away
        outcome.assert_alarm("DeliveryUncertain", after="02:00", within="00:25")
        assert away == []
        return
    outcome.assert_alarm("CgmLost" if message == "CGM_Reading" else "PumpLost", after="02:00", within="00:25")
    assert 24 < away[0] <= 28
    if (message, kind) == ("PUMP_Delivered", "replay"):  # totals that fell first and then rise are totals again
        assert away[-1] == 26
        return
    lost_by_window = {"drop": 0, "corrupt": 2, "replay": 0, "stuck": 1}[kind]  # beside the one for the counter's jump
    climb = 2 if message == "CGM_Reading" else 0  # SafeBasal, Degraded, Auto
    assert away[-1] == 32 + lost_by_window + climb
