"""How sure is the best hypothesis? A calibrated probability over all that fit, and over none of them.

Every hypothesis competes with its rivals and with the possibility that the query was made elsewhere:

    p_i = exp(k (l(s_i) - l(s_0))) / (1 + sum_j exp(k (l(s_j) - l(s_0)))),    l(s) = ln s - ln(1.2 - s)

with s the two-way score of `pc2grid.alignment.Fit`. l is the log-odds of a wall point to agree: a lead of a
tenth says more near 0.9 than near 0.5, for where nearly everything agrees, a little that does not is telling.
s_0 is the score at which a lone hypothesis is as likely right as wrong, and k says how much a lead is worth:
less, in proportion, where fewer than `ENOUGH_WALLS` wall points were seen. That more of them make a lead
worth more was tried: the likelihood does not rise by it, for what speaks against a lead, things moved and
rooms alike, does not average out.

The coefficients are those that `fit` finds most likely for the trials of `compare sensors` in two plans,
fr079 and intel, from 1 to 10 m of travel; how true confidence is, is judged on the other plans.
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
ENOUGH_WALLS = 100.0
_SLACK = 0.2
"""Closer agreement than to this says little more: of two rooms alike, one always agrees better by chance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the decision rests on.

    scores : of the best hypotheses, best first, at most `RIVALS`.
    walls : wall points (0.1 m apart) of the query that lie on ground known to the best one, weighted by
        `pc2grid.alignment.steadiness`.
    """

    scores: tuple[float, ...]
    walls: float

    @staticmethod
    def of(hypotheses: Sequence[Hypothesis], walls: float) -> Evidence:
        """Evidence of hypotheses, best first, for a query of so many wall points, by weight."""
        return Evidence(
            scores=tuple(h.fit.score for h in hypotheses[:RIVALS]),
            walls=hypotheses[0].fit.overlap * walls if hypotheses else 0.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Coefficients of the model: neutral score s_0 and worth k of a lead."""

    neutral: float = 0.627
    worth: float = 16.2

    def probabilities(self, evidence: Evidence) -> F64:
        """(H + 1,) probabilities: of each hypothesis in order, and last of none of them."""
        k = self.worth * min(1.0, evidence.walls / ENOUGH_WALLS)
        scores = np.clip([*evidence.scores, self.neutral], 0.01, 1.0)
        logits = np.log(scores) - np.log(1.0 + _SLACK - scores)
        weights = np.exp(k * (logits - logits.max()))
        return np.asarray(weights / weights.sum())


CALIBRATION = Calibration()


def fit(evidence: Sequence[Evidence], right: Sequence[bool]) -> Calibration:
    """Coefficients under which `right` (whether the best hypothesis was right) is most likely."""
    from scipy.optimize import minimize

    def model(x: F64) -> Calibration:
        return Calibration(neutral=float(np.clip(x[0], 0.05, 0.95)), worth=float(np.exp(x[1])))

    truth = np.asarray(right, dtype=bool)

    def loss(x: F64) -> float:
        p = np.array([model(x).probabilities(e)[0] if e.scores else 0.0 for e in evidence])
        p = np.clip(p, 1e-4, 1 - 1e-4)
        return float(-np.log(np.where(truth, p, 1 - p)).mean())

    return model(minimize(loss, np.array([0.6, np.log(10.0)]), method="Nelder-Mead").x)
