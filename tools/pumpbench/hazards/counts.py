"""The hazards by name, and how often each was found."""

from collections.abc import Mapping
from typing import Final, Protocol

NAMES: Final[Mapping[str, str]] = {
    "H1": "a bolus delivered twice, or after its expiry",
    "H2": "any dose above the limits of either side",
    "H3": "dosing on a CGM sample that is stale, repeated, failed its E2E check or is implausible",
    "H4": "insulin above the schedule when the last usable CGM sample is older than 15 min (age 4..6 steps), anything "
    "but the schedule from age 7 on, pramlintide while insulin is suspended",
    "H5": "a new bolus while an earlier one is uncertain",
    "H6": "an unaccounted stroke: commanded = delivered + pending + lost, per drug, at every step",
    "H7": "a silent failure: a node dead, a frame lost or a limit hit that no alarm and no counter shows",
    "H8": "state lost over a reset: another mode, a meal forgotten, or insulin on board that fell faster than insulin "
    "can",
}
"""What each hazard is, in the words of docs/design.md."""


class Counter(Protocol):
    """Where what was found is counted."""

    def count(self, name: str, found: bool = True) -> None:
        """Count a hazard, if it was found."""


class Hazards(dict[str, int]):
    """Counts by name.

    Attributes:
        step: sampling instant now.
        found: the instant and the name of every one, in order.
    """

    def __init__(self) -> None:
        super().__init__(dict.fromkeys(NAMES, 0))
        self.step = -1
        self.found: list[tuple[int, str]] = []

    def count(self, name: str, found: bool = True) -> None:
        """Count a hazard of this instant, if it was found."""
        if found:
            self[name] += 1
            self.found.append((self.step, name))


class Only:
    """A part of the counts: what else is counted through it is nobody's."""

    def __init__(self, hazards: Hazards, *names: str) -> None:
        self._hazards = hazards
        self._names = names

    def count(self, name: str, found: bool = True) -> None:
        """Count a hazard, if it was found and is one of the names."""
        self._hazards.count(name, found and name in self._names)
