"""Session maps with a trajectory and loops, without a recording."""

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import Health, Loop, OccupancyGrid, SessionMap, Trajectory
from pc2grid.submaps.submaps import partition
from signature.config import Config


def way(n: int = 40) -> Trajectory:
    poses = np.array([SE2(1.0 + 0.2 * k, 7.0).lift() for k in range(n)])
    health = [Health.FINE] * 10 + [Health.DEGENERATE] * 5 + [Health.LOST] * 5 + [Health.FINE] * (n - 20)
    return Trajectory(stamps_ns=np.arange(n) * 10**8, T_session_base=poses, health=tuple(health))


LOOPS = tuple(
    Loop(
        older=older,
        newer=newer,
        T_older_newer=SE2(0.2 * (newer - older) + 0.01, -0.02, 0.003),
        information=np.array([[900.0, 30.0, 5.0], [30.0, 400.0, -7.0], [5.0, -7.0, 4e4]]),
        accepted=accepted,
    )
    for older, newer, accepted in ((2, 30, True), (5, 39, True), (1, 12, False))
)


def session(
    name: str, grid: OccupancyGrid, trajectory: Trajectory, loops: tuple[Loop, ...] = ()
) -> SessionMap:
    submaps = partition(grid, Config().partition)
    return SessionMap(
        session=name, sensor="laser", grid=grid, submaps=submaps, trajectory=trajectory, loops=loops
    )
