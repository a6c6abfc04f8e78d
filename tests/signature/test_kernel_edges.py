"""Branches of compiled functions that recordings hardly meet, each by hand or against a slow oracle."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.mapping.unseen_hits import UnseenHits


def test_a_glimpse_is_what_falls_into_a_cell_for_the_first_time() -> None:
    def planar_scan(*hits: tuple[float, float]) -> PlanarScan:
        points = np.array(hits, np.float32).reshape(-1, 2)
        return PlanarScan.of_hits(
            stamp_ns=0, hits_m=points, origin_m=np.zeros(2), free_m=np.zeros(8, np.float32)
        )

    unseen_hits = UnseenHits(reach_m=1.0, cell_m=0.1)
    unseen_hits.restart(planar_scan((0.55, 0.55)), SE2(1.0, 0.0))
    unseen_hits.add(
        planar_scan((0.45, 0.55), (0.65, 0.55), (0.68, 0.52), (9.0, 0.0), (0.0, -9.0)), SE2(1.1, 0.0)
    )
    unseen_hits.add(planar_scan((0.65, 0.55)), SE2(1.1, 0.0))
    assert unseen_hits.take() == pytest.approx(np.array([[0.75, 0.55]]), abs=1e-6)
    assert unseen_hits.take().shape == (0, 2)
