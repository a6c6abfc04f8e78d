"""rosbag2 folders: of every kind, split, compressed, and with parts missing or damaged."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
import yaml

from pc2grid.errors import (
    LogCorrupt,
    LogNotFound,
    LogTruncated,
)
from pc2grid.io import open_log
from tests.helpers.recordings import (
    STEP,
    T0,
    check_drive,
    drive,
    read,
    write_bag,
    write_mcap,
    write_rosbag2,
)


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("compression", ["", "message"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_folder_of_every_kind(
    tmp_path: Path,
    storage: Literal["mcap", "sqlite3"],
    compression: Literal["", "message"],
    version: int,
) -> None:
    folder = write_rosbag2(tmp_path / "log", drive(), storage, compression, version)
    for path in (folder, folder / "metadata.yaml"):
        with open_log(path) as log:
            assert log.info.format == ("mcap/ros2" if storage == "mcap" else "db3/ros2")
            assert log.info.message_count == 25
            check_drive(list(log.scans()))
            assert not log.report().lossy


def split(folder: Path, names: list[str]) -> Path:
    """The drive in as many MCAP files as there are names, listed in that order by a metadata.yaml."""
    folder.mkdir()
    messages = drive()
    size = -(-len(messages) // len(names))
    for i, name in enumerate(names):
        write_mcap(folder / name, messages[i * size : (i + 1) * size])
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": [f"log/{name}" for name in names]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
    return folder


def test_split_recordings_in_the_order_of_the_metadata(tmp_path: Path) -> None:
    # Neither the order of the names nor that of their numbers.
    folder = split(tmp_path / "log", ["b_2.mcap", "a_10.mcap", "c_1.mcap"])
    with open_log(folder) as log:
        assert {t.topic: t.message_count for t in log.info.topics} == {
            "/odom": 12,
            "/points": 12,
            "/tf_static": 1,
        }
        check_drive(list(log.scans()))
        # tf is in the first file only, and still known in the last.
        late = list(log.scans(1.0))
        assert [s.stamp_ns for s in late] == [T0 + 10 * STEP, T0 + 11 * STEP]
        assert late[0].T_base_sensor[0, 3] == 0.2
        digest = log.digest()
    (folder / "metadata.yaml").unlink()
    (folder / "metadata.yaml").write_text("")
    with pytest.raises(LogCorrupt, match=r"metadata\.yaml: .*reindex"):
        read(folder)
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": ["c_1.mcap", "b_2.mcap", "a_10.mcap"]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
    with open_log(folder) as log:
        assert log.digest() != digest  # another order is another input


def test_without_metadata_there_is_one_file_or_what_to_type(tmp_path: Path) -> None:
    """A recorder that was killed leaves none."""
    folder = split(tmp_path / "log", ["log_0.mcap"])
    (folder / "metadata.yaml").unlink()
    check_drive(read(folder)[0])
    write_mcap(folder / "log_1.mcap", drive())
    for recover in (False, True):
        with pytest.raises(LogNotFound, match=r"log: 2 files, and no metadata\.yaml") as caught:
            open_log(folder, recover=recover)
        assert caught.value.hint is not None
        assert f"`ros2 bag reindex {folder}`" in caught.value.hint
        assert f"pc2grid convert {folder}/*.mcap" in caught.value.hint


def test_a_folder_of_ros_1_bags_is_refused_with_what_to_type(tmp_path: Path) -> None:
    write_bag(tmp_path / "a.bag", drive("ros1"))
    with pytest.raises(LogNotFound) as caught:
        open_log(tmp_path)
    assert caught.value.hint == f"name the files: pc2grid convert {tmp_path}/*.bag"


def test_a_missing_part(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap", "log_1.mcap", "log_2.mcap"])
    (folder / "log_1.mcap").unlink()
    with pytest.raises(LogNotFound, match=r"lists log_1\.mcap, which is not there"):
        read(folder)
    scans, report = read(folder, recover=True)
    assert 0 < len(scans) < 12
    assert report.lossy and report.severe
    assert "log_1.mcap is missing" in report.warnings


def test_a_damaged_part(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap", "log_1.mcap"])
    part = folder / "log_1.mcap"
    part.write_bytes(part.read_bytes()[:200])
    with pytest.raises(LogTruncated, match=r"log_1\.mcap"):
        read(folder)
    scans, report = read(folder, recover=True)
    assert 0 < len(scans) < 12
    assert report.bytes_lost > 0


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[1, 2]",
        b"rosbag2_bagfile_information: {relative_file_paths: 7}",
        b"rosbag2_bagfile_information: {relative_file_paths: [[1]]}",
        b"a: !!python/object/apply:os.system [touch hacked]",
        b"\xff\xfe\x00",
        b"[" * 5000,
        b"a: [" + b"1," * 300_000 + b"]",
    ],
    ids=range(8),
)
def test_metadata_that_makes_no_sense(tmp_path: Path, content: bytes) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap"])
    (folder / "metadata.yaml").write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"metadata\.yaml: not the metadata of a recording .*reindex"):
        read(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: []}")
    with pytest.raises(LogNotFound, match="none of the files"):
        read(folder)


def test_no_path_in_the_metadata_leads_out_of_the_folder(tmp_path: Path) -> None:
    write_mcap(tmp_path / "secret.mcap", drive())
    folder = tmp_path / "log"
    folder.mkdir()
    for name in ("../secret.mcap", str(tmp_path / "secret.mcap")):
        listed = {"rosbag2_bagfile_information": {"relative_file_paths": [name]}}
        (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
        with pytest.raises(LogNotFound, match=r"lists secret\.mcap, which is not there"):
            read(folder)


def test_files_compressed_as_a_whole_are_read_once_unpacked(tmp_path: Path) -> None:
    import zstandard

    folder = write_rosbag2(tmp_path / "log", drive(), "sqlite3", "file")
    with pytest.raises(LogNotFound, match=r"log\.db3\.zstd is compressed as a whole .*zstd -d"):
        read(folder)
    with (folder / "log.db3.zstd").open("rb") as packed, (folder / "log.db3").open("wb") as plain:
        zstandard.ZstdDecompressor().copy_stream(packed, plain)
    check_drive(read(folder)[0])
