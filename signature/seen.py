"""The three signatures of what was seen: of an isovist, without the rays whose ends are hidden.

A submap of a map is known whole, a view of a query often in part: a camera that has driven a metre has seen a
quarter of what surrounds it. The histograms of III-B to III-D then compare a part with a whole. Here every
bin is a share of what *was seen*: a ray that ends on unknown cells, and each pair of rays with such a ray,
counts neither for nor against. A part then has about the histogram of the whole.

All three are invariant to rotation, as in the paper. They are:

- boundary: the distances of wall points from the viewpoint (range), and of all pairs of them from each other
  (Eq. 1-2);
- free space: the lengths of the shortest paths between the viewpoint and the ends of every second ray, inside
  of what is seen (Eq. 3-4), how much longer than the straight line they are (detour), and the openings
  through which it goes on, which are steps between the ranges of neighbouring rays;
- symmetry: how well the ranges agree with their mirror image (Eq. 5), at the best axis, at axes beside it,
  and over all axes, and with themselves turned by half a circle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid.submaps.isovist import HIDDEN, OPEN

if TYPE_CHECKING:
    import networkx as nx


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenParameters:
    """Bins of the signatures of what was seen. Chosen by hand unless said otherwise.

    range_bins : of distances from the viewpoint, up to the limit of sight.
    pair_bins, path_bins : of distances of two wall points, and of lengths of paths, up to twice the limit of
        sight. On sessions of office 1, csail and fr079 the right place came earlier with 40 bins of pairs
        than with 20: as number 63, 37 and 24 of 30,000 instead of 101, 37 and 34, after 1, 3 and 8 m.
    steps_m : edges of the bins of the step between neighbouring rays.
    every : the ends of so many-th rays are nodes of the free-space graph.
    detours : bins of the share by which a path is longer than the straight line.
    largest_detour : share from which a path counts in the last of these bins.
    touch_m : a straight line may leave what is seen by this, about the width of a cell.
    mirror_m : two ranges that differ by this do not agree at all.
    few : rays added to the number of mirrored pairs, as a share of all rays, so that the agreement of few
        pairs counts for less.
    """

    range_bins: int = 20
    pair_bins: int = 40
    path_bins: int = 20
    steps_m: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.0)
    every: int = 2
    detours: int = 6
    largest_detour: float = 5.0 / 12.0
    touch_m: float = 0.05
    mirror_m: float = 0.5
    few: float = 0.15


SEEN = SeenParameters()

_AT_ONCE = 4096
"""Isovists whose pairs are in memory at the same time."""
_AXES = ((0,), (0.5,), (0.25, 0.75), (0.125, -0.125), (0.375, -0.375))
"""Directions of mirror axes relative to the best one, as shares of half a circle; the mean of each group."""
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
_NO_PATH = 1e6
"""Metres; longer than any path."""


def parts() -> dict[str, slice]:
    """Which columns of `seen_signatures` belong to which of the three signatures."""
    p = SEEN
    sizes = {
        "boundary": p.range_bins + 1 + p.pair_bins + 2,
        "freespace": p.path_bins + p.detours + len(p.steps_m) + 1,
        "symmetry": len(_AXES) + 2 + len(_QUANTILES) + 1,
    }
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def signature_columns() -> slice:
    """All columns of the three signatures; the last one, the share of rays that were seen, is left out."""
    return slice(0, -1)


def seen_signatures(ranges_m: F32, ends: NDArray[np.int8], sight_m: float) -> F32:
    """The signatures of what was seen, side by side, and the share that was seen: (N, K) float32.

    ranges_m, ends : (N, B) of isovists, as of `pc2grid.submaps.isovist.look_around` with `sight_m`, B a
    multiple of 8. The columns of each signature are those of `parts`. Histograms are square roots of shares,
    so that their Euclidean distance is that of Hellinger, and 0 where nothing was seen. The last column is
    the share of the rays, 0..1, whose ends are known.
    """
    found = [
        np.concatenate(
            (
                boundary_seen(ranges_m[part], ends[part], sight_m),
                freespace_seen(ranges_m[part], ends[part], sight_m),
                symmetry_seen(ranges_m[part], ends[part]),
                np.mean(ends[part] != HIDDEN, axis=1, keepdims=True),
            ),
            axis=1,
        )
        for part in (slice(at, at + _AT_ONCE) for at in range(0, max(len(ranges_m), 1), _AT_ONCE))
    ]
    return np.concatenate(found).astype(np.float32)


def boundary_seen(ranges_m: F32, ends: NDArray[np.int8], sight_m: float) -> F64:
    """(N, Kb) square roots of the shares of ranges and of pair distances.

    A ray without a wall within sight has no distance, but says that there is none: such rays, pairs with one
    and pairs of two have bins of their own.
    """
    bearings = ranges_m.shape[1]
    seen, open_end = ends != HIDDEN, ends == OPEN
    at = np.minimum((ranges_m / sight_m * SEEN.range_bins).astype(np.int64), SEEN.range_bins - 1)
    ranges = _shares(np.where(open_end, SEEN.range_bins, at), seen, SEEN.range_bins + 1)
    squares = ranges_m.astype(np.float64) ** 2
    pairs = np.zeros((len(ranges_m), SEEN.pair_bins + 2))
    for apart in range(1, bearings // 2 + 1):
        # Opposite rays are paired twice.
        count = bearings if 2 * apart < bearings else bearings // 2
        other, other_seen, other_open = (np.roll(v, -apart, axis=1) for v in (ranges_m, seen, open_end))
        cosine = math.cos(2.0 * math.pi * apart / bearings)
        squared_m2 = squares + np.roll(squares, -apart, axis=1) - 2.0 * cosine * ranges_m * other
        distance_bins = np.sqrt(np.maximum(squared_m2, 0.0)) * (SEEN.pair_bins / (2.0 * sight_m))
        at = np.minimum(distance_bins.astype(np.int64), SEEN.pair_bins - 1)
        at = np.where(open_end | other_open, SEEN.pair_bins + (open_end & other_open), at)
        pairs += _counts(at[:, :count], (seen & other_seen)[:, :count], SEEN.pair_bins + 2)
    return np.sqrt(np.concatenate((ranges, _as_shares(pairs)), axis=1))


def freespace_seen(ranges_m: F32, ends: NDArray[np.int8], sight_m: float) -> F64:
    """(N, Kf) square roots of the shares of path lengths and of detours between all nodes of `seen_graph`,
    and of steps."""
    lengths_m, straight_m = path_lengths(ranges_m, ends)
    first, second = np.triu_indices(lengths_m.shape[1], 1)
    lengths, straight = lengths_m[:, first, second], straight_m[:, first, second]
    known = lengths < _NO_PATH
    at = np.minimum(lengths / (2.0 * sight_m) * SEEN.path_bins + 1e-6, SEEN.path_bins - 1).astype(np.int64)
    paths = _shares(at, known, SEEN.path_bins)
    # From the viewpoint, node 0, every path is straight.
    detour = (lengths - straight) / np.maximum(lengths, 1e-6) * ((SEEN.detours - 1) / SEEN.largest_detour)
    at = np.minimum(detour, SEEN.detours - 1).astype(np.int64)
    detours = _shares(at, known & (first > 0), SEEN.detours)
    seen = ends != HIDDEN
    step_m = np.abs(ranges_m - np.roll(ranges_m, -1, axis=1))
    at = np.searchsorted(np.array(SEEN.steps_m), step_m)
    steps = _shares(at, seen & np.roll(seen, -1, axis=1), len(SEEN.steps_m) + 1)
    return np.sqrt(np.concatenate((paths, detours, steps), axis=1))


def seen_graph(ranges_m: F32, ends: NDArray[np.int8]) -> nx.Graph:
    """The free-space graph of one isovist (B,): node 0 is the viewpoint, node 1 + k the end of ray k `every`.

    Nodes of rays whose ends are hidden are left out. Edges with `length_m` join nodes whose straight line
    stays inside of what is seen (III-C 2).
    """
    import networkx as nx

    points_m, known, visible = _nodes(ranges_m[None], ends[None])
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(known[0]).tolist())
    for a, b in np.argwhere(np.triu(visible[0], 1)).tolist():
        graph.add_edge(a, b, length_m=math.dist(points_m[0, a], points_m[0, b]))
    return graph


def path_lengths(ranges_m: F32, ends: NDArray[np.int8]) -> tuple[F64, F64]:
    """Lengths (N, M, M) of the shortest paths and of the straight lines between the nodes of `seen_graph`.

    Of nodes that are left out, the paths are `_NO_PATH` long. All isovists together, by Floyd and Warshall's
    algorithm: 0.1 ms each, where networkx' Dijkstra takes 10.
    """
    points_m, _, visible = _nodes(ranges_m, ends)
    straight_m = np.hypot(*(points_m[:, :, None] - points_m[:, None]).transpose(3, 0, 1, 2))
    lengths_m = np.where(visible, straight_m, _NO_PATH)
    for via in range(lengths_m.shape[1]):
        np.minimum(lengths_m, lengths_m[:, :, via, None] + lengths_m[:, None, via], out=lengths_m)
    return np.minimum(lengths_m, _NO_PATH), straight_m


def _nodes(ranges_m: F32, ends: NDArray[np.int8]) -> tuple[F64, NDArray[np.bool_], NDArray[np.bool_]]:
    """Points (N, M, 2) of the nodes of `seen_graph`, which are known (N, M), and which pairs see each other
    (N, M, M)."""
    count, bearings = ranges_m.shape
    angles = 2.0 * math.pi * np.arange(bearings) / bearings
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    at = np.arange(0, bearings, SEEN.every)
    nodes = 1 + len(at)
    points_m = np.zeros((count, nodes, 2))
    points_m[:, 1:] = ranges_m[:, at, None] * directions[at]
    known = np.ones((count, nodes), bool)
    known[:, 1:] = ends[:, at] != HIDDEN
    visible = np.zeros((count, nodes, nodes), bool)
    visible[:, 0], visible[:, :, 0] = True, True
    reach_m = ranges_m + SEEN.touch_m
    for apart in range(1, (len(at) - 1) // 2 + 1):
        # The line from end a to end b crosses each ray between them at a distance of
        # r_a r_b sin(b - a) / (r_a sin(k - a) + r_b sin(b - k)).
        other = np.roll(ranges_m, -apart * SEEN.every, axis=1)[:, at]
        own = ranges_m[:, at]
        across = own * other * math.sin(angles[apart * SEEN.every])
        clear = np.ones(own.shape, bool)
        for between in range(1, apart * SEEN.every):
            wide = own * math.sin(angles[between]) + other * math.sin(angles[apart * SEEN.every - between])
            clear &= across <= wide * np.roll(reach_m, -between, axis=1)[:, at]
        a = np.arange(len(at))
        b = (a + apart) % len(at)
        visible[:, 1 + a, 1 + b], visible[:, 1 + b, 1 + a] = clear, clear
    visible &= known[:, :, None] & known[:, None]
    return points_m, known, visible


def symmetry_seen(ranges_m: F32, ends: NDArray[np.int8]) -> F64:
    """(N, Ks) agreement, 0..1, of the ranges with their mirror image, and turned by half a circle.

    The mirror axes pass through the viewpoint, one every half ray. The columns: at the best axis, at those of
    `_AXES` beside it (of the two diagonal ones the worse and the better), the mean of all, their quantiles,
    and the agreement after half a turn.
    """
    count, bearings = ranges_m.shape
    agreement = mirror_agreement(ranges_m, ends)
    best = agreement.argmax(axis=1)
    beside = [
        agreement[
            np.arange(count)[:, None],
            (best[:, None] + np.array([round(s * bearings) for s in axes])) % bearings,
        ]
        for axes in _AXES
    ]
    diagonal = np.sort(beside[2], axis=1)
    columns = [beside[0], beside[1], diagonal, *(b.mean(axis=1, keepdims=True) for b in beside[3:])]
    columns += [agreement.mean(axis=1, keepdims=True), np.quantile(agreement, _QUANTILES, axis=1).T]
    opposite = (np.arange(bearings) + bearings // 2) % bearings
    half_turn = _agreement(ranges_m, ends != HIDDEN, opposite)
    return np.concatenate([*columns, half_turn[:, None]], axis=1)


def mirror_agreement(ranges_m: F32, ends: NDArray[np.int8]) -> F64:
    """(N, B) agreement, 0..1, of the ranges with their mirror image at each axis through the viewpoint; axis
    k lies pi k / B from the first ray."""
    rays, seen = np.arange(ranges_m.shape[1]), ends != HIDDEN
    at_each = [_agreement(ranges_m, seen, (axis - rays) % len(rays)) for axis in rays]
    return np.stack(at_each, axis=1)


def _agreement(ranges_m: F32, seen: NDArray[np.bool_], partner: NDArray[np.intp]) -> F64:
    """(N,) mean agreement of each range with that of its partner (B,), where both are known."""
    both = seen & seen[:, partner]
    apart = np.abs(ranges_m - ranges_m[:, partner]) / SEEN.mirror_m
    total = (np.maximum(0.0, 1.0 - apart) * both).sum(axis=1)
    return np.asarray(total / (both.sum(axis=1) + SEEN.few * ranges_m.shape[1]))


def _counts(at: NDArray[np.int64], valid: NDArray[np.bool_], bins: int) -> F64:
    """(N, bins) how many valid entries of each row of `at` (N, M) lie in each bin."""
    rows = np.arange(len(at))[:, None] * bins
    return np.bincount((rows + at)[valid], minlength=len(at) * bins).reshape(len(at), bins).astype(np.float64)


def _as_shares(counts: F64) -> F64:
    return np.asarray(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0))


def _shares(at: NDArray[np.int64], valid: NDArray[np.bool_], bins: int) -> F64:
    """`_counts` as shares of the row; all 0 without a valid entry."""
    return _as_shares(_counts(at, valid, bins))
