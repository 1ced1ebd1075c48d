"""Seven modes, one controller: switched over the bus without a bump, and bit-identical when compiled."""

from dataclasses import replace

import numpy as np
import pytest
from bench import GLUCOSE, NMA, Bench
from pair import Pair
from pumpbench.calibration import MODES, tuning_for
from pumpbench.closed_loop import compiled

import firmware_sim.firmware
from firmware_sim.bolus import IDS, Boluses, Drug
from firmware_sim.control import core, layout
from plant_server.physiology import load_patient


@pytest.mark.parametrize("strategy", MODES)
def test_a_mode_is_taken_over_without_a_bump(strategy: str) -> None:
    """The same glucose in two modes gives the same insulin infusion, before, at and after the change."""
    staying, changing = Bench(mode=NMA), Bench(mode=NMA)
    for k in range(60):
        if k == 30:
            changing.send("MODE_Cmd", ModeRequest=MODES[strategy], ModeCmdSeq=1, SuspendRequest=0)
        glucose = GLUCOSE + 12 * k
        one, other = staying.step(glucose), changing.step(glucose)
        assert k < 2 or one.rate == other.rate, k  # the first sample only opens the ladder
        assert not other.all("PUMP_BolusCmd")  # a change of mode alone never doses (requirement USR-04)
    assert other.status["CtrlMode"] == MODES[strategy]
    assert (other.command["PramlintideRate"] > 0) == (strategy in ("s2", "s4"))


@pytest.mark.parametrize("strategy", MODES)
def test_the_compiled_core_gives_the_same_doses_in_every_mode(strategy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two days of meals in the closed loop, the core doubled at every step: all of its words, not only the doses."""
    fast = compiled.control_step()
    steps = 0

    def both(state: list[int], parameters: list[int], inputs: list[int], outputs: list[int]) -> None:
        nonlocal steps
        arrays = [np.array(words, dtype=np.int64) for words in (state, parameters, inputs, outputs)]
        fast(*arrays)
        core.control_step(state, parameters, inputs, outputs)
        assert arrays[0].tolist() == state
        assert arrays[3].tolist() == outputs
        steps += 1

    monkeypatch.setattr(firmware_sim.firmware, "control_step", both)
    patient = load_patient(f"adult#{MODES[strategy]:03d}")
    meals = [(96, 60.0), (140, 20.0), (156, 80.0), (240, 90.0), (384, 40.0), (450, 110.0)]
    tuning = replace(tuning_for(strategy), stuck_samples=0)
    pair = Pair(strategy, meals, steps=576, tuning=tuning, sensor="coloured", patient=patient).play()
    assert steps == 576
    assert bool(pair.commits(1)) == (strategy in ("ma", "sma", "s3", "s4"))
    assert pair.firmware._state[layout.SATURATIONS] == 0


def test_bolus_ids_wrap_below_the_code_that_says_nothing() -> None:
    boluses = Boluses()
    boluses.next_id = IDS - 1
    boluses.start(Drug.INSULIN, 100, 0)
    assert boluses.next_id == 0
    assert IDS == 65535


def test_ids_and_open_boluses_survive_a_save() -> None:
    boluses = Boluses()
    boluses.start(Drug.INSULIN, 100, 7)
    again = Boluses()
    again.restore(iter(boluses.save()))
    assert again.next_id == 1
    assert again.uncertain  # nobody knows how far it came
    assert not again.ready(Drug.PRAMLINTIDE)
