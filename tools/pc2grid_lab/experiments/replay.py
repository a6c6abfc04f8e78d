"""A real recording located in itself: one part becomes the map, later parts are the queries.

The truth is a trajectory that another program has computed over the whole recording. It need not contain
every scan: a query is judged by the last of its scans that have a true pose.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pc2grid.arrays import F64
from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.io import Log
from pc2grid.model import Scan, Trajectory
from pc2grid.observer import Observer
from pc2grid.pipeline import build_map
from pc2grid.time_span import TimeSpan
from pc2grid_lab.experiments.answers import localize
from pc2grid_lab.experiments.frames import number_at
from pc2grid_lab.experiments.judgement import judge
from pc2grid_lab.experiments.registered_session import RegisteredSession, register
from pc2grid_lab.experiments.sensor_map import SensorMap
from pc2grid_lab.experiments.trial import JUDGEMENT, Trial
from signature.config import Config
from signature.localization.map_index import MapIndex
from signature.localization.place_recognition import recognizer_for
from signature.sessions import describe_all
from signature.similarity import SignatureTable

_AROUND_M = 10.0
"""Scans of the map this near a query place it there: its walls were seen from them, and 2 cm of noise in
their true poses turn the frame by no more than 0.2 degrees. Chosen by hand."""
_LEAST_EXTENT_M = 2.0
"""Scans that span less do not show how a map is turned."""


@dataclass(frozen=True, slots=True)
class MappedPart:
    """The map of one part of a recording, and the true poses of its scans.

    sensor_map : with the frame that fits best over the whole part. mapped_xy, true_xy : (N, 2) positions of
        the scans in the map and in the world, of all that have a true pose. warnings : of the conversion.
    """

    sensor_map: SensorMap
    mapped_xy: F64
    true_xy: F64
    warnings: tuple[str, ...] = ()

    def around(self, T_world_base: SE2) -> SensorMap:
        """The map, with the frame that fits best around a true pose.

        A map can be bent: exact around each place, and off by a metre from one end to the other. Whether a
        robot is located in it is judged by the walls around; how far the map is bent is another question,
        see `bent_m`. Where no scan of the map is near, its frame is that of the whole.
        """
        away_m = np.hypot(*(self.true_xy - (T_world_base.x, T_world_base.y)).T)
        near = away_m < _AROUND_M
        if not near.any() or np.ptp(self.true_xy[near], axis=0).max() < _LEAST_EXTENT_M:
            return self.sensor_map
        return replace(self.sensor_map, T_plan_map=SE2.fit(self.mapped_xy[near], self.true_xy[near]))

    def bent_m(self, T_world_base: SE2) -> float:
        """How far the frame around a true pose puts it from where the frame of the whole does, metres."""
        T_map_base = self.around(T_world_base).T_plan_map.inverse() @ T_world_base
        apart = T_world_base.inverse() @ self.sensor_map.T_plan_map @ T_map_base
        return math.hypot(apart.x, apart.y)


def evenly_spaced(first_s: float, last_s: float, count: int, duration_s: float) -> tuple[TimeSpan, ...]:
    """`count` parts of `duration_s`, evenly distributed over the time from `first_s` to `last_s`."""
    starts_s = np.linspace(first_s, max(last_s - duration_s, first_s), count)
    return tuple(TimeSpan(float(start_s), duration_s) for start_s in starts_s)


def with_z_up(truth: Trajectory, T_base_sensor: F64) -> tuple[Trajectory, str]:
    """True poses in a world whose z is vertical, and the axis that pointed up before: `z` if none was turned.

    Only x, y and the heading of true poses are used, and phones, motion capture and cameras record them in
    worlds whose y is vertical. The base is level most of the time: its z, on average, is near the vertical.

    truth : poses T_world_sensor.
    """
    up = (truth.T_session_base[:, :3, :3] @ T_base_sensor[2, :3]).mean(axis=0)
    axis = int(np.argmax(np.abs(up)))
    if axis == 2:
        return truth, "z"
    downward = bool(up[axis] < 0)
    quarter = -90.0 if (axis == 0) != downward else 90.0
    T_turned_world = np.eye(4)
    T_turned_world[:3, :3] = Rotation.from_euler("yx"[axis], quarter, degrees=True).as_matrix()
    turned = replace(truth, T_session_base=T_turned_world @ truth.T_session_base)
    return turned, f"{'-' if downward else ''}{'xy'[axis]}"


class Replay:
    """A recording with its true poses, of which parts are mapped and located."""

    def __init__(self, log: Log, truth: Trajectory, config: Config, *, of_base: bool = False) -> None:
        """truth : poses of the sensor, as ground truths of lasers are; with `of_base` poses of the base.

        up : the axis of their world that points up; if it is not z, they are turned.
        """
        self._log, self._config = log, config
        self.name, self.sensor = log.info.path.stem, log.choose().sensor
        T_base_sensor = np.eye(4) if of_base else next(iter(log.scans())).T_base_sensor
        truth, self.up = with_z_up(truth, T_base_sensor)
        self._stamps_ns = truth.stamps_ns
        T_sensor_base = SE2.from_matrix(T_base_sensor).inverse()
        self._T_world_base = [pose @ T_sensor_base for pose in truth.poses()]

    def truth(self, stamp_ns: int) -> SE2 | None:
        """True pose T_world_base of the scan with that stamp; None if it is not known."""
        i = number_at(self._stamps_ns, stamp_ns)
        return None if i is None else self._T_world_base[i]

    def map(self, span: TimeSpan, observer: Observer = Observer()) -> MappedPart:
        """The map made of one part. Raises ConfigError if fewer than two of its scans have a true pose."""
        made = build_map(
            self._log,
            self._config,
            session=self.name,
            span=span,
            observer=observer,
            recognizer=recognizer_for(self._config),
        )
        table = SignatureTable.of(describe_all(made, self._config), [s.center_m for s in made.submaps])
        mapped_xy, true_xy = self._pairs(made.trajectory)
        sensor_map = SensorMap(
            name=self.name,
            sensor=self.sensor,
            T_plan_map=SE2.fit(mapped_xy, true_xy),
            index=MapIndex({self.name: made.grid}, table, self._config, self._config),
        )
        return MappedPart(sensor_map, mapped_xy, true_xy, made.report.warnings)

    def _pairs(self, trajectory: Trajectory) -> tuple[F64, F64]:
        """Positions (N, 2) of the scans of a trajectory that have a true pose, in it and in the world.

        Raises ConfigError if they are fewer than two.
        """
        truths = map(self.truth, trajectory.stamps_ns)
        pairs = [(a, b) for a, b in zip(trajectory.poses(), truths, strict=True) if b is not None]
        if len(pairs) < 2:
            raise ConfigError(
                f"{self.name}: the truth has no poses at the stamps of the part that becomes the map",
                hint="its stamps must be those of the scans",
            )
        return np.array([(a.x, a.y) for a, _ in pairs]), np.array([(b.x, b.y) for _, b in pairs])

    def register(self, span: TimeSpan) -> RegisteredSession:
        """One part, registered as a query."""

        def scans() -> Iterator[tuple[Scan, SE2 | None]]:
            for scan in self._log.scans(span.start_s, span.duration_s):
                yield scan, self.truth(scan.stamp_ns)

        return register(scans(), self._config, sensor=self.sensor)

    def locate(self, span: TimeSpan, part: MappedPart) -> Trial | None:
        """The judged answer for one part, by the map around its end; None if no scan has a true pose."""
        session = self.register(span)
        if np.isnan(session.T_world_base[:, 0]).all():
            return None
        scans = ((registered, planar_scan) for registered, planar_scan, _ in session.scans())
        (found,) = localize(scans, [part.sensor_map.index])
        (answer,) = found.answers
        T_world_base = session.T_world_odom() @ answer.T_odom_base
        trial = judge(
            part.around(T_world_base),
            found.query,
            answer,
            T_world_base,
            building=self.name,
            query_sensor=self.sensor,
            seed=round(span.start_s),
            travel_m=answer.path_m,
            look_up_ms=found.elapsed_ms[0],
            right_m=JUDGEMENT.right_recorded_m,
        )
        return replace(trial, map_bent_m=part.bent_m(T_world_base))
