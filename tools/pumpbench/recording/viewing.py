"""Rerun's viewer for people: a window on this machine, or a page for a browser."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

from pumpbench.recording.file import APPLICATION
from pumpbench.recording.page import Page
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


def open_window(source: Path | str, *, layout: str = "day", window: tuple[float, float] | None = None) -> None:
    """Show a recording in the native viewer until it is closed.

    Args:
        source: a recording, or the URL of one that is being made (`rerun+http://…`).
        layout: the tab in front: day, bus, patient or the name of a close-up.
        window: simulated seconds that the linked axes show at first; the whole run when left out.

    Raises:
        LayoutError: there is no such layout.
        ViewerError: no display, or the viewer failed; the text says why.
    """
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        raise ViewerError("there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set): try --web, or a snapshot")
    with tempfile.TemporaryDirectory() as directory:
        scratch = Path(directory)
        arguments = ["--bind", "127.0.0.1", "--port", "auto"]  # another viewer may be open
        with viewer([*arguments, *_sources(source, scratch, layout, window)], scratch) as process:
            _wait(process, scratch)


def serve_page(
    source: Path | str,
    say: Callable[[str], None],
    *,
    layout: str = "day",
    window: tuple[float, float] | None = None,
) -> None:
    """Serve a recording and a page that shows it, on 127.0.0.1, until a signal ends it.

    Args:
        source, layout, window: as of `open_window`; the URL is one of this machine, and brings its own layout.
        say: gets the page's address when it is there.

    Raises:
        LayoutError: there is no such layout, or it is not ours to choose.
        ViewerError: the server failed; the text says why.
        RecordingError: Rerun does not give its page.
    """
    with tempfile.TemporaryDirectory() as directory, contextlib.ExitStack() as stack:
        scratch = Path(directory)
        process = None
        if isinstance(source, Path):
            data = free_port()
            arguments = ["--serve-grpc", "--bind", "127.0.0.1", "--port", str(data)]
            process = stack.enter_context(viewer([*arguments, *_sources(source, scratch, layout, window)], scratch))
            _wait(process, scratch, until_port=data)
            source = f"rerun+http://127.0.0.1:{data}/proxy"
        parts = urlsplit(source)
        if parts.hostname not in ("127.0.0.1", "localhost") or parts.port is None:
            raise ViewerError(f"{source}: a page shows what is served on 127.0.0.1, with its port")
        port = free_port(WEB_PORT)
        stack.enter_context(contextlib.closing(Page(port, parts.port)))
        say(f"http://127.0.0.1:{port}/?url={quote(source, safe='')}")
        if process is None:
            threading.Event().wait()
        else:
            _wait(process, scratch)


def _sources(source: Path | str, scratch: Path, layout: str, window: tuple[float, float] | None) -> list[str]:
    """What the viewer is to open: the recording and, if not as they are in it, the looks."""
    from pumpbench.recording.layout import blueprint  # noqa: PLC0415

    if layout == "day" and window is None:
        return [str(source)]
    scene = scene_of(source) if isinstance(source, Path) else Scene()
    looks = scratch / "looks.rbl"
    blueprint(scene, layout, window).save(APPLICATION, looks)
    return [str(source), str(looks)]


def _wait(process: subprocess.Popen[bytes], scratch: Path, until_port: int | None = None) -> None:
    """Wait until the process has ended or, with a port, until it listens there."""
    while until_port is not None and process.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", until_port), timeout=1):
            return
        time.sleep(0.05)
    if process.wait():
        raise ViewerError(f"Rerun's viewer ended with status {process.returncode}: {last_words(scratch)}")
