"""Random damage: what transfer, storage, killed recorders and attackers do to a file."""

import functools
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.helpers.memory import Peak

# Mutations of each kind of file (`make fuzz`: 20,000); in parts of at most 5000 for several processes.
ROUNDS = int(os.environ.get("PC2GRID_FUZZ", "10"))
ENOUGH = 100
"""So many show every outcome."""
PARTS = -(-ROUNDS // 5000)

# A round takes milliseconds; an endless loop or a huge allocation in a decoder takes far longer.
PATIENCE_S = 10.0
# In addition to the interpreter with all libraries, which takes less than 200 MB.
MOST_BYTES = 300 << 20
_EXTREMES = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FC00000, 0x7F800000, 0x7E000000)


def put(path: Path, content: bytes) -> None:
    """Replace a file: file systems flush a file to the disk that is truncated and filled again."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)


def mutated(whole: bytes, rng: np.random.Generator) -> bytes:
    """The bytes truncated, flipped, spliced, shifted, with other lengths in them, or whole records gone."""
    content = bytearray(whole)
    a, b = sorted(int(v) for v in rng.integers(0, len(content), 2))
    match int(rng.integers(12)):
        case 0:
            del content[a:]
        case 1:
            content[a] ^= 1 << int(rng.integers(8))
        case 2:
            content[a : a + 64] = content[b : b + 64]
        case 3:
            del content[a : min(b, a + 500)]
        case 4:
            content[a:a] = content[a : min(b, a + 40)]
        case 5:
            content[a : a + 4] = _EXTREMES[int(rng.integers(len(_EXTREMES)))].to_bytes(4, "little")
        case 6:  # lengths and offsets are of eight bytes in one format, and of four in the others
            content[a : a + 8] = int(rng.integers(1 << 62)).to_bytes(8, "little")
        case 7:
            content[a : a + 4] = int(rng.integers(1 << 32)).to_bytes(4, "little")
        case 8:  # where summaries, indexes and footers are
            content[-int(rng.integers(1, min(800, len(content) + 1)))] ^= 1 << int(rng.integers(8))
        case 9:
            _swap_lengths(content, _lengths(whole), rng)
        case _:
            content = _other_records(content, _borders(whole) or [0, a, b, len(content)], rng)
    return bytes(content)


def _swap_lengths(content: bytearray, places: NDArray[np.intp], rng: np.random.Generator) -> None:
    """Exchange two words that look like lengths of, or offsets into, the content."""
    if len(places) >= 2:
        a, b = (int(v) for v in rng.choice(places, 2, replace=False))
        content[a : a + 4], content[b : b + 4] = content[b : b + 4], content[a : a + 4]


@functools.lru_cache(maxsize=64)
def _lengths(whole: bytes) -> NDArray[np.intp]:
    if len(whole) < 8:
        return np.empty(0, np.intp)
    words = np.lib.stride_tricks.sliding_window_view(np.frombuffer(whole, np.uint8), 4)
    values = words.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16, 1 << 24])
    return np.flatnonzero((values > 0) & (values <= len(whole)))


def _other_records(content: bytearray, borders: list[int], rng: np.random.Generator) -> bytearray:
    """Some consecutive records are left out, repeated, or moved in front of the ones before them.

    Each record stays as it was written, with its checksum, so only other records show that some are missing.
    """
    a, b, c = sorted(rng.choice(len(borders), 3, replace=False).tolist())
    front, first, second, rest = (
        content[: borders[a]],
        content[borders[a] : borders[b]],
        content[borders[b] : borders[c]],
        content[borders[c] :],
    )
    match int(rng.integers(4)):
        case 0:
            return front + second + first + rest
        case 1:
            return front + first + first + second + rest
        case _:
            return front + second + rest


@functools.lru_cache(maxsize=64)
def _borders(whole: bytes) -> list[int]:
    """Where the records of a file begin and end; empty for a format without records."""
    size = len(whole)
    if whole.startswith(b"SQLite format 3"):  # its pages except the first, without which nothing can be read
        page = int.from_bytes(whole[16:18], "big")
        return list(range(page, size + 1, page))
    if whole.startswith(b"\x89MCAP"):
        borders = [8]
        while borders[-1] < size - 8:
            at = borders[-1]
            borders.append(at + 9 + int.from_bytes(whole[at + 1 : at + 9], "little"))
        return borders
    if whole.startswith(b"#ROSBAG"):
        borders = [whole.index(b"\n") + 1]
        while borders[-1] < size:
            at = borders[-1]
            for _ in range(2):  # header and data
                at += 4 + int.from_bytes(whole[at : at + 4], "little")
            borders.append(at)
        return borders
    return []


def patiently() -> Iterator[int]:
    """The numbers of a part's rounds; asserts that each takes little time, and all together little memory."""
    rounds, peak = ROUNDS // PARTS, Peak()
    for number in range(rounds):
        begin = time.process_time()
        yield number
        assert time.process_time() - begin < PATIENCE_S, f"mutation {number}"
        if number % 100 == 99 or number == rounds - 1:  # the peak is kept, so it need not be read each time
            assert peak.grown_bytes() < MOST_BYTES, f"up to mutation {number}"
