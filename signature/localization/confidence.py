"""How sure is the best hypothesis? A calibrated probability from how well it fits and how far it leads.

    p = tie unslipped / (1 + exp(-z)),    z = b + c (max(f, g) + 0.35 min(f, g)) + d t
    f = r(n_f, few_f) l(a_f),    g = r(n_b, few_b) l(a_b),    t = lead sqrt(min(n_f, most) (1 - like^2))
    l(a) = ln a - ln(1.2 - a),    r(n, few) = n / (n + few),    tie = 1 / (1 + exp(-lead / equal lead))

- a_f, forward: how well the query's walls fit on ground that the map knows; n_f such wall points.
  a_b, backward: how well the map's walls fit on ground that the query knows; n_b such wall points.
  What one side does not know neither supports a place nor contradicts it. l is the log-odds that a wall point
  agrees, r how far it can be relied on: a single scan contradicts hardly any wall of a map, wherever it is
  placed, so a_b is 1 there but rests on few points.
- The better of the two directions counts more, because sensors differ in what they see: a 3D lidar draws
  furniture that a laser below or above it misses, but what the laser draws, the lidar draws too.
- lead, by which the two-way score of the best hypothesis exceeds that of its best rival: what wrong places
  score for this very query. The score is a mean over wall points, so by chance it varies as 1 / sqrt(n), and
  t is the lead in units of that. However well two equal places fit, each is right with a probability of at
  most one half: that is the factor "tie".
- like, how well the query fits onto itself, slid along (`pc2grid.matching.self_likeness`): walls of a
  bare corridor fit at many places along it and in other corridors, and tell none of them from another. So
  they are not counted among the wall points that make a lead surer; like^2 is the share of them, as the
  square of a correlation is the share of a variance that it explains.

- unslipped = 1 / (1 + exp(-(c + c_0) / s)), with c the least over the scans of the query, each by itself at
  its pose, of r(n, few_f) (l(a) - l(a_f)), a and n those of the scan: where tracking slips, the scans before
  fit and those after do not, and the pose of the last one is wrong, however well they fit together.

No figure is compared with a threshold of its own: drift and moved furniture lower the agreement at right and
wrong places alike, so a poor agreement needs a longer lead, and can be made up for by it.

Whether the query lies in the map at all, at the best or at another hypothesis, is asked separately: with the
same terms and other coefficients, and without the tie.

`pc2grid_lab.experiments.calibration` fits the coefficients to answers whose truth is known and judges them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.matching.likelihood_field import LikelihoodField
from pc2grid.matching.two_way_score import Fit
from signature.localization.hypotheses import Hypothesis
from signature.localization.query import QueryMap

FITTED_ON = frozenset({"fr079", "intel", "csail", "aces"})
"""Buildings that `CALIBRATION` and `PRESENCE` were fitted on: real recordings of the first three, simulated
sessions in intel and aces. Whether the confidence is true can be judged on other buildings only."""
RIVALS = 5
"""Places that are compared with each other before the decision; further ones are not needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceParameters:
    """Limits within which the figures count.

    slack : keeps the log-odds finite at an agreement of 1. Chosen on fr079 and intel.
    least_agreement : lower ones count as this.
    longest_lead : longer leads count as this. Chosen by hand.
    unreported : a hypothesis without a rival leads by this share of its own score, as searches report what
        scores 0.8 of the best or more (`coarse_keep`): a rival that was not reported may be so near. A poor
        score does not become sure by being the only one.
    equal_lead : the spread of the score between two equal places. Chosen by hand: simulated twin rooms differ
        by up to 0.018, by the paths that they were seen from.
    few_walls, few_looked_at : the agreement forward or backward counts half if it rests on so many wall
        points (0.1 m apart, by weight). Chosen by hand: twice or half as many fit nearly as well.
    worse_share : the worse direction counts so much of the better one. Chosen by hand; from 0.25 to 0.5 the
        likelihood is as high. It is not a coefficient of the fit, because pairs of sensors that see much
        less, one than the other, are from one building only: left out, its share would not be learnt.
    slipped, slipped_spread : c_0 and s, of the log-odds by which a scan alone agrees less than the query.
        Chosen on recordings in examples/real.md: where tracking slipped (a lidar at 2 Hz of which scans were
        left out) it is 1.7 or more, of right answers at most 1.14 (wean, birmingham, fr079).
    most_walls : more wall points do not make the lead surer, because what has been moved and similar rooms do
        not average out. Chosen by hand: with 100 or 1000 the likelihood is as high.
    """

    slack: float = 0.2
    least_agreement: float = 0.01
    longest_lead: float = 0.15
    unreported: float = 0.2
    equal_lead: float = 0.01
    few_walls: float = 30.0
    few_looked_at: float = 100.0
    worse_share: float = 0.35
    slipped: float = 1.5
    slipped_spread: float = 0.15
    most_walls: float = 300.0


LIMITS = EvidenceParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the decision is made from.

    forward : of the best hypothesis, `pc2grid.matching.two_way_score.Fit.known_agreement`.
    walls : wall points (0.1 m apart) of the query that lie on ground known to it, weighted by
        `pc2grid.matching.walls.steadiness`; `forward` rests on them.
    backward : the agreement the other way round. looked_at : wall points of the map that it rests on.
    lead : two-way score of the best hypothesis less that of the best one at another place;
        if there is no other, what an unreported one may lie behind (`EvidenceParameters.unreported`).
    likeness : `pc2grid.matching.self_likeness` of the query.
    worst_scan : c, see above; 0 of a drawn map.
    """

    forward: float
    walls: float
    backward: float
    looked_at: float
    lead: float
    likeness: float
    worst_scan: float = 0.0

    @staticmethod
    def of(rivals: Sequence[Hypothesis], query: QueryMap, field: LikelihoodField | None = None) -> Evidence:
        """Evidence of one hypothesis for each place, best first, for a query.

        field : of the map of the best one, to compare the scans of the query with it one by one.
        """
        if not rivals:
            return NO_EVIDENCE
        best = rivals[0].fit
        rival = rivals[1].fit.score if len(rivals) > 1 else (1.0 - LIMITS.unreported) * best.score
        return Evidence(
            forward=best.known_agreement,
            walls=best.overlap * query.walls.weight,
            backward=best.backward,
            looked_at=best.looked_at,
            lead=best.score - rival,
            likeness=query.likeness,
            worst_scan=0.0 if field is None else worst_scan(query, best, field),
        )

    @property
    def agreement(self) -> float:
        """0..1, the better of the two directions."""
        return max(self.forward, self.backward)

    @property
    def forward_support(self) -> float:
        """f: log-odds that a wall point of the query agrees, as far as they can be relied on."""
        return _reliance(self.walls, LIMITS.few_walls) * log_odds(self.forward)

    @property
    def backward_support(self) -> float:
        """g: the same of the map's wall points."""
        return _reliance(self.looked_at, LIMITS.few_looked_at) * log_odds(self.backward)

    @property
    def support(self) -> float:
        """What both directions say together."""
        forward, backward = self.forward_support, self.backward_support
        return max(forward, backward) + LIMITS.worse_share * min(forward, backward)

    @property
    def clearance(self) -> float:
        """t: the lead in units of what chance makes of it."""
        lead = min(max(self.lead, 0.0), LIMITS.longest_lead)
        return lead * math.sqrt(min(self.walls, LIMITS.most_walls) * (1.0 - self.likeness**2))

    @property
    def terms(self) -> tuple[float, float, float]:
        """What the coefficients of a `LinearModel` are multiplied with."""
        return 1.0, self.support, self.clearance


NO_EVIDENCE = Evidence(forward=0.0, walls=0.0, backward=0.0, looked_at=0.0, lead=0.0, likeness=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearModel:
    """Log-odds that are linear in the terms of the evidence.

    bias : b, log-odds without any evidence. support : c >= 0, weight of the agreement. clearance : d >= 0,
        weight of the lead.
    """

    bias: float
    support: float
    clearance: float

    def log_odds(self, evidence: Evidence) -> float:
        """Of what the model was fitted to."""
        coefficients = (self.bias, self.support, self.clearance)
        return sum(c * term for c, term in zip(coefficients, evidence.terms, strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration(LinearModel):
    """The probability that the best hypothesis is right.

    Fitted (maximum likelihood, right and wrong answers of the same weight) to 1166 answers of 81 drives,
    standing and after 1 to 14 m. Real: the laser logs fr079, intel and csail, each asked in the map of its
    own first part and in those of others; a lidar and a depth camera driven through a 3D scan of the fr079
    floor, and the log, each asked in the maps of all three and in that of intel. Simulated: drives by each
    sensor in the plans of aces and intel, each asked in maps of both and in those of the logs.

    The likeness takes no part in the fit, so that it only lowers the confidence of what is alike. It is
    judged by 535 more answers, to queries that are asked in their own building with all that they see there
    made unknown: nowhere else does so much look like the right place.

    Leaving out one log, scan or plan at a time, 502 of 581 right answers are located at 0.9, none of 585
    wrong ones and 9 of the 535, all but one of these in a simulated building. (The log and the scan of fr079
    counted as two, and queries of other buildings in the map that was left out stayed in the fit, so these
    counts are optimistic.) Without the likeness: 506, 0 and 10. With `like` instead of its square, and fitted
    with the 535 and with the likeness: 499, 0 and 5; but of 120 simulated depth cameras after 3 m it locates
    74, the form in use 82 (without the likeness 86).
    """

    bias: float = -6.83
    support: float = 6.08
    clearance: float = 3.19

    def probability(self, evidence: Evidence) -> float:
        """0..1; at most one half for the better of two equal places."""
        if not evidence.walls:
            return 0.0
        tie = _logistic(max(evidence.lead, 0.0) / LIMITS.equal_lead)
        unslipped = _logistic((evidence.worst_scan + LIMITS.slipped) / LIMITS.slipped_spread)
        return tie * unslipped * _logistic(self.log_odds(evidence))


CALIBRATION = Calibration()


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence(LinearModel):
    """The probability that the query lies in the map, at one of the hypotheses.

    Fitted to those of all these answers in which one of the first ten hypotheses is right, and to
    those in other buildings and without their place, both kinds with the same weight, a quarter of the latter
    without their place. At 0.5, leaving out as for `Calibration`, 567 of 595 in the map are kept, 1 of 467
    in other buildings and 75 of 536 without their place, most of which look like another one there.
    """

    bias: float = -5.83
    support: float = 5.77
    clearance: float = 2.27

    def probability(self, evidence: Evidence) -> float:
        """0..1."""
        return _logistic(self.log_odds(evidence)) if evidence.walls else 0.0


PRESENCE = Presence()


@dataclass(frozen=True, slots=True, kw_only=True)
class SamePlace:
    """Whether two maps made by one sensor, or of one time, show the same place, rivals left aside.

    logit p = k min(1, W/100) (l(s) - l(s_0)), with s the two-way score or the lower agreement of the two
    directions.
    neutral : s_0. sharpness : k. Fitted to simulated sessions in the plans of fr079 and intel, as the former
    probability of an answer without rivals.
    """

    neutral: float = 0.627
    sharpness: float = 16.2

    def probability(self, agreement: float, walls: float) -> float:
        """Probability, 0..1, given the agreement and the wall points that it rests on."""
        k = self.sharpness * min(1.0, walls / 100.0)
        return _logistic(k * (log_odds(agreement) - log_odds(self.neutral)))


SAME_PLACE = SamePlace()


def worst_scan(query: QueryMap, fit: Fit, field: LikelihoodField) -> float:
    """c: the log-odds by which the scan that agrees least with a map agrees less than the whole query."""
    least = 0.0
    for keyframe in query.keyframes:
        T_map_base = fit.T_map_query @ keyframe.T_odom_base
        likelihood, known = field.at(T_map_base.apply(keyframe.planar_scan.hits_m))
        if known.any():
            less = log_odds(float(likelihood[known].mean())) - log_odds(fit.known_agreement)
            least = min(least, _reliance(float(np.count_nonzero(known)), LIMITS.few_walls) * less)
    return least


def log_odds(agreement: float) -> float:
    """l(a) = ln a - ln(1 + slack - a)."""
    a = min(max(agreement, LIMITS.least_agreement), 1.0)
    return math.log(a) - math.log(1.0 + LIMITS.slack - a)


def _reliance(points: float, few: float) -> float:
    """r: how far an agreement that rests on so many wall points can be relied on, 0..1."""
    return points / (points + few)


def _logistic(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(x, -700.0), 700.0)))
