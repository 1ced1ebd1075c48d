"""Fault files: what is written together acts in three places, on the wire, in the pump and in the sensor."""

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import BaseModel, ConfigDict, Field

from can_bus import yaml_file
from can_bus.faults import Drop
from plant_server.faults import AnyPumpFault, PumpFault
from plant_server.sensors.effects import AnyEffect

AnyFault = Annotated[Drop | AnyPumpFault | AnyEffect, Field(discriminator="kind")]


class FaultFile(BaseModel):
    """The layout of a fault file."""

    model_config = ConfigDict(extra="forbid")

    faults: list[AnyFault]


class Faults(NamedTuple):
    """The faults of a run by where they act."""

    wire: tuple[Drop, ...] = ()
    pump: tuple[AnyPumpFault, ...] = ()
    sensor: tuple[AnyEffect, ...] = ()

    def as_json(self) -> list[dict[str, Any]]:
        """All of them as a fault file has them, for run.json."""
        return [fault.model_dump(mode="json") for part in self for fault in part]


def load(path: Path) -> Faults:
    """Read a fault file.

    Raises:
        yaml_file.FileError: with file, line and what was expected.
    """
    faults = yaml_file.load(path, FaultFile).faults
    return Faults(
        wire=tuple(fault for fault in faults if isinstance(fault, Drop)),
        pump=tuple(fault for fault in faults if isinstance(fault, PumpFault)),
        sensor=tuple(fault for fault in faults if not isinstance(fault, Drop | PumpFault)),
    )


def write_wire(faults: Faults, path: Path) -> None:
    """Write the wire's part as a fault file of its own, for the gateway."""
    entries = [fault.model_dump(mode="json", exclude_none=True) for fault in faults.wire]
    path.write_text(yaml.safe_dump({"faults": entries}), encoding="utf-8")
