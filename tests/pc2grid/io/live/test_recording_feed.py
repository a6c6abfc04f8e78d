"""Recordings that are still being written give the scans that the finished ones give."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogNotFound, NotALog
from pc2grid.io import open_log
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.mcap_tail import McapTail
from pc2grid.io.live.standard_input import StandardInput
from pc2grid.io.live.targets import open_live
from pc2grid.model import Scan
from tests.helpers.growing import Recorder, laser_drive
from tests.helpers.recordings import T0, Message, ros, write_mcap, write_rosbag2

ALL_S = 1e6
SMALL = {"chunk_size": 4000}


def same(found: Sequence[Scan], expected: Sequence[Scan]) -> None:
    """Whether scans are equal to the last bit."""
    assert [s.stamp_ns for s in found] == [s.stamp_ns for s in expected]
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.points_m, b.points_m)
        np.testing.assert_array_equal(a.T_base_sensor, b.T_base_sensor)
        assert a.T_odom_base is not None
        assert b.T_odom_base is not None
        np.testing.assert_array_equal(a.T_odom_base, b.T_odom_base)


def scans_of(live: LiveLog) -> list[Scan]:
    with live:
        return list(live.scans())


@pytest.fixture(scope="module")
def messages() -> list[Message]:
    return laser_drive()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> list[Scan]:
    path = write_mcap(tmp_path_factory.mktemp("finished") / "a.mcap", messages)
    with open_log(path) as log:
        return list(log.scans())


@pytest.mark.parametrize("options", [SMALL, {"use_chunking": False}, {**SMALL, "use_message_index": False}])
def test_a_finished_file_gives_the_same_scans(
    tmp_path: Path, messages: list[Message], finished: list[Scan], options: dict[str, object]
) -> None:
    path = tmp_path / "a.mcap"
    if "use_message_index" in options:
        from mcap.writer import IndexType

        options = {**SMALL, "index_types": IndexType.NONE}
    recorder = Recorder(path, **options)
    recorder.add(messages)
    recorder.finish()
    same(scans_of(open_live(str(path), last_s=ALL_S)), finished)
    # Of the last two seconds, with the static tf that was published long before.
    tail = scans_of(open_live(str(path), last_s=2.0))
    newest_ns = max(m.log_time_ns for m in messages)
    same(tail, [s for s in finished if s.stamp_ns >= newest_ns - 2 * 10**9])


@pytest.mark.parametrize("options", [SMALL, {"use_chunking": False}])
def test_a_growing_file_gives_the_same_scans(
    tmp_path: Path, messages: list[Message], finished: list[Scan], options: dict[str, object]
) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path, **options)
    recorder.add(messages[:150])

    def record() -> None:
        for start in range(150, len(messages), 20):
            recorder.add(messages[start : start + 20])
            time.sleep(0.01)
        recorder.finish()

    thread = threading.Thread(target=record)
    with open_live(str(path), last_s=ALL_S) as live:
        thread.start()
        same(list(live.scans()), finished)
        assert live.ended
    thread.join()


def test_bytes_that_come_some_at_a_time_are_whole_messages(tmp_path: Path, messages: list[Message]) -> None:
    recorded, path = tmp_path / "recorded.mcap", tmp_path / "a.mcap"
    recorder = Recorder(recorded, **SMALL)
    recorder.add(messages)
    recorder.finish()
    data = recorded.read_bytes()
    path.touch()
    tail = McapTail.of_file(path, ReadConfig())
    found = []
    with path.open("ab") as growing:
        for at in range(0, len(data), 777):
            growing.write(data[at : at + 777])
            growing.flush()
            found += list(tail.read())
    assert [(m.channel.topic, m.log_time_ns, bytes(m.data)) for m in found] == [
        (m.topic, m.log_time_ns, m.data) for m in messages
    ]
    assert tail.ended
    tail.close()


def test_nothing_is_read_twice(
    tmp_path: Path, messages: list[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    recorder = Recorder(path, **SMALL)
    recorder.add(messages)
    growing = McapTail.of_file(path, ReadConfig())
    newest_ns = growing.newest_ns()
    assert newest_ns is not None
    growing.skip_to(newest_ns - 10**9)
    first = list(growing.read())
    assert first[0].channel.topic == "/tf_static"
    assert min(m.log_time_ns for m in first[1:]) >= max(m.log_time_ns for m in first) - 10**9
    assert not list(growing.read())
    at = growing.position
    assert at == path.stat().st_size
    later = [m._replace(log_time_ns=m.log_time_ns + 10**11) for m in messages[1:]]
    recorder.add(later)
    recorder.finish()
    found = [m for _ in range(5) for m in growing.read()]
    unwritten = [m for m in messages[1:] if m.log_time_ns > first[-1].log_time_ns]  # of the open chunk
    assert len(found) == len(later) + len(unwritten)
    assert growing.ended
    growing.close()


def test_standard_input_gives_the_same_scans(
    tmp_path: Path, messages: list[Message], finished: list[Scan]
) -> None:
    path = write_mcap(tmp_path / "a.mcap", messages)
    read_end, write_end = os.pipe()

    def send() -> None:
        with path.open("rb") as file, os.fdopen(write_end, "wb") as pipe:
            while block := file.read(1000):
                pipe.write(block)

    thread = threading.Thread(target=send)
    thread.start()
    with LiveLog(StandardInput(ReadConfig(), read_end), ReadConfig()) as live:
        same(list(live.scans()), finished)
        assert live.ended
        assert live.feed.counts.dropped == 0
    thread.join()
    os.close(read_end)


def test_what_is_not_an_mcap_is_refused_on_standard_input() -> None:
    read_end, write_end = os.pipe()
    os.write(write_end, b"#ROSBAG V2.0\n" + bytes(100))
    os.close(write_end)
    with pytest.raises(NotALog, match="standard input: not an MCAP"):
        scans_of(LiveLog(StandardInput(ReadConfig(), read_end), ReadConfig()))
    os.close(read_end)


# --- folders --------------------------------------------------------------------------------------------


def test_a_finished_folder_gives_the_same_scans(
    tmp_path: Path, messages: list[Message], finished: list[Scan]
) -> None:
    folder = write_rosbag2(tmp_path / "bag", messages, "mcap")
    same(scans_of(open_live(str(folder), last_s=ALL_S)), finished)


def in_parts(folder: Path, parts: Sequence[Sequence[Message]]) -> None:
    """A finished folder of several files."""
    folder.mkdir()
    for number, part in enumerate(parts):
        recorder = Recorder(folder / f"bag_{number}.mcap", **SMALL)
        recorder.add(part)
        recorder.finish()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")


def test_the_last_seconds_of_a_folder_may_begin_in_any_file(
    tmp_path: Path, messages: list[Message], finished: list[Scan]
) -> None:
    folder = tmp_path / "bag"
    in_parts(folder, [messages[:100], messages[100:320], messages[320:]])
    newest_ns = max(m.log_time_ns for m in messages)
    for last_s in (1.0, 2.0, 7.0):
        tail = scans_of(open_live(str(folder), last_s=last_s))
        same(tail, [s for s in finished if s.stamp_ns >= newest_ns - round(last_s * 1e9)])


def test_a_damaged_file_is_left_out_where_another_follows(tmp_path: Path, messages: list[Message]) -> None:
    folder = tmp_path / "bag"
    in_parts(folder, [messages[:100], messages[100:200], messages[200:]])
    middle = folder / "bag_1.mcap"
    data = bytearray(middle.read_bytes())
    data[3000:3100] = bytes(100)
    middle.write_bytes(data)
    with open_live(str(folder), last_s=ALL_S) as live:
        stamps = [scan.stamp_ns for scan in live.scans()]
        assert any("bag_1.mcap" in told and "left out" in told for told in live.feed.news.take())
    assert stamps[-1] == max(m.log_time_ns for m in messages if m.topic == "/scan")


def test_a_folder_that_is_split_while_it_is_followed(
    tmp_path: Path, messages: list[Message], finished: list[Scan]
) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    parts = [messages[:100], messages[100:200], messages[200:]]
    recorder = Recorder(folder / "bag_0.mcap", **SMALL)
    recorder.add(parts[0])
    recorder.finish()
    recorder = Recorder(folder / "bag_1.mcap", **SMALL)
    recorder.add(parts[1])

    def record() -> None:
        recorder.finish()
        last = Recorder(folder / "bag_2.mcap", **SMALL)
        last.add(parts[2])
        time.sleep(0.1)
        last.finish()
        (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")

    thread = threading.Thread(target=record)
    with open_live(str(folder), last_s=ALL_S) as live:
        thread.start()
        same(list(live.scans()), finished)
    thread.join()


# --- what can be wrong ----------------------------------------------------------------------------------


def test_what_cannot_be_followed_is_refused_with_what_can(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("not a recording")
    (tmp_path / "empty").mkdir()
    write_rosbag2(tmp_path / "bag", laser_drive(3), "sqlite3")
    (tmp_path / "a.db3").write_bytes(next((tmp_path / "bag").glob("*.db3")).read_bytes())
    os.mkfifo(tmp_path / "pipe")
    for target, kind, words in (
        ("a.txt", NotALog, "not a recording that can be followed"),
        ("bag", LogNotFound, "holds no .mcap"),
        ("a.db3", NotALog, "not a recording that can be followed"),
        ("empty", LogNotFound, "a folder without a recording"),
        ("pipe", LogNotFound, "watch - <"),
        ("missing", LogNotFound, "no such file"),
    ):
        with pytest.raises(kind, match=words):
            open_live(str(tmp_path / target))
    with pytest.raises(LogNotFound, match="rosbridge:// is not known"):
        open_live("rosbridge://robot:9090")


def test_damage_is_named(tmp_path: Path, messages: list[Message]) -> None:
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_size=4000)
    data = bytearray(path.read_bytes())
    data[3000:3100] = bytes(100)
    path.write_bytes(data)
    with pytest.raises(LogCorrupt, match=r"a\.mcap: .*at byte"):
        scans_of(open_live(str(path), last_s=ALL_S))


def test_the_calibration_of_a_camera_is_found_before_the_last_seconds(tmp_path: Path) -> None:
    to = ros()
    pixels = np.full((4, 6), 2000, np.uint16)
    messages = [to.camera("/depth/camera_info", T0, 6, 4, 5.0)]
    messages += [to.image("/depth/image", T0 + i * 10**8, pixels, "16UC1") for i in range(100)]
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_size=500)
    assert len(scans_of(open_live(str(path), last_s=2.0))) == 21
