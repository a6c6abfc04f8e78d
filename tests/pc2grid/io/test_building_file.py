"""Clouds and meshes read as points, block by block."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import MapFileError
from pc2grid.geometry import F64
from pc2grid.grids.drawn import load_drawn_map
from pc2grid.io import building_file
from pc2grid.io.building_file import (
    axis_of_file,
    building_points,
    digest_of_building,
    is_building_file,
    kind_of,
)
from pc2grid.io.export import write_cloud
from pc2grid.settings import ReadConfig
from pc2grid.simulate.scene import load_building
from tests.helpers.memory import bounded_memory

PCD = (
    b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2000000000\nHEIGHT 1\n"
    b"POINTS 2000000000\n"
)
CLOUD = np.random.default_rng(0).uniform(-5, 5, (1000, 3)).astype(np.float32)


def points(path: Path, **config: object) -> F64:
    return np.concatenate([np.empty((0, 3)), *building_points(path, ReadConfig.model_validate(config))])


def square(path: Path) -> Path:
    """A mesh of 2 m x 1 m."""
    corners = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
    path.write_text(corners + "f 1 2 3\nf 1 3 4\n")
    return path


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_blocks_are_the_whole(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building_file, "_BLOCK_POINTS", 300)
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, CLOUD)
    blocks = list(building_points(path, ReadConfig()))
    assert [len(block) for block in blocks] == [300, 300, 300, 100]
    assert np.array_equal(np.concatenate(blocks), CLOUD)
    assert kind_of(path) == "cloud"


def test_mesh_is_sampled_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = square(tmp_path / "square.obj")
    monkeypatch.setattr(building_file, "_BLOCK_POINTS", 500)
    found = points(path)
    assert kind_of(path) == "mesh" and len(found) == 2 * 1600
    counts, *_ = np.histogram2d(found[:, 0], found[:, 1], bins=(4, 2), range=((0, 2), (0, 1)))
    assert counts.min() > 320 and counts.sum() == len(found)
    assert np.array_equal(found, points(path))


def test_units_and_the_axis_that_points_up(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_cloud(path, CLOUD)
    assert points(path, unit_m=0.001) == pytest.approx(CLOUD * 0.001)
    for up in ("x", "y", "z", "-x", "-y", "-z"):
        turned, sign = points(path, up=up), -1.0 if up[0] == "-" else 1.0
        assert turned[:, 2] == pytest.approx(sign * CLOUD[:, "xyz".index(up[-1])])
        assert axis_of_file(np.array([0.0, 0.0, 1.0]), up) == up
        # A rotation keeps the hand of the axes.
        R = np.linalg.lstsq(CLOUD.astype(float), turned, rcond=None)[0].T
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_coordinates_too_large_for_float32_are_refused(tmp_path: Path) -> None:
    """UTM in float32 is rounded to 0.5 m, in float64 it is exact; MGRS fits into float32."""
    utm = CLOUD + np.array([467_325.0, 5_429_800.0, 310.0])
    mgrs = CLOUD + np.array([67_325.0, 29_800.0, 310.0])
    for form, unit_m in ((".ply", 1.0), (".pcd", 0.001)):
        rounded = tmp_path / f"rounded{form}"
        write_cloud(rounded, (utm / unit_m).astype(np.float32))
        with pytest.raises(MapFileError, match=r"float32 cannot hold .* rounded to 0\.5\d? m") as refused:
            points(rounded, unit_m=unit_m)
        assert "offset" in (refused.value.hint or "")
    path = tmp_path / "cloud.ply"
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(utm)}\n{names}end_header\n"
    path.write_bytes(head.encode() + utm.tobytes())
    assert np.array_equal(points(path), utm)
    write_cloud(path, mgrs)
    assert points(path) == pytest.approx(mgrs, abs=0.01)


def test_local_maps_of_kiss_slam_are_one_cloud(tmp_path: Path) -> None:
    plys = tmp_path / "latest" / "local_maps" / "plys"
    plys.mkdir(parents=True)
    write_cloud(plys / "000000.ply", CLOUD[:400])
    write_cloud(plys / "000001.ply", CLOUD[400:])
    assert is_building_file(tmp_path / "latest") and not is_building_file(tmp_path)
    assert np.array_equal(points(tmp_path / "latest"), CLOUD)
    assert len(digest_of_building(tmp_path / "latest")) == 64


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"gone\.ply: no such file"):
        points(tmp_path / "gone.ply")
    with pytest.raises(MapFileError, match="not a building"):
        points(tmp_path / "notes.txt")
    (tmp_path / "empty.ply").touch()
    with pytest.raises(MapFileError, match=r"empty\.ply: empty file"):
        points(tmp_path / "empty.ply")
    write_cloud(tmp_path / "cut.pcd", CLOUD)
    data = (tmp_path / "cut.pcd").read_bytes()
    (tmp_path / "cut.pcd").write_bytes(data[:-100])
    with pytest.raises(MapFileError, match=r"cut\.pcd: ends in the middle"):
        points(tmp_path / "cut.pcd")
    (tmp_path / "odd.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(MapFileError, match=r"odd\.ply: a PLY without a header"):
        points(tmp_path / "odd.ply")
    (tmp_path / "no.obj").write_text("v 0 0 0\n")
    with pytest.raises(MapFileError, match="neither points nor triangles"):
        points(tmp_path / "no.obj")


def ply(vertices: int, faces: object, body: bytes, form: str = "binary_little_endian") -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        head + f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode() + body


CORNERS = struct.pack("<9f", 0, 0, 0, 4, 0, 0, 0, 4, 0)
MANY = 2_000_000_000


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("faces.ply", ply(3, MANY, CORNERS + bytes(99)), "3 and 2000000000 vertices and faces in"),
        ("vertices.ply", ply(MANY, 1, bytes(600)), "ends in the middle"),
        ("text.ply", ply(3, MANY, b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "ascii"), "ends in the middle"),
        ("digits.ply", ply(3, "9" * 5000, CORNERS), "ends in the middle"),
        ("far.ply", ply(3, 1, CORNERS + b"\x03" + struct.pack("<3i", 0, 1, 2**30)), "none of the 3 vertices"),
        ("below.ply", ply(3, 1, CORNERS + b"\x03" + struct.pack("<3i", 0, 1, -5)), "none of the 3 vertices"),
        (
            "vertices.off",
            b"OFF\n# two billions\n2000000000 1 0\n0 0 0\n",
            "2000000000 and 1 vertices and faces in",
        ),
        ("faces.off", b"OFF 3 2000000000 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "ends in the middle"),
        ("far.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 77777\n", "none of the 3 vertices"),
        ("far.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n", "neither points nor triangles"),
        ("many.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(500), "neither points nor triangles"),
        (
            "many.glb",
            b"glTF" + struct.pack("<III", 2, 2**32 - 1, 2**32 - 1) + b"JSON{}",
            "neither points nor",
        ),
        ("many.pcd", PCD + b"DATA binary\n" + bytes(600), "600 bytes where 24000000000 are declared"),
    ],
)
def test_headers_that_claim_too_much(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    """Open3D takes memory for all that is announced; some of these ended the whole process."""
    path = tmp_path / name
    path.write_bytes(content)
    with bounded_memory(1 << 30), pytest.raises(MapFileError, match=words) as caught:
        load_drawn_map(path)
    assert str(path) in caught.value.message


def test_a_mesh_in_millimetres_is_refused_before_it_is_sampled(tmp_path: Path) -> None:
    """A million times as many points as in metres: it went on for hours, also with the right unit."""
    path = tmp_path / "hall.obj"
    corners = [(x, y, z) for z in (0, 3000) for x, y in ((0, 0), (20_000, 0), (20_000, 10_000), (0, 10_000))]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    for a, b, c, d in ((1, 2, 3, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)):
        lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
    path.write_text("\n".join(lines))
    for load in (load_drawn_map, load_building):
        with pytest.raises(MapFileError, match="too high for a building in metres") as caught:
            load(path)
        assert caught.value.hint is not None and "unit_m=0.001 says millimetres" in caught.value.hint
    found = points(path, unit_m=0.001)
    assert len(found) == pytest.approx(1600 * (20 * 10 + 60 * 3), abs=2)
    assert np.ptp(found, axis=0) == pytest.approx((20.0, 10.0, 3.0), abs=0.05)
