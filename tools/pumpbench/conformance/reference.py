"""The reference firmware as a device of this process."""

from can_bus.faults.nodes import MemoryState
from can_bus.lockstep import Node
from firmware_sim.firmware import NVM_BYTES, NVM_WORDS, Cause, Firmware
from firmware_sim.nvm import ERASED, RamMemory
from pumpbench.conformance.device import InProcess
from pumpbench.rig.power import tear


def reference() -> InProcess:
    """The reference firmware with a memory that outlives it."""
    memory = RamMemory(NVM_BYTES)

    def build(state: MemoryState | None) -> Node:
        if state == "torn":
            tear(memory, NVM_WORDS)
        elif state != "kept":
            memory.write(0, bytes([ERASED]) * memory.size)
        return Firmware(memory, Cause.POWER_ON if state in (None, "kept") else Cause.BROWN_OUT)

    return InProcess(build)
