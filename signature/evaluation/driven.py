"""A session as registration left it, with the truth beside it: all that locating and judging need.

Registering a session takes far longer than locating it. Kept like this it is registered once, however many
maps it is located in, and however often a method is tried on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2
from pc2grid.model import Health, OccupancyGrid, RegisteredScan, Scan, SensorKind
from pc2grid.pipeline import PipelineConfig, follow
from pc2grid.sweep import Sweep

if TYPE_CHECKING:
    from pc2grid.simulate import SimulationConfig
_FITTED_M = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Driven:
    """N scans of one session.

    sweeps : what each says about the plane, with its stamp.
    T_odom_base : (N, 3) x, y, yaw as registered, in a frame of the session's own.
    lost : (N,) whether registration was lost.
    T_world_base : (N, 3) x, y, yaw in truth: in the floor plan, or as a log's ground truth has it; NaN where
    that says nothing.
    """

    sensor: SensorKind
    sweeps: tuple[Sweep, ...]
    T_odom_base: F64
    lost: NDArray[np.bool_]
    T_world_base: F64

    def __len__(self) -> int:
        return len(self.sweeps)

    def path_m(self) -> F64:
        """(N,) metres driven up to each scan, as registered."""
        steps = np.hypot(*np.diff(self.T_odom_base[:, :2], axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))[: len(self)]

    def T_world_odom(self) -> SE2:
        """Where the session's own frame truly lies at its end.

        Fitted over the scans of the last `_FITTED_M` whose truth is known: a single heading, taken while the
        robot turns, may be some degrees off.
        """
        path_m = self.path_m()
        known = np.flatnonzero(~np.isnan(self.T_world_base[:, 0]))
        known = known[path_m[known] >= path_m[known[-1]] - _FITTED_M]
        ahead = np.array([(0.0, 0.0), (_FITTED_M, 0.0)])
        return SE2.fit(
            np.concatenate([_pose(self.T_odom_base[k]).apply(ahead) for k in known]),
            np.concatenate([_pose(self.T_world_base[k]).apply(ahead) for k in known]),
        )

    def scans(self) -> Iterator[tuple[RegisteredScan, Sweep, SE2]]:
        """Each scan (without its points), its sweep and its true pose, as they came."""
        nothing = np.empty((0, 3), np.float32)
        for sweep, pose, lost, truth in zip(
            self.sweeps, self.T_odom_base, self.lost, self.T_world_base, strict=True
        ):
            scan = Scan(
                stamp_ns=sweep.stamp_ns, points_m=nothing, T_base_sensor=np.eye(4), sensor=self.sensor
            )
            health = Health.LOST if lost else Health.FINE
            yield (
                RegisteredScan(scan=scan, T_map_base=_pose(pose).lift(), health=health),
                sweep,
                _pose(truth),
            )

    def save(self, path: Path) -> None:
        """Write it as one .npz, whole or not at all."""
        from pc2grid.io.atomic import replace_file

        empty = np.empty((0, 2), np.float32)
        with replace_file(path) as draft, draft.open("wb") as file:
            np.savez_compressed(
                file,
                sensor=np.array(self.sensor),
                stamps_ns=np.array([s.stamp_ns for s in self.sweeps], np.int64),
                T_odom_base=self.T_odom_base,
                lost=self.lost,
                T_world_base=self.T_world_base,
                hit_count=np.array([len(s.hits_m) for s in self.sweeps], np.int64),
                hits_m=np.concatenate([empty, *(s.hits_m for s in self.sweeps)]),
                origin_m=np.array([s.origin_m for s in self.sweeps]).reshape(-1, 2),
                free_m=np.array([s.free_m for s in self.sweeps], np.float32),
            )

    @staticmethod
    def load(path: Path) -> Driven:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        hits = np.split(arrays["hits_m"], np.cumsum(arrays["hit_count"])[:-1])
        return Driven(
            sensor=str(arrays["sensor"]),  # type: ignore[arg-type]
            sweeps=tuple(
                Sweep(stamp_ns=int(stamp), hits_m=points, origin_m=origin, free_m=free)
                for stamp, points, origin, free in zip(
                    arrays["stamps_ns"], hits, arrays["origin_m"], arrays["free_m"], strict=True
                )
            ),
            T_odom_base=arrays["T_odom_base"],
            lost=arrays["lost"],
            T_world_base=arrays["T_world_base"],
        )


def register(
    scans: Iterable[tuple[Scan, SE2 | None]],
    config: PipelineConfig,
    *,
    sensor: SensorKind,
    until_m: float = math.inf,
) -> Driven:
    """Register scans, each with its true pose if known, as a user would; stop after `until_m` of travel."""
    truths: list[SE2 | None] = []

    def untold() -> Iterator[Scan]:
        for scan, truth in scans:
            truths.append(truth)
            yield scan

    sweeps: list[Sweep] = []
    poses: list[SE2] = []
    lost: list[bool] = []
    driven_m = 0.0
    for registered, sweep in follow(untold(), config):
        pose = SE2.flatten(registered.T_map_base)
        if poses:
            driven_m += math.hypot(pose.x - poses[-1].x, pose.y - poses[-1].y)
        sweeps.append(sweep)
        poses.append(pose)
        lost.append(registered.health is Health.LOST)
        if driven_m >= until_m:
            break
    return Driven(
        sensor=sensor,
        sweeps=tuple(sweeps),
        T_odom_base=_array(poses),
        lost=np.array(lost, bool),
        T_world_base=_array(truths[: len(sweeps)]),
    )


def drive(
    plan: OccupancyGrid,
    sensor: SensorKind,
    simulation: SimulationConfig,
    config: PipelineConfig,
    *,
    until_m: float = math.inf,
) -> Driven:
    """A simulated session in a floor plan, registered."""
    from pc2grid.simulate import iter_session

    scans = iter_session(sensor=sensor, grid=plan, config=simulation)
    return register(scans, config, sensor=sensor, until_m=until_m)


def _pose(row: F64) -> SE2:
    return SE2(float(row[0]), float(row[1]), float(row[2]))


def _array(poses: Sequence[SE2 | None]) -> F64:
    rows = [(p.x, p.y, p.yaw) if p else (math.nan,) * 3 for p in poses]
    return np.array(rows, np.float64).reshape(-1, 3)
