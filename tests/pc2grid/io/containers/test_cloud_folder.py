"""Folders of PCD, PLY and KITTI .bin files, as Open3D and plain numpy write them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    LogNotFound,
    NoScans,
    NotALog,
    Pc2GridError,
    PointCloudError,
    TrajectoryFileError,
    UnsupportedSchema,
)
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import write_tum
from pc2grid.model import Trajectory
from pc2grid.settings import ReadConfig
from tests.helpers.cloud_folders import KINDS, POINTS, folder_of, trajectory, write_cloud
from tests.helpers.recordings import STEP, T0, read


def bare(path: Path, content: bytes) -> Path:
    """A folder with one file of that content."""
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path.parent


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_in_the_order_of_the_numbers(tmp_path: Path, kind: str) -> None:
    folder = folder_of(tmp_path, kind)
    with open_log(folder) as log:
        assert log.info.format == f"folder/{kind.split()[0]}"
        assert log.info.message_count == 12
        scans = list(log.scans())
        report = log.report()
    tolerance = 1e-4 if "ascii" in kind else 0
    for i, scan in enumerate(scans):
        np.testing.assert_allclose(scan.points_m, POINTS[: 100 + i], rtol=0, atol=tolerance)
        assert scan.T_odom_base is None
    assert np.diff([s.stamp_ns for s in scans]).tolist() == [STEP] * 11
    assert any("10 clouds a second are assumed" in w for w in report.warnings)
    assert not report.lossy


def test_stamps_and_poses_of_a_tum_file(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    expected = trajectory()
    with open_log(folder) as log:
        without = log.digest()
    write_tum(folder / "poses.tum", expected)
    with open_log(folder) as log:
        assert log.choose().odometry_topic == "poses"
        assert log.digest() != without
        scans = list(log.scans())
    assert [s.stamp_ns for s in scans] == expected.stamps_ns.tolist()
    found = np.array([s.T_odom_base for s in scans])
    np.testing.assert_allclose(found, expected.T_session_base, atol=1e-8)
    assert all(s.T_odom_base is None for s in read(folder, ReadConfig(odometry="none"))[0])


@pytest.mark.parametrize("names", ["{s}.{ns:09d}", "{all}", "{us}"])
def test_names_that_are_times(tmp_path: Path, names: str) -> None:
    folder = tmp_path / "clouds"
    folder.mkdir()
    stamps = [T0 + i * STEP for i in range(5)]
    for i, t in enumerate(stamps):
        name = names.format(s=t // 10**9, ns=t % 10**9, all=t, us=t // 1000)
        write_cloud(folder / name, POINTS[: i + 1], "bin")
    # Poses at other times than the clouds: interpolated.
    poses = trajectory(7)
    write_tum(
        folder / "a.tum",
        Trajectory(stamps_ns=poses.stamps_ns - STEP // 2, T_session_base=poses.T_session_base),
    )
    scans, report = read(folder)
    assert [s.stamp_ns for s in scans] == stamps
    assert [len(s.points_m) for s in scans] == [1, 2, 3, 4, 5]
    assert scans[1].T_odom_base is not None
    assert scans[1].T_odom_base[0, 3] == pytest.approx(0.75)
    assert not any("assumed" in w for w in report.warnings)


def test_times_as_kitti_has_them(tmp_path: Path) -> None:
    sequence = tmp_path / "00"
    folder = folder_of(sequence, "bin", name="velodyne")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(12)))
    scans, report = read(folder)
    assert np.diff([s.stamp_ns for s in scans]).tolist() == [STEP] * 11
    assert not any("assumed" in w for w in report.warnings)


def test_per_point_times_of_a_pcd(tmp_path: Path) -> None:
    rows = np.zeros(4, np.dtype([("pad", "V3"), ("xyz", "<f4", 3), ("t", "<u4")]))
    rows["xyz"] = [[1, 2, 3], [np.nan, 0, 0], [4, 5, 6], [7, 8, 9]]
    rows["t"] = [0, 10_000_000, 50_000_000, 100_000_000]
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS _ x y z t\nSIZE 1 4 4 4 4\nTYPE U F F F U\nCOUNT 3 1 1 1 1\n"
        "WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA binary\n"
    )
    (scan,), _ = read(bare(tmp_path / "a" / "1.pcd", head.encode() + rows.tobytes()))
    np.testing.assert_array_equal(scan.points_m, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert scan.offsets_s is not None
    np.testing.assert_allclose(scan.offsets_s, [0, 0.05, 0.1])
    assert scan.dropped == 1


def test_a_big_endian_ply_behind_another_element(tmp_path: Path) -> None:
    head = (
        b"ply\r\nformat binary_big_endian 1.0\r\ncomment x\r\nelement camera 1\r\nproperty double f\r\n"
        b"element vertex 2\r\nproperty double x\r\nproperty double y\r\n"
        b"property double z\r\nproperty uchar r\r\n"
        b"element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    )
    body = struct.pack(">d", 7.0) + struct.pack(">3dB", 1, 2, 3, 255) + struct.pack(">3dB", 4, 5, 6, 0)
    (scan,), _ = read(bare(tmp_path / "a" / "1.ply", head + body + struct.pack(">B3i", 3, 0, 1, 0)))
    np.testing.assert_array_equal(scan.points_m, [[1, 2, 3], [4, 5, 6]])


WIDE = b"WIDTH 9000000000"
HEAD = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"


@pytest.mark.parametrize(
    ("name", "content", "error", "words"),
    [
        ("1.pcd", b"", PointCloudError, "without a DATA line"),
        ("1.pcd", HEAD + b"DATA binary\n" + bytes(20), PointCloudError, "20 bytes of data where 24"),
        ("1.pcd", HEAD + b"DATA ascii\n1 2 3 4 5\n", PointCloudError, "1 x 5 numbers as text where 2 x 3"),
        ("1.pcd", HEAD + b"DATA ascii\n1 2 3 4 5 six\n", PointCloudError, "not a line of numbers"),
        ("1.pcd", HEAD + b"DATA zipped\n", UnsupportedSchema, "'zipped'"),
        ("1.pcd", HEAD.replace(b"WIDTH 2", b"WIDTH x") + b"DATA ascii\n", PointCloudError, "makes no sense"),
        ("1.pcd", HEAD.replace(b"WIDTH 2", b"WIDTH -2") + b"DATA binary\n", PointCloudError, "negative"),
        ("1.pcd", HEAD.replace(b"WIDTH 2", WIDE) + b"DATA ascii\n", PointCloudError, "declared"),
        ("1.pcd", HEAD.replace(b"WIDTH 2", WIDE) + b"DATA binary\n", PointCloudError, "max_points"),
        ("1.pcd", HEAD.replace(b" z", b" w") + b"DATA binary\n" + bytes(24), PointCloudError, "field z"),
        ("1.pcd", HEAD + b"DATA binary_compressed\n" + bytes(8), UnsupportedSchema, "compressed' is not"),
        ("1.ply", b"plx", PointCloudError, "without a header"),
        ("1.ply", b"ply\nformat ascii 1.0\nend_header\n", PointCloudError, "without points"),
        ("1.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list int int x\nend_header\n",
         PointCloudError, "has lists"),
        ("1.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
         PointCloudError, "makes no sense"),
        ("1.bin", bytes(15), PointCloudError, "15 bytes are not whole points"),
    ],
)  # fmt: skip
def test_files_that_make_no_sense(
    tmp_path: Path, name: str, content: bytes, error: type[Pc2GridError], words: str
) -> None:
    with pytest.raises(error, match=words):
        read(bare(tmp_path / "a" / name, content))


def test_one_bad_file_is_counted(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    (folder / "scan_5.bin").write_bytes(bytes(15))
    scans, report = read(folder)
    assert len(scans) == 11
    assert report.scans_skipped == {"15 bytes are not whole points of 16 bytes": 1}


def test_an_empty_cloud_is_kept(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin", count=3)
    (folder / "scan_1.bin").write_bytes(b"")
    empty = HEAD.replace(b"WIDTH 2", b"WIDTH 0")
    assert [len(s.points_m) for s in read(folder)[0]] == [100, 0, 102]
    for kind in (b"ascii\n", b"binary\n"):
        with pytest.raises(NoScans, match="none of 1 scans holds a return"):
            read(bare(tmp_path / kind.decode().strip() / "1.pcd", empty + b"DATA " + kind))


def test_folders_and_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(LogNotFound, match=r"a folder without a recording .*\.ply"):
        read(tmp_path)
    folder = folder_of(tmp_path, "ply binary", count=1)
    with pytest.raises(NotALog, match=r"a PLY cloud .*name the folder"):
        read(folder / "scan_0.ply")
    with pytest.raises(LimitExceeded, match="max_record_bytes"):
        read(folder, ReadConfig(max_record_bytes=100))
    (folder / "a.tum").write_text("junk\n")
    with pytest.raises(TrajectoryFileError, match=r"a\.tum, line 1"):
        read(folder)


def test_mixed_kinds_are_said(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin", count=3)
    write_cloud(folder / "map", POINTS, "ply binary")
    scans, report = read(folder)
    assert len(scans) == 3
    assert any("only its .bin files are read" in w for w in report.warnings)


@pytest.mark.parametrize("name", ["9999999999.5", "9999999999999999999"])
def test_names_past_all_calendars_are_no_times(tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.bin").write_bytes(np.ones((5, 4), "<f4").tobytes())
    scans, report = read(tmp_path)
    assert len(scans) == 1
    assert any("10 clouds a second are assumed" in w for w in report.warnings)


def test_a_cloud_that_may_not_be_read_or_went_away(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    with open_log(folder) as log:
        (folder / "scan_3.bin").unlink()
        (folder / "scan_3.bin").mkdir()
        with pytest.raises(LogCorrupt, match=r"scan_3\.bin: cannot be read: Is a directory"):
            list(log.scans())
    (folder / "scan_3.bin").rmdir()
    with pytest.raises(LogCorrupt, match=r"cannot be read: No such file"), open_log(folder) as log:
        (folder / "scan_5.bin").unlink()
        list(log.scans())


def test_a_part_of_a_folder_of_clouds(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, "bin")
    with open_log(folder) as log:
        whole = [scan.stamp_ns for scan in log.scans()]
        part = [scan.stamp_ns for scan in log.scans(start_s=0.25, duration_s=0.5)]
    begin = whole[0] + 250_000_000
    assert part == [t for t in whole if begin <= t < begin + 500_000_000]
