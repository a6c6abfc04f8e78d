"""Seeded mutations of small recordings of every kind: truncated, flipped, spliced, with other lengths.

Whatever happens to a file, reading it gives the clean result, or an error of ours, or says what was lost.
Where the format has checksums, what is read without a word is exactly what was written. PC2GRID_FUZZ is
the number of mutations of all kinds together.
"""

from __future__ import annotations

import os
import resource
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from pc2grid.errors import Pc2GridError
from pc2grid.model import ReadReport, Scan
from tests.builders import drive, read, ros, write_bag, write_mcap, write_rosbag2

MCAP = {
    "mcap zstd": {"chunk_size": 2000},
    "mcap lz4": {"chunk_size": 2000, "compression": CompressionType.LZ4},
    "mcap plain": {"chunk_size": 2000, "compression": CompressionType.NONE},
    "mcap unchunked": {"use_chunking": False, "enable_data_crcs": True},
}
UNCHECKED = ["bag", "bag bz2", "bag lz4", "db3"]
KINDS = [*MCAP, "mcap ros1", *UNCHECKED]
COUNT = max(int(os.environ.get("PC2GRID_FUZZ", "540")) // len(KINDS), 1)


def small_log(folder: Path, kind: str) -> Path:
    if kind in MCAP:
        return write_mcap(folder / "a.mcap", drive(), **MCAP[kind])
    if kind == "mcap ros1":
        return write_mcap(folder / "a.mcap", drive("ros1"), "ros1", chunk_size=2000)
    if kind == "db3":
        return write_rosbag2(folder / "log", drive()) / "log.db3"
    return write_bag(folder / "a.bag", drive("ros1"), kind[4:], chunk_bytes=2000)


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    content = bytearray(whole)
    a, b = sorted(int(v) for v in rng.integers(0, len(content), 2))
    match int(rng.integers(7)):
        case 0:
            del content[a:]
        case 1:
            content[a] ^= 1 << int(rng.integers(8))
        case 2:
            content[a : a + 64] = content[b : b + 64]
        case 3:  # lengths and offsets are of eight bytes in one format, and of four in the others
            content[a : a + 8] = int(rng.integers(1 << 62)).to_bytes(8, "little")
        case 4:
            content[a : a + 4] = int(rng.integers(1 << 32)).to_bytes(4, "little")
        case 5:
            del content[a : min(b, a + 500)]
        case _:  # where summaries and indexes are
            content[-int(rng.integers(1, min(800, len(content))))] ^= 1 << int(rng.integers(8))
    return bytes(content)


def essence(found: tuple[list[Scan], ReadReport]) -> list[tuple[int, bytes, bytes | None]]:
    return [
        (s.stamp_ns, s.points_m.tobytes(), None if s.T_odom_base is None else s.T_odom_base.tobytes())
        for s in found[0]
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_fuzz_recordings(tmp_path: Path, kind: str) -> None:
    path = small_log(tmp_path, kind)
    whole = path.read_bytes()
    clean = essence(read(path))
    rng = np.random.default_rng(KINDS.index(kind))
    outcomes = {"clean": 0, "refused": 0, "said": 0}
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in range(COUNT):
        path.write_bytes(mutated(whole, rng))
        for recover in (False, True):
            try:
                found = read(path, recover=recover)
            except Pc2GridError as error:
                assert error.message, f"mutation {number}"
                outcomes["refused"] += 1
                continue
            if essence(found) == clean:
                outcomes["clean"] += 1
            else:
                report = found[1]
                assert report.lossy or report.warnings, f"mutation {number}, recover {recover}: silent"
                outcomes["said"] += 1
                # A chunk whose checksum is right was written so: what is missing is missing as a whole.
                if kind.startswith("mcap") and kind != "mcap unchunked":
                    points = {points for _, points, _ in clean}
                    assert all(p in points for _, p, _ in essence(found)), f"mutation {number}: wrong points"
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
    assert grown_mb < 500
    assert outcomes["clean"] and outcomes["refused"], outcomes


def test_fuzz_leaves_something_to_find() -> None:
    """The mutations do change what is read: else the test above would pass for a reader of constants."""
    rng = np.random.default_rng(0)
    data = ros().cloud("/points", 1, [[1, 2, 3]]).data
    assert sum(mutated(data * 20, rng) != data * 20 for _ in range(50)) > 45
