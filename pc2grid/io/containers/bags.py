"""ROS 1 bags, rosbag2 .db3 files and rosbag2 folders as message sources, read by `rosbags`.

A folder has a metadata.yaml that lists its .mcap or .db3 files. Bags and .db3 are without checksums, so the
reader warns. `rosbags` trusts the sizes in a file: so its reads and decompressions are bounded, and an index
or a table that misses messages is refused.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import yaml

from pc2grid.errors import LimitExceeded, LogCorrupt, LogNotFound, LogTruncated, NotALog
from pc2grid.io.containers.mcap import BoundedFile, plain_message, unpacked
from pc2grid.io.messages.ros import short_name
from pc2grid.io.source import (
    LogInfo,
    MessageSource,
    RawMessage,
    Tally,
    TopicInfo,
    counted,
    guarded,
    guarded_stream,
    total,
)
from pc2grid.model import MISSING_FILES
from pc2grid.settings import ReadConfig

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")


# Chosen by hand: PyYAML needs half a kilobyte per item, and a recording in 10,000 files has 70,000 items.
_MAX_YAML_BYTES, _MAX_YAML_ITEMS = 8 << 20, 200_000


def open_folder(folder: Path, open_file: Callable[[Path], MessageSource], *, recover: bool) -> SplitSource:
    """Open all files of a recording, in the order of metadata.yaml; without it, the only one there is.

    open_file : opens one of them. recover : go on without files that are missing, with a warning.

    Raises LogNotFound for files that are missing, or whose order is not known, LogCorrupt for a metadata.yaml
    that cannot be read.
    """
    tally, there = Tally(), []
    for path in _files(folder):
        if path.is_file():
            there.append(path)
            continue
        if path.with_name(f"{path.name}.zstd").is_file():
            raise LogNotFound(
                f"{folder}: {path.name}.zstd is compressed as a whole",
                hint=f"`zstd -d {path.name}.zstd` unpacks it next to it",
            )
        if not recover:
            raise LogNotFound(
                f"{folder}: {METADATA} lists {path.name}, which is not there",
                hint="--recover reads the others",
            )
        tally.warn(f"{path.name} is missing")
        tally.skip(MISSING_FILES)
    if not there:
        raise LogNotFound(f"{folder}: none of the files of the recording is there")
    return SplitSource(folder, [open_file(path) for path in there], tally)


def _files(folder: Path) -> list[Path]:
    """Return the files that the metadata lists, by their uncompressed names."""
    if (folder / METADATA).is_file():
        return [folder / name.removesuffix(".zstd") for name in _listed(folder / METADATA)]
    found = [path for path in folder.iterdir() if path.suffix in SUFFIXES]
    if len(found) > 1:
        raise LogNotFound(
            f"{folder}: {len(found)} files, and no {METADATA} that says whether they are one recording",
            hint=f"`ros2 bag reindex {folder}` writes it; of several recordings, name the files: "
            f"pc2grid convert {folder}/*{found[0].suffix}",
        )
    return found


def _listed(metadata: Path) -> list[str]:
    """Return the names of the files, without folders: no path leads out of the recording. Raises
    LogCorrupt."""
    with metadata.open("rb") as file:
        content = file.read(_MAX_YAML_BYTES + 1)
    try:
        if len(content) > _MAX_YAML_BYTES or content.count(b"\n") + content.count(b",") > _MAX_YAML_ITEMS:
            raise ValueError("too large")
        paths = yaml.safe_load(content.decode("utf-8"))["rosbag2_bagfile_information"]["relative_file_paths"]
        return [PurePosixPath(path).name for path in paths]
    except (yaml.YAMLError, ValueError, RecursionError, KeyError, TypeError, IndexError) as error:
        raise LogCorrupt(
            f"{metadata}: not the metadata of a recording ({type(error).__name__})",
            hint="`ros2 bag reindex` writes it anew",
        ) from error


class SplitSource:
    """The parts of a recording in the order in which they were recorded; they share one tally."""

    def __init__(self, path: Path, parts: Sequence[MessageSource], tally: Tally) -> None:
        self._parts = parts
        self.files: tuple[Path, ...] = tuple(file for part in parts for file in part.files)
        self.tally = tally
        for part in parts:
            tally.take_over(part.tally)
            part.tally = tally
        self.info = _info(path, [part.info for part in parts], tally)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource.messages; parts outside of the time range are not read."""
        for part in self._parts:
            if start_ns is not None and part.info.end_ns < start_ns:
                continue
            if end_ns is not None and part.info.start_ns >= end_ns:
                continue
            yield from part.messages(topics, start_ns, end_ns)


def _info(path: Path, infos: Sequence[LogInfo], tally: Tally) -> LogInfo:
    """Return the facts about the whole recording, from those about its parts."""
    spans = [info for info in infos if info.message_count != 0]
    topics = set(counted(dict(enumerate(t for info in infos for t in info.topics))).values())
    return LogInfo(
        path=path,
        format=next((info.format for info in infos if info.topics), infos[0].format),
        size_bytes=sum(info.size_bytes for info in infos),
        start_ns=min((s.start_ns for s in spans), default=0),
        end_ns=max((s.end_ns for s in spans), default=0),
        message_count=total(info.message_count for info in infos),
        topics=tuple(sorted(topics, key=lambda t: (t.topic, t.type))),
        warnings=tuple(tally.warnings),
    )


_MENDS_BAG = "`rosbag reindex {name}` mends it; --recover is for MCAP files"
_MENDS_DB3 = "`sqlite3 {name} .recover | sqlite3 mended.db3` mends it; --recover is for MCAP files"
_UNCHECKED = "the format carries no checksum: damage to its data would not be seen"
_INT64_MAX = (1 << 63) - 1


class RosbagsFile:
    """One file, open. Messages that rosbag2 compressed one by one are decompressed.

    Raises LogTruncated, LogCorrupt or LimitExceeded when it is opened or read.
    """

    def __init__(self, path: Path, config: ReadConfig, *, is_bag: bool) -> None:
        self.files: tuple[Path, ...] = (path,)
        self.tally = Tally()
        self._path, self._config, self._is_bag = path, config, is_bag
        self._hint = (_MENDS_BAG if is_bag else _MENDS_DB3).format(name=path.name)
        self._whole = is_bag  # of a .db3, this is found out before the first message
        self.tally.warn(_UNCHECKED)
        self._reader = guarded(path, lambda: _bag(path, config) if is_bag else _db3(path), self._hint)
        self._topic_of = self._topics()
        self.info = self._describe()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource.messages; exactly by log time."""
        if not self._whole:
            guarded(self._path, self._check_pages, self._hint)
        wanted = [c for c in self._reader.connections if self._topic_of[c.id].topic in topics]
        if not wanted:
            return  # rosbags reads every topic if it is given none
        times = (None if time_ns is None else min(time_ns, _INT64_MAX) for time_ns in (start_ns, end_ns))
        for connection, time_ns, data in guarded_stream(
            self._path, self._reader.messages(wanted, *times), self._hint
        ):
            if len(data) > (limit := self._config.max_record_bytes):
                raise LimitExceeded(
                    f"{self._path}: a message has {len(data)} bytes; the limit is {limit}",
                    hint="--set read.max_record_bytes=N raises it",
                )
            plain = plain_message(data, self._config.max_chunk_bytes)
            yield RawMessage(self._topic_of[connection.id], time_ns, plain)

    def _topics(self) -> dict[int, TopicInfo]:
        """Return the topic of each connection; a topic of ROS 1 has one for each publisher."""
        found: dict[int, TopicInfo] = {}
        for connection in self._reader.connections:
            definition = connection.msgdef
            encoding = "ros2idl" if definition.format.name == "IDL" else "ros2msg"
            found[connection.id] = TopicInfo(
                topic=connection.topic,
                type=short_name(connection.msgtype),
                encoding="ros1" if self._is_bag else "cdr",
                schema_encoding="ros1msg" if self._is_bag else encoding,
                schema=definition.data.encode(),
                message_count=connection.msgcount,
            )
        return counted(found)

    def _describe(self) -> LogInfo:
        span = self._reader if self._is_bag else self._reader.metadata
        topics = sorted(set(self._topic_of.values()), key=lambda t: (t.topic, t.type))
        count = sum(t.message_count or 0 for t in topics)
        return LogInfo(
            path=self._path,
            format="bag/ros1" if self._is_bag else "db3/ros2",
            size_bytes=self._path.stat().st_size,
            start_ns=span.start_time if count else 0,
            end_ns=span.end_time - 1 if count else 0,
            message_count=count,
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    def _check_pages(self) -> None:
        """Raise LogCorrupt for a damaged .db3: SQLite follows wrong links between pages without an error."""
        ((found,),) = self._reader.dbconn.execute("PRAGMA integrity_check(1)")
        if found != "ok":
            raise LogCorrupt(f"a damaged .db3: {' '.join(str(found).split())[:120]}", hint=self._hint)
        self._whole = True


def _bag(path: Path, config: ReadConfig) -> Any:
    """Open a reader of a ROS 1 bag. Raises LogTruncated for one without an index, LogCorrupt."""
    from rosbags.rosbag1 import Reader, ReaderError
    from rosbags.rosbag1.reader import decompressors

    reader: Any = Reader(path)
    reader.path = _BoundedPath(path)
    reader.path.most_bytes = config.max_record_bytes
    try:
        reader.open()
    except ReaderError as error:
        # A recorder writes the index last; without one it was interrupted.
        raise (LogTruncated if "not indexed" in str(error) else LogCorrupt)(str(error)) from error
    counted = [sum(c.connection_counts.get(x.id, 0) for c in reader.chunk_infos) for x in reader.connections]
    if counted != [connection.msgcount for connection in reader.connections]:
        reader.close()
        raise LogCorrupt("the index does not list what the chunks hold")
    names = {function: name for name, function in decompressors.items()}
    for place, chunk in reader.chunks.items():
        bounded = functools.partial(unpacked, names[chunk.decompressor], config.max_chunk_bytes)
        reader.chunks[place] = chunk._replace(decompressor=bounded)
    return reader


class _BoundedPath(type(Path())):  # type: ignore[misc]
    """A path whose file refuses to read more than `most_bytes` at once."""

    most_bytes: int

    def open(self, *arguments: Any, **options: Any) -> BoundedFile:
        return BoundedFile(io.FileIO(self), self.most_bytes)


def _db3(path: Path) -> Any:
    """Open a reader of a .db3. Raises LogTruncated if its recorder was killed, LogCorrupt, NotALog."""
    from rosbags.rosbag2 import ReaderError
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise LogTruncated(
            "its recorder was killed: the write-ahead log beside it holds messages that are not in it",
            hint=f"`sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'` writes them into it",
        )
    reader = Sqlite3Reader(Path(quote(str(path.absolute()))))  # it makes a URI of the name
    try:
        reader.open()
    except ReaderError as error:
        if "missing tables" in str(error):
            raise NotALog("an SQLite file, but not a rosbag2 .db3: no messages") from error
        raise LogCorrupt(f"a damaged .db3: {error.__cause__ or error}") from error
    if sum(connection.msgcount for connection in reader.connections) != reader.metadata.message_count:
        reader.close()
        raise LogCorrupt("a damaged .db3: messages whose topic is missing")
    return reader
