"""What kind of recording a path is, told by its first bytes and never by its name."""

from __future__ import annotations

import os
from pathlib import Path

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogNotFound, LogTruncated, NotALog
from pc2grid.io import cloud_folder, rosbag2_folder
from pc2grid.io.guard import guarded
from pc2grid.io.mcap_records import MAGIC
from pc2grid.io.source import Source

_BAG = b"#ROSBAG V2.0\n"
_SQLITE = b"SQLite format 3\0"


def open_source(path: Path, config: ReadConfig, *, recover: bool) -> Source:
    """Open a path as the container that it is.

    Raises LogNotFound, NotALog, LogTruncated, or what the container's reader raises.
    """
    try:
        if path.name == rosbag2_folder.METADATA and path.is_file():
            path = path.parent
        if path.is_dir():
            return _open_folder(path, config, recover)
        if not path.exists():
            raise LogNotFound(f"{path}: no such file", hint="check the path")
        if not path.is_file():
            raise LogNotFound(f"{path}: not a regular file")
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise LogNotFound(f"{path}: {error.strerror}") from error
    return _open_file(path, head, config, recover)


def _open_file(path: Path, head: bytes, config: ReadConfig, recover: bool) -> Source:
    if not head:
        raise LogTruncated(f"{path}: empty file", hint="was the recording interrupted?")
    if head.startswith(MAGIC):
        if os.path.getsize(path) <= len(MAGIC):  # noqa: PTH202 - the size, not the name, is meant
            raise LogTruncated(
                f"{path}: an MCAP that ends after its first 8 bytes", hint="nothing to recover"
            )
        from pc2grid.io.mcap_log import McapSource

        return McapSource(path, config, recover=recover)
    if MAGIC.startswith(head):
        raise LogTruncated(f"{path}: an MCAP that ends after {len(head)} bytes", hint="nothing to recover")
    if head.startswith(_BAG):
        from pc2grid.io.bag_log import BagSource
        from pc2grid.io.bag_salvage import SalvagedBag

        return SalvagedBag(path, config) if recover else BagSource(path, config)
    if head.startswith(_SQLITE):
        return _open_db3(path, config, recover)
    raise NotALog(f"{path}: not a recording; looks like {_looks_like(head)}", hint=_advice(head))


def _open_db3(path: Path, config: ReadConfig, recover: bool) -> Source:
    from pc2grid.io.db3_log import Db3Source, is_unfinished
    from pc2grid.io.db3_salvage import SalvagedDb3

    if is_unfinished(path):
        return SalvagedDb3(path, config, recover=recover)
    try:
        return guarded(path, lambda: Db3Source(path, config, check=recover))
    except (LogCorrupt, LogTruncated):
        if not recover:
            raise
        return SalvagedDb3(path, config, recover=True)


def _open_folder(path: Path, config: ReadConfig, recover: bool) -> Source:
    names = sorted(entry.name for entry in path.iterdir() if entry.is_file())
    if rosbag2_folder.METADATA in names or any(name.endswith(rosbag2_folder.SUFFIXES) for name in names):
        return rosbag2_folder.open_folder(
            path,
            lambda file: open_source(file, config, recover=recover),
            recover=recover,
            max_chunk_bytes=config.max_chunk_bytes,
        )
    if any(name.lower().endswith(cloud_folder.SUFFIXES) for name in names):
        return cloud_folder.CloudFolder(path, config)
    raise LogNotFound(
        f"{path}: a folder without a recording",
        hint="it holds neither metadata.yaml, .mcap or .db3 nor .pcd, .ply or .bin",
    )


def _looks_like(head: bytes) -> str:
    kinds = {
        b"#ROSBAG V": "a ROS 1 bag of an old format",
        b"\x89PNG": "a PNG image",
        b"P5": "a PGM image",
        b"\x1f\x8b": "a gzip archive",
        b"PK\x03\x04": "a zip archive",
        b"\x28\xb5\x2f\xfd": "a zstd-compressed file",
        b"\x04\x22\x4d\x18": "an lz4-compressed file",
        b"# .PCD": "a PCD cloud",
        b"ply": "a PLY cloud",
    }
    for mark, name in kinds.items():
        if head.startswith(mark):
            return name
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError:
        return "binary data of another kind"
    return "text" if text.isprintable() or "\n" in text else "binary data of another kind"


def _advice(head: bytes) -> str:
    if head.startswith((b"\x1f\x8b", b"PK\x03\x04", b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18")):
        return "unpack it first"
    if head.startswith(b"#ROSBAG V"):
        return "`rosbag migrate` or `rosbag fix` makes it one of format 2.0"
    if head.startswith((b"ply", b"# .PCD")):
        return "name the folder of the clouds, one file per scan"
    return "pc2grid reads MCAP, ROS 1 bags, rosbag2 folders and .db3"
