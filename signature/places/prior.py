"""What is known of the pose of a robot beforehand: a region of a map.

It excludes: a place outside has probability 0 and is no answer. Between places that fit equally well it
decides. But what scores differently outside still shows what wrong places score for this query, so it remains
evidence (`signature.localization.posterior`): a place that fits poorly is not certain because few others are
in the region, and if another place fits better by far, nothing inside is. That place is reported
(`Answer.excluded`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from pc2grid.errors import ConfigError
from pc2grid.geometry import F64, SE2
from signature.places.hypotheses import HYPOTHESES, SAME, SIGMAS, is_inside
from signature.places.query import QueryMap


@dataclass(frozen=True, slots=True, kw_only=True)
class PriorParameters:
    """How a covariance becomes a region, and how the region grows with travel.

    A region is at least as wide on each side as the distance within which two poses are one place. A smaller
    one would exclude right places that are drawn a little off.

    drift, drift_rad_m : a region for an earlier time grows by this share of the way since, and turns by this
        much a metre. Tracking without loops is off, in four real logs with true poses, by at most 2.9 % of
        50 m and 2.0 % of 200 m, and by 0.07 and 0.03 degrees a metre.
    """

    drift: float = 0.03
    drift_rad_m: float = math.radians(0.3)


PRIOR = PriorParameters()


def drifted(way_m: float) -> F64:
    """Return the (3, 3) region of x, y, yaw that odometry adds over a way."""
    return np.diag(np.square((PRIOR.drift, PRIOR.drift, PRIOR.drift_rad_m))) * way_m**2


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """The base is in an ellipse around (x, y) of the map frame of a session, with a heading near `yaw`.

    T_map_base : the centre of the region. shape : (3, 3), see `is_inside`.
    stamp_ns : when; of the scans of a query the nearest one is meant. From then on the region is carried by
    the motion; before, it says nothing. None: the newest scan when `Localizer.answer` is asked.
    session : whose map frame; None if there is only one session.

    >>> near = Prior.around(3.0, 4.0, radius_m=2.0)
    >>> near.allows(SE2(4.0, 5.0, 3.0)), near.allows(SE2(6.0, 4.0, 0.0))
    (True, False)
    """

    T_map_base: SE2
    shape: F64
    stamp_ns: int | None = None
    session: str | None = None

    @staticmethod
    def around(
        x_m: float,
        y_m: float,
        radius_m: float,
        *,
        yaw_rad: float = 0.0,
        half_yaw_rad: float = math.pi,
        session: str | None = None,
    ) -> Prior:
        """Return a disc, with any heading unless `half_yaw_rad` limits it.

        Raises ConfigError for numbers that are not finite or a radius that is not positive.
        """
        if not all(map(math.isfinite, (x_m, y_m, yaw_rad))) or not 0.0 < radius_m < math.inf:
            raise ConfigError(
                f"near: expected x and y in metres and a radius > 0, found {x_m:g} {y_m:g} {radius_m:g}"
            )
        radius_m = max(radius_m, HYPOTHESES.around_m)
        shape = np.diag(np.square((radius_m, radius_m, half_yaw_rad)))
        return Prior(T_map_base=SE2(x_m, y_m, yaw_rad), shape=shape, session=session)

    @staticmethod
    def of_pose(
        T_map_base: SE2, covariance: ArrayLike, *, stamp_ns: int | None = None, session: str | None = None
    ) -> Prior:
        """Return the 99 % region of a pose with a covariance (3, 3) of x, y, yaw; m^2, m rad, rad^2.

        Raises ConfigError for a covariance of zeros, which says nothing, and for one that is none.
        """
        full = np.asarray(covariance, np.float64)
        full = 0.5 * (full + full.T)
        position = full[:2, :2]
        pose = (T_map_base.x, T_map_base.y, T_map_base.yaw)
        if not np.isfinite(full).all() or not np.isfinite(pose).all():
            raise ConfigError("near: the pose or its covariance is not finite")
        if not position.any() or np.linalg.eigvalsh(position)[0] < 0.0 or full[2, 2] < 0.0:
            raise ConfigError(
                "near: the covariance of the pose is zero or not a covariance, so it names no region",
                hint="--near X Y RADIUS names one",
            )
        # Added, not a lower bound of the axes, so that the shape of the ellipse stays.
        shape = SIGMAS**2 * full + SAME
        if not full[2, 2]:  # beside a position that is uncertain: the heading is not known
            shape[2, 2] = math.pi**2
        return Prior(T_map_base=T_map_base, shape=shape, stamp_ns=stamp_ns, session=session)

    @property
    def radius_m(self) -> float:
        """Return the distance of the farthest position in the region from its centre."""
        return math.sqrt(float(np.linalg.eigvalsh(self.shape[:2, :2])[1]))

    def allows(self, T_map_base: SE2, since_m: float = 0.0) -> bool:
        """Return whether the base can be there. since_m : way driven since `stamp_ns`, by which the region
        grows."""
        return is_inside(T_map_base, self.T_map_base, self.shape + drifted(since_m))

    def of_one(self, sessions: Sequence[str]) -> Prior:
        """Return the prior with the name of its session. Raises ConfigError if it does not name one where
        there are several, or names an unknown one."""
        names = ", ".join(sessions[:12]) + (", ..." if len(sessions) > 12 else "")
        if self.session is None and len(sessions) > 1:
            raise ConfigError(
                f"near: the database holds {len(sessions)} sessions, each with a map frame of its own",
                hint=f"--session NAME says whose frame is meant: {names}",
            )
        if self.session is not None and self.session not in sessions:
            raise ConfigError(
                f"near: no session {self.session!r} where it is looked for", hint=f"there is: {names}"
            )
        return replace(self, session=self.session or next(iter(sessions), None))

    def is_ahead(self, query: QueryMap) -> bool:
        """Return whether the query ends before the time that the prior is about."""
        return self.stamp_ns is not None and query.stamp_ns < self.stamp_ns

    def T_odom_prior(self, query: QueryMap) -> SE2 | None:
        """Return the base at the time that the prior is about; None before, and if the motion since is not
        known."""
        if self.stamp_ns is None:
            return query.T_odom_base
        return None if self.is_ahead(query) else query.T_odom_prior

    def squares(self, query: QueryMap, free_m: F64, side_m: float) -> F64:
        """Return those of the squares of `side_m` around (K, 2) that may hold the base now, whatever its
        heading was. The motion since the time of the prior must be known."""
        T_odom_prior = self.T_odom_prior(query)
        assert T_odom_prior is not None
        step = T_odom_prior.inverse() @ query.T_odom_base
        reach_m = self.radius_m + math.hypot(step.x, step.y) + PRIOR.drift * query.since_prior_m
        center = (self.T_map_base.x, self.T_map_base.y)
        return np.asarray(free_m[np.hypot(*(free_m - center).T) <= reach_m + side_m * math.sqrt(0.5)])
