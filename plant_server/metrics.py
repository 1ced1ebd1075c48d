"""Outcome metrics of plasma glucose, over all samples of a run.

Sources: ranges and targets, Battelino et al., Diabetes Care 2019;42:1593 (percent of *samples*); LBGI and HBGI,
Kovatchev et al., Diabetes Care 1997;20:1655 and 2006;29:2433; GMI, Bergenstal et al., Diabetes Care 2018;41:2275; GRI,
Klonoff et al., J Diabetes Sci Technol 2023;17:1226. A value on a limit counts as in range. The tests hold these
functions against values worked by hand and against the packages iglu_python and py_agata.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def risk(glucose: Array) -> tuple[float, float]:
    """Low and high blood glucose index, LBGI and HBGI (Kovatchev et al.).

    f(G) = 1.509 [(ln G)^1.084 - 5.381], risk = 10 f^2; LBGI is the mean over *all* samples of the risk where f < 0,
    HBGI where f > 0.

    Some codes (simglucose's risk.py) take the mean over the samples of one side only; that is another number.

    Args:
        glucose: mg/dL, none below 1.
    """
    f = 1.509 * (np.log(glucose) ** 1.084 - 5.381)
    r = 10 * f**2
    return float(np.mean(np.where(f < 0, r, 0.0))), float(np.mean(np.where(f > 0, r, 0.0)))


def percent(mask: npt.NDArray[np.bool_]) -> float:
    """Share of samples in percent."""
    return 100.0 * float(np.mean(mask))


def glycaemic(glucose: Array) -> dict[str, float]:
    """The outcome of one run.

    Args:
        glucose: plasma glucose in mg/dL, one value per sampling instant; for the risk, what is below 1 counts as 1.

    Returns:
        Percent of samples in range (70 to 180, both included), below 54 and 70, above 180 and 250; LBGI, HBGI; mean
        (mg/dL) and coefficient of variation (%); GMI (%, Bergenstal 2018); GRI (Klonoff 2023, at most 100).

    Raises:
        ValueError: there is no sample, or one is missing or not positive.
    """
    if glucose.size == 0 or not np.all(np.isfinite(glucose)) or np.any(glucose <= 0):
        raise ValueError("metrics need at least one sample, all of them positive numbers")
    below_54, below_70 = percent(glucose < 54), percent(glucose < 70)
    above_180, above_250 = percent(glucose > 180), percent(glucose > 250)
    lbgi, hbgi = risk(np.maximum(glucose, 1.0))
    mean = float(np.mean(glucose))
    return {
        "tir_70_180": percent((glucose >= 70) & (glucose <= 180)),
        "tbr_54": below_54,
        "tbr_70": below_70,
        "tar_180": above_180,
        "tar_250": above_250,
        "lbgi": lbgi,
        "hbgi": hbgi,
        "mean_glucose": mean,
        "cv": 100.0 * float(np.std(glucose, ddof=1)) / mean if glucose.size > 1 else 0.0,
        "gmi": 3.31 + 0.02392 * mean,
        "gri": min(
            100.0,
            3.0 * below_54 + 2.4 * (below_70 - below_54) + 1.6 * above_250 + 0.8 * (above_180 - above_250),
        ),
    }
