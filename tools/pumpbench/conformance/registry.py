"""What a check is, and the list of them."""

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

from can_bus.faults.nodes import MemoryState
from can_bus.frame import Frame
from pumpbench.conformance.device import Device
from pumpbench.conformance.driver import NMA, Bench
from pumpbench.conformance.loop import Loop
from pumpbench.conformance.settings import Settings

Need = Literal["nma", "sma", "ma", "s1", "s2", "s3", "s4", "boluses", "pramlintide", "restart", "nvm", "memory", "uds"]
"""What a check can need of a device: a mode, any mode with boluses or with pramlintide, that it can be started anew,
that it keeps a memory meanwhile, that this can be erased or torn from outside, UDS."""

MEALTIME: tuple[Need, ...] = ("ma", "s3", "sma", "s4")
"""Modes that answer a meal with a bolus of insulin, any of which is what "boluses" needs."""


class NotOffered(Exception):
    """The device turns out, within a check, not to have what it takes; the text says what. No failure."""


class Dut:
    """The device under test as a check sees it.

    Attributes:
        settings: thresholds.
        offers: what this device can do.
        long: whether there is time for the long form of a check.
    """

    def __init__(self, device: Device, settings: Settings, offers: frozenset[Need], *, long: bool = False) -> None:
        self._device = device
        self.settings = settings
        self.offers = offers
        self.long = long
        self.record: Callable[[], Sequence[Frame]] = list

    def bench(self, **how: Any) -> Bench:
        """The device on a bench of its own, driven frame by frame: roll call and calibration are done; see `Bench`."""
        self._device.renew()
        bench = Bench(self._device, **how | {"start": False})
        self.record = lambda: bench.log
        if how.get("start", True):
            bench.call_roll()
            bench.configure(bench.flash, how.get("mode", NMA))
        return bench

    def loop(self, strategy: str, meals: Sequence[tuple[int, float]] = (), steps: int = 48, **how: Any) -> Loop:
        """The device with a whole plant around it, not yet running; see `Loop`."""
        self._device.renew()
        loop = Loop(self._device, strategy, meals, steps, **how)
        log: list[Frame] = []
        self.record = lambda: log
        loop.watch = log.extend
        return loop

    def require(self, *needs: Need) -> None:
        """Go on with what only some devices can be asked for; the rest of the check was for all.

        Raises:
            NotOffered: the device does not have all of these.
        """
        missing = [need for need in needs if need not in self.offers]
        if missing:
            raise NotOffered(", ".join(missing))

    def restart(self, memory: MemoryState = "kept") -> Sequence[Frame]:
        """Cut the device's power and give it back; what it says by itself. Only for checks that need `restart`."""
        return self._device.restart(memory)


class Check(NamedTuple):
    """One check of one requirement.

    Attributes:
        requirement: its id.
        run: raises `Violation` when the requirement does not hold.
        needs: without all of these it does not apply.
        how: what it does, in words.
    """

    requirement: str
    run: Callable[[Dut], None]
    needs: tuple[Need, ...]
    how: str


_found: dict[str, Check] = {}


def check(requirement: str, *, needs: Sequence[Need] = ()) -> Callable[[Callable[[Dut], None]], Callable[[Dut], None]]:
    """Register a function as the check of a requirement; its docstring says what it does."""

    def register(function: Callable[[Dut], None]) -> Callable[[Dut], None]:
        if requirement in _found:
            raise ValueError(f"{requirement} has two checks: {_found[requirement].run.__name__}, {function.__name__}")
        how = " ".join(inspect.cleandoc(function.__doc__ or "").split())
        _found[requirement] = Check(requirement, function, tuple(needs), how)
        return function

    return register


@functools.cache
def checks() -> dict[str, Check]:
    """All checks by the id of their requirement."""
    from pumpbench.conformance import checks as package  # noqa: PLC0415

    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
    return _found
