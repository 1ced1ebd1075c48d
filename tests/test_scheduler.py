"""Tasks, budgets, the watchdog, and what the device finds wrong with itself."""

from typing import Any

import pytest
from bench import GLUCOSE, S2, Bench

import firmware_sim.control.limits
from can_bus.lockstep import STEP_SECONDS, Done
from firmware_sim import selftest
from firmware_sim.alarms import Code
from firmware_sim.firmware import FRAMES_AT_MOST, NVM_BYTES, Firmware
from firmware_sim.ladder import State
from firmware_sim.nvm import RamMemory
from firmware_sim.scheduler import BITES_AFTER, Scheduler, Task
from firmware_sim.selftest import PATTERNS, Failure, check_program, check_ram


def counting(log: list[str], name: str, work: list[int], period: int = 300, budget: int = 5) -> Task:
    def run() -> int:
        log.append(name)
        return work[0]

    return Task(name, period, budget, run)


# ---- the scheduler alone


def test_tasks_run_in_order_when_their_period_has_passed() -> None:
    log: list[str] = []
    work = [1]
    scheduler = Scheduler((counting(log, "often", work, 300), counting(log, "seldom", work, 3600)))
    for tick in range(0, 7201, 300):
        scheduler.run(tick)
    assert log.count("often") == 25
    assert log.count("seldom") == 3
    assert log[:3] == ["often", "seldom", "often"]


def test_a_budget_may_be_used_up_and_not_more() -> None:
    work = [5]
    scheduler = Scheduler((counting([], "task", work),))
    assert scheduler.run(0) == 5
    assert (scheduler.late, scheduler.overruns) == ("", 0)
    work[0] = 6
    assert scheduler.run(300) == 6
    assert (scheduler.late, scheduler.overruns) == ("task", 1)
    work[0] = 1
    scheduler.run(600)
    assert scheduler.late == ""


def test_the_watchdog_bites_after_overruns_in_a_row_and_does_not_let_go() -> None:
    work = [9]
    scheduler = Scheduler((counting([], "task", work),))
    for k in range(BITES_AFTER - 1):
        scheduler.run(300 * k)
    work[0] = 1
    scheduler.run(300 * 10)  # one sound run in between
    work[0] = 9
    for k in range(BITES_AFTER):
        assert not scheduler.bitten
        scheduler.run(300 * (20 + k))
    assert scheduler.bitten
    work[0] = 1
    for k in range(20):
        scheduler.run(300 * (200 + k))
    assert scheduler.bitten


# ---- in the firmware


def flood(bench: Bench, count: int) -> list:
    return [bench.frame("UI_AlarmAck", AlarmAckNode=15, AlarmAckAction=0, AlarmAckInstance=0) for _ in range(count)]


def test_a_flood_is_an_overrun_that_is_told_and_passes() -> None:
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 300)
    turn = bench.step(GLUCOSE + 300, also=flood(bench, FRAMES_AT_MOST))
    assert turn.done["DoneStatus"] == Done.OVERRUN
    assert turn.alarms(Code.WATCHDOG)
    assert turn.done["ExecTime"] > FRAMES_AT_MOST
    turn = bench.step(GLUCOSE + 300)
    assert turn.done["DoneStatus"] == Done.OK
    assert turn.state == State.AUTO


def test_a_flood_that_stays_ends_in_fault_without_commands() -> None:
    """The pump goes to its schedule by itself when the last set-point expires (requirement FAL-07)."""
    bench = Bench(mode=S2)
    bench.run(20, GLUCOSE + 300)
    for _ in range(BITES_AFTER):
        turn = bench.step(GLUCOSE + 300, also=flood(bench, FRAMES_AT_MOST))
    for _ in range(10):
        turn = bench.step(GLUCOSE + 300)
        assert turn.state == State.FAULT
        assert not turn.all("PUMP_BasalCmd")
        assert turn.all("CTRL_Status")


def test_a_step_counts_its_work_the_same_way_every_time() -> None:
    works = []
    for _ in range(2):
        bench = Bench(mode=S2)
        works.append([bench.step(GLUCOSE + k).done["ExecTime"] for k in range(30)])
    assert works[0] == works[1]
    assert set(works[0][2:]) < set(range(1, 20))


def test_catching_up_after_a_long_gap_is_within_the_budget() -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    bench.k += 400
    turn = bench.step()
    assert turn.done["DoneStatus"] == Done.OK
    assert turn.done["ExecTime"] > 288


# ---- self test


def test_a_changed_program_is_found_at_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_program() == Failure.NONE
    monkeypatch.setattr(firmware_sim.control.limits, "PRAM_LOWEST_GLUCOSE", 600)
    assert check_program() == Failure.PROGRAM
    turn = Bench(mode=S2).run(5)
    assert turn.state == State.FAULT
    assert [alarm["CtrlAlarmAux"] for alarm in turn.alarms(Code.SELF_TEST)] == [Failure.PROGRAM]
    assert not turn.all("PUMP_BasalCmd")


def test_a_changed_function_is_found_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selftest.limits, "low", lambda state, parameters, inputs: False)
    assert check_program() == Failure.PROGRAM


class StuckBit(list):
    """A memory in which one bit of one word is always set."""

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        value = super().__getitem__(index)
        return value | 4 if index == 3 else value

    def __iter__(self):  # type: ignore[no-untyped-def]
        return (self[k] for k in range(len(self)))


def test_a_stuck_bit_is_found_and_a_sound_memory_keeps_what_it_holds() -> None:
    words = [5, -7, 1 << 30, 0]
    assert check_ram(words, [1]) == Failure.NONE
    assert words == [5, -7, 1 << 30, 0]
    assert check_ram(StuckBit([0] * 5)) == Failure.RAM


def test_a_parameter_that_changes_in_memory_ends_in_fault_within_the_hour() -> None:
    bench = Bench(mode=S2)
    bench.run(20)
    bench.firmware._calibration.parameters[0] += 1  # type: ignore[attr-defined]
    states = [bench.step().state for _ in range(13)]
    assert states[-1] == State.FAULT
    assert states.index(State.FAULT) <= 3600 // STEP_SECONDS
    assert bench.step().alarms(Code.SELF_TEST) or bench.run(3).alarms(Code.SELF_TEST)


def test_a_lost_memory_leaves_nothing_to_command_with() -> None:
    """Both banks bad: no calibration, so the pump's own schedule; SelfTest is raised (requirement RST-02)."""
    firmware = Firmware(broken())
    assert firmware._failures == Failure.MEMORY
    assert not firmware._calibration.active


def broken() -> RamMemory:
    memory = RamMemory(NVM_BYTES)
    memory.write(0, bytes(range(256)))
    return memory


def test_a_memory_that_does_not_take_back_what_it_held_is_found() -> None:
    class Leaky(list[int]):
        """Takes every pattern, and loses one bit of anything else."""

        def __setitem__(self, where: Any, words: Any) -> None:
            super().__setitem__(where, [word if word in PATTERNS else word & ~1 for word in words])

    assert check_ram(Leaky([3, 5])) == Failure.RAM
    assert check_ram([3, 5]) == Failure.NONE
