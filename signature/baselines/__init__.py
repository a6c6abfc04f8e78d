"""The paper's method and its six rivals (paper IV-A) behind one protocol.

A method is fitted to the submaps of a map and then asked, for a query, how alike it is to each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from pc2grid.geometry import F64
from pc2grid.model import Submap


@runtime_checkable
class Matcher(Protocol):
    """A method that has seen a map."""

    def similarities(self, query: Submap) -> F64:
        """How alike the query is to each of the N submaps fitted: (N,), larger is more alike, never NaN."""
        ...


@runtime_checkable
class Method(Protocol):
    """A way to describe and compare submaps."""

    def fit(self, submaps: Sequence[Submap]) -> Matcher:
        """Describe the submaps of a map, and learn what the method learns from them."""
        ...


def _proposed() -> Method:
    from signature.baselines.proposed import Proposed

    return Proposed()


METHODS: dict[str, Callable[[], Method]] = {
    "proposed": _proposed,
}
"""Every method by name, in the order of Table III with the proposed one first; made when called."""
