"""The six rivals and the protocol they share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.model import Submap
from pc2grid_lab.baselines import EXTRA_METHOD_NAMES, METHOD_NAMES, Matcher, Method, make_methods
from pc2grid_lab.baselines.sdf import (
    DistanceFeatures,
    _consensus,
    _directions,
    _mean_distances,
    _orientation_shares,
)
from pc2grid_lab.baselines.several_centres import SeveralCentres, lattice, smaller_disc
from pc2grid_lab.baselines.shape_context import ShapeContext
from pc2grid_lab.baselines.surf import describe_points, interest_points
from pc2grid_lab.baselines.words import Words, sift, submap_image, surf
from pc2grid_lab.experiments.paper_experiment import rotated_submap
from tests.helpers.rooms import cross, degenerate, disc, l_shape, polygon, random_rooms, rectangle, submap_of

ALL = METHOD_NAMES + EXTRA_METHOD_NAMES


def rooms() -> list[Submap]:
    shapes = [
        rectangle(8.0, 5.0),
        disc(4.0),
        cross(6.0, 2.0),
        l_shape(),
        *(random_rooms(seed) for seed in range(4)),
    ]
    return [submap_of(cells) for cells in shapes]


@pytest.fixture(scope="module")
def matchers() -> dict[str, Matcher]:
    pytest.importorskip("mahotas")
    submaps = rooms()
    return {name: method.fit(submaps) for name, method in make_methods(ALL).items()}


@pytest.mark.parametrize("name", ALL)
def test_every_method_finds_a_submap_itself(name: str, matchers: dict[str, Matcher]) -> None:
    for i, submap in enumerate(rooms()):
        scores = matchers[name].similarities(submap)
        assert scores.shape == (8,)
        assert scores[i] == pytest.approx(scores.max())


# Bags of words are not asked: the stairs of turned walls are the only features of rooms as bare as these.
ON_GEOMETRY = ["shape_context", "proposed", "sdf"]


@pytest.mark.parametrize("name", ON_GEOMETRY)
def test_methods_on_geometry_find_a_turned_submap(name: str) -> None:
    submaps = [submap_of(random_rooms(seed)) for seed in range(8)]
    assert found_turned(make_methods([name])[name].fit(submaps), submaps) == 8


@pytest.mark.parametrize("name", ON_GEOMETRY[:-1])
def test_methods_on_geometry_find_a_turned_bare_shape(name: str, matchers: dict[str, Matcher]) -> None:
    """Without sdf: of a disc or a cross the curvature of the distance is the same along whole ridges, so that
    the rounding of a processor decides where its keypoints are."""
    assert found_turned(matchers[name], rooms()) >= 6


def found_turned(matcher: Matcher, submaps: list[Submap]) -> int:
    """How many submaps are the most similar to themselves after a turn."""
    similarities = (matcher.similarities(rotated_submap(s.grid, s.center_m, 8.0, 0.7)) for s in submaps)
    return sum(int(np.argmax(scores)) == i for i, scores in enumerate(similarities))


@pytest.mark.parametrize("name", ALL)
def test_degenerate_submaps_have_finite_scores(name: str, matchers: dict[str, Matcher]) -> None:
    for query_name, query in degenerate().items():
        assert np.isfinite(matchers[name].similarities(query)).all(), query_name


@pytest.mark.parametrize("name", ["shape_context", "sdf", "sift_bow", "sift_tfidf", "proposed"])
def test_a_map_of_empty_submaps_can_be_fitted(name: str) -> None:
    empty = [degenerate()["unknown"], degenerate()["free"]]
    scores = make_methods([name])[name].fit(empty).similarities(rooms()[0])
    assert scores.shape == (2,) and np.isfinite(scores).all()


def test_unknown_methods_are_named() -> None:
    with pytest.raises(KeyError, match="orb"):
        make_methods(["orb_bow"])
    assert all(isinstance(method, Method) for method in make_methods(METHOD_NAMES).values())


def test_bow_and_tfidf_read_a_submap_once() -> None:
    calls = []

    def counted(image: np.ndarray) -> np.ndarray:
        calls.append(1)
        return sift(image)

    methods = make_methods(["sift_bow", "sift_tfidf"])
    vocabulary = methods["sift_bow"].vocabulary  # type: ignore[attr-defined]
    vocabulary.feature = counted
    submaps = rooms()
    fitted = [method.fit(submaps) for method in methods.values()]
    assert len(calls) == len(submaps)
    query = submap_of(l_shape())
    a, b = (matcher.similarities(query) for matcher in fitted)
    assert len(calls) == len(submaps) + 1
    assert not np.allclose(a, b)
    assert isinstance(methods["sift_bow"], Words)


def test_features_are_at_most_300() -> None:
    pytest.importorskip("mahotas")
    image = submap_image(submap_of(random_rooms(1, walls=60)))
    assert sift(image).shape[1] == 128 and len(sift(image)) <= 300
    assert surf(image).shape[1] == 64 and len(surf(image)) <= 300


def test_surf_points_find_themselves_after_a_quarter_and_a_half_turn() -> None:
    pytest.importorskip("mahotas")
    image = submap_image(submap_of(random_rooms(1, walls=40)))
    size = image.shape[0] - 1
    points = interest_points(image, 300)
    here = describe_points(image, points)
    assert np.linalg.norm(here, axis=1) == pytest.approx(1.0, abs=1e-4)
    for quarters in (1, 2):
        turned = np.ascontiguousarray(np.rot90(image, quarters))
        other_points = interest_points(turned, 300)
        there = describe_points(turned, other_points)
        y, x = points[:, 0], points[:, 1]
        for _ in range(quarters):
            y, x = size - x, y
        nearest = np.linalg.norm(here[:, None] - there[None], axis=2).argmin(axis=1)
        error = np.hypot(other_points[nearest, 0] - y, other_points[nearest, 1] - x)
        assert (error < 3).mean() > 0.6


def test_shape_context_of_one_wall_by_hand() -> None:
    method = ShapeContext()
    cells = np.full((321, 321), 0, np.int8)
    cells[160, 240] = 100  # 4 m at +x: sector 0
    cells[240, 160] = 100  # 4 m at +y: sector 6 of 24
    context = method.context(submap_of(cells))
    rings = np.geomspace(0.5, 8.0, 12)
    ring = int(np.searchsorted(rings, 4.0))
    assert np.argwhere(context > 0).tolist() == [[ring, 0], [ring, 6]]
    assert context.sum() == pytest.approx(1.0)


def test_distance_keypoints_sit_where_the_room_is_special() -> None:
    found = DistanceFeatures().features(submap_of(rectangle(8.0, 4.0))).places_m - 160 * 0.05
    # The middle line of an 8 x 4 m room ends 2 m from its short sides.
    for end in ((-2.0, 0.0), (2.0, 0.0)):
        assert np.linalg.norm(found - end, axis=1).min() < 0.3
    assert len(found) <= 200


def test_orientation_follows_the_gradient() -> None:
    y, x = np.mgrid[:61, :61].astype(np.float32)
    for angle in (0.0, 0.9, 2.5, -1.3):
        gx, gy = np.full_like(x, math.cos(angle)), np.full_like(y, math.sin(angle))
        found = _directions(np.array([[30, 30]]), gx, gy, 15.0)[0]
        assert math.remainder(found - angle, 2 * math.pi) == pytest.approx(0.0, abs=0.03)


def test_descriptors_turn_with_the_room() -> None:
    corners = [(-5, -3), (5, -3), (5, 3), (1, 3), (1, 1), (-5, 1)]
    c, s = math.cos(0.6), math.sin(0.6)
    here = DistanceFeatures().features(submap_of(polygon(corners)))
    there = DistanceFeatures().features(
        submap_of(polygon([(c * x - s * y, s * x + c * y) for x, y in corners]))
    )
    moved = (here.places_m - 8.0) @ np.array([[c, s], [-s, c]]) + 8.0
    costs = np.linalg.norm(here.descriptors[:, None] - there.descriptors[None], axis=2)
    error = np.linalg.norm(there.places_m[costs.argmin(axis=1)] - moved, axis=1)
    # By chance it were one in a hundred; along bare walls the places are as alike as they look.
    assert (error < 0.3).mean() > 0.2
    found = DistanceFeatures().fit([submap_of(polygon(corners)), submap_of(l_shape())])
    scores = found.similarities(submap_of(polygon([(c * x - s * y, s * x + c * y) for x, y in corners])))
    assert scores[0] > 1.5 * scores[1]


def test_consensus_counts_what_one_motion_explains() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(-6, 6, (60, 2)).astype(np.float32)
    c, s = math.cos(1.1), math.sin(1.1)
    b = (a @ np.array([[c, s], [-s, c]]) + [2.0, -1.0]).astype(np.float32)
    b[40:] = rng.uniform(-6, 6, (20, 2))
    assert 40 <= _consensus(a, b, 0.25, 400) <= 43
    mirrored = (a * [1, -1]).astype(np.float32)
    assert _consensus(a, mirrored, 0.25, 400) < 15
    assert _consensus(a[:1], b[:1], 0.25, 400) == 0


def test_where_nothing_changes_descriptors_are_zero_and_finite() -> None:
    """Of a window that leaves the map, what is inside counts."""
    flat = np.zeros((40, 40), np.float32)
    keypoints, directions = np.array([[0, 0], [20, 20], [39, 5]]), np.array([0.0, 1.0, 2.0])
    assert not _orientation_shares(keypoints, directions, flat, flat, 10.0, 2.0).any()
    distance = np.full((40, 40), 2.0, np.float32)
    assert _mean_distances(keypoints, directions, distance, 10.0, 2.0) == pytest.approx(np.full(3, 2.0))
    nothing = np.zeros((40, 40), np.uint8)
    assert not describe_points(nothing, np.array([[20.0, 20.0, 1.2], [0.0, 0.0, 2.0]])).any()


def test_several_centres_find_a_query_beside_the_centre() -> None:
    """Places 3 m apart; the queries lie 0.9 m beside their centres."""
    halls = [submap_of(random_rooms(seed, walls=40)) for seed in (3, 4, 5)]
    at = [(hall, offset_m) for hall in halls for offset_m in lattice(3.0, 3.0)]
    submaps = [smaller_disc(hall, offset_m, 4.0) for hall, offset_m in at]
    matchers = {
        "plain": ShapeContext().fit(submaps),
        "several": SeveralCentres(method=ShapeContext()).fit(submaps),
    }
    right = dict.fromkeys(matchers, 0)
    for number, (hall, offset_m) in enumerate(at):
        beside = smaller_disc(hall, offset_m + 0.9 * np.array([math.cos(number), math.sin(number)]), 4.0)
        turned = rotated_submap(beside.grid, _middle(beside), beside.radius_m, 0.7 * number)
        for name, matcher in matchers.items():
            right[name] += int(np.argmax(matcher.similarities(turned))) == number
    assert right["several"] > right["plain"]


def _middle(submap: Submap) -> tuple[float, float]:
    height, width = submap.grid.cells.shape
    x, y = np.asarray(submap.grid.origin_m) + 0.5 * submap.grid.resolution_m * np.array([width, height])
    return float(x), float(y)


def test_a_smaller_disc_keeps_the_cells_within_its_radius() -> None:
    submap = submap_of(random_rooms(3, walls=40))
    offset_m = np.array([0.5, -0.25])
    part = smaller_disc(submap, offset_m, 2.0)
    assert part.radius_m == submap.radius_m - 2.0
    middle = np.asarray(_middle(submap)) + offset_m
    cells = np.argwhere(part.grid.occupied)
    away = np.hypot(*(part.grid.to_point(cells) - middle).T)
    assert len(cells) and away.max() <= part.radius_m + part.grid.resolution_m
    assert submap.grid.occupied[tuple(submap.grid.to_cell(part.grid.to_point(cells)).T)].all()


def test_a_lattice_holds_the_centre_and_stays_within_its_reach() -> None:
    points = lattice(1.0, 0.5)
    assert len(points) == 13 and (np.hypot(*points.T) <= 1.0).all() and [0.0, 0.0] in points.tolist()


def test_a_disc_beside_the_centre_of_another_submap_stands_for_that_one() -> None:
    """Two submaps 1.2 m apart: the disc of the first that is cut 0.2 m beside the second belongs to it."""
    hall = submap_of(random_rooms(3, walls=40))
    offsets = np.array([[0.0, 0.0], [1.2, 0.0]])
    submaps = [replace(smaller_disc(hall, o, 2.0), center_m=(float(o[0]), float(o[1]))) for o in offsets]
    matcher = SeveralCentres(method=ShapeContext()).fit(submaps)
    query = smaller_disc(hall, np.array([1.0, 0.0]), 2.0)
    assert np.argmax(matcher.similarities(query)) == 1
