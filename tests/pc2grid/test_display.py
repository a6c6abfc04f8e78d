"""Results in a notebook: one short line each, and a picture or table where there is one."""

import ast
import base64
import fcntl
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import pc2grid
from pc2grid.display import LONGEST_PX, html_table, map_png, short
from pc2grid.errors import ClusterError, ConfigError, TopicError, in_python
from pc2grid.geometry import SE2, hand_over
from pc2grid.io.atomic import replace_file
from pc2grid.model import Health, Loop, OccupancyGrid, RegisteredScan, Scan, SessionMap, Submap, Trajectory
from pc2grid.settings import load_settings
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_lab.truth import read_relations, relation_errors
from signature.config import Config
from signature.paper import Signature, SignatureTable
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


# --- Hints for the command line, read in Python ---


ROOT = Path(__file__).resolve().parents[2]


def hints() -> list[str]:
    """The texts of all hints of the library, without what is filled in."""
    found = []
    for file in (*ROOT.glob("pc2grid/**/*.py"), *ROOT.glob("signature/**/*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "hint":
                parts = [part.value for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
                found += [part for part in parts if isinstance(part, str)]
    return found


def test_no_hint_names_an_option_of_the_command_line_in_python() -> None:
    found = hints()
    assert len(found) > 100
    for hint in found:
        # What is in backticks is typed in a shell.
        said = re.sub(r"`[^`]*`", "", in_python(hint))
        assert not re.search(r"(^|\s|\()--[a-z]", said), said


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ("--set read.up=y says so", "config=Config(read={'up': 'y'}) says so"),
        ("--set read.floor_z=-0.4 (metres)", "config=Config(read={'floor_z': -0.4}) (metres)"),
        ("such as --topic /front,/rear, or", "such as config=Config(read={'topic': '/front,/rear'}), or"),
        ("check --start and --duration", "check span=TimeSpan(start_s, duration_s)"),
        ("--recover reads what is whole", "recover=True reads what is whole"),
        ("`pc2grid db copy --recover` keeps the rest", "`pc2grid db copy --recover` keeps the rest"),
        ("make: `pc2grid convert a.mcap -o b.submaps`", 'make: pc2grid.convert("a.mcap", "b.submaps")'),
    ],
)
def test_options_become_arguments(hint: str, said: str) -> None:
    assert in_python(hint) == said


def test_what_a_hint_says_works(tmp_path: Path) -> None:
    config = SimulationConfig(length_m=0.5, seed=3, clutter=0)
    simulate_session(tmp_path / "a.mcap", sensor="laser", grid=office(), config=config)
    wrong = pc2grid.Config.model_validate({"read": {"odometry": "/wrong"}})
    with pytest.raises(TopicError, match="odometry") as caught:
        pc2grid.convert(tmp_path / "a.mcap", tmp_path / "a.submaps", wrong)
    (argument,) = re.findall(r"config=(Config\(.*\}\))", str(caught.value))
    config = eval(argument, {"Config": pc2grid.Config})
    assert pc2grid.convert(tmp_path / "a.mcap", tmp_path / "a.submaps", config).session == "a"


# --- What the parts refuse, and with which words; what is left alone ---


GRID = OccupancyGrid(cells=np.zeros((2, 2)), resolution_m=0.05, origin_m=(0.0, 0.0))
STILL = Trajectory(stamps_ns=np.arange(3), T_session_base=np.stack([np.eye(4)] * 3))


@pytest.mark.parametrize(
    ("kind", "values", "words"),
    [
        (Scan, {"stamp_ns": 0, "points_m": np.ones((5, 2)), "T_base_sensor": np.eye(4), "sensor": "lidar"},
         r"Scan\.points_m: expected shape \('N', 3\), got \(5, 2\)"),
        (Trajectory, {"stamps_ns": np.arange(3), "T_session_base": np.stack([np.eye(4)] * 2)},
         r"Trajectory\.T_session_base: expected shape \(3, 4, 4\), got \(2, 4, 4\)"),
        (partial(replace, STILL), {"health": (Health.FINE,)},
         r"Trajectory\.health: expected 3 entries, got 1"),
        (partial(replace, GRID), {"resolution_m": math.nan},
         r"OccupancyGrid\.resolution_m: expected > 0, got nan"),
        (SessionMap, {"session": "a", "sensor": "map", "grid": GRID, "submaps": (), "trajectory": STILL,
                      "loops": (Loop(older=1, newer=3, T_older_newer=SE2(), information=np.eye(3)),)},
         r"SessionMap\.loops: expected poses of 0\.\.2, got 1 and 3"),
        (Signature, {"boundary": np.ones((1, 3)), "freespace": np.ones(3), "symmetry": np.ones(2)},
         r"Signature\.boundary: expected shape \('Nb',\), got \(1, 3\)"),
        (partial(SignatureTable.of, (), np.empty((0, 2))), {"submap_id": [1]},
         r"SignatureTable\.submap_id: expected shape \(0,\)"),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_together(kind: Any, values: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        kind(**values)


def test_other_code_cannot_change_the_arrays_of_a_frozen_type() -> None:
    points = np.ones((5, 3), np.float32)
    shown = points.view()
    shown.flags.writeable = False
    for given in (points, points[::-1], shown, memoryview(points)):
        scan = Scan(stamp_ns=0, points_m=np.asarray(given), T_base_sensor=np.eye(4), sensor="lidar")
        with pytest.raises(ValueError, match="read-only"):
            scan.points_m[0] = 2.0
        points[:] += 1.0
        assert np.ptp(scan.points_m) == 0.0 and scan.points_m[0, 0] == points[0, 0] - 1.0
    again = replace(scan, stamp_ns=1)
    assert again.points_m is scan.points_m  # nobody can write to it: no need for a copy
    mine = hand_over(np.zeros((2, 2), np.int8))
    assert OccupancyGrid(cells=mine, resolution_m=0.05, origin_m=(0.0, 0.0)).cells is mine
    from_bytes = np.frombuffer(bytes(4), np.int8).reshape(2, 2)
    assert OccupancyGrid(cells=from_bytes, resolution_m=0.05, origin_m=(0.0, 0.0)).cells is from_bytes


def test_settings_that_cannot_be_read(tmp_path: Path) -> None:
    for name, words in (("none.toml", "no such file"), (".", "cannot be read: Is a directory")):
        with pytest.raises(ConfigError, match=words):
            load_settings(Config, tmp_path / name)
    (tmp_path / "a.toml").write_bytes(b"[read]\ntopic = '\xff'\n")
    with pytest.raises(ConfigError, match=r"a\.toml: not TOML"):
        load_settings(Config, tmp_path / "a.toml")
    assert load_settings(Config, environment={}) == Config()


def test_what_a_killed_writer_left_is_swept_and_nothing_else(tmp_path: Path) -> None:
    swept = [".a.pc2grid-0123abcd.tmp", ".a.pc2grid-1.tmp"]
    kept = [
        ".a.pc2grid-fedc9876.tmp",  # somebody is at it
        ".a.pc2grid-x.tmp",
        ".a.pc2grid-0123abcd",
        ".b.pc2grid-0123abcd.tmp",
        ".a.pc2grid-00.tmp",  # a link to somebody's file
    ]
    for name in (*swept, *kept[:-1]):
        (tmp_path / name).touch()
    (tmp_path / kept[-1]).symlink_to(kept[0])
    with (tmp_path / kept[0]).open() as busy, replace_file(tmp_path / "b") as other:
        other.write_text("b")
        fcntl.flock(busy, fcntl.LOCK_EX)
        for content in ("new", "newer"):
            with replace_file(tmp_path / "a") as temporary:
                temporary.write_text(content)
            assert (tmp_path / "a").read_text() == content
    (tmp_path / "b").unlink()
    kept.remove(".b.pc2grid-0123abcd.tmp")  # by the writer of b
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["a", *kept])


def test_a_lost_worker_ends_all_and_what_is_stored_stays(tmp_path: Path) -> None:
    from signature.conversion_jobs import Job, _outcome

    def result() -> None:
        raise OSError("closed")

    job = Job(path=tmp_path / "a.mcap", name="a", config=Config())
    with pytest.raises(
        ClusterError, match=r"a worker was lost; .*a\.mcap and what follows it is not stored: OSError"
    ) as caught:
        _outcome(job, SimpleNamespace(result=result))
    assert caught.value.hint is not None and "the same command continues" in caught.value.hint


def test_relations_that_a_trajectory_says_nothing_of(tmp_path: Path) -> None:
    (tmp_path / "a.relations").write_text("# t1 t2 x y z roll pitch yaw\n\n5 6 1 0 0 0 0 0\n")
    relations = read_relations(tmp_path / "a.relations")
    nothing = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    for trajectory in (STILL, nothing):
        assert len(relations) == 1 and relation_errors(trajectory, relations).shape == (0, 2)
