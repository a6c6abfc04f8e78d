"""Intervals of shares, and whether one run is worse than another by more than chance."""

from __future__ import annotations

ALPHA = 0.05


def clopper_pearson(successes: int, trials: int, alpha: float = ALPHA) -> tuple[float, float]:
    """The exact interval of a share that was seen `successes` times in `trials` (Clopper and Pearson, 1934).

    >>> low, high = clopper_pearson(0, 20)
    >>> low, round(high, 3)
    (0.0, 0.168)
    """
    from scipy.stats import beta

    low = 0.0 if not successes else float(beta.ppf(alpha / 2, successes, trials - successes + 1))
    high = 1.0 if successes == trials else float(beta.ppf(1 - alpha / 2, successes + 1, trials - successes))
    return low, high


def by_chance(worse: int, better: int) -> float:
    """Probability that at least `worse` of the queries whose result changed became worse, if either were as
    likely as the other (sign test of McNemar, one-sided).

    >>> by_chance(5, 0), by_chance(1, 1)
    (0.03125, 0.75)
    """
    from scipy.stats import binom

    return float(binom.sf(worse - 1, worse + better, 0.5))
