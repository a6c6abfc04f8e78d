"""What the peers' answers are worth: right, wrong or none, each peer with the threshold that is best for it.

pc2grid decides by itself whether it answers. The others give an answer and a score. Their threshold is chosen
on these very answers, which is more than a user could do: it is the one with the most right answers less the
wrong ones, in the own building and in another one. So the comparison is in favour of the peers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.calibration import share_by_session
from pc2grid_lab.experiments.frames import apart
from pc2grid_lab.peers.peer_process import PeerAnswer
from pc2grid_lab.peers.site import SiteQuery

Place = Literal["covered", "uncovered", "elsewhere"]
"""covered: the map shows what the query saw last. uncovered: it does not. elsewhere: the map is of another
building."""

DECIDES = "pc2grid"
"""The peer whose answers need no threshold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeParameters:
    """When an answer is right, and how intervals are made. All chosen by hand.

    right_m, right_rad : the truth is another program's map, good to some centimetres.
    resamples, seed, low, high : of the bootstrap over queries, and its percentiles.
    """

    right_m: float = 0.3
    right_rad: float = math.radians(5.0)
    resamples: int = 2000
    seed: int = 0
    low: float = 5.0
    high: float = 95.0


OUTCOME = OutcomeParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerTrial:
    """One answer with its truth.

    site: the building of the query. map: that of the map. right: near the true pose; false without a pose
    and elsewhere. error_m: null without a pose and elsewhere.
    """

    peer: str
    site: str
    map: str
    query: int
    place: Place
    pose: tuple[float, float, float] | None
    score: float
    right: bool
    error_m: float | None
    cpu_s: float
    peak_mb: float

    @staticmethod
    def of(peer: str, site: str, map_: str, number: int, query: SiteQuery, answer: PeerAnswer) -> PeerTrial:
        """The answer to a query, judged."""
        place: Place = "elsewhere" if map_ != site else "covered" if query.covered else "uncovered"
        right, error_m = False, None
        if answer.pose is not None and place != "elsewhere":
            error_m, error_rad = apart(query.T_map_base, SE2(*answer.pose))
            right = error_m <= OUTCOME.right_m and error_rad <= OUTCOME.right_rad
        return PeerTrial(
            peer=peer,
            site=site,
            map=map_,
            query=number,
            place=place,
            pose=answer.pose,
            score=answer.score,
            right=right,
            error_m=error_m,
            cpu_s=answer.cpu_s,
            peak_mb=answer.peak_mb,
        )

    def answered(self, threshold: float) -> bool:
        """Whether there is an answer at this threshold of the score."""
        return self.pose is not None and self.score >= threshold


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerCell:
    """One peer in the queries of one building.

    threshold: of its score; null if the peer decides by itself. right, wrong, unanswered: of the covered
    queries; right_low, right_high: 5 and 95 % of the share that is right. uncovered_wrong: of the uncovered
    ones. elsewhere_wrong: answers in another building's map, all wrong. median_error_m: of the right answers,
    null if there are none. cpu_s, elsewhere_cpu_s: median of an answer in the own and in another building's
    map; null without queries there. peak_mb: largest of its process.
    """

    peer: str
    site: str
    threshold: float | None
    covered: int
    right: int
    wrong: int
    unanswered: int
    right_low: float | None
    right_high: float | None
    uncovered: int
    uncovered_wrong: int
    elsewhere: int
    elsewhere_wrong: int
    median_error_m: float | None
    cpu_s: float | None
    elsewhere_cpu_s: float | None
    peak_mb: float


def best_threshold(trials: Sequence[PeerTrial]) -> float:
    """The threshold with the most right answers less the wrong ones; of several the highest.

    Infinite, which is never to answer, if wrong answers outnumber the right ones at every threshold.
    """
    scored = [t for t in trials if t.pose is not None]

    def gain(threshold: float) -> int:
        return sum(1 if t.right else -1 for t in scored if t.answered(threshold))

    return max([math.inf, *sorted({t.score for t in scored}, reverse=True)], key=gain)


def counted(trials: Sequence[PeerTrial]) -> list[PeerCell]:
    """A cell for each site and peer, in the order of the trials. A peer has one threshold for all sites."""
    thresholds = {
        name: best_threshold([t for t in trials if t.peer == name])
        for name in dict.fromkeys(t.peer for t in trials)
        if name != DECIDES
    }
    pairs = dict.fromkeys((t.site, t.peer) for t in trials)
    return [_cell([t for t in trials if (t.site, t.peer) == pair], thresholds.get(pair[1])) for pair in pairs]


def _cell(trials: Sequence[PeerTrial], threshold: float | None) -> PeerCell:
    lowest = -math.inf if threshold is None else threshold
    of_place = Counter(trial.place for trial in trials)
    wrong = Counter(t.place for t in trials if t.answered(lowest) and not t.right)
    right = [t for t in trials if t.answered(lowest) and t.right and t.place == "covered"]
    low, high = _interval([t in right for t in trials if t.place == "covered"])
    return PeerCell(
        peer=trials[0].peer,
        site=trials[0].site,
        threshold=threshold if math.isfinite(lowest) else None,
        covered=of_place["covered"],
        right=len(right),
        wrong=wrong["covered"],
        unanswered=of_place["covered"] - len(right) - wrong["covered"],
        right_low=low,
        right_high=high,
        uncovered=of_place["uncovered"],
        uncovered_wrong=wrong["uncovered"],
        elsewhere=of_place["elsewhere"],
        elsewhere_wrong=wrong["elsewhere"],
        median_error_m=_median([t.error_m for t in right]),
        cpu_s=_median_cpu_s(trials, elsewhere=False),
        elsewhere_cpu_s=_median_cpu_s(trials, elsewhere=True),
        peak_mb=max(t.peak_mb for t in trials),
    )


def _median_cpu_s(trials: Sequence[PeerTrial], *, elsewhere: bool) -> float | None:
    return _median([t.cpu_s for t in trials if (t.place == "elsewhere") == elsewhere])


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _interval(right: Sequence[bool]) -> tuple[float | None, float | None]:
    """Percentiles of the share, by resampling the queries."""
    if not right:
        return None, None
    bounds = (OUTCOME.low, OUTCOME.high)
    return share_by_session(
        range(len(right)), np.array(right), draws=OUTCOME.resamples, seed=OUTCOME.seed, percentiles=bounds
    )[1:]
