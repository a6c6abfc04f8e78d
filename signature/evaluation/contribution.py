"""What do the three signatures contribute, and do they depend on the sensor?

Two figures. Independence: how far apart one place seen by two sensors is, against two places seen by one
sensor; a signature that depends on the sensor confuses the two. Ablation: how well places are found by
each signature alone, by two, and by all three.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.partition import view_at
from signature.config import SignatureConfig
from signature.describe import Signature, describe
from signature.evaluation.mapped import Mapped
from signature.places import Places
from signature.query import QueryMap
from signature.similarity import SignatureTable, histogram_distance, structural_factor

PARTS = ("boundary", "freespace", "symmetry")
COMBINATIONS = tuple("+".join(c) for n in (1, 2, 3) for c in itertools.combinations(PARTS, n))
"""The names of all ways to leave signatures out; the last one is Eq. 6 with all three."""

FAR_M = 3.0
"""Places of one map this far apart are different places."""


def part_distances(query: Signature, table: SignatureTable, config: SignatureConfig) -> dict[str, F64]:
    """Distance of a signature to every row, (N,), for each of `COMBINATIONS`.

    Eq. 6 without the terms that are left out; symmetry alone is the structural factor Omega.
    """
    omega = structural_factor(query.symmetry[None], table.symmetry, config)[0]
    boundary = histogram_distance(query.boundary[None], table.boundary, config)[0]
    freespace = histogram_distance(query.freespace[None], table.freespace, config)[0]
    w = config.weight_boundary
    terms = {"boundary": w * boundary, "freespace": (1.0 - w) * freespace}
    found = {}
    for name in COMBINATIONS:
        parts = name.split("+")
        histograms = [terms[part] for part in parts if part in terms]
        total = np.sum(histograms, axis=0) if histograms else np.ones(len(table))
        found[name] = np.asarray(omega * total if "symmetry" in parts else total)
    return found


def ranks(
    query: QueryMap, places: Places, T_map_query: SE2, config: SignatureConfig, within_m: float
) -> dict[str, int]:
    """For each combination, the rank of the first place within `within_m` of where a view truly lies; -1
    if there is none. Every view speaks by how far a place stands out to it, as in `signature.retrieve`."""
    if not query.views or not len(places.table):
        return dict.fromkeys(COMBINATIONS, -1)
    right = np.zeros((len(query.views), len(places.table)), bool)
    voice = {name: np.empty(right.shape) for name in COMBINATIONS}
    for i, view in enumerate(query.views):
        true = T_map_query.apply(np.array([view.center_m]))[0]
        right[i] = np.hypot(*(places.table.center_m - true).T) <= within_m
        for name, distance in part_distances(view.signature, places.table, config).items():
            spread = float(distance.std())
            voice[name][i] = (distance.mean() - distance) / spread if spread > 0 else 0.0
    found = {}
    for name, voices in voice.items():
        order = np.argsort(-voices.max(axis=0), kind="stable")
        view = voices.argmax(axis=0)
        hits = np.flatnonzero(right[view[order], order])
        found[name] = int(hits[0]) if len(hits) else -1
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Independence:
    """Distances by one combination of signatures.

    same : of one place, seen by two sensors. other : of two places far apart, seen by one sensor.
    auc : probability that the first is smaller; 0.5 says nothing, 1 tells them apart always.
    """

    combination: str
    same: F64
    other: F64

    @staticmethod
    def together(measured: Sequence[Independence]) -> Independence:
        """Several buildings as one."""
        return Independence(
            combination=measured[0].combination,
            same=np.concatenate([m.same for m in measured]),
            other=np.concatenate([m.other for m in measured]),
        )

    @property
    def auc(self) -> float:
        """Area under the curve of true against false positives (Mann-Whitney)."""
        from scipy.stats import rankdata

        n = len(self.same)
        if not n or not len(self.other):
            return float("nan")
        ranked = rankdata(np.concatenate((self.same, self.other)))
        return float(1.0 - (ranked[:n].sum() - n * (n + 1) / 2) / (n * len(self.other)))


def independence(maps: Sequence[Mapped]) -> tuple[Independence, ...]:
    """Compare one building as several sensors mapped it, for each combination of signatures.

    The places are those of each map in turn; where another map knows the ground there, it is cut and
    described at the same point of the building.
    """
    same: dict[str, list[F64]] = {name: [] for name in COMBINATIONS}
    other: dict[str, list[F64]] = {name: [] for name in COMBINATIONS}
    for one in maps:
        table, config = one.building.places.table, one.building.made_with.signature
        apart = np.hypot(*(table.center_m[:, None] - table.center_m[None]).transpose(2, 0, 1)) >= FAR_M
        signatures = [_row(table, i) for i in range(len(table))]
        for i, mine in enumerate(signatures):
            for name, distance in part_distances(mine, table, config).items():
                other[name].append(distance[apart[i]])
        for two in maps:
            if two is one:
                continue
            T_two_one = two.T_plan_map.inverse() @ one.T_plan_map
            for mine, center in zip(signatures, T_two_one.apply(table.center_m), strict=True):
                theirs = _seen_from(two, center)
                if theirs is not None:
                    single = SignatureTable.of([theirs], center)
                    for name, distance in part_distances(mine, single, config).items():
                        same[name].append(distance)
    return tuple(
        Independence(
            combination=name,
            same=np.concatenate([np.empty(0), *same[name]]),
            other=np.concatenate([np.empty(0), *other[name]]),
        )
        for name in COMBINATIONS
    )


def _row(table: SignatureTable, i: int) -> Signature:
    return Signature(boundary=table.boundary[i], freespace=table.freespace[i], symmetry=table.symmetry[i])


def _seen_from(mapped: Mapped, center: F64) -> Signature | None:
    """What a map shows from a point; None where it does not know it as free."""
    building = mapped.building
    grid = building.grids[0]
    row, column = grid.to_cell(center[None])[0]
    height, width = grid.cells.shape
    if not (0 <= row < height and 0 <= column < width and grid.free[row, column]):
        return None
    made_with = building.made_with
    return describe(
        view_at(grid, (float(center[0]), float(center[1])), made_with.partition), made_with.signature
    )
