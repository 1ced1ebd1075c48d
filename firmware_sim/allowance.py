"""How much the control law may do in a step: arithmetic of integers that the loop of campaigns uses as it is."""

from .control.fixed import round_divide
from .control.layout import LIMIT_NONE, LIMIT_SCHEDULE, LIMIT_SUSPEND
from .ladder import AGE_DEGRADED


def limit_of(auto: bool, suspended: bool, cautious: bool) -> int:
    """IN_LIMIT: in Auto the law decides, unless something asks for caution; suspended comes first."""
    if suspended:
        return LIMIT_SUSPEND
    return LIMIT_NONE if auto and not cautious else LIMIT_SCHEDULE


def stale_age(minutes: int) -> int:
    """CfgStaleCgmLimit as the age of a sample from which on it is stale, in steps; it can only tighten (USR-05)."""
    return min(minutes // 5 + 1, AGE_DEGRADED)


def insulin_left(tdd: int, delivered: int, under_way: int) -> int:
    """IN_INSULIN_LEFT, mU: what twice the daily dose leaves of 24 h (requirement LIM-06).

    Args:
        tdd: CfgInsulinTdd, 0.01 U.
        delivered: within 24 h, mU.
        under_way: bolus that no total holds yet, 0.01 U.
    """
    return max(tdd * 20 - delivered - under_way * 10, 0)


def pram_left(tdd: int, delivered: int, under_way: int) -> int:
    """IN_PRAM_LEFT, 0.1 ug: what the limit leaves of 24 h.

    Args:
        tdd: CfgPramTdd, 0.1 ug.
        delivered: within 24 h, 0.01 ug.
        under_way: bolus that no total holds yet, 0.1 ug.
    """
    return max(tdd - round_divide(delivered, 10) - under_way, 0)
