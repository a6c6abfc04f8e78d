"""Points as PLY or PCD files, as Open3D, CloudCompare and PCL read them: binary, little-endian, float32.

PLY: https://paulbourke.net/dataformats/ply. PCD: version 0.7, see `cloud_files`.

Not written by Open3D 0.19: when the disk is full, its PLY writer reports success for a file that ends in the
middle; it refuses clouds without points; and it takes 0.6 s to load for a header of ten lines.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pc2grid.errors import OutputError
from pc2grid.io.atomic import replace_file

_PLY = """ply
format binary_little_endian 1.0
element vertex {n}
property float x
property float y
property float z
end_header
"""
_PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA binary
"""
_HEADERS = {".ply": _PLY, ".pcd": _PCD}


def write_cloud(path: str | Path, points_m: ArrayLike) -> None:
    """Write points (N, 3), metres, as `.ply` or `.pcd`, by the suffix; an existing file is replaced.

    Raises OutputError for another suffix or if the file cannot be written.

    >>> write_cloud("corner.ply", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    """
    suffix = Path(path).suffix.lower()
    header = _HEADERS.get(suffix)
    if header is None:
        raise OutputError(f"{path}: not a kind of cloud file", hint="end its name in .ply or .pcd")
    points = np.asarray(points_m, "<f4").reshape(-1, 3)
    with replace_file(path) as temporary:
        temporary.write_bytes(header.format(n=len(points)).encode("ascii") + points.tobytes())
