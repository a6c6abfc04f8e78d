"""Maps against a second, independent reading of nav2's rules; trajectories there and back."""

from __future__ import annotations

import math
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pc2grid.errors import MapFileError, TrajectoryFileError
from pc2grid.io.maps import is_map_file, load_map, save_map
from pc2grid.io.trajectory import read_tum, stamp_ns_from_text, stamp_text, write_tum
from pc2grid.model import THING, OccupancyGrid, Trajectory
from tests.helpers.nav2_map import nav2_map, oracle

GOOD: dict[str, Any] = {
    "image": "m.pgm",
    "resolution": 0.05,
    "origin": [0, 0, 0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_map(folder: Path, keys: dict[str, Any], pixels: bytes = bytes(6)) -> Path:
    (folder / "m.pgm").write_bytes(b"P5\n# made\n3 2\n255\n" + pixels)
    path = folder / "m.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in keys.items()))
    return path


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@settings(max_examples=60, deadline=None)
@given(pixels=st.binary(min_size=6, max_size=6), negate=st.sampled_from([0, 1]))
def test_loading_agrees_with_the_oracle(mode: str, pixels: bytes, negate: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        keys = {**GOOD, "mode": mode, "negate": negate}
        grid = load_map(write_map(Path(folder), keys, pixels))
    expected = np.array([oracle(v, keys, mode) for v in pixels]).reshape(2, 3)[::-1]
    np.testing.assert_array_equal(grid.cells, expected)


@pytest.mark.parametrize("image_format", ["pgm", "png"])
@pytest.mark.parametrize("mode", ["trinary", "raw"])
@settings(max_examples=40, deadline=None)
@given(
    cells=hnp.arrays(np.int8, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.integers(-1, 100)),
    resolution=st.floats(1e-3, 10),
    x=st.floats(-1e6, 1e6),
)
def test_maps_survive_saving(mode: Any, image_format: Any, cells: Any, resolution: float, x: float) -> None:
    if mode == "trinary":
        cells = np.select([cells < 0, cells < 20, cells >= 65], [-1, 0, 100], -1)
    grid = OccupancyGrid(cells=cells, resolution_m=resolution, origin_m=(x, -x))
    with tempfile.TemporaryDirectory() as folder:
        path, _ = save_map(grid, Path(folder) / "a b", mode=mode, image_format=image_format)
        found = load_map(path)
    np.testing.assert_array_equal(found.cells, grid.cells)
    # As exact as a product of floats: what is off a short number by its rounding is written as that number.
    read, wanted = (found.resolution_m, *found.origin_m), (resolution, x, -x)
    assert all(map(partial(math.isclose, rel_tol=5e-16), read, wanted))


def test_an_origin_is_written_as_a_person_would(tmp_path: Path) -> None:
    cells = np.zeros((2, 2), np.int8)
    for origin_m, text in (
        ((-478 * 0.05, 3 * 0.1), "[-23.9, 0.3, 0]"),
        ((1e-05, -0.0), "[1.0e-05, -0.0, 0]"),
        ((math.pi, 1 / 3), "[3.141592653589793, 0.3333333333333333, 0]"),
    ):
        path, _ = save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=origin_m), tmp_path / "m")
        assert f"origin: {text}\n" in path.read_text()
        assert np.abs(np.subtract(load_map(path).origin_m, origin_m)).max() < 1e-14


def test_a_comment_changes_nothing_that_is_read(tmp_path: Path) -> None:
    grid = OccupancyGrid(cells=np.array([[0, 60, 100]]), resolution_m=0.05, origin_m=(1.5, 2.0))
    plain, _ = save_map(grid, tmp_path / "a")
    told, _ = save_map(grid, tmp_path / "b", comment="image: no.pgm\n--- 1.8 m: \u2028resolution: 7")
    assert told.read_text().startswith("# image: no.pgm\n# --- 1.8 m: \n# resolution: 7\nimage: b.pgm\n")
    assert np.array_equal(load_map(told).cells, load_map(plain).cells)
    assert load_map(told).resolution_m == 0.05


def test_grey_205_is_unknown_and_rows_are_flipped(tmp_path: Path) -> None:
    grid = load_map(write_map(tmp_path, GOOD, bytes([205, 254, 0, 0, 0, 254])))
    assert grid.cells.tolist() == [[100, 100, 0], [-1, 0, 100]]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("resolution", 0),
        ("resolution", ".nan"),
        ("resolution", "[1]"),
        ("image", "none.pgm"),
        ("origin", "[0, 0]"),
        ("origin", "[0, 0, .inf]"),
        ("negate", "maybe"),
        ("free_thresh", 0.9),
        ("mode", "odd"),
        ("image", "!!python/object/apply:os.system ['true']"),
    ],
)
def test_bad_keys_are_named(tmp_path: Path, key: str, value: object) -> None:
    with pytest.raises(MapFileError, match=r"m\.yaml|none\.pgm"):
        load_map(write_map(tmp_path, {**GOOD, key: value}))


@pytest.mark.parametrize("key", list(GOOD))
def test_missing_keys_are_named(tmp_path: Path, key: str) -> None:
    with pytest.raises(MapFileError, match=f"{key}: field required"):
        load_map(write_map(tmp_path, {k: v for k, v in GOOD.items() if k != key}))


def test_exponents_read_as_in_nav2(tmp_path: Path) -> None:
    assert load_map(write_map(tmp_path, {**GOOD, "resolution": "1e-3"})).resolution_m == 0.001


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("resolution", [1e-3, 100.0], [0.9e-3, 101]),
        ("origin", [[1e8, -1e8, 0], [0, 0, 3.14]], [[1.1e8, 0, 0], [0, 0], [0, 0, 0, 0], "a"]),
        ("occupied_thresh", [0.196, 1.0], [0.19, 1.01]),
        ("free_thresh", [0.0, 0.65], [-0.01, 0.66]),
        ("negate", [0, 1, "0", "1", True, "false"], [2, -1, "", [0], 0.5, 10**30]),
    ],
)
def test_values_up_to_their_limits(tmp_path: Path, key: str, good: list[object], bad: list[object]) -> None:
    for value in good:
        load_map(write_map(tmp_path, {**GOOD, key: value}))
    for value in bad:
        with pytest.raises(MapFileError, match=r"m\.yaml: .*" + key):
            load_map(write_map(tmp_path, {**GOOD, key: value}))


def test_a_shade_at_a_threshold_is_neither(tmp_path: Path) -> None:
    keys = {**GOOD, "negate": 1, "occupied_thresh": 0.2, "free_thresh": 0.2}  # 0.2 is shade 51
    path = write_map(tmp_path, keys, bytes([50, 51, 52, 0, 255, 51]))
    assert load_map(path).cells.tolist() == [[0, 100, -1], [0, -1, 100]]


def test_grey_205_stays_unknown_whatever_the_threshold(tmp_path: Path) -> None:
    """Map savers write it for unknown, and some of them a free_thresh of 0.25 beside it."""
    keys, said = {**GOOD, "free_thresh": 0.25}, list[str]()
    pixels = bytes([205, 254, 0, 204, 206, 254])
    grid = load_map(write_map(tmp_path, keys, pixels), said.append)
    assert grid.cells.tolist() == [[0, 0, 0], [-1, 0, 100]]
    assert "free_thresh 0.25 would make grey 205 free" in said[0]
    assert load_map(write_map(tmp_path, GOOD, pixels), said.append).cells[1, 0] == -1
    darker = load_map(write_map(tmp_path, keys, bytes([205] * 5 + [0])), said.append)
    assert (darker.cells == 0).sum() == 5, "without a lighter grey, 205 is what is free"
    assert len(said) == 1


@pytest.mark.parametrize("yaw_rad", [math.pi, -math.pi / 2, 3.14, 0.7])
def test_a_rotated_map_is_turned_about_its_origin(tmp_path: Path, yaw_rad: float) -> None:
    """Every cell of the image lies where the yaml says, and walls stay closed."""
    cells = np.zeros((30, 50), np.int8)
    cells[:, 20] = cells[12, 20:] = 100
    saved, _ = save_map(OccupancyGrid(cells=cells, resolution_m=0.1, origin_m=(2.0, -1.0)), tmp_path / "m")
    saved.write_text(saved.read_text().replace("-1.0, 0]", f"-1.0, {yaw_rad}]"))
    said: list[str] = []
    grid = load_map(saved, said.append)
    assert f"rotated by {yaw_rad:g} rad" in said[0]
    rows, columns = np.indices(cells.shape)
    across, up = 0.1 * (columns + 0.5), 0.1 * (rows + 0.5)
    x = 2.0 + math.cos(yaw_rad) * across - math.sin(yaw_rad) * up
    y = -1.0 + math.sin(yaw_rad) * across + math.cos(yaw_rad) * up
    at = np.floor((np.stack((y, x), -1) - grid.origin_m[::-1]) / 0.1).astype(int)
    found = grid.cells[at[..., 0], at[..., 1]]
    assert (found[cells == 100] == 100).all()
    assert (found == cells).mean() > 0.95
    assert (grid.cells == 0).sum() == pytest.approx((cells == 0).sum(), rel=0.03)


def test_what_is_a_map_and_what_is_a_recording(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    names = {"a.yaml": True, "a.yml": True, "a.mcap": False, "metadata.yaml": False, "folder.yaml": False}
    assert {name: is_map_file(tmp_path / name) for name in names} == names


@pytest.mark.parametrize("image_format", ["pgm", "png"])
def test_things_are_obstacles_unless_walls_alone_are_wanted(tmp_path: Path, image_format: Any) -> None:
    """By the reader of another: black, white, and grey 205 for nav2's map server."""
    grid = OccupancyGrid(
        cells=np.array([[-1, 0, 19, 20], [50, THING, 65, 99]]), resolution_m=0.05, origin_m=(0.0, 0.0)
    )
    wanted = {"everything": [-1, 100, 100, 100], "walls": [-1, -1, 100, 100]}
    for of, upper in wanted.items():
        path, _ = save_map(grid, tmp_path / "m", image_format=image_format, of=of)  # type: ignore[arg-type]
        assert nav2_map(path)[0].tolist() == [[-1, 0, 0, -1], upper]
        assert load_map(path).cells.tolist() == [[-1, 0, 0, -1], upper]


def test_a_short_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"m\.pgm: a damaged image"):
        load_map(write_map(tmp_path, GOOD, bytes(5)))


@given(st.integers(-(2**63), 2**63 - 1))
def test_stamps_survive_exactly(stamp_ns: int) -> None:
    assert stamp_ns_from_text(stamp_text(stamp_ns)) == stamp_ns


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6))
def test_tum_survives(values: list[float]) -> None:
    from pc2grid.geometry import pose_from_rotation_vector

    pose = pose_from_rotation_vector(np.array(values[:3]) / 1e4, values[3:])
    before = Trajectory(stamps_ns=np.array([1, 10**18]), T_session_base=np.stack((np.eye(4), pose)))
    with tempfile.TemporaryDirectory() as folder:
        write_tum(Path(folder) / "t.tum", before)
        after = read_tum(Path(folder) / "t.tum")
    np.testing.assert_array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.T_session_base, before.T_session_base, atol=5e-9)


@pytest.mark.parametrize("line", ["1 2 3", "x 0 0 0 0 0 0 1", "1 0 0 nan 0 0 0 1", "1 0 0 0 0 0 0 0"])
def test_bad_lines_are_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# made\n{line}\n")
    with pytest.raises(TrajectoryFileError, match="line 2"):
        read_tum(path)
