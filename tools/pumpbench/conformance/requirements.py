"""The catalogue of requirements."""

import functools
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from can_bus import yaml_file

CATALOGUE = Path(__file__).with_name("requirements.yaml")

Hazard = Literal["H1", "H2", "H3", "H4", "H5", "H6", "H7", "H8"]


class Requirement(BaseModel):
    """One row; requirements.yaml says what the fields mean."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str = Field(pattern=r"^[A-Z2]{3}-\d\d$")
    group: str
    text: str
    hazards: tuple[Hazard, ...] = Field(min_length=1)
    source: str
    binds: Literal["device", "pump"] = "device"
    evidence: str | None = None
    open: str | None = None


class Catalogue(BaseModel):
    """The file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sources: dict[str, str]
    requirements: tuple[Requirement, ...]


@functools.cache
def catalogue() -> Catalogue:
    """The whole catalogue."""
    return yaml_file.load(CATALOGUE, Catalogue)


@functools.cache
def requirements() -> dict[str, Requirement]:
    """The requirements by id, in the order of the file."""
    return {each.id: each for each in catalogue().requirements}
