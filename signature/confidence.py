"""How sure is the best hypothesis? A calibrated probability over all that fit, and over none of them.

Every hypothesis competes with its rivals and with the possibility that the query was made elsewhere:

    p_i = exp(k (s_i - s_0)) / (1 + sum_j exp(k (s_j - s_0)))

with s the two-way score of `pc2grid.alignment.Fit`. s_0 is the score at which a lone hypothesis is as
likely right as wrong, and k says how much a lead is worth; more walls seen make a lead worth more.

The coefficients are those that `fit` finds most likely for the 324 trials of `compare sensors` in two
plans, fr079 and intel, from 1 to 10 m of travel (it finds 0.608, 106, 0.99): a lead is worth in proportion
to the walls seen, as evidence from each wall for itself would be. On a third plan, csail, the squared error
of the confidence is no worse than on those two (0.023, 162 trials).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.geometry import F64
from signature.verify import Hypothesis

TUNED_ON = ("fr079", "intel")
"""Plans whose trials had a say in the coefficients; how far confidence is true is judged on others."""
RIVALS = 5
"""Hypotheses that take part; further ones add next to nothing."""
MANY_WALLS = 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the decision rests on.

    scores : of the best hypotheses, best first, at most `RIVALS`.
    walls : wall points (0.1 m apart) of the query that lie on ground known to the best one.
    """

    scores: tuple[float, ...]
    walls: float

    @staticmethod
    def of(hypotheses: Sequence[Hypothesis], wall_points: int) -> Evidence:
        """Evidence of hypotheses, best first, for a query of so many wall points."""
        return Evidence(
            scores=tuple(h.fit.score for h in hypotheses[:RIVALS]),
            walls=hypotheses[0].fit.overlap * wall_points if hypotheses else 0.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Coefficients of the model: neutral score s_0, worth k of a lead seen with `MANY_WALLS`, and the
    power with which k grows with the walls seen."""

    neutral: float = 0.61
    worth: float = 106.0
    power: float = 1.0

    def probabilities(self, evidence: Evidence) -> F64:
        """(H + 1,) probabilities: of each hypothesis in order, and last of none of them."""
        k = self.worth * min(1.0, max(evidence.walls, 1.0) / MANY_WALLS) ** self.power
        logits = np.array([k * (score - self.neutral) for score in evidence.scores] + [0.0])
        weights = np.exp(logits - logits.max())
        return np.asarray(weights / weights.sum())


CALIBRATION = Calibration()


def fit(evidence: Sequence[Evidence], right: Sequence[bool]) -> Calibration:
    """Coefficients under which `right` (whether the best hypothesis was right) is most likely."""
    from scipy.optimize import minimize

    def loss(x: F64) -> float:
        model = Calibration(neutral=float(x[0]), worth=float(np.exp(x[1])), power=float(x[2]))
        p = np.array([model.probabilities(e)[0] if e.scores else 0.0 for e in evidence])
        p = np.clip(p, 1e-4, 1 - 1e-4)
        truth = np.asarray(right, dtype=bool)
        return float(-np.log(np.where(truth, p, 1 - p)).mean() + 1e-3 * float(x[2]) ** 2)

    best = minimize(loss, np.array([0.6, np.log(50.0), 0.3]), method="Nelder-Mead").x
    return Calibration(neutral=float(best[0]), worth=float(np.exp(best[1])), power=float(best[2]))
