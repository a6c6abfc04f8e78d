"""A rosbag2 folder: metadata.yaml and the .mcap or .db3 files that it lists."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import yaml

from pc2grid.errors import LogCorrupt, LogNotFound, NotALog
from pc2grid.io.containers.cloud_folder import natural
from pc2grid.io.containers.split_recording import SplitSource
from pc2grid.io.message_source import LogInfo, MessageSource, Tally
from pc2grid.model import MISSING_FILES

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
_MAX_GAP_S = 3600.0
"""Longest time between two files of one recording where no metadata.yaml says that they are one; chosen by
hand: a recorder begins the next file at once."""
_REINDEX = "`ros2 bag reindex` writes it anew"
# Chosen by hand: PyYAML needs half a kilobyte per item, and a recording in 10,000 files has 70,000 items.
_MAX_YAML_BYTES, _MAX_YAML_ITEMS = 8 << 20, 200_000


def open_folder(
    folder: Path, open_file: Callable[[Path], MessageSource], *, recover: bool, max_chunk_bytes: int
) -> SplitSource:
    """Open all files of a recording, in the order of metadata.yaml, or of their numbers if there is none.

    open_file : opens one of them. recover : go on without files that are missing, with a warning, and
    without a metadata.yaml that cannot be read.

    Raises LogNotFound for files that are missing, LogCorrupt for a metadata.yaml that cannot be read, NotALog
    for files that do not look like parts of one recording, if there is no metadata.yaml.
    """
    tally = Tally()
    paths = _files(folder, tally, recover)
    there = [path for path in paths if path.is_file()]
    for path in paths:
        if path in there:
            continue
        if not recover:
            raise LogNotFound(
                f"{folder}: {METADATA} lists {path.name}, which is not there",
                hint="--recover reads the others",
            )
        tally.warn(f"{path.name} is missing")
        tally.skip(MISSING_FILES)
    if not there:
        raise LogNotFound(f"{folder}: none of the files of the recording is there")
    parts: list[MessageSource] = []
    with contextlib.ExitStack() as opened:
        for path in there:
            part = open_file(path)
            opened.callback(part.close)
            parts.append(part)
        if not (folder / METADATA).is_file():
            _refuse_unrelated(folder, parts)
        opened.pop_all()
    return SplitSource(folder, parts, tally, max_chunk_bytes)


def _refuse_unrelated(folder: Path, parts: Sequence[MessageSource]) -> None:
    """Raises NotALog if the parts, in their order, do not look like one recording.

    The names of its files differ in their numbers only, its files follow each other in time, and each of them
    has a topic of those before it, with the same type.
    """
    infos = [part.info for part in parts]
    first, reasons = infos[0].path, []
    topics = {(t.topic, t.type) for t in infos[0].topics}
    for before, info in itertools.pairwise(infos):
        own = {(t.topic, t.type) for t in info.topics}
        reason = _does_not_follow(before, info, first)
        if reason is None and topics and own and not topics & own:
            reason = f"{info.path.name} has none of the topics of {first.name}"
        reasons += [] if reason is None else [reason]
        topics |= own
    if reasons:
        raise NotALog(
            f"{folder}: these look like {len(reasons) + 1} recordings: {reasons[0]}",
            hint=f"name the files: pc2grid convert {folder}/*{first.suffix}; if they are one recording,"
            f" `ros2 bag reindex {folder}` writes its {METADATA}",
        )


def _does_not_follow(before: LogInfo, info: LogInfo, first: Path) -> str | None:
    """Why a file is not the one after another in a recording that begins with `first`; None if it may be."""
    path, gap_s = info.path, (info.start_ns - before.end_ns) * 1e-9
    if _without_numbers(path) != _without_numbers(first):
        return f"the name of {path.name} is not that of {first.name} with another number"
    if before.message_count != 0 and info.message_count != 0 and abs(gap_s) > _MAX_GAP_S:
        order = "after" if gap_s > 0 else "before"
        return f"{path.name} begins {abs(gap_s) / 3600:.0f} h {order} the end of {before.path.name}"
    return None


def _without_numbers(path: Path) -> str:
    return re.sub(r"\d+", "#", path.stem)


def _files(folder: Path, tally: Tally, recover: bool) -> list[Path]:
    try:
        if (folder / METADATA).is_file():
            return [_unpacked(folder, name) for name in listed_files(folder / METADATA)]
    except LogCorrupt as error:
        if not recover:
            raise
        tally.warn(f"{error.message}; the files are read in the order of their numbers")
    else:
        tally.warn(f"the folder has no {METADATA}: its files are read in the order of their numbers")
    names = [path.name for path in folder.iterdir() if path.suffix in SUFFIXES]
    kind = max(SUFFIXES, key=lambda suffix: sum(name.endswith(suffix) for name in names))
    return [folder / name for name in sorted(names, key=natural) if name.endswith(kind)]


def listed_files(metadata: Path) -> list[str]:
    """Names of the files that a metadata.yaml lists, without folders: no path leads out of the recording.

    Raises LogCorrupt if it cannot be read.
    """
    if metadata.stat().st_size > _MAX_YAML_BYTES:
        raise LogCorrupt(f"{metadata}: larger than {_MAX_YAML_BYTES} bytes", hint=_REINDEX)
    content = metadata.read_bytes()
    if content.count(b"\n") + content.count(b",") > _MAX_YAML_ITEMS:
        raise LogCorrupt(f"{metadata}: more than {_MAX_YAML_ITEMS} items", hint=_REINDEX)
    try:
        document = yaml.safe_load(content.decode("utf-8"))
        paths = document["rosbag2_bagfile_information"]["relative_file_paths"]
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise LogCorrupt(f"{metadata}: not YAML ({type(error).__name__})", hint=_REINDEX) from error
    except (KeyError, TypeError, IndexError) as error:
        raise LogCorrupt(
            f"{metadata}: key rosbag2_bagfile_information.relative_file_paths is missing", hint=_REINDEX
        ) from error
    if not isinstance(paths, list) or not paths or not all(isinstance(p, str) for p in paths):
        raise LogCorrupt(f"{metadata}: relative_file_paths is not a list of names", hint=_REINDEX)
    return [PurePosixPath(path).name for path in paths]


def _unpacked(folder: Path, name: str) -> Path:
    """The path of a listed file; of `x.db3.zstd` (compression_mode: file) the decompressed file beside it."""
    path = folder / name
    if path.suffix != ".zstd":
        return path
    if not path.with_suffix("").is_file():
        raise LogNotFound(
            f"{folder}: {name} is compressed as a whole", hint=f"`zstd -d {name}` unpacks it next to it"
        )
    return path.with_suffix("")
