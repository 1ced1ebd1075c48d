"""The commands that show a recording: in Rerun's viewer, or as pictures."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pumpbench.cli.terminal import EXIT_DEAD, EXIT_USAGE, Failed, console, errors

if TYPE_CHECKING:
    from pumpbench.recording.scene import Scene

    Window = tuple[float, float]

RUN = "A run folder or an .rrd file"
LAYOUT = "The tab in front: day, bus, patient, or the name of a close-up."
AROUND_S = (-3600, 7200)
"""What --at shows, in simulated seconds around the time: what was normal, and what came of it."""


def view(
    run: Annotated[
        str | None,
        typer.Argument(help=f"{RUN}, or rerun+http://... of one being made (default: the newest below runs/)."),
    ] = None,
    layout: Annotated[str | None, typer.Option(help=LAYOUT)] = None,
    at: Annotated[
        str | None, typer.Option(help="From an hour before this time to two after: 02:00 or 1+02:00.")
    ] = None,
    fault: Annotated[int | None, typer.Option(help="Show close-up N, of faults and alarms.", min=1)] = None,
    web: Annotated[bool, typer.Option(help="Serve a page on 127.0.0.1 and print its address; Ctrl-C ends it.")] = False,
) -> None:
    """Open a recording in Rerun's viewer. Exit status 3 if the viewer fails."""
    from pumpbench.recording import viewing  # noqa: PLC0415
    from pumpbench.recording.scene import scene_of  # noqa: PLC0415

    if fault is not None and (layout is not None or at is not None):
        raise Failed(EXIT_USAGE, "--fault has its own layout and window: give --layout and --at without it")
    target = str(_newest()) if run is None else run
    try:
        if target.startswith(viewing.URL_SCHEMES):
            if fault is not None or (web and (layout or at)):
                raise Failed(
                    EXIT_USAGE, f"{target} is being made and has its own looks: no --fault, nor others with --web"
                )
            _show(target, layout or "day", _around(at, None), web)
            return
        with viewing.readable(_recording(Path(target))) as recording:
            scene = scene_of(recording)
            chosen = (layout or "day") if fault is None else _close_up(scene, fault)
            _show(recording, chosen, _around(at, scene), web)
    except viewing.ViewerError as error:
        raise Failed(EXIT_DEAD, str(error)) from None
    except ValueError as error:  # no such layout, or no recording of ours
        raise Failed(EXIT_USAGE, str(error)) from None


def snapshot(
    run: Annotated[Path, typer.Argument(help=f"{RUN}.")],
    out: Annotated[
        Path | None, typer.Option(help="PNG to write; with --faults a folder (default: in the run folder).")
    ] = None,
    layout: Annotated[str, typer.Option(help=LAYOUT)] = "day",
    view: Annotated[str | None, typer.Option(help='Only this view of the tab, as "Glucose [mg/dL]".')] = None,
    window: Annotated[str | None, typer.Option(help="Simulated time, 01:30-03:30 or 1+01:30-1+03:30.")] = None,
    faults: Annotated[bool, typer.Option(help="A picture of each close-up: of every fault and alarm.")] = False,
) -> None:
    """Draw a recording without a display: by Rerun's viewer where a Vulkan driver is, else by Matplotlib."""
    from pumpbench.recording import snapshot as pictures  # noqa: PLC0415
    from pumpbench.recording.scene import scene_of  # noqa: PLC0415
    from pumpbench.recording.viewing import readable  # noqa: PLC0415

    if faults and (layout != "day" or view is not None or window is not None):
        raise Failed(
            EXIT_USAGE, "--faults has its own layout and windows: give --layout, --view and --window without it"
        )
    source = _recording(run)
    try:
        with readable(source) as recording:
            scene = scene_of(recording)
            if faults:
                shots = pictures.close_up_shots(scene, out or source.parent)
            else:
                name = f"{layout.replace(':', '').replace(' ', '-')}.png"
                shots = [pictures.Shot(out or source.parent / name, layout, _window(window, scene), view)]
            if not shots:
                console.print("no fault and no alarm: nothing to draw")
                return
            how = pictures.snapshot(recording, shots, run=source.parent)
    except pictures.NoViewer as error:
        raise Failed(EXIT_DEAD, f"a single view needs Rerun's viewer, which cannot draw here: {error}") from None
    except ValueError as error:
        raise Failed(EXIT_USAGE, str(error)) from None
    errors.print(how, markup=False)
    for shot in shots:
        console.print(str(shot.path), markup=False, soft_wrap=True)


def _show(source: Path | str, layout: str, window: "Window | None", web: bool) -> None:
    from pumpbench.recording import viewing  # noqa: PLC0415

    if web:
        viewing.serve_page(source, _say, layout=layout, window=window)
    else:
        viewing.open_window(source, layout=layout, window=window)


def _say(address: str) -> None:
    console.print(address, markup=False, soft_wrap=True)


def _newest() -> Path:
    runs = [path.parent for path in Path("runs").glob("*/recording.rrd")]
    if not runs:
        raise Failed(EXIT_USAGE, "there is no run below runs/: name a run folder or a recording")
    return max(runs, key=lambda path: path.stat().st_mtime)


def _recording(path: Path) -> Path:
    """The recording of what was named; what a killed recorder left is made readable first."""
    from pumpbench.recorder.journal import NAMES  # noqa: PLC0415
    from pumpbench.recorder.repair import repair  # noqa: PLC0415
    from pumpbench.runfolder import PARTIAL, RECORDING, RunFolder  # noqa: PLC0415

    if path.is_file():
        return path
    if path.name.endswith(PARTIAL) and any((path / name).exists() for name in NAMES):
        repair(path)
        errors.print(f"{path}: its recorder did not come to its end; the recording was made of what it had heard")
    if (path / RECORDING).is_file():
        return path / RECORDING
    return RunFolder.load(path).recording  # says what is missing


def _close_up(scene: "Scene", number: int) -> str:
    names = [closeup.name for closeup in scene.close_ups]
    if number > len(names):
        known = "; ".join(f"{each} is {name}" for each, name in enumerate(names, 1))
        raise Failed(EXIT_USAGE, f"there is no close-up {number}: {known or 'the run had no fault and no alarm'}")
    return names[number - 1]


def _around(at: str | None, scene: "Scene | None") -> "Window | None":

    if at is None:
        return None
    time_s = _time("--at", at)
    return _inside((time_s + AROUND_S[0], time_s + AROUND_S[1]), f"--at {at}", scene)


def _window(text: str | None, scene: "Scene") -> "Window | None":
    if text is None:
        return None
    first, dash, last = text.partition("-")
    if not dash:
        raise Failed(EXIT_USAGE, f"--window {text}: it is from-to, as 01:30-03:30")
    window = _time("--window", first), _time("--window", last)
    if window[0] >= window[1]:
        raise Failed(EXIT_USAGE, f"--window {text}: it ends before it begins")
    return _inside(window, f"--window {text}", scene)


def _time(option: str, text: str) -> float:
    from can_bus.faults import seconds  # noqa: PLC0415

    try:
        return float(seconds(text))
    except ValueError as error:
        raise Failed(EXIT_USAGE, f"{option} {text}: {error}") from None


def _inside(window: "Window", option: str, scene: "Scene | None") -> "Window":
    """The part of a window that the run has."""
    from can_bus.faults import clock  # noqa: PLC0415

    if scene is None:
        return max(window[0], 0.0), window[1]
    found = max(window[0], scene.start_s), min(window[1], scene.end_s)
    if found[0] >= found[1]:
        first, last = (clock(int(time_s)) for time_s in (scene.start_s, scene.end_s))
        raise Failed(EXIT_USAGE, f"{option}: the run is from {first} to {last}")
    return found
