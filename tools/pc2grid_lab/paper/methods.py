"""The methods of the comparison by name: the paper's own and its six rivals (paper IV-A).

Other settings of the method to the letter: what each signature adds, and what each choice moves.

A place described from several centres: any method, given smaller discs around many points of a submap.

It is not in the paper, whose submaps have one centre each. A query lies up to a metre beside it, and its disc
then shows other walls at the rim and other distances inside. Here every submap of the map is cut into smaller
discs around the points of a lattice, and the best of them counts; the query is cut to the same size around
its own centre only. All discs lie inside the submaps, so that no method sees more of the map than the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.geometry import F64, I64
from pc2grid.model import UNKNOWN, OccupancyGrid, Submap
from pc2grid_lab.paper.experiment import Matcher, Method
from pc2grid_lab.paper.learned import LEARNED, UNLEARNED, Learned, Unlearned, Vectors
from pc2grid_lab.paper.proposed import Proposed, Signatures
from pc2grid_lab.paper.rivals import DistanceFeatures, ShapeContext, Vocabulary, Words, sift, surf
from signature.config import SignatureConfig

METHOD_NAMES = (
    "proposed",
    "proposed_ln_bc",
    "shape_context",
    "sift_bow",
    "surf_bow",
    "sift_tfidf",
    "surf_tfidf",
    "sdf",
)
"""The paper's method to the letter, with both readings of the distance d of Eq. 6, OpenCV's sqrt(1 - BC) and
-ln BC; its rivals in the order of Table III."""

OURS = (*METHOD_NAMES[:2], "as_used_here")
"""What stands beside the published row in both tables; the last one with the default settings."""

EXTRA_METHOD_NAMES = (
    "as_used_here",
    *LEARNED,
    "unlearned",
    "as_used_here_centres",
    "boundary_centres",
    "shape_context_centres",
)
"""Beyond the paper: the default settings; the boundary at several radii with a learned metric, with more and
fewer parts, and nothing learned; places described from several centres, by Eq. 6, by its boundary alone, and
by the shape context."""


def make_methods(
    names: Iterable[str], within: F64 | None = None, signatures: Signatures | None = None
) -> dict[str, Method]:
    """Methods by name, with the paper's parameters.

    Methods with the same features share them when they are made together, so that the features of a submap
    are extracted once. within : `learned.differences` of other maps, without which no method can be made that
    learns. Raises KeyError for a name that is not known.
    """
    signatures, vectors = signatures or Signatures(), Vectors()
    sift_words, surf_words = Vocabulary(sift), Vocabulary(surf)
    # A spread of 1e6 makes Omega of Eq. 6 equal to 1.
    boundary = Proposed(SignatureConfig(weight_boundary=1.0, symmetry_sigma=1e6))
    ln_bc = SignatureConfig.paper().model_copy(update={"histogram_distance": "bhattacharyya"})
    known: dict[str, Method] = {
        "proposed": Proposed(SignatureConfig.paper(), signatures),
        "proposed_ln_bc": Proposed(ln_bc, signatures),
        "as_used_here": Proposed(),
        "shape_context": ShapeContext(),
        "sift_bow": Words(sift_words, tfidf=False),
        "surf_bow": Words(surf_words, tfidf=False),
        "sift_tfidf": Words(sift_words, tfidf=True),
        "surf_tfidf": Words(surf_words, tfidf=True),
        "sdf": DistanceFeatures(),
        "unlearned": Unlearned(vectors, UNLEARNED),
        "as_used_here_centres": SeveralCentres(method=Proposed()),
        "boundary_centres": SeveralCentres(method=boundary),
        "shape_context_centres": SeveralCentres(method=ShapeContext()),
    }
    if within is not None:
        known |= {name: Learned(vectors, parts, within) for name, parts in LEARNED.items()}
    return {name: known[name] for name in names}


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


@dataclass(frozen=True, slots=True, kw_only=True)
class SeveralCentres:
    """`method` on discs around the points of a lattice.

    reach_m : farthest centre of a disc from that of its submap; the discs are smaller by as much.
    spacing_m : of the lattice. Both are chosen by hand, for queries within 1 m of a centre.
    """

    method: Method
    reach_m: float = 1.0
    spacing_m: float = 0.5

    def fit(self, submaps: Sequence[Submap]) -> _Centres:
        """Describe every disc of every submap."""
        offsets = lattice(self.reach_m, self.spacing_m)
        discs = [smaller_disc(submap, offset, self.reach_m) for submap in submaps for offset in offsets]
        own = np.repeat(np.arange(len(submaps)), len(offsets))
        centers_m = np.array([submap.center_m for submap in submaps]).reshape(-1, 2)
        at_m = centers_m[own] + np.tile(offsets, (len(submaps), 1))
        return _Centres(self.method.fit(discs), _nearest(at_m, centers_m, own), len(submaps), self.reach_m)


def _nearest(at_m: F64, centers_m: F64, own: I64) -> I64:
    """For each disc, at (N, 2), the submap with the nearest centre (M, 2); its own (N,) if none is nearer.

    Submaps overlap. A disc of one of them that lies beside the centre of another one stands for that one.
    """
    if not len(at_m):
        return own
    away_m, nearest = cKDTree(centers_m).query(at_m)
    own_m = np.hypot(*(at_m - centers_m[own]).T)
    return np.where(own_m <= away_m + 1e-9, own, nearest)


@dataclass(frozen=True, slots=True)
class _Centres:
    matcher: Matcher
    owner: I64
    count: int
    reach_m: float

    def similarities(self, query: Submap) -> F64:
        scores = self.matcher.similarities(smaller_disc(query, np.zeros(2), self.reach_m))
        best = np.full(self.count, -np.inf)
        np.maximum.at(best, self.owner, scores)
        return best


def lattice(reach_m: float, spacing_m: float) -> F64:
    """(K, 2) points of a square lattice within `reach_m` of (0, 0), which is one of them."""
    steps = np.arange(-int(reach_m / spacing_m), int(reach_m / spacing_m) + 1) * spacing_m
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(points[np.hypot(*points.T) <= reach_m + 1e-9])


def smaller_disc(submap: Submap, offset_m: F64, less_m: float) -> Submap:
    """The part of a submap within its radius less `less_m` of its centre plus `offset_m` (2,)."""
    grid = submap.grid
    radius_m = submap.radius_m - less_m
    height, width = grid.cells.shape
    middle_m = np.asarray(grid.origin_m) + 0.5 * grid.resolution_m * np.array([width, height]) + offset_m
    part = grid.crop((float(middle_m[0]), float(middle_m[1])), radius_m)
    rows, columns = np.indices(part.cells.shape)
    x_m, y_m = (
        (np.stack((columns, rows), axis=-1) + 0.5) * part.resolution_m + np.asarray(part.origin_m) - middle_m
    ).transpose(2, 0, 1)
    inside = np.hypot(x_m, y_m) <= radius_m + 0.5 * part.resolution_m
    return Submap(
        submap_id=submap.submap_id,
        center_m=submap.center_m,
        radius_m=radius_m,
        grid=OccupancyGrid(
            cells=np.where(inside, part.cells, np.int8(UNKNOWN)),
            resolution_m=part.resolution_m,
            origin_m=part.origin_m,
        ),
    )
