"""How exactly the places of a map are known: the pose graph says it, and repeated drives agree."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2
from pc2grid.mapping.graph import Edge, optimise
from pc2grid.mapping.quality import (
    position_sigmas,
    precision_of,
    precision_warning,
)
from pc2grid.model import Health, Precision, Trajectory

STEP = np.diag([0.03**-2, 0.03**-2, np.radians(0.4) ** -2])
LOOP = np.diag([0.02**-2, 0.02**-2, np.radians(0.2) ** -2])


def hall_and_wing() -> F64:
    """Twice around a hall of 16 by 16 m in steps of 4 m, then 40 m along a wing: poses (N, 3)."""
    side = [(4.0, 0.0, 0.0)] * 4 + [(0.0, 0.0, np.pi / 2)]
    pose, poses = SE2(0.0, 0.0, 0.0), []
    for step in side * 8 + [(4.0, 0.0, 0.0)] * 10:
        poses.append((pose.x, pose.y, pose.yaw))
        pose = pose @ SE2(*step)
    return np.array(poses)


TRUTH = hall_and_wing()
ROUND = 20  # steps of one lap
WING = slice(2 * ROUND + 1, None)


def edges(truth: F64, *, loops: bool = True, rng: np.random.Generator | None = None) -> list[Edge]:
    """Tracked steps, and loops between the laps; with noise as their information says, if `rng` is given."""
    pairs = [(k, k + 1, STEP, False) for k in range(len(truth) - 1)]
    pairs += [(k, k + ROUND, LOOP, True) for k in range(0, ROUND, 2) if loops]
    found = []
    for i, j, information, loop in pairs:
        covariance = np.linalg.inv(information)
        noise = np.zeros(3) if rng is None else rng.multivariate_normal(np.zeros(3), covariance)
        measured = SE2(*truth[i]).inverse() @ SE2(*truth[j]) @ SE2(*noise)
        found.append(Edge(i, j, measured, information, loop=loop))
    return found


def placed(poses: F64, truth: F64, weight: F64) -> F64:
    """Errors (N, 2) of positions after the weighted least squares placement on the truth."""
    share = weight / weight.sum()
    a, b = poses[:, :2] - share @ poses[:, :2], truth[:, :2] - share @ truth[:, :2]
    turn = np.arctan2(share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), share @ (a * b).sum(axis=1))
    return SE2(0.0, 0.0, float(turn)).apply(a) - b


@pytest.mark.parametrize("loops", [True, False])
def test_repeated_drives_scatter_as_stated(loops: bool) -> None:
    rng = np.random.default_rng(5)
    sigma, weight = position_sigmas(TRUTH, edges(TRUTH, loops=loops))
    errors = np.array(
        [placed(optimise(TRUTH, edges(TRUTH, loops=loops, rng=rng)).poses, TRUTH, weight) for _ in range(80)]
    )
    scatter = np.sqrt([np.linalg.eigvalsh(np.cov(errors[:, k].T))[-1] for k in range(len(TRUTH))])
    assert np.all(np.abs(np.log(scatter / sigma)) < np.log(1.5))
    assert abs(np.log(scatter / sigma).mean()) < 0.2


def test_a_wing_driven_once_is_known_less_the_farther_it_leads() -> None:
    sigma, _ = position_sigmas(TRUTH, edges(TRUTH))
    assert np.all(np.diff(sigma[WING]) > 0.0)
    assert sigma[-1] > 3.0 * np.median(sigma[: 2 * ROUND])


def test_loops_make_places_surer() -> None:
    with_loops, _ = position_sigmas(TRUTH, edges(TRUTH))
    without, _ = position_sigmas(TRUTH, edges(TRUTH, loops=False))
    assert with_loops.max() < 0.7 * without.max()


def test_a_loop_from_the_end_of_the_wing_ties_it() -> None:
    back = Edge(0, len(TRUTH) - 1, SE2(*TRUTH[0]).inverse() @ SE2(*TRUTH[-1]), LOOP, loop=True)
    loose, _ = position_sigmas(TRUTH, edges(TRUTH))
    tied, _ = position_sigmas(TRUTH, [*edges(TRUTH), back])
    assert tied[-1] < 0.5 * loose[-1]


def way(length_m: float = 30.0) -> Trajectory:
    count = round(length_m / 0.5) + 1
    return Trajectory(
        stamps_ns=7 * 10**9 + np.arange(count) * 10**9,
        T_session_base=np.array([SE2(0.5 * k, 1.0, 0.0).lift() for k in range(count)]),
        health=(Health.FINE,) * count,
    )


def test_the_loose_stretch_is_named_with_its_place_and_what_to_do() -> None:
    scans, sigma_m = np.array([4, 12, 20, 28, 36, 44, 52]), np.array([0.1, 0.1, 0.2, 0.3, 0.6, 0.9, 1.2])
    found = precision_of(way(), scans, sigma_m)
    (loose,) = found.loose
    assert (loose.from_ns, loose.to_ns) == (39 * 10**9, 67 * 10**9)  # from scan 32 to the end
    assert (loose.x_m, loose.y_m, loose.sigma_m, loose.length_m) == (26.0, 1.0, 1.2, pytest.approx(14.0))
    assert found.at(int(way().stamps_ns[48])) == pytest.approx(1.05)
    text = precision_warning(found, way())
    assert text is not None
    for part in ("14 m of the travel, 32 to 60 s", "near x 26.0, y 1.0 m", "off by 1.2 m", "come back"):
        assert part in text


def test_a_map_that_is_tied_well_has_no_warning() -> None:
    scans = np.array([4, 12, 20])
    assert precision_warning(precision_of(way(), scans, np.array([0.1, 0.5, 0.2])), way()) is None
    # Less than a local map: nothing to come back to.
    assert precision_of(way(1.0), np.array([1]), np.array([2.0])).loose == ()
    assert precision_of(way(), np.empty(0, np.int64), np.empty(0)) == Precision()
