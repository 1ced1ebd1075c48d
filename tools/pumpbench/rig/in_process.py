"""A run in one process: the same nodes and the same frames as on a bus, without its wake-ups."""

from collections.abc import Callable, Sequence

from can_bus.faults import NodeFault
from can_bus.frame import Frame
from can_bus.gateway import Gateway, Side
from can_bus.lockstep import Node
from plant_server.server import PlantServer
from pumpbench.capture import Capture
from pumpbench.rig.plant import plant_of
from pumpbench.rig.power import InProcess
from pumpbench.rig.processes import NodeDied
from pumpbench.rig.request import Prepared, Progress, unseen


class Wires:
    """The buses of a run in one process: hands every frame to every other node, in order.

    Args:
        plant: a fresh one.
        device: a node, or a firmware with its power switch.
        gateway: between the two, with the device behind it.
        capture: gets every frame.
    """

    def __init__(self, plant: PlantServer, device: Node | InProcess, gateway: Gateway | None, capture: Capture) -> None:
        self.plant = plant
        self.device = device
        self.gateway = gateway
        self.capture = capture

    def run(self, progress: Callable[[int], None]) -> None:
        """From the roll call to the end of the run.

        Raises:
            NodeDied: the firmware did not answer a token; in one process it never will.
        """
        from_plant: list[Frame] = self.plant.call_roll()
        while from_plant:
            from_plant = self._round(from_plant)
            if self.plant.step % 16 == 0:
                progress(self.plant.step)
        if not self.plant.finished:
            raise NodeDied(f"the firmware went silent: {self.plant.waiting_for}")

    def _round(self, from_plant: list[Frame]) -> list[Frame]:
        """What the plant sends after this, once everybody who is spoken to has answered."""
        if self.gateway is None:
            self.capture.extend(0, from_plant)
            said = self._tell_device(from_plant)
            self.capture.extend(0, said)
            return self._tell_plant(said)
        self.capture.extend(1, from_plant)
        answers: list[Frame] = []
        to_plant: list[Frame] = []
        for frame in from_plant:  # one by one: a fault may replace the device between two of them
            crossing = self.gateway.forward(frame, Side.PLANT)
            self.capture.extend(0, crossing.device)
            to_plant += crossing.plant
            answers += self._tell_device(crossing.device)
        while answers:
            self.capture.extend(0, answers)
            for frame in answers:
                to_plant += self.gateway.forward(frame, Side.DEVICE).plant
            answers = self._started()
        self.capture.extend(1, to_plant)
        return self._tell_plant(to_plant)

    def _tell_device(self, frames: Sequence[Frame]) -> list[Frame]:
        node = self.device.firmware if isinstance(self.device, InProcess) else self.device
        return [answer for frame in frames for answer in node.receive(frame)] + self._started()

    def _started(self) -> list[Frame]:
        """What a device says that a fault has just started."""
        if not isinstance(self.device, InProcess):
            return []
        said, self.device.said = self.device.said, []
        return said

    def _tell_plant(self, frames: Sequence[Frame]) -> list[Frame]:
        return [answer for frame in frames for answer in self.plant.receive(frame)]


def simulate(prepared: Prepared, capture: Capture, progress: Progress = unseen) -> None:
    """Do the run in this process, with the built-in firmware; `capture` gets every frame and nothing is written.

    Raises:
        NodeDied, PlantError: the run did not come to its end.
    """
    wires(prepared, capture).run(lambda step: progress(step, prepared.request.steps))


def wires(prepared: Prepared, capture: Capture, *, memory: bool = False) -> Wires:
    """The nodes of a run in this process, joined.

    Args:
        prepared: the run.
        capture: gets every frame.
        memory: the firmware has a non-volatile memory, whether or not a fault needs one.
    """
    from firmware_sim.firmware import Firmware  # noqa: PLC0415

    wire, origin = prepared.faults.wire, prepared.request.origin
    memory |= origin is not None and origin.state is not None  # which has one
    memory |= any(isinstance(fault, NodeFault) for fault in wire)
    device: Node | InProcess = InProcess() if memory else Firmware()
    gateway = Gateway(wire, device if isinstance(device, InProcess) else None) if wire else None
    return Wires(plant_of(prepared, gateway, device), device, gateway, capture)
