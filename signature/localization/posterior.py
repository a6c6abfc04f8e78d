"""The posterior over places, from which an answer is read.

Each place of the maps that may be the query's has a mass, and so has "not in this map":

    mass(h)  =  prior(h) exp(z_h) / N                        the query lies at h
    slipped  =  mass(h) A sum_k s exp(-c r_k)                it lay at the likeliest h until scan k
    nowhere  =  1 / N                                        it lies at no place of this map
    N        =  1 + sum_h prior(h) exp(z_h), and all else that is told apart from "nowhere"

located      the best place has at least the mass `RelocalizeConfig.accept`
ambiguous    it has less, but is at least as likely as "nowhere", z + ln prior >= 0: several places share the
             mass, or several maps show one place and nothing says so, because they are not joined
not_found    all else

*Evidence.* z_h is that of the walls (`pc2grid.matching.evidence`).

*Slips.* r_k is the log-likelihood of the scans from k on, f of these alone, a metre, times the metres since:
where tracking slips or the robot is carried away, the scans before fit and those after do not. s is the rate
of slips, per scan, higher where its pose is not fine. As in a test by the least sum (Page 1954, "Continuous
inspection schemes"), what has contradicted for long tells more; metres count, because neighbouring scans see
the same walls. Where all scans contradict, as those of a camera in a laser's map, r_k is what these
contradict more: the score of the place has the rest. A is what the scans since the likeliest slip can be:
"nowhere" and each other place of the map, found for these scans alone; 1 as long as nothing contradicts the
place. If that is likelier than not, what they say is the answer.

*Over time.* The posterior is filtered, with a rate of kidnapping:

    prior_t(h)  =  1 + (1 - k) mass_s(h) / (1 - (1 - k) sum_g mass_s(g)),    k = 1 - (1 - slip)^n

The scans of a search are those of the last metres, so the searches overlap. The prior of search t follows
from the latest search s that lies before all n scans of t. Then each scan counts once, however far the robot
has driven, and a search costs the same after 80 m as after 15 m. The odometry carries the places on: the pose
of a query in the map is that of its odometry frame, which does not move; the covariances grow. At each scan,
odometry may fail or the robot may be carried away, at the rate `slip`. This share of the mass joins
"anywhere", of which each place has the mass of "nowhere" again, as at the beginning. So the past makes a
place at most 1 / k times as likely, and a place that the robot was never believed to be at has the prior 1.
After a slip that is more likely than not, nothing that was known before counts; the place where the robot was
held to be is remembered, and is given up when the scans since say so.

*Beside the map.* Where a map shows too little of what is seen (`PosteriorParameters.shown`), it tells nothing
of a place, neither for it nor against it. So a place of search s stays as likely beside "nowhere" as it was,
at the pose to which odometry carries it:

    mass_t(h)   =  (prior_t(h) - 1) / N,        which N contains, too

What walls find there, too, is the same place, with both masses, if the walls say it more exactly
(`Place.beside`). While the map shows too little it is held at the pose of odometry, since on few walls a pose
slides. When the robot comes back, the place that the map shows there has this mass before it.

*In space.* Where map and query both have points, they are a factor of each place:

    mass(h)  =  m_h exp(u_h) / (1 - sum_g m_g + sum_g m_g exp(u_g + p n_gh))
    u_h      =  d_h (a on_h + b through_h + c before_h)

- m_h, the mass in the plane; what is missing to 1 is "not in this map".
- on_h, through_h, before_h, the shares of the rays of the query that end there on a surface of the map,
  behind one, or before one, once ICP has brought the query onto them. a, b and c are what each kind tells:
  what has been taken away since (through) contradicts less than what stands where the map shows nothing
  (before). This is independent of the occupancy grids.
- d_h, 0..1, how well the surfaces hold the query (`SpatialFit.held`): walls of a corridor fit all along it.
- Where ICP leaves the planar pose, u_h is what that tells, `left`. Where a side shows nothing, u_h = 0.
- Among places that agree (u >= 0), u is that of the best one: in each of two rooms alike the things may have
  been moved since. They are told apart by n_gh, the patches of the building that only g explains, less
  those that only h does (`pc2grid.matching.icp_in_space.Rays.patches_over`).

The place that is likeliest is the answer, and its pose that of ICP, in six degrees of freedom.
`pc2grid_lab.fit.posterior` fits a, b, c and `left`, and judges them on buildings that were left out.

Fox, Burgard and Thrun 1999, "Markov localization for mobile robots in dynamic environments"; Thrun, Burgard
and Fox, "Probabilistic Robotics", chapter 8.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from pc2grid.geometry import F64, SE2, lever_arm
from pc2grid.matching.evidence import EVIDENCE, LEFT, evidence_of, masses, tempered
from pc2grid.matching.icp_in_space import MapSurface, SpatialFit, Unfit, register_in_space
from pc2grid.matching.score import Fit, score_fit
from signature.localization.answer import LIKELY, Answer, Place, PoseInSpace, SpaceStatus, State, Status
from signature.places.hypotheses import HYPOTHESES, SIGMAS, agree, more_exact, one_place
from signature.places.map_index import MapIndex, drifted
from signature.places.query import QueryInSpace, QueryMap


@dataclass(frozen=True, slots=True, kw_only=True)
class PosteriorParameters:
    """What the equations above are made of.

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
"""Prior of a place by its fits, relative to that of "not in this map"; None: nothing is known, 1."""


# --- Evidence ---


def decide(
    index: MapIndex,
    query: QueryMap,
    known: tuple[Fit, ...] = (),
    prior_of: PriorOf | None = None,
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
    index: MapIndex, query: QueryMap, hypotheses: Iterable[Fit], prior_of: PriorOf | None = None
) -> Answer:
    """Return the answer by the places of the hypotheses and what their walls tell.

    A place that the prior of the index excludes has no mass. But it shows what wrong places score for this
    query, so it remains a rival. Otherwise any place in a small region, which has few rivals, would look
    certain.
    """
    every = by_place(index, query, hypotheses)
    inside = [tuple(h for h in fits if index.allows(query, h)) for fits in every]
    rivals = [fits[0] for fits, left in zip(every, inside, strict=True) if not left]
    inside = [fits for fits in inside if fits]
    evidence = evidence_of([fits[0] for fits in inside], query.likeness, rivals)
    mass = masses(evidence, 1.0 if prior_of is None else [prior_of(fits) for fits in inside])
    places = tuple(
        Place(fits=inside[k], mass=float(mass[k])) for k in np.argsort(-mass, kind="stable").tolist()
    )
    return Answer(
        status=_status(places, 1.0 - float(mass.sum()), index.config.accept),
        places=places,
        stamp_ns=query.stamp_ns,
        path_m=query.path_m,
        T_odom_base=query.T_odom_base,
        local_map=query.grid,
        views_m=tuple(view.center_m for view in query.views),
        sessions=index.sessions,
        labels=index.labels,
        part=query.part,
    )


def _status(places: Sequence[Place], nowhere: float, accept: float) -> Status:
    """Return what the masses say. The first place need not be as likely as all else, but as "nowhere"."""
    first = sum(place.mass for place in places[:1])
    if first >= accept:
        return "located"
    return "ambiguous" if places and first >= nowhere else "not_found"


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
    frame, other = (index.frames.get(index.sessions[h.session_index]) for h in (a, b))
    if frame is None or other is None or frame.name != other.name:
        return False
    here, there = (h.T_map_query @ query.T_odom_base for h in (a, b))
    return one_place(frame.placed(here), other.placed(there))


# --- Slips, and what is beside the map ---


def slip_of(index: MapIndex, query: QueryMap, answer: Answer) -> tuple[float, int]:
    """Return the mass of "it lay at the best fit until it was carried away or tracking slipped", as a
    multiple of that of the place, with A = 1; and the number of scans since the likeliest slip, 0 if none
    contradict the place."""
    if answer.best is None:
        return 0.0, 0
    T_map_query = answer.best.T_map_query
    walls = index.maps_for(query)(answer.best.session_index).walls
    above = query.walls.facing(walls).only_explain
    likelihood = points = 0.0
    levels, steps, weak = [], [], []
    # Before the first scan there was nothing to slip from.
    for count, keyframe in enumerate(reversed(query.keyframes[1:]), start=1):
        hits_m = (T_map_query @ keyframe.T_odom_base).apply(keyframe.planar_scan.hits_m)
        values, known = walls.field.at(hits_m, above=above)
        likelihood += float(values[known].sum())
        points += float(np.count_nonzero(known))
        mean = likelihood / points if points else 0.0
        levels.append(tempered(mean, points / count))
        # Travel after which scans are new evidence.
        steps.append(max((query.path_m - keyframe.path_m) / index.config.step_m, 1.0))
        weak.append(keyframe.weak)
    tail = (np.array(levels) - min([*levels[-1:], 0.0])) * steps
    since = 1 + int(tail.argmin()) if tail.min(initial=0.0) < 0.0 else 0
    rates = np.where(weak, POSTERIOR.slip_weak, POSTERIOR.slip)
    return float(rates @ np.exp(-EVIDENCE.fit * tail)), since


def elsewhere(alone: Answer, place: Answer) -> float:
    """Return A: the mass of all that the scans since a slip can be but the place that they contradict, as a
    multiple of "nowhere"."""
    here = mass_at(place.hypotheses[:1], with_mass(alone), alone.T_odom_base)
    return (1.0 - here) / max(1.0 - alone.mass, np.finfo(float).tiny)


def weighed(answer: Answer, off_map: Sequence[Place], slipped: float, accept: float) -> tuple[Answer, float]:
    """Return the answer weighed against what else may be: places that the map does not show, and that the
    robot was carried away or tracking slipped; and the mass of this. A place beside the map is one with the
    place where walls put the query more exactly, with the masses of both.

    off_map : with masses relative to "nowhere". slipped : relative to the first place.
    """
    slip = slipped * answer.confidence
    nowhere = 1.0 - answer.mass
    share = 1.0 / (1.0 + slip + nowhere * sum(away.mass for away in off_map))
    places, beside = _together(
        [replace(place, mass=share * place.mass) for place in answer.places],
        [replace(away, mass=share * nowhere * away.mass) for away in off_map],
        answer.T_odom_base,
    )
    status = _status(places, share * nowhere, accept)
    return replace(answer, status=status, places=tuple(places), off_map=tuple(beside)), share * slip


def _together(
    places: list[Place], off_map: Iterable[Place], T_odom_base: SE2
) -> tuple[list[Place], list[Place]]:
    """Return the places, each with what is beside the map and one with it, and the others beside the map;
    both likeliest first."""
    others = []
    for away in sorted(off_map, key=lambda away: -away.mass):
        here = away.fits[0]
        for k, place in enumerate(places):
            if any(more_exact(h, here) and agree(T_odom_base, here, h) for h in place.fits):
                places[k] = replace(place, mass=place.mass + away.mass, beside=place.beside or away)
                break
        else:
            others.append(away)
    return sorted(places, key=lambda place: -place.mass), others


# --- Over time ---


def with_mass(answer: Answer) -> tuple[Place, ...]:
    """Return the places that an answer gives mass to, first place first, with when a map showed each last. A
    place of which the map shows too little to align it stays where odometry has carried the robot."""
    off_map, places = list(answer.off_map), list[Place]()
    for place in answer.places:
        first, beside = place.fits[0], place.beside
        here = [k for k, away in enumerate(off_map) if agree(answer.T_odom_base, away.fits[0], first)]
        if beside is None and here:
            beside = off_map.pop(here[0])
            place = replace(place, mass=place.mass + beside.mass)
        if beside is not None and first.overlap < POSTERIOR.shown:
            places.append(replace(beside, mass=place.mass))
        else:
            covariances = tuple(fit.covariance for fit in place.fits)
            at = answer.T_odom_base
            places.append(replace(place, beside=None, seen_m=answer.path_m, T_odom_seen=at, seen=covariances))
    return (*places, *off_map)


def mass_at(fits: Sequence[Fit], places: Iterable[Place], T_odom_base: SE2) -> float:
    """Return the mass of those of the places that put the base where one of the fits does."""
    return sum(
        place.mass for place in places if any(agree(T_odom_base, h, fit) for h in place.fits for fit in fits)
    )


def _carried(place: Place, now: QueryMap | Answer, odds: float = 1.0) -> Place:
    """Return the place with the covariances of the base now, by the odometry since the map showed it, and
    with `odds` times its mass."""
    drift = drifted(now.path_m - place.seen_m) / SIGMAS**2
    fits = []
    for fit, seen in zip(place.fits, place.seen, strict=True):
        J = lever_arm(fit.T_map_query @ place.T_odom_seen, fit.T_map_query @ now.T_odom_base)
        fits.append(replace(fit, covariance=np.asarray(J @ seen @ J.T + drift)))
    return replace(place, fits=tuple(fits), mass=odds * place.mass)


def stayed(query: QueryMap) -> float:
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
        known, beside, share = [], [], stayed(query)
        for past in self._before(query)[-1:]:
            odds = share / (1.0 - share * past.mass)
            known = [_carried(place, query, odds) for place in past.places]
        for place in known:
            h = place.fits[0]
            walls = index.maps_for(query)(h.session_index).walls
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


# --- In space ---


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceParameters:
    """What the equation in space is made of.

    on, through, before, left : a, b, c, and u of a place that ICP leaves. Fitted to the hall, the e1r office,
        the corridor, the room, the kitchen and fr079 of the catalogue of recordings, with windows twice as
        dense. By those of the catalogue alone `before` is twice as much, and the same is located; but then a
        cupboard that was brought since, a tenth of the rays, would contradict a room.
    patch : p. Two maps of one simulated office, with other things in it, differ by 0 to 4 patches, by 7 where
        a map is bent; offices whose ceilings differ by 1 m, by 30 where they are seen. By hand.
    """

    on: float = 13.4
    through: float = -18.6
    before: float = -106.1
    left: float = -4.3
    patch: float = 0.2


SPACE = SpaceParameters()


def settle_in_space(
    answer: Answer, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> Answer:
    """Return the answer with the points as a factor, and the pose in space of the place that is located, or
    of the one that was located and is rejected now. Return it unchanged where no place can be compared.

    surface_of : the points of a session, by its index. accept : least confidence to be located.
    """
    if not query.views or query.T_odom_base is None:
        return answer
    fits, mass, best = _compared(answer, query, surface_of, accept)
    if not fits:
        return answer
    poses = {k: _pose(fit, query.T_odom_base) for k, fit in fits.items() if isinstance(fit, SpatialFit)}
    order = sorted(range(len(mass)), key=lambda k: (k != best, -mass[k]))
    places = [replace(answer.places[k], mass=float(mass[k])) for k in order]
    settled = _status(places, 1.0 - float(mass.sum()), accept)
    in_space = poses.get(best) if settled == "located" else None
    if in_space is not None:
        planar = np.ix_((0, 1, 5), (0, 1, 5))
        T_map_query = SE2.from_matrix(in_space.T_map_base) @ SE2.from_matrix(query.T_odom_base).inverse()
        first, *others = places[0].fits
        first = replace(first, T_map_query=T_map_query, covariance=in_space.covariance[planar])
        places[0] = replace(places[0], fits=(first, *others))
    elif settled != "located" and answer.located:
        in_space = poses.get(0)
    # What the map does not show stays as likely beside "nowhere" as it was.
    less = (1.0 - mass.sum()) / max(1.0 - answer.mass, np.finfo(float).tiny)
    off_map = tuple(replace(away, mass=less * away.mass) for away in answer.off_map)
    return replace(answer, status=settled, places=tuple(places), off_map=off_map, in_space=in_space)


def _compared(
    answer: Answer, query: QueryInSpace, surface_of: Callable[[int], MapSurface | None], accept: float
) -> tuple[dict[int, SpatialFit | Unfit], F64, int]:
    """Return the fits of places by number, without those of which nothing is known; the masses with them, and
    the likeliest place. The places with the most mass are compared, until no other one can change what is
    certain."""
    fits: dict[int, SpatialFit | Unfit] = {}
    planar = [place.mass for place in answer.places]
    best, mass = 0, np.array(planar)
    for number, place in enumerate(answer.places):
        fit = fit_in_space(query, surface_of(place.fits[0].session_index), place.fits[0])
        if log_odds_in_space(fit):
            fits[number] = fit
            mass, best = masses_of(planar, fits)
        # The places that are left can agree as well as the best one: is that certain all the same?
        left = sum(planar[number + 1 :]) / max(planar[best], np.finfo(float).tiny)
        if best in fits and mass[best] >= accept * (1.0 + mass[best] * left):
            break
    return fits, mass, best


def fit_in_space(query: QueryInSpace, surface: MapSurface | None, place: Fit) -> SpatialFit | Unfit:
    """Return the fit of a query at a place. surface : the points of its map; None: there are none."""
    return "unknown" if surface is None else register_in_space(query.views, surface, place.T_map_query)


def masses_of(planar: Sequence[float], fits: Mapping[int, SpatialFit | Unfit]) -> tuple[F64, int]:
    """Return `masses_in_space` of places, by the fits of those that are compared, by number."""
    u, patches = np.full(len(planar), np.nan), np.zeros((len(planar), len(planar)))
    for place, fit in fits.items():
        u[place] = log_odds_in_space(fit)
    for (h, fit), (g, other) in permutations(fits.items(), 2):
        if isinstance(fit, SpatialFit) and isinstance(other, SpatialFit):
            patches[h, g] = other.compared.patches_over(fit.compared)
    return masses_in_space(np.asarray(planar), u, SPACE.patch * patches)


def masses_in_space(planar: F64, u: F64, other: F64 | float = 0.0) -> tuple[F64, int]:
    """Return the masses (P,) of places with the points as a factor, and the number of the likeliest.

    planar : (P,) in the plane. u : (P,), NaN of a place that is not compared. other : (P, P), by how much the
    log odds of the second place are higher beside the first one.
    """
    compared, agrees = np.isfinite(u), u >= 0.0
    shared = np.where(agrees, np.max(u, initial=0.0, where=compared), np.where(compared, u, 0.0))
    odds = planar * np.exp(shared)
    # Each row: the odds of all places beside that of one of them.
    every = odds * np.exp(np.broadcast_to(other, (len(odds), len(odds))))
    rows = 1.0 - planar.sum() + every.sum(axis=1)
    likeliest = int((odds / rows).argmax())
    return np.asarray(every[likeliest] / rows[likeliest]), likeliest


def log_odds_in_space(fit: SpatialFit | Unfit) -> float:
    """Return u of a place: below 0 its surfaces agree with the rays less than those of wrong places."""
    return float(np.dot(terms_in_space(fit), (SPACE.on, SPACE.through, SPACE.before, SPACE.left)))


def terms_in_space(fit: SpatialFit | Unfit) -> tuple[float, float, float, float]:
    """Return the factors of a, b, c and `left`."""
    if isinstance(fit, SpatialFit):
        return fit.held * fit.on, fit.held * fit.through, fit.held * fit.before, 0.0
    return 0.0, 0.0, 0.0, float(fit == "left")


def _pose(fit: SpatialFit, T_odom_base: F64) -> PoseInSpace:
    u = log_odds_in_space(fit)
    of_map = np.repeat((HYPOTHESES.map_m, HYPOTHESES.map_rad), 3)
    status: SpaceStatus = "agrees" if u >= 0.0 else "unsure"
    return PoseInSpace(
        # Like one that ICP leaves.
        status="contradicts" if u <= SPACE.left else status,
        T_map_base=fit.T_map_query @ T_odom_base,
        covariance=fit.covariance_at(T_odom_base) + np.diag(np.square(of_map)),
        rmse_m=fit.rmse_m,
        rays=fit.rays,
        on=fit.on,
        through=fit.through,
        before=fit.before,
    )
