"""A recording located by the program, from its start to the answer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import material
from measure import Row, median, program
from reading import bare_kiss


def relocalize_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid relocalize` on 15 s of a log, less what KISS-ICP alone needs for its scans."""
    building, log = folder / "monday.mcap", folder / "tuesday.mcap"
    material.lidar_log(building, 10.0 if quick else 60.0, seed=0)
    material.lidar_log(log, 12.0, seed=1)
    database = folder / "building.submaps"
    program("convert", building, "-o", database)
    program("relocalize", log, "--duration", "2", "-d", database)  # compiles
    whole, bare = [], []
    for _ in range(1 if quick else 5):
        whole.append(program("relocalize", log, "--duration", "15", "-d", database).time)
        bare.append(bare_kiss(log, 15.0).same)
    took, kiss = median(whole), median(bare)
    yield Row(
        what="relocalize a 15 s log, process start to answer, less KISS-ICP",
        measured=took.wall - kiss.wall,
        cpu=took.cpu - kiss.cpu,
        unit="s",
        goal=3.0,
        note=f"cpu: {took.cpu:.1f} s in all, KISS-ICP alone {kiss.cpu:.1f} s",
    )
