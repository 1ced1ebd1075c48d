"""An independent watch over a recorded run: what must never happen, counted (H1 to H8 of docs/design.md).

It sees the device's bus as the device did and judges every step at SYNC_Done by its own rules, knowing nothing of how
the firmware decides. A hazard this build of the bench cannot yet observe is reported as None, never as 0.
"""

from pumpbench.hazards.counts import NAMES
from pumpbench.hazards.monitor import Monitor

__all__ = ["NAMES", "Monitor"]
