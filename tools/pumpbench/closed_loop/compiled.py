"""The firmware's control core, compiled: the source of `firmware_sim.control` as machine code, for campaigns.

The firmware is plain Python and knows nothing of numba. Here its functions get a compiled twin, made from the same code
objects: every function is given a copy of its module's globals in which the functions it calls are compiled already.
The modules themselves stay as they are, so a plain firmware and a compiled core can run beside each other.
"""

import functools
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt

from firmware_sim.control import core

Words = npt.NDArray[np.int64]

Function = TypeVar("Function", bound=Callable[..., Any])

_ROOM = "firmware_sim.control"


def helper(function: Function) -> Function:
    """Compile a function that only compiled code calls; it becomes a part of its caller, on disk too."""
    return cast(Function, numba.njit(function))


def kept_on_disk(sources: Iterable[Path]) -> Callable[[Function], Function]:
    """Compile a function that Python calls, and keep its machine code beside its source for the next process.

    numba compiles again when that one file changes, but the code of everything the function calls, and the value of
    every constant, lies in it too: it is good for just these bytes of all of `sources` (files, or folders of them).
    """
    digest = hashlib.sha256()
    for source in sources:
        for file in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            digest.update(file.read_bytes())
    stamp = digest.digest()

    def decorate(function: Function) -> Function:
        try:
            dispatcher = numba.njit(cache=True)(function)
        except RuntimeError:  # nowhere to write, as in a read-only container
            return helper(function)
        cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if cache_file is not None:  # None under NUMBA_DISABLE_JIT
            cache_file._source_stamp = (cache_file._source_stamp, stamp)
        return cast(Function, dispatcher)

    return decorate


class _Twins:
    """Compiles functions of the control core, callees first, each of them once."""

    def __init__(self) -> None:
        self._functions: dict[FunctionType, Any] = {}
        self._modules: dict[ModuleType, ModuleType] = {}

    def function(self, plain: FunctionType) -> Any:
        """The compiled twin of a function."""
        if plain not in self._functions:
            names = _names(plain)
            scope = {name: self._twin(value, names) for name, value in plain.__globals__.items() if name in names}
            scope["__name__"] = plain.__module__  # numba's cache on disk looks a function up by its module
            copy = FunctionType(plain.__code__, scope, plain.__name__, plain.__defaults__, plain.__closure__)
            self._functions[plain] = numba.njit(copy)
        return self._functions[plain]

    def _twin(self, value: Any, names: set[str]) -> Any:
        if isinstance(value, FunctionType) and value.__module__.startswith(_ROOM):
            return self.function(value)
        if isinstance(value, ModuleType) and value.__name__.startswith(_ROOM):
            return self._module(value, names)
        return value

    def _module(self, plain: ModuleType, names: set[str]) -> ModuleType:
        """A module as its callers see it: with the twins of those of its functions that `names` mentions."""
        twin = self._modules.setdefault(plain, ModuleType(plain.__name__))
        for name, value in vars(plain).items():
            if name in names and not hasattr(twin, name):
                setattr(twin, name, self._twin(value, names))
        return twin


def _names(function: FunctionType) -> set[str]:
    """Every global or attribute the code of a function mentions."""
    return set(function.__code__.co_names)


@functools.cache
def _control() -> _Twins:
    return _Twins()


def twin(plain: Function) -> Function:
    """The compiled twin of a function of the firmware that calls only what is in `firmware_sim.control`."""
    return cast(Function, _control().function(cast(FunctionType, plain)))


@functools.cache
def control_step() -> Callable[[Words, Words, Words, Words], None]:
    """The compiled `firmware_sim.control.core.control_step`; the first call in a process takes seconds to compile.

    Returns:
        A function of the arrays state, parameters, inputs and outputs, int64 and laid out as in
        `firmware_sim.control.layout`. It can also be called from other functions that numba compiles.
    """
    return cast(Callable[[Words, Words, Words, Words], None], twin(core.control_step))
