"""A rosbag2 folder: metadata.yaml and the .mcap or .db3 files that it lists."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import yaml

from pc2grid.errors import LogCorrupt, LogNotFound
from pc2grid.io.message_source import LogInfo, MessageSource, RawMessage, Tally, TopicInfo
from pc2grid.model import MISSING_FILES

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
    """The files that the metadata lists, by the names that they have when they are not compressed."""
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
    """Names of the files, without folders: no path leads out of the recording. Raises LogCorrupt."""
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
        """See MessageSource.messages; parts outside of the time range are not read."""
        for part in self._parts:
            if start_ns is not None and part.info.end_ns < start_ns:
                continue
            if end_ns is not None and part.info.start_ns >= end_ns:
                continue
            yield from part.messages(topics, start_ns, end_ns)


def _info(path: Path, infos: Sequence[LogInfo], tally: Tally) -> LogInfo:
    """The facts about the whole recording, by those about its parts."""
    spans = [info for info in infos if info.message_count != 0]
    topics = _merged([t for info in infos for t in info.topics])
    return LogInfo(
        path=path,
        format=next((info.format for info in infos if info.topics), infos[0].format),
        size_bytes=sum(info.size_bytes for info in infos),
        start_ns=min((s.start_ns for s in spans), default=0),
        end_ns=max((s.end_ns for s in spans), default=0),
        message_count=_total(info.message_count for info in infos),
        topics=tuple(sorted(topics, key=lambda t: (t.topic, t.type))),
        warnings=tuple(tally.warnings),
    )


def _merged(topics: Iterable[TopicInfo]) -> list[TopicInfo]:
    """The topics of the whole recording, with all messages counted."""
    groups: dict[TopicInfo, list[TopicInfo]] = {}
    for topic in topics:
        groups.setdefault(topic, []).append(topic)
    return [
        replace(
            next((t for t in group if t.schema), group[0]),
            message_count=_total(t.message_count for t in group),
        )
        for group in groups.values()
    ]


def _total(counts: Iterable[int | None]) -> int | None:
    """The sum; None if one is unknown."""
    known = list(counts)
    return None if None in known else sum(count for count in known if count is not None)
