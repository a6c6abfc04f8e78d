"""How sure is the best hypothesis? A calibrated probability from three figures.

    p = tie / (1 + exp(-z)),    z = b + k W/100 (l(a) - l_0) + d ln(lead / longest lead)
    l(a) = ln a - ln(1.2 - a),    tie = 1 / (1 + exp(-lead / equal lead))

- a, the agreement: how well the query's walls fit on ground that the map knows, or the map's walls where the
  query has looked, whichever is better. What one side does not know neither supports a place nor contradicts
  it. One direction is enough because sensors differ in what they see: a 3D lidar draws furniture that a
  laser below or above it misses, but what the laser draws, the lidar draws too. Right and wrong places do
  not overlap once the query has seen enough.
- W, the wall points that this rests on: l is the log-odds that one wall point agrees, and independent
  points add up. So more travel makes surer, either way.
- lead, by which the two-way score of the best hypothesis exceeds that of its best rival: what wrong places
  score for this very query. However well two equal places fit, each is right with a probability of at most
  one half: that is the factor "tie".

Whether the query lies in the map at all, at the best or at another hypothesis, is asked separately:

    logit q = b' + k' l(a) + w' ln(W/100) + d' ln(lead / longest lead)

Here a long list of equally good places speaks for a building that the map does not show, though less than it
speaks against the first of them.

`signature.evaluation.calibration` fits the coefficients to answers whose truth is known and judges them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from signature.relocalization.hypotheses import Hypothesis

TUNED_ON = ("fr079", "intel")
"""Plans whose simulated sessions anything was tuned on; calibration in simulation is judged on others."""
RIVALS = 5
"""Places that are compared with each other before the decision; further ones are not needed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceParameters:
    """Limits within which the figures count.

    slack : keeps the log-odds finite at an agreement of 1. Chosen on fr079 and intel.
    least_agreement : lower ones count as this.
    shortest_lead, longest_lead : shorter and longer leads count as these; a hypothesis without a rival has
        the longest. Chosen by hand: the spread of the score between equally wrong places is about 0.005, and
        right answers of the logs lead by up to 0.25.
    equal_lead : the spread of the score between two equal places. Chosen by hand: simulated twin rooms differ
        by up to 0.018, by the paths that they were seen from.
    most_walls : wall points (0.1 m apart, by weight); more do not make surer, because what has been moved
        and similar rooms do not average out. Chosen by hand: with twice as many the likelihood is as high.
    few_walls : below this the lead counts in proportion. Less than 1 % of the answers in the fit had fewer.
    """

    slack: float = 0.2
    least_agreement: float = 0.01
    shortest_lead: float = 0.005
    longest_lead: float = 0.25
    equal_lead: float = 0.01
    most_walls: float = 300.0
    few_walls: float = 30.0


LIMITS = EvidenceParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the decision is made from.

    agreement : of the best hypothesis, the better of `known_agreement` and `backward` of
        `signature.verification.two_way_score.Fit`.
    walls : wall points (0.1 m apart) of the query that lie on ground known to the best hypothesis, weighted
        by `signature.verification.walls.steadiness`.
    lead : two-way score of the best hypothesis less that of the best one at another place;
        `EvidenceParameters.longest_lead` if there is no other.
    """

    agreement: float
    walls: float
    lead: float

    @staticmethod
    def of(rivals: Sequence[Hypothesis], walls: float) -> Evidence:
        """Evidence of one hypothesis for each place, best first, for a query whose wall points weigh `walls`
        together."""
        if not rivals:
            return NO_EVIDENCE
        best = rivals[0].fit
        return Evidence(
            agreement=max(best.known_agreement, best.backward),
            walls=best.overlap * walls,
            lead=best.score - rivals[1].fit.score if len(rivals) > 1 else LIMITS.longest_lead,
        )

    @property
    def log_odds(self) -> float:
        """l(a): the log-odds that a wall point of one side agrees with the other side."""
        return log_odds(self.agreement)

    @property
    def log_lead(self) -> float:
        """The logarithm of the lead, relative to the longest: 0 or less."""
        lead = min(self.lead, LIMITS.longest_lead) * min(1.0, self.walls / LIMITS.few_walls)
        return math.log(max(lead, LIMITS.shortest_lead) / LIMITS.longest_lead)

    @property
    def hundreds(self) -> float:
        """The wall points that count, in hundreds."""
        return min(self.walls, LIMITS.most_walls) / 100.0


NO_EVIDENCE = Evidence(agreement=0.0, walls=0.0, lead=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Coefficients of the model.

    bias : b, log-odds of an answer with the longest lead whose wall points agree as `neutral` says.
    sharpness : k >= 0, weight of 100 wall points.
    neutral : l_0, log-odds of agreement that speak neither for nor against a place.
    lead : d >= 0, weight of the lead.

    Fitted (maximum likelihood) to 1720 answers. 1540 are from real laser logs: fr079, intel, csail and
    killian, each asked in the map of its own first part and in those of the three others, after 0 to 12 m of
    travel; and fr079 asked in a map made by a lidar driven through a 3D scan of the same floor. The others
    are simulated: `compare sensors intel.yaml --queries 4 --map-length 60`. The real ones, leaving out one
    building at a time: log loss 0.073, area under the ROC curve 0.993.
    """

    bias: float = 1.720
    sharpness: float = 4.479
    neutral: float = 0.970
    lead: float = 2.024

    def probability(self, evidence: Evidence) -> float:
        """Probability, 0..1, that the best hypothesis is right."""
        if not evidence.walls:
            return 0.0
        fits = self.sharpness * evidence.hundreds * (evidence.log_odds - self.neutral)
        tie = _logistic(max(evidence.lead, 0.0) / LIMITS.equal_lead)
        return tie * _logistic(self.bias + fits + self.lead * evidence.log_lead)


CALIBRATION = Calibration()


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """Coefficients b', k', w' and d' of the probability that the query lies in the map.

    Fitted to those of the answers of `Calibration` in which one of the first ten hypotheses is right, and to
    those from other buildings. At 0.5, 53 of the 66 right answers below a confidence of 0.9 are kept, and 2 %
    of the answers from other buildings (21 of 1044).
    """

    bias: float = -3.74
    agreement: float = 5.09
    walls: float = 1.30
    lead: float = 1.07

    def probability(self, evidence: Evidence) -> float:
        """Probability, 0..1, that the query lies in the map, at one of the hypotheses."""
        if not evidence.walls:
            return 0.0
        x = self.bias + self.agreement * evidence.log_odds + self.lead * evidence.log_lead
        return _logistic(x + self.walls * math.log(evidence.hundreds))


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


def log_odds(agreement: float) -> float:
    """l(a) = ln a - ln(1 + slack - a)."""
    a = min(max(agreement, LIMITS.least_agreement), 1.0)
    return math.log(a) - math.log(1.0 + LIMITS.slack - a)


def _logistic(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(x, -700.0), 700.0)))
