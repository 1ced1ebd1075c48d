"""What the pump did, on its own bus: H1, and H6 as its totals against the plant's truth."""

from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.frame import Frame
from can_bus.lockstep import Phase
from plant_server import mechanism
from pumpbench.hazards.boluses import BolusWatch
from pumpbench.hazards.counts import Hazards, Only

PUMP_SAYS = ("PUMP_Ack", "PUMP_BolusState", "PUMP_Delivered", "PLANT_Truth")
"""The pump says so ahead of a token; what has one of these ids after it, on the pump's bus, somebody has forged."""

BOOT_COUNT_SNA = 15
INSULIN_LEDGER, PRAM_LEDGER = 4, 5
"""PLANT_Truth.TruthSel."""


class PumpWatch:
    """Boluses that the pump has taken, and the ledger of strokes."""

    def __init__(self, hazards: Hazards) -> None:
        self._hazards = hazards
        self._boluses = BolusWatch(Only(hazards, "H1"))
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
            self._hazards.count("H6")
