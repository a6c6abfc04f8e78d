"""A real recording against itself: one part becomes the map, later parts are located in it.

The truth is a trajectory that somebody else computed over the whole recording. It need not cover every
scan; a query is judged by the last of its scans that it does cover.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.model import Scan, Trajectory
from pc2grid.pipeline import build_map
from signature.build import describe_all
from signature.config import Config
from signature.evaluation.driven import Driven, register
from signature.evaluation.mapped import Mapped
from signature.evaluation.trial import MAPPED, Trial, judge
from signature.relocalize import Building, Relocalizer
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from pc2grid.io import Log

RIGHT_M = 0.3
"""The truth itself, a filter's map, is no better than a few centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of a recording, seconds from its start."""

    start_s: float
    length_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """What became of the queries.

    inside : how many look at ground that the map covers, by the truth; only these have a right answer.
    right, wrong : of those, located and right; located and wrong. unsure : neither located.
    outside : the rest. refused : of those, not located, as it should be.
    wrong_outside : of those, located all the same, and wrong.
    """

    inside: int
    right: int
    wrong: int
    unsure: int
    outside: int
    refused: int
    wrong_outside: int

    @staticmethod
    def of(trials: Sequence[Trial]) -> Tally:
        """Count; a query outside the map that is located rightly (at its edge) is neither gain nor loss."""
        inside = [t for t in trials if t.mapped >= MAPPED]
        outside = [t for t in trials if t.mapped < MAPPED]
        return Tally(
            inside=len(inside),
            right=sum(t.status == "located" and t.right for t in inside),
            wrong=sum(t.status == "located" and not t.right for t in inside),
            unsure=sum(t.status != "located" for t in inside),
            outside=len(outside),
            refused=sum(t.status != "located" for t in outside),
            wrong_outside=sum(t.status == "located" and not t.right for t in outside),
        )


def spread(first_s: float, last_s: float, count: int, length_s: float) -> tuple[Part, ...]:
    """`count` parts of `length_s`, evenly over the time from `first_s` to `last_s`."""
    starts = np.linspace(first_s, max(last_s - length_s, first_s), count)
    return tuple(Part(start_s=float(s), length_s=length_s) for s in starts)


class Replay:
    """A recording with its truth, ready to be cut.

    truth : poses of the sensor, as ground truths of lasers are, or of the base with `of_base`.
    """

    def __init__(self, log: Log, truth: Trajectory, config: Config, *, of_base: bool = False) -> None:
        self._log, self._config = log, config
        self.name, self.sensor = log.info.path.stem, log.choose().sensor
        mount = SE2() if of_base else SE2.flatten(next(iter(log.scans())).T_base_sensor)
        self._stamps_ns = truth.stamps_ns
        self._T_world_base = [pose @ mount.inverse() for pose in truth.poses()]

    def truth(self, stamp_ns: int) -> SE2 | None:
        """T_world_base of the scan of that stamp, None if nobody knows."""
        i = int(np.searchsorted(self._stamps_ns, stamp_ns - _SAME_NS))
        if i == len(self._stamps_ns) or self._stamps_ns[i] > stamp_ns + _SAME_NS:
            return None
        return self._T_world_base[i]

    def map(self, part: Part, progress: Callable[[float], None] | None = None) -> Mapped:
        """One part as a building. Raises ConfigError if the truth covers less than two of its scans."""
        made = build_map(
            self._log,
            self._config,
            session=self.name,
            start_s=part.start_s,
            duration_s=part.length_s,
            progress=progress,
        )
        here = list(zip(made.trajectory.poses(), map(self.truth, made.trajectory.stamps_ns), strict=True))
        pairs = [(a, b) for a, b in here if b is not None]
        if len(pairs) < 2:
            raise ConfigError(
                f"{self.name}: the truth has no poses at the stamps of the part that becomes the map",
                hint="its stamps must be those of the scans",
            )
        table = SignatureTable.of(describe_all(made, self._config), [s.center_m for s in made.submaps])
        return Mapped(
            name=self.name,
            sensor=self.sensor,
            T_plan_map=SE2.fit([(a.x, a.y) for a, _ in pairs], [(b.x, b.y) for _, b in pairs]),
            building=Building({self.name: made.grid}, table, self._config, self._config),
        )

    def drive(self, part: Part) -> Driven:
        """One part, registered as a query."""

        def scans() -> Iterator[tuple[Scan, SE2 | None]]:
            for scan in self._log.scans(part.start_s, part.length_s):
                yield scan, self.truth(scan.stamp_ns)

        return register(scans(), self._config, sensor=self.sensor)

    def locate(self, part: Part, mapped: Mapped) -> Trial | None:
        """The answer for one part beside the truth; None if the truth says nothing of it."""
        driven = self.drive(part)
        if np.isnan(driven.T_world_base[:, 0]).all():
            return None
        relocalizer = Relocalizer(mapped.building)
        for registered, sweep, _ in driven.scans():
            relocalizer.add(registered, sweep)
        begin = time.perf_counter()
        query = relocalizer.query()
        answer = relocalizer.searches[0].answer(query)
        return judge(
            mapped,
            query,
            answer,
            driven.T_world_odom() @ answer.T_odom_base,
            building=self.name,
            query_sensor=self.sensor,
            seed=round(part.start_s),
            travel_m=answer.path_m,
            look_up_ms=1000.0 * (time.perf_counter() - begin),
            right_m=RIGHT_M,
        )


_SAME_NS = 1_000_000
