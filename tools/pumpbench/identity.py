"""What was tested, and with what: the part of a result that says which firmware and which bench it is of."""

import functools
import hashlib
import importlib.metadata
import platform
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import dbc
from can_bus import codec
from pumpbench import __version__

PACKAGES = ("numpy", "numba", "python-can", "cantools", "autosar-e2e", "rerun-sdk")

SOMEBODY_ELSES = "none"
"""In place of a firmware's command: the device runs by itself."""

BUILT_IN = "built-in"
"""In place of a firmware's command in run.json, and as --firmware of a fork: the reference firmware."""


def versions() -> dict[str, Any]:
    """Versions of the bench, of the wire, of Python and of the packages a result depends on."""
    return {
        "pumpbench": __version__,
        "protocol": ".".join(map(str, dbc.protocol_version())),
        "dbc_crc32": f"{dbc.crc32():08x}",
        "python": platform.python_version(),
        "packages": dict(_packages()),
    }


@functools.cache
def _packages() -> dict[str, str]:
    """Searching the installed packages costs as much as some steps of a run: once is enough."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def other_dbc(info: Mapping[str, Any]) -> str | None:
    """What to say of a record, from its run.json, whose frames another DBC than this one gave their meaning."""
    theirs, ours = info.get("dbc_crc32"), f"{dbc.crc32():08x}"
    if theirs in (None, ours):
        return None
    return f"was recorded with another pumpbench.dbc: CRC-32 {theirs}, this one {ours}"


def firmware_sha256(command: str | None) -> dict[str, str]:
    """SHA-256 of the firmware's files, by name.

    Args:
        command: that starts it, of which every word counts that names a file, the first one also by the PATH. None:
            the reference firmware, whose sources are one hash. "none": a device that runs by itself, without files.
    """
    if command is None:
        import firmware_sim  # noqa: PLC0415

        digest = hashlib.sha256()
        for source in sorted(Path(next(iter(firmware_sim.__path__))).rglob("*.py")):
            digest.update(source.read_bytes())
        return {"firmware_sim": digest.hexdigest()}
    if command == SOMEBODY_ELSES:
        return {}
    words = shlex.split(command)
    found = {}
    for number, word in enumerate(words):
        path = Path((shutil.which(word) if number == 0 else None) or word)
        if path.is_file():
            with path.open("rb") as file:
                found[word] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def stated(info: Mapping[str, int] | None) -> dict[str, Any] | None:
    """What a device says of itself, from the raw values of its CTRL_Info; None if it said nothing.

    Returns:
        Its firmware's version, its build and the protocol it was built for; None for what it leaves open.
    """
    if info is None:
        return None

    def known(*names: str) -> list[str] | None:
        open_ = any(info[name] == codec.choice("CTRL_Info", name, "SNA") for name in names)
        return None if open_ else [str(info[name]) for name in names]

    version, protocol = known("FirmwareMajor", "FirmwareMinor"), known("CtrlProtocolMajor", "CtrlProtocolMinor")
    build = known("FirmwareBuild")
    return {
        "version": None if version is None else ".".join(version),
        "build": None if build is None else int(build[0]),
        "protocol": None if protocol is None else ".".join(protocol),
    }
