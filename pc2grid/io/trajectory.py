"""Trajectories as TUM and KITTI text files, as evo reads them.

TUM: `t tx ty tz qx qy qz qw` per line, seconds with 9 decimals, `#` starts a comment.
KITTI: the first three rows of the pose, 12 numbers per line, no time.
"""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import F64, pose_from_xyz_quat, quat_xyzw_from_pose
from pc2grid.io.atomic import replace_file
from pc2grid.model import Trajectory

_MAX_BYTES = 128 << 20  # some million poses


def stamp_ns_from_text(text: str) -> int:
    """Convert seconds as decimal text to int64 nanoseconds, exactly (a float would lose the last three
    digits).

    Raises ValueError if it is not a finite decimal number that fits.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"not a time: {text!r:.60}") from error
    if not seconds.is_finite() or seconds.adjusted() > 10:  # the integer of 1e999000 would take minutes
        raise ValueError(f"not a time: {text!r:.60}")
    stamp = int((seconds * 1_000_000_000).to_integral_value())
    if not -(2**63) <= stamp < 2**63:
        raise ValueError(f"not a time: {text!r}")
    return stamp


def stamp_text(stamp_ns: int) -> str:
    """Convert nanoseconds to seconds with 9 decimals, exactly."""
    sign = "-" if stamp_ns < 0 else ""
    seconds, rest = divmod(abs(int(stamp_ns)), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM file as poses of the base in the map frame, metres; stamps must increase.

    Raises TrajectoryFileError with the line that is wrong.

    >>> truth = read_tum("tuesday.tum")
    >>> truth.T_session_base.shape[1:], bool((truth.stamps_ns[1:] > truth.stamps_ns[:-1]).all())
    ((4, 4), True)
    """
    stamps: list[int] = []
    poses: list[F64] = []
    for number, line in enumerate(lines_of(path), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) != 8:
                raise ValueError(f"expected 8 numbers (t x y z qx qy qz qw), found {len(words)}")
            stamp = stamp_ns_from_text(words[0])
            values = np.array([float(word) for word in words[1:]])
            if not np.isfinite(values).all():
                raise ValueError("not a finite number")
            if stamps and stamp <= stamps[-1]:
                raise ValueError("time does not increase")
            poses.append(pose_from_xyz_quat(values[:3], values[3:]))
        except (ValueError, ArithmeticError) as error:
            raise TrajectoryFileError(f"{path}, line {number}: {error}") from error
        stamps.append(stamp)
    matrices = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
    return Trajectory(stamps_ns=np.array(stamps, dtype=np.int64), T_session_base=matrices)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file: seconds with 9 decimals, metres, quaternions x y z w, no trailing space.

    Raises OutputError if it cannot be written; an existing file is replaced.

    >>> write_tum("copy.tum", read_tum("tuesday.tum"))
    >>> len(read_tum("copy.tum")) == len(read_tum("tuesday.tum"))
    True
    """
    with replace_file(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as out:
        for stamp_ns, T_session_base in zip(trajectory.stamps_ns, trajectory.T_session_base, strict=True):
            values = (*T_session_base[:3, 3], *quat_xyzw_from_pose(T_session_base))
            out.write(" ".join((stamp_text(int(stamp_ns)), *(f"{v:.9f}" for v in values))) + "\n")


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI pose file: 12 numbers per line, the upper (3, 4) of each pose, row by row, metres.

    Raises OutputError if it cannot be written; an existing file is replaced.

    >>> write_kitti("poses.txt", read_tum("tuesday.tum"))
    >>> len(lines_of("poses.txt")) == len(read_tum("tuesday.tum"))
    True
    """
    with replace_file(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as out:
        for T_session_base in trajectory.T_session_base:
            out.write(" ".join(f"{v:.9e}" for v in T_session_base[:3].ravel()) + "\n")


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write KITTI for the suffix `.kitti`, else TUM, which has times.

    >>> write_trajectory("way.kitti", read_tum("tuesday.tum"))
    >>> len(lines_of("way.kitti")[0].split())
    12
    """
    write = write_kitti if Path(path).suffix.lower() == ".kitti" else write_tum
    write(path, trajectory)


def lines_of(path: str | Path) -> list[str]:
    """Return the lines of a text file of poses or times.

    Raises TrajectoryFileError if it cannot be read, is larger than 128 MiB, or not text.
    """
    try:
        if Path(path).stat().st_size > _MAX_BYTES:
            raise TrajectoryFileError(f"{path}: larger than {_MAX_BYTES} bytes: no trajectory")
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise TrajectoryFileError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise TrajectoryFileError(f"{path}: not a text file") from error
