"""A query as retrieval takes it: described at a few places."""

from __future__ import annotations

from dataclasses import dataclass

from pc2grid.submaps.isovist import Isovist
from signature.describe import Signature


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The query described at one place.

    center_m : (x, y) in the query's frame.
    profile : its isovist with `signature.seen_places.PROFILE_BEARINGS` rays.
    signature : the three signatures of the submap around it, cut like those of the database.
    """

    center_m: tuple[float, float]
    profile: Isovist
    signature: Signature
