"""The reference firmware as a device of this process."""

from can_bus.faults.nodes import MemoryState
from can_bus.lockstep import Node
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.nvm import RamMemory
from pumpbench.conformance.device import InProcess
from pumpbench.rig.power import erase, powered_on


def reference() -> InProcess:
    """The reference firmware with a memory that outlives it."""
    memory = RamMemory(NVM_BYTES)

    def build(state: MemoryState | None) -> Node:
        if state is not None:
            return powered_on(memory, state)
        erase(memory)
        return Firmware(memory)

    return InProcess(build)
