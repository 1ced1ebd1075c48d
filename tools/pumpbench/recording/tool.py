"""Rerun's own program: the viewer and the tool box for its files."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path


class RecordingError(RuntimeError):
    """The recording could not be written or does not verify; the text says why."""


def rerun_binary() -> Path:
    """The viewer and tool box that comes with rerun-sdk (the `rerun` command itself is only a shim around it)."""
    import rerun_cli  # noqa: PLC0415

    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def quiet_environment(scratch: Path) -> dict[str, str]:
    """Environment for the Rerun binary: no analytics, no chatter.

    Args:
        scratch: an existing directory it may write its configuration to.
    """
    settings = scratch / "rerun" / "analytics.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    settings.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "none", "metadata": {}}))
    return os.environ | {"XDG_CONFIG_HOME": str(scratch), "RUST_LOG": "error", "NO_COLOR": "1"}


def rrd(arguments: list[str], environment: dict[str, str]) -> None:
    """Run `rerun rrd` with these arguments.

    Raises:
        RecordingError: it failed; the text has its last words.
    """
    result = subprocess.run(
        [rerun_binary(), "rrd", *arguments], env=environment, capture_output=True, text=True, check=False
    )
    if result.returncode:
        lines = (result.stderr or result.stdout).strip().splitlines() or ["no message"]
        raise RecordingError(f"rerun rrd {arguments[0]} failed: {lines[-1]}")
