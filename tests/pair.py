"""Plant and firmware against each other in this process, over a wire that loses frames and with power that fails.

pair = Pair("s3", meals=[(20, 60.0)], steps=40)
pair.to_device = lambda name, values: [] if name == "PUMP_Ack" else None     # lose every acknowledgement
pair.play()
assert pair.ledgers_close()
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from pumpbench.calibration import MODES, Tuning, calibrate, tuning_for

from can_bus import codec
from can_bus.frame import Frame
from firmware_sim.firmware import NVM_WORDS, Cause, Firmware
from firmware_sim.nvm import PowerLost, RamMemory, memory_size
from plant_server import mechanism
from plant_server.physiology import Patient, load_patient
from plant_server.scenario import Meal, Scenario, load_scenario
from plant_server.server import PlantServer, Run

Values = dict[str, int]
Wire = Callable[[str, Values, Frame], Sequence[Frame] | None]
"""What becomes of a frame: None = it passes, else the frames that arrive instead."""

TOKENS = ("SYNC_Step", "SYNC_Done")


def pass_all(_name: str, _values: Values, _frame: Frame) -> None:
    """A sound wire."""


class Pair:
    """One run of both sides.

    Attributes:
        to_device, to_plant: the wire of either direction.
        heard: (step, message, raw values) of everything the plant's side of the wire saw, both directions, in order.
    """

    def __init__(
        self,
        strategy: str,
        meals: Sequence[tuple[int, float]] = (),
        steps: int = 48,
        *,
        tuning: Tuning | None = None,
        sensor: str = "ideal",
        patient: Patient | None = None,
    ) -> None:
        patient = patient or load_patient("adult#001")
        tuning = tuning or replace(tuning_for(strategy), stuck_samples=0)
        scenario: Scenario = load_scenario("fasting")._replace(
            meals=tuple(Meal(step, "Lunch", carbs) for step, carbs in meals)
        )
        run = Run(patient, scenario, steps, 1, MODES[strategy], calibrate(patient, tuning), sensor, ())
        self.plant = PlantServer(run)
        self.memory = RamMemory(memory_size(NVM_WORDS))
        self.firmware = Firmware(self.memory)
        self.to_device: Wire = pass_all
        self.to_plant: Wire = pass_all
        self.heard: list[tuple[int, str, Values]] = []
        self.frames_in = 0  # frames that reached the device
        self.cut_at_frame: int | None = None  # power fails when so many have
        self.boots = 0
        self.watch: Callable[[Sequence[Frame]], None] = lambda _frames: None  # sees the device's side of the wire
        self.watch_pump: Callable[[Sequence[Frame]], None] = lambda _frames: None  # sees the plant's side

    def play(self) -> "Pair":
        """To the end of the run."""
        to_device = deque(self.plant.call_roll())
        while not self.plant.finished:
            assert to_device, self.plant.waiting_for
            frame = to_device.popleft()
            answers: list[Frame] = []
            self.watch_pump([frame])
            for arrived in self._carry(self.to_device, frame):
                self.watch([arrived])
                said = self._give(arrived)
                self.watch(said)
                answers += said
            for answer in answers:
                for arrived in self._carry(self.to_plant, answer):
                    self.watch_pump([arrived])
                    to_device += self.plant.receive(arrived)
        return self

    def _carry(self, wire: Wire, frame: Frame) -> Sequence[Frame]:
        message = codec.messages_by_id()[frame.can_id]
        values = message.unpack(frame.data)
        self.heard.append((self.plant.step, message.name, values))
        arrived = wire(message.name, values, frame)
        return (frame,) if arrived is None else arrived

    def _give(self, frame: Frame) -> list[Frame]:
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

    # ---- what came of it

    def all(self, name: str) -> list[Values]:
        """The frames of one message."""
        return [values for _, said, values in self.heard if said == name]

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
        pump = self.plant._pump
        return all(mechanism.ledger_closes(chamber.words) for chamber in (pump.insulin, pump.pramlintide))

    def iob(self) -> list[int]:
        """InsulinOnBoard of every CTRL_Status, 0.01 U."""
        return [values["InsulinOnBoard"] for values in self.all("CTRL_Status")]

    def states(self) -> list[int]:
        """CtrlState of every CTRL_Status."""
        return [values["CtrlState"] for values in self.all("CTRL_Status")]

    def alarms(self, code: int) -> list[Values]:
        """The alarm frames of one code."""
        return [values for values in self.all("CTRL_Alarm") if values["CtrlAlarmCode"] == code]
