"""How the equations are compiled: numba, ahead of the first call, kept on disk.

numba keeps compiled code beside the source and compiles again when *that* file changes. Our right-hand
side is spread over one file per subsystem, so a change in `gastric.py` must also renew `advance` in
`integrate.py`: the decorator here ties every entry point to the text of the whole package.

A division by zero gives infinity, as in numpy (`error_model`); the check that Python would ask for at every
division costs 40 % of the speed, and `patients.py` lets no zero into a denominator.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import float64, njit, types, void

Function = TypeVar("Function", bound=Callable[..., Any])

Array = npt.NDArray[np.float64]

WRITES = types.Array(float64, 1, "C")
READS = types.Array(float64, 1, "C", readonly=True)
"""One-dimensional arrays that are written to, and that are only read (a `Patient`'s own are read-only)."""


def _package_digest() -> bytes:
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.digest()


PACKAGE_DIGEST = _package_digest()
"""Digest of every source file of the package."""


def _tie_to_package(dispatcher: Any) -> None:
    """Let the cached machine code of `dispatcher` expire with any file of the package."""
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None:  # None under NUMBA_DISABLE_JIT
        cache_file._source_stamp = (cache_file._source_stamp, PACKAGE_DIGEST)


def compiled(function: Function) -> Function:
    """Compile a helper that only compiled code calls."""
    return cast(Function, njit(error_model="numpy")(function))


def entry_point(result: Any, *arguments: Any) -> Callable[[Function], Function]:
    """Compile a function that Python and other compiled code call, for these types alone.

    Fixed types mean that an `int` time or a read-only array does not set off a second, slow compilation.
    """

    def decorate(function: Function) -> Function:
        # Two steps: the cache has to be tied to the package before the signature is compiled or looked up.
        try:
            dispatcher = njit(cache=True, error_model="numpy")(function)
        except RuntimeError:  # nowhere to write, as in a read-only container
            dispatcher = njit(error_model="numpy")(function)
        _tie_to_package(dispatcher)
        if hasattr(dispatcher, "compile"):
            dispatcher.compile(result(*arguments))
            dispatcher.disable_compile()
        return cast(Function, dispatcher)

    return decorate


__all__ = ["PACKAGE_DIGEST", "READS", "WRITES", "compiled", "entry_point", "float64", "void"]
