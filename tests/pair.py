"""Plant and firmware against each other in this process, over a wire that loses frames and with power that fails.

pair = Pair("s3", meals=[(20, 60.0)], steps=40)
pair.to_device = lambda name, values, frame: [] if name == "PUMP_Ack" else None     # lose every acknowledgement
pair.play()
assert pair.ledgers_close()
"""

from typing import Any

from pumpbench.conformance.loop import Loop, Values, Wire, pass_all

from can_bus.frame import Frame
from firmware_sim.firmware import NVM_BYTES, Cause, Firmware
from firmware_sim.nvm import PowerLost, RamMemory

__all__ = ["TOKENS", "Pair", "Values", "Wire", "pass_all"]

TOKENS = ("SYNC_Step", "SYNC_Done")


class Pair(Loop):
    """One run of both sides; power fails when `cut_at_frame` frames have reached the device, or within a write."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.memory = RamMemory(NVM_BYTES)
        self.firmware = Firmware(self.memory)
        super().__init__(self.firmware, *args, **kwargs)
        self.frames_in = 0  # frames that reached the device
        self.cut_at_frame: int | None = None
        self.boots = 0

    def give(self, frame: Frame) -> list[Frame]:
        self.frames_in += 1
        if self.cut_at_frame is not None and self.frames_in > self.cut_at_frame:
            self.cut_at_frame = None
            return self.reboot()
        try:
            return list(self.firmware.receive(frame))
        except PowerLost:
            return self.reboot()

    def reboot(self, cause: Cause = Cause.BROWN_OUT) -> list[Frame]:
        """Power fails and comes back; what the device says then."""
        self.boots += 1
        self.memory.power_fails_after(None)
        self.firmware = Firmware(self.memory, cause)
        return self.firmware.start()
