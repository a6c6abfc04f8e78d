"""Places selected by the signatures of their viewpoints, at every size."""

import functools
import math
from typing import get_args

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.simulate import office_floorplan
from signature.config import RelocalizeConfig, ShortlistBy
from signature.places.places import ORDER, SQUARE_M, PlaceIndex, Places, best_headings
from signature.places.query import Query, QueryMap
from signature.shown.page import compare_views
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})
OWN = next(iter(OFFICE.places.blocks()))
PLACES = len(OFFICE.places.table)


@functools.cache
def queries(field_deg: float = 360.0, every_m: float = 1.0) -> list[tuple[QueryMap, SE2]]:
    """What parts of a drive along the office have seen, and their frame there."""
    found, path_m = [], 0.0
    window, first = Query(OFFICE.made_with, OFFICE.config), None
    for registered, planar_scan, truth in drive(
        office(), [(1.5, 7.0), (18.0, 7.0)], field_rad=math.radians(field_deg)
    ):
        first = first or truth
        window.add(registered, planar_scan)
        if window.path_m - path_m >= every_m:
            path_m = window.path_m
            found.append((window.map(), first))
    return found


def right(query: QueryMap, T_map_query: SE2, reach_m: float = 1.5) -> np.ndarray:
    """The places next to the robot."""
    base_m = T_map_query.apply(np.array([query.center_m]))[0]
    return np.flatnonzero(np.hypot(*(OFFICE.places.table.center_m - base_m).T) <= reach_m)


def first(places: Places, query: QueryMap, index: PlaceIndex, most: int) -> np.ndarray:
    """The places that are likeliest by an index."""
    return np.argsort(-places.next_to(index.poses(query.views, query.center_m)), kind="stable")[:most]


def test_a_random_order_has_the_place_later() -> None:
    plans = {"office": office(), **{f"floor {seed}": office_floorplan(seed) for seed in (1, 2)}}
    places, rng, asked = building(plans).places, np.random.default_rng(0), queries(90.0)
    count = len(places.table)
    most = round(0.06 * count)  # about what 100 of 6 such floors are
    assert len(asked) > 10

    def share(index: PlaceIndex) -> float:
        chosen = [first(places, q, index, most) for q, _ in asked]
        return float(np.mean([np.isin(c, right(*each)).any() for c, each in zip(chosen, asked, strict=True)]))

    drawn = [np.isin(rng.permutation(count)[:most], right(q, T)).any() for q, T in asked]
    found = share(places.index())
    # All by signatures hold the place but one or two, of views into one direction that have seen little.
    assert found >= 0.9
    assert found >= np.mean(drawn) + 0.2
    assert found >= share(places.index().shuffled(rng)) + 0.2


def test_the_order_holds_every_place_once_and_all_of_the_mass() -> None:
    (query, _), *_ = queries()
    for views in (query.views, ()):
        rows, mass = OFFICE.places.order(views, query.center_m, RelocalizeConfig())
        assert sorted(rows.tolist()) == list(range(PLACES))
        assert (np.diff(mass) <= 0.0).all() and abs(mass.sum() - 1.0) < 1e-9
        # Of some queries the signatures say nothing, so every place has a share.
        share = ORDER.astray if views else 1.0
        assert mass.min() >= 0.999 * share / PLACES


def test_the_controls_have_the_place_later() -> None:
    """As by `relocalize --set relocalize.shortlist_by=shuffled`."""
    asked, found = queries(), {}
    for by in get_args(ShortlistBy):
        config = RelocalizeConfig.model_validate({"shortlist_by": by})
        places = building({"office": office()}).places
        rows = [places.order(query.views, query.center_m, config).rows for query, _ in asked]
        assert {len(chosen) for chosen in rows} == {PLACES}
        found[by] = np.mean([np.isin(r[:5], right(*each)).any() for r, each in zip(rows, asked, strict=True)])
    assert min(found["signatures"], found["boundary"]) >= max(found["shuffled"], found["random"]) + 0.2
    assert found["symmetry"] < found["boundary"]


def test_the_free_ground_next_to_a_place_is_searched() -> None:
    places = OFFICE.places
    (area,) = places.areas(np.array([3]))
    away_m, row = places.nearest(0, area.squares_m)
    assert len(area.squares_m) and (row == 3).all() and away_m.min() <= SQUARE_M
    (whole,) = places.areas(np.arange(PLACES))
    assert len(whole.squares_m) == len(places.ground(0)[0])


def test_maps_do_not_mix() -> None:
    """The same viewpoints in two maps: a pose in one of them is not supported by the other."""
    (query, _), *_ = queries()
    once, twice = PlaceIndex.of([OWN]), PlaceIndex.of([OWN, OWN])
    assert len(twice) == 2 * len(once)
    assert np.array_equal(twice.vectors, np.concatenate((once.vectors, once.vectors)))
    alone, both = (index.poses(query.views, query.center_m) for index in (once, twice))
    assert np.isclose(both.likelihood.max(), alone.likelihood.max(), atol=1e-3)
    assert set(both.block.tolist()) == {0, 1}
    columns = twice.vectors, twice.hidden, twice.at_m, twice.block
    assert sum(column.nbytes for column in columns) < 96 * len(twice)


def test_an_index_without_places_finds_none() -> None:
    (query, _), *_ = queries()
    empty = PlaceIndex.of([])
    assert len(empty) == 0 and len(empty.poses(query.views, query.center_m).likelihood) == 0


def test_the_views_of_a_query_agree_where_their_positions_do() -> None:
    """Two views, the second a lattice ahead of the first; viewpoints of two maps by their numbers:

    0 1 2 . . . . 3        5
                           4
    """
    #                 the first view likes, the second
    scores = np.array([(4, 0), (1, 0), (1, 3), (1, 0), (1, 0), (2, 5)], np.float32)
    squares = np.array([(0, 0), (1, 0), (2, 0), (7, 0), (3, -1), (3, 0)], np.float32)
    maps = np.array([0, 0, 0, 0, 1, 1], np.int32)
    raster = np.array([0, 1, 2, -1, -1, -1, -1, 3, 4, 5], np.int32)
    low, shape, begin = np.array([(0, 0), (3, -1)]), np.array([(8, 1), (1, 2)]), np.array([0, 8])
    steps = np.zeros((3, 2, 2, 2))  # heading, of view, to view
    for heading, ahead in enumerate([(0.9, 0.2), (-0.9, 0.2), (0.2, 0.9)]):
        steps[heading, 0, 1], steps[heading, 1, 0] = ahead, np.negative(ahead)
    #      too far from what the second likes; beside it; does not stand on itself; nothing is known beside
    put = [(0, 0, 4, None), (1, 0, 4, 0), (2, 0, 1, None), (3, 0, 1, None)]
    #       the other map goes north; there is nothing beyond it, to the south neither
    put += [(4, 0, 6, 2), (5, 0, 2, None), (4, 1, 0, None)]
    #       the second view, with the first behind it
    put += [(5, 1, 6, 2), (2, 1, 4, 0), (1, 1, 4, 0)]
    viewpoint, view = np.array([place for place, *_ in put]), np.array([of for _, of, *_ in put])
    found, heading = np.empty(len(put), np.float32), np.empty(len(put), np.int64)
    best_headings(scores, squares, maps, low, shape, begin, raster, viewpoint, view, steps, found, heading)
    assert found.tolist() == [best for *_, best, _ in put]
    assert all(at in (None, best) for at, best in zip((at for *_, at in put), heading.tolist(), strict=True))


# --- What explains a place: the signatures of the query on top of those of the map ---


SIGHT_M = 5.0
VIEWS_M = ((3.0, 7.0), (9.0, 7.0))
"""In the corridor of the office."""


def quarter_turned(grid: OccupancyGrid) -> tuple[OccupancyGrid, SE2]:
    """The same map in a frame that is turned by 90 degrees, and the pose of that frame in the map's."""
    cells = np.ascontiguousarray(np.rot90(grid.cells, axes=(1, 0)))
    turned = OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=(0.0, 0.0))
    # Row r, column c of the map is row c, column H - 1 - r of the turned one: x' = H - y, y' = x.
    return turned, SE2(0.0, grid.cells.shape[0] * grid.resolution_m, -math.pi / 2)


def test_where_the_query_is_the_map_all_signatures_coincide_and_speak_for_one_place() -> None:
    for view in compare_views(office(), VIEWS_M, office(), SE2(), SIGHT_M):
        for name in ("boundary", "freespace", "symmetry"):
            np.testing.assert_array_equal(view.query[name], view.map[name])
        assert view.log_ratio is not None and view.log_ratio > 0.0
        # Histograms are shares of all pairs.
        assert math.isclose(view.map["boundary"].sum(), 1.0, abs_tol=1e-6)
        assert math.isclose(view.map["freespace"].sum(), 1.0, abs_tol=1e-6)


def test_a_turned_query_is_shown_in_the_frame_of_the_map() -> None:
    grid, T_map_query = quarter_turned(office())
    views_m = [tuple(xy) for xy in T_map_query.inverse().apply(np.array(VIEWS_M)).tolist()]
    for view in compare_views(grid, views_m, office(), T_map_query, SIGHT_M):
        # Rays start at cells, so that a turned one may end 5 cm earlier, of the 0.5 m of a mirrored pair.
        assert np.abs(view.query["symmetry"] - view.map["symmetry"]).mean() < 0.05
        assert np.abs(view.query["boundary"] - view.map["boundary"]).sum() < 0.3
        assert view.log_ratio is not None and view.log_ratio > 0.0


def test_a_wrong_place_and_one_without_floor_can_be_told() -> None:
    (right, _), (wrong, _) = (
        compare_views(office(), VIEWS_M, office(), SE2(*at), SIGHT_M) for at in ((0.0, 0.0), (6.5, -4.0))
    )
    assert right.log_ratio is not None and wrong.log_ratio is not None
    assert wrong.log_ratio < right.log_ratio
    outside = compare_views(office(), VIEWS_M, office(), SE2(-100.0, 0.0), SIGHT_M)
    assert [view.log_ratio for view in outside] == [None, None]
    assert compare_views(office(), (), office(), SE2(), SIGHT_M) == ()
