"""What the three signatures contribute, and whether they depend on the sensor.

Two measures. Independence: distances between the signatures of one place seen by two sensors, compared with
those of two places seen by one sensor; a signature that depends on the sensor does not separate them.
Ablation: the recall of places by each signature alone, by two of them, and by all three.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.partition import view_at
from pc2grid_lab.experiments.calibration import area
from pc2grid_lab.experiments.metrics import recall
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import Trial
from signature.config import SignatureConfig
from signature.describe import Signature, describe
from signature.localization.query import QueryMap
from signature.retrieval.viewpoints import Places
from signature.similarity import SignatureTable, histogram_distance, structural_factor

PARTS = ("boundary", "freespace", "symmetry")
COMBINATIONS = tuple("+".join(c) for n in (1, 2, 3) for c in itertools.combinations(PARTS, n))
"""The names of all combinations of signatures; the last one is Eq. 6 with all three."""

FAR_M = 3.0
"""Places of one map count as different if they are this far apart; chosen by hand."""


def part_distances(query: Signature, table: SignatureTable, config: SignatureConfig) -> dict[str, F64]:
    """Distances (N,) of a signature to every row, for each of `COMBINATIONS`.

    They are Eq. 6 without the terms of the other signatures; symmetry alone is the structural factor Omega.
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
    """For each of `COMBINATIONS`, the rank of the first place within `within_m` of where a view truly lies.

    The rank is -1 if there is no such place.

    A place is ranked by the largest of its z-scores over the views, as in `signature.retrieval.vote`.
    """
    if not query.views or not len(places.table):
        return dict.fromkeys(COMBINATIONS, -1)
    right = np.zeros((len(query.views), len(places.table)), bool)
    z_scores = {name: np.empty(right.shape) for name in COMBINATIONS}
    for i, view in enumerate(query.views):
        true_m = T_map_query.apply(np.array([view.center_m]))[0]
        right[i] = np.hypot(*(places.table.center_m - true_m).T) <= within_m
        for name, distance in part_distances(view.signature, places.table, config).items():
            deviation = float(distance.std())
            z_scores[name][i] = (distance.mean() - distance) / deviation if deviation > 0 else 0.0
    found = {}
    for name, z_score in z_scores.items():
        order = np.argsort(-z_score.max(axis=0), kind="stable")
        view = z_score.argmax(axis=0)
        hits = np.flatnonzero(right[view[order], order])
        found[name] = int(hits[0]) if len(hits) else -1
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Independence:
    """Distances by one combination of signatures.

    same : between descriptions of one place by two sensors. other : between two places that are far apart,
    described by one sensor.
    """

    combination: str
    same: F64
    other: F64

    @staticmethod
    def together(measured: Sequence[Independence]) -> Independence:
        """The distances of several buildings together."""
        return Independence(
            combination=measured[0].combination,
            same=np.concatenate([m.same for m in measured]),
            other=np.concatenate([m.other for m in measured]),
        )

    @property
    def auc(self) -> float:
        """Probability that a distance of `same` is smaller than one of `other`; NaN without distances."""
        return area(self.other, self.same)


def independence(maps: Sequence[SensorMap]) -> tuple[Independence, ...]:
    """Compare maps of one building made by several sensors, for each of `COMBINATIONS`.

    The places of each map are taken in turn. Each is compared with the other maps, which are described at the
    same point of the building if that point is free in them.
    """
    same: dict[str, list[F64]] = {name: [np.empty(0)] for name in COMBINATIONS}
    other: dict[str, list[F64]] = {name: [np.empty(0)] for name in COMBINATIONS}
    for one in maps:
        table, config = one.index.places.table, one.index.made_with.signature
        signatures = [_row(table, i) for i in range(len(table))]
        far = cdist(table.center_m, table.center_m) >= FAR_M
        for mine, chosen in zip(signatures, far, strict=True):
            _append(other, part_distances(mine, table, config), chosen)
        for two in (m for m in maps if m is not one):
            T_two_one = two.T_plan_map.inverse() @ one.T_plan_map
            for mine, center in zip(signatures, T_two_one.apply(table.center_m), strict=True):
                theirs = _signature_at(two, center)
                if theirs is not None:
                    _append(same, part_distances(mine, SignatureTable.of([theirs], center), config))
    return tuple(
        Independence(combination=name, same=np.concatenate(same[name]), other=np.concatenate(other[name]))
        for name in COMBINATIONS
    )


def _append(
    found: dict[str, list[F64]], distances: dict[str, F64], chosen: slice | NDArray[np.bool_] = slice(None)
) -> None:
    for name, distance in distances.items():
        found[name].append(distance[chosen])


def _is_free(grid: OccupancyGrid, point_m: F64) -> bool:
    row, column = grid.to_cell(point_m[None])[0]
    height, width = grid.cells.shape
    return bool(0 <= row < height and 0 <= column < width and grid.free[row, column])


def _row(table: SignatureTable, i: int) -> Signature:
    return Signature(boundary=table.boundary[i], freespace=table.freespace[i], symmetry=table.symmetry[i])


def _signature_at(sensor_map: SensorMap, center: F64) -> Signature | None:
    """The signature of a map at a point; None if the point is not free in it."""
    index = sensor_map.index
    grid = index.grids[0]
    if not _is_free(grid, center):
        return None
    made_with = index.made_with
    view = view_at(grid, (float(center[0]), float(center[1])), made_with.partition)
    return describe(view, made_with.signature)


def recall_by_combination(
    trials: Sequence[Trial], travel_m: float
) -> dict[str, dict[str, dict[int, float | None]]]:
    """Recall of the right place after some metres of travel, by query sensor (and "all") and by what is used.

    What is used: each of `COMBINATIONS`, and "with isovists": all three signatures, then the comparison of
    isovists.
    """
    members = [t for t in trials if t.in_map and t.travel_m == travel_m]
    found: dict[str, dict[str, dict[int, float | None]]] = {}
    for sensor in ("all", *sorted({t.query_sensor for t in members})):
        chosen = [t for t in members if sensor in ("all", t.query_sensor)]
        found[sensor] = {name: recall([t.alone[name] for t in chosen]) for name in COMBINATIONS}
        found[sensor]["with isovists"] = recall([t.rank for t in chosen])
    return found
