"""The evidence that two sets of walls show one place: one equation for loops, answers and joins.

    z_h = b + c (f_h + g_h) + d t_h                          log-odds of a place over "none of these"
    f = l(a_f) n_f / (n_f + few),    g = l(a_b) n_b / (n_b + few),    l(a) = ln a - ln(1.2 - a)
    t = min(score - rival, q score) sqrt(n_f (1 - like^2))

- f and g are the log-likelihood of the wall points of the query on ground that the map knows, and of the
  map's on ground that the query knows, as log-odds against a wrong place, where 0.6 agree. Divided by
  (n + few) instead of 1, because neighbouring points repeat each other and all share what has been moved in
  the building (`n_eff`). Ground that one side does not know says nothing.
- t is what wrong places tell. However well a place fits, "not in this map" explains the query as well if
  another place fits nearly so well: then such a fit is nothing special. The score (`score_fit`) is a
  mean, which varies by chance as 1 / sqrt(n). No lead counts as longer than the share q of the score: what
  scores less is not searched for, so there may always be a rival so near. Places that fit equally well are
  no examples of it: they get the evidence of the best of them, and their priors divide the mass.
- like, how well the query fits onto itself, slid along (`self_similarity`): the walls of a
  bare corridor tell no place along it from another.

`pc2grid_lab.fit.posterior` fits b, c and d to queries whose truth is known, and judges them on buildings that
were left out. They are fitted to fr079, intel, csail, aces, killian, wean, kidnap, workshop, birmingham, the
hall, jarvis, the room and the kitchen of the catalogue of recordings. Loops (`signature.session.loops`) had
no part in it: on all pairs of local maps that csail and fr079 compare, it tells right from wrong ones as well
as limits that were chosen for them did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from pc2grid.geometry import F64
from pc2grid.matching.score import Fit


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceParameters:
    """What the equation above is made of.

    bias, fit, lead : b, c and d.
    few : wall points (0.1 m apart, by weight). Chosen among 3 to 100 by what is judged without the building;
        from half to twice of it the likelihood is as high.
    longest_lead : q. By hand; searches report what is nearer.
    slack, least_agreement : keep the log-odds finite at an agreement of 1 and of 0.
    alike : places whose scores differ by less fit equally well: twice the spread of the score between two
        equal places (simulated twin rooms, which differ by the paths that they were seen from).
    """

    bias: float = -7.33
    fit: float = 2.55
    lead: float = 4.19
    few: float = 10.0
    longest_lead: float = 0.2
    slack: float = 0.2
    least_agreement: float = 0.01
    alike: float = 0.02


EVIDENCE = EvidenceParameters()
LEFT = 0.05
"""What has less than this share of the mass does not matter: a search ends, a loop is none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What tells for one place.

    known_agreement, compared, backward, looked_at : see `pc2grid.matching.score.Fit`.
    lead : score less that of the best place that does not fit equally well, at most `longest_lead` of it.
    likeness : `self_similarity` of the query.
    """

    known_agreement: float
    compared: float
    backward: float
    looked_at: float
    lead: float
    likeness: float

    @property
    def log_likelihood(self) -> float:
        """Return f + g: below 0 the place fits less than wrong places do."""
        return tempered(self.known_agreement, self.compared) + tempered(self.backward, self.looked_at)

    @property
    def terms(self) -> tuple[float, float, float]:
        """Return the factors of b, c and d."""
        sharpness = math.sqrt(self.compared * (1.0 - self.likeness**2))
        return 1.0, self.log_likelihood, self.lead * sharpness

    def log_odds(self) -> float:
        """Return z, the logarithm of the mass of the place over that of "nowhere"; minus infinity without
        walls."""
        if not self.compared:
            return -math.inf
        return float(np.dot((EVIDENCE.bias, EVIDENCE.fit, EVIDENCE.lead), self.terms))


def evidence_of(
    fits: Sequence[Fit], likeness: float = 0.0, rivals: Sequence[Fit] = ()
) -> tuple[Evidence, ...]:
    """Return the evidence of places, one fit each.

    likeness : `self_similarity` of the query. rivals : of places that are no answers, but examples of what
    wrong places score as well.
    """
    each = [
        Evidence(
            known_agreement=fit.known_agreement,
            compared=fit.compared,
            backward=fit.backward,
            looked_at=fit.looked_at,
            lead=0.0,
            likeness=likeness,
        )
        for fit in fits
    ]
    return with_leads(each, [fit.score for fit in (*fits, *rivals)])


def with_leads(each: Sequence[Evidence], scores: Sequence[float]) -> tuple[Evidence, ...]:
    """Return the evidence of places with their leads; of those that fit equally well, that of the best.

    scores : of these places, then of their other rivals.
    """
    every = np.array(scores)
    alike = np.abs(every[: len(each), None] - every) <= EVIDENCE.alike
    led = [
        replace(
            one,
            lead=min(EVIDENCE.longest_lead * score, score - float(np.max(every[~equal], initial=-math.inf))),
        )
        for one, score, equal in zip(each, scores, alike, strict=False)
    ]
    return tuple(max(compress(led, equal), key=Evidence.log_odds) for equal in alike)


def masses(evidence: Sequence[Evidence], prior: float | Sequence[float] = 1.0) -> F64:
    """(H,) probability of each place; what is missing to 1 is "nowhere".

    prior : of each place, relative to that of "nowhere".
    """
    log_odds = np.array([e.log_odds() for e in evidence]) + np.log(prior)
    highest = max(0.0, *log_odds, 0.0)
    odds = np.exp(log_odds - highest)
    return np.asarray(odds / (math.exp(-highest) + odds.sum()))


def tempered(agreement: float, points: float) -> float:
    """Return l of the agreement of wall points, 0..1, tempered by their number: 0 at what wrong places
    reach."""
    a = min(max(agreement, EVIDENCE.least_agreement), 1.0)
    likelihood_ratio = math.log(a) - math.log(1.0 + EVIDENCE.slack - a)
    return likelihood_ratio * points / (points + EVIDENCE.few)
