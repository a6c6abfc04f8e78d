"""Intervals of shares, and whether one run is worse than another by more than chance."""

from __future__ import annotations

from scipy.stats import binomtest

ALPHA = 0.05


def clopper_pearson(successes: int, trials: int, alpha: float = ALPHA) -> tuple[float, float]:
    """The exact interval of a share that was seen `successes` times in `trials` (Clopper and Pearson, 1934).

    >>> low, high = clopper_pearson(0, 20)
    >>> low, round(high, 3)
    (0.0, 0.168)
    """
    interval = binomtest(successes, trials).proportion_ci(1.0 - alpha)
    return float(interval.low), float(interval.high)


def by_chance(worse: int, better: int) -> float:
    """Probability that at least `worse` of the queries whose result changed became worse, if either were as
    likely as the other (sign test of McNemar, one-sided).

    >>> by_chance(5, 0), by_chance(1, 1)
    (0.03125, 0.75)
    """
    return float(binomtest(worse, worse + better, alternative="greater").pvalue)
