"""The catalogue of faults (`catalogue.yaml`): what each puts to the test, and who notices it."""

import functools
import inspect
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_bus import yaml_file
from pumpbench.calibration import MODES
from pumpbench.faults import KINDS, AnyFault, dump

TIMES = ("start", "end")
CATALOGUE = Path(__file__).with_name("catalogue.yaml")

Hazard = Literal["H1", "H2", "H3", "H4", "H5", "H6", "H7", "H8"]


class Entry(BaseModel):
    """One typical fault; catalogue.yaml says what its keys mean."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    fault: AnyFault
    hazards: Annotated[tuple[Hazard, ...], Field(min_length=1)]
    seen_by: tuple[str, ...] = ()
    unseen: str = ""
    modes: tuple[str, ...] = tuple(MODES)

    @model_validator(mode="after")
    def _either(self) -> "Entry":
        if bool(self.seen_by) == bool(self.unseen):
            raise ValueError("give either seen_by, or unseen with the reason")
        unknown = set(self.modes) - set(MODES)
        if unknown:
            raise ValueError(f"modes are of {', '.join(MODES)}")
        return self

    @property
    def noticed(self) -> str:
        """Who notices, in words."""
        return f"seen by {', '.join(self.seen_by)}" if self.seen_by else f"not seen: {self.unseen}"


class CatalogueFile(BaseModel):
    """The layout of catalogue.yaml."""

    model_config = ConfigDict(extra="forbid")

    entries: list[Entry]


@functools.cache
def entries() -> tuple[Entry, ...]:
    """All of them, in the order of the file."""
    return tuple(yaml_file.load(CATALOGUE, CatalogueFile).entries)


def parameters(kind: str) -> dict[str, str]:
    """The keys of a kind of its own, and what each takes: its type as a fault file has it, and its default."""
    model = KINDS[kind]
    schema = model.model_json_schema()
    needed = schema.get("required", ())
    found = {}
    for name, field in schema["properties"].items():
        if name == "kind":
            continue
        text = "time" if name in TIMES else _type(field)
        found[name] = text if name in needed else f"{text}; default {_default(field)}"
    return found


def _default(field: dict[str, Any]) -> str:
    value = field.get("default")
    if field.get("title", "").lower() in TIMES:
        return "the beginning" if value == 0 else "the end of the run"
    return "none" if value is None else "true" if value is True else "false" if value is False else str(value)


def _type(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(_type(part) for part in field["anyOf"] if part.get("type") != "null"))
    if "enum" in field:
        return ", ".join(map(str, field["enum"]))
    if "const" in field:
        return str(field["const"])
    low, high = field.get("minimum", field.get("exclusiveMinimum")), field.get("maximum", field.get("exclusiveMaximum"))
    kind = {"integer": "integer", "number": "number", "string": "text", "boolean": "true or false", "array": "list",
            "object": "mapping"}.get(field.get("type", ""), "value")  # fmt: skip
    if low is not None and high is not None:
        return f"{kind} {low:g} to {high:g}"
    return f"{kind} from {low:g}" if low is not None else f"{kind} to {high:g}" if high is not None else kind


def summary(kind: str) -> str:
    """The first sentence of what a kind does."""
    return describe(kind).split("\n\n")[0].replace("\n", " ")


def describe(kind: str) -> str:
    """What a kind does."""
    return inspect.cleandoc(KINDS[kind].__doc__ or "")


def examples(kind: str) -> list[Entry]:
    """The entries of a kind."""
    return [entry for entry in entries() if entry.fault.kind == kind]


def as_file(entry: Entry) -> str:
    """A fault file with this entry alone."""
    return dump([entry.fault])
