"""Rerun's own program: the viewer and the tool box for its files."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
from collections.abc import Iterator
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
    content = {"analytics_enabled": False, "analytics_id": "none", "metadata": {}}
    places = {"config_file_path": str(settings), "data_dir_path": str(settings.parent)}  # without them it is not read
    settings.write_text(json.dumps(content | places))
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


@contextlib.contextmanager
def viewer(arguments: list[str], scratch: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's process, which does not outlive this; `last_words(scratch)` has what it complained about."""
    with (scratch / "stderr").open("wb") as sink:
        process = subprocess.Popen(
            [rerun_binary(), *arguments], env=quiet_environment(scratch), stdout=subprocess.DEVNULL, stderr=sink
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def last_words(scratch: Path) -> str:
    """Why the viewer ended, in a line."""
    lines = [line.strip() for line in (scratch / "stderr").read_text(errors="replace").splitlines() if line.strip()]
    telling = [line for line in lines if "panicked" in line or line.startswith("Error")]
    return (telling or lines[-1:] or ["no message"])[0]


def free_port(preferred: int = 0) -> int:
    """A port of this machine that nobody listens on, the preferred one if that is so."""
    for port in (preferred, 0):
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            found: int = probe.getsockname()[1]
            return found
    raise RecordingError("no port of 127.0.0.1 is free")
