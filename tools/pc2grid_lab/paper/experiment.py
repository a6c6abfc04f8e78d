"""The paper's experiment (IV-B): queries cut from the map, with noise, matched against its submaps.

The noise is mapping errors at walls, and objects in the free space. The paper gives the counts and Figure 8,
not the sizes. These were chosen before any result was known, and are not tuned: a person or a chair is half a
metre wide, a speckle spreads over two cells of 0.05 m. A `Method` describes the submaps of a map, and
compares queries with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import OCCUPIED, UNKNOWN, OccupancyGrid, Submap

Key = TypeVar("Key")
Matcher = Callable[[Submap], F64]
"""Returns the similarity of a query to each of N submaps: (N,), larger is more alike, never NaN."""
Method = Callable[[Sequence[Submap]], Matcher]
"""A way to compare submaps: describes those of a map, and learns from them what it needs, as a vocabulary."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """How queries are drawn and judged.

    queries : number of queries per map (paper IV-B: 2000).
    offset_m : largest distance of a query's centre from the nearest submap's centre. The paper does not give
        it, and the results depend on it. Its F1 rules out 0.5: if a share p of the best matches is right, F1
        is at least 2 p / (1 + p). 1.0 fits best.
    correct_m : a match is true if the matched submap's centre is this near (paper IV-B).
    seed : of everything random. Query i of a seed does not depend on the number of queries, and lies at the
        same place at every noise level.
    """

    queries: int
    offset_m: float = 1.0
    correct_m: float = 1.0
    seed: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class BestMatches:
    """Best match of every query.

    similarity : (Q,) of the best match; larger is more similar, on a scale of the method's own.
    correct : (Q,) bool, whether the best match is true.
    """

    similarity: F64
    correct: NDArray[np.bool_]

    def curve(self) -> PrecisionRecall:
        """Return precision and recall as functions of the similarity threshold; empty if no match is true."""
        if not self.correct.any():
            return PrecisionRecall(recall=np.empty(0), precision=np.empty(0))
        from sklearn.metrics import precision_recall_curve

        precision, recall, _ = precision_recall_curve(self.correct, self.similarity)
        # scikit-learn begins at the lowest threshold, and ends with a point that no match has.
        return PrecisionRecall(recall=recall[-2::-1], precision=precision[-2::-1])

    def measures(self) -> MatchMeasures:
        """Return all measures of these matches."""
        recall, precision = self.curve()
        area, total = 0.0, precision + recall
        if len(recall):
            from sklearn.metrics import auc

            # Trapezoids from recall 0 at the precision of the first point.
            area = float(auc([0.0, *recall], [precision[0], *precision]))
        f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
        rp9 = recall[precision >= 0.9].max(initial=0.0)
        return MatchMeasures(area, float(self.correct.mean()), float(rp9), float(f1.max(initial=0.0)))

    def half_widths(self, resamples: int = 300, seed: int = 0) -> MatchMeasures:
        """Return half of the interval from 5 to 95 % of each measure, by bootstrap over the queries."""
        rng = np.random.default_rng(seed)
        drawn = np.array(
            [
                BestMatches(similarity=self.similarity[rows], correct=self.correct[rows]).measures()
                for rows in rng.integers(len(self.correct), size=(resamples, len(self.correct)))
            ]
        )
        return MatchMeasures(*(np.diff(np.quantile(drawn, (0.05, 0.95), axis=0), axis=0)[0] / 2).tolist())


class MatchMeasures(NamedTuple):
    """Area under the precision-recall curve, the share of the queries whose best match is true (R@1), the
    largest recall at a precision of at least 0.9 (0 if there is none), and the largest F1 over the
    thresholds; each 0 .. 1. R@1 is not in the paper.
    """

    auc: float
    r_at_1: float
    rp9: float
    f1: float


class PrecisionRecall(NamedTuple):
    """A precision-recall curve, from the highest threshold to the lowest.

    recall, precision : (T,), one point for each distinct similarity.

    Recall is the share of the true matches that pass the threshold, so that it ends at 1. The paper does not
    define it, but its Table III shows it: if recall were a share of all queries, the area could not exceed
    the share of true matches, and F1 is at least that share; in most rows, however, AUC exceeds F1.
    """

    recall: F64
    precision: F64


def draw_queries(
    grid: OccupancyGrid, centers_m: F64, radius_m: float, experiment: Experiment, noise: Noise
) -> Iterator[Submap]:
    """Query submaps: cut at a free place near a submap's centre, turned at random, with noise (IV-B).

    centers_m : (N, 2) of the submaps. `center_m` of a query is the place where it was cut; its grid is
    centred on (0, 0) of a turned frame of its own, so that nothing in it shows the place.
    """
    for index in range(experiment.queries):
        rng = np.random.default_rng([experiment.seed, index])
        center_m = _free_place(grid, centers_m, experiment.offset_m, rng)
        turned = rotated_submap(grid, center_m, radius_m, float(rng.uniform(-math.pi, math.pi)), index)
        # The noise has a random stream of its own, so that its amount does not change the next query.
        yield add_noise(turned, noise, np.random.default_rng([experiment.seed, index, noise.boundary]))


def _free_place(
    grid: OccupancyGrid, centers_m: F64, offset_m: float, rng: np.random.Generator
) -> tuple[float, float]:
    """Draw a place from the disc of `offset_m` around a random centre, until its cell is free."""
    for _ in range(1000):
        angle, reach = rng.uniform(0, 2 * math.pi), offset_m * math.sqrt(rng.random())
        place = centers_m[rng.integers(len(centers_m))] + reach * np.array([math.cos(angle), math.sin(angle)])
        if grid.is_free(float(place[0]), float(place[1])):
            return float(place[0]), float(place[1])
    raise ValueError(f"no free cell within {offset_m} m of any submap centre")


def rotated_submap(
    grid: OccupancyGrid, center_m: tuple[float, float], radius_m: float, angle_rad: float, submap_id: int = 0
) -> Submap:
    """Return the disc around a place, in a frame turned by `angle_rad`; cells are copied from the nearest
    ones."""
    resolution = grid.resolution_m
    n = round(radius_m / resolution)
    # A square that contains every rotation is cut first, because warpAffine reads its whole input.
    around = grid.crop(center_m, radius_m + 2 * resolution)
    x, y = (np.asarray(center_m) - around.origin_m) / resolution - 0.5
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    to_map = np.array([[c, -s, x - c * n + s * n], [s, c, y - s * n - c * n]])
    cells = cv2.warpAffine(
        np.ascontiguousarray(around.cells).view(np.uint8),
        to_map,
        (2 * n + 1, 2 * n + 1),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=255,
    ).view(np.int8)
    steps = np.arange(-n, n + 1) ** 2
    cells = np.where(steps[:, None] + steps <= (radius_m / resolution) ** 2 + 1e-9, cells, np.int8(UNKNOWN))
    half_m = (n + 0.5) * resolution
    return Submap(
        submap_id=submap_id,
        center_m=center_m,
        radius_m=radius_m,
        grid=OccupancyGrid(cells=cells, resolution_m=resolution, origin_m=(-half_m, -half_m)),
    )


def evaluate(
    methods: Mapping[str, Method],
    grid: OccupancyGrid,
    submaps: Sequence[Submap],
    experiment: Experiment,
    noise: Noise,
) -> dict[str, BestMatches]:
    """Return cells of Table III: the methods on one map at one noise level, all on the same queries.

    submaps : the map's partition, all of one radius. Raises ValueError if there are no submaps.
    """
    if not submaps:
        raise ValueError("a map without submaps cannot be evaluated")
    matchers = {name: method(submaps) for name, method in methods.items()}
    return best_matches(matchers, grid, submaps, experiment, noise)


def best_matches(
    matchers: Mapping[Key, Matcher],
    grid: OccupancyGrid,
    submaps: Sequence[Submap],
    experiment: Experiment,
    noise: Noise,
) -> dict[Key, BestMatches]:
    """Return the best matches of methods that were fitted to the submaps."""
    centers_m = np.array([submap.center_m for submap in submaps])
    similarity = {key: np.empty(experiment.queries) for key in matchers}
    correct = {key: np.empty(experiment.queries, np.bool_) for key in matchers}
    for i, query in enumerate(draw_queries(grid, centers_m, submaps[0].radius_m, experiment, noise)):
        for key, matcher in matchers.items():
            scores = matcher(query)
            best = int(np.argmax(scores))
            similarity[key][i] = scores[best]
            correct[key][i] = math.dist(centers_m[best], query.center_m) <= experiment.correct_m
    return {key: BestMatches(similarity=similarity[key], correct=correct[key]) for key in matchers}


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """How much noise of both kinds, and of which size.

    boundary : N_b, occupied cells around which speckles are put.
    freespace : N_f, unoccupied cells on which obstacles are put: the paper calls them so, and half or more of
        them are unknown. Its sentence is read as printed.
    speckles : number of occupied cells put around each of the N_b, with normally distributed offsets.
    speckle_sigma_m : standard deviation of these offsets, per axis.
    obstacle_m : r_n, radius of the circles and half the width of the squares; both are filled, and equally
        likely.
    """

    boundary: int
    freespace: int
    speckles: int = 10
    speckle_sigma_m: float = 0.1
    obstacle_m: float = 0.25


NOISE_LEVELS = (
    Noise(boundary=0, freespace=0),
    Noise(boundary=50, freespace=10),
    Noise(boundary=100, freespace=20),
)
"""No noise, level 1 and level 2 of Figure 8."""


def add_noise(submap: Submap, noise: Noise, rng: np.random.Generator) -> Submap:
    """Return the submap with noise inside its radius. Boundary noise needs occupied cells, free-space noise
    unoccupied ones."""
    grid = submap.grid
    image = np.ascontiguousarray(grid.cells).astype(np.int16)
    center = (np.array(image.shape) - 1) / 2
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    beyond = (rows - center[0]) ** 2 + (columns - center[1]) ** 2 > (submap.radius_m / grid.resolution_m) ** 2
    occupied, unoccupied = np.argwhere(grid.occupied), np.argwhere(~(grid.occupied | beyond))
    if noise.freespace and len(unoccupied):
        half = round(noise.obstacle_m / grid.resolution_m)
        for (row, column), circle in zip(
            unoccupied[rng.integers(len(unoccupied), size=noise.freespace)].tolist(),
            (rng.random(noise.freespace) < 0.5).tolist(),
            strict=True,
        ):
            if circle:
                cv2.circle(image, (column, row), half, OCCUPIED, cv2.FILLED)
            else:
                cv2.rectangle(
                    image, (column - half, row - half), (column + half, row + half), OCCUPIED, cv2.FILLED
                )
    if noise.boundary and len(occupied):
        at = occupied[rng.integers(len(occupied), size=noise.boundary)]
        spread = rng.normal(
            0.0, noise.speckle_sigma_m / grid.resolution_m, (noise.boundary, noise.speckles, 2)
        )
        cells = (at[:, None] + np.rint(spread).astype(np.int64)).reshape(-1, 2)
        cells = cells[((cells >= 0) & (cells < image.shape)).all(axis=1)]
        image[cells[:, 0], cells[:, 1]] = OCCUPIED
    image[beyond] = UNKNOWN
    noisy = OccupancyGrid(cells=image.astype(np.int8), resolution_m=grid.resolution_m, origin_m=grid.origin_m)
    return replace(submap, grid=noisy)
