"""Which container a path is; its first bytes decide, not its name."""

from __future__ import annotations

import re
from pathlib import Path

from pc2grid.config import ReadConfig
from pc2grid.errors import LogNotFound, LogTruncated, NotALog
from pc2grid.io.containers import cloud_folder, rosbag2_folder
from pc2grid.io.containers.mcap import McapSource
from pc2grid.io.containers.rosbags_file import RosbagsFile
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from pc2grid.io.message_source import MessageSource

_MCAP = b"\x89MCAP0\r\n"
_BAG = b"#ROSBAG V2.0\n"
_SQLITE = b"SQLite format 3\0"
SUBMAPS_ID = b"pcsm"
"""The application id in the header of a submap database."""
_READ = "pc2grid reads MCAP, ROS 1 bags, rosbag2 folders and .db3"
_OTHERS = (
    (
        b"#ROSBAG V",
        "a ROS 1 bag of an old format",
        "`rosbag migrate` or `rosbag fix` makes it one of format 2.0",
    ),
    (b"\x89PNG", "a PNG image", "of a map, give the .yaml that names this image"),
    (b"P5", "a PGM image", "of a map, give the .yaml that names this image"),
    (b"\x1f\x8b", "a gzip archive", "unpack it first"),
    (b"PK\x03\x04", "a zip archive", "unpack it first"),
    (b"\x28\xb5\x2f\xfd", "a zstd-compressed file", "unpack it first"),
    (b"\x04\x22\x4d\x18", "an lz4-compressed file", "unpack it first"),
    (b"# .PCD", "a PCD cloud", "name the folder of the clouds, one file per scan"),
    (b"ply", "a PLY cloud", "name the folder of the clouds, one file per scan"),
)
"""How other files begin, what they are, and what helps."""
_RECORDED = "of a running robot, or a recording that comes through a pipe: pc2grid watch"


def open_source(path: Path, config: ReadConfig, *, recover: bool) -> MessageSource:
    """Open the container at a path.

    recover : read what is whole of a damaged MCAP file, and go on without missing files of a folder.

    Raises LogNotFound, NotALog, LogTruncated, or what the container's reader raises.
    """
    try:
        if path.name == rosbag2_folder.METADATA and path.is_file():
            path = path.parent
        if path.is_dir():
            return _open_folder(path, config, recover)
        if not path.exists():
            stream = "://" in str(path) or re.match(r"\w+:/", str(path)) or str(path) == "-"
            raise LogNotFound(f"{path}: no such file", hint=_RECORDED if stream else "check the path")
        if not path.is_file():
            raise LogNotFound(f"{path}: not a regular file", hint=_RECORDED)
        head = first_bytes(path)
    except OSError as error:
        raise LogNotFound(f"{path}: {error.strerror}") from error
    return _open_file(path, head, config, recover)


def first_bytes(path: Path) -> bytes:
    """The first 100 bytes of a file, by which its format is known. Raises OSError."""
    with path.open("rb") as file:
        return file.read(100)


def is_submap_database(head: bytes) -> bool:
    """Whether a file is a submap database, by its first 100 bytes."""
    return head.startswith(_SQLITE) and head[68:72] == SUBMAPS_ID


def is_submap_file(path: Path) -> bool:
    """Return whether this is the file of a submap database; not if it cannot be read."""
    try:
        return is_submap_database(first_bytes(path))
    except OSError:
        return False


def _open_file(path: Path, head: bytes, config: ReadConfig, recover: bool) -> MessageSource:
    if not head:
        raise LogTruncated(f"{path}: empty file", hint="was the recording interrupted?")
    if _MCAP.startswith(head):
        raise LogTruncated(
            f"{path}: an MCAP that ends after its first {len(head)} bytes", hint="nothing to recover"
        )
    if head.startswith(_MCAP):
        return McapSource(path, config, recover=recover)
    if head.startswith(_BAG):
        return RosbagsFile(path, config, is_bag=True)
    if is_submap_database(head):
        raise NotALog(
            f"{path}: a submap database, not a recording", hint=f"`pc2grid info {path}` shows what is in it"
        )
    if head.startswith(_SQLITE):
        return RosbagsFile(path, config, is_bag=False)
    name, advice = _looks_like(head)
    raise NotALog(f"{path}: not a recording; looks like {name}", hint=advice)


def _open_folder(path: Path, config: ReadConfig, recover: bool) -> MessageSource:
    names = sorted(entry.name for entry in path.iterdir() if entry.is_file())
    if rosbag2_folder.METADATA in names or any(name.endswith(rosbag2_folder.SUFFIXES) for name in names):
        return rosbag2_folder.open_folder(
            path, lambda file: open_source(file, config, recover=recover), recover=recover
        )
    if any(name.lower().endswith(cloud_folder.SUFFIXES) for name in names):
        return cloud_folder.CloudFolder(path, config)
    if any(name.endswith(".bag") for name in names):
        raise LogNotFound(
            f"{path}: a folder of ROS 1 bags", hint=f"name the files: pc2grid convert {path}/*.bag"
        )
    raise LogNotFound(
        f"{path}: a folder without a recording",
        hint="it holds neither metadata.yaml, .mcap or .db3 nor .pcd, .ply or .bin",
    )


def _looks_like(head: bytes) -> tuple[str, str]:
    """What a file is that begins so, and what helps."""
    if is_lfs_pointer(head):
        return "a Git LFS pointer to one", LFS_HINT
    for mark, name, advice in _OTHERS:
        if head.startswith(mark):
            return name, advice
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError:
        text = "\0"
    return "text" if text.isprintable() or "\n" in text else "binary data of another kind", _READ
