"""From what was heard to a run folder."""

from typing import Any

from pumpbench.capture import Capture
from pumpbench.identity import stated
from pumpbench.rewind import Diverged, Origin, join
from pumpbench.runfolder import RunFolder


def write(
    folder: RunFolder, capture: Capture, info: dict[str, Any], *, complete: bool, origin: Origin | None = None
) -> None:
    """Analyse what was collected and write the run folder; an incomplete run keeps its `.partial` name.

    Raises:
        RunFolderError: the folder could not be written.
        Diverged: the run did not begin as its origin did; it keeps its `.partial` name too.
    """
    from pumpbench.outcome import measure  # noqa: PLC0415
    from pumpbench.trace import Trace  # noqa: PLC0415

    info = info | {"device": stated(capture.device_info())}
    frames = capture.finish()
    if not complete:
        folder.write_partial(frames, info)
        return
    if origin is not None:
        try:
            frames = join(origin, frames)
        except Diverged:
            folder.write_partial(frames, info)
            raise
    trace = Trace.from_frames(frames, info)
    folder.write_all(frames, info, measure(trace, frames), trace)
