"""The paper's method with verification: signatures propose submaps, alignment decides among them.

It is not in the paper. It shows what verification adds in the paper's own experiment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import score_fit
from pc2grid.matching.walls import Walls, thin_evenly
from pc2grid.matching.window_search import SearchMap, SearchParameters, search_windows
from pc2grid.model import Submap
from pc2grid_lab.baselines.method import Matcher
from pc2grid_lab.baselines.proposed import Proposed
from signature.config import SignatureConfig

_HALF_T_M = 0.5


@dataclass(frozen=True, slots=True)
class Verified:
    """Eq. 6 proposes `candidates` submaps; the query is aligned with each of them.

    All headings and positions up to `reach_m` from the centre of the submap are searched. The similarity is
    the two-way score of the best pose. It is given to the submap whose centre is nearest to the query at
    that pose: overlapping submaps fit equally well, but only one of them is the right one. Both numbers are
    chosen by hand.
    """

    config: SignatureConfig = field(default_factory=SignatureConfig)
    candidates: int = 30
    reach_m: float = 1.5

    def fit(self, submaps: Sequence[Submap]) -> _Verifier:
        """Describe every submap and prepare it for alignment."""
        return _Verifier(
            proposer=Proposed(self.config).fit(submaps),
            maps=[SearchMap.of(submap.grid) for submap in submaps],
            centers_m=np.array([submap.center_m for submap in submaps]),
            candidates=self.candidates,
            reach_m=self.reach_m,
        )


@dataclass(frozen=True, slots=True)
class _Verifier:
    proposer: Matcher
    maps: list[SearchMap]
    centers_m: F64
    candidates: int
    reach_m: float

    def similarities(self, query: Submap) -> F64:
        """(N,): best two-way score of each submap; what was not aligned follows in the proposer's order."""
        proposed = self.proposer.similarities(query)
        order = np.argsort(-proposed, kind="stable")
        result = -1.0 - np.argsort(np.argsort(-proposed, kind="stable"), kind="stable") / len(proposed)
        walls = Walls.of(query.grid)
        if not len(walls.points_m):
            return np.asarray(result)
        coarse = walls.points_m[thin_evenly(walls.points_m, 0.25)]
        coarse = coarse[np.linspace(0, len(coarse) - 1, min(len(coarse), 160)).astype(int)]
        best = 0.0
        for index in order[: self.candidates]:
            poses = search_windows(
                self.maps[index],
                coarse,
                self._boxes(self.centers_m[index]),
                half_t_m=_HALF_T_M,
                half_a_rad=math.pi,
                parameters=SearchParameters(floor=max(0.4, 0.9 * best), keep=0.95, most=2),
            )
            for x, y, yaw, score in poses:
                best = max(best, float(score))
                start = SE2(float(x), float(y), float(yaw))
                pose, covariance = refine(self.maps[index].field, walls.points_m, start, (0.0, 0.0))
                fit = score_fit(self.maps[index].walls, walls, pose, covariance)
                away = np.hypot(*(self.centers_m - (pose.x, pose.y)).T)
                nearest = int(index if away[index] <= away.min() else np.argmin(away))
                result[nearest] = max(result[nearest], fit.score)
        return np.asarray(result)

    def _boxes(self, center_m: F64) -> F64:
        steps = np.arange(-self.reach_m + _HALF_T_M, self.reach_m, 2 * _HALF_T_M)
        x, y, yaw = np.meshgrid(center_m[0] + steps, center_m[1] + steps, 0.0, indexing="ij")
        return np.column_stack((x.ravel(), y.ravel(), yaw.ravel()))
