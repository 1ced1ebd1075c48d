"""The buses of a run as URLs."""

import re
from pathlib import Path
from typing import Final, NamedTuple

from pumpbench.identity import SOMEBODY_ELSES
from pumpbench.rig.request import Request, RigError

SERIAL: Final = "slcan:"
"""Buses that one program opens."""


class Buses(NamedTuple):
    """The buses of a run as URLs."""

    plant: str
    device: str
    shown: str  # where a recorder sees what is on the device's
    private: bool  # the plant's is a hub of this run
    hosted: bool  # the device's is a hub of the gateway

    @classmethod
    def of(cls, request: Request, place: Path, *, faulty: bool) -> "Buses":
        """Which buses a request needs; with faults there are two, and where only one program can open a bus.

        Raises:
            RigError: the device's bus is not told.
        """
        plant, second, tap = (f"unix:{place / name}.sock" for name in ("plant", "device", "tap"))
        if request.bus == "hub":
            device = request.device_bus or (second if faulty else plant)
        elif request.bus.startswith(SERIAL):
            device = request.bus
        else:
            plant = request.bus
            device = request.device_bus or (_second_bus(plant) if faulty else plant)
        private = request.bus == "hub" or request.bus.startswith(SERIAL)
        if not device.startswith(SERIAL):
            return cls(plant, device, device, private, hosted=device == second)
        if request.firmware is None:
            raise RigError(
                f"only one program can open {device}, and that is the bench: give --firmware "
                f"{SOMEBODY_ELSES} for a device that runs by itself, or the command that starts it at the other end"
            )
        return cls(plant, device, tap if faulty else plant, private, hosted=False)


def _second_bus(url: str) -> str:
    match = re.fullmatch(r"(socketcan:.*?)(\d+)", url)
    if match is None:
        raise RigError(
            f"faults need a second bus for the device: give --device-bus beside --bus {url} (a hub has one of its own)"
        )
    return f"{match[1]}{int(match[2]) + 1}"
