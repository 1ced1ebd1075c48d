"""Whatever arrives, in whatever order, with power failing: no exception, no dose above a limit, no hazard.

The lengths are set by environment variables, so that `make nightly` runs the same tests for long:
PUMPBENCH_SEQUENCES (default 60), PUMPBENCH_RANDOM_FRAMES (default 20000).
"""

import os
import random
from collections.abc import Sequence

import pytest
from bench import SENT_BY_CTRL, calibration
from pair import TOKENS, Pair, Values
from pumpbench.calibration import MODES
from pumpbench.hazards import Monitor

from can_bus import codec
from can_bus.codec import MessageCodec, Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Done, Phase
from firmware_sim.firmware import Firmware
from firmware_sim.wire import subscriptions

SEQUENCES = int(os.environ.get("PUMPBENCH_SEQUENCES", "60"))
RANDOM_FRAMES = int(os.environ.get("PUMPBENCH_RANDOM_FRAMES", "20000"))

MAX_BASAL, MAX_BOLUS, PRAM_BOLUS = 4000, 800, 200  # 4 U/h, 8 U, 20 ug
S3, S4 = MODES["s3"], MODES["s4"]


class Device:
    """A calibrated firmware that is told whatever a test wants to tell it, and watched for its doses."""

    def __init__(self, mode: int) -> None:
        self.firmware = Firmware()
        self.transmitter = Transmitter()
        self.k = 0
        self.basal = 0
        self.boluses = 0
        self.asked: list[dict[str, int]] = []  # bolus commands of this turn
        self.newest: dict[int, dict[str, int]] = {}  # by drug
        flash = calibration(CfgMaxBasal=MAX_BASAL, CfgMaxBolus=MAX_BOLUS, CfgPramBolus=PRAM_BOLUS)
        names = codec.message("CFG_Param").pages
        self.token(Phase.INIT, 1)
        self.transmitter = Transmitter()
        for index, raw in flash.items():
            self.say("CFG_Param", CfgIndex=index, **{names[index][0].name: raw})
            if names[index][0].name == "CfgBasal":
                self.basal = raw
        self.say("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=0, SuspendRequest=0)
        self.token(Phase.CONFIG, 0)

    def say(self, name: str, **values: int) -> None:
        self.hear(self.firmware.receive(self.transmitter.frame(name, **values)))

    def raw(self, message: MessageCodec, word: int) -> None:
        """A frame of any content with a good CRC and the next counter."""
        counter = self.transmitter.counters[message.name]
        self.transmitter.counters[message.name] = (counter + 1) % 16
        word &= ~0xFFF if message.data_ids is not None else -1
        self.hear(self.firmware.receive(Frame(message.can_id, codec.protect(message, word, counter))))

    def token(self, phase: Phase, k: int) -> int:
        answers = self.firmware.receive(
            self.transmitter.frame("SYNC_Step", SyncPhase=phase, StepIndex=k, SimTime=k * STEP_SECONDS)
        )
        return self.hear(answers)

    def hear(self, frames: Sequence[Frame]) -> int:
        """Check every dose; the DoneStatus, or -1."""
        status = -1
        for frame in frames:
            message = codec.messages_by_id()[frame.can_id]
            values = message.unpack(frame.data)
            if message.name == "PUMP_BasalCmd" and values["BasalOp"] == 1:
                assert values["InsulinRate"] * 5 <= max(MAX_BASAL, self.basal)
                assert values["PramlintideRate"] <= values["InsulinRate"] // 2 + 1
                assert values["InsulinRate"] > 0 or values["PramlintideRate"] == 0
            elif message.name == "PUMP_BolusCmd":
                self.boluses += values["BolusOp"] == 2
                self.asked.append(values)
                self.newest[values["BolusHormone"]] = values
                drug = values["BolusHormone"]
                dose = values["InsulinBolus" if drug == 1 else "PramlintideBolus"]
                assert 0 < dose <= (MAX_BOLUS if drug == 1 else PRAM_BOLUS)
            elif message.name == "SYNC_Done":
                status = values["DoneStatus"]
        return status

    def step(self, glucose: int = 1400) -> None:
        """One sound instant."""
        k = self.k
        self.say("CGM_Reading", CgmState=1, GlucoseConc=glucose, CgmSampleSeq=k % 65535, CgmSampleStep=k % 256)
        self.say("PUMP_Status", PumpState=3, InsulinReservoir=2000, PramReservoir=2000, PumpBattery=90)
        self.say("PUMP_Delivered", PumpBootCount=0, InsulinTotal=k * 120, PramTotal=0)
        for drug in (1, 2):
            done = {}
            if drug in self.newest:
                done = {"BolusPhase": 3, "BolusStateId": self.newest[drug]["BolusId"]}
            fields = {"BolusStateHormone": drug, "BolusPhase": 0, "BolusDeliveredRaw": 0, **done}
            self.say("PUMP_BolusState", **fields)
        self.run()

    def run(self) -> None:
        """The token of this instant, and every further turn that is asked for."""
        status = self.token(Phase.STEP, self.k)
        for _ in range(12):
            if status != Done.CONTINUE:
                break
            for command in self.asked:
                drug, operation = command["BolusHormone"], command["BolusOp"]
                dose = command["InsulinBolus" if drug == 1 else "PramlintideBolus"]
                purpose = 6 if operation == 3 else {1: 0, 2: 2}[drug] + 1 + operation
                self.say("PUMP_Ack", AckFor=purpose, AckResult=0, AckId=command["BolusId"], AckEchoRaw=dose)
            self.asked.clear()
            status = self.token(Phase.CONTINUE, self.k)
        assert status == Done.OK
        self.asked.clear()
        self.k += 1


def raws(bits: int) -> Sequence[int]:
    """Every value of a field up to 12 bits, else its ends, powers of two and some between."""
    if bits <= 12:
        return range(1 << bits)
    top = (1 << bits) - 1
    powers = [value for bit in range(bits) for value in (1 << bit, (1 << bit) - 1)]
    return sorted({0, top, top - 1, *powers, *range(0, top, max(top // 500, 1))})


HEARD = [name for name in subscriptions() if name not in ("SYNC_Step", "CFG_Param", "PLANT_Info")]


@pytest.mark.parametrize("name", HEARD)
def test_every_field_over_its_whole_range(name: str) -> None:
    """With a good CRC, a fresh counter, and everything else as usual (requirement NUM-01)."""
    message = codec.message(name)
    device = Device(S3)
    for _ in range(4):
        device.step()
    for field in message.fields.values():
        if field.name in ("CHECKSUM", "COUNTER"):
            continue
        for raw in raws(field.mask.bit_length()):
            usual = {"MEAL_Announce": {"MealKind": 1, "MealId": device.k % 255, "CarbsEst": 80, "MealOffset": 0}}
            values = {known: value for known, value in usual.get(name, {}).items() if known != field.name}
            word = message.pack(values) & ~(field.mask << field.shift) | raw << field.shift
            device.raw(message, word)
            device.step()
    assert name != "MEAL_Announce" or device.boluses > 100  # the sweep was not idle


def test_random_frames_change_no_dose_and_break_nothing() -> None:
    """Any id, length and content: what has no good CRC has no effect at all (requirements ROB-02, E2E-01)."""
    draw = random.Random(5)
    quiet, noisy = Device(S4), Device(S4)
    for _ in range(4):
        quiet.step(), noisy.step()
    ids = [message.can_id for message in codec.messages().values()]
    unprotected = {message.can_id for message in codec.messages().values() if message.data_ids is None}
    for number in range(RANDOM_FRAMES):
        can_id = draw.choice([draw.choice(ids), draw.getrandbits(11), draw.getrandbits(29) | 1 << 31])
        if can_id not in unprotected:
            data = bytearray(draw.randbytes(draw.choice([0, 1, 7, 8, 8, 8])))
            message = codec.messages_by_id().get(can_id)
            if message is not None and len(data) == message.length:
                word = int.from_bytes(data, "little") & ~0xFFF
                good = codec.protect(message, word | data[1] >> 4 << 12, data[1] & 15)
                data[0] ^= data[0] == good[0]  # one frame in 256 has a good CRC by chance: then it is no noise
            assert not noisy.firmware.receive(Frame(can_id, bytes(data)))
        if number % 100 == 99:
            quiet.step(1400 + number // 100 % 7), noisy.step(1400 + number // 100 % 7)
    assert noisy.firmware._outputs == quiet.firmware._outputs
    assert noisy.firmware._state == quiet.firmware._state
    assert noisy.firmware._wire.e2e_errors > 0


@pytest.mark.parametrize("first", range(0, SEQUENCES, 20))
def test_hostile_sequences_never_make_a_hazard(first: int) -> None:
    """Lost, doubled, late, replayed and corrupted frames, mode changes, suspensions and power cuts, by seed."""
    for seed in range(first, min(first + 20, SEQUENCES)):
        hostile_run(seed)


def hostile_run(seed: int) -> None:
    draw = random.Random(seed)
    mode = draw.choice(list(MODES))
    meals = sorted((draw.randint(6, 30), draw.choice([10.0, 40.0, 80.0, 140.0])) for _ in range(draw.randint(1, 4)))
    pair = Pair(mode, meals, steps=44)
    level = draw.choice([0.02, 0.1, 0.3])
    history: dict[bool, list[Frame]] = {False: [], True: []}  # by direction
    late: list[tuple[int, Frame]] = []

    def wire(name: str, _values: Values, frame: Frame) -> Sequence[Frame] | None:
        if name in TOKENS or pair.plant.step < 3 or name in ("CFG_Param", "CFG_ParamEcho", "HB_CTRL", "MODE_Cmd"):
            return None
        arrived = [frame]
        earlier = history[name in SENT_BY_CTRL]
        if draw.random() < level:
            fate = draw.randrange(6)
            if fate == 0:
                arrived = []
            elif fate == 1:
                arrived = [frame, frame]
            elif fate == 2:
                late.append((pair.plant.step + draw.randint(1, 4), frame))
                arrived = []
            elif fate == 3 and earlier:
                arrived = [frame, draw.choice(earlier)]
            elif fate == 4:
                data = bytearray(frame.data)
                data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
                arrived = [Frame(frame.can_id, bytes(data))] if codec.messages_by_id()[frame.can_id].data_ids else []
            elif pair.cut_at_frame is None and name not in ("PUMP_BasalCmd", "CTRL_Status"):
                pair.cut_at_frame = pair.frames_in + draw.randint(0, 8)
        due = [held for at, held in late if at <= pair.plant.step and held.can_id == frame.can_id]
        late[:] = [each for each in late if not (each[0] <= pair.plant.step and each[1].can_id == frame.can_id)]
        earlier.append(frame)
        del earlier[:-200]
        return [*arrived, *due]

    pair.to_device = pair.to_plant = wire
    device, pump = Monitor(), Monitor()
    pair.watch, pair.watch_pump = device.watch, pump.watch
    pair.play()
    # what was delivered shows at the pump, what was dosed on shows at the device; a replayed frame proves nothing
    hazards = {name: device.hazards[name] for name in ("H2", "H3", "H4", "H5", "H8") if device.hazards[name]}
    hazards |= {name: pump.hazards[name] for name in ("H1", "H6") if pump.hazards[name]}
    assert not hazards, (seed, mode, hazards)
    assert pair.ledgers_close(), seed
    for drug in (1, 2):
        assert pair.bolus_strokes(drug) <= sum(dose // 5 for dose in pair.commits(drug).values()), seed
