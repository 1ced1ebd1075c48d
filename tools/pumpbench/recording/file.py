"""The recording of a run as a file."""

from __future__ import annotations

import json
import tempfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from pumpbench.frames import Frames
from pumpbench.recording.columns import log_run
from pumpbench.recording.scene import PROPERTY, Scene
from pumpbench.recording.tool import RecordingError, quiet_environment, rrd
from pumpbench.story import title
from pumpbench.trace import Trace

APPLICATION: Final = "pumpbench"


def write_recording(trace: Trace, frames: Frames, path: Path, metrics: Mapping[str, Any] | None = None) -> None:
    """Write the run with its blueprint as an .rrd file, compacted and verified.

    Args:
        trace: the decoded run.
        frames: every frame of it.
        path: the file; overwritten.
        metrics: content of metrics.json, shown beside the run's data.

    Raises:
        RecordingError: Rerun could not write the file or does not accept it.
    """
    import rerun as rr  # noqa: PLC0415

    from pumpbench.recording.layout import blueprint  # noqa: PLC0415

    scene = Scene.of(trace, frames)

    def fill(recording: Any) -> None:
        recording.send_recording_name(title(trace.info))
        recording.send_property(PROPERTY, rr.AnyValues(json=scene.as_json()))
        log_run(recording, trace, frames, metrics)

    write_stream(path, _recording_id(trace, frames), blueprint(scene), fill)


def write_stream(path: Path, recording_id: str, look: Any, fill: Callable[[Any], None]) -> None:
    """Write an .rrd file, compacted and verified.

    Args:
        path: the file; overwritten.
        recording_id: the viewer joins recordings of one id.
        look: its blueprint.
        fill: logs everything into a `rerun.RecordingStream`.

    Raises:
        RecordingError: Rerun could not write the file or does not accept it.
    """
    import rerun as rr  # noqa: PLC0415

    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".recording-") as directory:
        raw, final = Path(directory) / "raw.rrd", Path(directory) / "recording.rrd"
        strict = rr.strict_mode()
        rr.set_strict_mode(True)  # else a value Rerun does not like is only a warning, and missing
        try:
            with rr.RecordingStream(APPLICATION, recording_id=recording_id) as recording:
                recording.save(raw, default_blueprint=look)
                rr.set_log_time_enabled(False, recording=recording)
                fill(recording)
                recording.flush(timeout_sec=60)
        except (RuntimeError, TypeError, ValueError) as error:
            raise RecordingError(f"Rerun could not write {path.name}: {error}") from error
        finally:
            rr.set_strict_mode(strict)
        environment = quiet_environment(Path(directory))
        rrd(["optimize", str(raw), "-o", str(final)], environment)
        rrd(["verify", str(final)], environment)
        final.replace(path)


def _recording_id(trace: Trace, frames: Frames) -> str:
    """The same run gets the same id; the viewer joins recordings of one id, so whatever differs must show in it."""
    about = zlib.crc32(json.dumps(trace.info, sort_keys=True, default=str).encode())
    return f"{frames.sha256()[:24]}-{about:08x}"
