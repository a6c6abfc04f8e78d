"""How far the poses of joined sessions lie from those of one recording that contains them all.

    pc2grid convert log.mcap -o whole.submaps
    pc2grid convert log.mcap -o halves.submaps --duration 300 --name first
    pc2grid convert log.mcap -o halves.submaps --add --start 300 --name second
    pc2grid db join halves.submaps
    python -m pc2grid_lab.bench.real_joins whole.submaps halves.submaps

Printed are RMS distances after the best rigid alignment, of each session and of all together where they lie
in the building: as they were drawn, and as they straighten each other.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.model import Trajectory
from signature.database import open_database
from signature.database.protocol import BuildingFrame

Placed = Callable[[BuildingFrame, F64], F64]
"""Points (N, 2) of a session in the frame of its building."""


def drawn(frame: BuildingFrame, points_m: F64) -> F64:
    """As the session was drawn."""
    return frame.T_building_session.apply(points_m)


def off_m(
    whole: Trajectory, parts: Mapping[str, Trajectory], frames: Mapping[str, BuildingFrame], placed: Placed
) -> dict[str, float]:
    """RMS distance of the poses of each part, and of all together."""
    pairs = {}
    for name, part in parts.items():
        _, i, j = np.intersect1d(part.stamps_ns, whole.stamps_ns, return_indices=True)
        pairs[name] = placed(frames[name], part.planar()[i, :2]), whole.planar()[j, :2]
    at_m, true_m = (np.concatenate(points) for points in zip(*pairs.values(), strict=True))
    pairs["all"] = at_m, true_m
    return {
        name: float(np.sqrt(((SE2.fit(at, true).apply(at) - true) ** 2).sum(axis=1).mean()))
        for name, (at, true) in pairs.items()
    }


def main() -> None:
    """Print a line for each session, and one for all."""
    with open_database(sys.argv[1]) as one, open_database(sys.argv[2]) as joined:
        (info,) = one.sessions()
        whole, frames = one.trajectory(info.name), joined.frames()
        parts = {name: joined.trajectory(name) for name in frames}
    before, after = (off_m(whole, parts, frames, placed) for placed in (drawn, BuildingFrame.apply))
    for name, error_m in before.items():
        print(f"{name}: {error_m:.3f} -> {after[name]:.3f} m")


if __name__ == "__main__":
    main()
