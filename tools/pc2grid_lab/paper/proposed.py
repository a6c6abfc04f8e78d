"""The paper's own method as a `Method`, for the comparison with the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pc2grid.geometry import F64
from pc2grid.model import Submap
from signature.config import SignatureConfig
from signature.freespace import freespace_paths
from signature.paper import Signature, SignatureTable, described, distances, similarity

_OF_COMPARING = {"weight_boundary", "symmetry_scale", "symmetry_sigma", "histogram_distance"}
"""Fields of a configuration that do not change a signature."""


@dataclass(slots=True)
class Signatures:
    """Signatures, with those of the last submap cached: methods that share them describe a query once."""

    _read: Submap | None = None
    _found: dict[str, Signature] = field(default_factory=dict)

    def of(self, submap: Submap, config: SignatureConfig) -> Signature:
        """The signature that `signature.paper` gives, without a graph that would only be unpacked."""
        if self._read is not submap:
            self._read, self._found = submap, {}
        key = config.model_dump_json(exclude=_OF_COMPARING)
        if key not in self._found:
            self._found[key] = described(submap, freespace_paths(submap, config), config)
        return self._found[key]


@dataclass(frozen=True, slots=True)
class Proposed:
    """Three signatures, compared by Eq. 6."""

    config: SignatureConfig = field(default_factory=SignatureConfig)
    signatures: Signatures = field(default_factory=Signatures)

    def fit(self, submaps: Sequence[Submap]) -> _Table:
        """Describe every submap."""
        signatures = [self.signatures.of(submap, self.config) for submap in submaps]
        return _Table(self, SignatureTable.of(signatures, [submap.center_m for submap in submaps]))


@dataclass(frozen=True, slots=True)
class _Table:
    method: Proposed
    table: SignatureTable

    def similarities(self, query: Submap) -> F64:
        config = self.method.config
        return similarity(distances(self.method.signatures.of(query, config), self.table, config))
