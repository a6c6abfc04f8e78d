"""Losses that a search with mutations found to pass unseen, or to be read as something else."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, LogCorrupt
from tests.builders import check_drive, drive, read, write_bag, write_mcap, write_rosbag2
from tests.watching import bounded_memory


def test_tf_may_be_among_what_is_lost_without_a_trace(tmp_path: Path) -> None:
    """The chunk with tf and its channel is damaged, and so is the index: no guess where the sensor is."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=200, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    place = content.index(b"/tf_static")
    content[place : place + 4] = b"\xff\xff\xff\xff"
    (tmp_path / "b.mcap").write_bytes(content[:-100])
    with pytest.raises(FrameError, match="tf does not connect frame lidar to the base") as caught:
        read(tmp_path / "b.mcap", recover=True)
    assert "assume_identity" in str(caught.value.hint)
    scans, report = read(tmp_path / "b.mcap", ReadConfig(assume_identity=True), recover=True)
    assert scans
    assert report.lossy


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
@pytest.mark.parametrize("word", [b"topic=/tf_static", b"type=tf2_msgs/TFMessage", b"message_definition=geo"])
def test_topic_that_the_index_of_a_bag_calls_otherwise(tmp_path: Path, word: bytes, compression: str) -> None:
    """Without its tf every scan would be shifted: a bit in the index, behind all chunks, decided on that."""
    path = write_bag(tmp_path / "a.bag", drive("ros1"), compression)
    content = bytearray(path.read_bytes())
    place = content.rindex(word)
    if word.startswith(b"topic"):  # stands twice in each record, and the first counts
        place = content.rindex(word, 0, place)
    content[place + len(word) - 1] ^= 4
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"the index (describes|does not)") as caught:
        read(path)
    assert "--recover" in str(caught.value.hint)
    scans, report = read(path, recover=True)
    check_drive(scans)
    assert not report.lossy


def test_index_of_a_bag_that_leads_to_an_absurd_length(tmp_path: Path) -> None:
    """What stands where a chunk should begin is taken for a length of 4 GB; as much was set aside for it."""
    path = write_bag(tmp_path / "a.bag", drive("ros1"), "bz2")
    content = bytearray(path.read_bytes())
    place = content.rindex(b"chunk_pos=") + len(b"chunk_pos=")
    wrong = content.index(b"index_pos=") - 6  # in the header, where bytes of a name follow
    content[place : place + 8] = wrong.to_bytes(8, "little")
    path.write_bytes(content)
    with bounded_memory(100 << 20), pytest.raises(LogCorrupt, match="where a record should begin"):
        read(path)
    scans, _ = read(path, recover=True)
    check_drive(scans)


def test_page_of_a_db3_that_was_made_to_look_empty(tmp_path: Path) -> None:
    """Its last page, with the last messages: only the number of its rows is zeroed, or all of its head."""
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    places = [
        p for p in range(4096, len(content), 4096) if content[p] == 0x0D and content[p + 3 : p + 5] != b"\0\0"
    ]
    for size in (5, 8):
        path.write_bytes(content[: places[-1] + 3] + bytes(size - 3) + content[places[-1] + size :])
        scans, report = read(path, recover=True)
        assert 0 < len(scans) < 12
        assert report.bytes_lost >= 4096
        assert "1 pages of the .db3 are damaged" in report.warnings


@pytest.mark.parametrize(
    ("at", "value"),
    [(1, 0x80), (-1, 6)],  # the first column becomes a number of its own; the row gets another's number
)
def test_last_message_of_a_db3_whose_row_became_another(tmp_path: Path, at: int, value: int) -> None:
    """It is missed between no others by its number."""
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    place = content.index(bytes([25, 6, 0, 1, 6])) + 1  # 25, its columns: null for 25, the topic, the time
    content[place + at] = value
    path.write_bytes(content)
    scans, report = read(path, recover=True)
    check_drive(scans, 11)
    assert report.lossy
    assert "1 rows are of no kind that rosbag2 writes, or there twice" in report.warnings


@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize("counted", [True, False])
def test_chunk_of_an_mcap_that_is_cut_out_with_its_indexes(
    tmp_path: Path, recover: bool, counted: bool
) -> None:
    """Every record that is left stands where it should; only the summary tells of the messages."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000, use_statistics=counted)
    whole, chunks = path.read_bytes(), chunks_of(path)
    path.write_bytes(whole[: chunks[2]] + whole[chunks[3] :])
    scans, report = read(path, recover=recover)
    assert 0 < len(scans) < 12
    assert any("the index is not usable" in warning for warning in report.warnings)
    said = any("messages that the log counts are not there" in warning for warning in report.warnings)
    assert said == counted


def test_chunk_of_an_mcap_with_tf_that_is_cut_out(tmp_path: Path) -> None:
    """Where the sensor is stood in it, and nothing is amiss but a count: that is no log without tf."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=200, compression=CompressionType.NONE)
    whole, chunks = path.read_bytes(), chunks_of(path)
    after = next(place for place in chunks if place > whole.index(b"/tf_static"))
    path.write_bytes(whole[: chunks[0]] + whole[after:])
    for recover in (False, True):
        with pytest.raises(FrameError, match="tf does not connect frame lidar to the base"):
            read(path, recover=recover)


def chunks_of(path: Path) -> list[int]:
    """Where the chunks of a sound MCAP begin."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [index.chunk_start_offset for index in summary.chunk_indexes]
