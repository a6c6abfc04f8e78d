"""Views, retrieval by signatures and isovists, and what the probabilities promise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from signature.confidence import Calibration, Evidence, fit
from signature.query import Window
from signature.retrieve import _voices, retrieve, rotate_and_compare
from tests.drives import building, drive, office

OFFICE = building({"office": office()})


def window(corners: list[tuple[float, float]], field_deg: float = 360.0) -> tuple[Window, SE2]:
    """What is seen on a drive, and where its frame lies in the office."""
    seen = Window(OFFICE.made_with.projection, OFFICE.config)
    first: SE2 | None = None
    for registered, sweep, truth in drive(office(), corners, field_rad=math.radians(field_deg)):
        first = first or truth
        seen.add(sweep, SE2.flatten(registered.T_map_base))
    assert first is not None
    return seen, first


@pytest.mark.parametrize("field_deg", [360.0, 270.0, 90.0])
def test_the_right_place_is_among_the_first_twenty(field_deg: float) -> None:
    seen, T_map_query = window([(1.5, 7.0), (9.5, 7.0)], field_deg)
    made_with = OFFICE.made_with
    query = seen.query(made_with.partition, made_with.signature)
    found = retrieve(query, OFFICE.places, signature=made_with.signature, config=OFFICE.config, top_k=20)
    assert len(found) == 20
    assert [p.likeness for p in found] == sorted((p.likeness for p in found), reverse=True)
    right = [
        p
        for p in found
        if math.dist(
            T_map_query.apply(np.array([query.views[p.view].center_m]))[0],
            OFFICE.places.table.center_m[p.row],
        )
        <= 1.0
    ]
    assert right
    turns = [abs(math.remainder(p.yaw_rad - T_map_query.yaw, 2 * math.pi)) for p in right]
    assert min(turns) < math.radians(10)
    bases = [SE2(*p.at_m, p.yaw_rad) @ SE2(*query.views[p.view].center_m).inverse() for p in found]
    poses = [b @ query.T_odom_base for b in bases]
    for i, a in enumerate(poses):
        for b in poses[:i]:
            turn = abs(math.remainder(a.yaw - b.yaw, 2 * math.pi))
            assert max(abs(a.x - b.x), abs(a.y - b.y)) > 0.7 or turn > math.radians(14)


def test_every_view_has_a_standpoint_beside_it_that_belongs_to_the_nearest_place() -> None:
    places, grid = OFFICE.places, office()
    rows = np.arange(len(places.table))
    stand = places.around(rows)
    cells = grid.to_cell(stand.at_m)
    assert grid.free[cells[:, 0], cells[:, 1]].all()
    apart = np.hypot(*(stand.at_m[:, None] - places.table.center_m[None]).transpose(2, 0, 1))
    assert (apart[np.arange(len(apart)), stand.place] <= apart.min(axis=1) + 1e-9).all()
    rng = np.random.default_rng(0)
    on_the_way = rng.uniform((0.5, 6.6), (19.5, 7.4), (50, 2))
    found = stand.beside(on_the_way, np.zeros(50, np.int64))
    assert (found < len(stand.at_m)).all()
    assert np.hypot(*(stand.at_m[found] - on_the_way).T).max() < 0.29
    assert (stand.beside(on_the_way, np.ones(50, np.int64)) == len(stand.at_m)).all()


def test_views_lie_apart_and_on_what_was_seen() -> None:
    seen, _ = window([(1.5, 7.0), (9.5, 7.0)], 90.0)
    query = seen.query(OFFICE.made_with.partition, OFFICE.made_with.signature)
    centers = np.array([v.center_m for v in query.views])
    apart = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1))
    assert 2 <= len(centers) <= OFFICE.config.views
    assert apart[~np.eye(len(centers), dtype=bool)].min() >= OFFICE.config.view_spacing_m
    cells = query.grid.to_cell(centers)
    assert (query.grid.cells[cells[:, 0], cells[:, 1]] >= 0).all()


def test_a_window_forgets_what_lies_farther_back() -> None:
    config = OFFICE.config.model_copy(update={"window_m": 3.0})
    long, short = (
        Window(OFFICE.made_with.projection, OFFICE.config),
        Window(OFFICE.made_with.projection, config),
    )
    for registered, sweep, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        for seen in (long, short):
            seen.add(sweep, SE2.flatten(registered.T_map_base))
    assert long.path_m == pytest.approx(short.path_m) == pytest.approx(7.8, abs=0.3)
    assert len(short) < 20 < len(long)


def test_standing_still_adds_nothing() -> None:
    seen = Window(OFFICE.made_with.projection, OFFICE.config)
    registered, sweep, _ = next(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for _ in range(50):
        seen.add(sweep, SE2.flatten(registered.T_map_base))
    assert len(seen) == 1 and seen.path_m == 0.0


@pytest.mark.parametrize(("bearings", "longest_m"), [(48, 5.0), (90, 5.0), (48, 80.0)])
def test_isovists_are_compared_at_every_rotation_like_a_slow_oracle(bearings: int, longest_m: float) -> None:
    rng = np.random.default_rng(0)
    ranges, others = (rng.uniform(0, longest_m, (n, bearings)).astype(np.float32) for n in (2, 700))
    seen, others_seen = rng.random((2, bearings)) < 0.8, rng.random((700, bearings)) < 0.8
    others[3], others_seen[3] = np.roll(ranges[1], 20), np.roll(seen[1], 20)
    seen[0, 5:] = False
    others_seen[600] = False
    fast = rotate_and_compare(ranges, seen, others, others_seen)
    assert fast.shape == (2, bearings, 700)
    for shift in range(bearings):
        other, known = np.roll(others, -shift, axis=1), np.roll(others_seen, -shift, axis=1)
        both = seen[:, None] & known
        kernel = np.maximum(0.0, 1.0 - np.abs(ranges[:, None] - other) / 0.5) * both
        plain = kernel.sum(axis=2) / (both.sum(axis=2) + 0.15 * bearings)
        assert np.abs(fast[:, shift] - plain).max() < 0.002 * max(1.0, longest_m / 20)
    assert np.unravel_index(np.argmax(fast[1]), fast[1].shape) == (20, 3)


def test_a_view_speaks_of_what_it_would_see_or_not_at_all() -> None:
    rng = np.random.default_rng(0)
    likeness = rng.random((3, 48, 10)).astype(np.float32)
    shift, beside = rng.integers(0, 48, 40), rng.integers(0, 11, (40, 3))
    voices = _voices(likeness, shift, beside)
    for c, u in np.ndindex(voices.shape):
        near = (
            [likeness[u, (shift[c] + turn) % 48, beside[c, u]] for turn in (-1, 0, 1)]
            if beside[c, u] < 10
            else [-1]
        )
        assert voices[c, u] == max(near)


def test_probabilities_sum_to_one_and_a_tie_is_halved() -> None:
    model = Calibration()
    p = model.probabilities(Evidence(scores=(0.9, 0.9), walls=2000))
    assert p.sum() == pytest.approx(1.0)
    assert p[0] == pytest.approx(p[1]) == pytest.approx(0.5, abs=1e-3)
    assert model.probabilities(Evidence(scores=(), walls=0))[-1] == 1.0
    lone = [model.probabilities(Evidence(scores=(s,), walls=1000))[0] for s in (0.3, 0.6, 0.9)]
    assert lone == sorted(lone) and lone[0] < 0.05 and lone[2] > 0.99


def test_the_fit_recovers_the_model_that_made_the_data() -> None:
    rng = np.random.default_rng(0)
    truth = Calibration(neutral=0.55, worth=15.0)
    scores = np.sort(rng.uniform(0.35, 0.85, (4000, 3)), axis=1)[:, ::-1]
    walls = rng.uniform(20, 400, 4000)
    evidence = [Evidence(scores=tuple(s), walls=float(w)) for s, w in zip(scores, walls, strict=True)]
    right = [rng.random() < truth.probabilities(e)[0] for e in evidence]
    found = fit(evidence, right)
    assert found.neutral == pytest.approx(truth.neutral, abs=0.03)
    assert found.worth == pytest.approx(truth.worth, rel=0.25)
