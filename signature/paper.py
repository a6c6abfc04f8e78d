"""The three signatures of a submap (paper III, Figure 1), and their distance (paper III-E, Eq. 6-8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from pc2grid.geometry import F32, F64, frozen_arrays
from pc2grid.model import Submap
from signature.boundary import boundary_edges, boundary_histogram, boundary_points
from signature.config import SignatureConfig
from signature.freespace import freespace_graph, freespace_histogram, shortest_paths
from signature.symmetry import symmetry_scores


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(boundary=(np.float32, "Nb"), freespace=(np.float32, "Nf"), symmetry=(np.float32, "S"))
class Signature:
    """The three signatures of a submap, as the paper has them: they are stored, exported and compared by
    `distances`. Answers are ordered by what is visible from a viewpoint instead (`signature.visible`).

    boundary : (Nb,) float32, H^b of Eq. 2; sum 1, or all 0 if fewer than two boundary points are known.
    freespace : (Nf,) float32, H^f of Eq. 4; sum 1, or all 0 if no two free places are connected.
    symmetry : (2,) float32, s^alpha and s^beta of Eq. 5; 0 where there is no axis.

    Raises ValueError if an array does not have one axis.
    """

    boundary: F32
    freespace: F32
    symmetry: F32

    def __repr__(self) -> str:
        alpha, beta = self.symmetry
        bins = f"{len(self.boundary)} boundary bins, {len(self.freespace)} free-space bins"
        return f"Signature({bins}, symmetry {alpha:.1f} and {beta:.1f})"


def describe(submap: Submap, config: SignatureConfig = SignatureConfig()) -> Signature:
    """Return the three signatures of a submap; defined for every submap, never NaN.

    >>> import pc2grid
    >>> submaps = pc2grid.submaps_of(pc2grid.load_map("map.yaml"))
    >>> signature = describe(submaps[0])
    >>> signature.boundary.shape, signature.freespace.shape, signature.symmetry.shape
    ((50,), (50,), (2,))
    >>> round(float(signature.boundary.sum()), 5)
    1.0
    """
    radius_m, resolution_m = submap.radius_m, submap.grid.resolution_m
    edges = boundary_edges(submap, config)
    points = boundary_points(edges, resolution_m, config)
    paths_m = shortest_paths(freespace_graph(submap, config))
    return Signature(
        boundary=boundary_histogram(points, radius_m, resolution_m, config),
        freespace=freespace_histogram(paths_m, radius_m, config),
        symmetry=symmetry_scores(edges, resolution_m, config),
    )


I32 = NDArray[np.int32]

FARTHEST = 20.0
"""Cap of -ln BC, chosen by hand: BC is below 2e-9 only if no bin is shared."""

_BC_ROUNDING = np.finfo(np.float32).eps
"""Float32 histograms have rounding errors of this size; 1 - BC of equal ones is not more."""

_LARGEST_EXPONENT = 0.5 * np.log(np.finfo(np.float64).max)
"""In Eq. 8, so that exp stays finite in float64 and so does the product of two factors."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(session_index=(np.int32, "N"), submap_id=(np.int32, "N"), center_m=(np.float64, "N", 2))
class PlaceTable:
    """The places of a database, N submaps, one row each.

    session_index (N,), submap_id (N,) : int32, the submap that a row describes.
    center_m (N, 2) : float64, centre of the submap in its session's map frame.
    """

    session_index: I32
    submap_id: I32
    center_m: F64

    def __len__(self) -> int:
        return len(self.session_index)

    @classmethod
    def concatenated(cls, tables: Sequence[Self]) -> Self:
        """Return the rows of several tables, one table after the other."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: np.concatenate([getattr(t, name) for t in tables]) for name in names})


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(
    session_index=(np.int32, "N"),
    submap_id=(np.int32, "N"),
    center_m=(np.float64, "N", 2),
    boundary=(np.float32, "N", "bins"),
    freespace=(np.float32, "N", "lengths"),
    symmetry=(np.float32, "N", 2),
)
class SignatureTable(PlaceTable):
    """The places of a database with their signatures.

    boundary (N, Nb), freespace (N, Nf), symmetry (N, 2) : float32, as in `Signature`.
    """

    boundary: F32
    freespace: F32
    symmetry: F32

    def __repr__(self) -> str:
        return f"SignatureTable({len(self)} submaps of {len(np.unique(self.session_index))} sessions)"

    @staticmethod
    def of(
        signatures: Sequence[Signature],
        center_m: ArrayLike,
        *,
        submap_id: ArrayLike | None = None,
        session_index: ArrayLike | None = None,
    ) -> SignatureTable:
        """Return a table of signatures with their centres (N, 2); ids default to 0 .. N - 1, sessions to
        0."""
        n = len(signatures)

        def stack(name: str) -> F32:
            rows = [getattr(s, name) for s in signatures]
            return np.stack(rows) if rows else np.empty((0, 2 if name == "symmetry" else 0), np.float32)

        return SignatureTable(
            boundary=stack("boundary"),
            freespace=stack("freespace"),
            symmetry=stack("symmetry"),
            session_index=np.asarray(np.zeros(n) if session_index is None else session_index, np.int32),
            submap_id=np.asarray(np.arange(n) if submap_id is None else submap_id, np.int32),
            center_m=np.asarray(center_m).reshape(n, 2),
        )

    @property
    def places(self) -> PlaceTable:
        """Return the rows without signatures: 24 bytes instead of some 400 each."""
        return PlaceTable(session_index=self.session_index, submap_id=self.submap_id, center_m=self.center_m)


def distances(query: Signature, table: SignatureTable, config: SignatureConfig = SignatureConfig()) -> F64:
    """Return the matching score s of Eq. 6 against every row of a table, (N,); smaller is more alike, never
    NaN.

    s = Omega * (omega_b d(H^b) + omega_f d(H^f)). An empty histogram shares no bin with any other, not
    even with another empty one: its distance is the largest possible.

    >>> import pc2grid, signature
    >>> submaps = pc2grid.submaps_of(pc2grid.load_map("map.yaml"))
    >>> signatures = [signature.signature_of(submap) for submap in submaps]
    >>> table = SignatureTable.of(signatures, [submap.center_m for submap in submaps])
    >>> int(distances(signatures[2], table).argmin())
    2
    """
    scores = score_matrix(query.boundary[None], query.freespace[None], query.symmetry[None], table, config)
    return np.asarray(scores[0])


def score_matrix(
    boundary: F32, freespace: F32, symmetry: F32, table: SignatureTable, config: SignatureConfig
) -> F64:
    """Return Eq. 6 of M queries, given as (M, Nb), (M, Nf), (M, 2), against N rows: (M, N)."""
    geometric = config.weight_boundary * histogram_distance(boundary, table.boundary, config)
    geometric += (1.0 - config.weight_boundary) * histogram_distance(freespace, table.freespace, config)
    return structural_factor(symmetry, table.symmetry, config) * geometric


def similarity(score: F64) -> F64:
    """Return the submap similarity rho, the reciprocal of the matching score; inf for identical submaps."""
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.asarray(score, np.float64))


def histogram_distance(a: F32, b: F32, config: SignatureConfig) -> F64:
    """Return d of Eq. 6 between histograms (M, K) and (N, K): (M, N).

    From the Bhattacharyya coefficient BC = sum sqrt(a b), 1 for equal histograms and 0 without a shared bin:
    sqrt(1 - BC) in [0, 1] or -ln BC in [0, 20], by `config.histogram_distance`.
    """
    if a.shape[-1] != b.shape[-1] and len(b):
        raise ValueError(f"histograms of {a.shape[-1]} and {b.shape[-1]} bins: other radius or bin width")
    if len(b) == 0:
        return np.zeros((len(a), 0))
    # Of equal histograms 1 - BC is only rounding, which the square root would enlarge.
    bc = np.sqrt(a.astype(np.float64)) @ np.sqrt(b.astype(np.float64)).T
    bc = np.where(bc > 1.0 - _BC_ROUNDING, 1.0, bc)
    if config.histogram_distance == "hellinger":
        return np.asarray(np.sqrt(1.0 - bc))
    # 0 - ln 1 is 0; -ln 1 would be -0, and the similarity, its reciprocal, -inf.
    return np.asarray(0.0 - np.log(np.maximum(bc, np.exp(-FARTHEST))))


def structural_factor(a: F32, b: F32, config: SignatureConfig) -> F64:
    """Return omega of Eq. 7-8 between symmetry scores (M, 2) and (N, 2): (M, N), at least eta^2.

    Eq. 8 as printed is the reciprocal of an exponential with a negative exponent. That agrees with Eq. 6,
    where the score must grow with the difference of the symmetries: phi = eta exp(+(s_i - s_j)^2 / (2
    sigma^2)).
    """
    differences = a[:, None].astype(np.float64) - b[None].astype(np.float64)
    exponent = (differences**2).sum(axis=-1) / (2.0 * config.symmetry_sigma**2)
    return np.asarray(config.symmetry_scale**2 * np.exp(np.minimum(exponent, _LARGEST_EXPONENT)))
