"""In a large database, only the maps that look like what the query sees are read and searched."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from pc2grid.model import OccupancyGrid, SessionMap, Trajectory
from pc2grid.submaps.partition import partition
from signature.config import Config
from signature.database import open_database
from signature.relocalization import map_index as building_file
from signature.relocalization.relocalizer import MapIndex, locate_map
from signature.retrieval import viewpoints
from signature.sessions import add_session, provenance
from tests.helpers.simulated_drives import building, office, plan

WALLS = np.random.default_rng(0).uniform(0, 12, (6, 5, 4)).round()
MAPS = {
    **{f"other{k}": plan(14, 12, [tuple(wall) for wall in walls]) for k, walls in enumerate(WALLS)},
    "office": office(),
}
ALL = building(MAPS)
PART = MAPS["office"].crop((8.0, 7.0), 5.0)


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


def test_few_maps_are_read_and_the_answer_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    areas_m2 = {name: float(grid.free.sum()) * 0.05**2 for name, grid in MAPS.items()}
    monkeypatch.setattr(viewpoints, "AT_ONCE_M2", 2 * max(areas_m2.values()))
    maps = _Counted()
    large = MapIndex(maps, ALL.places.table, ALL.made_with, Config(), areas_m2=areas_m2)
    assert maps.read == []
    answer = locate_map(PART, large)
    assert 1 <= len(maps.read) <= 3 and len(set(maps.read)) == len(maps.read) and "office" in maps.read
    monkeypatch.undo()
    expected = locate_map(PART, ALL)
    assert answer.status == expected.status == "located" and answer.session == expected.session == "office"
    assert answer.T_map_base == expected.T_map_base


def test_a_map_larger_than_what_is_searched_at_once_is_still_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewpoints, "AT_ONCE_M2", 1.0)
    areas_m2 = {name: float(grid.free.sum()) * 0.05**2 for name, grid in MAPS.items()}
    maps = _Counted()
    answer = locate_map(PART, MapIndex(maps, ALL.places.table, ALL.made_with, Config(), areas_m2=areas_m2))
    assert answer.session == "office" and maps.read == ["office"]


def test_a_stored_map_is_read_when_it_matters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, config = tmp_path / "large.submaps", ALL.made_with
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    for name in ("other0", "office"):
        grid = MAPS[name]
        made = SessionMap(
            session=name,
            sensor="map",
            grid=grid,
            submaps=partition(grid, config.partition),
            trajectory=still,
        )
        add_session(file, made, config, provenance(Path(name), "0" * 64, config))
    monkeypatch.setattr(viewpoints, "AT_ONCE_M2", 1.0)
    monkeypatch.setattr(building_file, "AT_ONCE_M2", 1.0)
    with open_database(file) as database:
        read: list[str] = []
        take = database.grid
        monkeypatch.setattr(database, "grid", lambda name: (read.append(name), take(name))[1])
        answer = locate_map(PART, MapIndex.of(database, config))
    assert answer.session == "office" and read == ["office"]
