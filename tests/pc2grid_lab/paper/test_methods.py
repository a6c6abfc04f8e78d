"""The six rivals and the protocol they share."""

import math

import numpy as np
import pytest

from pc2grid.geometry import F64
from pc2grid.model import Submap
from pc2grid_lab.paper.experiment import Matcher, rotated_submap
from pc2grid_lab.paper.methods import (
    EXTRA_METHOD_NAMES,
    METHOD_NAMES,
    DistanceFeatures,
    context,
    make_methods,
    submap_vector,
)
from signature.freespace import shortest_paths
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
    return {name: method(submaps) for name, method in make_methods(ALL, within()).items()}


def within() -> F64:
    """How other rooms differ from themselves after a turn."""
    others = [submap_of(random_rooms(seed)) for seed in range(10, 14)]
    turned = [rotated_submap(s.grid, s.center_m, 8.0, 1.0 + k) for k, s in enumerate(others)]
    return np.array([submap_vector(a) for a in turned]) - np.array([submap_vector(b) for b in others])


@pytest.mark.parametrize("name", ALL)
def test_every_method_finds_a_submap_itself(name: str, matchers: dict[str, Matcher]) -> None:
    for i, submap in enumerate(rooms()):
        scores = matchers[name](submap)
        assert scores.shape == (8,)
        assert scores[i] == pytest.approx(scores.max())


# Bags of words are not asked: the stairs of turned walls are the only features of rooms as bare as these.
ON_GEOMETRY = ["shape_context", "proposed", "proposed_ln_bc", "as_used_here", "learned", "unlearned", "sdf"]


@pytest.mark.parametrize("name", ON_GEOMETRY[:-1])
def test_methods_on_geometry_find_a_turned_bare_shape(name: str, matchers: dict[str, Matcher]) -> None:
    """Without sdf: of a disc or a cross the curvature of the distance is the same along whole ridges, so that
    the rounding of a processor decides where its keypoints are."""
    assert found_turned(matchers[name], rooms()) >= 6


def found_turned(matcher: Matcher, submaps: list[Submap]) -> int:
    """How many submaps are the most similar to themselves after a turn."""
    similarities = (matcher(rotated_submap(s.grid, s.center_m, 8.0, 0.7)) for s in submaps)
    return sum(int(np.argmax(scores)) == i for i, scores in enumerate(similarities))


@pytest.mark.parametrize("name", ALL)
def test_degenerate_submaps_have_finite_scores(name: str, matchers: dict[str, Matcher]) -> None:
    for query_name, query in degenerate().items():
        assert np.isfinite(matchers[name](query)).all(), query_name


@pytest.mark.parametrize("name", ["shape_context", "sdf", "sift_bow", "sift_tfidf", "proposed"])
def test_a_map_of_empty_submaps_can_be_fitted(name: str) -> None:
    empty = [degenerate()["unknown"], degenerate()["free"]]
    scores = make_methods([name])[name](empty)(rooms()[0])
    assert scores.shape == (2,) and np.isfinite(scores).all()


def test_methods_that_differ_in_comparing_share_the_description_of_a_query(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The two readings of the distance do; other signatures are not mistaken for these."""
    submaps, query = rooms()[:3], submap_of(random_rooms(5))
    names = ("proposed", "proposed_ln_bc", "as_used_here")
    matchers = [method(submaps) for method in make_methods(names).values()]
    described = []
    monkeypatch.setattr(
        "signature.paper.shortest_paths", lambda *of: described.append(of) or shortest_paths(*of)
    )
    found = [matcher(query) for matcher in matchers]
    assert len(described) == 2
    for name, similarities in zip(names, found, strict=True):
        assert np.array_equal(similarities, make_methods([name])[name](submaps)(query))


def test_shape_context_of_one_wall_by_hand() -> None:
    cells = np.full((321, 321), 0, np.int8)
    cells[160, 240] = 100  # 4 m at +x: sector 0
    cells[240, 160] = 100  # 4 m at +y: sector 6 of 24
    found = context(submap_of(cells))
    rings = np.geomspace(0.5, 8.0, 12)
    ring = int(np.searchsorted(rings, 4.0))
    assert np.argwhere(found > 0).tolist() == [[ring, 0], [ring, 6]]
    assert found.sum() == pytest.approx(1.0)


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
    found = DistanceFeatures()([submap_of(polygon(corners)), submap_of(l_shape())])
    scores = found(submap_of(polygon([(c * x - s * y, s * x + c * y) for x, y in corners])))
    assert scores[0] > 1.5 * scores[1]
