"""Pictures of a recording on a machine without a display.

Rerun's own viewer draws them off-screen when there is a Vulkan driver (Mesa's lavapipe will do: `apt-get install
mesa-vulkan-drivers`, or `tools/with_browser -- COMMAND`); otherwise Matplotlib draws the same from the run's folder.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pumpbench.files import write_file
from pumpbench.recording.columns import TIMELINE
from pumpbench.recording.scene import Scene, scene_of
from pumpbench.recording.still import draw_still
from pumpbench.recording.tool import free_port, last_words, viewer

if TYPE_CHECKING:
    from pumpbench.recording.layout import Blueprint

SETTLE_SECONDS: Final = 1.0
"""Wall time the viewer gets after loading: tables find their column widths while it draws."""


class NoViewer(RuntimeError):
    """Rerun's viewer cannot draw here; the text says why."""


@dataclass(frozen=True)
class Shot:
    """A picture to be taken.

    Attributes:
        path: the PNG; overwritten.
        layout: the tab: day, bus, patient, or the name of a close-up.
        window: simulated seconds from, to; the whole run, or the close-up's own, when left out.
        view: name of one view of that tab, to draw nothing else.
    """

    path: Path
    layout: str = "day"
    window: tuple[float, float] | None = None
    view: str | None = None


def close_up_shots(scene: Scene, folder: Path) -> list[Shot]:
    """A picture of each close-up of a run, named after what happened in it."""
    return [Shot(folder / closeup.file_name(number), closeup.name) for number, closeup in enumerate(scene.close_ups, 1)]


def snapshot(
    rrd: Path,
    shots: list[Shot],
    *,
    run: Path | None = None,
    size: tuple[int, int] = (1600, 1000),
    timeout: float = 60,
) -> str:
    """Draw pictures of a recording.

    Args:
        rrd: the recording.
        shots: the pictures.
        run: the run folder, for Matplotlib; that of the recording when left out.
        size: width and height of the viewer's window in pixels; Matplotlib's are 1600 x 1000.
        timeout: seconds of wall clock for the viewer to start and load.

    Returns:
        How they were drawn, in words, and what the viewer could not show.

    Raises:
        OSError: no such recording, or neither a viewer nor a run to draw from, or a picture cannot be written.
        NoViewer: a single view is asked for, which only Rerun's viewer can draw, and it cannot.
        ValueError: the recording is none of ours, or there is no such layout or view.
    """
    from pumpbench.recording.layout import blueprint  # noqa: PLC0415

    if not rrd.is_file():
        raise FileNotFoundError(f"{rrd} is missing")
    scene = scene_of(rrd)
    looks = [blueprint(scene, shot.layout, shot.window, shot.view) for shot in shots]
    complaints: list[str] = []
    try:
        with _loaded(rrd.resolve(), size, timeout) as drawing:
            for shot, look in zip(shots, looks, strict=True):
                closeups = {each.name: each.start_s for each in scene.close_ups}
                cursor_s = shot.window[0] if shot.window else closeups.get(shot.layout, scene.start_s)
                picture, said = drawing.draw(look, cursor_s)
                write_file(shot.path, picture)
                complaints += said
    except NoViewer as error:
        for shot in shots:
            if shot.view is not None:
                raise
            draw_still(run or rrd.parent, scene, shot.path, shot.layout, shot.window)
        return f"drawn by Matplotlib, because Rerun's viewer cannot draw here: {error}"
    return "; ".join(["drawn by Rerun's viewer, off-screen", *complaints])


class _Viewer:
    """A viewer without a window, and the recording it has loaded."""

    def __init__(self, process: subprocess.Popen[bytes], scratch: Path, deadline: float) -> None:
        self._process, self._scratch, self._deadline = process, scratch, deadline
        self._client: Any = None

    def connect(self, port: int) -> None:
        """Wait until it answers and the recording is loaded."""
        try:
            from rerun.experimental import ViewerClient  # noqa: PLC0415
        except ImportError as error:
            raise NoViewer(f"this version of rerun-sdk has no ViewerClient: {error}") from error
        while True:
            self._check()
            try:
                with socket.create_connection(("127.0.0.1", port), timeout=1):
                    pass
                self._client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                state = self._client.get_state()
                if state.active_recording and not state.loading and state.views:
                    return
            except (OSError, RuntimeError):
                pass
            time.sleep(0.05)

    def draw(self, look: Blueprint, cursor_s: float) -> tuple[bytes, list[str]]:
        """A PNG of the window with these looks, and what their views complain about."""
        from pumpbench.recording.layout import views  # noqa: PLC0415

        wanted = {str(view.id) for view in views(look.root_container)}
        try:
            # the viewer has given the application of a file a name of its own: Recording:NAME:id
            application = self._client.get_state().active_recording.split(":")[1]
            look.connect_grpc(application, url=self._client.url, make_default=False)
            while {view.view_id for view in self._client.get_state().views} != wanted:
                self._check()
                time.sleep(0.05)
            self._client.set_time(TIMELINE, duration=cursor_s)  # the tables scroll there
            time.sleep(SETTLE_SECONDS)
            picture: bytes = self._client.take_screenshot()
            shown = self._client.get_state().views
        except (RuntimeError, ConnectionError) as error:
            raise NoViewer(f"it took no screenshot: {error}") from error
        return picture, [f"view {view.name}: {report.summary}" for view in shown for report in view.reports]

    def _check(self) -> None:
        if self._process.poll() is not None:
            raise NoViewer(f"it ended with status {self._process.returncode}: {last_words(self._scratch)}")
        if time.monotonic() > self._deadline:
            raise NoViewer("it did not show the recording in time")


@contextlib.contextmanager
def _loaded(rrd: Path, size: tuple[int, int], timeout: float) -> Iterator[_Viewer]:
    port = free_port()
    arguments = ["--headless", "--port", str(port), "--bind", "127.0.0.1", "--memory-limit", "2GB"]
    arguments += ["--window-size", f"{size[0]}x{size[1]}", str(rrd)]
    with tempfile.TemporaryDirectory() as scratch, viewer(arguments, Path(scratch)) as process:
        drawing = _Viewer(process, Path(scratch), time.monotonic() + timeout)
        drawing.connect(port)
        yield drawing
