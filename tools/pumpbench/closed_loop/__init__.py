"""The closed loop as one compiled function, for campaigns: the same doses as plant and firmware on the bus.

result = simulate(Case("adult#001", mode="s2", days=14, seed=7))
result.metrics()["tir_70_180"]
"""

from .case import Case, CaseError
from .result import LoopError, Result, simulate

__all__ = ["Case", "CaseError", "LoopError", "Result", "simulate"]
