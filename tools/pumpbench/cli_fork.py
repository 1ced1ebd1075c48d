"""What `pumpbench run --from` takes from the record and which options may change it, and the command `checkpoint`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pumpbench.terminal import EXIT_USAGE, Failed, console

if TYPE_CHECKING:
    from pumpbench.rig import Request

CHANGES = ("faults", "strategy", "scenario", "days", "firmware", "bus")
"""Options that say what is different from the instant on; not given, they are as recorded."""

RECORDED = (
    "patient",
    "seed",
    "sensor",
    "physiology",
    "pramlintide",
    "variability",
    "controller",
    "free_running",
    "speed",
)
"""Options of a run that nothing can change on its way."""


def forked(context: typer.Context, origin: str, out: Path | None, **more: Any) -> "Request":
    """The request of `pumpbench run --from ORIGIN`.

    Args:
        context: of the command, with its options.
        origin: RUN@TIME.
        out: the run folder to write; None: below runs/.
        more: how the run is done.

    Raises:
        Failed: an option that cannot be changed.
        ForkError, RunFolderError: see `pumpbench.fork`.
    """
    from can_bus.lockstep import STEPS_PER_DAY  # noqa: PLC0415
    from pumpbench import fork  # noqa: PLC0415

    given = {name: value for name, value in context.params.items() if _was_given(context, name)}
    for name in RECORDED:
        if name in given:
            raise Failed(
                EXIT_USAGE, f"--{name.replace('_', '-')} cannot change on the way: --from takes it from the record"
            )
    instant = fork.Instant.parse(origin)
    changes = {name: given[name] for name in CHANGES if name in given}
    if "days" in changes:
        changes["steps"] = round(changes.pop("days") * STEPS_PER_DAY)
    label = f"{Path(instant.name).name}-from-{instant.at}"
    return fork.fork(instant, out or Path("runs") / label, **changes, **more)


def _was_given(context: typer.Context, name: str) -> bool:
    """Whether an option stands on the command line; its default looks like any other value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def checkpoint(
    instant: Annotated[str, typer.Argument(metavar="RUN@TIME", help="A run folder, and hh:mm or days+hh:mm.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
) -> None:
    """Store an instant of a run: what led there, and the state of every node. Give the folder to run --from."""
    from pumpbench import checkpoint as checkpoints  # noqa: PLC0415
    from pumpbench import fork  # noqa: PLC0415

    checkpoints.take(fork.Instant.parse(instant), out)
    console.print(f"checkpoint of {instant}: {out}", soft_wrap=True)
