"""The result file of `pumpbench conformance --json` as the page needs it."""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from can_bus import yaml_file
from can_bus.yaml_file import FileError
from pumpbench.conformance.suite import Verdict
from pumpbench.evidence.run import Device


class Row(BaseModel):
    """One requirement and what came of it."""

    id: str
    verdict: Verdict
    text: str
    requirement: str
    group: str
    hazards: tuple[str, ...]
    source: str
    binds: str
    check: str

    @property
    def broken(self) -> bool:
        """Whether it keeps the firmware from holding."""
        return self.verdict in (Verdict.FAILED, Verdict.NOT_RUN)


class ResultFile(BaseModel):
    """The keys of the file that the page shows; it may have more."""

    model_config = ConfigDict(frozen=True)

    pumpbench: str
    protocol: str
    dbc_crc32: str
    python: str
    packages: dict[str, str]
    bus: str
    firmware: str
    firmware_sha256: dict[str, str]
    device: Device | None
    long: bool
    holds: bool
    catalogue: int = Field(gt=0)
    requirements: tuple[Row, ...]


class Result(NamedTuple):
    """A result file, where it was and its hash."""

    file: Path
    sha256: str
    content: ResultFile

    @property
    def counts(self) -> dict[str, int]:
        """How many requirements have which verdict, in the order of `Verdict`; those without any are left out."""
        counts = Counter(row.verdict for row in self.content.requirements)
        return {verdict.value: counts[verdict] for verdict in Verdict if counts[verdict]}

    @property
    def groups(self) -> list[tuple[str, list[Row]]]:
        """The requirements by group, in the order of the file."""
        return [
            (group, list(rows)) for group, rows in itertools.groupby(self.content.requirements, lambda row: row.group)
        ]


def load(path: Path) -> Result:
    """Read a result file.

    Raises:
        FileError: it cannot be read, is none, or contradicts itself.
    """
    content = yaml_file.load(path, ResultFile)
    holds = not any(row.broken for row in content.requirements)
    if holds != content.holds:
        raise FileError(f"{path}: holds is {str(content.holds).lower()}, but the verdicts say otherwise")
    return Result(path, hashlib.sha256(path.read_bytes()).hexdigest(), content)
