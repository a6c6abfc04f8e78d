"""Other settings of the method to the letter: what each signature adds, and what each choice moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class SettingChoice:
    """Another setting of the method to the letter, to measure what it moves.

    name : in a few words. paper : what the paper says of it. letter : what the letter does.
    overrides : fields of SignatureConfig with the other values.
    """

    name: str
    paper: str
    letter: str
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
    SettingChoice(name, paper, letter, (override,))
    for name, paper, letter, override in (
        (
            "Guo-Hall thinning",
            "two works: III-A, III-B",
            "Guo-Hall for the boundary, Zhang-Suen for free space",
            ("thinning", "guo_hall"),
        ),
        ("blocks of 0.1 m", "skeleton of the map", "cells of 0.05 m", ("freespace_cell_m", 0.1)),
        ("eroded by 0.2 m", "III-C names no erosion", "none", ("freespace_clearance_m", 0.2)),
        ("limit in S^G", "no limit", "none", ("symmetry_limited", True)),
        ("vote by length", "voting on the angles", "one vote each", ("axis_vote", "length")),
        (
            "Zhang-Suen thinning",
            "two works: III-A, III-B",
            "Guo-Hall for the boundary, Zhang-Suen for free space",
            ("thinning", "zhang_suen"),
        ),
        ("boundary points 0.05 m", "-", "0.1 m", ("boundary_spacing_m", 0.05)),
        ("boundary points 0.2 m", "-", "0.1 m", ("boundary_spacing_m", 0.2)),
        ("nodes 0.4 m apart", "-", "0.6 m", ("freespace_spacing_m", 0.4)),
        ("nodes 1.0 m apart", "-", "0.6 m", ("freespace_spacing_m", 1.0)),
        ("nodes joined to 1.5 m", "all that see each other", "the same", ("freespace_join_m", 1.5)),
        ("S^G peaks at 255", "-", "34", ("symmetry_peak", 255.0)),
        ("omega_b = 0.7", "0.9", "0.9", ("weight_boundary", 0.7)),
    )
)
"""Where our default departs from the paper (the first five, which together are the row "as_used_here"), and
other values of what the paper leaves open."""
