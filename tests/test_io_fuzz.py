"""Seeded mutations of small recordings of every kind: truncated, flipped, spliced, with other lengths.

Whatever happens to a file, reading it gives the clean result, or an error of ours, or says what was lost;
in no other time and with no other memory than a small file deserves. What cannot be noticed:

- ROS 1 bags (but for bz2, whose blocks have checksums), .db3 and clouds in files carry no checksum. Their
  reader says so in a warning, always; a changed coordinate, stamp or frame name is read as it stands.
- In an MCAP, all that is used of a message stands under the checksum of its chunk, or of the data section.
  Whole chunks can be missing without a trace in a file that was not closed: that is what the warning about
  the recorder is for.

PC2GRID_FUZZ is the number of mutations of each kind.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from pc2grid.errors import Pc2GridError
from pc2grid.io.trajectory import write_tum
from pc2grid.model import ReadReport, Scan
from tests.builders import drive, read, ros, write_bag, write_mcap, write_rosbag2
from tests.mutations import mutated, patiently, put
from tests.test_io_clouds import folder_of, trajectory

MCAP = {
    "mcap zstd": {"chunk_size": 2000},
    "mcap lz4": {"chunk_size": 2000, "compression": CompressionType.LZ4},
    "mcap plain": {"chunk_size": 2000, "compression": CompressionType.NONE},
    "mcap unchunked": {"use_chunking": False, "enable_data_crcs": True},
}
CHECKED = [*MCAP, "mcap ros1", "rosbag2 mcap"]
UNCHECKED = [
    "bag", "bag bz2", "bag lz4", "db3", "rosbag2 db3",
    "pcd ascii", "pcd binary", "pcd compressed", "ply ascii", "ply binary", "bin",
]  # fmt: skip
WARNED = [kind for kind in UNCHECKED if kind != "bag bz2"]
KINDS = [*CHECKED, *UNCHECKED]
COUNT = int(os.environ.get("PC2GRID_FUZZ", "30"))
SCANS = 10  # fewer, and one that is lost would be more than the tenth that a reader puts up with


def small_log(folder: Path, kind: str) -> Path:
    if kind in MCAP:
        return write_mcap(folder / "a.mcap", drive(scans=SCANS), **MCAP[kind])
    if kind == "mcap ros1":
        return write_mcap(folder / "a.mcap", drive("ros1", SCANS), "ros1", chunk_size=2000)
    if kind.startswith("bag"):
        return write_bag(folder / "a.bag", drive("ros1", SCANS), kind[4:], chunk_bytes=2000)
    if kind == "db3":
        return write_rosbag2(folder / "log", drive(scans=SCANS)) / "log.db3"
    if kind.startswith("rosbag2"):
        suffix = kind.split()[1]
        log = write_rosbag2(folder / "log", drive(scans=SCANS), "mcap" if suffix == "mcap" else "sqlite3")
        if suffix == "mcap":
            write_mcap(
                log / "log.mcap", drive(scans=SCANS), **MCAP["mcap zstd"]
            )  # rosbags writes no checksums
        # Only this is read of it: elsewhere damage would change nothing.
        listed = f"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n  - log.{suffix}\n"
        (log / "metadata.yaml").write_text(listed)
        return log
    clouds = folder_of(folder, kind, count=3)
    write_tum(clouds / "poses.tum", trajectory(3))
    return clouds


def essence(scans: list[Scan]) -> list[tuple[int, bytes, bytes | None]]:
    return [
        (s.stamp_ns, s.points_m.tobytes(), None if s.T_odom_base is None else s.T_odom_base.tobytes())
        for s in scans
    ]


def news(report: ReadReport, usual: ReadReport) -> bool:
    """Whether the reading said more than it does of the whole file."""
    return report.lossy or bool(set(report.warnings) - set(usual.warnings))


@pytest.mark.parametrize("kind", KINDS)
def test_fuzz_recordings(tmp_path: Path, kind: str) -> None:
    path = small_log(tmp_path, kind)
    files = [path] if path.is_file() else sorted(path.iterdir())
    whole = [file.read_bytes() for file in files]
    scans, usual = read(path)
    clean = essence(scans)
    assert not usual.lossy
    assert any("no checksum" in warning for warning in usual.warnings) == (kind in WARNED)
    rng = np.random.default_rng(KINDS.index(kind))
    outcomes = {"clean": 0, "refused": 0, "said": 0}
    for number in patiently(COUNT):
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
                    break  # nothing to recover: looked at now and then
                continue
            outcomes["said"] += 1
            if kind in CHECKED:
                assert news(report, usual), f"{what}: silent"
            if kind in CHECKED and kind != "mcap unchunked":
                # A chunk whose checksum is right was written so: what is missing is missing as a whole.
                assert {f[:2] for f in found} <= {c[:2] for c in clean}, f"{what}: other points"
            if recover and kind.endswith("db3") and len(found) < len(clean):
                assert news(report, usual), f"{what}: silent"
            if kind == "bag bz2":
                assert {f[1] for f in found} <= {c[1] for c in clean}, f"{what}: other points"
        put(files[victim], whole[victim])
    assert outcomes["clean"] and outcomes["refused"], outcomes


def test_fuzz_leaves_something_to_find() -> None:
    """The mutations do change what is read: else the test above would pass for a reader of constants."""
    rng = np.random.default_rng(0)
    data = ros().cloud("/points", 1, [[1, 2, 3]]).data
    assert sum(mutated(data * 20, rng) != data * 20 for _ in range(50)) > 45
