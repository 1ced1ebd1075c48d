"""An independent watch over a recorded run: what must never happen, counted (H1 to H8 of docs/design.md).

It sees the device's bus as the device did and judges every step at SYNC_Done by its own rules, knowing nothing of how
the firmware decides. A hazard this build of the bench cannot yet observe is reported as None, never as 0.
"""

from collections.abc import Iterable
from typing import Any

from can_bus.codec import Check, Receiver
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase
from plant_server import mechanism

WATCHED = (
    "SYNC_Step", "SYNC_Done", "CGM_Reading", "PUMP_BasalCmd", "PUMP_Delivered", "CTRL_Status", "CTRL_Alarm",
    "CTRL_Diag", "CFG_Param", "PLANT_Truth", "FAULT_Inject",
)  # fmt: skip

USABLE_STATES = (1, 4, 5)
AGE_RAISE = 3
"""Steps: a sample older than this must not raise insulin above the schedule (H4)."""

AGE_SCHEDULE = 7
"""Steps: from this age on nothing but the schedule, and no pramlintide (H4)."""

SET_RATE, SUSPEND, RESUME_SCHEDULE = 1, 2, 3
STATE_SUSPENDED = 4
"""CTRL_Status.CtrlState: the user has suspended."""

CGM_LOST = 1
CFG_BASAL, CFG_MAX_BASAL = 0, 3
ALARM_INACTIVE = 0
INSULIN_LEDGER, PRAM_LEDGER = 4, 5
NEVER = 1 << 20
GRACE = 1
"""Steps a device may take to raise an alarm (requirement ALM-03)."""


class Monitor:
    """Counts hazards frame by frame."""

    def __init__(self) -> None:
        self._receiver = Receiver(WATCHED)
        self._start()

    def _start(self) -> None:
        self.hazards = dict.fromkeys(("H2", "H3", "H4", "H6", "H7"), 0)
        self._taken: int | None = None
        self._sequences: set[int] = set()
        self._fresh: list[tuple[int, int]] = []  # (sequence, sample step mod 256) of this step's usable samples
        self._command: dict[str, int] | None = None
        self._basal = 0  # 0.001 U/h
        self._max_basal = 0
        self._used: int | None = None
        self._state: int | None = None
        self._lost_alarm = False
        self._totals: dict[str, int] | None = None
        self._phase: int = Phase.INIT
        self.limiter_steps = 0
        self.diag: dict[str, int] | None = None
        self.injected = 0

    def watch(self, frames: Iterable[Frame]) -> None:
        """Take frames of the device's bus in order."""
        for frame in frames:
            check, name, values, _ = self._receiver.receive(frame)
            if check <= Check.OK_SOME_LOST:
                getattr(self, f"_on_{name.lower()}")(values)

    # ---- what the device was told

    def _on_sync_step(self, values: dict[str, int]) -> None:
        self._phase = values["SyncPhase"]

    def _on_cgm_reading(self, values: dict[str, int]) -> None:
        state, glucose = values["CgmState"], values["GlucoseConc"]
        if state in USABLE_STATES and (state != 1 or 200 <= glucose <= 8000):
            self._fresh.append((values["CgmSampleSeq"], values["CgmSampleStep"]))

    def _on_cfg_param(self, values: dict[str, int]) -> None:
        if values["CfgIndex"] == CFG_BASAL:
            self._basal = values["CfgBasal"]
        elif values["CfgIndex"] == CFG_MAX_BASAL:
            self._max_basal = values["CfgMaxBasal"]

    def _on_pump_delivered(self, values: dict[str, int]) -> None:
        self._totals = values

    def _on_plant_truth(self, values: dict[str, int]) -> None:
        if self._totals is None:
            return
        if values["TruthSel"] == INSULIN_LEDGER:
            stroke = round(mechanism.INSULIN_STROKE_U * 1000)
            self._check_ledger(values, "Insulin", self._totals["InsulinTotal"], stroke)
        elif values["TruthSel"] == PRAM_LEDGER:
            stroke = round(mechanism.PRAMLINTIDE_STROKE_UG * 100)
            self._check_ledger(values, "Pram", self._totals["PramTotal"], stroke)

    def _check_ledger(self, values: dict[str, int], drug: str, total: int, stroke: int) -> None:
        open_strokes = values[f"Truth{drug}Pending"] + values[f"Truth{drug}Lost"]
        if total % stroke or (values[f"Truth{drug}Commanded"] - open_strokes - total // stroke) % 16384:
            self.hazards["H6"] += 1

    def _on_fault_inject(self, _values: dict[str, int]) -> None:
        self.injected += 1

    # ---- what it did

    def _on_pump_basalcmd(self, values: dict[str, int]) -> None:
        self._command = values

    def _on_ctrl_alarm(self, values: dict[str, int]) -> None:
        if values["CtrlAlarmCode"] == CGM_LOST:
            self._lost_alarm = values["CtrlAlarmState"] != ALARM_INACTIVE

    def _on_ctrl_status(self, values: dict[str, int]) -> None:
        self._used = values["LastCgmSeq"]
        self._state = values["CtrlState"]
        self.limiter_steps += values["LimiterBits"] != 0

    def _on_ctrl_diag(self, values: dict[str, int]) -> None:
        self.diag = values

    def _on_sync_done(self, values: dict[str, int]) -> None:
        if values["DoneStatus"] == Done.CONTINUE:
            return  # the step goes on
        if self._phase in (Phase.STEP, Phase.CONTINUE):
            self._judge(values["DoneStepIndex"])
        self._fresh = []
        self._command = None
        self._totals = None

    def _judge(self, step: int) -> None:
        for sequence, sample_step in self._fresh:
            age = (step - sample_step) % 256
            if age <= AGE_RAISE and sequence not in self._sequences:
                self._sequences.add(sequence)
                self._taken = step - age if self._taken is None else max(self._taken, step - age)
        if self._used is not None and self._used != 65535 and self._used not in self._sequences:
            self.hazards["H3"] += 1
        age = NEVER if self._taken is None else step - self._taken
        if self._command is not None:
            self._judge_command(self._command, age)
        if AGE_RAISE + 1 + GRACE <= age < NEVER and not self._lost_alarm:
            self.hazards["H7"] += 1

    def _judge_command(self, command: dict[str, int], age: int) -> None:
        operation, rate, pramlintide = command["BasalOp"], command["InsulinRate"], command["PramlintideRate"]
        if operation == SUSPEND and age >= AGE_SCHEDULE and self._state != STATE_SUSPENDED:
            self.hazards["H4"] += 1
        if operation != SET_RATE:
            return
        ceiling = max(self._max_basal, self._basal)
        if rate * 5 > ceiling or rate > 8000 or pramlintide > 8000:
            self.hazards["H2"] += 1
        above = rate * 5 > self._basal
        if age > AGE_RAISE and above:
            self.hazards["H4"] += 1
        if age >= AGE_SCHEDULE and (rate != self._basal // 5 or pramlintide > 0):
            self.hazards["H4"] += 1
        if rate == 0 and pramlintide > 0:
            self.hazards["H4"] += 1

    def safety(self, ledger: dict[str, Any]) -> dict[str, Any]:
        """The `safety` part of metrics.json; counts are the device's own where it reports them."""
        hazards = {f"H{number}": self.hazards.get(f"H{number}") for number in range(1, 9)}
        return {
            "frames_lost": None if self.diag is None else self.diag["LostFrameCount"],
            "e2e_errors": None if self.diag is None else self.diag["E2eErrorCount"],
            "sequence_errors": None if self.diag is None else self.diag["SequenceErrorCount"],
            "saturations": None if self.diag is None else self.diag["SaturationCount"],
            "limiter_steps": self.limiter_steps,
            "faults_injected": self.injected,
            "ledger": ledger,
            "hazards": hazards,
        }
