"""Rerun's viewer for people: a window on this machine, or a page for a browser."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from pumpbench.recording.file import APPLICATION
from pumpbench.recording.page import served
from pumpbench.recording.scene import Scene, scene_of
from pumpbench.recording.tool import RecordingError, free_port, last_words, quiet_environment, rrd, viewer

WEB_PORT: Final = 9090
URL_SCHEMES: Final = ("rerun://", "rerun+http://", "rerun+https://")


class ViewerError(RuntimeError):
    """The viewer cannot show anything; the text says why."""


@contextlib.contextmanager
def readable(recording: Path) -> Iterator[Path]:
    """The recording, or a copy of it with the end that a killed writer could not write.

    Raises:
        RecordingError: it is none.
    """
    with tempfile.TemporaryDirectory() as scratch:
        environment = quiet_environment(Path(scratch))
        try:
            rrd(["verify", str(recording)], environment)
        except RecordingError:
            whole = Path(scratch) / recording.name
            try:
                rrd(["optimize", str(recording), "-o", str(whole)], environment)
                rrd(["verify", str(whole)], environment)
            except RecordingError as error:
                raise RecordingError(f"{recording} is no recording: {error}") from None
            recording = whole
        yield recording


def view(
    source: Path | str,
    *,
    layout: str = "day",
    window: tuple[float, float] | None = None,
    web: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Show a recording until the viewer is closed.

    Args:
        source: a recording, or the URL of one that is being made (`rerun+http://…`).
        layout: the tab in front: day, bus, patient or the name of a close-up.
        window: simulated seconds that the linked axes show at first; the whole run when left out.
        web: serve a page on 127.0.0.1 instead of opening a window.
        say: gets the page's address.

    Raises:
        LayoutError: there is no such layout.
        ViewerError: no display, or the viewer failed; the text says why.
    """
    from pumpbench.recording.layout import blueprint  # noqa: PLC0415

    if not web and sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        raise ViewerError("there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set): try --web, or a snapshot")
    with tempfile.TemporaryDirectory() as directory:
        scratch = Path(directory)
        arguments = ["--bind", "127.0.0.1", str(source)]
        if layout != "day" or window is not None:
            scene = scene_of(source) if isinstance(source, Path) else Scene()
            looks = scratch / "looks.rbl"
            blueprint(scene, layout, window).save(APPLICATION, looks)
            arguments.append(str(looks))
        page, data = free_port(), free_port()
        if web:
            arguments += ["--serve-web", "--web-viewer-port", str(page), "--port", str(data)]
        else:
            arguments += ["--port", "auto"]  # another viewer may be open
        with viewer(arguments, scratch) as process:
            if web and _listens(process, page):
                shown = f"rerun+http://127.0.0.1:{data}/proxy" if isinstance(source, Path) else source
                with served(f"http://127.0.0.1:{page}", shown, free_port(WEB_PORT)) as address:
                    say(address)
                    process.wait()
            if process.wait():
                raise ViewerError(f"Rerun's viewer ended with status {process.returncode}: {last_words(scratch)}")


def _listens(process: subprocess.Popen[bytes], port: int) -> bool:
    """Wait until somebody listens on a port, or the process that should has ended."""
    while process.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return True
        time.sleep(0.05)
    return False
