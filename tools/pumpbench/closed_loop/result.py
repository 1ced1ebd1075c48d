"""A case, done: what happened in every step, and the outcome as a run folder's metrics.json has it."""

from typing import NamedTuple

import numpy as np

from can_bus import codec
from can_bus.lockstep import STEPS_PER_DAY
from plant_server import mechanism
from plant_server.metrics import glycaemic
from pumpbench.closed_loop import loop
from pumpbench.closed_loop.case import Case, prepare
from pumpbench.closed_loop.compiled import Words
from pumpbench.closed_loop.loop import Floats


class LoopError(RuntimeError):
    """A run left what the compiled loop can represent; the text says where."""


class Result(NamedTuple):
    """One run, one entry per step k: state and commands at instant k, strokes from k to k+1.

    Raw values are those of the DBC.
    """

    glucose: Floats  # plasma, mg/dL
    plasma_insulin: Floats  # pmol/L
    plasma_pramlintide: Floats  # pmol/L
    cgm: Words  # CGM_Reading.GlucoseConc, 0.1 mg/dL; 8191 = no number
    cgm_state: Words  # CGM_Reading.CgmState; 15 = nothing was sent
    rate: Words  # commanded InsulinRate, 0.005 U/h; -1 = the pump's own schedule
    pram_rate: Words  # commanded PramlintideRate, 0.1 ug/h; -1 likewise
    bolus: Words  # committed InsulinBolus, 0.01 U
    pram_bolus: Words  # committed PramlintideBolus, 0.1 ug
    strokes: Words  # of insulin that reached the patient, 0.05 U each
    pram_strokes: Words  # of pramlintide, 0.5 ug each
    limiters: Words  # CTRL_Status.LimiterBits
    state: Words  # CTRL_Status.CtrlState

    @property
    def days(self) -> float:
        """Length of the run."""
        return len(self.glucose) / STEPS_PER_DAY

    def metrics(self) -> dict[str, float]:
        """The outcome under the names of metrics.json, and the same numbers; `limiter_steps` as under `safety` there.

        Glucose is taken to the resolution at which PLANT_Truth tells it.
        """
        truth = codec.message("PLANT_Truth").fields["TruthGlucose"]
        raw = np.clip(np.rint(self.glucose / GLUCOSE_SCALE), 0, truth.high)
        insulin = int(self.strokes.sum()) * loop.MILLIUNITS_PER_STROKE
        pramlintide = int(self.pram_strokes.sum()) * loop.PRAM_TOTAL_PER_STROKE
        return {
            **glycaemic(raw * GLUCOSE_SCALE),
            "insulin_u_per_day": insulin * 0.001 / self.days,
            "pramlintide_ug_per_day": pramlintide * 0.01 / self.days,
            "limiter_steps": int(np.count_nonzero(self.limiters)),
        }


GLUCOSE_SCALE = 0.02
"""mg/dL, PLANT_Truth.TruthGlucose."""


def simulate(case: Case) -> Result:
    """Do a run: the doses, the samples and the glucose that plant and firmware have on a bus, bit for bit.

    The first call on a machine compiles, which takes a minute; the code is kept on disk.

    Raises:
        CaseError, PatientError, ScenarioError, SensorError, ControllerModelError, CalibrationError:
            what is wrong with the case.
        LoopError: the run left what the loop can represent.
    """
    plan = prepare(case)
    floats = np.empty((3, case.steps))
    words = np.empty((10, case.steps), np.int64)
    for motor in loop.run(plan, loop.Record(floats, words)):
        if not mechanism.ledger_closes(motor):
            raise LoopError(f"the pump's ledger does not close: {motor.tolist()}")
    return Result(*floats, *words)
