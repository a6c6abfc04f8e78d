"""A real recording located in itself: one part becomes the map, later parts are the queries.

The truth is a trajectory that another program has computed over the whole recording. It need not contain
every scan: a query is judged by the last of its scans that have a true pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.model import Scan, Trajectory
from pc2grid.observer import Observer
from pc2grid.pipeline import build_map
from pc2grid.time_span import TimeSpan
from signature.config import Config
from signature.evaluation.judgement import judge
from signature.evaluation.registered_session import RegisteredSession, register
from signature.evaluation.sensor_map import SensorMap
from signature.evaluation.trial import JUDGEMENT, Trial
from signature.relocalization.place_recognition import recognizer_for
from signature.relocalization.relocalizer import MapIndex, localize
from signature.sessions import describe_all
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from pc2grid.io import Log

_SAME_NS = 1_000_000  # a true pose belongs to a scan if their stamps differ by no more than this


def spread(first_s: float, last_s: float, count: int, duration_s: float) -> tuple[TimeSpan, ...]:
    """`count` parts of `duration_s`, evenly distributed over the time from `first_s` to `last_s`."""
    starts_s = np.linspace(first_s, max(last_s - duration_s, first_s), count)
    return tuple(TimeSpan(float(start_s), duration_s) for start_s in starts_s)


class Replay:
    """A recording with its true poses, of which parts are mapped and located."""

    def __init__(self, log: Log, truth: Trajectory, config: Config, *, of_base: bool = False) -> None:
        """truth : poses of the sensor, as ground truths of lasers are; with `of_base` poses of the base."""
        self._log, self._config = log, config
        self.name, self.sensor = log.info.path.stem, log.choose().sensor
        T_base_sensor = SE2() if of_base else SE2.from_matrix(next(iter(log.scans())).T_base_sensor)
        self._stamps_ns = truth.stamps_ns
        self._T_world_base = [pose @ T_base_sensor.inverse() for pose in truth.poses()]

    def truth(self, stamp_ns: int) -> SE2 | None:
        """True pose T_world_base of the scan with that stamp; None if it is not known."""
        i = int(np.searchsorted(self._stamps_ns, stamp_ns - _SAME_NS))
        if i == len(self._stamps_ns) or self._stamps_ns[i] > stamp_ns + _SAME_NS:
            return None
        return self._T_world_base[i]

    def map(self, span: TimeSpan, observer: Observer = Observer()) -> SensorMap:
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
        return SensorMap(
            name=self.name,
            sensor=self.sensor,
            T_plan_map=self.T_world_map(made.trajectory),
            index=MapIndex({self.name: made.grid}, table, self._config, self._config),
        )

    def T_world_map(self, trajectory: Trajectory) -> SE2:
        """The frame of a map in the world of the true poses, fitted over the trajectory of the map.

        Raises ConfigError if fewer than two of its scans have a true pose.
        """
        truths = map(self.truth, trajectory.stamps_ns)
        pairs = [(a, b) for a, b in zip(trajectory.poses(), truths, strict=True) if b is not None]
        if len(pairs) < 2:
            raise ConfigError(
                f"{self.name}: the truth has no poses at the stamps of the part that becomes the map",
                hint="its stamps must be those of the scans",
            )
        return SE2.fit([(a.x, a.y) for a, _ in pairs], [(b.x, b.y) for _, b in pairs])

    def register(self, span: TimeSpan) -> RegisteredSession:
        """One part, registered as a query."""

        def scans() -> Iterator[tuple[Scan, SE2 | None]]:
            for scan in self._log.scans(span.start_s, span.duration_s):
                yield scan, self.truth(scan.stamp_ns)

        return register(scans(), self._config, sensor=self.sensor)

    def locate(self, span: TimeSpan, sensor_map: SensorMap) -> Trial | None:
        """The judged answer for one part; None if none of its scans has a true pose."""
        session = self.register(span)
        if np.isnan(session.T_world_base[:, 0]).all():
            return None
        scans = ((registered, planar_scan) for registered, planar_scan, _ in session.scans())
        (asked,) = localize(scans, [sensor_map.index])
        (answer,) = asked.answers
        return judge(
            sensor_map,
            asked.query,
            answer,
            session.T_world_odom() @ answer.T_odom_base,
            building=self.name,
            query_sensor=self.sensor,
            seed=round(span.start_s),
            travel_m=answer.path_m,
            look_up_ms=asked.elapsed_ms[0],
            right_m=JUDGEMENT.right_recorded_m,
        )
