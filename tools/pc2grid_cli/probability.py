"""Probabilities in text for people; JSON documents hold the numbers as they were computed."""

from __future__ import annotations

_LEAST, _MOST = 0.01, 0.99
"""What lies outside is shown as `< 0.01` or `> 0.99`: how true confidence is was measured no finer than that
(`compare sensors`)."""


def probability(value: float) -> str:
    """A probability with two digits; never 0 or 1.

    >>> probability(0.5), probability(0.9999), probability(0.0)
    ('0.50', '> 0.99', '< 0.01')
    """
    if value > _MOST:
        return f"> {_MOST}"
    return f"< {_LEAST}" if value < _LEAST else f"{value:.2f}"
