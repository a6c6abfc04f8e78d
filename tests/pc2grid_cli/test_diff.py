"""`pc2grid diff`: a building in which a wall came, said, drawn and written."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.config import ReadConfig
from pc2grid.errors import Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.io.building_file import building_points
from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from signature.config import Config
from signature.database import maintenance
from signature.database.protocol import BuildingFrame
from signature.sessions import add_sessions, provenance
from tests.helpers.json_schema import closed
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import office

EXACT = ((0.0, 0.0, 0.0),) * 3
MOVED = SE2(-2.0, 3.0, 0.0)
"""T_building_session of friday: whole cells, so nothing is drawn anew."""
WALL = ((60, 64), (150, 210))
"""Rows and columns of the office, in a room."""


def with_wall(grid: OccupancyGrid) -> OccupancyGrid:
    cells = grid.cells.copy()
    rows, columns = WALL
    assert (cells[slice(*rows), slice(*columns)] == 0).all(), "the wall stands on free ground"
    cells[slice(*rows), slice(*columns)] = OCCUPIED
    x, y = grid.origin_m
    return OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=(x - MOVED.x, y - MOVED.y))


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("diff") / "office.submaps"
    maps = {"monday": office(), "friday": with_wall(office())}
    entries = [
        (session(name, grid, way()), provenance(Path(f"{name}.mcap"), name[0] * 64, Config()))
        for name, grid in maps.items()
    ]
    add_sessions(path, entries, Config(), keep=False)
    return path


@pytest.fixture(scope="module")
def joined(database: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joined") / "office.submaps"
    maintenance.copy(database, path)
    poses = {"monday": SE2(), "friday": MOVED}
    frames = {
        name: BuildingFrame(name="monday", T_building_session=pose, covariance=EXACT)
        for name, pose in poses.items()
    }
    maintenance.place(path, frames)
    return path


def diff(*words: object) -> str:
    result = CliRunner().invoke(app, ["diff", *map(str, words)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def middle_m() -> tuple[float, float]:
    grid = office()
    (r0, r1), (c0, c1) = WALL
    x, y = grid.to_point(np.array([(r0, c0), (r1 - 1, c1 - 1)])).mean(axis=0)
    return float(x), float(y)


def test_a_wall_that_came(joined: Path) -> None:
    document = json.loads(diff(joined, "monday", "friday", "--json"))
    jsonschema.validate(document, closed(schema("diff")))
    (wall,) = document["changes"]
    cell_m = office().resolution_m
    assert wall["kind"] == "came" and wall["probability"] > 0.99
    assert wall["center_m"] == pytest.approx(middle_m(), abs=cell_m)
    assert (wall["length_m"], wall["width_m"]) == pytest.approx((60 * cell_m, 4 * cell_m), abs=cell_m)
    assert document["came_m2"] == pytest.approx(240 * cell_m**2, rel=0.05)
    assert (document["went_m2"], document["frame"]) == (0.0, "monday")
    back = json.loads(diff(joined, "friday", "monday", "--json"))
    assert [change["kind"] for change in back["changes"]] == ["went"]
    assert "1 thing came" in diff(joined, "monday", "friday")


def test_files_by_their_endings(joined: Path, tmp_path: Path) -> None:
    names = ("changes.png", "changes.geojson", "changes.pcd", "changes.ply")
    diff(joined, "monday", "friday", *(word for name in names for word in ("-o", tmp_path / name)))
    picture = cv2.imread(str(tmp_path / names[0]))
    vermillion = np.array((0x00, 0x5E, 0xD5))  # blue, green, red of "came"
    assert (np.abs(picture.astype(int) - vermillion).max(axis=2) < 10).sum() > 50
    features = json.loads((tmp_path / names[1]).read_text())["features"]
    (wall,) = [feature for feature in features if feature["properties"]["kind"] == "came"]
    (ring,) = wall["geometry"]["coordinates"]
    assert ring[0] == ring[-1] and np.mean(ring[:-1], axis=0) == pytest.approx(middle_m(), abs=0.05)
    stood = next(f["geometry"]["coordinates"] for f in features if f["properties"]["kind"] == "stood")
    for name in names[2:]:
        (points,) = building_points(tmp_path / name, ReadConfig())
        assert len(points) == len(stood) + 240


def test_points_of_a_pcd_have_their_kind_as_intensity(joined: Path, tmp_path: Path) -> None:
    diff(joined, "friday", "monday", "-o", tmp_path / "changes.pcd")
    data = (tmp_path / "changes.pcd").read_bytes().split(b"DATA binary\n")[1]
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    assert set(points[:, 3]) == {-1.0, 0.0}
    went_m = points[points[:, 3] == -1.0, :2].mean(axis=0)
    assert went_m == pytest.approx(middle_m(), abs=0.05)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("monday", "friday"), "not joined.*pc2grid db join"),
        (("monday", "monday"), "compared with itself"),
        (("monday", "sunday"), "no session 'sunday'.*'monday', 'friday'"),
        (("monday", "2001-01-01"), "no joined session was recorded on 2001-01-01"),
        (("monday", "friday", "-o", "out.las"), "does not write the format .las.*geojson"),
    ],
)
def test_what_cannot_be_compared(database: Path, words: tuple[str, ...], said: str) -> None:
    with pytest.raises(Pc2GridError, match=said):
        diff(database, *words)


def test_all_sessions_of_a_day(joined: Path) -> None:
    """All are of one day here, the first of the epoch, so it holds monday twice."""
    with pytest.raises(Pc2GridError, match="'monday' is compared with itself"):
        diff(joined, "monday", "1970-01-01")
