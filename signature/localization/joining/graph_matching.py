"""Two junction graphs matched: sets of node pairs that agree on how one session lies to the other.

1. Every node of one graph is paired with the nodes of the other that its signatures say it may be; isovists
   compared at every rotation say at which heading. A pair with a heading is a transform.
2. Two pairs agree if one transform explains both: the distance between their nodes is the same in both
   sessions, and so is the direction. What is allowed grows with the length of the way between them in the
   graphs, as the error of a map does.
3. The consistent sets are found by the spectral method of Leordeanu and Hebert, "A spectral technique for
   correspondence problems using pairwise constraints" (ICCV 2005): the leading eigenvector of the matrix of
   agreements holds how much each pair belongs to the largest set. It stands for the maximum clique, which
   takes exponential time. The next set is found among the pairs that are left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from pc2grid.arrays import F64, I64
from pc2grid.geometry import SE2, wrap_angle
from signature.localization.joining.landmarks import Landmarks
from signature.retrieval.likeness import peaks, rotate_and_compare
from signature.seen_likelihood import seen_spread, seen_weights


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphMatchingParameters:
    """How two graphs are matched. By hand.

    partners : nodes of the other graph that a node is paired with, the likeliest by signatures.
    headings : at which each pair is tried. pairs : the likeliest of all that are compared with each other.
    near_m, drift, turn_rad : two pairs agree if their nodes are displaced by less than `near_m` and the share
        `drift` of the way between them, at headings that differ by less than `turn_rad`: the spacing of
        nodes, and two rays of their isovists.
    sets : that are reported at most. least : pairs of a set at least; two nodes agree by chance.
    """

    partners: int = 12
    headings: int = 2
    pairs: int = 2000
    near_m: float = 1.0
    drift: float = 0.03
    turn_rad: float = math.radians(15.0)
    sets: int = 20
    least: int = 3


GRAPH_MATCHING = GraphMatchingParameters()
_ROUNDS = 50
"""Of the power iteration; the largest sets do not change after 20."""
_LEAST_STRENGTH = 1e-4
"""Of a pair that belongs to a set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """A set of pairs of nodes that agree on one transform.

    T_target_source : by least squares over the nodes. at_m : (x, y) the middle of the nodes in the source.
    evidence : sum of the log-likelihood ratios of the pairs. nodes : how many different nodes of the source.
    """

    T_target_source: SE2
    at_m: tuple[float, float]
    evidence: float
    nodes: int


@dataclass(frozen=True, slots=True)
class NodePairs:
    """P pairs of a node of the target and one of the source, with the heading of the source in the target.

    target, source, yaw_rad (P,). log_ratio (P,) : by signatures, of the two being one place.
    """

    target: I64
    source: I64
    yaw_rad: F64
    log_ratio: F64

    def only(self, kept: I64) -> NodePairs:
        """Some of the pairs."""
        return NodePairs(self.target[kept], self.source[kept], self.yaw_rad[kept], self.log_ratio[kept])


def align_graphs(target: Landmarks, source: Landmarks) -> tuple[Alignment, ...]:
    """The ways in which a source may lie in a target, those with most evidence first."""
    if not len(target) or not len(source):
        return ()
    pairs = node_pairs(target, source)
    agreement = agreements(target, source, pairs)
    found, left = [], np.arange(len(pairs.target))
    for _ in range(GRAPH_MATCHING.sets):
        members = consistent_set(agreement[left][:, left])
        if len(members) < GRAPH_MATCHING.least:
            break
        found.append(_alignment(target, source, pairs.only(left[members])))
        # What agrees with the strongest pair of a set would give the same transform again.
        left = np.setdiff1d(left, agreeing(agreement, left[members[0]]))
    return tuple(sorted(found, key=lambda alignment: -alignment.evidence))


def node_pairs(target: Landmarks, source: Landmarks) -> NodePairs:
    """The pairs that signatures and isovists propose."""
    p = GRAPH_MATCHING
    ratio = likeness_of_nodes(target, source)
    partners = np.argsort(-ratio, axis=0, kind="stable")[: p.partners]
    bearings = target.ranges_m.shape[1]
    found = []
    for node in range(len(source)):
        others = partners[:, node]
        likeness = rotate_and_compare(
            source.ranges_m[node, None], source.seen[node, None], target.ranges_m[others], target.seen[others]
        )[0]
        column, shift = peaks(likeness, np.arange(len(others)))
        # Of each partner the headings that fit best.
        order = np.lexsort((-likeness[shift, column], column))
        rank = np.arange(len(order)) - np.searchsorted(column[order], column[order])
        order = order[rank < p.headings]
        at = others[column[order]]
        found.append((at, np.full(len(at), node), shift[order] * (2.0 * math.pi / bearings), ratio[at, node]))
    pairs = NodePairs(*(np.concatenate(column) for column in zip(*found, strict=True)))
    likely = np.flatnonzero(pairs.log_ratio > 0.0)
    return pairs.only(likely[np.argsort(-pairs.log_ratio[likely], kind="stable")[: p.pairs]])


def likeness_of_nodes(target: Landmarks, source: Landmarks) -> F64:
    """(N, M) log-likelihood ratio of each node of the target and each of the source showing one place."""
    weights, spread = seen_weights(), seen_spread()
    a, b = (weights.of_places(nodes.signatures) for nodes in (target, source))
    squared = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    hidden = (1.0 - target.signatures[:, -1])[:, None] + (1.0 - source.signatures[:, -1])
    return spread.log_ratio(np.maximum(squared, 0.0), hidden)


def agreements(target: Landmarks, source: Landmarks, pairs: NodePairs) -> csr_array:
    """(P, P) how well two pairs agree, 0..1; empty on the diagonal. Few pairs do, so only these are held."""
    p = GRAPH_MATCHING
    one, other = at_alike_headings(pairs.yaw_rad, p.turn_rad).T
    # A node of either side has one partner.
    alone = (pairs.target[one] != pairs.target[other]) & (pairs.source[one] != pairs.source[other])
    one, other = one[alone], other[alone]
    step_target = target.at_m[pairs.target[other]] - target.at_m[pairs.target[one]]
    step_source = source.at_m[pairs.source[other]] - source.at_m[pairs.source[one]]
    way_m = np.minimum(
        target.way_m[pairs.target[one], pairs.target[other]],
        source.way_m[pairs.source[one], pairs.source[other]],
    )
    straight_m = np.hypot(*step_source.T)
    way_m = np.where(np.isfinite(way_m), way_m, straight_m)
    allowed_m = p.near_m + p.drift * np.maximum(way_m, straight_m)
    length = np.abs(np.hypot(*step_target.T) - straight_m)
    # The heading that both steps give, and the headings of the two pairs, which are known to one ray.
    heading = np.arctan2(*step_target.T[::-1]) - np.arctan2(*step_source.T[::-1])
    mean_yaw = pairs.yaw_rad[one] + 0.5 * wrap_angle(pairs.yaw_rad[other] - pairs.yaw_rad[one])
    slack = p.turn_rad + np.arctan2(allowed_m, np.maximum(straight_m, 1e-6))
    agrees = (length < allowed_m) & (np.abs(wrap_angle(heading - mean_yaw)) < slack)
    one, other, agreement = one[agrees], other[agrees], (1.0 - length / allowed_m)[agrees]
    count = len(pairs.yaw_rad)
    both = np.concatenate((one, other)), np.concatenate((other, one))
    return csr_array((np.tile(agreement, 2), both), shape=(count, count))


def at_alike_headings(yaw_rad: F64, turn_rad: float) -> I64:
    """(E, 2) which two of the headings (P,) differ by less than `turn_rad`."""
    around = cKDTree(np.mod(yaw_rad, 2.0 * math.pi)[:, None], boxsize=2.0 * math.pi)
    return np.asarray(around.query_pairs(turn_rad, output_type="ndarray"), np.int64)


def consistent_set(agreement: csr_array) -> I64:
    """The members of the largest set of pairs that agree with each other, the strongest first."""
    strength = np.ones(agreement.shape[0])
    for _ in range(_ROUNDS):
        strength = agreement @ strength
        norm = math.sqrt(strength @ strength)
        if norm == 0.0:
            return np.empty(0, np.int64)
        strength /= norm
    left = np.argsort(-strength, kind="stable")
    left = left[strength[left] > _LEAST_STRENGTH]
    members: list[int] = []
    agrees = np.zeros(len(strength), bool)
    while len(left):
        members.append(int(left[0]))
        agrees[:] = False
        agrees[agreeing(agreement, members[-1])] = True
        left = left[agrees[left]]
    return np.array(members, np.int64)


def agreeing(agreement: csr_array, pair: int) -> I64:
    """The pairs that agree with one."""
    return np.asarray(agreement.indices[agreement.indptr[pair] : agreement.indptr[pair + 1]], np.int64)


def _alignment(target: Landmarks, source: Landmarks, pairs: NodePairs) -> Alignment:
    there, here = target.at_m[pairs.target], source.at_m[pairs.source]
    x, y = here.mean(axis=0).tolist()
    return Alignment(
        T_target_source=SE2.fit(here, there),
        at_m=(x, y),
        evidence=float(pairs.log_ratio.sum()),
        nodes=len(pairs.source),
    )
