"""Branches of compiled functions that recordings hardly meet, each by hand or against a slow oracle."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pc2grid.alignment import NEUTRAL, SIGMA_M, _gauss_newton, levels_for, prepare, prepare_query, refine
from pc2grid.config import ProjectionConfig
from pc2grid.errors import PointCloudError
from pc2grid.facing import facing
from pc2grid.floor import Ground
from pc2grid.geometry import SE2
from pc2grid.glimpses import Glimpses
from pc2grid.io.lzf import decompress
from pc2grid.matching import PointGrid
from pc2grid.sweep import Sweep, flatten
from pc2grid.windows import search_windows
from signature.baselines import sdf, surf
from signature.config import SignatureConfig
from signature.freespace import adjacency
from signature.retrieve import _distinct, _peaks
from tests.drives import office

FIELD = prepare(office())


def test_points_so_far_away_that_no_maximum_covers_them() -> None:
    """Half a heading moves them further than any sliding maximum looks, and they may be on a wall."""
    rng, step = np.random.default_rng(5), 0.375
    angles = rng.uniform(-math.pi, math.pi, 24)
    far = rng.uniform(1, 9, 24)
    points = np.column_stack((far * np.cos(angles), far * np.sin(angles))).astype(np.float32)
    start = np.array([10.02, 7.03, 0.2])
    found = search_windows(
        FIELD, points, start[None], half_t_m=0.2, half_a_rad=1.5 * step, step_rad=step, floor=0.0, keep=0.0
    )
    res, reaches = FIELD.resolution_m, np.asarray(FIELD.reaches_m) / FIELD.resolution_m
    level = levels_for((far / res).astype(np.float32), 0.5, step / 2, reaches)
    assert level.max() == len(reaches) - 1
    _, height, width = FIELD.levels.shape
    scores = []
    for turn, down, right in itertools.product((-step, 0.0, step), range(-4, 5), range(-4, 5)):
        c, s = math.cos(start[2] + turn), math.sin(start[2] + turn)
        moved = (points.astype(float) @ [[c, s], [-s, c]] + start[:2] - FIELD.origin_m) / res
        x, y = np.floor(moved).astype(int).T + np.array([[right], [down]])
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        values = FIELD.levels[level, np.where(inside, y, 0), np.where(inside, x, 0)]
        scores.append(np.where(inside, values, int(255 * NEUTRAL)).mean() / 255)
    # A coordinate on the border of two cells may be rounded either way.
    assert found[0, 3] == pytest.approx(max(scores), abs=0.02)
    assert max(scores) - np.median(scores) > 0.05


def test_a_step_of_the_refinement_is_two_cells_at_most() -> None:
    """Far down the slope of a wall the straight line leads much too far."""
    field = np.zeros((80, 80), np.uint8)
    away = np.arange(80) - 40.0
    sigma = SIGMA_M / FIELD.resolution_m
    field[:] = np.exp(-0.5 * (away / sigma) ** 2) * 255
    x, y = np.zeros(40), np.linspace(-15, 15, 40)
    start = 40.5 - 2.2 * sigma
    tx, ty, _, _, _ = _gauss_newton(field, x, y, start, 40.0, 0.0, 1)
    assert math.hypot(tx - start, ty - 40.0) == pytest.approx(2.0, abs=1e-9)
    assert tx > start
    tx, _, yaw, _, _ = _gauss_newton(field, x, y, start, 40.0, 0.0, 30)
    assert tx == pytest.approx(40.5, abs=0.05) and yaw == pytest.approx(0.0, abs=1e-3)


def test_many_points_are_refined_by_way_of_a_few() -> None:
    query = prepare_query(office(), spacing_m=0.05)
    assert len(query.walls_m) > 2000
    pose, _ = refine(FIELD, query, SE2(0.12, -0.08, 0.01))
    assert math.hypot(pose.x, pose.y) < 0.01 and abs(pose.yaw) < 1e-3


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_scan_of_one_short_wall_faces_the_sensor_squarely(count: int) -> None:
    """All beams lie within one neighbourhood: going round in the scan, no beam is beyond it."""
    hits = np.column_stack((np.full(count, 2.0), np.linspace(0.5, 0.54, count))).astype(np.float32)
    assert facing(hits, np.zeros(2)) == pytest.approx(np.full(count, math.pi), abs=1e-4)


def test_points_beside_a_map_are_no_part_of_it_and_a_heap_is_no_line() -> None:
    wall = np.column_stack((np.linspace(0.5, 3.5, 200), np.full(200, 2.0)))
    south = np.full(200, -math.pi / 2)
    grid = PointGrid((0.0, 0.0), (4.0, 4.0))
    beside = np.array([[-1.0, 2.0], [5.0, 2.0], [2.0, -1.0], [2.0, 5.0]] * 50)
    grid.add(beside, south)
    nothing = grid.match(wall, south, SE2(), SE2(), np.eye(3))
    assert nothing.overlap == 0.0 and nothing.pose == SE2()
    grid.add(np.full((200, 2), 2.0), south)
    assert grid.match(wall, south, SE2(), SE2(), np.eye(3)).overlap == 0.0
    grid.add(wall, south)
    found = grid.match(wall, south, SE2(0.0, 0.08), SE2(0.0, 0.08), np.eye(3))
    assert found.overlap > 0.9 and abs(found.pose.y) < 0.01


def test_above_its_band_a_sensor_says_nothing_of_what_is_above_it() -> None:
    config = ProjectionConfig()
    ground = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
    high = config.band_max_m + 1.0
    points = np.array([[5.0, 0.0, high - 0.5], [0.0, 5.0, 0.0]])

    def seen(sensor_z_m: float) -> Sweep:
        sensor = np.array([0.0, 0.0, sensor_z_m])
        return flatten(points, stamp_ns=0, sensor_m=sensor, ground=ground, config=config)

    above, below = seen(high), seen(0.5 * config.band_max_m)
    assert above.free_m[0] == 0.0 and 0.0 < below.free_m[0] < 5.0
    assert above.free_m[360] == pytest.approx(5.0) and not len(above.hits_m)


def test_a_glimpse_is_what_falls_into_a_cell_for_the_first_time() -> None:
    def sweep(*hits: tuple[float, float]) -> Sweep:
        points = np.array(hits, np.float32).reshape(-1, 2)
        return Sweep(stamp_ns=0, hits_m=points, origin_m=np.zeros(2), free_m=np.zeros(8, np.float32))

    glimpses = Glimpses(reach_m=1.0, cell_m=0.1)
    glimpses.restart(sweep((0.55, 0.55)), SE2(1.0, 0.0))
    glimpses.add(sweep((0.45, 0.55), (0.65, 0.55), (0.68, 0.52), (9.0, 0.0), (0.0, -9.0)), SE2(1.1, 0.0))
    glimpses.add(sweep((0.65, 0.55)), SE2(1.1, 0.0))
    assert glimpses.take() == pytest.approx(np.array([[0.75, 0.55]]), abs=1e-6)
    assert glimpses.take().shape == (0, 2)


def slowly(data: bytes, size: int) -> bytes | None:
    """LZF by its description; None where it makes no sense."""
    out, at = b"", 0
    while at < len(data):
        control, at = data[at], at + 1
        if control < 32:
            piece, at = data[at : at + control + 1], at + control + 1
            if len(piece) <= control:
                return None
        else:
            count = control >> 5
            if count == 7:
                count, at = count + int.from_bytes(data[at : at + 1], "big"), at + 1
            if at >= len(data):
                return None
            back, at = ((control & 31) << 8) + data[at] + 1, at + 1
            if back > len(out):
                return None
            piece = (out[-back:] * (count + 2))[: count + 2]
        out += piece
        if len(out) > size:
            return None
    return out if len(out) == size else None


PARTS = st.one_of(
    st.binary(min_size=1, max_size=32).map(lambda raw: bytes([len(raw) - 1]) + raw),
    st.tuples(st.integers(1, 6), st.integers(0, 40)).map(lambda p: bytes([p[0] << 5, p[1]])),
    st.tuples(st.integers(0, 255), st.integers(0, 40)).map(lambda p: bytes([7 << 5, *p])),
    st.binary(max_size=3),
)


@settings(max_examples=200, deadline=None)
@given(parts=st.lists(PARTS, max_size=6), more=st.sampled_from([0, 0, 0, -1, 1]))
@example(parts=[b"\x00a", b"\xe0\xff\x00"], more=0)  # one byte, and 264 like it
@example(parts=[b"\x00a", b"\xe0\xff\x00"], more=-1)
@example(parts=[b"\x00a", b"\x20\x01"], more=0)  # from before the beginning
@example(parts=[b"\x05abc"], more=0)
@example(parts=[b"\x02abc"], more=-1)
@example(parts=[b"\x00a", b"\xe0\x01"], more=0)
def test_lzf_is_expanded_as_by_its_description(parts: list[bytes], more: int) -> None:
    data = b"".join(parts)
    size = next((n for n in range(2000) if slowly(data, n) is not None), 100) + more
    expected = slowly(data, size) if size >= 0 else None
    if expected is not None:
        assert decompress(data, size) == expected
    elif size >= 0:
        with pytest.raises(PointCloudError, match="damaged"):
            decompress(data, size)


def test_peaks_are_found_around_the_circle_and_one_on_each_plateau() -> None:
    rng = np.random.default_rng(2)
    likeness = rng.integers(0, 4, (12, 30)).astype(np.float32)
    likeness[:, 0] = 1.0  # as good everywhere: no peak
    columns = rng.permutation(30)[:20]
    columns[0] = 0
    at, shift = _peaks(likeness, columns)
    expected = [
        (column, k)
        for column in columns.tolist()
        for k in range(12)
        if likeness[k - 1, column] <= likeness[k, column] > likeness[(k + 1) % 12, column]
    ]
    assert list(zip(at.tolist(), shift.tolist(), strict=True)) == expected
    assert 0 in shift and 11 in shift and 0 not in at


def test_placements_beside_a_better_one_are_left_out() -> None:
    base = np.array([[0.0, 0.0], [0.3, 0.3], [0.3, 0.3], [0.3, 0.3], [0.0, 5.0], [9.0, 0.0]])
    yaw = np.array([math.pi - 0.01, 0.01 - math.pi, 0.0, 0.01 - math.pi, 0.0, 0.0])
    session = np.array([0, 0, 0, 1, 0, 0])
    order = np.array([0, 1, 2, 3, 4, 5])
    assert _distinct(order, base, yaw, session, 10).tolist() == [0, 2, 3, 4, 5]
    assert _distinct(order, base, yaw, session, 3).tolist() == [0, 2, 3]
    assert _distinct(order[::-1].copy(), base, yaw, session, 10).tolist() == [5, 4, 3, 2, 1]


def test_where_nothing_changes_descriptors_say_so_and_stay_finite() -> None:
    """Of a window that leaves the map, what is inside counts."""
    flat = np.zeros((40, 40), np.float32)
    keypoints = np.array([[0, 0], [20, 20], [39, 5]])
    distance = np.full((40, 40), 2.0, np.float32)
    found = sdf._descriptors(keypoints, np.array([0.0, 1.0, 2.0]), distance, flat, flat, 10.0, 2.0, 0.25)
    assert not found[:, :-1].any()
    assert found[:, -1] == pytest.approx(np.full(3, 0.5))
    assert not surf._describe(np.zeros((41, 41)), np.array([[20.0, 20.0, 1.2], [0.0, 0.0, 2.0]])).any()


@pytest.mark.parametrize("turns", range(4))
def test_a_line_through_a_corner_is_blocked_by_both_cells_beside_it(turns: int) -> None:
    for beside, joined in (([], True), ([(3, 4)], True), ([(4, 3)], True), ([(3, 4), (4, 3)], False)):
        occupied, ends = np.zeros((8, 8), np.bool_), np.zeros((8, 8), np.bool_)
        ends[2, 2] = ends[5, 5] = True
        for cell in beside:
            occupied[cell] = True
        nodes = np.argwhere(np.rot90(ends, turns))
        walls = np.ascontiguousarray(np.rot90(occupied, turns))
        weights = adjacency(nodes, walls, 0.05, SignatureConfig())
        assert np.isfinite(weights[0, 1]) == joined
