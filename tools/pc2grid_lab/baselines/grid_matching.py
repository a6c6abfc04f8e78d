"""Two maps brought together by MRPT's grid-matching, as Debian installs it (`apt-get install mrpt-apps`).

Blanco, Gonzalez-Jimenez and Fernandez-Madrigal, "A robust, multi-hypothesis approach to matching occupancy
grid maps" (Robotica, 2013): corners of the grids are matched by their surroundings, RANSAC finds transforms
that explain several of them, and ICP turns down those that fit badly. The program reads maps as the scans
that made them, so each grid is looked at from the nodes of its junction graph. Its settings are those of its
example.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import WALL, look_around
from signature.localization.joining.landmarks import LANDMARKS, with_places_on_ways

if TYPE_CHECKING:
    import networkx as nx

SETTINGS = Path("/usr/share/mrpt/config_files/grid-matching/gridmatch_example.ini")
_SIGHT_M = 20.0
_LONGEST_M = 80.0
"""What is as long or longer counts as nothing seen (for `carmen2simplemap`)."""
_BEAMS = 720


@dataclass(frozen=True, slots=True)
class GridMatch:
    """A transform that the program believes in, and the logarithm of its weight."""

    log_weight: float
    T_target_source: SE2


def match_grids(
    target: tuple[OccupancyGrid, nx.Graph], source: tuple[OccupancyGrid, nx.Graph]
) -> tuple[GridMatch, ...]:
    """The transforms that the program finds, the likeliest first; none if it says that there is none.

    target, source : each a grid with its junction graph.

    Raises ConfigError if the program is not installed.
    """
    if shutil.which("grid-matching") is None or not SETTINGS.exists():
        raise ConfigError("MRPT's grid-matching is not installed", hint="apt-get install mrpt-apps")
    with tempfile.TemporaryDirectory(prefix="grid-matching-") as name:
        folder = Path(name)
        maps = [_simple_map(folder / side, *of) for side, of in (("target", target), ("source", source))]
        found = folder / "found.txt"
        inputs: list[str | Path] = ["-1", maps[0], "-2", maps[1], "-c", SETTINGS]
        _run(["grid-matching", "--match", *inputs, "-o", found, "--out-dir", folder / "out"], folder)
        rows = np.loadtxt(found, comments="%", ndmin=2).reshape(-1, 4)
    matches = [GridMatch(weight, SE2(x, y, yaw)) for weight, x, y, yaw in rows.tolist()]
    return tuple(sorted(matches, key=lambda match: -match.log_weight))


def _simple_map(stem: Path, grid: OccupancyGrid, graph: nx.Graph) -> Path:
    """The map as a file of scans at known poses."""
    log, made = stem.with_suffix(".log"), stem.with_suffix(".simplemap")
    log.write_text(carmen_scans(grid, graph))
    _run(["carmen2simplemap", "-q", "-w", "-i", log, "-o", made], stem.parent)
    return made


def carmen_scans(grid: OccupancyGrid, graph: nx.Graph) -> str:
    """What is seen all around from the places of a junction graph, as a CARMEN log, a line each."""
    places = with_places_on_ways(graph, LANDMARKS.spacing_m)
    at_m = np.array([at for _, at in places.nodes(data="center_m")], np.float64).reshape(-1, 2)
    ranges_m, ends = look_around(grid, at_m, _SIGHT_M, bearings=_BEAMS)
    # A CARMEN scan begins behind the robot, an isovist in front of it.
    ranges_m = np.roll(np.where(ends == WALL, ranges_m, 1.0 + _LONGEST_M), _BEAMS // 2, axis=1)
    step_rad = 2.0 * math.pi / _BEAMS
    head = f"ROBOTLASER1 0 {-math.pi:.6f} {2.0 * math.pi - step_rad:.6f} {step_rad:.6f} {_LONGEST_M:g} 0.01 0"
    return "".join(
        f"{head} {_BEAMS} {' '.join(f'{r:.3f}' for r in scan)}"
        f" 0 {x:.4f} {y:.4f} 0 {x:.4f} {y:.4f} 0 0 0 0 0 0 {k}.0 robot {k}.0\n"
        for k, (scan, (x, y)) in enumerate(zip(ranges_m, at_m.tolist(), strict=True))
    )


def _run(command: list[str | Path], folder: Path) -> None:
    """Run a program of MRPT in a folder, where it leaves its drawings. Raises CalledProcessError."""
    words = [*map(str, command)]
    subprocess.run(words, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, check=True)
