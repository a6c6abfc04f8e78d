"""The warnings of `convert`: what each is about, and whether it is right where the truth is known."""

from __future__ import annotations

import re
from collections.abc import Iterable

from pc2grid_lab.experiments.recordings.rows import Verdict, Warned

_ABOUT = {
    "bent": r"contradicts itself",
    "loose": r"^no loop ties",
    "lift": r"as small as a lift",
    "ends on a slope": r"is on a slope that leads to another floor",
    "slope unnoticed": r"on a slope that was not noticed",
    "left its height": r"the sensor in the hand is up to",
    "floors": r"^the recording goes over \d+ floors",
    "parts": r"^the recording falls into \d+ parts",
    "lost": r"^registration was lost",
    "weak": r"did not fix the pose in every direction",
    "no tf": r"^the log has no tf",
    "gaps": r"gaps of more than",
    "empty scans": r"hold no returns",
}
_SHAPE = ("bent", "loose")
_STOREYS = ("lift", "ends on a slope", "slope unnoticed", "left its height", "floors")
EXACT_M, WRONG_M = 0.1, 0.25
"""A map with a smaller error is not bent, one with a larger is. Chosen by hand: what a doubled wall needs."""


def warned(texts: Iterable[str], *, storeys: bool, error_m: float | None) -> tuple[Warned, ...]:
    """Each warning with its verdict. storeys : whether the recording goes over several floors. error_m : of
    the trajectory, None if it is not known.
    """
    return tuple(
        Warned(about=about, verdict=_verdict(about, storeys, error_m), text=text)
        for text in texts
        for about in [_about(text)]
    )


def _about(text: str) -> str:
    """What a warning is about; of one that is not known here, its first words."""
    for about, pattern in _ABOUT.items():
        if re.search(pattern, text):
            return about
    return " ".join(text.split()[:5])


def _verdict(about: str, storeys: bool, error_m: float | None) -> Verdict:
    if about in _STOREYS:
        return "right" if storeys else "false"
    if about in _SHAPE and error_m is not None:
        if error_m < EXACT_M:
            return "false"
        if error_m > WRONG_M:
            return "right"
    return "unknown"
