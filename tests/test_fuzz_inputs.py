"""Seeded mutations of inputs: what is inside the messages of a recording, databases, nav2 maps.

The containers of recordings are mutated in tests/pc2grid/io/test_fuzz.py, where checksums catch most of it.
Here the container stays sound and its content is wrong, so that decoders behind the checksums are reached.
Whatever is changed, the result is whole and possible, or a Pc2GridError; never another exception.
PC2GRID_FUZZ is the number of mutations of each kind; from 100 on, every outcome must occur.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from pc2grid.errors import DatabaseError, MapFileError, Pc2GridError
from pc2grid.io.maps import load_map, save_map
from pc2grid.model import OccupancyGrid
from pc2grid.settings import ReadConfig
from signature.database import open_database
from signature.database.maintenance import check, copy, store
from tests.helpers import foxglove_messages as foxglove
from tests.helpers.databases import digests_of, make_entry
from tests.helpers.memory import bounded_memory
from tests.helpers.mutations import ENOUGH, MOST_BYTES, PARTS, ROUNDS, mutated, patiently, put
from tests.helpers.recordings import STEP, T0, Message, drive, read, ros, write_mcap

RECORDINGS = ["lidar", "lidar ros1", "laser", "depth", "foxglove protobuf", "foxglove json", "lidar timed"]
# Times within a scan are at most 10 s away from its stamp, and span 2 s.
FARTHEST_S = 12.0


# --- recordings ---------------------------------------------------------------------------------------


class Record(NamedTuple):
    """A message with its topic, type and time."""

    topic: str
    type: str
    schema_encoding: str
    schema: bytes
    encoding: str
    log_time_ns: int
    data: bytes


def recording(folder: Path, kind: str) -> Path:
    """A small log of six scans."""
    path, to, rng = folder / "clean.mcap", ros(), np.random.default_rng(1)
    stamps = [T0 + i * STEP for i in range(6)]
    if kind == "lidar timed":
        mount = to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")
        return write_mcap(path, [mount, *(timed_cloud(t, rng.uniform(1, 9, (20, 3))) for t in stamps)])
    if kind.startswith("lidar"):
        dialect = "ros1" if kind == "lidar ros1" else "ros2"
        return write_mcap(path, drive(dialect, 6), dialect)
    if kind == "laser":
        mount = to.tf(T0, "base_link", "laser", 0.2, topic="/tf_static")
        return write_mcap(path, [mount, *(to.laser("/scan", t, rng.uniform(1, 9, 30)) for t in stamps)])
    if kind == "depth":
        camera = [to.camera("/camera/depth/camera_info", t, 8, 6, 10.0) for t in stamps]
        images = [
            to.image("/camera/depth/image", t, rng.integers(500, 3000, (6, 8)).astype("<u2"), "16UC1")
            for t in stamps
        ]
        return write_mcap(path, [m for pair in zip(camera, images, strict=True) for m in pair])
    contents = [foxglove.cloud(t, rng.uniform(1, 9, (5, 3))) for t in stamps]
    mount = ("/tf", "FrameTransform", T0, foxglove.edge(T0, "base_link", "lidar", 0.2))
    return foxglove.write(path, [mount, *contents], kind.split()[1])


def timed_cloud(stamp_ns: int, points_m: np.ndarray) -> Message:
    """A cloud of 0.1 s, with the nanoseconds of each point since the stamp."""
    to, count = ros(), len(points_m)
    rows = np.zeros(count, [("xyz", "<f4", 3), ("t", "<u4")])
    rows["xyz"], rows["t"] = points_m, np.linspace(0, 1e8, count)
    fields = [
        to.make("sensor_msgs/PointField", name, 4 * i, datatype, 1)
        for i, (name, datatype) in enumerate(zip("xyzt", (7, 7, 7, 6), strict=True))
    ]
    data, header = np.frombuffer(rows.tobytes(), np.uint8), to.header(stamp_ns, "lidar")
    cloud = to.make("sensor_msgs/PointCloud2", header, 1, count, fields, False, 16, 16 * count, data, True)
    return to.message("/points", stamp_ns, cloud)


def records(path: Path) -> list[Record]:
    with path.open("rb") as stream:
        return [
            Record(c.topic, s.name, s.encoding, s.data, c.message_encoding, m.log_time, m.data)
            for s, c, m in make_reader(stream).iter_messages()
            if s is not None
        ]


def write(path: Path, entries: list[Record]) -> None:
    """A sound container around the entries, whatever they are."""
    path.unlink(missing_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schemas: dict[tuple[str, str, bytes], int] = {}
        channels: dict[tuple[str, str, int], int] = {}
        for entry in entries:
            key = (entry.type, entry.schema_encoding, entry.schema)
            schema = schemas.get(key) or schemas.setdefault(key, writer.register_schema(*key))
            line = (entry.topic, entry.encoding, schema)
            channel = channels.get(line) or channels.setdefault(line, writer.register_channel(*line))
            writer.add_message(channel, entry.log_time_ns, entry.data, entry.log_time_ns)
        writer.finish()


def assert_possible(path: Path, config: ReadConfig | None, recover: bool) -> None:
    """What is read is possible: finite, in order, fields aligned, times near the stamp."""
    scans, report = read(path, config, recover=recover)
    assert report.scans_read == len(scans)
    last = -1
    for scan in scans:
        assert scan.stamp_ns > last
        last = scan.stamp_ns
        assert scan.points_m.ndim == 2
        assert scan.points_m.shape[1] == 3
        assert np.isfinite(scan.points_m).all()
        if scan.offsets_s is not None:
            assert len(scan.offsets_s) == len(scan.points_m)
            assert (np.abs(scan.offsets_s) <= FARTHEST_S).all()
        assert np.isfinite(scan.T_base_sensor).all()
        assert scan.T_odom_base is None or np.isfinite(scan.T_odom_base).all()


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("kind", RECORDINGS)
@bounded_memory(MOST_BYTES)
def test_fuzz_content_of_recordings(tmp_path: Path, kind: str, part: int) -> None:
    clean = records(recording(tmp_path, kind))
    path = tmp_path / "x.mcap"
    write(path, clean)
    assert len(read(path)[0]) == 6
    rng = np.random.default_rng([RECORDINGS.index(kind), part])
    outcomes = {"read": 0, "refused": 0}
    for number in patiently():
        entries = list(clean)
        at = int(rng.integers(len(entries)))
        if rng.random() < 0.2:  # the schema, everywhere that it is used
            schema = mutated(entries[at].schema, rng)
            kind_of_it = entries[at].type
            entries = [e._replace(schema=schema) if e.type == kind_of_it else e for e in entries]
        else:
            entries[at] = entries[at]._replace(data=mutated(entries[at].data, rng))
        write(path, entries)
        try:
            named = kind == "lidar timed" and number % 4 < 2  # else the unit is told by the times
            config = ReadConfig(point_time="ns") if named else None
            assert_possible(path, config, recover=bool(number % 2))
        except Pc2GridError as error:
            assert error.message
            assert "\n" not in error.message
            outcomes["refused"] += 1
        except Exception as error:
            raise AssertionError(f"{kind}, mutation {number}: {error!r}") from error
        else:
            outcomes["read"] += 1
    assert min(outcomes.values()) > 0 or ROUNDS < ENOUGH, outcomes


# --- databases ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", range(PARTS))
@bounded_memory(MOST_BYTES)
def test_fuzz_databases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    """Mutated files are read whole, or refused; what is left of them is read, and copied or added to."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # no power failure is simulated here
    path, saved = tmp_path / "x.submaps", tmp_path / "saved.submaps"
    names = ["monday", "tuesday"]
    store(path, [make_entry(name, i, submaps=2) for i, name in enumerate(names)], keep=False)
    whole = path.read_bytes()
    with open_database(path) as database:
        clean = digests_of(database)
    sunday = make_entry("sunday", 9, submaps=1)
    rng = np.random.default_rng([44, part])
    outcomes = {"whole": 0, "refused": 0, "left out": 0, "saved": 0, "added": 0}
    for number in patiently():
        content = mutated(whole, rng)
        put(path, content)
        whole_again = False
        try:
            with open_database(path) as database:
                assert digests_of(database) == clean
            outcomes["whole"] += 1
            whole_again = True
        except DatabaseError:
            outcomes["refused"] += 1
        if not whole_again or number % 4 == 0:  # nothing is to be left out: tried for every fourth only
            try:
                with open_database(path) as database:
                    left_out = database.leave_out_damaged()
                    rest = digests_of(database)
                assert rest.items() <= clean.items()
                assert len(rest) >= len(names) - len(left_out)
                assert rest == clean or not whole_again
                outcomes["left out"] += bool(left_out)
            except DatabaseError:
                assert not whole_again
        try:
            if number % 5 == 0:  # costs more than all the rest
                problems = check(path)
                copy(path, saved, recover=True, overwrite=True)
                assert check(saved) == ()
                with open_database(saved) as database:
                    found = digests_of(database)
                assert found.keys() <= clean.keys()
                assert found == clean or problems
                outcomes["saved"] += bool(found) and bool(problems)
            else:
                store(path, [sunday], keep=True)
                outcomes["added"] += 1
        except DatabaseError:
            assert path.read_bytes() == content
        assert set(tmp_path.iterdir()) <= {path, saved}
    assert min(outcomes.values()) > 0 or ROUNDS < ENOUGH, outcomes


# --- maps ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("image_format", ["pgm", "png"])
@bounded_memory(MOST_BYTES)
def test_fuzz_maps(tmp_path: Path, image_format: str, part: int) -> None:
    """A map has no checksum: what loads must at least be a map, and an error must name the file."""
    cells = np.random.default_rng(2).choice(np.array([-1, 0, 100], np.int8), (12, 17))
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-1.5, 2.0))
    yaml_path, image_path = save_map(grid, tmp_path / "map", image_format=image_format)
    texts = {file: file.read_bytes() for file in (yaml_path, image_path)}
    rng = np.random.default_rng([46, part])
    outcomes = {"loaded": 0, "refused": 0}
    for number in patiently():
        for file, text in texts.items():
            put(file, text)
        victim = (yaml_path, image_path)[number % 2]
        put(victim, mutated(texts[victim], rng))
        try:
            loaded = load_map(yaml_path)
        except MapFileError as error:
            assert str(tmp_path) in error.message
            assert "\n" not in error.message
            outcomes["refused"] += 1
            continue
        except Exception as error:
            raise AssertionError(f"{victim.name}, mutation {number}: {error!r}") from error
        assert loaded.cells.dtype == np.int8
        assert -1 <= loaded.cells.min() <= loaded.cells.max() <= 100
        assert loaded.resolution_m > 0
        assert np.isfinite([loaded.resolution_m, *loaded.origin_m]).all()
        outcomes["loaded"] += 1
    assert min(outcomes.values()) > 0 or ROUNDS < ENOUGH, outcomes
