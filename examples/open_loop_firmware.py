"""Somebody else's firmware, as small as it can be: tells the pump to run its schedule, whatever the glucose.

It shows what the bench asks of a device, with public libraries (python-can, cantools, autosar-e2e) and no code of the
reference firmware: answer the roll call, echo the calibration, speak only when it has the turn, close the turn.

    pumpbench run --strategy nma --firmware "python examples/open_loop_firmware.py {bus}"
"""

import sys

import can
import cantools
from e2e.p02 import e2e_p02_check, e2e_p02_protect

import dbc
from can_bus import open_bus

DATABASE = cantools.database.load_file(dbc.DBC_PATH)
RESUME_SCHEDULE, STATE_SAFE_BASAL = 3, 3
INIT, STEP, END = 0, 1, 4


class Device:
    """The whole firmware."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus
        self.reset()

    def reset(self) -> None:
        self.counters: dict[str, int] = {}
        self.calibration: dict[int, int] = {}
        self.echoes: list[dict[str, int]] = []
        self.mode = 0
        self.sent = 0

    def send(self, name: str, **signals: int) -> None:
        """Encode with the DBC's raw values, add counter and CRC (AUTOSAR E2E Profile 2), send."""
        message = DATABASE.get_message_by_name(name)
        counter = self.counters.get(name, 0)
        self.counters[name] = (counter + 1) % 16
        start = {signal.name: int(signal.raw_initial or 0) for signal in message.signals}
        data = bytearray(message.encode({**start, **signals, **self.checks(message, counter)}, scaling=False))
        if "COUNTER" in start:
            ids = bytes.fromhex(message.dbc.attributes["E2EDataIdList"].value)
            e2e_p02_protect(data, ids, increment_counter=False)
        self.bus.send(can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=False))
        self.sent += 1

    @staticmethod
    def checks(message: cantools.database.Message, counter: int) -> dict[str, int]:
        protected = any(signal.name == "COUNTER" for signal in message.signals)
        return {"CHECKSUM": 0, "COUNTER": counter} if protected else {}

    def run(self) -> None:
        for frame in self.bus:
            try:
                message = DATABASE.get_message_by_frame_id(frame.arbitration_id)
            except KeyError:
                continue
            if "CTRL" not in message.receivers:
                continue
            ids = message.dbc.attributes.get("E2EDataIdList")
            if ids and not e2e_p02_check(bytes(frame.data), bytes.fromhex(ids.value)):
                continue
            values = message.decode(frame.data, scaling=False, decode_choices=False)
            if message.name == "CFG_Param":
                self.store(values)
            elif message.name == "MODE_Cmd":
                self.mode = values["ModeRequest"]
            elif message.name == "SYNC_Step" and self.turn(values["SyncPhase"], values["StepIndex"]):
                return

    def store(self, values: dict[str, int]) -> None:
        raw = next(value for name, value in values.items() if name not in ("CHECKSUM", "COUNTER", "CfgIndex"))
        self.calibration[values["CfgIndex"]] = raw
        self.echoes.append({"EchoIndex": values["CfgIndex"], "EchoRaw": raw & 0x3FFFFFFF, "EchoSetCrc": 0})

    def turn(self, phase: int, step: int) -> bool:
        """One turn: what there is to say, then SYNC_Done. True at the end of the run."""
        if phase == INIT:
            self.reset()
        self.sent = 0
        for echo in self.echoes:
            self.send("CFG_ParamEcho", **echo)
        self.echoes = []
        if phase == STEP:
            until = (step + 3) % 128
            self.send("PUMP_BasalCmd", BasalOp=RESUME_SCHEDULE, BasalCmdSeq=step % 1023, BasalUntilStep=until)
            self.send("CTRL_Status", CtrlMode=self.mode, CtrlState=STATE_SAFE_BASAL, InsulinOnBoard=0)
        self.send("SYNC_Done", DoneStatus=0, DoneStepIndex=step, TxCount=self.sent + 1)
        if phase == INIT:
            self.reset()
        return phase == END


if __name__ == "__main__":
    with open_bus(sys.argv[1]) as device_bus:
        Device(device_bus).run()
