"""Fault files: what is written together acts on the wire, on the device, in the pump and in the sensor."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

from can_bus import yaml_file
from can_bus.faults import Fault as WireFault
from can_bus.faults import WireFaults
from plant_server.faults import AnyPumpFault, PumpFault
from plant_server.sensors.effects import AnyEffect, Effect

AnyFault = Annotated[WireFaults | AnyPumpFault | AnyEffect, Field(discriminator="kind")]
"""A fault in a file."""

Fault = WireFault | PumpFault | Effect
"""Any fault of the catalogue, as a value."""


class FaultFile(BaseModel):
    """The layout of a fault file."""

    model_config = ConfigDict(extra="forbid")

    faults: list[AnyFault]


class Faults(NamedTuple):
    """The faults of a run by where they act."""

    wire: tuple[WireFault, ...] = ()
    pump: tuple[AnyPumpFault, ...] = ()
    sensor: tuple[AnyEffect, ...] = ()

    @classmethod
    def of(cls, faults: Iterable[Any]) -> "Faults":
        """Sort faults by where they act.

        Raises:
            TypeError: one is none.
        """
        wire: list[WireFault] = []
        pump: list[Any] = []
        sensor: list[Any] = []
        for fault in faults:
            match fault:
                case WireFault():
                    wire.append(fault)
                case PumpFault():
                    pump.append(fault)
                case Effect():
                    sensor.append(fault)
                case _:
                    raise TypeError(f"{fault!r} is no fault; see pumpbench.faults")
        return cls(tuple(wire), tuple(pump), tuple(sensor))

    def as_json(self) -> list[dict[str, Any]]:
        """All of them as a fault file has them, for run.json."""
        return [fault.model_dump(mode="json", exclude_none=True) for part in self for fault in part]


def load(path: Path) -> Faults:
    """Read a fault file.

    Raises:
        yaml_file.FileError: with file, line and what was expected.
    """
    return Faults.of(yaml_file.load(path, FaultFile).faults)


def dump(faults: Iterable[Any]) -> str:
    """The text of a fault file with these; only what is not at its default, one fault a line."""
    lines = [
        yaml.safe_dump(
            {"kind": fault.kind} | fault.model_dump(mode="json", exclude_defaults=True),
            default_flow_style=True,
            sort_keys=False,
            width=1000,
        ).strip()
        for fault in faults
    ]
    return "faults:\n" + "".join(f"  - {line}\n" for line in lines) if lines else "faults: []\n"


def call(fault: Any) -> str:
    """The Python that makes a fault, with `faults` for this module: "faults.drop(message='HB_PUMP', start='02:00')"."""
    keys = fault.model_dump(mode="json", exclude_defaults=True)
    keys.pop("kind", None)
    return f"faults.{fault.kind}({', '.join(f'{name}={value!r}' for name, value in keys.items())})"


def write_wire(faults: Faults, path: Path) -> None:
    """Write the wire's part as a fault file of its own, for the gateway."""
    path.write_text(dump(faults.wire), encoding="utf-8")


class Maker:
    """Makes faults of one kind: `drop("CGM_Reading", start="02:00", end="02:40")`.

    What may stand without its name: the keys that the kind needs, in their order, then its own others.
    """

    def __init__(self, kind: type[BaseModel]) -> None:
        self.of = kind
        needed = [name for name, key in kind.model_fields.items() if key.is_required()]
        own = [name for name in vars(kind).get("__annotations__", {}) if name in kind.model_fields]
        self._positional = [name for name in dict.fromkeys(needed + own) if name not in ("kind", "start", "end")]
        self.__doc__ = kind.__doc__

    def __call__(self, *values: Any, **keys: Any) -> Any:
        """A fault.

        Raises:
            TypeError: too many values, or a key twice.
            pydantic.ValidationError: a value that does not fit; the text says what was expected.
        """
        names = self._positional[: len(values)]
        if len(names) < len(values) or set(names) & set(keys):
            raise TypeError(f"{kind_of(self.of)}: takes {', '.join(self._positional)} in this order, or by name")
        return self.of(**dict(zip(names, values, strict=True)), **keys)


def kind_of(fault: type[BaseModel]) -> str:
    """The kind's name in a fault file."""
    name: str = fault.model_fields["kind"].default
    return name


def _members(union: Any) -> list[type[Any]]:
    parts = [_members(part) for part in get_args(union) if not isinstance(part, FieldInfo)]
    return [member for part in parts for member in part] or [union]


KINDS: dict[str, type[Any]] = {kind_of(fault): fault for fault in _members(AnyFault)}
"""Every kind of fault by its name."""


def __getattr__(name: str) -> Maker:
    """The maker of each kind: `pumpbench.faults.drop` and so on."""
    if name in KINDS:
        return Maker(KINDS[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
