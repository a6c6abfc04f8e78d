"""What a method of the comparison does: describe the submaps of a map, and compare queries with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from pc2grid.arrays import F64
from pc2grid.model import Submap


@runtime_checkable
class Matcher(Protocol):
    """A method that is fitted to the submaps of a map."""

    def similarities(self, query: Submap) -> F64:
        """Similarity of the query to each of the N fitted submaps: (N,), larger is more alike, never NaN."""
        ...


@runtime_checkable
class Method(Protocol):
    """A way to describe and compare submaps."""

    def fit(self, submaps: Sequence[Submap]) -> Matcher:
        """Describe the submaps of a map and learn from them what the method needs, such as a vocabulary."""
        ...
