"""A rosbag2 folder: metadata.yaml and the .mcap or .db3 files that it lists."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from pc2grid.errors import LogCorrupt, LogNotFound
from pc2grid.io.cloud_folder import natural
from pc2grid.io.source import Source, Tally
from pc2grid.io.split_log import SplitSource

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
_REINDEX = "`ros2 bag reindex` writes it anew"
# As YAML each item is an object of half a kilobyte; a recording in 10 000 files has some 70 000.
_MAX_YAML_BYTES, _MAX_YAML_ITEMS = 8 << 20, 200_000


def open_folder(
    folder: Path, open_file: Callable[[Path], Source], *, recover: bool, max_chunk_bytes: int
) -> SplitSource:
    """Open all files of a recording, in the order of metadata.yaml, or of their numbers if there is none.

    open_file : opens one of them. recover : go on without files that are missing, and say so.

    Raises LogNotFound for files that are missing, LogCorrupt for a metadata.yaml that makes no sense.
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
        tally.skip("files of the recording that are missing")
    if not there:
        raise LogNotFound(f"{folder}: none of the files of the recording is there")
    parts: list[Source] = []
    with contextlib.ExitStack() as opened:
        for path in there:
            part = open_file(path)
            opened.callback(part.close)
            parts.append(part)
        opened.pop_all()
    return SplitSource(folder, parts, tally, max_chunk_bytes)


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
    """Names of the files that a metadata.yaml lists; folders in it are dropped, so none leads elsewhere.

    Raises LogCorrupt.
    """
    import yaml

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
    """The file, or for `x.db3.zstd` (compression_mode: file) what was unpacked next to it."""
    path = folder / name
    if path.suffix != ".zstd":
        return path
    if not path.with_suffix("").is_file():
        raise LogNotFound(
            f"{folder}: {name} is compressed as a whole", hint=f"`zstd -d {name}` unpacks it next to it"
        )
    return path.with_suffix("")
