"""Results in a notebook: one short line each, and a picture or table where there is one."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import pc2grid
from pc2grid.display import LONGEST_PX, html_table, map_png, short
from pc2grid.geometry import SE2
from pc2grid.model import Loop, OccupancyGrid, RegisteredScan, Scan, SessionMap, Submap, Trajectory
from tests.helpers.recordings import drive, write_mcap
from tests.helpers.session_maps import LOOPS, session, way
from tests.helpers.simulated_drives import office

LONGEST_LINE = 200


def decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image


def shown(page: str) -> np.ndarray:
    (data,) = re.findall(r"data:image/png;base64,([^\"]+)", page)
    return decoded(base64.b64decode(data))


@pytest.fixture(scope="module")
def monday() -> SessionMap:
    return session("monday", office(), way(), LOOPS)


def test_a_map_is_shown_as_drawn_north_up_and_without_what_is_unknown() -> None:
    cells = np.full((50, 60), -1, np.int8)
    cells[10:30, 20:50] = 0
    cells[10, 20:50] = 100  # the south wall
    cells[29, 21] = 50
    image = decoded(map_png(cells, 0.05, (0.0, 0.0)))
    rows, columns = image.shape[0] // 20, image.shape[1] // 30
    assert rows == columns > 1 and image.shape == (20 * rows, 30 * columns, 3)
    grey = image[rows // 2 :: rows, columns // 2 :: columns, 0].astype(int)
    assert (grey[-1] < 60).all() and (grey[1:-1] > 250).all()
    assert 100 < grey[0, 1] < 200  # undecided


def test_path_and_centres_are_drawn_where_they_are() -> None:
    cells = np.zeros((100, 200), np.int8)
    path_m, centers_m = np.array([[2.0, 1.0], [8.0, 1.0]]), np.array([[5.0, 4.0]])
    image = decoded(map_png(cells, 0.05, (0.0, 0.0), path_m=path_m, centers_m=centers_m))
    scale = image.shape[0] / 100
    row, column = round((100 - 1.0 / 0.05) * scale), round(5.0 / 0.05 * scale)
    assert (image[row, column] < (255, 255, 200)).any(), "the path"
    row = round((100 - 4.0 / 0.05) * scale)
    blue, green, red = (int(value) for value in image[row, column])
    assert green > blue > red, "the centre"


@pytest.mark.parametrize(("shape", "value"), [((1, 1), 0), ((3, 5000), 0), ((4000, 3000), 0), ((7, 9), -1)])
def test_a_picture_is_never_larger_than_a_notebook_is_wide(shape: tuple[int, int], value: int) -> None:
    image = decoded(map_png(np.full(shape, value, np.int8), 0.05, (0.0, 0.0)))
    assert 0 < max(image.shape[:2]) <= LONGEST_PX


def test_every_type_is_one_short_line(monday: SessionMap, tmp_path: Path) -> None:
    points = np.zeros((50_000, 3), np.float32)
    scan = Scan(stamp_ns=2**62, points_m=points, T_base_sensor=np.eye(4), sensor="lidar")
    long = session("a\nb" * 300, office(), way(), LOOPS)
    write_mcap(tmp_path / "a.mcap", drive())
    with pc2grid.open_log(tmp_path / "a.mcap") as log:
        things: dict[type, object] = {
            Scan: scan,
            RegisteredScan: RegisteredScan(scan=scan, T_session_base=np.eye(4)),
            Trajectory: monday.trajectory,
            OccupancyGrid: monday.grid,
            Submap: monday.submaps[3],
            Loop: Loop(
                older=1, newer=10**6, T_older_newer=SE2(1 / 3, -200 / 7, 2 / 3), information=np.eye(3)
            ),
            SessionMap: monday,
            pc2grid.Log: log,
        }
        for kind, thing in (*things.items(), (SessionMap, long)):
            text = repr(thing)
            assert text.startswith(f"{kind.__name__}(") and len(text) < LONGEST_LINE and "\n" not in text
        assert repr(log).startswith("Log('a.mcap', mcap/ros2, ")
        assert ">/points</td>" in log._repr_html_() and "sensor_msgs/PointCloud2" in log._repr_html_()
    assert repr(monday.trajectory) == "Trajectory(40 poses, 7.8 m in 3.9 s)"
    assert "'monday', laser, 7.8 m in 4 s" in repr(monday)


def test_a_map_without_a_robot(monday: SessionMap) -> None:
    nobody = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    plan = SessionMap(
        session="plan", sensor="map", grid=monday.grid, submaps=monday.submaps, trajectory=nobody
    )
    assert repr(nobody) == "Trajectory(0 poses, 0.0 m in 0.0 s)"
    assert "'plan', map, " in repr(plan)
    assert shown(plan._repr_html_()).size


def test_grid_and_submap_are_pictures_and_a_session_a_table_with_one(monday: SessionMap) -> None:
    assert decoded(monday.grid._repr_png_()).shape[2] == 3
    assert decoded(monday.submaps[0]._repr_png_()).size
    page = monday._repr_html_()
    assert '<td style="text-align:left">7.8 m in 4 s</td>' in page
    image, plain = shown(page), decoded(monday.grid._repr_png_())
    assert image.shape == plain.shape and (image != plain).any()


def test_what_stands_in_a_table_is_text_only() -> None:
    page = html_table("<b>", [("<script>", 1)], ("&", "x"))
    assert "<script>" not in page and "&lt;script&gt;" in page and "<caption>&lt;b&gt;" in page


def test_settings_show_what_differs_from_the_defaults() -> None:
    assert repr(pc2grid.Config()) == "Config()"
    changed = pc2grid.Config.model_validate({"partition": {"radius_m": 4.0}})
    assert repr(changed) == "Config(partition=PartitionConfig(radius_m=4.0))"
    partition = pc2grid.Config(partition=pc2grid.Config.paper().partition)
    assert len(repr(partition)) < LONGEST_LINE


def test_the_middle_of_a_long_name_is_left_out() -> None:
    assert short("monday") == "'monday'"
    assert len(short("m" * 500)) <= 63 and "..." in short("m" * 500)
