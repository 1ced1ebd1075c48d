"""The pump's side of the boluses of one drug: Program, Commit, Cancel; one id is delivered at most once.

The pump remembers the newest bolus it has accepted and what became of it. A repeated command is answered as the first
time, an older one is refused, so that no mix of lost, doubled, late and replayed frames can make one bolus two.
"""

import enum
from dataclasses import dataclass, field

from . import mechanism
from .chamber import Chamber

IDS = 65535
"""BolusId runs from 0 to 65534; 65535 is SNA."""

DOSE_RESERVED = 4000
"""Raw doses above this are reserved codes."""

STROKE_RAW = 5
"""Raw dose of one stroke of either drug: 0.05 U in 0.01 U, 0.5 ug in 0.1 ug."""

EXPIRY_AHEAD_MAX = 2
"""Steps: a bolus that claims to hold longer is malformed (requirement CMD-04)."""


class Op(enum.IntEnum):
    """PUMP_BolusCmd.BolusOp."""

    PROGRAM = 1
    COMMIT = 2
    CANCEL = 3


class Phase(enum.IntEnum):
    """PUMP_BolusState.BolusPhase."""

    IDLE = 0
    PROGRAMMED = 1
    DELIVERING = 2
    DONE = 3
    ABORTED = 4


class AckResult(enum.IntEnum):
    """PUMP_Ack.AckResult."""

    ACCEPTED = 0
    DUPLICATE = 1
    EXPIRED = 2
    OVER_LIMIT = 3
    WRONG_STATE = 4
    BUSY = 5
    MALFORMED = 7
    COMPLETED = 8


def _is_older(number: int, than: int) -> bool:
    """Whether an id lies behind another one: by half of the circle or more ahead is behind."""
    return (number - than) % IDS > IDS // 2


@dataclass
class DrugBolus:
    """The newest bolus of one drug.

    Attributes:
        chamber: whose motor delivers it.
        max_raw: the pump's own limit, in the raw coding of the command.
        number: id of the newest bolus accepted.
        dose: raw, as programmed; a rest below a stroke is not delivered.
        phase: how far it is.
        strokes: committed.
    """

    chamber: Chamber
    max_raw: int
    number: int | None = None
    dose: int = 0
    phase: Phase = Phase.IDLE
    strokes: int = 0
    _newest: int | None = None  # id of the newest valid Program, accepted or not
    _accepted: set[Op] = field(default_factory=set)  # operations on `number`

    @property
    def limit_raw(self) -> int:
        """Largest raw dose the pump accepts now: its limit, and what the reservoir holds."""
        return min(self.max_raw, self.chamber.available * STROKE_RAW)

    @property
    def delivered_raw(self) -> int:
        """What of the newest bolus has reached the patient."""
        return 0 if self.strokes == 0 else int(self.chamber.words[mechanism.BOLUS_DELIVERED]) * STROKE_RAW

    def judge(
        self, operation: int, number: int, dose: int, until: int, step: int, *, ready: bool
    ) -> tuple[AckResult, int]:
        """Take one command, as a whole or not at all.

        Args:
            operation: BolusOp.
            number: BolusId.
            dose: raw.
            until: BolusUntilStep.
            step: k.
            ready: whether the pump delivers this drug at all.

        Returns:
            AckResult and AckEchoRaw: the dose as understood, that of the first time for a repeated command.
        """
        if operation == Op.CANCEL:
            return self._cancel(number), self.dose if number == self.number else dose
        result = self._judge(operation, number, dose, (until - step) % 256, ready=ready)
        if result == AckResult.ACCEPTED:
            self._accept(Op(operation), number, dose)
        return result, dose

    def _judge(self, operation: int, number: int, dose: int, ahead: int, *, ready: bool) -> AckResult:
        if operation not in (Op.PROGRAM, Op.COMMIT) or number >= IDS or not 0 < dose <= DOSE_RESERVED:
            return AckResult.MALFORMED
        if number == self.number:
            if dose != self.dose:
                return AckResult.MALFORMED
            if Op(operation) in self._accepted:
                return AckResult.DUPLICATE
        elif self._newest is not None and _is_older(number, self._newest):
            return AckResult.EXPIRED
        if ahead > EXPIRY_AHEAD_MAX:
            return AckResult.EXPIRED if ahead >= 128 else AckResult.MALFORMED
        if operation == Op.PROGRAM:
            self._newest = number
        if self.phase == Phase.DELIVERING:
            return AckResult.BUSY
        if not ready or (operation == Op.COMMIT and (number != self.number or self.phase != Phase.PROGRAMMED)):
            return AckResult.WRONG_STATE
        return AckResult.OVER_LIMIT if dose > self.limit_raw else AckResult.ACCEPTED

    def _accept(self, operation: Op, number: int, dose: int) -> None:
        if operation == Op.PROGRAM:
            self.number, self.dose = number, dose
            self.phase = Phase.PROGRAMMED
            self.strokes = 0
            self._accepted = {operation}
            return
        self._accepted.add(operation)
        self.strokes = dose // STROKE_RAW
        mechanism.begin_bolus(self.chamber.words, self.strokes)
        self.phase = Phase.DELIVERING if self.strokes else Phase.DONE

    def _cancel(self, number: int) -> AckResult:
        if number >= IDS:
            return AckResult.MALFORMED
        if number != self.number:
            return AckResult.WRONG_STATE
        if Op.CANCEL in self._accepted:
            return AckResult.DUPLICATE
        if self.phase == Phase.DONE:
            return AckResult.COMPLETED
        self._accepted.add(Op.CANCEL)
        self.abort()
        return AckResult.ACCEPTED

    def abort(self) -> None:
        """End it: what the motor has not made yet is lost, and never caught up."""
        mechanism.end_bolus(self.chamber.words)
        if self.phase in (Phase.PROGRAMMED, Phase.DELIVERING):
            self.phase = Phase.ABORTED

    def follow(self) -> None:
        """Look how far it is after the motor has run for an interval."""
        if self.phase != Phase.DELIVERING:
            return
        words = self.chamber.words
        under_way = words[mechanism.BOLUS] + words[mechanism.BOLUS_HELD]
        if words[mechanism.BOLUS_DELIVERED] == self.strokes:
            self.phase = Phase.DONE
        elif self.chamber.stopped or self.chamber.empty or under_way == 0:
            self.abort()  # an occlusion, an empty reservoir or air took the rest

    def state(self) -> tuple[int, int, int, int]:
        """Raw phase, id, delivered and programmed dose as PUMP_BolusState has them."""
        return self.phase, IDS if self.number is None else self.number, self.delivered_raw, self.dose
