"""What is decided of a query: the masses of the places that are found, and the status that they give.

    mass(h)  =  prior(h) exp(z_h) / N                        the query lies at h
    slipped  =  mass(h) A sum_k s exp(-c r_k)                it lay at the likeliest h until scan k
    nowhere  =  1 / N                                        it lies at no place of this map
    N        =  1 + sum_h prior(h) exp(z_h), and all else that is told apart from "nowhere"

z_h is the evidence of a place (`pc2grid.matching.evidence`).

- r_k, the log-likelihood of the scans from k on, f of these alone, a metre, times the metres since: where
  tracking slips or the robot is carried away, the scans before fit and those after do not. s is the rate of
  slips, per scan, higher where its pose is not fine. As in a test by the least sum (Page 1954, "Continuous
  inspection schemes"), what has contradicted for long tells more; metres count, because neighbouring scans
  see the same walls. Where all scans contradict, as those of a camera in a laser's map, r_k is what these
  contradict more: the score of the place has the rest.
- A, what the scans since the likeliest slip can be: "nowhere" and each other place of the map, found for
  these scans alone. 1 as long as nothing contradicts the place. If that is likelier than not, what they say
  is the answer.

located      one place has at least the mass `RelocalizeConfig.accept`
ambiguous    the best place, or one that fits equally well, is at least as likely as "nowhere", z + ln prior
             >= 0; so where maps show one place and nothing says so, because their sessions are not joined
not_found    all else
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.matching.evidence import EVIDENCE, LEFT, evidence_of, masses, tempered
from pc2grid.matching.score import Fit
from pc2grid.matching.walls import Walls
from signature.localization.answer import Answer, Place, Status
from signature.localization.hypotheses import agree, more_exact, same_pose
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap


@dataclass(frozen=True, slots=True, kw_only=True)
class PosteriorParameters:
    """What the equation above is made of.

    slip : s, once in 100 m of scans 0.1 m apart; by hand, since it is too rare to be fitted. At .0006 a robot
        that is carried away notices later, at .002 one that leaves the map forgets where it was.
    slip_weak : s of a scan whose pose is not fine; by hand: at .05 a robot that is lifted is lost while its
        last scans fit.
    certain : a robot is told where it is if the searches in a row that found it there are that sure; by hand.
    shown : a map that knows the ground of less than this share of the walls that are seen says nothing of a
        place; half, as where the recordings are judged.
    """

    slip: float = 0.001
    slip_weak: float = 0.01
    certain: float = 0.99
    shown: float = 0.5


POSTERIOR = PosteriorParameters()

PriorOf = Callable[[Sequence[Fit]], float]
"""Prior of a place by its fits, relative to that of "not in this map"."""


def anywhere(fits: Sequence[Fit]) -> float:
    """Return the prior of a place without any knowledge."""
    return 1.0


def decide(
    index: MapIndex,
    query: QueryMap,
    known: tuple[Fit, ...] = (),
    prior_of: PriorOf = anywhere,
) -> tuple[Answer, tuple[Fit, ...]]:
    """Return the answer by the hypotheses that are known and those that the search finds, and all of these.
    The search ends when one place is certain and the right one likely searched, or when what is left has too
    little mass to matter."""
    for found, left in index.search(query, known):
        answer = judge(index, query, found, prior_of)
        # What was not searched may fit as well as what was.
        if left < LEFT or (answer.located and left < 1.0 - index.config.accept):
            break
    return answer, found


def judge(
    index: MapIndex, query: QueryMap, hypotheses: Sequence[Fit], prior_of: PriorOf = anywhere
) -> Answer:
    """Return the posterior over the places of the hypotheses, see above.

    A place that the prior of the index excludes has no mass. But it shows what wrong places score for this
    query, so it remains a rival. Otherwise any place in a small region, which has few rivals, would look
    certain.
    """
    groups, rivals = _allowed(index, query, by_place(index, query, hypotheses))
    evidence_for = evidence_of([fits[0] for fits in groups], query.likeness, rivals)
    known = list(zip(groups, map(prior_of, groups), evidence_for, strict=True))
    known.sort(key=lambda each: -math.log(each[1]) - each[2].log_odds())
    mass = masses([each[2] for each in known], [each[1] for each in known]).tolist()
    in_the_map = any(each[2].log_odds() + math.log(each[1]) >= 0.0 for each in known[:1])
    status: Status = "ambiguous" if in_the_map else "not_found"
    return Answer(
        status="located" if sum(mass[:1]) >= index.config.accept else status,
        confidence=sum(mass[:1]),
        places=tuple(Place(fits=fits, mass=share) for (fits, *_), share in zip(known, mass, strict=True)),
        log_odds=known[0][2].log_odds() if known else -math.inf,
        stamp_ns=query.stamp_ns,
        path_m=query.path_m,
        T_odom_base=query.T_odom_base,
        local_map=query.grid,
        views_m=tuple(view.center_m for view in query.views),
        sessions=index.sessions,
        labels=index.labels,
        part=query.part,
    )


def slip_of(query: QueryMap, fit: Fit, walls: Walls, step_m: float) -> tuple[float, int]:
    """Return the mass of "it lay here until it was carried away or tracking slipped", as a multiple of that
    of the place, with A = 1; and the number of scans since the likeliest slip, 0 if none contradict the
    place.

    step_m : travel after which scans are new evidence.
    """
    above = query.walls.facing(walls).only_explain
    likelihood = points = 0.0
    levels, steps, weak = [], [], []
    # Before the first scan there was nothing to slip from.
    for count, keyframe in enumerate(reversed(query.keyframes[1:]), start=1):
        hits_m = (fit.T_map_query @ keyframe.T_odom_base).apply(keyframe.planar_scan.hits_m)
        values, known = walls.field.at(hits_m, above=above)
        likelihood += float(values[known].sum())
        points += float(np.count_nonzero(known))
        mean = likelihood / points if points else 0.0
        levels.append(tempered(mean, points / count))
        steps.append(max((query.path_m - keyframe.path_m) / step_m, 1.0))
        weak.append(keyframe.weak)
    tail = (np.array(levels) - min([*levels[-1:], 0.0])) * steps
    since = 1 + int(tail.argmin()) if tail.min(initial=0.0) < 0.0 else 0
    rates = np.where(weak, POSTERIOR.slip_weak, POSTERIOR.slip)
    return float(rates @ np.exp(-EVIDENCE.fit * tail)), since


def weighed(
    answer: Answer, prior_of: PriorOf, off_map: Sequence[Place], slipped: float, accept: float
) -> Answer:
    """Return the answer weighed against what else may be: places that the map does not show, and that the
    robot was carried away or tracking slipped. Of a place beside the map that the map puts where the query
    lies by its walls, too, both masses count for the confidence.

    off_map : with masses relative to "nowhere". slipped : relative to the first place.
    """
    first, at = answer.places[0].fits if answer.places else (), answer.T_odom_base
    odds = 1.0
    if answer.confidence:
        odds = prior_of(first) * math.exp(answer.log_odds) / answer.places[0].mass
    share = 1.0 / (odds * (1.0 + slipped * answer.confidence) + sum(away.mass for away in off_map))
    places = tuple(replace(place, mass=place.mass * odds * share) for place in answer.places)
    here = [
        away
        for away in off_map
        if any(agree(at, away.fits[0], h) and more_exact(h, away.fits[0]) for h in first)
    ]
    confidence = sum(place.mass for place in places[:1]) + share * sum(away.mass for away in here)
    return replace(
        answer,
        status="ambiguous" if answer.located and confidence < accept else answer.status,
        confidence=confidence,
        places=places,
        off_map=tuple(
            replace(away, mass=away.mass * share) for away in sorted(off_map, key=lambda away: -away.mass)
        ),
    )


def _allowed(
    index: MapIndex, query: QueryMap, places: Sequence[tuple[Fit, ...]]
) -> tuple[list[tuple[Fit, ...]], list[Fit]]:
    """Return the places that the prior of the index allows, and the fits of the others, which show what wrong
    places score."""
    inside = [tuple(h for h in place if index.allows(query, h)) for place in places]
    excluded = [place[0] for place, left in zip(places, inside, strict=True) if not left]
    return [place for place in inside if place], excluded


def by_place(index: MapIndex, query: QueryMap, hypotheses: Iterable[Fit]) -> list[tuple[Fit, ...]]:
    """Return the hypotheses by place, best first. Hypotheses in the maps of joined sessions are one place if
    they put the query at one pose of their building; a place has one hypothesis a session."""
    places: list[tuple[Fit, ...]] = []
    for h in hypotheses:
        for number, place in enumerate(places):
            elsewhere = h.session_index not in {other.session_index for other in place}
            if elsewhere and any(_one_place(index, query, h, other) for other in place):
                places[number] = (*place, h)
                break
        else:
            places.append((h,))
    return places


def _one_place(index: MapIndex, query: QueryMap, a: Fit, b: Fit) -> bool:
    """Return whether two hypotheses in the maps of two sessions are one pose of the building of both."""
    frames = index.joined(a.session_index, b.session_index)
    return frames is not None and same_pose(
        *(at.placed(h.T_map_query @ query.T_odom_base) for at, h in zip(frames, (a, b), strict=True))
    )
