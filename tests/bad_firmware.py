"""Firmware as nobody should write it: python bad_firmware.py KIND URL [MARK]."""

import os
import random
import sys

from can_bus import codec
from can_bus.codec import Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import Phase
from can_bus.url import open_link
from firmware_sim.firmware import Firmware

TOKEN = codec.message("SYNC_Step")
DONE = codec.message("SYNC_Done")


def main(kind: str, url: str) -> None:
    """Join the bus and behave badly, but answer the roll call, so that the tests begin."""
    device = Firmware()
    wrong = Transmitter()
    noise = random.Random(1)
    with open_link(url, wait=5.0) as link:
        while True:
            for frame in link.recv(None):
                step = TOKEN.unpack(frame.data)["SyncPhase"] if frame.can_id == TOKEN.can_id else None
                if kind == "mute":
                    continue
                if step != Phase.STEP:
                    link.send(device.receive(frame))
                elif kind == "dies":
                    os._exit(7)
                elif kind == "garbage":
                    link.send([Frame(can_id, noise.randbytes(8)) for can_id in (0x200, 0x300, DONE.can_id)])
                elif kind == "floods":
                    link.send([Frame(0x300, bytes(8))] * 5000)
                elif kind == "other step":
                    asked = TOKEN.unpack(frame.data)["StepIndex"]
                    wrong.counters["SYNC_Done"] = (asked + 1) % 16  # 0 was the answer to the calibration
                    link.send([wrong.frame("SYNC_Done", DoneStatus=0, DoneStepIndex=asked + 1, ExecTime=0, TxCount=1)])
                elif kind == "hangs":
                    continue


if __name__ == "__main__":
    main(*sys.argv[1:3])
