"""Time of `pc2grid relocalize`, from the start of the process to the answer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import fixtures
from measure import Row, median, program
from reading import bare_kiss


def relocalize_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid relocalize` on 15 s of a recording, without the time that bare KISS-ICP needs for its scans.

    Also how much more processor time the first run in a fresh environment needs, where nothing is compiled
    yet.
    """
    mapped, log = folder / "monday.mcap", folder / "tuesday.mcap"
    fixtures.lidar_log(mapped, 10.0 if quick else 60.0, seed=0)
    fixtures.lidar_log(log, 12.0, seed=1)
    database = folder / "building.submaps"
    program("convert", mapped, "-o", database)
    cache = {"NUMBA_CACHE_DIR": str(folder / "numba")}
    first, second = (
        program("relocalize", log, "--duration", "15", "-d", database, environment=cache).time
        for _ in range(2)
    )
    yield Row(
        what="first relocalize in a fresh environment, over the second",
        measured=first.wall - second.wall,
        cpu=first.cpu - second.cpu,
        unit="s",
        goal=12.0,
        note=f"cpu: {first.cpu:.1f} s, then {second.cpu:.1f} s",
    )
    whole, bare = [], []
    for _ in range(1 if quick else 5):
        whole.append(program("relocalize", log, "--duration", "15", "-d", database, environment=cache).time)
        bare.append(bare_kiss(log, 15.0).same)
    took, kiss = median(whole), median(bare)
    yield Row(
        what="relocalize a 15 s log, process start to answer, without KISS-ICP",
        measured=took.wall - kiss.wall,
        cpu=took.cpu - kiss.cpu,
        unit="s",
        goal=3.0,
        note=f"cpu: {took.cpu:.1f} s in all, KISS-ICP alone {kiss.cpu:.1f} s",
    )
