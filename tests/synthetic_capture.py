"""A made-up closed loop, frame by frame: what a bus carries when nobody has written a plant or a firmware yet."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np
from pumpbench.capture import Capture
from pumpbench.frames import Frames

import dbc
from can_bus import codec
from can_bus.frame import Frame

STROKE_U = 0.05
MEALS = {96: 45.0, 156: 70.0, 228: 60.0}  # step of the day -> g
Fault = Callable[[int, Frame], list[Frame]]


class Loop:
    """One device and one plant on a bus; `faults` sit in a gateway, so that the two buses differ."""

    def __init__(self, steps: int, seed: int = 1, occlusion: range = range(0), faults: Fault | None = None) -> None:
        self.steps, self.occlusion, self.faults = steps, occlusion, faults
        self.tx = codec.Transmitter()
        self.rng = np.random.default_rng(seed)
        self.capture = Capture()
        self.step = 0
        self.insulin = self.pram = 0.0
        self.bolus = {1: (0xFFFF, 0, 0), 2: (0xFFFF, 0, 0)}
        self.sent: list[tuple[int, Frame]] = []

    def put(self, frame: Frame, *, device: bool = False) -> None:
        """A frame from one side to the other, through the gateway when there is one."""
        if self.faults is None:
            self.capture.extend(0, [frame])
            self.sent.append((0, frame))
            return
        source, sink = (0, 1) if device else (1, 0)
        self.capture.extend(source, [frame])
        self.sent.append((source, frame))
        for passed in self.faults(self.step, frame):
            self.capture.extend(sink, [passed])
            self.sent.append((sink, passed))

    def send(self, name: str, **values: int) -> None:
        self.put(self.tx.frame(name, **values), device=codec.message(name).sender == "CTRL")

    def token(self, phase: str, step: int, time_s: int) -> None:
        self.send("SYNC_Step", SyncPhase=codec.choice("SYNC_Step", "SyncPhase", phase), StepIndex=step, SimTime=time_s)

    def done(self, step: int, count: int = 1, status: int = 0) -> None:
        self.send("SYNC_Done", DoneStatus=status, DoneStepIndex=step, ExecTime=120, TxCount=count)

    def run(self) -> Capture:
        for call in range(3):  # the roll call: how often it is repeated depends on the wall clock
            self.send("PLANT_Info", PlantProtocolMajor=1, PlantProtocolMinor=0)
            self.token("Init", call, 0)
        self.send("CTRL_Info", CtrlProtocolMajor=1, CtrlProtocolMinor=0, FirmwareMajor=0, FirmwareMinor=1)
        self.done(2)
        for index in range(3):
            self.send("CFG_Param", CfgIndex=index, **{("CfgBasal", "CfgCarbRatio", "CfgGlucoseTarget")[index]: 1200})
        self.send("MODE_Cmd", ModeRequest=6, ModeCmdSeq=1, SuspendRequest=0)
        self.token("Config", 0, 0)
        for index in range(3):
            self.send("CFG_ParamEcho", EchoIndex=index, EchoRaw=1200, EchoSetCrc=7)
        self.done(0)
        for k in range(self.steps):
            self.one_step(k)
        self.step = self.steps
        self.batch(self.steps)
        self.token("End", self.steps, 300 * self.steps)
        self.done(self.steps)
        return self.capture

    def run_frames(self) -> list[tuple[int, Frame]]:
        """Run, and return channel and frame of everything sent, in order."""
        self.run()
        return self.sent

    def glucose(self, k: int) -> float:
        day = k % 288
        rise = sum(
            1.6 * carbs * (t := (day - start) / 9) * math.exp(1 - t) for start, carbs in MEALS.items() if day >= start
        )
        stuck = 60 * sum(max(0.0, 1 - abs(k - stop - 6) / 24) for stop in (self.occlusion.stop,) if self.occlusion)
        return 115 + 12 * math.sin(k / 40) + rise + stuck

    def batch(self, k: int) -> None:
        """What the plant's side says before it hands over the turn of step k."""
        glucose = self.glucose(k)
        cgm = min(400.0, max(40.0, glucose + float(self.rng.normal(0, 6))))
        carbs = MEALS.get(k % 288, 0.0)
        occluded = k in self.occlusion
        self.send(
            "CGM_Reading",
            CgmState=1,
            GlucoseConc=round(cgm / 0.1),
            GlucoseRate=round(self.rng.normal(0, 50)),
            CgmSampleSeq=k % 65535,
            CgmSampleStep=k % 256,
        )
        if k % 12 == 0:
            self.send(
                "CGM_Status",
                CgmFaultBits=0,
                CgmSessionId=1,
                CgmSensorAge=5 * k,
                CgmNoise=12,
                CgmBattery=180,
                CgmDropCount=0,
            )
        if carbs:
            self.send(
                "MEAL_Announce", MealKind=1, MealId=k % 255, CarbsEst=round(2 * carbs), MealOffset=0, MealAbsorption=0
            )
        self.send(
            "PUMP_Status",
            PumpState=3,
            PumpLastBasalSeq=(k - 1) % 1023,
            InsulinReservoir=max(0, 3000 - round(10 * self.insulin)),
            PramReservoir=max(0, 3000 - round(self.pram)),
            PumpBattery=90,
            InsulinOcclusion=2 if occluded else 0,
            TbrActive=1,
            PramOcclusion=0,
        )
        self.send(
            "PUMP_Delivered",
            PumpBootCount=1,
            InsulinTotal=round(self.insulin / 0.001),
            PramTotal=round(self.pram / 0.01),
        )
        for hormone, (ident, delivered, programmed) in self.bolus.items():
            self.send(
                "PUMP_BolusState",
                BolusStateHormone=hormone,
                BolusPhase=0 if ident == 0xFFFF else 3,
                BolusStateId=ident,
                BolusDeliveredRaw=delivered,
                BolusProgrammedRaw=programmed,
            )
        if occluded:
            self.send("PUMP_Alarm", PumpAlarmState=1, PumpAlarmPriority=3, PumpAlarmCode=5, PumpAlarmInstance=41)
        elif self.occlusion and k == self.occlusion.stop:
            self.send("PUMP_Alarm", PumpAlarmState=0, PumpAlarmPriority=3, PumpAlarmCode=5, PumpAlarmInstance=41)
        for node in ("Pump", "Cgm"):
            self.send(
                f"HB_{node.upper()}",
                **{f"Nmt{node}": 5, f"Toggle{node}": k % 2, f"ResetCause{node}": 0, f"Boot{node}": 1},
            )
        stomach = sum(c * math.exp(-((k % 288) - s) / 12) for s, c in MEALS.items() if (k % 288) >= s)
        pages: list[dict[str, int]] = [
            {"TruthGlucose": round(glucose / 0.02), "TruthInterstitial": round(self.glucose(k - 1) / 0.02)},
            {"TruthInsulin": round((15 + stomach / 4) / 0.02), "TruthPramlintide": round(stomach / 3 / 0.02)},
            {"TruthEta": round(max(0.3, 1 - stomach / 120) / 0.0001), "TruthQsto": round(1000 * stomach / 4)},
            {"TruthRa": round(stomach / 12 / 0.001), "TruthMealCarbs": round(carbs / 0.02)},
            {"TruthInsulinCommanded": k, "TruthInsulinPending": 0, "TruthInsulinLost": 0},
            {"TruthPramCommanded": k, "TruthPramPending": 0, "TruthPramLost": 0},
        ]
        for page, values in enumerate(pages):
            self.send("PLANT_Truth", TruthSel=page, TruthStep=k, **values)

    def one_step(self, k: int) -> None:
        self.step = k
        self.batch(k)
        self.token("Step", k, 300 * k)
        lost = self.faults is not None and not self.faults(k, Frame(codec.message("CGM_Reading").can_id, bytes(8)))
        rate = 1.2 if lost else max(0.0, 1.2 + (self.glucose(k) - 115) / 40)
        raw_rate, raw_pram = round(rate / 0.005), round(6 * rate / 0.1)
        carbs = MEALS.get(k % 288, 0.0)
        self.send(
            "PUMP_BasalCmd",
            BasalOp=1,
            BasalCmdSeq=k % 1023,
            InsulinRate=raw_rate,
            PramlintideRate=raw_pram,
            BasalUntilStep=(k + 2) % 128,
        )
        if carbs:
            ident = k % 65535
            for op, turn in ((1, 1), (2, 2)):
                self.send(
                    "PUMP_BolusCmd",
                    BolusHormone=1,
                    BolusOp=op,
                    BolusId=ident,
                    BolusUntilStep=k % 256,
                    InsulinBolus=round(carbs / 12 / 0.01),
                )
                self.done(k, 2, status=3)
                self.send(
                    "PUMP_Ack",
                    AckFor=2 * turn,
                    AckResult=0,
                    AckId=ident,
                    AckEchoRaw=round(carbs / 12 / 0.01),
                    AckLimitRaw=2000,
                )
                self.token("Continue", k, 300 * k + turn)
        self.send(
            "CTRL_Status",
            CtrlMode=6,
            CtrlState=2 if lost else 1,
            InsulinOnBoard=120,
            LimiterBits=16 if lost else 0,
            LastMealId=0,
            LastCgmSeq=k % 65535,
        )
        self.send(
            "CTRL_Diag",
            E2eErrorCount=0,
            LostFrameCount=min(k, 3) if lost else 0,
            SequenceErrorCount=0,
            SaturationCount=0,
            NvmFallbackCount=0,
        )
        if lost:
            self.send(
                "CTRL_Alarm", CtrlAlarmState=1, CtrlAlarmPriority=2, CtrlAlarmCode=1, CtrlAlarmInstance=k // 288 + 1
            )
        self.send("HB_CTRL", NmtCtrl=5, ToggleCtrl=k % 2, ResetCauseCtrl=0, BootCtrl=1)
        self.done(k, 5)
        delivered = 0.0 if k in self.occlusion else raw_rate * 0.005 / 12
        if carbs:
            units = carbs / 12 if k not in self.occlusion else 0.0
            delivered += units
            self.bolus[1] = (k % 65535, round(units / 0.01), round(carbs / 12 / 0.01))
        self.insulin += delivered
        self.pram += raw_pram * 0.1 / 12


def dropping(message: str, steps: range, announce: Callable[[int, Frame], Frame | None] | None = None) -> Fault:
    """A gateway that drops a message during some steps and says so with FAULT_Inject, once per frame."""
    can_id = codec.message(message).can_id
    tx = codec.Transmitter()
    sender = codec.message(message).sender
    target = sender if sender in ("CGM", "PUMP", "CTRL", "UI") else "Bus"

    def fault(step: int, frame: Frame) -> list[Frame]:
        if frame.can_id == can_id and step in steps:
            if frame.data == bytes(8):
                return []  # only asked
            return [
                tx.frame(
                    "FAULT_Inject",
                    FaultTarget=codec.choice("FAULT_Inject", "FaultTarget", target),
                    FaultKind=1,
                    FaultCanId=can_id,
                    FaultCount=1,
                )
            ]
        return [frame]

    return fault


def as_frames(frames: list[Frame]) -> Frames:
    """Frames as a record of one step each, whatever they say."""
    n = len(frames)
    data = np.frombuffer(b"".join(frame.data.ljust(8, b"\0") for frame in frames), "u1").reshape(n, 8)
    return Frames(
        channel=np.zeros(n, "u1"),
        can_id=np.array([frame.can_id for frame in frames], "u4"),
        length=np.array([len(frame.data) for frame in frames], "u1"),
        data=data,
        step=np.arange(n, dtype="i4"),
        time_s=300.0 * np.arange(n),
        turn=np.zeros(n, "i2"),
    )


def pages(name: str) -> list[int]:
    """The values of a multiplexer that select something."""
    ids = {
        signal.multiplexer_ids[0] for signal in dbc.load().get_message_by_name(name).signals if signal.multiplexer_ids
    }
    return sorted(ids)


def random_frames(count: int, seed: int = 3) -> Iterator[tuple[str, Frame]]:
    """Frames of every message with random payload bits and a fitting checksum."""
    rng = np.random.default_rng(seed)
    for name, message in codec.messages().items():
        selectors = [None] if message.selector is None else pages(name)
        for _, selector in zip(range(count), itertools.cycle(selectors)):
            word = int.from_bytes(rng.bytes(message.length), "little")
            if selector is not None:
                field = message.fields[message.selector or ""]
                word = word & ~(field.mask << field.shift) | (selector & field.mask) << field.shift
            counter = int(rng.integers(16))
            if message.data_ids:
                word &= ~0xFFF
            yield name, Frame(message.can_id, codec.protect(message, word, counter))
