"""MRPT's grid-matching as a rival: what it is given, and what it finds of a map in itself."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest

from pc2grid.errors import ConfigError
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid_lab.baselines.grid_matching import carmen_scans, match_grids
from signature.config import Config
from tests.helpers.simulated_drives import office

needs_mrpt = pytest.mark.skipif(
    shutil.which("grid-matching") is None, reason="MRPT is not installed: apt-get install mrpt-apps"
)


def test_the_ends_of_the_beams_are_the_walls() -> None:
    grid = office()
    lines = carmen_scans(grid, junction_graph(grid, Config().partition)).splitlines()
    assert lines
    walls_m = grid.to_point(np.argwhere(grid.occupied))
    for line in lines:
        words = line.split()
        start_rad, step_rad, longest_m = (float(words[k]) for k in (2, 4, 5))
        beams = int(words[8])
        ranges_m = np.array(words[9 : 9 + beams], float)
        x, y, yaw = (float(word) for word in words[10 + beams : 13 + beams])
        bearings = yaw + start_rad + step_rad * np.arange(beams)
        ends_m = np.column_stack((x + ranges_m * np.cos(bearings), y + ranges_m * np.sin(bearings)))
        hits_m = ends_m[ranges_m < longest_m]
        off_m = np.min(np.linalg.norm(hits_m[:, None] - walls_m, axis=2), axis=1)
        # A ray ends at a wall's side; the middle of its cell is half a diagonal away, and a step of the ray.
        assert np.max(off_m, initial=0.0) < 1.5 * grid.resolution_m


@needs_mrpt
def test_a_map_lies_in_itself() -> None:
    grid = office()
    of = grid, junction_graph(grid, Config().partition)
    best = match_grids(of, of)[0].T_target_source
    assert math.hypot(best.x, best.y) < 0.1
    assert abs(best.yaw) < math.radians(1.0)


def test_without_the_program_its_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    grid = office()
    of = grid, junction_graph(grid, Config().partition)
    with pytest.raises(ConfigError, match="mrpt-apps"):
        match_grids(of, of)
