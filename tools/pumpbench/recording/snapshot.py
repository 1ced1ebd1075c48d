"""A picture of a recording on a machine without a display.

Rerun's own viewer draws it off-screen when there is a Vulkan driver (Mesa's lavapipe will do: `apt-get install
mesa-vulkan-drivers`); otherwise Matplotlib draws the run's summary from the trace beside the recording.
"""

from __future__ import annotations

import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from pumpbench.recording.columns import TIMELINE
from pumpbench.recording.file import APPLICATION
from pumpbench.recording.layout import blueprint
from pumpbench.recording.tool import quiet_environment, rerun_binary
from pumpbench.summary import write_summary
from pumpbench.trace import Trace

SETTLE_SECONDS: Final = 1.0
"""Wall time the viewer gets after loading: tables find their column widths while it draws."""


class NoViewer(RuntimeError):
    """Rerun's viewer cannot draw here; the text says why."""


def snapshot(
    rrd_path: Path,
    png_path: Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    view: str | None = None,
    window: tuple[float, float] | None = None,
    timeout: float = 60,
) -> str:
    """Draw a recording into a PNG.

    Args:
        rrd_path: the recording; for the fallback its folder also holds the trace.
        png_path: the picture; overwritten.
        size: width and height of the viewer's window in pixels.
        view: name of one view to draw instead of the whole window.
        window: simulated seconds from, to; the whole run when left out.
        timeout: seconds of wall clock for the viewer.

    Returns:
        How it was drawn, in words, and what the viewer could not show.

    Raises:
        FileNotFoundError: no such recording, or neither a viewer nor a trace to draw from.
        ValueError: no view of that name.
    """
    if not rrd_path.is_file():
        raise FileNotFoundError(f"{rrd_path} is missing")
    try:
        complaints = _draw(rrd_path.resolve(), png_path.resolve(), size, view, window, timeout)
    except NoViewer as error:
        trace = Trace.load(rrd_path.parent)
        write_summary(trace if window is None else trace.between(*window), png_path)
        return f"drawn by Matplotlib, because Rerun's viewer cannot draw here: {error}"
    return "; ".join(["drawn by Rerun's viewer, off-screen", *complaints])


def _draw(
    rrd: Path,
    png: Path,
    size: tuple[int, int],
    view: str | None,
    window: tuple[float, float] | None,
    timeout: float,
) -> list[str]:
    deadline = time.monotonic() + timeout
    port = _free_port()
    with tempfile.TemporaryDirectory() as scratch:
        arguments = ["--headless", "--port", str(port), "--bind", "127.0.0.1", "--memory-limit", "2GB"]
        files = [str(rrd)]
        if window is not None:
            layout = Path(scratch) / "window.rbl"
            blueprint(*window, gateway=True).save(APPLICATION, layout)
            files.append(str(layout))
        errors = Path(scratch) / "stderr"
        with errors.open("wb") as sink:
            viewer = subprocess.Popen(
                [rerun_binary(), *arguments, "--window-size", f"{size[0]}x{size[1]}", *files],
                env=quiet_environment(Path(scratch)),
                stdout=subprocess.DEVNULL,
                stderr=sink,
            )
        try:
            client = _connect(viewer, port, errors, deadline)
            state = _loaded(client, viewer, errors, deadline)
            chosen = None
            if view is not None:
                chosen = next((shown.view_id for shown in state.views if shown.name == view), None)
                if chosen is None:
                    raise ValueError(f"no view {view!r}; there are {', '.join(shown.name for shown in state.views)}")
            if window is not None:
                client.set_time(TIMELINE, duration=window[0])  # the tables scroll there
            time.sleep(SETTLE_SECONDS)
            try:
                png.write_bytes(client.take_screenshot(chosen))
                views = client.get_state().views
                return [f"view {shown.name}: {report.summary}" for shown in views for report in shown.reports]
            except (RuntimeError, ConnectionError) as error:
                raise NoViewer(f"it took no screenshot: {error}") from error
        finally:
            viewer.terminate()
            try:
                viewer.wait(5)
            except subprocess.TimeoutExpired:
                viewer.kill()
                viewer.wait()


def _connect(viewer: subprocess.Popen[bytes], port: int, errors: Path, deadline: float) -> Any:
    try:
        from rerun.experimental import ViewerClient  # noqa: PLC0415
    except ImportError as error:
        raise NoViewer(f"this version of rerun-sdk has no ViewerClient: {error}") from error
    while True:
        _check(viewer, errors, deadline)
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=1):
                pass
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
            return client
        except (OSError, RuntimeError):
            time.sleep(0.05)


def _loaded(client: Any, viewer: subprocess.Popen[bytes], errors: Path, deadline: float) -> Any:
    """The viewer's state once the recording and its blueprint are there."""
    while True:
        _check(viewer, errors, deadline)
        try:
            state = client.get_state()
        except (RuntimeError, ConnectionError):
            time.sleep(0.05)
            continue
        if state.active_recording and not state.loading and state.views:
            return state
        time.sleep(0.05)


def _check(viewer: subprocess.Popen[bytes], errors: Path, deadline: float) -> None:
    if viewer.poll() is not None:
        text = errors.read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if "graphics" in line or "adapter" in line]
        reason = lines[-1] if lines else (text.strip().splitlines() or ["no message"])[-1]
        raise NoViewer(f"it ended with status {viewer.returncode}: {reason}")
    if time.monotonic() > deadline:
        raise NoViewer("it did not show the recording in time")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
