"""A query as retrieval takes it: described at a few places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from pc2grid.submaps.isovist import Isovist
from signature.describe import Signature


@dataclass(frozen=True, kw_only=True)  # no slots, for what is computed once
class View:
    """The query described at one place.

    center_m : (x, y) in the query's frame.
    profile : its isovist with `signature.seen_places.PROFILE_BEARINGS` rays.
    describe : makes its signature.
    """

    center_m: tuple[float, float]
    profile: Isovist
    describe: Callable[[], Signature]

    @cached_property
    def signature(self) -> Signature:
        """The three signatures of the submap around it, cut like those of the database."""
        return self.describe()
