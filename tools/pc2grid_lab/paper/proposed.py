"""The paper's own method as a `Method`, for the comparison with the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pc2grid.arrays import F64
from pc2grid.model import Submap
from signature.config import SignatureConfig
from signature.describe import Signature, described
from signature.freespace import freespace_paths
from signature.similarity import SignatureTable, distances, similarity


@dataclass(frozen=True, slots=True)
class Proposed:
    """Three signatures, compared by Eq. 6."""

    config: SignatureConfig = field(default_factory=SignatureConfig)

    def fit(self, submaps: Sequence[Submap]) -> _Table:
        """Describe every submap."""
        signatures = [signature_of(submap, self.config) for submap in submaps]
        return _Table(SignatureTable.of(signatures, [submap.center_m for submap in submaps]), self.config)


@dataclass(frozen=True, slots=True)
class _Table:
    table: SignatureTable
    config: SignatureConfig

    def similarities(self, query: Submap) -> F64:
        return similarity(distances(signature_of(query, self.config), self.table, self.config))


def signature_of(submap: Submap, config: SignatureConfig) -> Signature:
    """The signature that `signature.describe` gives, without a graph that would only be unpacked."""
    return described(submap, freespace_paths(submap, config), config)
