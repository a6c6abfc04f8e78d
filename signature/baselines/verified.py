"""The paper's method with its answer checked: signatures propose submaps, alignment decides among them.

Not in the paper. It stands beside the others to show what verification adds on the paper's own terms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pc2grid.alignment import LikelihoodField, assess, prepare, prepare_query, refine, search, thin_evenly
from pc2grid.geometry import F64, SE2
from pc2grid.model import Submap
from signature.baselines import Matcher
from signature.baselines.proposed import Proposed
from signature.config import SignatureConfig

_HALF_T_M, _HALF_A_RAD = 0.5, math.radians(7.5)


@dataclass(frozen=True, slots=True)
class Verified:
    """Eq. 6 proposes `candidates` submaps; the query is aligned on each, every heading, `reach_m` around.

    The similarity is the two-way score of the best pose, given to the submap whose centre is nearest to
    where that pose puts the query: overlapping submaps fit equally well, but only one of them is the place.
    """

    config: SignatureConfig = field(default_factory=SignatureConfig)
    candidates: int = 30
    reach_m: float = 1.5

    def fit(self, submaps: Sequence[Submap]) -> _Verifier:
        """Describe every submap and prepare it for alignment."""
        return _Verifier(
            proposer=Proposed(self.config).fit(submaps),
            fields=[prepare(submap.grid) for submap in submaps],
            centers_m=np.array([submap.center_m for submap in submaps]),
            candidates=self.candidates,
            reach_m=self.reach_m,
        )


@dataclass(frozen=True, slots=True)
class _Verifier:
    proposer: Matcher
    fields: list[LikelihoodField]
    centers_m: F64
    candidates: int
    reach_m: float

    def similarities(self, query: Submap) -> F64:
        """(N,): best two-way score of each submap; what was not aligned follows in the proposer's order."""
        proposed = self.proposer.similarities(query)
        order = np.argsort(-proposed, kind="stable")
        result = -1.0 - np.argsort(np.argsort(-proposed, kind="stable"), kind="stable") / len(proposed)
        prepared = prepare_query(query.grid, center_m=(0.0, 0.0))
        if not len(prepared.walls_m):
            return np.asarray(result)
        coarse = prepared.walls_m[thin_evenly(prepared.walls_m, 0.25)]
        coarse = coarse[np.linspace(0, len(coarse) - 1, min(len(coarse), 160)).astype(int)]
        best = 0.0
        for index in order[: self.candidates]:
            poses = search(
                self.fields[index],
                coarse,
                self._boxes(self.centers_m[index]),
                half_t_m=_HALF_T_M,
                half_a_rad=_HALF_A_RAD,
                floor=max(0.4, 0.9 * best),
                keep=0.95,
                most=2,
            )
            for x, y, yaw, score in poses:
                best = max(best, float(score))
                pose, covariance = refine(self.fields[index], prepared, SE2(float(x), float(y), float(yaw)))
                fit = assess(self.fields[index], prepared, pose, covariance)
                away = np.hypot(*(self.centers_m - (pose.x, pose.y)).T)
                nearest = int(index if away[index] <= away.min() else np.argmin(away))
                result[nearest] = max(result[nearest], fit.score)
        return np.asarray(result)

    def _boxes(self, center_m: F64) -> F64:
        steps = np.arange(-self.reach_m + _HALF_T_M, self.reach_m, 2 * _HALF_T_M)
        yaws = np.arange(-math.pi, math.pi, 2 * _HALF_A_RAD) + _HALF_A_RAD
        x, y, yaw = np.meshgrid(center_m[0] + steps, center_m[1] + steps, yaws, indexing="ij")
        return np.column_stack((x.ravel(), y.ravel(), yaw.ravel()))
