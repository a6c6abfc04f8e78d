"""A building in a file: one point cloud, or a mesh, read as points block by block.

Clouds in PCD and PLY are read by our own reader (`pc2grid.io.messages.clouds`), a block at a time from the
mapped file, so that a map of many gigabytes needs the memory of a block. Meshes are read by Open3D, and
sampled evenly. The folder of results that KISS-SLAM writes is read, too: `local_maps/plys` in it holds its
local maps, all in one frame.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pc2grid.errors import LogError, MapFileError
from pc2grid.geometry import F64, I64
from pc2grid.io.messages.clouds import parser
from pc2grid.io.messages.types import HEADER_BYTES, Header
from pc2grid.io.sensors.decode import decode_cloud
from pc2grid.io.source import LFS_HINT, is_lfs_pointer
from pc2grid.settings import ProjectionConfig, ReadConfig

CLOUD_SUFFIXES = (".pcd", ".ply")
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")

_BLOCK_POINTS = 1_000_000  # 24 MB
_SPACING_SAMPLE = 2000
"""Points of a cloud of which the distance to the nearest neighbour is measured."""
_SAMPLES_PER_M2 = 1600.0  # of the surface of a mesh: one every 2.5 cm
_DIGEST_BYTES = 1 << 20
_LOCAL_MAPS = Path("local_maps", "plys")
_ROUNDED_M = 2.0 * ProjectionConfig().resolution_m
"""Steps of coordinates above which walls are not drawn: two cells. Rounded to 0.06 m a building keeps 94 to
99 % of its free area, to 0.12 m 64 to 97 %, to 0.5 m none."""
# Rotations of the axis that points up to z.
UPRIGHT: dict[str, F64] = {
    "z": np.eye(3),
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
}

Kind = Literal["cloud", "mesh"]


def is_building_file(path: Path) -> bool:
    """Return True if an input is a cloud, a mesh or a folder of KISS-SLAM, not a recording."""
    if path.is_dir():
        return os.path.isdir(path / _LOCAL_MAPS)  # noqa: PTH112 - no error for a folder that is locked
    return path.suffix.lower() in (*CLOUD_SUFFIXES, *MESH_SUFFIXES)


def kind_of(path: Path) -> Kind:
    """Return the kind of a file, points or triangles; a .ply with faces holds triangles.

    Raises MapFileError if there is no such file.
    """
    _files(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES or path.is_dir():
        return "cloud"
    return "mesh" if suffix not in CLOUD_SUFFIXES or _has_faces(path) else "cloud"


def building_points(
    path: Path, config: ReadConfig, check: Callable[[F64], None] = lambda vertices_m: None
) -> Iterator[F64]:
    """Yield the points (N, 3) of a building, metres, z up, in blocks; those of a mesh are spread evenly.

    `config.unit_m` and `config.up` are the unit and the upward axis of the file.

    check : gets the vertices (V, 3) of a mesh, metres, z up, before it is sampled; may raise. A mesh in
        millimetres has a million times as many points.

    Raises MapFileError if there is no such file, it cannot be read, is damaged, or its coordinates are too
    large for float32.

    >>> from pc2grid.io.export import write_cloud
    >>> write_cloud("corner.ply", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> sum(len(block) for block in building_points(Path("corner.ply"), ReadConfig()))
    2
    """
    turn = UPRIGHT[config.up] * config.unit_m
    for file in _files(path):
        try:
            if kind_of(file) == "mesh":
                vertices, triangles = load_mesh(file)
                _check_rounding(file, vertices, config.unit_m)
                vertices = vertices @ turn.T
                check(vertices)
                yield from sampled(vertices, triangles)
                continue
            for block in _cloud_blocks(file):
                _check_rounding(file, block, config.unit_m)
                yield block if config.up == "z" and config.unit_m == 1.0 else block @ turn.T
        except LogError as error:  # of the reader of clouds, which also reads recordings
            raise MapFileError(f"{file}: {error.message}", hint=error.hint) from error


def axis_of_file(direction: F64, up: str) -> str:
    """Return the axis of a file nearest to a direction (3,) in its points as they are read with `read.up`.

    >>> axis_of_file(np.array([0.1, 0.0, -1.0]), up="y")
    '-y'
    """
    in_file = UPRIGHT[up].T @ direction
    axis = int(np.abs(in_file).argmax())
    return ("-" if in_file[axis] < 0.0 else "") + "xyz"[axis]


def _check_rounding(path: Path, points: F64, unit_m: float) -> None:
    """Raise MapFileError if float32 has rounded the coordinates (N, 3) of a file more than walls allow."""
    if not len(points):
        return
    typical = np.median(points, axis=0)
    step_m = float(np.spacing(np.float32(np.abs(typical).max()))) * unit_m
    if step_m > _ROUNDED_M and np.array_equal(points, points.astype(np.float32)):
        shift = " ".join(f"{0.0 - round(v, -3):.0f}" for v in typical)
        raise MapFileError(
            f"{path}: float32 cannot hold these coordinates: near {np.abs(typical).max():.0f} they are"
            f" rounded to {step_m:.2g} m",
            hint="where the cloud is still exact, subtract an offset, such as a global shift of"
            f" {shift}, and export it again, or export it in float64",
        )


def digest_of_building(path: Path) -> str:
    """Return the sha256 of the content, in hexadecimal digits. Raises MapFileError if it cannot be read."""
    digest = hashlib.sha256()
    for file in _files(path):
        with _opened(file) as content:
            while block := content.read(_DIGEST_BYTES):
                digest.update(block)
    return digest.hexdigest()


def load_mesh(path: Path) -> tuple[F64, I64]:
    """Read vertices (V, 3) and triangles (T, 3), rows of the vertices, as they stand in a file.

    Raises MapFileError if it holds no triangles, a vertex is not finite, or a triangle names a missing
    vertex.
    """
    from pc2grid.open3d_core import o3d

    _check_counts(path)
    # Open3D prints a warning of its own for each file without triangles.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        found = o3d.io.read_triangle_mesh(path)
    triangles = np.array(found.triangles, np.int64)
    if not len(triangles):
        raise MapFileError(f"{path}: it holds neither points nor triangles")
    vertices = np.array(found.vertices, np.float64)
    if not np.isfinite(vertices).all():
        raise MapFileError(f"{path}: a vertex is not a finite number")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MapFileError(f"{path}: a triangle has a corner that is none of the {len(vertices)} vertices")
    return vertices, triangles


def _check_counts(path: Path) -> None:
    """Raise MapFileError if a .ply or .off announces more vertices and faces than it has bytes.

    Open3D takes memory for all that are announced, and more than there is ends the process.
    """
    head, suffix, counts = _header(path), path.suffix.lower(), []
    if suffix == ".ply":
        counts = re.findall(rb"^element\s+\S+\s+(\d+)", head, re.MULTILINE)
    elif suffix == ".off":
        counts = re.findall(rb"\d+", re.sub(rb"#.*", b"", head))[:2]
    size = path.stat().st_size
    if sum(int(count[:20]) for count in counts) > size:
        named = " and ".join(count[:20].decode() for count in counts)
        raise MapFileError(
            f"{path}: ends in the middle: {named} vertices and faces in {size} bytes", hint="copy it again"
        )


def _files(path: Path) -> list[Path]:
    """Return the files of a building. Raises MapFileError if there are none."""
    if path.is_dir():
        found = sorted((path / _LOCAL_MAPS).glob("*.ply"))
        if not found:
            raise MapFileError(f"{path / _LOCAL_MAPS}: holds no .ply")
        return found
    known = {*CLOUD_SUFFIXES, *MESH_SUFFIXES}
    if path.suffix.lower() not in known:
        raise MapFileError(
            f"{path}: not a building that pc2grid reads",
            hint=f"known are {', '.join(sorted({'.yaml', *known}))}",
        )
    if not path.is_file():
        raise MapFileError(f"{path}: no such file", hint="check the path")
    if is_lfs_pointer(_header(path)):
        raise MapFileError(f"{path}: a Git LFS pointer to a cloud or mesh", hint=LFS_HINT)
    return [path]


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with path.open("rb") as content:
            yield content
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror or error}") from error


def _header(path: Path) -> bytes:
    """Return the beginning of a file; of a .ply its header."""
    with _opened(path) as content:
        head: bytes = content.read(HEADER_BYTES)
    return head.partition(b"end_header")[0]


def _has_faces(path: Path) -> bool:
    """Return True if the header of a .ply announces faces."""
    return re.search(rb"^element face 0*[1-9]", _header(path), re.MULTILINE) is not None


def _cloud_blocks(path: Path) -> Iterator[F64]:
    """Yield the points of a cloud file, in blocks. Raises PointCloudError if it contradicts itself."""
    if not path.stat().st_size:
        raise MapFileError(f"{path}: empty file")
    # The file stays mapped as long as there are views of it.
    mapped = np.memmap(path, np.uint8, mode="r").data
    cloud = parser(path.suffix.lower()[1:])(mapped, Header(0, ""))
    step, data = cloud.point_step, memoryview(cloud.data)
    if len(data) < cloud.width * step:
        raise MapFileError(
            f"{path}: ends in the middle: {len(data)} bytes where {cloud.width * step} are declared",
            hint="copy it again",
        )
    for first in range(0, cloud.width, _BLOCK_POINTS):
        count = min(_BLOCK_POINTS, cloud.width - first)
        part = data[first * step : (first + count) * step]
        block = replace(cloud, width=count, row_step=count * step, data=part)
        yield decode_cloud(block, unit="none").xyz_m.astype(np.float64)


def sampled(vertices: F64, triangles: I64) -> Iterator[F64]:
    """Yield blocks of points (N, 3) spread evenly over triangles (T, 3) of vertices (V, 3); never random."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    # Each triangle gets its share of the points, rounded so that the sum stays right.
    ends = np.floor(np.cumsum(area_m2) * _SAMPLES_PER_M2).astype(np.int64)
    rng = np.random.default_rng(0)
    for first in range(0, int(ends[-1]), _BLOCK_POINTS):
        count = min(_BLOCK_POINTS, int(ends[-1]) - first)
        chosen = np.searchsorted(ends, np.arange(first, first + count), side="right")
        u, v = rng.random((2, count, 1))
        flipped = u + v > 1
        u, v = np.where(flipped, 1 - u, u), np.where(flipped, 1 - v, v)
        points: F64 = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
        yield points


def neighbour_distances_m(points_m: F64, neighbour: int = 1) -> F64:
    """Return the distance (M,) of some points of a cloud (N, 3), evenly chosen, to their n-th nearest
    neighbour."""
    from scipy.spatial import cKDTree

    sample = points_m[:: max(len(points_m) // _SPACING_SAMPLE, 1)]
    return np.asarray(cKDTree(points_m).query(sample, k=[neighbour + 1])[0][:, 0])
