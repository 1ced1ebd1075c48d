"""The firmware as a node: turns, modes, suspension, the pump's totals, alarms."""

import itertools
import random
from collections.abc import Callable, Sequence

import pytest
from bench import GLUCOSE, MODE_OFF, NMA, OPEN_LOOP, S2, SENT_BY_CTRL, Bench, Turn, calibration
from hypothesis import given, settings
from hypothesis import strategies as st

import dbc
from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase
from firmware_sim.alarms import PRIORITY, STEPS_AT_LEAST, Code, Priority
from firmware_sim.alarms import State as AlarmState
from firmware_sim.firmware import VERSION, Firmware
from firmware_sim.ladder import State
from firmware_sim.pump import RATE_EXPIRES_AFTER, Op, Pump
from firmware_sim.user import SUPPORTED_MODES
from firmware_sim.wire import subscriptions

STEP_FRAMES = ["PUMP_BasalCmd", "CTRL_Status", "CTRL_Diag", "HB_CTRL", "SYNC_Done"]
"""What an uneventful step is answered with, in this order."""

SETTLED = 9
"""Steps after which nothing is told of the start any more."""

MAJOR, MINOR = dbc.protocol_version()


def of_ctrl(frames: Sequence[Frame]) -> list[Frame]:
    return [frame for frame in frames if codec.messages_by_id()[frame.can_id].sender == "CTRL"]


# ---- roll call


def test_roll_call_says_who_is_there() -> None:
    bench = Bench(start=False)
    turn = bench.call_roll()
    assert turn.names == ["HB_CTRL", "CTRL_Info", "SYNC_Done"]
    assert turn.one("HB_CTRL")["NmtCtrl"] == 0  # boot-up
    info = turn.one("CTRL_Info")
    assert (info["CtrlProtocolMajor"], info["CtrlProtocolMinor"]) == (MAJOR, MINOR)
    assert (info["FirmwareMajor"], info["FirmwareMinor"]) == VERSION
    assert turn.done == {"DoneStatus": Done.OK, "DoneStepIndex": 1, "TxCount": 3, "ExecTime": turn.done["ExecTime"]}


def test_a_run_does_not_depend_on_how_often_the_roll_was_called() -> None:
    runs = []
    for calls in (1, 2, 5, 17):
        bench = Bench(start=False)
        for call in range(calls):
            assert bench.call_roll().done["DoneStepIndex"] == call + 1
        start = len(bench.log)
        bench.configure(calibration(), S2)
        bench.run(40, 1700)
        runs.append(bench.log[start:])
    assert runs[0] == runs[1] == runs[2] == runs[3]
    first = {frame.can_id: frame.data[1] & 0xF for frame in reversed(of_ctrl(runs[0])) if len(frame.data) == 8}
    assert set(first.values()) == {0}  # every counter of the run starts at 0


def test_a_roll_call_in_the_middle_of_a_run_starts_anew() -> None:
    bench = Bench(mode=S2)
    bench.run(20, 1900)
    for _ in range(5):
        bench.step(drop=True)
    bench.call_roll()
    bench.configure(bench.flash, S2)
    bench.k = 0
    bench.total = 0
    again = Bench(mode=S2)
    for _ in range(12):
        assert bench.step(1500).frames == again.step(1500).frames


@pytest.mark.parametrize(
    ("version", "status"),
    [
        ((MAJOR, MINOR), Done.OK),
        ((MAJOR, MINOR + 1), Done.OK),
        ((MAJOR + 1, MINOR), Done.FAULT),
        ((MAJOR - 1, MINOR), Done.FAULT),
        ((63, 63), Done.FAULT),
    ],
)
def test_another_major_version_is_a_fault(version: tuple[int, int], status: Done) -> None:
    turn = Bench(start=False).call_roll(version)
    assert turn.done["DoneStatus"] == status
    assert turn.one("CTRL_Info")["CtrlProtocolMajor"] == MAJOR  # so that the other side can say what is wrong


def test_a_bench_that_does_not_say_its_version_is_let_in() -> None:
    bench = Bench(start=False)
    assert bench.token(Phase.INIT, 1).done["DoneStatus"] == Done.OK


# ---- turns


def test_it_speaks_only_in_its_turn() -> None:
    """Every message it subscribes to, at any time: silence, until the token comes."""
    bench = Bench()
    bench.run(3)
    for name in subscriptions():
        if name == "SYNC_Step":
            continue
        message = codec.message(name)
        for page in message.pages or [None]:
            values = {field.name: field.low for field in message.pages[page]} if message.pages else {}
            if message.selector:
                values[message.selector] = page
            bench.send(name, **values)  # asserts silence


def test_an_uneventful_step_is_five_frames_and_done_is_the_last() -> None:
    bench = Bench()
    bench.run(SETTLED)
    for _ in range(20):
        assert bench.step().names == STEP_FRAMES


def test_only_frames_of_its_own_are_sent() -> None:
    allowed = {codec.message(name).can_id: codec.message(name).length for name in SENT_BY_CTRL}
    bench = Bench(mode=S2)
    draw = random.Random(5)
    for k in range(300):
        turn = bench.step(draw.randint(400, 3000), drop=draw.random() < 0.3, status=draw.random() < 0.8)
        assert all(allowed[frame.can_id] == len(frame.data) for frame in turn.frames), k


def test_what_was_queued_before_the_turn_is_counted_too() -> None:
    bench = Bench()
    bench.run(SETTLED)
    echoed = [bench.frame("CFG_Param", CfgIndex=5, CfgMaxIob=1000) for _ in range(7)]
    turn = bench.step(also=echoed)
    assert turn.names == ["CFG_ParamEcho"] * 7 + STEP_FRAMES
    assert turn.done["TxCount"] == 12


def test_the_same_token_again_is_no_new_step() -> None:
    bench, undisturbed = Bench(), Bench()
    for k in range(30):
        assert bench.step(1300 + 10 * k).command == undisturbed.step(1300 + 10 * k).command
        for earlier in {k, max(k - 1, 0), 0}:
            assert bench.token(Phase.STEP, earlier).names == ["SYNC_Done"]


def test_a_duplicate_of_the_token_frame_is_not_even_answered() -> None:
    bench = Bench()
    bench.run(5)
    token = next(frame for frame in reversed(bench.log) if frame.can_id == codec.message("SYNC_Step").can_id)
    for _ in range(3):
        bench.give(token)
    assert bench.step().diag["SequenceErrorCount"] == 3


@pytest.mark.parametrize("phase", [2, 3, 5, 6, 7, 14, 15])
def test_other_phases_get_sync_done_and_dose_nothing(phase: int) -> None:
    bench, undisturbed = Bench(), Bench()
    bench.run(5), undisturbed.run(5)
    frame = bench.frame("SYNC_Step", SyncPhase=0, StepIndex=bench.k, SimTime=0)
    word = int.from_bytes(frame.data, "little") & ~0xFFFF | phase << 12
    token = frame._replace(data=codec.protect(codec.message("SYNC_Step"), word, frame.data[1] & 0xF))
    turn = bench.hand_over(token, bench.k)
    assert turn.names == ["SYNC_Done"]
    assert turn.done["DoneStatus"] == Done.OK
    assert not bench.firmware.finished
    assert bench.step(1500).command == undisturbed.step(1500).command


def test_a_step_without_a_number_is_no_step() -> None:
    bench = Bench()
    bench.run(SETTLED)
    assert bench.token(Phase.STEP, 1048575).names == ["SYNC_Done"]
    assert bench.step().names == STEP_FRAMES


def test_the_end_is_answered_and_finishes() -> None:
    bench = Bench()
    bench.run(3)
    assert not bench.firmware.finished
    turn = bench.token(Phase.END, bench.k)
    assert turn.names == ["SYNC_Done"]
    assert bench.firmware.finished


@pytest.mark.parametrize("start", [120, 250, 65530, 1048560])
def test_no_counter_wraps_into_a_dose(start: int) -> None:
    """Modulo 128, 256, 65535 and the last step there is: commands expire three steps ahead, samples stay fresh."""
    bench = Bench()
    bench.k = start
    for k in range(start, min(start + 20, 1048575)):
        turn = bench.step(1400)
        assert turn.command["BasalUntilStep"] == (k + RATE_EXPIRES_AFTER) % 128
        assert turn.state == (State.AUTO if k > start else State.INIT)
        assert turn.status["LastCgmSeq"] == k % 65535


def test_command_numbers_count_up_and_wrap() -> None:
    bench = Bench()
    for k in range(1030):
        assert bench.step().command["BasalCmdSeq"] == k % 1023  # 1023 is SNA


def test_skipped_steps_age_the_sample_by_the_true_distance() -> None:
    bench = Bench()
    bench.run(5)
    bench.k += 6
    turn = bench.step(drop=True)
    assert turn.state == State.SAFE_BASAL
    assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE


def test_truth_and_injection_reports_do_not_influence_it() -> None:
    """PLANT_Truth and FAULT_Inject are for the recording; they may say anything."""
    bench, undisturbed = Bench(mode=S2), Bench(mode=S2)
    draw = random.Random(6)
    for k in range(50):
        noise = [
            Frame(codec.message(name).can_id, draw.randbytes(codec.message(name).length))
            for name in ("PLANT_Truth", "FAULT_Inject")
        ]
        glucose = 1200 + 20 * k
        assert bench.step(glucose, also=noise).frames == undisturbed.step(glucose).frames


# ---- heartbeat


def test_heartbeat_tells_the_state_and_toggles() -> None:
    bench = Bench(flash={})
    beats = [bench.step().one("HB_CTRL") for _ in range(3)]
    assert {beat["NmtCtrl"] for beat in beats} == {127}  # pre-operational without a calibration
    bench.configure(calibration(), NMA)
    bench.basal = 1425
    beats += [bench.step().one("HB_CTRL") for _ in range(5)]
    assert {beat["NmtCtrl"] for beat in beats[3:]} == {5}
    toggles = [beat["ToggleCtrl"] for beat in beats]
    assert all(one != other for one, other in itertools.pairwise(toggles))


# ---- modes


@pytest.mark.parametrize("mode", sorted(set(range(16)) - set(SUPPORTED_MODES)))
def test_a_mode_this_build_does_not_have_is_refused(mode: int) -> None:
    bench, undisturbed = Bench(), Bench()
    assert bench.run(5, 1500).frames == undisturbed.run(5, 1500).frames
    turn = bench.step(1500, also=[bench.frame("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=1, SuspendRequest=0)])
    (alarm,) = turn.alarms(Code.DOSE_REJECTED)
    assert alarm["CtrlAlarmState"] == AlarmState.PENDING
    assert turn.status["CtrlMode"] == NMA
    assert turn.command == undisturbed.step(1500).command


@pytest.mark.parametrize("mode", [mode for mode in SUPPORTED_MODES if mode != MODE_OFF])
def test_a_mode_is_taken_up_in_the_same_step_and_its_change_alone_never_doses(mode: int) -> None:
    bench = Bench(mode=NMA if mode != NMA else S2)
    before = bench.run(60)  # at target, at rest
    turn = bench.step(also=[bench.frame("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=1, SuspendRequest=0)])
    assert turn.status["CtrlMode"] == mode
    assert abs(turn.rate - before.rate) <= 1
    assert not turn.all("PUMP_BolusCmd")
    assert not turn.alarms(Code.DOSE_REJECTED)


def test_pramlintide_comes_with_the_mode_that_has_it() -> None:
    bench = Bench(mode=NMA)
    assert bench.run(10, 2000).command["PramlintideRate"] == 0
    bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=1, SuspendRequest=0)
    for _ in range(20):
        command = bench.step(2000).command
        assert abs(command["PramlintideRate"] - command["InsulinRate"] * 0.5) <= 1  # 10 ug/U
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=2, SuspendRequest=0)
    assert bench.step(2000).command["PramlintideRate"] == 0


def test_an_open_loop_runs_the_schedule() -> None:
    bench = Bench(mode=OPEN_LOOP)
    bench.run(2)
    rates = [bench.step(4000 if k % 50 < 25 else 500).rate for k in range(200)]
    assert set(rates) <= {bench.basal // 5, bench.basal // 5 + 1}


@pytest.mark.parametrize(("last", "number"), [(7, 7), (7, 6), (7, 0), (7, 135), (7, 255), (200, 200), (200, 255)])
def test_an_old_or_repeated_mode_command_is_ignored(last: int, number: int) -> None:
    bench = Bench()
    bench.run(3)
    for sequence in (last // 2, last):
        bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=sequence, SuspendRequest=0)
    assert bench.step().status["CtrlMode"] == S2
    errors = bench.step().diag["SequenceErrorCount"]
    for _ in range(3):
        bench.send("MODE_Cmd", ModeRequest=MODE_OFF, ModeCmdSeq=number, SuspendRequest=1)
        turn = bench.step()
        assert turn.status["CtrlMode"] == S2
        assert turn.state == State.AUTO
    assert turn.diag["SequenceErrorCount"] - errors == (0 if number == last else 3)  # a repetition is no error


@pytest.mark.parametrize("sequence", [8, 7 + 127])
def test_a_newer_mode_command_counts(sequence: int) -> None:
    bench = Bench()
    bench.send("MODE_Cmd", ModeRequest=NMA, ModeCmdSeq=7, SuspendRequest=0)
    bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=sequence, SuspendRequest=0)
    assert bench.step().status["CtrlMode"] == S2


def test_mode_numbers_wrap() -> None:
    bench = Bench()
    for k in range(1, 600):
        bench.send("MODE_Cmd", ModeRequest=S2 if k % 2 else NMA, ModeCmdSeq=k % 255, SuspendRequest=0)
        assert bench.step().status["CtrlMode"] == (S2 if k % 2 else NMA)


# ---- suspension


def suspend(bench: Bench, sequence: int, request: int, mode: int = S2) -> None:
    bench.send("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=sequence, SuspendRequest=request)


def test_suspend_stops_both_drugs_in_the_same_step_and_only_resume_ends_it() -> None:
    bench = Bench(mode=S2)
    assert bench.run(20, 2500).command["PramlintideRate"] > 0
    suspend(bench, 1, 1)
    for k in range(40):
        if k == 10:
            suspend(bench, 2, 0, mode=NMA)  # another mode
        if k == 20:
            suspend(bench, 3, 3)  # SNA
        turn = bench.step(2500, drop=20 < k < 30)  # nor does a gap of the CGM
        assert turn.state == State.SUSPENDED
        assert turn.command["BasalOp"] == Op.SUSPEND
        assert turn.command["InsulinRate"] == turn.command["PramlintideRate"] == 8191  # says nothing
    suspend(bench, 4, 2)
    turn = bench.step(2500)
    assert turn.state == State.AUTO
    assert turn.rate > 0


def test_a_resume_into_a_lost_cgm_says_so() -> None:
    """What stands under the suspension shows at once, also when it flapped all the while."""
    bench = Bench(mode=S2)
    bench.run(10, 2000)
    suspend(bench, 1, 1)
    for k in range(30):
        bench.step(2000, drop=k < 10 or k % 2 == 0)
    suspend(bench, 2, 2)
    turn = bench.step(2000, drop=True)
    assert turn.state == State.SAFE_BASAL
    assert turn.alarms(Code.CGM_LOST)


def test_mode_off_suspends() -> None:
    bench = Bench(mode=MODE_OFF)
    turn = bench.run(5, 3000)
    assert turn.state == State.SUSPENDED
    assert turn.command["BasalOp"] == Op.SUSPEND


def test_insulin_on_board_follows_the_totals_not_the_commands() -> None:
    """A pump that delivers nothing leaves nothing on board, whatever was asked of it."""
    bench, stuck = Bench(), Bench()
    for _ in range(60):
        delivering = bench.step(3000).status["InsulinOnBoard"]
        on_board = stuck.step(3000, totals=stuck.delivered(InsulinTotal=0)).status["InsulinOnBoard"]
    assert delivering > 100
    assert on_board == 0


def test_insulin_on_board_decays_as_two_compartments() -> None:
    bench = Bench(mode=OPEN_LOOP)
    bench.run(3)
    bench.total += 12 * 10000  # 10 U at once
    seen = [bench.step().status["InsulinOnBoard"] for _ in range(61)]
    for k, on_board in enumerate(seen):
        t = 5 * k / 55
        assert on_board == pytest.approx(1000 * (1 + t) * 2.718281828459045**-t, abs=2)  # 0.01 U
    assert seen[60] < 30  # 3 % after 5 h


# ---- the pump's totals


def totals(total: int, boot: int = 0) -> dict[str, int]:
    return {"InsulinTotal": total, "PumpBootCount": boot, "PramTotal": 0}


def test_delivered_is_the_difference_of_totals() -> None:
    pump = Pump()
    assert pump.delivered(None, 0, 1200) == -1
    assert pump.delivered(totals(5000), 1, 1200) == -1  # what came before is not known
    assert pump.delivered(totals(5150), 2, 1200) == 150
    assert pump.delivered(totals(5150), 3, 1200) == 0


@pytest.mark.parametrize("actual", [0, 50, 100, 250])
def test_a_missing_total_is_estimated_and_settled(actual: int) -> None:
    pump = Pump()
    pump.delivered(totals(1000), 0, 1200)
    booked = [pump.delivered(None, 1, 1200), pump.delivered(None, 2, 1200)]
    assert booked == [100, 100]  # the schedule, for no command is in force
    total = 1000 + actual
    booked.append(pump.delivered(totals(total), 3, 1200))
    for step in range(4, 10):
        total += 60
        booked.append(pump.delivered(totals(total), step, 1200))
    assert sum(booked) == total - 1000
    assert min(booked) >= 0


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(st.integers(0, 400), st.sampled_from(["ok", "ok", "missing", "falls", "reserved"])),
        min_size=1,
        max_size=60,
    )
)
def test_the_sum_of_steps_is_what_the_pump_says(steps: list[tuple[int, str]]) -> None:
    """Never less than the pump's total, and equal to it once no estimate is open."""
    pump = Pump()
    total, booked = 10000, 0
    assert pump.delivered(totals(total), 0, 1200) == -1
    refused = 0
    for step, (amount, what) in enumerate(steps, start=1):
        total += amount
        heard = {
            "ok": totals(total),
            "missing": None,
            "falls": totals(9999),
            "reserved": totals(16777214),
        }[what]
        refused += what == "falls"
        delivered = pump.delivered(heard, step, 1200)
        assert delivered >= 0
        booked += delivered
        if what == "ok":
            assert booked >= total - 10000
    total += 100000
    booked += pump.delivered(totals(total), 100, 1200)
    assert booked == total - 10000
    assert pump.refused == refused


def test_a_falling_total_counts_as_not_received() -> None:
    bench = Bench()
    bench.run(30, 2000)
    before = bench.step(2000)
    turn = bench.step(2000, totals=bench.delivered(InsulinTotal=0))
    assert turn.diag["SequenceErrorCount"] == before.diag["SequenceErrorCount"] + 1
    assert turn.status["InsulinOnBoard"] >= before.status["InsulinOnBoard"] - 1  # it does not drop
    after = bench.step(2000)
    assert after.status["InsulinOnBoard"] == pytest.approx(turn.status["InsulinOnBoard"], abs=5)


def test_totals_that_keep_falling_make_delivery_uncertain() -> None:
    bench = Bench()
    bench.run(5)
    states = [bench.step(totals=bench.delivered(InsulinTotal=0)).state for _ in range(4)]
    assert states == [State.AUTO, State.AUTO, State.DELIVERY_UNCERTAIN, State.DELIVERY_UNCERTAIN]


def test_a_reset_of_the_pump_starts_a_new_base() -> None:
    pump = Pump()
    pump.delivered(totals(90000, boot=3), 0, 1200)
    assert pump.delivered(totals(90100, boot=3), 1, 1200) == 100
    assert pump.delivered(totals(30, boot=4), 2, 1200) == 30
    assert pump.delivered(totals(150, boot=4), 3, 1200) == 120
    assert pump.delivered(totals(10, boot=0), 4, 1200) == 10  # the count has wrapped
    assert pump.refused == 0


def test_a_boot_count_that_says_nothing_is_no_reset() -> None:
    """Its whole total would be booked as one dose."""
    bench, undisturbed = Bench(), Bench()
    bench.run(100, 2000), undisturbed.run(100, 2000)
    turn = bench.step(2000, totals=bench.delivered(PumpBootCount=15))
    other = undisturbed.step(2000, totals=False)
    assert turn.command == other.command
    assert turn.status == other.status


@pytest.mark.parametrize("total", [16777214, 16777215])
def test_reserved_totals_count_as_not_received(total: int) -> None:
    bench, undisturbed = Bench(), Bench()
    bench.run(10, 2000), undisturbed.run(10, 2000)
    for _ in range(2):
        frame = bench.frame("PUMP_Delivered", PumpBootCount=0, InsulinTotal=total, PramTotal=0)
        assert bench.step(2000, totals=frame).command == undisturbed.step(2000, totals=False).command


@pytest.mark.parametrize("what", ["status", "totals", "both"])
def test_a_silent_pump_is_noticed_after_three_steps(what: str) -> None:
    """11 min without a status or totals; back when both can be used again."""
    bench = Bench(mode=S2)
    bench.run(20, 2500)
    states, alarms = [], []
    for _ in range(6):
        turn = bench.step(2500, status=what == "totals", totals=what == "status")
        states.append(turn.state)
        alarms.append(bool(turn.alarms(Code.PUMP_LOST)))
        if turn.state == State.DELIVERY_UNCERTAIN:
            assert turn.rate <= bench.basal // 5
    uncertain = [State.DELIVERY_UNCERTAIN] * 4
    assert states == [State.AUTO, State.AUTO, *uncertain]
    assert alarms == [False, False, True, True, True, True]
    assert bench.step(2500).state == State.DELIVERY_UNCERTAIN  # its counter has jumped by more than 3
    assert bench.step(2500).state == State.AUTO


def test_on_board_stays_through_a_silent_pump() -> None:
    bench = Bench()
    bench.run(40, 2500)
    before = bench.step(2500).status["InsulinOnBoard"]
    for _ in range(3):
        turn = bench.step(2500, totals=False, status=False)
    assert turn.status["InsulinOnBoard"] > 0.8 * before


def test_without_pump_and_sensor_it_is_the_schedule() -> None:
    """Uncertain delivery is no excuse to go on at the rate of an hour ago."""
    bench = Bench(mode=S2)
    bench.run(20, 2500)
    for age in range(1, 20):
        turn = bench.step(drop=True, status=False, totals=False)
        if age >= 3:
            assert turn.state == State.DELIVERY_UNCERTAIN
        if age >= 7:
            assert turn.command["BasalOp"] == Op.RESUME_SCHEDULE
        elif age >= 3:
            assert turn.rate <= bench.basal // 5
        if age >= 4:
            assert any(alarm["CtrlAlarmCode"] == Code.CGM_LOST for alarm in turn.all("CTRL_Alarm"))


# ---- alarms


def lose_cgm(bench: Bench, steps: int) -> Turn:
    for _ in range(steps):
        turn = bench.step(drop=True)
    return turn


def acknowledge(bench: Bench, instance: int, action: int, node: int = 1) -> Frame:
    return bench.frame("UI_AlarmAck", AlarmAckNode=node, AlarmAckAction=action, AlarmAckInstance=instance)


def test_an_alarm_is_repeated_until_confirmed_and_ends_once() -> None:
    bench = Bench()
    bench.run(5)
    (alarm,) = lose_cgm(bench, 4).alarms(Code.CGM_LOST)
    assert alarm["CtrlAlarmState"] == AlarmState.PENDING
    assert alarm["CtrlAlarmPriority"] == Priority.MEDIUM
    assert alarm["CtrlAlarmAux"] == 4  # the age of the sample
    instance = alarm["CtrlAlarmInstance"]
    for age in (5, 6):
        (alarm,) = lose_cgm(bench, 1).alarms(Code.CGM_LOST)
        assert (alarm["CtrlAlarmState"], alarm["CtrlAlarmInstance"]) == (AlarmState.PENDING, instance)
        assert alarm["CtrlAlarmAux"] == age
    bench.give(acknowledge(bench, instance, 1))
    (alarm,) = lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    assert (alarm["CtrlAlarmState"], alarm["CtrlAlarmInstance"]) == (AlarmState.CONFIRMED, instance)
    for _ in range(4):
        assert not lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    frames = [alarm for _ in range(10) for alarm in bench.step().alarms(Code.CGM_LOST)]
    assert [frame["CtrlAlarmState"] for frame in frames].count(AlarmState.INACTIVE) == 1
    assert frames[-1]["CtrlAlarmState"] == AlarmState.INACTIVE
    assert {frame["CtrlAlarmInstance"] for frame in frames} == {instance}


def test_snoozed_is_quiet_and_can_still_be_confirmed() -> None:
    bench = Bench()
    bench.run(5)
    (alarm,) = lose_cgm(bench, 4).alarms(Code.CGM_LOST)
    instance = alarm["CtrlAlarmInstance"]
    bench.give(acknowledge(bench, instance, 2))
    (alarm,) = lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    assert alarm["CtrlAlarmState"] == AlarmState.SNOOZED
    assert not lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    bench.give(acknowledge(bench, instance, 1))
    (alarm,) = lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    assert alarm["CtrlAlarmState"] == AlarmState.CONFIRMED


@pytest.mark.parametrize(
    ("instance", "action", "node"), [(2, 1, 1), (65534, 1, 1), (1, 1, 2), (1, 0, 1), (1, 15, 1), (1, 1, 0)]
)
def test_an_acknowledgement_of_something_else_changes_nothing(instance: int, action: int, node: int) -> None:
    bench = Bench()
    bench.run(5)
    (alarm,) = lose_cgm(bench, 4).alarms(Code.CGM_LOST)
    assert alarm["CtrlAlarmInstance"] == 1
    bench.give(acknowledge(bench, instance, action, node))
    (alarm,) = lose_cgm(bench, 1).alarms(Code.CGM_LOST)
    assert alarm["CtrlAlarmState"] == AlarmState.PENDING


def test_confirming_does_not_remove_the_cause() -> None:
    bench = Bench()
    bench.run(5, 2500)
    turn = lose_cgm(bench, 4)
    bench.give(acknowledge(bench, turn.alarms(Code.CGM_LOST)[0]["CtrlAlarmInstance"], 1))
    for _ in range(10):
        turn = lose_cgm(bench, 1)
    assert turn.state == State.SAFE_BASAL


def test_every_alarm_has_a_number_of_its_own() -> None:
    bench = Bench()
    bench.run(5)
    seen: dict[int, int] = {}
    for k in range(120):
        corrupt = bench.sample()._replace(data=bytes(8))
        refused = bench.frame("MODE_Cmd", ModeRequest=9, ModeCmdSeq=1 + k, SuspendRequest=0)
        also = [frame for frame, every in ((corrupt, 23), (refused, 17)) if k % every == 0]
        turn = bench.step(drop=k % 30 in range(8), status=k % 40 not in range(5), also=also)
        for alarm in turn.all("CTRL_Alarm"):
            code = seen.setdefault(alarm["CtrlAlarmInstance"], alarm["CtrlAlarmCode"])
            assert code == alarm["CtrlAlarmCode"]
    assert sorted(seen) == list(range(len(seen)))
    assert {Code.CGM_LOST, Code.PUMP_LOST, Code.DOSE_REJECTED, Code.E2E_FAULT} <= set(seen.values())


def test_the_highest_priority_comes_first() -> None:
    bench = Bench()
    bench.run(5)
    for k in range(8):
        also = [bench.frame("MODE_Cmd", ModeRequest=9, ModeCmdSeq=1 + k, SuspendRequest=0)]
        also.append(bench.sample()._replace(data=bytes(8)))
        turn = bench.step(drop=True, status=False, also=also)
    alarms = turn.all("CTRL_Alarm")
    assert len(alarms) >= 4
    priorities = [alarm["CtrlAlarmPriority"] for alarm in alarms]
    assert priorities == sorted(priorities, reverse=True)
    assert alarms[0]["CtrlAlarmCode"] == Code.PUMP_LOST
    assert all(alarm["CtrlAlarmPriority"] == PRIORITY[Code(alarm["CtrlAlarmCode"])] for alarm in alarms)


def test_a_passing_error_is_one_alarm_that_ends() -> None:
    bench = Bench()
    bench.run(5)
    corrupt = bench.sample()._replace(data=bytes(8))
    frames = bench.step(also=[corrupt]).alarms(Code.E2E_FAULT)
    for _ in range(STEPS_AT_LEAST + 3):
        frames += bench.step().alarms(Code.E2E_FAULT)
    states = [frame["CtrlAlarmState"] for frame in frames]
    assert states == [AlarmState.PENDING] * STEPS_AT_LEAST + [AlarmState.INACTIVE]


Script = Callable[[random.Random, Bench, int], Turn]


def confirm_all(bench: Bench, turn: Turn) -> None:
    for alarm in turn.all("CTRL_Alarm"):
        if alarm["CtrlAlarmState"] == AlarmState.PENDING:
            bench.give(acknowledge(bench, alarm["CtrlAlarmInstance"], 1))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("confirming", [True, False])
def test_every_change_of_state_is_told_in_the_same_step(seed: int, confirming: bool) -> None:
    """Up and down the ladder and through a silent pump, also to a user who has confirmed everything already."""
    causes = {Code.CGM_LOST, Code.PUMP_LOST}
    bench, draw = Bench(mode=S2), random.Random(seed)
    state = bench.run(3, GLUCOSE).state
    pairs = set()
    lost = silent = 0
    for _ in range(1500):
        lost = lost - 1 if lost else draw.choice([0] * 12 + [3, 4, 5, 7, 9])
        silent = silent - 1 if silent else draw.choice([0] * 15 + [3, 5])
        turn = bench.step(draw.randint(900, 2500), drop=lost > 0, status=not silent)
        if turn.state != state:
            pairs.add((state, turn.state))
            assert causes & {alarm["CtrlAlarmCode"] for alarm in turn.all("CTRL_Alarm")}, (state, turn.state)
        state = turn.state
        if confirming:
            confirm_all(bench, turn)
    auto, degraded, safe, uncertain = State.AUTO, State.DEGRADED, State.SAFE_BASAL, State.DELIVERY_UNCERTAIN
    assert {(auto, degraded), (degraded, safe), (safe, degraded), (degraded, auto), (auto, uncertain)} <= pairs
    assert {(uncertain, auto), (uncertain, degraded), (uncertain, safe)} & pairs


def test_a_device_that_starts_says_so_before_it_listens() -> None:
    """It cannot know whether a run is on: the bench may have taken its power away, and its memory too."""
    (frame,) = Firmware().start()
    assert codec.messages_by_id()[frame.can_id].name == "HB_CTRL"
    assert codec.message("HB_CTRL").unpack(frame.data)["NmtCtrl"] == 0


def test_an_alarm_that_is_not_in_force_is_not_renewed() -> None:
    bench = Bench()
    bench.run(3)
    bench.firmware._alarms.renew(Code.CGM_LOST)  # type: ignore[attr-defined]
    assert not bench.step().alarms(Code.CGM_LOST)
