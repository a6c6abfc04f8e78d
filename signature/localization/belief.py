"""The posterior filtered over time, with a rate of kidnapping.

    prior_t(h)  =  1 + (1 - k) mass_s(h) / (1 - (1 - k) sum_g mass_s(g)),    k = 1 - (1 - slip)^n
    mass_t(h)   =  prior_t(h) exp(z_h) / N        (`signature.localization.decision`)

The scans of a search are those of the last metres, so the searches overlap. The prior of search t follows
from the latest search s that lies before all scans of t. Then each scan counts once, however far the robot
has driven, and a search costs the same after 80 m as after 15 m. The odometry carries the places on: the pose
of a query in the map is that of its odometry frame, which does not move.

At each of the n scans of t, odometry may fail or the robot may be carried away, at the rate `slip`. This
share of the mass joins "anywhere", of which each place has the mass of "nowhere" again, as at the beginning.
So the past makes a place at most 1 / k times as likely, and a place that the robot was never believed to be
at has the prior 1.

Odometry carries the places of search s to t; their covariances grow. One test tells whether a place of t is
one of them: the Mahalanobis distance of the two poses (`signature.localization.hypotheses.agree`).

Off the map: where a map shows too little of what is seen (`PosteriorParameters.shown`), it tells nothing of
a place, neither for it nor against it. So a place of search s stays as likely beside "nowhere" as it was, at
the pose to which odometry carries it:

    mass_t(h)   =  (prior_t(h) - 1) / N,        which N contains, too

What walls find there, too, is the same place, and both masses count if the walls say it more exactly. While
the map shows too little it is held at the pose of odometry, since on few walls a pose slides. When the robot
comes back, the place that the map shows there has this mass before it.

After a slip that is more likely than not, nothing that was known before counts; the place where the robot was
held to be is remembered, and is given up when the scans since say so.

Fox, Burgard and Thrun 1999, "Markov localization for mobile robots in dynamic environments"; Thrun, Burgard
and Fox, "Probabilistic Robotics", chapter 8.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from pc2grid.geometry import SE2, lever_arm
from pc2grid.matching.score import Fit, score_fit
from signature.localization.answer import LIKELY, Answer, Place, State
from signature.localization.decision import POSTERIOR, PriorOf
from signature.localization.hypotheses import agree, more_exact
from signature.localization.map_index import MapIndex
from signature.localization.prior import PRIOR
from signature.localization.query import QueryMap


def with_mass(answer: Answer) -> tuple[Place, ...]:
    """Return the places that an answer gives mass to, first place first, with when a map showed each last. A
    place of which the map shows too little to align it stays where odometry has carried the robot."""
    beside = list(answer.off_map)
    places: list[Place] = []
    for place in answer.places:
        first, at = place.fits[0], answer.T_odom_base
        for k, away in enumerate(beside):
            if first.overlap < POSTERIOR.shown and agree(at, away.fits[0], first):
                places.append(replace(beside.pop(k), mass=away.mass + place.mass))
                break
        else:
            covariances = tuple(fit.covariance for fit in place.fits)
            places.append(replace(place, seen_m=answer.path_m, T_odom_seen=at, seen=covariances))
    return (*places, *beside)


def mass_at(fits: Sequence[Fit], places: Iterable[Place], T_odom_base: SE2) -> float:
    """Return the mass of those of the places that put the base where one of the fits does."""
    return sum(
        place.mass
        for place in places
        if any(agree(T_odom_base, known, fit) for known in place.fits for fit in fits)
    )


def _carried(place: Place, now: QueryMap | Answer, odds: float = 1.0) -> Place:
    """Return the place with the covariances of the base now, by the odometry since the map showed it, and
    with `odds` times its mass."""
    way_m = (now.path_m - place.seen_m) / PRIOR.sigmas
    drift = np.array([PRIOR.drift, PRIOR.drift, PRIOR.drift_rad_m]) * way_m
    fits = []
    for fit, seen in zip(place.fits, place.seen, strict=True):
        J = lever_arm(fit.T_map_query @ place.T_odom_seen, fit.T_map_query @ now.T_odom_base)
        fits.append(replace(fit, covariance=np.asarray(J @ seen @ J.T + np.diag(drift**2))))
    return replace(place, fits=tuple(fits), mass=odds * place.mass)


def kept(query: QueryMap) -> float:
    """Return 1 - k, the share of the masses before a query that stays where it was."""
    return float((1.0 - POSTERIOR.slip) ** max(len(query.keyframes), 1))


class Belief:
    """The masses of the searches since the start of the last window, and what they say of a running robot."""

    def __init__(self, accept: float) -> None:
        """Begin without any place.

        accept : least mass to say where the robot is, and to say that it is not where it was.
        """
        self._accept = accept
        # Answers without maps, with all places that have mass (`with_mass`), or the likeliest alone.
        self._searches: list[Answer] = []
        self._place: Answer | None = None  # where it is held to be, located or off the map
        self._found: tuple[Answer, float] | None = None  # the last search, if it located the robot; doubt
        self._was_located = False

    @property
    def located(self) -> bool:
        """Return whether the robot is taken to be somewhere, in the map or off it."""
        return self._place is not None

    def in_its_map(self, answer: Answer) -> Answer:
        """Return the answer in which, of each place, the fit in the map in which the robot is taken to be
        comes first."""
        number = self._place.places[0].fits[0].session_index if self._place else None
        places = tuple(
            replace(place, fits=tuple(sorted(place.fits, key=lambda fit: fit.session_index != number)))
            for place in answer.places
        )
        return replace(answer, places=places)

    def before(self, index: MapIndex, query: QueryMap) -> tuple[PriorOf, tuple[Place, ...]]:
        """Return the prior of each place by the masses before all scans of a query, carried on by odometry,
        and those places of which the map shows too little. Masses are relative to that of "nowhere"."""
        known, beside, share = [], [], kept(query)
        for past in self._before(query)[-1:]:
            odds = share / (1.0 - share * past.mass)
            known = [_carried(place, query, odds) for place in past.places]
        for place in known:
            h = place.fits[0]
            walls = index.maps_for(query)[h.session_index].walls
            fit = score_fit(walls, query.walls, h.T_map_query, h.covariance)
            if place.mass >= 1.0 - POSTERIOR.certain and fit.overlap < POSTERIOR.shown:
                here = replace(fit, session_index=h.session_index, submap_id=h.submap_id)
                beside.append(replace(place, fits=(here,), seen=place.seen[:1]))

        def prior_of(fits: Sequence[Fit]) -> float:
            shown = fits[0].overlap >= POSTERIOR.shown
            found = (place for place in known if shown or more_exact(fits[0], place.fits[0]))
            return 1.0 + mass_at(fits, found, query.T_odom_base)

        return prior_of, tuple(beside)

    def _before(self, query: QueryMap) -> list[Answer]:
        """Return the searches that lie before all scans of a query, and after a slip before it."""
        first_m = query.keyframes[0].path_m if query.keyframes else 0.0
        return [
            past
            for past in self._searches
            if past.part == query.part and query.slipped_m <= past.path_m < first_m
        ]

    def update(self, query: QueryMap, answer: Answer) -> State:
        """Return the state of a running robot after a search. Keep its masses; forget those that no later
        query continues."""
        now = replace(answer.moment, places=with_mass(answer), T_odom_base=answer.T_odom_base)
        likeliest = replace(now, places=tuple(sorted(now.places, key=lambda place: -place.mass)[:1]))
        forgotten = max(len(self._before(query)) - 1, 0)
        here = [known for known in self._searches if known.part == query.part]
        self._searches = [*here[forgotten:], now]
        on = _mass_there(now, self._place)
        if answer.status == "located":
            doubt = 1.0 - answer.confidence
            if self._found is not None and _mass_there(now, self._found[0]) >= self._accept:
                doubt *= self._found[1]
            self._found = likeliest, doubt
            if on >= LIKELY or doubt <= 1.0 - POSTERIOR.certain:
                goes_on = on >= LIKELY or not self._was_located
                self._was_located, self._place = True, likeliest
                return "located" if goes_on else "recovered"
        else:
            self._found = None
            if answer.beside_map is not None:
                self._place = likeliest
                return "off_map"
        held, less_sure = self._place, on > 1.0 - self._accept
        if held and held.part == now.part and (less_sure or held.places[0].seen_m < held.path_m):
            return "doubtful"
        self._place = None
        return "lost" if self._was_located else "searching"


def _mass_there(now: Answer, before: Answer | None) -> float:
    """Return the mass of the places where a robot may be now if odometry has carried it from one place
    before."""
    if before is None or before.part != now.part:
        return 0.0
    return mass_at(_carried(before.places[0], now).fits, now.places, now.T_odom_base)
