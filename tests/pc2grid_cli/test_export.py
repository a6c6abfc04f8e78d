"""`pc2grid export` in the formats of others, read back by the programs they are for or by their libraries."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from pc2grid.errors import OutputError, Pc2GridError
from pc2grid.io.building_file import building_points
from pc2grid.io.export import write_cloud
from pc2grid.io.trajectory import read_tum, write_tum
from pc2grid.model import Trajectory
from pc2grid.settings import ReadConfig
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid_cli.main import app
from signature.config import Config
from tests.helpers.building_clouds import room_cloud
from tests.helpers.databases import stored
from tests.helpers.session_maps import LOOPS, session, way
from tests.helpers.simulated_drives import office


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "office.submaps"
    return stored(path, session("office", office(), way(), LOOPS))


def test_points_of_a_session_are_exported_instead_of_its_walls(tmp_path: Path) -> None:
    cloud, room = tmp_path / "room.ply", tmp_path / "room.submaps"
    write_cloud(cloud, room_cloud(1.7))
    for options in (("--no-points",), ("--set", "projection.points_voxel_m=0.1")):
        made = ["convert", str(cloud), "-o", str(room), "--force", *options]
        assert CliRunner().invoke(app, made, catch_exceptions=False).exit_code == 0
        said = export(room, "--cloud", tmp_path / "out.ply", "--mcap", tmp_path / "out.mcap", "--force")
        (found,) = building_points(tmp_path / "out.ply", ReadConfig())
        with (tmp_path / "out.mcap").open("rb") as file:
            topics = {c.topic for c in make_reader(file).get_summary().channels.values()}
        assert ("/points" in topics) == (len(options) > 1)
        if len(options) > 1:
            assert "one a voxel of 0.1 m" in said
            assert 4000 < len(found) < 20_000
            assert np.quantile(found[:, 2], (0.01, 0.99)) == pytest.approx([0.0, 2.5], abs=0.05)
        else:
            assert "keeps no 3D points" in said and not found[:, 2].any()


def export(database: Path, *options: object) -> str:
    done = CliRunner().invoke(app, ["export", str(database), *map(str, options)], catch_exceptions=False)
    assert done.exit_code == 0
    return done.stderr


def test_tum_and_kitti_by_suffix(database: Path, tmp_path: Path) -> None:
    for name in ("a.tum", "b.kitti", "d.txt"):
        export(database, "--trajectory", tmp_path / name)
    for name in ("a.tum", "d.txt"):
        assert np.array_equal(read_tum(tmp_path / name).stamps_ns, way().stamps_ns)
    rows = np.loadtxt(tmp_path / "b.kitti").reshape(-1, 3, 4)
    assert np.allclose(rows, way().T_session_base[:, :3], atol=1e-8)


@pytest.mark.skipif(shutil.which("evo_traj") is None, reason="evo is not installed (GPL: only called)")
def test_evo_reads_trajectories_over_the_map(
    database: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export(database, "--trajectory", tmp_path / "t.tum", "--map", tmp_path / "m")
    export(database, "--trajectory", tmp_path / "t.kitti")
    monkeypatch.setenv("HOME", str(tmp_path))  # evo keeps settings there
    monkeypatch.setenv("MPLBACKEND", "agg")

    def evo(*words: str) -> str:
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True).stdout

    over_map = ("--ref", "t.tum", "--ros_map_yaml", "m.yaml", "--save_plot", "p.png", "--plot_mode", "xy")
    for words in (("tum", "t.tum", *over_map), ("kitti", "t.kitti")):
        assert "40 poses, 7.800m path length" in evo("evo_traj", *words)
    assert any(path.stat().st_size > 1000 for path in tmp_path.glob("p*.png"))
    # Beside a truth that jumps 0.1 m to and fro.
    beside = way().T_session_base.copy()
    beside[1::2, 1, 3] += 0.1
    write_tum(tmp_path / "truth.tum", replace(way(), T_session_base=beside))
    rmse = re.search(r"rmse\s+([0-9.]+)", evo("evo_ape", "tum", "truth.tum", "t.tum"))
    assert rmse is not None and float(rmse[1]) == pytest.approx(0.1 / 2**0.5, abs=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_walls_as_points(database: Path, tmp_path: Path, suffix: str) -> None:
    import open3d

    path = tmp_path / f"walls.{suffix}"
    said = export(database, "--cloud", path)
    assert "keeps no 3D points" in said
    points = np.asarray(open3d.io.read_point_cloud(str(path)).points)
    grid = office()
    assert np.allclose(points[:, :2], grid.to_point(np.argwhere(grid.occupied)), atol=1e-5)
    assert not points[:, 2].any()


def test_ways_as_a_graph(database: Path, tmp_path: Path) -> None:
    export(database, "--graph", tmp_path / "w.graphml")
    wanted = junction_graph(office(), Config().partition)
    graph = nx.read_graphml(tmp_path / "w.graphml", node_type=int)
    assert nx.utils.edges_equal(graph.edges, wanted.edges)
    for node, about in wanted.nodes(data=True):
        assert (graph.nodes[node]["x_m"], graph.nodes[node]["y_m"]) == about["center_m"]
        assert graph.nodes[node]["kind"] == about["kind"]
    assert all(graph.edges[e]["length_m"] == wanted.edges[e]["length_m"] for e in wanted.edges)


def read_g2o(path: Path) -> tuple[dict[int, np.ndarray], list[tuple[int, int, np.ndarray, np.ndarray]]]:
    """Vertices and edges (from, to, transform, information) by the words of g2o's own documentation."""

    def matrix(x: float, y: float, yaw: float) -> np.ndarray:
        return np.array([[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0, 0, 1]])

    vertices, edges = {}, []
    for line in path.read_text().splitlines():
        tag, *words = line.split()
        if tag == "VERTEX_SE2":
            vertices[int(words[0])] = matrix(*map(float, words[1:]))
        else:
            assert tag == "EDGE_SE2" and len(words) == 11
            a, b, c, d, e, f = map(float, words[5:])
            information = np.array([[a, b, c], [b, d, e], [c, e, f]])
            edges.append((int(words[0]), int(words[1]), matrix(*map(float, words[2:5])), information))
    return vertices, edges


def test_the_pose_graph_for_g2o(database: Path, tmp_path: Path) -> None:
    export(database, "--g2o", tmp_path / "poses.g2o", "--trajectory", tmp_path / "poses.tum")
    vertices, edges = read_g2o(tmp_path / "poses.g2o")
    truth = way().T_session_base[:, [[0], [1], [3]], [0, 1, 3]]
    assert np.allclose([vertices[k] for k in range(len(vertices))], truth, atol=1e-8)
    assert len(vertices) == len(read_tum(tmp_path / "poses.tum")) == 40
    steps, loops = edges[:39], edges[39:]
    assert [(a, b) for a, b, *_ in steps] == [(k, k + 1) for k in range(39)]
    for a, b, transform, information in steps:
        assert np.allclose(vertices[a] @ transform, vertices[b], atol=1e-7)
        assert np.linalg.eigvalsh(information)[0] > 0
    trust = np.array([information[0, 0] for *_, information in steps])
    lost = np.array([b >= 15 and a < 20 for a, b, *_ in steps])  # of `way`
    assert np.allclose(trust[~lost], trust[0]) and np.allclose(trust[lost], 1e-3 * trust[0])
    accepted = [loop for loop in LOOPS if loop.accepted]
    for loop, (a, b, transform, information) in zip(accepted, loops, strict=True):
        assert (a, b) == (loop.older, loop.newer)
        assert np.allclose(transform, loop.T_older_newer.matrix(), atol=1e-8)
        assert np.allclose(information, loop.information, rtol=1e-8)
        assert np.abs(vertices[a] @ transform - vertices[b]).max() < 0.03


def test_gtsam_reads_the_pose_graph(database: Path, tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam", reason="GTSAM is not installed")
    export(database, "--g2o", tmp_path / "poses.g2o")
    graph, initial = gtsam.readG2o(str(tmp_path / "poses.g2o"), False)
    assert (graph.size(), initial.size()) == (39 + 2, 40)
    # Steps agree with the poses; what is left is what the two loops would still like to move.
    error = np.array([0.01, -0.02, 0.003])
    assert graph.error(initial) == pytest.approx(error @ LOOPS[0].information @ error, rel=0.01)


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"\.ply or \.pcd"):
        write_cloud(tmp_path / "x.las", np.zeros((1, 3)))
    assert list(tmp_path.iterdir()) == []


def test_a_trajectory_that_is_not_there_stops_everything(tmp_path: Path) -> None:
    nowhere = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    stored(tmp_path / "p.submaps", session("plan", office(), nowhere))
    for option, name in (("--trajectory", "t.tum"), ("--g2o", "p.g2o")):
        options = ["--map", str(tmp_path / "m"), option, str(tmp_path / name)]
        done = CliRunner().invoke(app, ["export", str(tmp_path / "p.submaps"), *options])
        assert isinstance(done.exception, Pc2GridError) and "no trajectory" in str(done.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["p.submaps"]
