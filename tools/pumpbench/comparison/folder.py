"""A comparison kept: report.txt, report.json, comparison.rrd for Rerun's viewer, and comparison.png."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pumpbench.comparison.report import Report
from pumpbench.files import write_file

TEXT: Final = "report.txt"
DATA: Final = "report.json"
RECORDING: Final = "comparison.rrd"
PICTURE: Final = "comparison.png"


def write(report: Report, out: Path) -> None:
    """Write all four into a folder, which is made; files of these names are replaced.

    Raises:
        OSError: the disk is full, or the folder or Rerun's file in it cannot be written.
    """
    from pumpbench.comparison.picture import write_picture  # noqa: PLC0415
    from pumpbench.recording.comparison import write_comparison  # noqa: PLC0415
    from pumpbench.recording.tool import RecordingError  # noqa: PLC0415

    out.mkdir(parents=True, exist_ok=True)
    write_file(out / TEXT, f"{report.text()}\n".encode())
    write_file(out / DATA, report.json().encode())
    try:
        write_comparison(report, out / RECORDING)
    except RecordingError as error:
        raise OSError(f"cannot write {out / RECORDING}: {error}") from error
    write_picture(report, out / PICTURE)


def told(out: Path) -> str:
    """Where the recording and the picture are, for who reads the text on a terminal."""
    return f"recording: {out / RECORDING}   picture: {out / PICTURE}"
