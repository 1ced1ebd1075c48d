"""Boluses as the firmware gives them: Program, echo, Commit; ids never used twice; uncertain until the pump tells.

A command is repeated, at most `SENDS` times, with the same id, dose and expiry, so that the pump knows it again. What
is not acknowledged may or may not be delivered: it counts in full as insulin on board, and no further bolus of either
drug is given until PUMP_BolusState has settled it (requirements CMD-01 to CMD-06).
"""

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from can_bus.lockstep import Turn

from .pump import ACCEPTED, DUPLICATE, accepted_limit

SENDS = 3
"""Times a command is sent at most (project's choice)."""

EXPIRES_AFTER = 1
"""Steps after which Program and Commit are void."""

LIMIT_AT_BOOT = 4000
"""Raw dose of either drug that the pump is taken to accept until it has said otherwise: the largest of the wire."""

IDS = 65535
"""BolusId runs from 0 to 65534; 65535 is SNA."""


class Drug(enum.IntEnum):
    """PUMP_BolusCmd.BolusHormone."""

    INSULIN = 1
    PRAMLINTIDE = 2


DOSE_FIELD = {Drug.INSULIN: "InsulinBolus", Drug.PRAMLINTIDE: "PramlintideBolus"}


STROKE = 5
"""Raw, of either drug: the pump gives whole strokes, so that less than one may be missing of a bolus."""


class Op(enum.IntEnum):
    """PUMP_BolusCmd.BolusOp; NONE = nothing more to say."""

    NONE = 0
    PROGRAM = 1
    COMMIT = 2
    CANCEL = 3


CANCEL_ACK = 6
ACKS = {
    2: (Drug.INSULIN, Op.PROGRAM),
    3: (Drug.INSULIN, Op.COMMIT),
    4: (Drug.PRAMLINTIDE, Op.PROGRAM),
    5: (Drug.PRAMLINTIDE, Op.COMMIT),
}
"""PUMP_Ack.AckFor of the stages; `CANCEL_ACK` names no drug, its id does."""


class Phase(enum.IntEnum):
    """PUMP_BolusState.BolusPhase."""

    IDLE = 0
    PROGRAMMED = 1
    DELIVERING = 2
    DONE = 3
    ABORTED = 4


@dataclass
class _Bolus:
    """The newest bolus of one drug, until the pump has told its end."""

    number: int
    dose: int  # raw
    until: int  # last step in which Program and Commit may be executed
    op: Op = Op.PROGRAM  # what the firmware says next
    sends: int = 0  # of `op`, in this step
    committed: bool = False  # a Commit was sent: it may be delivered
    uncertain: bool = False
    cancelled: bool = False  # the device itself wants it no more
    remaining: int = 0  # raw, committed and in no total yet
    ack: tuple[int, int] | None = None  # result and echo of the stage in question


class Boluses:
    """The bolus of each drug that is not settled, and the numbers of those to come."""

    def __init__(self) -> None:
        self.next_id = 0
        self.refused = 0  # boluses the pump refused or understood wrongly, so far
        self.short = dict.fromkeys(Drug, 0)  # raw, of boluses that ended before they were whole, so far
        self.committed = dict.fromkeys(Drug, 0)  # raw, of boluses whose first Commit was sent in this step
        self.unanswered = 0  # commands that no acknowledgement came for, so far
        self.limit = dict.fromkeys(Drug, LIMIT_AT_BOOT)  # what the pump accepts, as it last said
        self._open: dict[Drug, _Bolus] = {}
        self._states: dict[Drug, dict[str, int]] = {}
        self._heard: set[Drug] = set()

    # ---- what the rest of the firmware asks

    @property
    def known(self) -> bool:
        """Whether the pump has told of both drugs since boot (requirement RST-03)."""
        return len(self._heard) == len(Drug)

    @property
    def uncertain(self) -> bool:
        """Whether a bolus of either drug may or may not have been given."""
        return any(bolus.uncertain for bolus in self._open.values())

    @property
    def open(self) -> bool:
        """Whether a bolus of either drug is not settled."""
        return bool(self._open)

    def ready(self, drug: Drug) -> bool:
        """Whether a bolus of this drug may be started."""
        return self.known and not self.uncertain and drug not in self._open

    def remaining(self, drug: Drug) -> int:
        """Raw dose that was or may have been committed and that no total holds yet."""
        bolus = self._open.get(drug)
        return 0 if bolus is None or not bolus.committed else bolus.remaining

    # ---- frames in

    def hear_ack(self, values: dict[str, int]) -> None:
        """A PUMP_Ack: it confirms one stage of one id and nothing else."""
        purpose, number = values["AckFor"], values["AckId"]
        for drug, bolus in self._open.items():
            stage = ACKS.get(purpose) == (drug, bolus.op) or (purpose == CANCEL_ACK and bolus.op == Op.CANCEL)
            if stage and number == bolus.number:
                bolus.ack = (values["AckResult"], values["AckEchoRaw"])
                self.limit[drug] = accepted_limit(values, self.limit[drug])

    def hear_state(self, values: dict[str, int]) -> None:
        """A PUMP_BolusState of this step."""
        if values["BolusStateHormone"] in (Drug.INSULIN, Drug.PRAMLINTIDE) and values["BolusPhase"] <= Phase.ABORTED:
            drug = Drug(values["BolusStateHormone"])
            self._states[drug] = values
            self._heard.add(drug)

    # ---- the step

    def open_step(self, step: int) -> list[tuple[Drug, int]]:
        """Follow what the pump told of its boluses; to be called once per step before anything is decided.

        Returns:
            What newly turns out to be delivered of each drug, raw.
        """
        delivered: list[tuple[Drug, int]] = []
        self.committed = dict.fromkeys(Drug, 0)
        for drug in list(self._open):
            bolus, state = self._open[drug], self._states.get(drug)
            bolus.sends = 0
            if bolus.op != Op.NONE and not bolus.uncertain:
                bolus.uncertain = True  # the step before broke off in the middle
                bolus.op = Op.NONE
            if state is None:
                continue
            if state["BolusStateId"] == bolus.number:
                self._follow(drug, bolus, state, delivered)
            elif step > bolus.until:
                del self._open[drug]  # the pump knows nothing of it, and by now it never will
        self._states.clear()
        return delivered

    def _follow(self, drug: Drug, bolus: _Bolus, state: dict[str, int], delivered: list[tuple[Drug, int]]) -> None:
        phase = state["BolusPhase"]
        given = min(state["BolusDeliveredRaw"], bolus.dose)
        if phase in (Phase.DELIVERING, Phase.DONE, Phase.ABORTED):
            left = bolus.dose - given
            if left < bolus.remaining:
                delivered.append((drug, bolus.remaining - left))
            bolus.remaining = min(bolus.remaining, left)
            bolus.committed = True
            bolus.uncertain = False
            if phase != Phase.DELIVERING:
                self.short[drug] += left if left >= STROKE and not bolus.cancelled else 0
                del self._open[drug]
        elif phase == Phase.PROGRAMMED:
            bolus.op = Op.CANCEL  # programmed and not committed: nobody shall commit it any more
            bolus.uncertain = bolus.committed

    def start(self, drug: Drug, dose: int, step: int) -> None:
        """A new bolus, to be programmed in this step; `dose` is raw and positive."""
        self._open[drug] = _Bolus(self.next_id, dose, step + EXPIRES_AFTER, remaining=dose)
        self.next_id = (self.next_id + 1) % IDS

    def cancel(self) -> None:
        """End every bolus that has not ended yet, e.g. because the user suspends."""
        for bolus in self._open.values():
            bolus.op = Op.CANCEL
            bolus.cancelled = True
            bolus.sends = 0
            bolus.ack = None

    def speak(self, turn: Turn) -> bool:
        """Send what is to be said in this turn; whether there was anything, so that an answer is needed."""
        said = False
        for drug, bolus in self._open.items():
            if bolus.op == Op.NONE or self._must_wait(drug, bolus):
                continue
            bolus.sends += 1
            if bolus.op == Op.COMMIT and not bolus.committed:
                bolus.committed = True
                self.committed[drug] = bolus.dose
            said = True
            turn.send(
                "PUMP_BolusCmd",
                BolusHormone=drug,
                BolusOp=bolus.op,
                BolusId=bolus.number,
                BolusUntilStep=bolus.until % 256,
                **{DOSE_FIELD[drug]: bolus.dose},
            )
        return said

    def _must_wait(self, drug: Drug, bolus: _Bolus) -> bool:
        """Pramlintide of a meal is not committed before its insulin is agreed: a meal is refused as a whole."""
        insulin = self._open.get(Drug.INSULIN)
        return drug == Drug.PRAMLINTIDE and bolus.op == Op.COMMIT and insulin is not None and insulin.op == Op.PROGRAM

    def listen(self) -> None:
        """Go on by the acknowledgements that came since `speak`."""
        refused = self.refused
        had_insulin = Drug.INSULIN in self._open
        self._listen()
        pramlintide = self._open.get(Drug.PRAMLINTIDE)
        if had_insulin and self.refused > refused and pramlintide is not None and not pramlintide.committed:
            pramlintide.op = Op.CANCEL
            pramlintide.sends = 0

    def _listen(self) -> None:
        for drug in list(self._open):
            bolus = self._open[drug]
            ack, bolus.ack = bolus.ack, None
            if bolus.op == Op.NONE:
                continue
            if ack is None:
                self.unanswered += 1
                if bolus.sends >= SENDS:
                    bolus.uncertain = bolus.uncertain or bolus.op != Op.CANCEL or bolus.committed
                    bolus.op = Op.NONE
            elif bolus.op == Op.CANCEL:
                bolus.op = Op.NONE  # what was delivered until then, PUMP_BolusState tells
                if not bolus.committed:
                    del self._open[drug]
            else:
                self._advance(drug, bolus, *ack)

    def _advance(self, drug: Drug, bolus: _Bolus, result: int, echo: int) -> None:
        agreed = result in (ACCEPTED, DUPLICATE)
        bolus.sends = 0
        if agreed and echo == bolus.dose:
            bolus.op = Op.COMMIT if bolus.op == Op.PROGRAM else Op.NONE
        elif agreed:
            self.refused += 1
            bolus.op = Op.CANCEL
        else:
            self.refused += 1
            del self._open[drug]

    # ---- non-volatile memory

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""
        words = [self.next_id]
        for drug in Drug:
            bolus = self._open.get(drug)
            if bolus is None:
                words += [0, 0, 0, 0, 0, 0]
            else:
                words += [1, bolus.number, bolus.dose, bolus.until, int(bolus.committed), bolus.remaining]
        return words

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote; what was open is uncertain until the pump tells."""
        self.next_id = next(words)
        for drug in Drug:
            present, number, dose, until, committed, remaining = (next(words) for _ in range(6))
            if present:
                self._open[drug] = _Bolus(
                    number, dose, until, Op.NONE, committed=committed == 1, uncertain=True, remaining=remaining
                )
