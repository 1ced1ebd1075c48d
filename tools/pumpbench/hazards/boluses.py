"""Boluses of both drugs, as a bus shows them: H1, H5, and the part of H2 that is about them."""

from dataclasses import dataclass

from pumpbench.hazards.counts import Counter

BOLUS_DOSE = {1: "InsulinBolus", 2: "PramlintideBolus"}
"""PUMP_BolusCmd.BolusHormone."""

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


class BolusWatch:
    """Every bolus from its command to its end."""

    def __init__(self, hazards: Counter) -> None:
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
            self._hazards.count("H2")

    def _judge_new(self) -> None:
        """A bolus begins: is everything before it known?"""
        open_ = any(bolus.committed and not bolus.settled for bolus in self._sent.values())
        self._hazards.count("H5", open_ or (self._uncertain and not self._resolved))

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
            self._hazards.count("H1")  # a second time: that is a second dose
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
            self._hazards.count("H1")
        sent = self._sent.get(drug)
        bolus = self._known.setdefault((drug, number), _Bolus())
        last = self._shown.get(drug)
        if last is not None and last != number:
            self._known[drug, last].passed_by = True
        self._shown[drug] = number
        again = bolus.passed_by or delivered < bolus.delivered or (phase < bolus.phase and bolus.phase >= DONE)
        self._hazards.count("H1", again and number != BOLUS_ID_SNA)
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
            self._hazards.count("H1")

    def close_step(self, *, uncertain: bool) -> None:
        """The device is done with an instant, and says whether it knows what was given."""
        self._uncertain = uncertain
        self._resolved = False
