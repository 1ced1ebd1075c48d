"""Three first-order lags in cascade, with an exact hold over the sample: G_u of the observer, F of a bolus."""

from .fixed import Ints, round_shift, saturate
from .layout import SATURATIONS


def advance(
    state: Ints,
    first: int,
    u: int,
    a11: int,
    a21: int,
    a22: int,
    a31: int,
    a32: int,
    a33: int,
    b1: int,
    b2: int,
    b3: int,
) -> int:
    """One sample of x(k+1) = A x(k) + B u(k), A lower triangular.

    Args:
        state: as in `layout`; the words first, first + 1 and first + 2 are x and are advanced.
        first: index of x_1.
        u: in the format of x.
        a11, a21, a22, a31, a32, a33, b1, b2, b3: coefficients with 30 fractional bits.

    Returns:
        x_3(k+1).
    """
    counts = state[SATURATIONS : SATURATIONS + 1]
    x1 = state[first]
    x2 = state[first + 1]
    x3 = state[first + 2]
    state[first] = saturate(round_shift(a11 * x1 + b1 * u, 30), counts)
    state[first + 1] = saturate(round_shift(a21 * x1 + a22 * x2 + b2 * u, 30), counts)
    state[first + 2] = saturate(round_shift(a31 * x1 + a32 * x2 + a33 * x3 + b3 * u, 30), counts)
    state[SATURATIONS] = counts[0]
    return state[first + 2]
