"""The plant of a run: a fresh one, or one that begins as a recorded run did."""

from can_bus.gateway import Gateway
from can_bus.lockstep import Node
from plant_server.server import PlantServer
from pumpbench.rewind import RewoundPlant
from pumpbench.rig.power import InProcess
from pumpbench.rig.request import Prepared


def plant_of(prepared: Prepared, gateway: Gateway | None = None, device: Node | InProcess | None = None) -> PlantServer:
    """The plant of a run.

    Args:
        prepared: the run.
        gateway, device: that are in this process, for a checkpoint says something about them too.
    """
    origin = prepared.request.origin
    if origin is None:
        return PlantServer(prepared.run)
    plant = RewoundPlant(prepared.run, origin)
    stored = origin.state
    if stored is not None:
        from pumpbench import checkpoint  # noqa: PLC0415

        other_faults = prepared.info["faults"] != origin.info["faults"]
        mine = device if isinstance(device, InProcess) else None
        plant.arrived = lambda: checkpoint.check(
            stored, checkpoint.state(plant, gateway, mine), other_faults=other_faults
        )
    return plant
