"""Fixed-point arithmetic of the control path: signed 32-bit words, 64-bit products, one rounding rule.

The functions take and give plain integers and compile with numba, where every integer is an int64; in plain Python they
stay within int64 by the ranges given here, so both give the same result.

Rounding, everywhere: to the nearest, halves up (towards plus infinity), i.e. add half and floor. In C this is an
arithmetic shift for powers of two and, for a positive divisor, a division that floors.
"""

from collections.abc import MutableSequence

Ints = MutableSequence[int]
"""An array of integers: a list in plain Python, an int64 array when compiled."""

INT32_MAX = 2147483647
INT32_MIN = -2147483648


def saturate(value: int, counts: Ints) -> int:
    """Clamp to a signed 32-bit word.

    Args:
        value: an integer within int64.
        counts: a one-element array; counts the clamps.
    """
    if value > INT32_MAX:
        counts[0] += 1
        return INT32_MAX
    if value < INT32_MIN:
        counts[0] += 1
        return INT32_MIN
    return value


def round_shift(value: int, bits: int) -> int:
    """Value / 2**bits, rounded; |value| + 2**(bits - 1) below 2**63."""
    return (value + (1 << (bits - 1))) >> bits


def round_divide(value: int, divisor: int) -> int:
    """Value / divisor, rounded; the divisor is positive, |value| + divisor/2 below 2**63."""
    return (value + (divisor >> 1)) // divisor
