"""The answer to "where was this?": places with their probabilities, and the pose if one of them is certain.

Three things are made of it. A line, on which the likely places of an ambiguous answer lie: the walls of a
corridor hold a query across it and with its heading, and along it the query fits again and again, so that
there are many places and yet much is known. The same answer in the frame of a building, where its session was
joined with others. The path of the query, corrected by where it was located on the way.

`signature.shown` draws answers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field

from pc2grid.display import html_picture, html_table, map_png, plain, probability, short
from pc2grid.geometry import F64, I64, SE2, frozen_arrays, lever_arm, wrap_angle
from pc2grid.matching.score import Fit
from pc2grid.model import Health, OccupancyGrid, Trajectory
from signature.database.protocol import BuildingFrame, Label
from signature.places.hypotheses import HYPOTHESES, SAME, is_inside
from signature.places.map_index import drifted

Status = Literal["located", "ambiguous", "not_found"]
SpaceStatus = Literal["agrees", "unsure", "contradicts"]
State = Literal["searching", "located", "off_map", "doubtful", "lost", "recovered"]
"""searching: not located yet. located: one place has at least the mass `RelocalizeConfig.accept`; and the
robot was located there before, or the searches in a row that found it there leave no more doubt, multiplied,
than `PosteriorParameters.certain`. off_map: most likely it is where the map shows too little of what it sees.
doubtful: none of these; lost: nor is it where it was, as all else together has at least the mass `accept`, or
it was carried away. What a map shows does not contradict a place that it does not show: off the map, a robot
is not lost but doubtful until it is located elsewhere. recovered: located elsewhere, or again after it was
lost."""

LIKELY = 0.5
"""Least mass of what is more likely than not."""

_NO_MAP = OccupancyGrid(cells=np.empty((0, 0), np.int8), resolution_m=1.0, origin_m=(0.0, 0.0))
"""Of an answer in a history, of which there may be thousands."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(T_map_base=(np.float64, 4, 4), covariance=(np.float64, 6, 6))
class PoseInSpace:
    """A pose of the base with six degrees of freedom, and how well it agrees with the map.

    status : agrees, contradicts, or unsure between the two.
    T_map_base : (4, 4) at the query's last scan. covariance : (6, 6) of x, y, z and of the rotation about the
        axes of the map, metres and radians. rmse_m : of the distances of points from surfaces.
    rays, on, through, before : see `SpatialFit`.
    """

    status: SpaceStatus
    T_map_base: F64
    covariance: F64
    rmse_m: float
    rays: int
    on: float
    through: float
    before: float

    @property
    def rpy_rad(self) -> tuple[float, float, float]:
        """Return roll, pitch and yaw, radians (REP-103: about the fixed axes x, y, z in this order)."""
        R = self.T_map_base[:3, :3]
        pitch = math.asin(float(np.clip(-R[2, 0], -1.0, 1.0)))
        return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])

    def to_json(self) -> dict[str, Any]:
        """Return the pose as plain types."""
        x, y, z = self.T_map_base[:3, 3].tolist()
        roll, pitch, yaw = self.rpy_rad
        return {
            "status": self.status,
            "x": x,
            "y": y,
            "z": z,
            "roll": roll,
            "pitch": pitch,
            "yaw": yaw,
            "covariance": self.covariance.tolist(),
            "rmse_m": self.rmse_m,
            "rays": self.rays,
            "on": self.on,
            "through": self.through,
            "before": self.before,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A place that the robot may be at.

    fits : where it lies in the maps that show it, one a session, the best first; each `covariance` is that of
    the base now. mass : probability of it.
    seen_m, T_odom_seen, seen : of a place to which odometry has carried the robot: metres driven, the base,
    and the covariances of the fits (3, 3), where the maps showed the place last.
    beside : the same place where odometry has carried the robot, of what the map hardly shows; its mass is a
    part of this one's.
    """

    fits: tuple[Fit, ...]
    mass: float
    seen_m: float = 0.0
    T_odom_seen: SE2 = field(default_factory=SE2)
    seen: tuple[F64, ...] = ()
    beside: Place | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Where the query was.

    status : located, ambiguous (several places fit) or not_found (none does).
    places : all that fit, the likeliest first, with their masses, see `signature.localization.posterior`.
    off_map : further places, of which the map shows too little to tell; odometry has carried the robot there
    from places that it shows. The likeliest first; their masses are parts of the same probability.
    history : the answers so far, this one last: the best place of each (`moment`).
    local_map : what the query has seen, in its odom frame: what the hypotheses were compared with. views_m :
    where it was described by signatures, in that frame. map : of the session of the best hypothesis.
    sessions, labels : all of the database, that `Fit.session_index` counts. part : of the query, see
    `signature.places.query.QueryMap`.
    prior : what became of the prior, None if there was none. Not used: "lapsed", registration was lost after
    the time that it is about; "ahead", its time lies after the last scan. excluded : the best place that the
    prior excludes, if nothing that it allows is certain and this fits better.
    frames : for each session the frame of its building that poses are in, None: in its map frame; empty: all
    are in the map frames of their sessions (`signature.localization.answer`).
    in_space : the pose with six degrees of freedom, and whether the points agree; None if either side has
    none. Of a place that was turned down because they contradict it, the pose there.
    state : of a robot that is followed, what this answer says beside those before (`Localizer.add`); None: it
    was asked once. T_odometry_base : the base at the last scan in the frame of the robot's own odometry, if
    it has any. elapsed_s : time of the search.

    `pc2grid.relocalize` returns a `Found`, which can be drawn, too.

    >>> import pc2grid
    >>> answer = pc2grid.relocalize("tuesday.mcap", "building.submaps")
    >>> answer.status, answer.session, answer.confidence > 0.9
    ('located', 'monday', True)
    >>> figure = answer.plot()
    >>> answer.report("answer.html")
    >>> answer.save("answer.json")
    """

    status: Status
    places: tuple[Place, ...]
    stamp_ns: int
    path_m: float
    T_odom_base: SE2
    local_map: OccupancyGrid
    sessions: tuple[str, ...]
    labels: tuple[Label, ...]
    part: int = 0
    history: tuple[Answer, ...] = ()
    timing_ms: dict[str, float] = field(default_factory=dict)
    prior: Literal["used", "lapsed", "ahead"] | None = None
    excluded: Answer | None = None
    in_space: PoseInSpace | None = None
    views_m: tuple[tuple[float, float], ...] = ()
    map: OccupancyGrid | None = None
    frames: tuple[str | None, ...] = ()
    off_map: tuple[Place, ...] = ()
    state: State | None = None
    T_odometry_base: SE2 | None = None
    elapsed_s: float = 0.0

    def __repr__(self) -> str:
        sure = f"confidence {probability(self.confidence)}, after {self.path_m:.1f} m"
        if self.T_map_base is None:
            places = len(self.places)
            return f"Answer({self.status}, {places} {'place' if places == 1 else 'places'}, {sure})"
        return f"Answer(located in {short(self.session)} at {pose_text(self.T_map_base)}, {sure})"

    def _repr_html_(self) -> str:
        located = self.T_map_base is not None
        rows = [
            (
                number,
                self.sessions[fit.session_index],
                pose_text(fit.T_map_query @ self.T_odom_base),
                f"{fit.score:.2f}",
                "the answer" if located and row == 0 else "",
            )
            for row, (number, fit) in enumerate(self.numbered)
        ]
        status = self.status.replace("_", " ")
        title = f"{status}, confidence {probability(self.confidence)}, after {self.path_m:.1f} m"
        table = html_table(title, rows, ("place", "session", "pose of the robot", "score", ""))
        picture = self._repr_png_()
        return table if picture is None else table + html_picture(picture, "the query's walls in the map")

    def _repr_png_(self) -> bytes | None:
        """Return the map, with the walls of the query at the best hypothesis; None without one."""
        if self.map is None or self.best is None:
            return None
        walls_m = self.local_map.to_point(np.argwhere(self.local_map.occupied))
        there_m = self.best.T_map_query.apply(walls_m)
        return map_png(self.map.cells, self.map.resolution_m, self.map.origin_m, centers_m=there_m)

    @property
    def confidence(self) -> float:
        """Return the mass of the first place."""
        return self.places[0].mass if self.places else 0.0

    @property
    def mass(self) -> float:
        """Return the probability that it is at one of the places."""
        return sum(place.mass for place in self.places)

    @property
    def numbered(self) -> list[tuple[int, Fit]]:
        """Return all fits with the numbers of their places, from 0 on."""
        return [(number, fit) for number, place in enumerate(self.places) for fit in place.fits]

    @property
    def hypotheses(self) -> tuple[Fit, ...]:
        """Return the fits of all places, the likeliest place first."""
        return tuple(fit for place in self.places for fit in place.fits)

    @property
    def best(self) -> Fit | None:
        """Return the first fit of the likeliest place; None: nothing fits."""
        return self.places[0].fits[0] if self.places else None

    @property
    def pose(self) -> SE2 | None:
        """Return the base at the query's last scan by the best fit, certain or not; None: nothing fits."""
        return None if self.best is None else self.best.T_map_query @ self.T_odom_base

    @property
    def best_session(self) -> str | None:
        """Return the session that the best fit is in, certain or not; None: nothing fits."""
        return None if self.best is None else self.sessions[self.best.session_index]

    @property
    def located(self) -> Fit | None:
        """Return the fit that is the answer; None unless one place is certain."""
        return self.best if self.status == "located" else None

    @property
    def session(self) -> str | None:
        """Return the session whose map frame the pose is in; None unless located."""
        return self.best_session if self.located else None

    @property
    def T_map_odom(self) -> SE2 | None:
        """Return what puts the whole query trajectory into the map; None unless located."""
        return None if self.located is None else self.located.T_map_query

    @property
    def T_map_base(self) -> SE2 | None:
        """Return the base at the query's last scan; None unless located."""
        return self.pose if self.located else None

    @property
    def T_map_odometry(self) -> SE2 | None:
        """Return the frame of the robot's own odometry in the map; None unless located, or without any."""
        if self.T_map_base is None or self.T_odometry_base is None:
            return None
        return self.T_map_base @ self.T_odometry_base.inverse()

    @property
    def is_told(self) -> bool:
        """Return whether the place is certain enough to be sent to a robot."""
        return self.state in ("located", "recovered")

    @property
    def covariance(self) -> F64 | None:
        """Return that of the pose, (3, 3) of x, y, yaw; None unless located."""
        return None if self.located is None else self.located.covariance

    @property
    def moment(self) -> Answer:
        """Return the answer for the history of those after it: the best fit alone, without any map, and with
        the base itself as the frame of the query."""
        places = tuple(
            replace(
                place,
                fits=tuple(
                    replace(fit, T_map_query=fit.T_map_query @ self.T_odom_base) for fit in place.fits[:1]
                ),
            )
            for place in self.places[:1]
        )
        return replace(
            self,
            places=places,
            T_odom_base=SE2(),
            local_map=_NO_MAP,
            map=None,
            views_m=(),
            off_map=(),
            in_space=None,
            history=(),
            excluded=None,
        )

    @property
    def beside_map(self) -> Place | None:
        """Return where the robot is, beside the map, if that is more likely than all else together."""
        return next((away for away in self.off_map if away.mass >= LIKELY), None)

    @property
    def line(self) -> AmbiguousLine | None:
        """Return the line on which an ambiguous base is likely to be; None: there is none."""
        if self.status != "ambiguous" or not self.places:
            return None
        first = self.places[0].fits[0].session_index
        here = [place for place in self.places if place.fits[0].session_index == first]
        bases = [place.fits[0].T_map_query @ self.T_odom_base for place in here]
        return ambiguous_line(bases, [place.mass for place in here])

    @property
    def label(self) -> Label:
        """Return building and floor of the session it was located in, as far as they are known."""
        return Label() if self.located is None else self.labels[self.located.session_index]

    def frame_of(self, hypothesis: Fit) -> str | None:
        """Return the frame of the building that a hypothesis is in; None: the map frame of its session."""
        return self.frames[hypothesis.session_index] if self.frames else None

    @property
    def frame(self) -> str | None:
        """Return the frame of the building that the pose is in; None: the map frame of the session."""
        return None if self.located is None else self.frame_of(self.located)

    @property
    def stamped_pose(self) -> dict[str, Any] | None:
        """Return the pose of the base as plain types; None unless it is located."""
        if self.T_map_base is None or self.covariance is None:
            return None
        pose = _planar(self.T_map_base)
        return {"stamp_ns": self.stamp_ns, **pose, "covariance": self.covariance.tolist()}

    @property
    def off_map_pose(self) -> dict[str, Any] | None:
        """Return where the base is beside the map, as plain types; None if it is not most likely there."""
        away = self.beside_map
        if away is None:
            return None
        (h,) = away.fits
        return {
            "session": self.sessions[h.session_index],
            "frame": self.frame_of(h),
            **_planar(h.T_map_query @ self.T_odom_base),
            "covariance": h.covariance.tolist(),
            "probability": away.mass,
        }

    def to_json(self) -> dict[str, Any]:
        """Return the answer as plain types: most of what `pc2grid relocalize --json` prints."""
        about = {
            "status": self.status,
            "session": self.session,
            "frame": self.frame,
            "building": self.label.building,
            "floor": self.label.floor,
            "pose": self.stamped_pose,
            "T_map_odom": self.T_map_odom,
            "confidence": self.confidence,
            "hypotheses": [
                {
                    "session": self.sessions[h.session_index],
                    "frame": self.frame_of(h),
                    "building": self.labels[h.session_index].building,
                    "floor": self.labels[h.session_index].floor,
                    "submap_id": h.submap_id if h.submap_id >= 0 else None,
                    "place": number,
                    **_planar(h.T_map_query @ self.T_odom_base),
                    "score": h.score,
                    "overlap": h.overlap,
                }
                for number, h in self.numbered
            ],
            "history": [_moment_json(answer) for answer in self.history],
            "line": self.line,
            "off_map": self.off_map_pose,
            "prior": self.prior
            and {"status": self.prior, "excluded": self.excluded and _moment_json(self.excluded)},
            "in_space": self.in_space and self.in_space.to_json(),
            "query": {"path_m": self.path_m, "stamp_ns": self.stamp_ns},
            "database": {"sessions": list(self.sessions)},
            "timing_ms": self.timing_ms,
        }
        return plain(about)


AnswerT = TypeVar("AnswerT", bound=Answer)


def pose_text(pose: SE2) -> str:
    """Return a pose as a person reads it."""
    return f"x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {math.degrees(pose.yaw):.1f} deg"


def _planar(pose: SE2) -> dict[str, float]:
    return {"x": pose.x, "y": pose.y, "yaw": pose.yaw}


def _moment_json(answer: Answer) -> dict[str, Any]:
    """Return an `Answer.moment` as plain types."""
    return {
        "stamp_ns": answer.stamp_ns,
        "path_m": answer.path_m,
        "status": answer.status,
        "session": answer.best_session,
        **(_planar(answer.pose) if answer.pose else dict.fromkeys(("x", "y", "yaw"))),
        "confidence": answer.confidence,
    }


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a map, metres."""

    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class AmbiguousLine:
    """Likely places that lie on one line, all with one heading.

    begin, end : the places at its ends, in the frame of the best hypothesis. probability : that the base is
    at one of these places.
    """

    begin: Point
    end: Point
    yaw_rad: Annotated[float, Field(serialization_alias="yaw")]
    length_m: float
    probability: float


def ambiguous_line(bases: Sequence[SE2], masses: Sequence[float]) -> AmbiguousLine | None:
    """Return the line through the best place that most of the mass lies on, with the heading of that place.

    bases : the base at each place of one frame, best first. masses : of each. None if no other place has this
    heading, or if it is not likely that the base is at one of them.
    """
    lines = (_through(bases, masses, other) for other in range(1, len(bases)))
    likely = [line for line in lines if line is not None and line.probability >= LIKELY]
    return max(likely, key=lambda line: line.probability, default=None)


def _through(bases: Sequence[SE2], masses: Sequence[float], other: int) -> AmbiguousLine | None:
    """Return the line through the best place and another one; None if their headings differ."""
    poses = np.array([(base.x, base.y, base.yaw) for base in bases])
    away_m, turned = poses[:, :2] - poses[0, :2], np.abs(wrap_angle(poses[:, 2] - poses[0, 2]))
    length_m = math.hypot(*away_m[other])
    if turned[other] >= HYPOTHESES.around_rad or not length_m:
        return None
    along = away_m[other] / length_m
    across_m = np.abs(away_m @ np.array((-along[1], along[0])))
    on_line = np.flatnonzero((turned < HYPOTHESES.around_rad) & (across_m < HYPOTHESES.around_m))
    at_m = away_m[on_line] @ along
    ends = on_line[[at_m.argmin(), at_m.argmax()]]
    begin, end = (Point(*xy) for xy in poses[ends, :2].tolist())
    return AmbiguousLine(
        begin=begin,
        end=end,
        yaw_rad=bases[0].yaw,
        length_m=math.dist(poses[ends[0], :2], poses[ends[1], :2]),
        probability=float(np.asarray(masses)[on_line].sum()),
    )


_APART = BuildingFrame(name="", T_building_session=SE2(), covariance=((0.0,) * 3,) * 3)
"""Of a session that is not joined: its poses stay as they are."""


def answer_in_building(answer: AnswerT, frames: Mapping[str, BuildingFrame]) -> AnswerT:
    """Return an answer with all poses in the frames of the buildings, where their sessions have one.

    frames : of sessions that were joined, by name (`SubmapDatabase.frames`). Covariances contain how exactly
    the session is known to lie in its building.
    """
    frame_of = [frames.get(name, _APART) for name in answer.sessions]

    def placed(fit: Fit) -> Fit:
        frame, T_map_base = frame_of[fit.session_index], fit.T_map_query @ answer.T_odom_base
        return replace(
            fit,
            T_map_query=frame.at(T_map_base.x, T_map_base.y) @ fit.T_map_query,
            covariance=covariance_in_building(fit.covariance, T_map_base, frame),
        )

    stated = replace(
        answer,
        places=fits_changed(answer.places, placed),
        off_map=fits_changed(answer.off_map, placed),
        history=tuple(answer_in_building(moment, frames) for moment in answer.history),
        excluded=answer.excluded and answer_in_building(answer.excluded, frames),
        frames=tuple(frame.name or None for frame in frame_of),
    )
    if stated.located is None or answer.in_space is None:
        return stated
    return replace(stated, in_space=_in_space(answer.in_space, frame_of[stated.located.session_index]))


def fits_changed(places: Iterable[Place], change: Callable[[Fit], Fit]) -> tuple[Place, ...]:
    """Return the places with each of their fits changed."""
    return tuple(replace(place, fits=tuple(map(change, place.fits))) for place in places)


def covariance_in_building(covariance: F64, T_session_base: SE2, frame: BuildingFrame) -> F64:
    """Return the covariance (3, 3) of a pose in a session's map as one in its building.

    It is turned, and contains that of the session's own place, whose heading moves the pose the more the
    farther it is from the session's origin.
    """
    there = frame.placed(T_session_base)
    turn = SE2(0.0, 0.0, there.yaw - T_session_base.yaw).matrix()
    J = lever_arm(frame.T_building_session, there)
    return np.asarray(turn @ covariance @ turn.T + J @ np.array(frame.covariance) @ J.T)


def _in_space(pose: PoseInSpace, frame: BuildingFrame) -> PoseInSpace:
    T_map_base = SE2.from_matrix(pose.T_map_base)
    T = frame.at(T_map_base.x, T_map_base.y).lift()
    turn = np.kron(np.eye(2), T[:3, :3])
    covariance = turn @ pose.covariance @ turn.T
    planar = np.ix_((0, 1, 5), (0, 1, 5))
    nothing = np.zeros((3, 3))
    covariance[planar] += covariance_in_building(nothing, T_map_base, frame)
    return replace(pose, T_map_base=T @ pose.T_map_base, covariance=covariance)


def corrected_path(poses: Trajectory, answer: Answer) -> Trajectory:
    """Return the query's poses (odometry frame of its last scan), corrected where it was located on the way.

    Between two located moments the correction is interpolated along the travel, in position and heading of
    the base; before the first one it is that of the first. Where registration was lost the motion is not
    known, so nothing is interpolated across. A moment counts if the one before or after it agrees with it, by
    the motion between them.

    Without an answer: as they are.
    """
    if answer.T_map_odom is None:
        return poses
    planar = poses.planar()
    travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(planar[:, :2], axis=0).T))))
    # Scans of a standing robot get increasing values, too.
    travel_m += 1e-9 * np.arange(len(travel_m))
    health = poses.health or (Health.FINE,) * len(poses)
    part = np.cumsum([h is Health.LOST for h in health])
    at, moments = _located_moments(poses, travel_m, part, answer)
    T_odom_map = answer.T_map_odom.inverse()
    corrections = [T_odom_map @ pose @ SE2(*planar[k]).inverse() for k, pose in zip(at, moments, strict=True)]
    turns = np.unwrap([T.yaw for T in corrections])
    moved = np.array([T.apply(planar[:, :2]) for T in corrections])
    corrected = poses.T_session_base.copy()
    for number in np.unique(part):
        here = np.flatnonzero(part == number)
        own = np.flatnonzero(part[at] == number)
        if not len(own):
            own = np.abs(at - here.mean()).argmin(keepdims=True)
        # How much each of the moments counts at each of the scans: between two of them, both.
        shares = [np.interp(travel_m[here], travel_m[at[own]], one) for one in np.eye(len(own))]
        for k, share in zip(here, np.transpose(shares), strict=True):
            height_m = corrected[k, 2, 3]
            corrected[k] = SE2(0.0, 0.0, share @ turns[own]).lift() @ corrected[k]
            corrected[k, :3, 3] = *(share @ moved[own, k]), height_m
    return replace(poses, T_session_base=corrected)


def _located_moments(poses: Trajectory, travel_m: F64, part: I64, answer: Answer) -> tuple[I64, list[SE2]]:
    """Return the scans at which the query was located in the session of the answer, and the bases there."""
    planar = poses.planar()
    found = [
        (int(np.searchsorted(poses.stamps_ns, moment.stamp_ns)), moment.pose)
        for moment in answer.history
        if moment.status == "located" and moment.session == answer.session and moment.pose is not None
    ]

    def agree(a: tuple[int, SE2], b: tuple[int, SE2]) -> bool:
        if part[a[0]] != part[b[0]]:
            return False
        expected = a[1] @ SE2(*planar[a[0]]).inverse() @ SE2(*planar[b[0]])
        return is_inside(expected, b[1], SAME + drifted(travel_m[b[0]] - travel_m[a[0]]))

    agrees = [agree(a, b) for a, b in itertools.pairwise(found)]
    kept = [
        here
        for here, before, after in zip(found, [False, *agrees], [*agrees, True], strict=True)
        if before or after  # the last one is the answer
    ]
    return np.array([k for k, _ in kept], np.int64), [pose for _, pose in kept]
