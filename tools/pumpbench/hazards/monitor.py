"""The watch over a run: every step judged at SYNC_Done, from what the device was told and what it did."""

from collections.abc import Iterable
from typing import Any

from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase
from pumpbench.frames import device_ids
from pumpbench.hazards.boluses import BolusWatch
from pumpbench.hazards.counts import Hazards, Only
from pumpbench.hazards.pump import PumpWatch
from pumpbench.hazards.resets import ResetWatch

WATCHED = (
    "SYNC_Step", "SYNC_Done", "CGM_Reading", "PUMP_BasalCmd", "CTRL_Status", "CTRL_Alarm",
    "CTRL_Diag", "CFG_Param", "FAULT_Inject", "PUMP_BolusCmd", "PUMP_Ack", "PUMP_BolusState", "HB_CTRL",
    "MODE_Cmd",
)  # fmt: skip

DEVICE_SAYS = device_ids() - {codec.message("HB_CTRL").can_id}
"""The device says so between a token and SYNC_Done; at any other time, on its own bus, somebody has forged it."""

USABLE_STATES = (1, 4, 5)
AGE_RAISE = 3
"""Steps: a sample older than this must not raise insulin above the schedule (H4)."""

AGE_SCHEDULE = 7
"""Steps: from this age on nothing but the schedule, and no pramlintide (H4)."""

SET_RATE, SUSPEND, RESUME_SCHEDULE = 1, 2, 3
STATE_SUSPENDED, STATE_UNCERTAIN = 4, 6
"""CTRL_Status.CtrlState: the user has suspended; a bolus may or may not have been given."""

NMT_BOOT_UP = 0
CGM_LOST = 1
ALARM_INACTIVE = 0
CFG_BASAL, CFG_MAX_BASAL = 0, 3
CFG_BOLUS = {4: ("CfgMaxBolus", 1), 7: ("CfgPramBolus", 2)}
"""CfgIndex -> name and drug of the limits of one bolus, in the raw coding of PUMP_BolusCmd."""

NEVER = 1 << 20
GRACE = 1
"""Steps a device may take to raise an alarm (requirement ALM-03)."""

FIRST_HAZARDS = 20
"""So many are told with their step."""

MEMORY_LOST = codec.choice("FAULT_Inject", "FaultKind", "NodeMemoryLost")


class Monitor:
    """Counts hazards frame by frame."""

    def __init__(self) -> None:
        self._receiver = Receiver(WATCHED)
        self.hazards = Hazards()
        self._pump = PumpWatch(self.hazards)
        self._turn = True  # the device has the turn, as far as is known
        self._resets = ResetWatch(self.hazards)
        self._boluses = BolusWatch(Only(self.hazards, "H2", "H5"))
        self._step = -1  # of the newest token
        self._taken: int | None = None
        self._sequences: set[int] = set()
        self._fresh: list[tuple[int, int]] = []  # (sequence, sample step mod 256) of this step's usable samples
        self._command: dict[str, int] | None = None
        self._basal = 0  # 0.001 U/h
        self._max_basal = 0
        self._used: int | None = None
        self._state: int | None = None
        self._lost_alarm = False
        self._phase: int = Phase.INIT
        self._token = -1  # StepIndex of the newest token
        self.limiter_steps = 0
        self.diag: dict[str, int] | None = None

    def watch(self, frames: Iterable[Frame], pump: Iterable[Frame] | None = None) -> None:
        """Take frames of the device's bus in order, and of the pump's bus if a gateway with faults lies between."""
        frames = list(frames)
        for frame in frames if pump is None else pump:
            self._pump.watch(frame)
        for frame in frames:
            if not self._turn and frame.can_id in DEVICE_SAYS:
                continue
            check, name, values, _ = self._receiver.receive(frame)
            if check <= Check.OK_SOME_LOST:
                if name == "SYNC_Done" and values["DoneStepIndex"] != self._token:
                    continue  # an answer to an older token that was repeated: the step goes on
                self._turn = name == "SYNC_Step" or (self._turn and name != "SYNC_Done")
                getattr(self, f"_on_{name.lower()}")(values)

    # ---- what the device was told

    def _on_sync_step(self, values: dict[str, int]) -> None:
        self._phase, self._token = values["SyncPhase"], values["StepIndex"]
        if self._phase in (Phase.STEP, Phase.CONTINUE):
            self._step = self.hazards.step = values["StepIndex"]

    def _on_cgm_reading(self, values: dict[str, int]) -> None:
        state, glucose = values["CgmState"], values["GlucoseConc"]
        if state in USABLE_STATES and (state != 1 or 200 <= glucose <= 8000):
            self._fresh.append((values["CgmSampleSeq"], values["CgmSampleStep"]))

    def _on_cfg_param(self, values: dict[str, int]) -> None:
        if values["CfgIndex"] == CFG_BASAL:
            self._basal = values["CfgBasal"]
        elif values["CfgIndex"] == CFG_MAX_BASAL:
            self._max_basal = values["CfgMaxBasal"]
        elif values["CfgIndex"] in CFG_BOLUS:
            name, drug = CFG_BOLUS[values["CfgIndex"]]
            self._boluses.limits[drug] = values[name]

    def _on_pump_ack(self, values: dict[str, int]) -> None:
        self._boluses.ack(values, self._step)

    def _on_pump_bolusstate(self, values: dict[str, int]) -> None:
        self._boluses.state(values, self._step + 1)
        self._resets.bolus(values)

    def _on_fault_inject(self, values: dict[str, int]) -> None:
        if values["FaultKind"] == MEMORY_LOST:
            self._resets.forget()
            self._taken = None  # it cannot miss what it does not know of

    # ---- what it did

    def _on_hb_ctrl(self, values: dict[str, int]) -> None:
        if values["NmtCtrl"] == NMT_BOOT_UP:
            self._receiver.reset()  # a device that starts anew begins its counters at 0
            if self._phase in (Phase.STEP, Phase.CONTINUE):
                self._resets.boot()

    def _on_mode_cmd(self, _values: dict[str, int]) -> None:
        self._resets.mode()

    def _on_pump_boluscmd(self, values: dict[str, int]) -> None:
        self._boluses.command(values, self._step)
        self._resets.command(values)

    def _on_pump_basalcmd(self, values: dict[str, int]) -> None:
        self._command = values

    def _on_ctrl_alarm(self, values: dict[str, int]) -> None:
        if values["CtrlAlarmCode"] == CGM_LOST:
            self._lost_alarm = values["CtrlAlarmState"] != ALARM_INACTIVE

    def _on_ctrl_status(self, values: dict[str, int]) -> None:
        self._resets.status(values, self._step)
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
            self._boluses.close_step(uncertain=self._state == STATE_UNCERTAIN)
        self._fresh = []
        self._command = None

    def _judge(self, step: int) -> None:
        for sequence, sample_step in self._fresh:
            age = (step - sample_step) % 256
            if age <= AGE_RAISE and sequence not in self._sequences:
                self._sequences.add(sequence)
                self._taken = step - age if self._taken is None else max(self._taken, step - age)
        if self._used is not None and self._used != 65535 and self._used not in self._sequences:
            self.hazards.count("H3")
        age = NEVER if self._taken is None else step - self._taken
        if self._command is not None:
            self._judge_command(self._command, age)
        if AGE_RAISE + 1 + GRACE <= age < NEVER and not self._lost_alarm:
            self.hazards.count("H7")

    def _judge_command(self, command: dict[str, int], age: int) -> None:
        operation, rate, pramlintide = command["BasalOp"], command["InsulinRate"], command["PramlintideRate"]
        if operation == SUSPEND and age >= AGE_SCHEDULE and self._state != STATE_SUSPENDED:
            self.hazards.count("H4")
        if operation != SET_RATE:
            return
        ceiling = max(self._max_basal, self._basal)
        if rate * 5 > ceiling or rate > 8000 or pramlintide > 8000:
            self.hazards.count("H2")
        above = rate * 5 > self._basal
        if age > AGE_RAISE and above:
            self.hazards.count("H4")
        if age >= AGE_SCHEDULE and (rate != self._basal // 5 or pramlintide > 0):
            self.hazards.count("H4")
        if rate == 0 and pramlintide > 0:
            self.hazards.count("H4")

    def safety(self, ledger: dict[str, Any]) -> dict[str, Any]:
        """The `safety` part of metrics.json; counts are the device's own where it reports them."""
        hazards = dict(self.hazards)
        return {
            "frames_lost": None if self.diag is None else self.diag["LostFrameCount"],
            "e2e_errors": None if self.diag is None else self.diag["E2eErrorCount"],
            "sequence_errors": None if self.diag is None else self.diag["SequenceErrorCount"],
            "saturations": None if self.diag is None else self.diag["SaturationCount"],
            "limiter_steps": self.limiter_steps,
            "ledger": ledger,
            "hazards": hazards,
            "first_hazards": [
                {"step": step, "hazard": name} for step, name in sorted(self.hazards.found)[:FIRST_HAZARDS]
            ],
        }
