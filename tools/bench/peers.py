"""pc2grid, MapClosures and KISS-Matcher locate the same robot in the same building, in turn.

The peers need other versions of libraries than pc2grid. Each runs in a process of its own, in an environment
that is made at the first use.
"""

from __future__ import annotations

import contextlib
import json
import math
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fixtures
import numpy as np
from measure import ROOT, Row, Time, median, timed

from pc2grid.geometry import SE2, wrap_angle
from signature.config import Config
from signature.relocalization.hypotheses import Hypothesis
from signature.relocalization.relocalizer import MapIndex

PINS = ("map-closures==2.2.0", "kiss-matcher==1.0.2")
ENVIRONMENT = ROOT / ".venv" / "peers"
MAP_M, WINDOW_M = 150.0, 15.0
MAPPED_M = 3.0
"""Queries that end farther than this from the path of the map are left out: no answer is right."""


def compare(folder: Path, quick: bool) -> Iterator[Row]:
    """Time from the query's grid (peers: its points) to its pose; right is within 1 m and 10 degrees."""
    config = Config()
    scans = list(fixtures.drive(30.0 if quick else MAP_M, seed=0))
    index = fixtures.index_of(fixtures.grid_of(scans), config)
    np.save(
        folder / "path.npy", np.array([(k.T_map_base.x, k.T_map_base.y, k.T_map_base.yaw) for k in scans])
    )
    np.savez(folder / "map.npz", *(scan.points_m for scan in scans))
    queries = [
        window
        for seed in ((1,) if quick else (1, 2, 3))
        for window in _windows(list(fixtures.drive(16.0 if quick else 62.0, seed=seed)))
        if min(math.dist(_xy(window[-1]), _xy(scan)) for scan in scans) < MAPPED_M
    ]
    for number, window in enumerate(queries):
        T_query_map = window[-1].T_map_base.inverse().lift()
        np.savez(
            folder / f"query{number}.npz",
            *(k.points_m @ T_query_map[:3, :3].T + T_query_map[:3, 3] for k in window),
        )
    names = ("map_closures", "kiss_matcher")
    times: dict[str, list[Time]] = {name: [] for name in ("pc2grid", *names)}
    right = dict.fromkeys(times, 0)
    with contextlib.ExitStack() as stack:
        children = {name: stack.enter_context(_Peer(name, folder)) for name in names}
        index.look_up(fixtures.query_map(queries[0], config))  # compiles
        for number, window in enumerate(queries):
            truth = window[-1].T_map_base
            taken, pose = _ours(window, index, config)
            answers = {"pc2grid": (taken, pose)}
            for name, child in children.items():
                answers[name] = child.ask(number)
            for name, (taken, pose) in answers.items():
                times[name].append(taken)
                right[name] += pose is not None and _near(pose, truth)
    places = len(index.places.table)
    for name, values in times.items():
        wall, cpu = median(values).times(1e3)
        goal = 60.0 if name == "pc2grid" else None
        yield Row(
            what=f"query to pose in {places} submaps, {name}",
            measured=wall,
            cpu=cpu,
            unit="ms",
            goal=goal,
            note=f"right {right[name]} of {len(queries)}, after {WINDOW_M:.0f} m of travel",
        )
    for name in names:
        ratio = statistics.median(a.cpu / b.cpu for a, b in zip(times["pc2grid"], times[name], strict=True))
        yield Row(what=f"pc2grid over {name}", measured=ratio, unit="x", goal=1.0)


def _xy(scan: fixtures.PosedScan) -> tuple[float, float]:
    return scan.T_map_base.x, scan.T_map_base.y


def _windows(scans: list[fixtures.PosedScan]) -> Iterator[list[fixtures.PosedScan]]:
    """The scans of each 15 m of travel."""
    start, path_m = 0, 0.0
    for k in range(1, len(scans)):
        a, b = scans[k - 1].T_map_base, scans[k].T_map_base
        path_m += math.hypot(b.x - a.x, b.y - a.y)
        if path_m >= WINDOW_M:
            yield scans[start : k + 1]
            start, path_m = k + 1, 0.0


def _ours(window: list[fixtures.PosedScan], index: MapIndex, config: Config) -> tuple[Time, SE2 | None]:
    grid = fixtures.grid_of(window)
    found: list[tuple[Hypothesis, ...]] = []

    def locate() -> None:
        query = fixtures.query_map(window, config, grid)
        found.append(index.look_up(query))
        index.judge(query, found[0])

    taken = timed(locate)
    return taken, found[0][0].fit.T_map_query @ window[-1].T_map_base if found[0] else None


def _near(pose: SE2, truth: SE2) -> bool:
    return math.hypot(pose.x - truth.x, pose.y - truth.y) < 1.0 and abs(
        wrap_angle(pose.yaw - truth.yaw)
    ) < math.radians(10.0)


class _Peer:
    """A peer in its own process: it reads the number of a query in each line, and writes a line of JSON."""

    def __init__(self, name: str, folder: Path) -> None:
        if not (ENVIRONMENT / "bin" / "python").exists():
            subprocess.run([sys.executable, "-m", "venv", ENVIRONMENT], check=True)
            pip = [ENVIRONMENT / "bin" / "python", "-m", "pip", "install", "-q", *PINS]
            subprocess.run(pip, check=True, stdout=sys.stderr)
        code = Path(__file__).with_name("peer.py")
        self._process = subprocess.Popen(
            [ENVIRONMENT / "bin" / "python", code, name, folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._in, self._out = self._process.stdin, self._process.stdout

    def ask(self, number: int) -> tuple[Time, SE2 | None]:
        """The time of the query, and the pose of the base in the map."""
        print(number, file=self._in, flush=True)
        answer = json.loads(self._out.readline())
        return Time(*answer["seconds"]), SE2(*answer["pose"]) if answer["pose"] else None

    def __enter__(self) -> _Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._in.close()
        self._process.wait()
