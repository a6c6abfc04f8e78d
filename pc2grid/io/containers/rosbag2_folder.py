"""A rosbag2 folder: metadata.yaml and the .mcap or .db3 files that it lists."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import yaml

from pc2grid.errors import LogCorrupt, LogNotFound
from pc2grid.io.containers.split_recording import SplitSource
from pc2grid.io.message_source import MessageSource, Tally
from pc2grid.model import MISSING_FILES

METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")
# Chosen by hand: PyYAML needs half a kilobyte per item, and a recording in 10,000 files has 70,000 items.
_MAX_YAML_BYTES, _MAX_YAML_ITEMS = 8 << 20, 200_000


def open_folder(
    folder: Path, open_file: Callable[[Path], MessageSource], *, recover: bool, max_chunk_bytes: int
) -> SplitSource:
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
    parts: list[MessageSource] = []
    with contextlib.ExitStack() as opened:
        for path in there:
            part = open_file(path)
            opened.callback(part.close)
            parts.append(part)
        opened.pop_all()
    return SplitSource(folder, parts, tally, max_chunk_bytes)


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
