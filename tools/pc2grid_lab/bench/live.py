"""A running robot: lag of each sensor, what is dropped, and whether memory stays flat.

The robot is another process, which replays a simulated drive in real time over the Foxglove websocket.
"""

from __future__ import annotations

import gc
import resource
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pc2grid.config import ReadConfig
from pc2grid.io import open_log
from pc2grid.io.live.feed import News
from pc2grid.io.live.inbox import Arrived, FeedCounts
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.targets import open_live
from pc2grid.io.message_source import RawMessage, TopicInfo
from pc2grid.io.nav2_map import save_map
from pc2grid.pipeline import follow
from pc2grid.simulate import SimulationConfig, office_floorplan, simulate_session
from pc2grid.simulate.config import DepthConfig, LaserConfig
from pc2grid.simulate.record import TOPICS
from pc2grid_lab.bench.measure import ROOT, Row
from signature.config import Config
from signature.database import open_database
from signature.localization.follower import Follower
from signature.localization.localizer import Localizer, MapIndex, locate
from signature.sessions import add_sessions, build_session

_ROBOT = (
    "import sys, pathlib\n"
    "from tests.helpers.robot import Recorded, Robot\n"
    "recorded = Recorded.read(pathlib.Path(sys.argv[1]))\n"
    "with Robot(recorded, begin_topic=sys.argv[2]).running() as robot:\n"
    "    print(robot.url, flush=True)\n"
    "    sys.stdin.read()\n"
)

SENSORS = {"laser": "laser, 40 Hz", "lidar": "lidar, 10 Hz", "depth": "depth 640x480, 15 Hz"}


def simulated(folder: Path, kind: str, length_m: float) -> tuple[Path, str]:
    """A drive through the office by one sensor, at the rate of a usual device; and the topic of its scans."""
    config = SimulationConfig(
        length_m=length_m,
        seed=3,
        laser=LaserConfig(rate_hz=40.0, step_deg=0.25),
        depth=DepthConfig(width=640, height=480, rate_hz=15.0),
    )
    path = folder / f"{kind}.mcap"
    if not path.exists():
        simulate_session(path, sensor=kind, grid=office_floorplan(0), config=config)
    return path, TOPICS[kind]


def database_of(folder: Path) -> Path:
    """A database of the office's plan."""
    path = folder / "office.submaps"
    if not path.exists():
        save_map(office_floorplan(0), folder / "office")
        add_sessions(path, [build_session(folder / "office.yaml", "office", Config())], Config(), keep=False)
    return path


def lag(folder: Path, quick: bool) -> Iterator[Row]:
    """Time from the arrival of a scan to the end of its tracking, 95th percentile, for each sensor."""
    database = database_of(folder)
    for kind, what in (
        ("laser", "laser, 40 Hz"),
        ("lidar", "lidar, 10 Hz"),
        ("depth", "depth 640x480, 15 Hz"),
    ):
        path, topic = simulated(folder, kind, 5.0 if quick else 10.0)
        warm_up(path, database)
        robot = subprocess.Popen(
            [sys.executable, "-c", _ROBOT, str(path), topic],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert robot.stdout is not None
        url = robot.stdout.readline().strip()
        lags: list[float] = []
        cpu_s = time.process_time()
        with open_database(database) as opened, open_live(url, ReadConfig()) as live:
            localizer = Localizer(MapIndex.of(opened, opened.config()))
            live.on_poll = Stopped(live)
            live.choose()
            count = 0
            with Follower(localizer, beside=True) as follower:
                for registered, planar_scan in follow(live.scans(), opened.config()):
                    # The lag is that of the scan before; those held back for the plan have waited on purpose.
                    if live.feed.keeps_up:
                        lags.append(live.lag_s)
                    count += 1
                    follower.add(registered, planar_scan)
                follower.finish()
                at_m = [look.answer.path_m for look in follower.take() if look.state == "located"]
                located_m = min(at_m, default=None)
            dropped = live.feed.counts.dropped
        cpu_s = time.process_time() - cpu_s
        robot.communicate()
        located = "not located" if located_m is None else f"located after {located_m:.1f} m"
        yield Row(
            what=f"lag of a running robot's scans, 95th percentile: {what}",
            measured=float(np.percentile(lags, 95)) if lags else None,
            unit="s",
            goal=0.2,
            note=f"median {np.median(lags) if lags else 0:.3f} s, {count} scans used, {dropped} dropped,"
            f" {located}, cpu {1000 * cpu_s / max(count, 1):.0f} ms a scan with looks",
        )


def warm_up(path: Path, database: Path) -> None:
    """Use each function once: the first use compiles it."""
    with open_database(database) as opened, open_log(path) as log:
        locate(follow(log.scans(0.0, 2.0), opened.config()), opened, opened.config())


def memory(folder: Path, quick: bool) -> Iterator[Row]:
    """Memory of `watch --keep` while a laser drives to and fro, as fast as it can be followed."""
    robot_s = 300.0 if quick else 3600.0
    path, _ = simulated(folder, "laser", 8.0)
    database = database_of(folder)
    sizes: list[tuple[float, int]] = []
    with open_database(database) as opened, LiveLog(ToAndFro(path, robot_s), ReadConfig()) as live:
        localizer = Localizer(MapIndex.of(opened, opened.config()))
        with Follower(localizer, beside=False) as follower:
            first_ns: int | None = None
            for registered, planar_scan in follow(live.scans(), opened.config()):
                follower.add(registered, planar_scan)
                follower.take()
                stamp_ns = registered.scan.stamp_ns
                first_ns = stamp_ns if first_ns is None else first_ns
                if not sizes or (stamp_ns - first_ns) * 1e-9 - sizes[-1][0] > 10.0:
                    gc.collect()
                    sizes.append(((stamp_ns - first_ns) * 1e-9, _rss_bytes()))
    after = [size for seconds, size in sizes if seconds > robot_s / 4]
    begin, end = np.median(after[: len(after) // 3]), np.median(after[-len(after) // 3 :])
    yield Row(
        what=f"memory of following a laser for {robot_s:.0f} s: last third over first third, after a quarter",
        measured=float(100.0 * (end / begin - 1.0)),
        unit="%",
        goal=5.0,
        note=f"{begin / 1e6:.0f} MB, then {end / 1e6:.0f} MB",
    )


class Stopped:
    """Whether the robot has sent nothing, and nothing was used, for some seconds."""

    def __init__(self, live: LiveLog) -> None:
        self._live, self._before, self._last_s = live, (-1, -1), 0.0

    def __call__(self) -> bool:
        """Whether it has stopped."""
        now = self._live.feed.counts.arrived, self._live.report().scans_read
        if now != self._before:
            self._before, self._last_s = now, time.monotonic()
        return time.monotonic() - self._last_s > 5.0


class ToAndFro:
    """A feed of a recording that is played forwards and backwards, with stamps that go on."""

    connected = True

    def __init__(self, path: Path, robot_s: float) -> None:
        from mcap.reader import make_reader

        self.name = path.name
        self.counts, self.news = FeedCounts(), News()
        self._topics: dict[str, TopicInfo] = {}
        recorded = []
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                kind = schema.name.replace("/msg/", "/")
                info = TopicInfo(topic=channel.topic, type=kind, encoding="cdr")
                known = self._topics.setdefault(channel.topic, info)
                # A tenth of the scans: a laser at 4 Hz.
                recorded.append((known, message.log_time, message.data))
        scans = 0
        self._recorded = []
        for entry in recorded:
            scans += entry[0].topic == "/scan"
            if entry[0].topic != "/scan" or scans % 8 == 0:
                self._recorded.append(entry)
        self._messages = self._play(robot_s)
        self._over = False

    def _play(self, robot_s: float) -> Iterator[object]:
        first, last = self._recorded[0][1], self._recorded[-1][1]
        span, played = last - first, 0
        while played * span < robot_s * 1e9:
            backwards = played % 2 == 1
            entries = reversed(self._recorded) if backwards else self._recorded
            for topic, time_ns, data in entries:
                at = (last - time_ns if backwards else time_ns - first) + first + played * span
                if topic.topic == "/tf_static":
                    if played == 0:
                        yield Arrived(RawMessage(topic, at, data), time.monotonic())
                    continue
                offset = 8 if topic.topic == "/tf" else 4
                stamped = data[:offset] + struct.pack("<iI", *divmod(at, 10**9)) + data[offset + 8 :]
                yield Arrived(RawMessage(topic, at, stamped), time.monotonic())
            played += 1

    @property
    def ended(self) -> bool:
        """Whether the time is over."""
        return self._over

    def topics(self) -> tuple[object, ...]:
        """The topics of the recording."""
        return tuple(self._topics.values())

    def want(self, topics: object) -> None:
        """All messages are sent."""

    def pending(self, topics: object) -> Sequence[object]:
        """Nothing waits."""
        return ()

    def receive(self, timeout_s: float) -> object:
        """The next message."""
        found = next(self._messages, None)
        self._over = found is None
        return found

    def close(self) -> None:
        """Nothing is open."""


def _rss_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
