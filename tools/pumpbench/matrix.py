"""Every entry of the catalogue in every mode with many seeds: nothing dangerous happens, what can be seen is seen."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from plant_server.physiology import cohort
from pumpbench import probe
from pumpbench.calibration import MODES
from pumpbench.catalogue import Entry, entries
from pumpbench.parallel import in_parallel
from pumpbench.probe import Probe, Verdict

RUNS_TO_TELL = 7
"""Runs of an entry from which on what shows in all of them is no chance."""


class Cell(NamedTuple):
    """One run of the matrix."""

    entry: Entry
    mode: str
    seed: int
    verdict: Verdict

    @property
    def missed(self) -> tuple[str, ...]:
        """Signs that the entry says it is seen by, and that this run, in which it acted, did not show."""
        if not self.verdict.injected or self.mode not in self.entry.modes:
            return ()
        return tuple(sign for sign in self.entry.seen_by if sign not in self.verdict.signs)

    @property
    def wrong(self) -> str:
        """What is wrong with this run, in words; or ""."""
        verdict = self.verdict
        if verdict.error:
            return verdict.error
        if verdict.hazards:
            return f"hazards {verdict.hazards}, the first in step {verdict.first[0]}" if verdict.first else "hazards"
        if self.missed:
            return f"not seen: {', '.join(self.missed)}; found {', '.join(sorted(verdict.signs)) or 'nothing'}"
        return ""


def run(
    seeds: int,
    modes: Sequence[str] = tuple(MODES),
    chosen: Sequence[Entry] | None = None,
    jobs: int = 1,
    told: Callable[[int, int], None] = lambda done, total: None,
) -> list[Cell]:
    """Run the matrix: seed s has patient s of the ten adults, and every entry meets the same patients and noise.

    Args:
        seeds: 1 to so many.
        modes: of the controller.
        chosen: entries; None for all.
        jobs: processes.
        told: called with the runs done and their number.
    """
    adults = [name for name in cohort() if name.startswith("adult")]
    places = [
        (entry, mode, seed)
        for mode in modes
        for seed in range(1, seeds + 1)
        for entry in (entries() if chosen is None else chosen)
    ]
    probes = [
        Probe(adults[(seed - 1) % len(adults)], mode, seed, faults=(entry.fault,)) for entry, mode, seed in places
    ]
    verdicts = in_parallel(probe.judge, probes, jobs, lambda done: told(done, len(probes)))
    return [Cell(*place, verdict) for place, verdict in zip(places, verdicts, strict=True)]


def outdated(cells: Sequence[Cell]) -> dict[str, set[str]]:
    """Entries that nothing is said to show, and the signs that show them in every run all the same."""
    found = {}
    for entry in {cell.entry.name: cell.entry for cell in cells}.values():
        signs = [cell.verdict.signs for cell in cells if cell.entry.name == entry.name and cell.verdict.injected]
        always = set.intersection(*map(set, signs)) if len(signs) >= RUNS_TO_TELL and entry.unseen else set()
        if always:
            found[entry.name] = always
    return found


def table(cells: Sequence[Cell]) -> str:
    """The matrix as Markdown: one row per entry."""
    lines = [
        "| fault | puts to the test | runs it acted in | hazards | seen by, in how many of them |",
        "|---|---|---:|---:|---|",
    ]
    for entry in dict.fromkeys(cell.entry.name for cell in cells):
        of = [cell for cell in cells if cell.entry.name == entry]
        acted = [cell.verdict for cell in of if cell.verdict.injected]
        hazards = sum(sum(cell.verdict.hazards.values()) for cell in of) + sum(bool(cell.verdict.error) for cell in of)
        counts = probe.signs_of(acted)
        seen = ", ".join(f"{sign} {'all' if count == len(acted) else count}" for sign, count in counts.items())
        reason = f"nobody: {of[0].entry.unseen}" if of[0].entry.unseen else "nobody"
        lines.append(
            f"| {entry} | {', '.join(of[0].entry.hazards)} | {len(acted)} of {len(of)} | {hazards} | {seen or reason} |"
        )
    return "\n".join(lines) + "\n"


def page(cells: Sequence[Cell]) -> str:
    """The matrix as a page of docs."""
    modes, seeds = ({cell.mode for cell in cells}, {cell.seed for cell in cells})
    wrong = sum(bool(cell.wrong) for cell in cells)
    return f"""# The matrix of faults

Written by `pumpbench matrix --seeds {len(seeds)} --markdown docs/fault-matrix.md`: every entry of the catalogue
([faults.md](faults.md)) in {len(modes)} modes with {len(seeds)} seeds over ten patients, six hours, three meals each,
on the reference firmware: {len(cells)} runs, of which {wrong} were wrong: a hazard, a run that broke off, or a fault
that was not seen by what should see it. "Seen by" are alarms of the device (CTRL) or of the pump (PUMP) and counters of
CTRL_Diag that the same run without the fault does not have.

""" + table(cells)
