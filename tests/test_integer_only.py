"""No float, no true division, no library that brings them in: read from the syntax trees of the whole firmware."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench import S2, Bench

import firmware_sim
from firmware_sim.firmware import Firmware

ROOM = Path(firmware_sim.__file__).parent

SOURCES = sorted(path for path in ROOM.rglob("*.py") if path.name not in ("__main__.py", "serial_port.py"))
"""Everything a frame can reach; __main__ only opens the bus, and serial_port the console's port."""

ALLOWED_IMPORTS = {"binascii", "collections", "dataclasses", "enum", "typing", "dbc", "can_bus"}
"""Beside the firmware's own modules. A list of what is allowed, so that nothing slips in under a new name."""

FORBIDDEN_NAMES = {"float", "complex", "round", "pow", "eval", "exec", "__import__"}
FORBIDDEN_ATTRIBUTES = {"__truediv__", "__rtruediv__", "__float__", "as_integer_ratio", "fromhex"}


def offences(source: str) -> list[str]:
    """What in this source is not integer arithmetic, as "line: what"."""
    return [f"{line}: {what}" for line, what in _offences(ast.parse(source))]


def _offences(tree: ast.AST) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Constant) and isinstance(node.value, (float, complex)):
            yield line, f"literal {node.value}"
        elif isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.Div):
            yield line, "true division"
        elif isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.Pow):
            exponent = node.right if isinstance(node, ast.BinOp) else node.value
            if not (isinstance(exponent, ast.Constant) and isinstance(exponent.value, int)):
                yield line, "power with an exponent that may be negative"
        elif isinstance(node, ast.Name) and node.id in FORBIDDEN_NAMES:
            yield line, f"name {node.id}"
        elif isinstance(node, ast.Attribute) and node.attr in FORBIDDEN_ATTRIBUTES:
            yield line, f"attribute {node.attr}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.partition(".")[0] not in ALLOWED_IMPORTS:
                    yield line, f"import {alias.name}"
        elif isinstance(node, ast.ImportFrom) and not node.level:
            if (node.module or "").partition(".")[0] not in ALLOWED_IMPORTS:
                yield line, f"import {node.module}"
        elif isinstance(node, ast.FormattedValue) and node.format_spec is not None:
            yield line, "formatted number"


def test_the_whole_control_path_is_read() -> None:
    names = {path.relative_to(ROOM).as_posix() for path in SOURCES}
    assert {"firmware.py", "control/core.py", "control/observer.py", "control/strategies/s2.py", "cgm.py"} <= names
    assert sum(len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES) > 800


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOM).as_posix())
def test_integers_only(path: Path) -> None:
    assert offences(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "x = 0.5",
        "x = 1e3",
        "x = 2j",
        "x = y / 2",
        "x /= 2",
        "x = 2 ** -1",
        "x = 2 ** n",
        "x **= n",
        "x = float(y)",
        "x = round(y)",
        "x = pow(2, -1)",
        "def f(x: float) -> int: return 0",
        "convert = float\nx = convert(1)",
        "x = (1).__truediv__(2)",
        "import math",
        "import numpy as np",
        "from numpy import int64",
        "from scipy.signal import lfilter",
        "import random",
        "import time",
        "from time import monotonic",
        "from fractions import Fraction",
        "from decimal import Decimal",
        "import operator\nx = operator.truediv(1, 2)",
        "from statistics import mean",
        "x = eval('1/2')",
        "def f():\n    import struct",
        "x = f'{y:.2f}'",
    ],
)
def test_it_would_be_noticed(source: str) -> None:
    assert offences(source)


@pytest.mark.parametrize(
    "source",
    [
        "x = y // 2",
        "x = y >> 3",
        "x = 2 ** 8",
        "x = -7 % 5",
        "f(**values)",
        "from can_bus.codec import Check",
        "import enum",
    ],
)
def test_integer_arithmetic_is_no_offence(source: str) -> None:
    assert offences(source) == []


def test_every_word_of_the_core_stays_an_int() -> None:
    """What the trees cannot show: a float that came in from outside."""
    firmware = Firmware()
    bench = Bench(mode=S2, firmware=firmware)
    for k in range(60):
        bench.step(1200 + 13 * k, drop=k % 7 == 3, totals=k % 5 != 0)
        words = [*firmware._state, *firmware._inputs, *firmware._outputs, *firmware._calibration.parameters]
        assert {type(word) for word in words} == {int}
