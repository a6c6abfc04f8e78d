"""What `--plot` draws: evidence in its colours, nothing in the legend that is not in the picture."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from pc2grid.geometry import SE2
from pc2grid.io.maps import save_map
from pc2grid.model import OccupancyGrid
from signature.config import Config
from signature.database import SubmapDatabase, open_database
from signature.database.protocol import BuildingFrame
from signature.sessions import find
from signature.shown.page import Found
from signature.shown.picture import (
    BLUE,
    FREE,
    FURNITURE,
    GREEN,
    ORANGE,
    PALETTE,
    PURPLE,
    UNKNOWN,
    VERMILLION,
    WALL,
    draw_answer,
    draw_building,
    draw_session,
    drawn_as,
)
from tests.helpers.databases import stored
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, part
from tests.helpers.nav2_map import as_mapped, nav2_map
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import changed_part, cut, office, plan


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> SubmapDatabase:
    path = tmp_path_factory.mktemp("picture") / "office.submaps"
    return open_database(stored(path, session("office", office(), way())))


def located(grid: OccupancyGrid, database: SubmapDatabase, folder: Path) -> Found:
    save_map(grid, folder / "query")
    return find(folder / "query.yaml", database, Config())


def larger_part() -> OccupancyGrid:
    """The changed part; below y = 0 the map ends, and the query has seen another wall there."""
    cells = changed_part().cells
    beyond = np.zeros((40, cells.shape[1]), np.int8)
    beyond[0:2] = 100
    return OccupancyGrid(cells=np.vstack((beyond, cells)), resolution_m=0.05, origin_m=(0.0, 0.0))


def pixels_of(path: Path, colour: str) -> int:
    image = cv2.imread(str(path)).astype(int)
    wanted = np.array([int(colour[k : k + 2], 16) for k in (5, 3, 1)])
    return int((np.abs(image - wanted).max(axis=-1) < 12).sum())


def labels_of(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The labels of the legend of the next picture."""
    seen: list[str] = []
    legend = Figure.legend

    def listening(self: Figure, handles: object, labels: list[str], **kind: object) -> object:
        seen.extend(labels)
        return legend(self, handles, labels, **kind)

    monkeypatch.setattr(Figure, "legend", listening)
    return seen


def test_walls_have_the_colour_of_what_the_map_says_about_them(
    database: SubmapDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = located(larger_part(), database, tmp_path)
    assert found.status == "located"
    labels = labels_of(monkeypatch)
    draw_answer(tmp_path / "a.png", database, found, found.poses)
    drawn = {colour: pixels_of(tmp_path / "a.png", colour) for colour in (GREEN, VERMILLION, BLUE, ORANGE)}
    assert min(drawn.values()) > 20
    assert drawn[GREEN] > 5 * drawn[VERMILLION]
    assert {
        "query's wall: fits the map",
        "query's wall: on free ground of the map",
        "query's wall: unknown to the map",
        "map's wall: the query saw free ground",
    } <= set(labels)
    assert len(labels) == len(set(labels))


def test_the_picture_is_the_map_that_nav2_gets_and_tells_furniture_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = as_mapped(office())
    save_map(grid, tmp_path / "map")
    cells, *_ = nav2_map(tmp_path / "map.yaml")
    drawn = drawn_as(grid)
    for told, kinds in ((0, {FREE}), (-1, {UNKNOWN}), (100, {WALL, FURNITURE})):
        assert set(drawn[cells == told]) == kinds
    assert set(drawn[grid.things]) == {FURNITURE}

    for name, there in (("bare", False), ("furnished", True)):
        made = session(name, grid if there else office(), way())
        labels = labels_of(monkeypatch)
        with open_database(stored(tmp_path / f"{name}.submaps", made)) as opened:
            draw_session(tmp_path / f"{name}.png", opened, name)
        assert ("map's furniture: an obstacle, no wall" in labels) == there
        colour = "#" + bytes(PALETTE[FURNITURE].tolist()).hex()
        assert (pixels_of(tmp_path / f"{name}.png", colour) > 100) == there


def test_a_map_as_the_query_has_no_last_scan_and_no_path(
    database: SubmapDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = located(cut(office(), 4.0, 3.0, 15.0, 12.0), database, tmp_path)
    labels = labels_of(monkeypatch)
    draw_answer(tmp_path / "a.png", database, found, found.poses)
    assert "frame of the query" in labels
    assert not [label for label in labels if "last scan" in label or "query: path" in label]
    # A part of the very map is contradicted nowhere, so the legend does not name this.
    assert (
        "query's wall: on free ground of the map" not in labels
        and "map's wall: the query saw free ground" not in labels
    )


def test_without_a_hypothesis_there_is_only_the_map(
    database: SubmapDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = located(plan(8, 5, []), database, tmp_path)
    none = replace(found, status="not_found", places=())
    labels = labels_of(monkeypatch)
    draw_answer(tmp_path / "a.png", database, none, found.poses)
    assert labels == ["path of the map's robot"]
    assert pixels_of(tmp_path / "a.png", PURPLE) == 0


def test_a_small_query_is_also_shown_from_near(database: SubmapDatabase, tmp_path: Path) -> None:
    part, whole = cut(office(), 4.0, 3.0, 9.0, 8.5), cut(office(), 0.5, 0.5, 19.0, 13.0)
    for name, grid in (("near", part), ("far", whole)):
        found = located(grid, database, tmp_path)
        draw_answer(tmp_path / f"{name}.png", database, found, found.poses)
    near, far = (cv2.imread(str(tmp_path / f"{name}.png")).shape for name in ("near", "far"))
    assert near[0] * near[1] > 1.3 * far[0] * far[1]


def test_joined_maps_have_two_colours_that_lie_on_each_other_only_once_they_are_joined(
    tmp_path: Path,
) -> None:
    def frame(T_building_session: SE2) -> BuildingFrame:
        variances = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-6))
        return BuildingFrame(name="west", T_building_session=T_building_session, covariance=variances)

    west, east = part(WEST), in_frame(part(EAST), T_OFFICE_EAST)
    joined = {"west": (west, frame(SE2(0.0, 0.0, 0.0))), "east": (east, frame(T_OFFICE_EAST))}
    draw_building(tmp_path / "joined.png", "west", joined)
    image = cv2.imread(str(tmp_path / "joined.png")).astype(int)
    shares = []
    for half in (image[:, : image.shape[1] // 2], image[:, image.shape[1] // 2 :]):
        blue, orange = (
            np.abs(half - [int(colour[k : k + 2], 16) for k in (5, 3, 1)]).max(axis=-1) < 12
            for colour in (BLUE, ORANGE)
        )
        assert blue.sum() > 1000 and orange.sum() > 1000
        near_blue = cv2.dilate(blue.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        shares.append((orange & near_blue).sum() / orange.sum())
    before, after = shares
    assert before < 0.25 < 0.4 < after, "half of the walls of the east are also in the west"


@pytest.mark.parametrize("name", ["session", "answer"])
def test_no_band_of_a_picture_is_empty(name: str, database: SubmapDatabase, tmp_path: Path) -> None:
    if name == "session":
        draw_session(tmp_path / "a.png", database, "office")
    else:
        found = located(larger_part(), database, tmp_path)
        draw_answer(tmp_path / "a.png", database, found, found.poses)
    drawn = cv2.imread(str(tmp_path / "a.png")).min(axis=-1) < 250
    for axis in (0, 1):
        used = np.flatnonzero(drawn.any(axis=1 - axis))
        longest = np.diff(np.concatenate(([0], used, [drawn.shape[axis]]))).max()
        assert longest < 0.06 * max(drawn.shape)
