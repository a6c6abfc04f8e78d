"""Other settings of the method as it is used here: what each signature adds, and what each choice moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class SettingChoice:
    """Another setting of the method as it is used here, to measure what it moves.

    name : in a few words. paper : what the paper says of it. ours : what the default does instead.
    overrides : fields of SignatureConfig with the other values.
    """

    name: str
    paper: str
    ours: str
    overrides: tuple[tuple[str, Any], ...]


_NO_SYMMETRY = ("symmetry_sigma", 1e6)

ABLATION = (
    SettingChoice("boundary and free space", "Eq. 6 with Omega = 1", "Eq. 6", (_NO_SYMMETRY,)),
    SettingChoice(
        "boundary alone", "omega_b = 1, Omega = 1", "Eq. 6", (("weight_boundary", 1.0), _NO_SYMMETRY)
    ),
    SettingChoice(
        "free space alone", "omega_b = 0, Omega = 1", "Eq. 6", (("weight_boundary", 0.0), _NO_SYMMETRY)
    ),
    SettingChoice("symmetry made to count", "sigma = 120", "sigma = 120; here 4", (("symmetry_sigma", 4.0),)),
)
"""What each signature adds."""

OPEN_CHOICES = tuple(
    SettingChoice(name, paper, ours, (override,))
    for name, paper, ours, override in (
        (
            "-ln BC",
            "Bhattacharyya distance",
            "sqrt(1 - BC), which OpenCV calls so",
            ("histogram_distance", "bhattacharyya"),
        ),
        (
            "Zhang-Suen thinning",
            "thinning, not which one",
            "Guo-Hall in the signatures",
            ("thinning", "zhang_suen"),
        ),
        (
            "full resolution",
            "skeleton of the map",
            "free-space skeleton on blocks of 0.1 m",
            ("freespace_cell_m", 0.05),
        ),
        (
            "no limit in S^G",
            "no limit",
            "cut at 34, the value of a straight line",
            ("symmetry_limited", False),
        ),
        ("plain vote", "voting on the angles", "by length, blurred, refined", ("axis_vote", "plain")),
        ("boundary points 0.05 m", "-", "0.1 m", ("boundary_spacing_m", 0.05)),
        ("boundary points 0.2 m", "-", "0.1 m", ("boundary_spacing_m", 0.2)),
        ("nodes 0.4 m apart", "-", "0.6 m", ("freespace_spacing_m", 0.4)),
        ("nodes 1.0 m apart", "-", "0.6 m", ("freespace_spacing_m", 1.0)),
        ("eroded by 0.3 m", "erosion, not how much", "0.2 m", ("freespace_clearance_m", 0.3)),
        ("nodes joined to 1.5 m", "all that see each other", "the same", ("freespace_join_m", 1.5)),
        ("S^G peaks at 255", "-", "34", ("symmetry_peak", 255.0)),
        ("omega_b = 0.7", "0.9", "0.9", ("weight_boundary", 0.7)),
    )
)
"""Where the default departs from the paper (the first five, which are the row "proposed" together), and other
values of what the paper leaves open."""
