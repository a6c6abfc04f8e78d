"""In a large database, only the maps that look like what the query sees are read and searched."""

import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import DatabaseCorrupt
from pc2grid.model import OccupancyGrid, SessionMap, Trajectory
from pc2grid.observer import Observer
from pc2grid.submaps.submaps import partition
from signature.config import Config
from signature.database import maintenance, open_database
from signature.localization.localizer import locate_map
from signature.places import map_index, places
from signature.places.map_index import MapIndex
from signature.places.query import query_of
from signature.sessions import add_session, provenance
from signature.visible import SeenPlaces, View
from tests.helpers.databases import sql
from tests.helpers.simulated_drives import building, office, plan

WALLS = np.random.default_rng(0).uniform(0, 12, (6, 5, 4)).round()
MAPS = {
    **{f"other{k}": plan(14, 12, [tuple(wall) for wall in walls]) for k, walls in enumerate(WALLS)},
    "office": office(),
}
PART = MAPS["office"].crop((8.0, 7.0), 5.0)


@functools.cache
def whole() -> MapIndex:
    """The index of all maps."""
    return building(MAPS)


@functools.cache
def seen() -> dict[str, SeenPlaces]:
    """What is seen from the places of each map, as a database stores it."""
    table, sight_m = whole().places.table, whole().places.sight_m
    return {
        name: SeenPlaces.of(grid, table.center_m[table.session_index == number], sight_m)
        for number, (name, grid) in enumerate(MAPS.items())
    }


def large(maps: Mapping[str, OccupancyGrid]) -> MapIndex:
    """All maps as a database gives them: with their areas, and what is seen in them."""
    areas_m2 = {name: grid.free_m2 for name, grid in MAPS.items()}
    made = whole().places.table, whole().made_with, Config()
    return MapIndex(maps, maps.__getitem__, *made, areas_m2=areas_m2, stored=seen().get)


class _Counted(Mapping[str, OccupancyGrid]):
    """The maps, and which of them were asked for."""

    def __init__(self) -> None:
        self.read: list[str] = []

    def __getitem__(self, name: str) -> OccupancyGrid:
        self.read.append(name)
        return MAPS[name]

    def __iter__(self) -> Iterator[str]:
        return iter(MAPS)

    def __len__(self) -> int:
        return len(MAPS)


@pytest.fixture(autouse=True)
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """The best eight places are compared at first."""
    monkeypatch.setattr(places, "FIRST_PLACES", 8)
    monkeypatch.setattr(map_index, "FIRST_PLACES", 8)


def test_few_maps_are_read_and_the_answer_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "AT_ONCE_M2", 2 * max(grid.free_m2 for grid in MAPS.values()))
    maps = _Counted()
    index = large(maps)
    assert maps.read == []
    answer = locate_map(PART, index)
    assert 1 <= len(maps.read) <= 3 and len(set(maps.read)) == len(maps.read) and "office" in maps.read
    monkeypatch.undo()
    expected = locate_map(PART, whole())
    assert answer.status == expected.status == "located" and answer.session == expected.session == "office"
    assert answer.T_map_base is not None and expected.T_map_base is not None
    apart = expected.T_map_base.inverse() @ answer.T_map_base  # refined from another proposal
    assert max(abs(apart.x), abs(apart.y), abs(apart.yaw)) < 1e-3


def test_a_map_larger_than_what_is_searched_at_once_is_still_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(places, "AT_ONCE_M2", 1.0)
    index = large(_Counted())
    assert locate_map(PART, index).session == "office"
    rows = index.places.order(query_views(), (0.0, 0.0), index.config).rows
    assert set(index.places.table.session_index[rows].tolist()) == {list(MAPS).index("office")}


def test_the_maps_that_were_used_last_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "AT_ONCE_M2", 1.0)
    monkeypatch.setattr(map_index, "AT_ONCE_M2", 0.25 * sum(grid.free_m2 for grid in MAPS.values()))
    maps = _Counted()
    index = large(maps)
    for number in (0, 1, 0, 2, 0, 1):  # two of seven are kept
        assert index.grid_of(number) is not None
    assert maps.read == ["other0", "other1", "other2", "other1"]


class News(Observer):
    """The progress and the warnings."""

    def __init__(self) -> None:
        self.shares: list[float] = []
        self.warnings: list[str] = []

    def on_progress(self, share: float) -> None:
        self.shares.append(share)

    def on_warning(self, text: str) -> None:
        self.warnings.append(text)


def store_maps(file: Path, maps: Mapping[str, OccupancyGrid]) -> None:
    """A database of drawn maps."""
    config = whole().made_with
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    for name, grid in maps.items():
        made = SessionMap(
            session=name, sensor="map", grid=grid, submaps=partition(grid, config.partition), trajectory=still
        )
        add_session(file, made, config, provenance(Path(name), "0" * 64, config))


def query_views() -> tuple[View, ...]:
    """The views of `PART`."""
    made_with = whole().made_with
    return query_of(PART, np.empty((0, 2)), made_with, made_with.relocalize).views


def test_a_stored_map_is_read_when_it_matters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "large.submaps"
    store_maps(file, {name: MAPS[name] for name in ("other0", "office")})
    monkeypatch.setattr(places, "AT_ONCE_M2", 1.0)
    monkeypatch.setattr(map_index, "AT_ONCE_M2", 1.0)
    with open_database(file) as database:
        read: list[str] = []
        take = database.grid
        monkeypatch.setattr(database, "grid", lambda name: (read.append(name), take(name))[1])
        answer = locate_map(PART, MapIndex.of(database, Config()))
    assert answer.session == "office" and read == ["office"]


def test_places_are_selected_by_what_is_stored_and_computed_where_it_is_not(tmp_path: Path) -> None:
    """A database of more places than are compared at first."""
    file, copied = tmp_path / "damaged.submaps", tmp_path / "copied.submaps"
    store_maps(file, MAPS)
    sql(file, "DELETE FROM part WHERE name = 'seen'")
    maintenance.copy(file, copied, recover=True)
    answers, news = {}, {}
    for path in (file, copied):
        news[path] = News()
        with open_database(path) as database:
            index = MapIndex.of(database, whole().made_with, news[path])
            answers[path] = locate_map(PART, index)
    assert answers[file].session == answers[copied].session == "office"
    assert answers[file].T_map_base == answers[copied].T_map_base
    (warning,) = news[file].warnings
    assert "damaged.submaps: lacks what is seen from the places of 7 of its 7 sessions" in warning
    assert news[copied].warnings == [] and news[copied].shares[-1] == 1.0


def test_damage_to_what_is_seen_costs_no_answer(tmp_path: Path) -> None:
    file = tmp_path / "x.submaps"
    store_maps(file, {"office": MAPS["office"]})
    sql(file, "UPDATE part SET crc32 = crc32 + 1 WHERE name = 'seen'")
    with open_database(file) as database:
        assert database.leave_out_damaged() == ()
        with pytest.raises(DatabaseCorrupt, match="wrong checksum"):
            database.seen_places("office")
        news = News()
        index = MapIndex.of(database, whole().made_with, news)
        assert locate_map(PART, index).status == "located"
    assert len(news.warnings) == 1
