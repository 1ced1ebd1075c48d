"""The whole plant around a device, step by step in this process, over a wire whose frames a check can lose or change.

loop = Loop(device, "s3", meals=[(20, 60.0)], steps=40)
loop.to_device = lambda name, values, frame: [] if name == "PUMP_Ack" else None     # lose every acknowledgement
loop.play()
expect(loop.ledgers_close(), "...")
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Self

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Node, Phase
from plant_server import mechanism
from plant_server.physiology import Patient, load_patient
from plant_server.scenario import Meal, Scenario, load_scenario
from plant_server.sensor import SensorSettings
from plant_server.server import PlantServer, Run
from pumpbench.calibration import MODES, Tuning, calibrate, tuning_for
from pumpbench.conformance.driver import Silent, alarm_code

Values = dict[str, int]
Wire = Callable[[str, Values, Frame], Sequence[Frame] | None]
"""What becomes of a frame: None = it passes, else the frames that arrive instead."""


def pass_all(_name: str, _values: Values, _frame: Frame) -> None:
    """A sound wire."""


class Loop:
    """One run of both sides.

    Args:
        device: what is tested.
        strategy: the mode, by its name in the paper.
        meals: (step, g of carbohydrates), all announced.
        steps: number of them.
        tuning: of the controller; default: the paper's, with a sensor that may stand still.
        sensor: its model.
        patient: default: adult#001.

    Attributes:
        to_device, to_plant: the wire of either direction.
        heard: (step, message, raw values) of everything the plant's side of the wire saw, both directions, in order.
        watch: sees the frames on the device's side of the wire, in order.
        watch_pump: sees those on the plant's side.
    """

    def __init__(
        self,
        device: Node,
        strategy: str,
        meals: Sequence[tuple[int, float]] = (),
        steps: int = 48,
        *,
        tuning: Tuning | None = None,
        sensor: str | SensorSettings = "ideal",
        patient: Patient | None = None,
    ) -> None:
        patient = patient or load_patient("adult#001")
        tuning = tuning or replace(tuning_for(strategy), stuck_samples=0)
        scenario: Scenario = load_scenario("fasting")._replace(
            meals=tuple(Meal(step, "Lunch", carbs) for step, carbs in meals)
        )
        run = Run(patient, scenario, steps, 1, MODES[strategy], calibrate(patient, tuning), sensor, ())
        self.plant = PlantServer(run)
        self.device = device
        self.to_device: Wire = pass_all
        self.to_plant: Wire = pass_all
        self.heard: list[tuple[int, str, Values]] = []
        self.watch: Callable[[Sequence[Frame]], None] = lambda _frames: None
        self.watch_pump: Callable[[Sequence[Frame]], None] = lambda _frames: None

    def play(self) -> Self:
        """To the end of the run; returns the loop.

        The device is not told of the end: a process would leave, and the next check needs it.

        Raises:
            Silent: the device did not answer.
            PlantError: it broke the protocol in a way the plant does not bear.
        """
        to_device = deque(self.plant.call_roll())
        calls = 1
        while not self.plant.finished:
            if not to_device:
                if calls == 3 or self.plant.step > 0:
                    raise Silent(f"an answer; waited for {self.plant.waiting_for}")
                calls += 1  # one whose counters are those of an earlier run misses the first call
                to_device += self.plant.call_roll()
            frame = to_device.popleft()
            if self._is_end(frame):
                break
            answers: list[Frame] = []
            self.watch_pump([frame])
            for arrived in self._carry(self.to_device, frame):
                self.watch([arrived])
                said = self.give(arrived)
                self.watch(said)
                answers += said
            for answer in answers:
                for arrived in self._carry(self.to_plant, answer):
                    self.watch_pump([arrived])
                    to_device += self.plant.receive(arrived)
        return self

    @staticmethod
    def _is_end(frame: Frame) -> bool:
        token = codec.message("SYNC_Step")
        return frame.can_id == token.can_id and token.unpack(frame.data)["SyncPhase"] == Phase.END

    def _carry(self, wire: Wire, frame: Frame) -> Sequence[Frame]:
        message = codec.messages_by_id().get(frame.can_id)
        if message is None or len(frame.data) != message.length:
            return (frame,)  # nothing of ours: the other side has to bear it
        values = message.unpack(frame.data)
        self.heard.append((self.plant.step, message.name, values))
        arrived = wire(message.name, values, frame)
        return (frame,) if arrived is None else arrived

    def give(self, frame: Frame) -> list[Frame]:
        """Let the device have a frame; returns what it says."""
        return list(self.device.receive(frame))

    # ---- what came of it

    def all(self, name: str) -> list[Values]:
        """The frames of one message."""
        return [values for _, said, values in self.heard if said == name]

    def steps_of(self, name: str) -> list[tuple[int, Values]]:
        """The frames of one message with the step they belong to."""
        return [(step, values) for step, said, values in self.heard if said == name]

    def commits(self, drug: int) -> dict[int, int]:
        """BolusId -> raw dose of the Commits that were sent."""
        field = {1: "InsulinBolus", 2: "PramlintideBolus"}[drug]
        return {
            values["BolusId"]: values[field]
            for values in self.all("PUMP_BolusCmd")
            if values["BolusHormone"] == drug and values["BolusOp"] == 2
        }

    def bolus_strokes(self, drug: int) -> int:
        """Strokes of boluses that reached the patient, summed over ids as PUMP_BolusState told them."""
        delivered: dict[int, int] = {}
        for values in self.all("PUMP_BolusState"):
            if values["BolusStateHormone"] == drug:
                delivered[values["BolusStateId"]] = values["BolusDeliveredRaw"] // 5
        return sum(delivered.values())

    def ledgers_close(self) -> bool:
        """Commanded = delivered + pending + lost, both drugs."""
        pump = self.plant.pump
        return all(mechanism.ledger_closes(chamber.words) for chamber in (pump.insulin, pump.pramlintide))

    def iob(self) -> list[int]:
        """InsulinOnBoard of every CTRL_Status, 0.01 U."""
        return [values["InsulinOnBoard"] for values in self.all("CTRL_Status")]

    def states(self) -> list[int]:
        """CtrlState of every CTRL_Status."""
        return [values["CtrlState"] for values in self.all("CTRL_Status")]

    def alarms(self, code: int | str) -> list[Values]:
        """The alarm frames of one code, by number or by its name in the DBC."""
        return [values for values in self.all("CTRL_Alarm") if values["CtrlAlarmCode"] == alarm_code(code)]
