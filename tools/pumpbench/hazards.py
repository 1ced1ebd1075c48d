"""An independent watch over a recorded run: what must never happen, counted (H1 to H8 of docs/design.md).

It sees the device's bus as the device did and judges every step at SYNC_Done by its own rules, knowing nothing of how
the firmware decides. A hazard this build of the bench cannot yet observe is reported as None, never as 0.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase
from plant_server import mechanism

WATCHED = (
    "SYNC_Step", "SYNC_Done", "CGM_Reading", "PUMP_BasalCmd", "CTRL_Status", "CTRL_Alarm",
    "CTRL_Diag", "CFG_Param", "FAULT_Inject", "PUMP_BolusCmd", "PUMP_Ack", "PUMP_BolusState", "HB_CTRL",
    "MODE_Cmd",
)  # fmt: skip

PUMP_SAYS = ("PUMP_Ack", "PUMP_BolusState", "PUMP_Delivered", "PLANT_Truth")
"""The pump says so ahead of a token; what has one of these ids after it, on the pump's bus, somebody has forged."""

DEVICE_SAYS = frozenset(
    message.can_id for message in codec.messages().values() if message.sender == "CTRL" and message.name != "HB_CTRL"
)
"""The device says so between a token and SYNC_Done; at any other time, on its own bus, somebody has forged it."""

MEAL_IDS, MEAL_SNA = 255, 255
IOB_KEPT, IOB_SLACK = 0.75, 50.0
"""Share of the insulin on board that is left after a step, and 0.01 U besides: no insulin in use fades faster (H8)."""

USABLE_STATES = (1, 4, 5)
AGE_RAISE = 3
"""Steps: a sample older than this must not raise insulin above the schedule (H4)."""

AGE_SCHEDULE = 7
"""Steps: from this age on nothing but the schedule, and no pramlintide (H4)."""

SET_RATE, SUSPEND, RESUME_SCHEDULE = 1, 2, 3
STATE_SUSPENDED, STATE_UNCERTAIN = 4, 6
"""CTRL_Status.CtrlState: the user has suspended; a bolus may or may not have been given."""

NMT_BOOT_UP = 0
BOOT_COUNT_SNA = 15

CGM_LOST = 1
CFG_BASAL, CFG_MAX_BASAL = 0, 3
CFG_BOLUS = {4: ("CfgMaxBolus", 1), 7: ("CfgPramBolus", 2)}
"""CfgIndex -> name and drug of the limits of one bolus, in the raw coding of PUMP_BolusCmd."""

BOLUS_DOSE = {1: "InsulinBolus", 2: "PramlintideBolus"}
"""PUMP_BolusCmd.BolusHormone."""

INSULIN = 1
PROGRAM, COMMIT = 1, 2
"""PUMP_BolusCmd.BolusOp."""

COMMIT_ACKS = {3: 1, 5: 2}
"""PUMP_Ack.AckFor of a Commit -> drug."""

ACCEPTED = 0
DELIVERING, DONE, ABORTED = 2, 3, 4
"""PUMP_BolusState.BolusPhase."""

BOLUS_RESERVED = 4000
"""Raw doses above this are reserved codes."""

BOLUS_ID_SNA = 65535
ALARM_INACTIVE = 0
INSULIN_LEDGER, PRAM_LEDGER = 4, 5
NEVER = 1 << 20
GRACE = 1
"""Steps a device may take to raise an alarm (requirement ALM-03)."""


FIRST_HAZARDS = 20
"""So many are told with their step."""

MEMORY_LOST = codec.choice("FAULT_Inject", "FaultKind", "NodeMemoryLost")


NAMES = {
    "H1": "a bolus delivered twice, or after its expiry",
    "H2": "any dose above the limits of either side",
    "H3": "dosing on a CGM sample that is stale, repeated, failed its E2E check or is implausible",
    "H4": "insulin above the schedule when the last usable CGM sample is older than 15 min (age 4..6 steps), anything "
    "but the schedule from age 7 on, pramlintide while insulin is suspended",
    "H5": "a new bolus while an earlier one is uncertain",
    "H6": "an unaccounted stroke: commanded = delivered + pending + lost, per drug, at every step",
    "H7": "a silent failure: a node dead, a frame lost or a limit hit that no alarm and no counter shows",
    "H8": "state lost over a reset: another mode, a meal forgotten, or insulin on board that fell faster than insulin "
    "can",
}
"""What each hazard is, in the words of docs/design.md."""


class Hazards(dict[str, int]):
    """Counts by name.

    Attributes:
        step: sampling instant now.
        found: the instant and the name of every one, in order.
    """

    def __init__(self) -> None:
        super().__init__({f"H{number}": 0 for number in range(1, 9)})
        self.step = -1
        self.found: list[tuple[int, str]] = []

    def __setitem__(self, name: str, count: int) -> None:
        """Set a count; what it grows by is found now."""
        self.found += [(self.step, name)] * (count - self[name])
        super().__setitem__(name, count)


class _Only:
    """A part of the counts: what else is counted through it is nobody's."""

    def __init__(self, hazards: Hazards, *names: str) -> None:
        self._hazards = hazards
        self._names = names

    def __getitem__(self, name: str) -> int:
        return self._hazards[name]

    def __setitem__(self, name: str, count: int) -> None:
        if name in self._names:
            self._hazards[name] = count


@dataclass
class _Bolus:
    """One BolusId of one drug, as the bus has shown it so far."""

    until: int | None = None  # last step in which the pump may execute it; None: no command was seen
    committed: bool = False  # a Commit was sent
    accepted: bool = False  # and the pump has said that it took it
    settled: bool = False  # whether it is given is known
    phase: int = 0
    delivered: int = 0
    passed_by: bool = False  # the pump has shown another id after it
    too_late: bool = False  # after its expiry the pump still had not begun it
    counted_late: bool = False
    counted_limit: bool = False


class _BolusWatch:
    """Boluses of both drugs: H1, H5, and the part of H2 that is about them."""

    def __init__(self, hazards: _Only) -> None:
        self._hazards = hazards
        self.limits = {1: 0, 2: 0}
        self._known: dict[tuple[int, int], _Bolus] = {}  # (drug, BolusId)
        self._sent: dict[int, _Bolus] = {}  # the newest one of each drug that was commanded
        self._shown: dict[int, int] = {}  # the id the pump showed last
        self._uncertain = False  # the device said so at the end of the step before
        self._resolved = False  # the pump has told in this step what became of a bolus

    def command(self, values: dict[str, int], step: int) -> None:
        """A PUMP_BolusCmd of instant `step`."""
        drug, operation, number = values["BolusHormone"], values["BolusOp"], values["BolusId"]
        if drug not in BOLUS_DOSE or operation not in (PROGRAM, COMMIT):
            return
        bolus = self._known.setdefault((drug, number), _Bolus())
        if bolus.until is None:
            bolus.until = step + (values["BolusUntilStep"] - step + 128) % 256 - 128
            if operation == PROGRAM:
                self._judge_new()
            self._sent[drug] = bolus
        bolus.committed |= operation == COMMIT
        dose = values[BOLUS_DOSE[drug]]
        if (dose > self.limits[drug] or dose > BOLUS_RESERVED) and not bolus.counted_limit:
            bolus.counted_limit = True  # a retry is the same bolus
            self._hazards["H2"] += 1

    def _judge_new(self) -> None:
        """A bolus begins: is everything before it known?"""
        open_ = any(bolus.committed and not bolus.settled for bolus in self._sent.values())
        self._hazards["H5"] += open_ or (self._uncertain and not self._resolved)

    def ack(self, values: dict[str, int], step: int) -> None:
        """A PUMP_Ack of what was sent in instant `step`."""
        drug = COMMIT_ACKS.get(values["AckFor"])
        if drug is None:
            return
        bolus = self._known.setdefault((drug, values["AckId"]), _Bolus())
        bolus.settled = True
        if values["AckResult"] != ACCEPTED:
            return
        if bolus.accepted:
            self._hazards["H1"] += 1  # a second time: that is a second dose
        bolus.accepted = True
        begun_in_time = bolus.phase >= DELIVERING and not bolus.too_late  # then it is the answer that is late
        if bolus.until is not None and step > bolus.until and not begun_in_time:
            self._count_late(bolus)

    def state(self, values: dict[str, int], step: int) -> None:
        """A PUMP_BolusState at the opening of instant `step`."""
        drug, number, phase = values["BolusStateHormone"], values["BolusStateId"], values["BolusPhase"]
        if drug not in BOLUS_DOSE or phase > ABORTED:
            return
        delivered = values["BolusDeliveredRaw"]
        if delivered > values["BolusProgrammedRaw"]:
            self._hazards["H1"] += 1
        sent = self._sent.get(drug)
        bolus = self._known.setdefault((drug, number), _Bolus())
        last = self._shown.get(drug)
        if last is not None and last != number:
            self._known[drug, last].passed_by = True
        self._shown[drug] = number
        again = bolus.passed_by or delivered < bolus.delivered or (phase < bolus.phase and bolus.phase >= DONE)
        self._hazards["H1"] += again and number != BOLUS_ID_SNA
        if bolus.too_late and (phase in (DELIVERING, DONE) or delivered):
            self._count_late(bolus)
        begun = sent is bolus and phase >= DELIVERING
        over = sent is not None and sent.until is not None and step > sent.until  # it must not begin any more
        if sent is not None and over and not begun and sent.phase < DELIVERING:
            sent.too_late = True
        bolus.phase, bolus.delivered, bolus.passed_by = phase, delivered, False
        if sent is not None and not sent.settled and (begun or (over and sent is not bolus)):
            sent.settled = True
        self._resolved |= sent is None or sent.settled  # a device that had lost the pump knows again where it stands

    def _count_late(self, bolus: _Bolus) -> None:
        if not bolus.counted_late:
            bolus.counted_late = True
            self._hazards["H1"] += 1

    def close_step(self, *, uncertain: bool) -> None:
        """The device is done with an instant, and says whether it knows what was given."""
        self._uncertain = uncertain
        self._resolved = False


class _ResetWatch:
    """H8: what the device said of itself before a reset against what it says after it."""

    def __init__(self, hazards: Hazards) -> None:
        self._hazards = hazards
        self._before: dict[str, int] | None = None  # the newest status
        self._step = -1  # of that status
        self._booted = False
        self._mode_asked = False  # since that status: then another mode is no loss
        self._number: int | None = None  # of the newest insulin bolus
        self._open = 0  # its dose (0.01 U) until the device has heard what became of it, which may be counted twice
        self._open_before = 0  # when that status was said
        self._told: int | None = None  # what the device has heard was delivered of it, since it last started
        self._given = 0  # the same, once it has taken it in
        self._given_step = 0

    def boot(self) -> None:
        """The device has started anew in the middle of a run."""
        self._booted = True
        self._told = None  # heard and forgotten

    def forget(self) -> None:
        """The device has come back with a blank memory: there is nothing it could know."""
        self._booted = False

    def mode(self) -> None:
        """A mode was asked for."""
        self._mode_asked = True

    def command(self, values: dict[str, int]) -> None:
        """A PUMP_BolusCmd."""
        if values["BolusHormone"] == INSULIN and values["BolusOp"] == COMMIT:
            self._number, self._open = values["BolusId"], values["InsulinBolus"]
            self._given, self._told = 0, None

    def bolus(self, values: dict[str, int]) -> None:
        """A PUMP_BolusState."""
        if values["BolusStateHormone"] == INSULIN and values["BolusStateId"] == self._number and self._open:
            self._told = values["BolusDeliveredRaw"] if values["BolusPhase"] in (DONE, ABORTED) else self._told

    def status(self, values: dict[str, int], step: int) -> None:
        """A CTRL_Status of instant `step`."""
        if self._told is not None:
            self._open, self._given, self._given_step, self._told = 0, self._told, step, None
        if self._booted and self._before is not None:
            self._hazards["H8"] += self._lost(self._before, values, step)
        self._before, self._step, self._open_before = values, step, self._open
        self._booted = self._mode_asked = False

    def _lost(self, before: dict[str, int], after: dict[str, int], step: int) -> bool:
        mode = before["CtrlMode"] != after["CtrlMode"] and not self._mode_asked
        meal = before["LastMealId"] != MEAL_SNA and (
            after["LastMealId"] == MEAL_SNA or (after["LastMealId"] - before["LastMealId"]) % MEAL_IDS > MEAL_IDS // 2
        )
        left = (before["InsulinOnBoard"] - self._open_before) * IOB_KEPT ** (step - self._step)
        of_bolus = self._given * IOB_KEPT ** (step - self._given_step)
        iob = max(left, of_bolus) - IOB_SLACK > after["InsulinOnBoard"]
        return mode or meal or iob


class _PumpWatch:
    """What the pump did, on its own bus: H1, and H6 as its totals against the plant's truth."""

    def __init__(self, hazards: Hazards) -> None:
        self._hazards = hazards
        self._boluses = _BolusWatch(_Only(hazards, "H1"))
        self._receiver = Receiver(("SYNC_Step", "SYNC_Done", "PUMP_BolusCmd", *PUMP_SAYS))
        self._ids = frozenset(codec.message(name).can_id for name in PUMP_SAYS)
        self._turn = False  # the device has the turn
        self._boot_count: int | None = None
        self._base: dict[str, int] = {"Insulin": 0, "Pram": 0}  # strokes delivered before the totals began
        self._totals: dict[str, int] | None = None

    def watch(self, frame: Frame) -> None:
        """Take a frame of the pump's bus."""
        if self._turn and frame.can_id in self._ids:
            return
        check, name, values, _ = self._receiver.receive(frame)
        if check > Check.OK_SOME_LOST:
            return
        if name in ("SYNC_Step", "SYNC_Done"):
            self._turn = name == "SYNC_Step"
        if name == "SYNC_Step":
            if values["SyncPhase"] != Phase.CONTINUE:
                self._totals = None  # the batch of the next instant follows
            self._hazards.step = values["StepIndex"]
        elif name == "PUMP_BolusCmd":
            self._boluses.command(values, self._hazards.step)
        elif name == "PUMP_Ack":
            self._boluses.ack(values, self._hazards.step)
        elif name == "PUMP_BolusState":
            self._boluses.state(values, self._hazards.step + 1)
        elif name == "PUMP_Delivered":
            self._totals = values
            self._note_boot(values["PumpBootCount"])
        elif name == "PLANT_Truth" and self._totals is not None:
            self._compare(values, self._totals)

    def _note_boot(self, boot_count: int) -> None:
        if boot_count >= BOOT_COUNT_SNA:
            return
        if self._boot_count not in (None, boot_count):
            self._base = {}  # the totals have begun anew, the ledger has not
        self._boot_count = boot_count

    def _compare(self, truth: dict[str, int], totals: dict[str, int]) -> None:
        if truth["TruthSel"] == INSULIN_LEDGER:
            self._check(truth, "Insulin", totals["InsulinTotal"], round(mechanism.INSULIN_STROKE_U * 1000))
        elif truth["TruthSel"] == PRAM_LEDGER:
            self._check(truth, "Pram", totals["PramTotal"], round(mechanism.PRAMLINTIDE_STROKE_UG * 100))

    def _check(self, truth: dict[str, int], drug: str, total: int, stroke: int) -> None:
        open_strokes = truth[f"Truth{drug}Pending"] + truth[f"Truth{drug}Lost"]
        before = (truth[f"Truth{drug}Commanded"] - open_strokes - total // stroke) % 16384
        if total % stroke or before != self._base.setdefault(drug, before):
            self._hazards["H6"] += 1


class Monitor:
    """Counts hazards frame by frame."""

    def __init__(self) -> None:
        self._receiver = Receiver(WATCHED)
        self._start()

    def _start(self) -> None:
        self.hazards = Hazards()
        self._pump = _PumpWatch(self.hazards)
        self._turn = True  # the device has the turn, as far as is known
        self._resets = _ResetWatch(self.hazards)
        self._boluses = _BolusWatch(_Only(self.hazards, "H2", "H5"))
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
