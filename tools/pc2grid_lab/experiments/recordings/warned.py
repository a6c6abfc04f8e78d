"""The warnings of `convert`: what each is about, and whether it is right where the truth is known."""

from __future__ import annotations

import re
from collections.abc import Iterable

from pc2grid_lab.experiments.recordings.rows import Verdict, Warned

_ABOUT = {
    "bent": r"contradicts itself",
    "loose": r"^no loop ties",
    "height": r"^the height changes by",
    "parts": r"^the recording falls into \d+ parts",
    "lost": r"^registration was lost",
    "weak": r"did not fix the pose in every direction",
    "no tf": r"^the log has no tf",
    "gaps": r"gaps of more than",
    "empty scans": r"hold no returns",
}
_SHAPE = ("bent", "loose")
EXACT_M, WRONG_M = 0.1, 0.25
"""A map with a smaller error is not bent, one with a larger is. Chosen by hand: what a doubled wall needs."""


def warned(texts: Iterable[str], *, error_m: float | None) -> tuple[Warned, ...]:
    """Each warning with its verdict. error_m : of the trajectory, None if it is not known."""
    return tuple(
        Warned(about=about, verdict=_verdict(about, error_m), text=text)
        for text in texts
        for about in [_about(text)]
    )


def _about(text: str) -> str:
    """What a warning is about; of one that is not known here, its first words."""
    for about, pattern in _ABOUT.items():
        if re.search(pattern, text):
            return about
    return " ".join(text.split()[:5])


def _verdict(about: str, error_m: float | None) -> Verdict:
    if about == "height":  # each of the recordings is of one floor
        return "false"
    if about in _SHAPE and error_m is not None:
        if error_m < EXACT_M:
            return "false"
        if error_m > WRONG_M:
            return "right"
    return "unknown"
