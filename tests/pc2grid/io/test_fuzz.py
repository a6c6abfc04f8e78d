"""Seeded mutations of small recordings of every kind: truncated, flipped, spliced, with other lengths.

Whatever happens to a file, reading it gives the clean result, a Pc2GridError, or a report of what was lost,
with the time and memory of a small file. What cannot be noticed:

- ROS 1 bags, .db3 and clouds in files carry no checksum (but for the blocks of bz2). Their reader always
  warns of it; a changed coordinate, stamp, or name of a frame or topic is read as it stands.
- In an MCAP, everything that is used of a message stands under the checksum of its chunk, or of the data
  section. Whole chunks can be missing without a trace in a file that was not closed; the warning that the
  recorder was killed stands for that.

PC2GRID_FUZZ is the number of mutations of each kind; from 100 on, every outcome must occur.
"""

import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from pc2grid.errors import Pc2GridError
from pc2grid.io.trajectory import write_tum
from pc2grid.model import ReadReport, Scan
from tests.helpers.cloud_folders import POINTS, trajectory, write_cloud
from tests.helpers.memory import bounded_memory
from tests.helpers.mutations import ENOUGH, MOST_BYTES, PARTS, ROUNDS, mutated, patiently, put
from tests.helpers.recordings import (
    STEP,
    T0,
    Dialect,
    Message,
    drive,
    read,
    ros,
    write_bag,
    write_mcap,
    write_rosbag2,
)

MCAP = {
    "mcap zstd": {"chunk_size": 1500},
    "mcap lz4": {"chunk_size": 1500, "compression": CompressionType.LZ4},
    "mcap plain": {"chunk_size": 1500, "compression": CompressionType.NONE},
    "mcap unchunked": {"use_chunking": False, "enable_data_crcs": True},
}
CHECKED = [*MCAP, "mcap ros1", "rosbag2 mcap"]
UNCHECKED = [
    "bag", "bag bz2", "bag lz4", "db3", "rosbag2 db3",
    "pcd ascii", "pcd binary", "ply ascii", "ply binary", "bin",
]  # fmt: skip
KINDS = [*CHECKED, *UNCHECKED]
# With fewer scans, a single lost one would exceed the tenth that a reader accepts; where every chunk has a
# checksum, whole chunks are lost instead of single scans.
SCANS, SCANS_IN_CHUNKS = 10, 6
WITH_ODOMETRY = 3  # of these: one has as many bytes as all clouds, most of them covariances


def messages(dialect: Dialect = "ros2", scans: int = SCANS) -> list[Message]:
    last_ns = T0 + WITH_ODOMETRY * STEP
    return [m for m in drive(dialect, scans) if m.topic != "/odom" or m.log_time_ns < last_ns]


def small_log(folder: Path, kind: str) -> Path:
    if kind in MCAP:
        scans = SCANS_IN_CHUNKS if "chunk_size" in MCAP[kind] else SCANS
        return write_mcap(folder / "a.mcap", messages(scans=scans), **MCAP[kind])
    if kind == "mcap ros1":
        return write_mcap(folder / "a.mcap", messages("ros1", SCANS_IN_CHUNKS), "ros1", chunk_size=1500)
    if kind.startswith("bag"):
        return write_bag(folder / "a.bag", messages("ros1"), kind[4:], chunk_bytes=1500)
    if kind == "db3":
        return with_one_profile(write_rosbag2(folder / "log", messages()) / "log.db3")
    if kind.startswith("rosbag2"):
        suffix = kind.split()[1]
        log = write_rosbag2(folder / "log", messages(), "mcap" if suffix == "mcap" else "sqlite3")
        if suffix == "mcap":  # rosbags writes no checksums
            write_mcap(log / "log.mcap", messages(scans=SCANS_IN_CHUNKS), **MCAP["mcap zstd"])
        else:
            with_one_profile(log / "log.db3")
        # Nothing else of it is read, so damage elsewhere would change nothing.
        listed = f"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n  - log.{suffix}\n"
        (log / "metadata.yaml").write_text(listed)
        return log
    clouds = folder / "clouds"
    clouds.mkdir()
    for i in range(3):
        write_cloud(clouds / f"scan_{i}", POINTS[: 20 + i], kind)
    write_tum(clouds / "poses.tum", trajectory(3))
    return clouds


def with_one_profile(path: Path) -> Path:
    """The .db3 with the QoS profiles of its first topic: they are YAML, and parsing it takes its time."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE topics SET offered_qos_profiles = '' WHERE id > 1")
        connection.commit()
        connection.execute("VACUUM")
    return path


def essence(scans: list[Scan]) -> list[tuple[int, bytes, bytes | None]]:
    return [
        (s.stamp_ns, s.points_m.tobytes(), None if s.T_odom_base is None else s.T_odom_base.tobytes())
        for s in scans
    ]


def news(report: ReadReport, usual: ReadReport) -> bool:
    """Whether the report says more than that of the undamaged file."""
    return report.lossy or bool(set(report.warnings) - set(usual.warnings))


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("kind", KINDS)
@bounded_memory(MOST_BYTES)
def test_fuzz_recordings(tmp_path: Path, kind: str, part: int) -> None:
    path = small_log(tmp_path, kind)
    files = [path] if path.is_file() else sorted(path.iterdir())
    whole = [file.read_bytes() for file in files]
    scans, usual = read(path)
    clean = essence(scans)
    assert not usual.lossy
    assert any("no checksum" in warning for warning in usual.warnings) == (kind in UNCHECKED)
    rng = np.random.default_rng([KINDS.index(kind), part])
    outcomes = {"clean": 0, "refused": 0, "said": 0}
    for number in patiently():
        victim = int(rng.integers(len(files)))
        put(files[victim], mutated(whole[victim], rng))
        for recover in (False, True):
            what = f"mutation {number} of {files[victim].name}, recover {recover}"
            try:
                scans, report = read(path, recover=recover)
            except Pc2GridError as error:
                assert error.message, what
                assert "\n" not in error.message, what
                outcomes["refused"] += 1
                continue
            except Exception as error:
                raise AssertionError(f"{what}: {error!r}") from error
            found = essence(scans)
            if found == clean:
                outcomes["clean"] += 1
                if not news(report, usual) and number % 4:
                    break  # nothing to recover: tried for every fourth only
                continue
            outcomes["said"] += 1
            if kind in CHECKED:
                assert news(report, usual), f"{what}: silent"
            if kind in CHECKED and kind != "mcap unchunked":
                # A chunk with a right checksum holds what was written, so only whole chunks can be missing.
                assert {f[:2] for f in found} <= {c[:2] for c in clean}, f"{what}: other points"
            if kind.endswith("db3"):
                assert news(report, usual) or len(found) == len(clean), f"{what}: silent"
        if len(files) > 1:
            put(files[victim], whole[victim])
    assert (outcomes["clean"] and outcomes["refused"]) or ROUNDS < ENOUGH, outcomes


def test_fuzz_leaves_something_to_find() -> None:
    """The mutations change what is read: otherwise a reader that returns constants would pass."""
    rng = np.random.default_rng(0)
    data = ros().cloud("/points", 1, [[1, 2, 3]]).data
    assert sum(mutated(data * 20, rng) != data * 20 for _ in range(50)) > 45


def test_fuzz_notices_memory_that_is_asked_for_and_never_touched() -> None:
    """In a process of its own: memory that other tests left behind may be freed meanwhile and reused."""
    code = (
        "from tests.helpers.memory import bounded_memory\n"
        f"most, more = {MOST_BYTES}, {32 << 20}\n"  # memory that was free before may be used, too
        "with bounded_memory(most):\n"
        "    bytearray(most // 2)\n"
        "    try:\n"
        "        bytearray(most + more)\n"
        "    except MemoryError:\n"
        "        print('noticed')\n"
        "bytearray(most + more)\n"
        "print('free again')"
    )
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert (done.stdout.split("\n"), done.stderr) == (["noticed", "free again", ""], "")
