"""A query as retrieval takes it: described at a few places."""

from __future__ import annotations

from dataclasses import dataclass

from pc2grid.submaps.isovist import Isovist
from signature.describe import Signature

PROFILE_BEARINGS = 48
"""Rays of the isovists whose ranges are compared: one every 7.5 degrees, the window of headings that the
coarse search covers around each proposal. Chosen on fr079 and intel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The query described at one place.

    center_m : (x, y) in the query's frame.
    profile : its isovist with `PROFILE_BEARINGS` rays.
    signature : the three signatures of the submap around it, cut like those of the database.
    """

    center_m: tuple[float, float]
    profile: Isovist
    signature: Signature
