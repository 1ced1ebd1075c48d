"""The reference firmware on the bench of `pumpbench.conformance.driver`, without a bus."""

from pumpbench.conformance.driver import (
    GLUCOSE,
    NMA,
    SENT_BY_CTRL,
    SIM_TIME_SNA,
    Turn,
    calibration,
)
from pumpbench.conformance.driver import Bench as Driver

from can_bus.lockstep import Node
from firmware_sim.firmware import Firmware

__all__ = [
    "GLUCOSE",
    "MODE_OFF",
    "NMA",
    "OPEN_LOOP",
    "S2",
    "SENT_BY_CTRL",
    "SIM_TIME_SNA",
    "Bench",
    "Turn",
    "calibration",
]

MODE_OFF, OPEN_LOOP, S2 = 0, 1, 6


class Bench(Driver):
    """As the driver, with the built-in firmware if none is given."""

    def __init__(
        self,
        *,
        patient: str = "adult#001",
        mode: int = NMA,
        flash: dict[int, int] | None = None,
        firmware: Node | None = None,
        start: bool = True,
    ) -> None:
        super().__init__(firmware or Firmware(), patient=patient, mode=mode, flash=flash, start=start)
