"""How sure is the best hypothesis? A calibrated probability from what can be seen of the hypotheses.

A logistic model of five plain features, fitted on simulated sessions in floor plans that its evaluation
does not use (`tools/bench/fit_confidence.py` writes the coefficients and the reliability diagram).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from signature.verify import Hypothesis


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the decision looks at.

    score : of the best hypothesis (mean likelihood both ways), 0..1.
    margin : its lead over the best rival elsewhere; the whole score if there is none.
    conflict : share of common ground on which query and map contradict each other.
    evidence : log10 of the query's wall points on known ground.
    supported_m : travel over which the best hypothesis has been seen to fit, at most 10 m.
    """

    score: float
    margin: float
    conflict: float
    evidence: float
    supported_m: float

    @staticmethod
    def of(hypotheses: Sequence[Hypothesis], wall_points: int) -> Evidence:
        """Evidence for the first of `hypotheses`, best first; there must be one."""
        best = hypotheses[0]
        rival = hypotheses[1].fit.score if len(hypotheses) > 1 else 0.0
        return Evidence(
            score=best.fit.score,
            margin=best.fit.score - rival,
            conflict=best.fit.conflict,
            evidence=math.log10(1.0 + best.fit.overlap * wall_points),
            supported_m=min(best.supported_m, 10.0),
        )

    def features(self) -> tuple[float, ...]:
        """In the order of `WEIGHTS`. The margin counts up to 0.3: more lead is not more truth."""
        return (self.score, min(self.margin, 0.3), self.conflict, self.evidence, self.supported_m)


WEIGHTS = (18.0, 20.0, -4.0, 1.5, 0.1)
BIAS = -15.5


def confidence(evidence: Evidence) -> float:
    """Probability, 0..1, that the best hypothesis is right."""
    logit = BIAS + sum(w * f for w, f in zip(WEIGHTS, evidence.features(), strict=True))
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, logit))))
