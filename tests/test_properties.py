"""Laws that hold for any input: of poses, of settings, of what is written and read back."""

import math
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from pydantic import ValidationError

from pc2grid.errors import ConfigError
from pc2grid.geometry import (
    SE2,
    interpolate_pose,
    invert_pose,
    pose_from_rotation_vector,
    pose_from_xyz_quat,
    quat_xyzw_from_pose,
    rotation_vector,
    transform_points,
    wrap_angle,
)
from pc2grid.io.maps import save_map
from pc2grid.io.trajectory import write_kitti
from pc2grid.model import SensorKind, Trajectory
from pc2grid.settings import Section, dump_settings, load_settings
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from tests.helpers.rooms import small_house

METRES = st.floats(-1e4, 1e4)
ANGLES = st.floats(-10, 10)
PLANAR = st.builds(SE2, METRES, METRES, ANGLES)
TURNS = st.lists(st.floats(-math.pi, math.pi), min_size=3, max_size=3).map(np.array)


@st.composite
def spatial(draw: st.DrawFn) -> np.ndarray:
    rotation = draw(TURNS)
    norm = float(np.linalg.norm(rotation))
    scaled = rotation * min(1.0, 3.1 / norm) if norm else rotation
    return pose_from_rotation_vector(scaled, draw(st.lists(METRES, min_size=3, max_size=3)))


def assert_same(a: SE2, b: SE2) -> None:
    assert a.x == pytest.approx(b.x, abs=1e-7)
    assert a.y == pytest.approx(b.y, abs=1e-7)
    assert abs(wrap_angle(a.yaw - b.yaw)) < 1e-9


# --- poses --------------------------------------------------------------------------------------------


@given(st.floats(-1e6, 1e6))
def test_an_angle_is_wrapped_to_itself(angle_rad: float) -> None:
    wrapped = wrap_angle(angle_rad)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle_rad), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle_rad), abs=1e-9)
    assert wrap_angle(wrapped) == wrapped


@given(PLANAR, PLANAR, PLANAR)
def test_planar_poses_are_a_group(a: SE2, b: SE2, c: SE2) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ SE2(), a)
    assert_same(SE2() @ a, a)
    assert_same(a @ a.inverse(), SE2())
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(PLANAR, PLANAR, st.lists(st.tuples(METRES, METRES), max_size=5))
def test_planar_poses_act_on_points(a: SE2, b: SE2, points: list[tuple[float, float]]) -> None:
    xy = np.array(points, float).reshape(-1, 2)
    np.testing.assert_allclose((a @ b).apply(xy), a.apply(b.apply(xy)), atol=1e-7)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-7)
    homogeneous = np.column_stack((xy, np.ones(len(xy)))) @ a.matrix().T
    np.testing.assert_allclose(a.apply(xy), homogeneous[:, :2], atol=1e-7)
    assert_same(SE2.from_matrix(a.lift()), a)
    moved, kept = a.apply(xy), np.linalg.norm(np.diff(xy, axis=0), axis=1)
    np.testing.assert_allclose(np.linalg.norm(np.diff(moved, axis=0), axis=1), kept, atol=1e-7)


@given(PLANAR, st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=3, max_size=8))
def test_fitting_finds_the_pose_that_moved_the_points(a: SE2, points: list[tuple[float, float]]) -> None:
    xy = np.array(points)
    assume(np.linalg.norm(xy - xy.mean(axis=0), axis=1).max() > 1.0)
    np.testing.assert_allclose(SE2.fit(xy, a.apply(xy)).apply(xy), a.apply(xy), atol=1e-6)


@settings(deadline=None)
@given(spatial(), spatial())
def test_spatial_poses(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(a @ invert_pose(a), np.eye(4), atol=1e-7)
    quat = quat_xyzw_from_pose(a)
    assert np.linalg.norm(quat) == pytest.approx(1.0)
    assert quat[3] >= 0
    np.testing.assert_allclose(pose_from_xyz_quat(a[:3, 3], quat), a, atol=1e-9)
    np.testing.assert_allclose(pose_from_xyz_quat(a[:3, 3], -7 * quat), a, atol=1e-9)
    np.testing.assert_allclose(pose_from_rotation_vector(rotation_vector(a), a[:3, 3]), a, atol=1e-7)
    points = np.random.default_rng(0).uniform(-9, 9, (4, 3))
    moved = transform_points(a @ b, points)
    np.testing.assert_allclose(moved, transform_points(a, transform_points(b, points)), atol=1e-7)


@settings(deadline=None)
@given(spatial(), spatial(), st.floats(0, 1))
def test_between_two_poses(a: np.ndarray, b: np.ndarray, fraction: float) -> None:
    np.testing.assert_allclose(interpolate_pose(a, b, 0.0), a, atol=1e-7)
    np.testing.assert_allclose(interpolate_pose(a, b, 1.0), b, atol=1e-6)
    between = interpolate_pose(a, b, fraction)
    line = (1 - fraction) * a[:3, 3] + fraction * b[:3, 3]
    np.testing.assert_allclose(between[:3, 3], line, atol=1e-6)
    np.testing.assert_allclose(between[:3, :3] @ between[:3, :3].T, np.eye(3), atol=1e-9)


# --- files --------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.lists(spatial(), max_size=4))
def test_kitti_survives(poses: list[np.ndarray]) -> None:
    T = np.array(poses).reshape(-1, 4, 4)
    before = Trajectory(stamps_ns=np.arange(len(T)), T_session_base=T)
    with tempfile.TemporaryDirectory() as folder:
        write_kitti(Path(folder) / "p.txt", before)
        rows = [line.split() for line in (Path(folder) / "p.txt").read_text().splitlines()]
    found = np.array(rows, float).reshape(-1, 3, 4)
    np.testing.assert_allclose(found, T[:, :3], rtol=1e-8, atol=1e-9)


# --- settings -----------------------------------------------------------------------------------------


def values(annotation: Any, default: Any) -> st.SearchStrategy[Any]:
    """Values that a setting may take, by its type; not all of them are within its range."""
    if get_origin(annotation) is Literal:
        return st.sampled_from(get_args(annotation))
    if get_origin(annotation) is not None and type(None) in get_args(annotation):
        rest = next(a for a in get_args(annotation) if a is not type(None))
        return st.none() | values(rest, default)
    if annotation is bool:
        return st.booleans()
    if annotation is int:
        return st.integers(0, 2 * (default or 50))
    if annotation is float:
        return st.floats(0, 4 * (default or 1.0)) | st.sampled_from([1e-7, 1e22, 0.1 + 0.2])
    if annotation is str:
        return st.text(max_size=12)
    return st.just(default)


SETTINGS = [
    (name, key, values(info.annotation, info.default))
    for name, field in Config.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
    for key, info in field.annotation.model_fields.items()
]


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_settings_survive_their_dump(data: st.DataObject) -> None:
    tree: dict[str, dict[str, Any]] = {}
    for name, key, strategy in data.draw(st.lists(st.sampled_from(SETTINGS), min_size=1, max_size=12)):
        tree.setdefault(name, {})[key] = data.draw(strategy, label=f"{name}.{key}")
    try:
        wanted = Config.model_validate(tree)
    except ValidationError:
        assume(False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "settings.toml"
        path.write_text(dump_settings(wanted), encoding="utf-8")
        assert load_settings(Config, path, (), {}) == wanted
    assert Config.model_validate_json(wanted.model_dump_json()) == wanted


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_no_file_of_settings_breaks_anything(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "settings.toml"
        path.write_bytes(content)
        try:
            assert load_settings(Config, path, (), {}) == Config()
        except ConfigError as error:
            assert str(path) in error.message
            assert "\n" not in error.message


@settings(max_examples=80, deadline=None)
@given(st.text(max_size=20), st.text(max_size=20))
def test_no_assignment_breaks_anything(key: str, value: str) -> None:
    for text in (f"{key}={value}", f"read.topic={value}", f"partition.{key}={value}", key):
        try:
            load_settings(Config, None, [text], {})
        except ConfigError as error:
            assert error.message


# --- Same input, configuration and version: the same bytes ---


ROOT = Path(__file__).resolve().parent.parent
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")


def convert(*inputs: Path, output: Path, hash_seed: int, threads: int | None = None) -> bytes:
    """A fresh process, as sets and dictionaries must not leave their order in the result either.

    threads : what the user says of all libraries; None: nothing.
    """
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    if threads is not None:
        environment |= dict.fromkeys(THREADS, str(threads))
    done = subprocess.run(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", "convert", *inputs,
         "-o", output],
        cwd=output.parent, capture_output=True, text=True, timeout=240,
        env={
            **environment, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PC2GRID_CONFIG": "",
            "PYTHONHASHSEED": str(hash_seed),
        },
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return output.read_bytes()


def test_recordings_and_a_map_give_the_same_database_again(tmp_path: Path) -> None:
    """Of each sensor; in two folders, by two processes at once, each slowed down by the other at another
    place each time: no path, clock, number of a process or of its threads is in the bytes."""
    lengths_m: dict[SensorKind, float] = {"laser": 1.5, "lidar": 0.4, "depth": 0.8}
    (tmp_path / "1").mkdir()
    for sensor, length_m in lengths_m.items():
        config = SimulationConfig(length_m=length_m, seed=3, clutter=2)
        simulate_session(tmp_path / "1" / f"{sensor}.mcap", sensor=sensor, grid=small_house(), config=config)
    save_map(small_house(), tmp_path / "1" / "house")
    shutil.copytree(tmp_path / "1", tmp_path / "2")

    def made(number: int) -> bytes:
        folder = tmp_path / str(number)
        inputs = [*(folder / f"{sensor}.mcap" for sensor in lengths_m), folder / "house.yaml"]
        os.utime(inputs[-1], (number * 1000, number * 1000))
        threads = 1 if number == 1 else None
        return convert(*inputs, output=folder / "x.submaps", hash_seed=number, threads=threads)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(made, (1, 2))
    assert first == second
    assert sorted(path.name for path in tmp_path.glob("*/.*")) == []


def test_a_simulated_recording_is_the_same_again(tmp_path: Path) -> None:
    config = SimulationConfig(length_m=0.6, seed=3, clutter=2)
    for name in ("a", "b"):
        simulate_session(tmp_path / f"{name}.mcap", sensor="laser", grid=small_house(), config=config)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
