"""A query as retrieval takes it: described at a few places."""

from __future__ import annotations

from dataclasses import dataclass

from pc2grid.submaps.isovist import Isovist


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The query described at one place.

    center_m : (x, y) in the query's frame.
    profile : its isovist with `signature.seen_places.PROFILE_BEARINGS` rays.
    """

    center_m: tuple[float, float]
    profile: Isovist
