"""What commands write: files, which are checked before any work begins, tables, and warnings of lost data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.errors import OutputError
from pc2grid.io.atomic import require_writable
from pc2grid.model import ReadReport
from signature.database.postgres import is_url

if TYPE_CHECKING:
    from rich.table import Table


SUFFIXES: dict[str, tuple[str, ...]] = {
    "trajectory": (".tum", ".kitti", ".txt"),
    "map": (".yaml", ".yml", ".pgm"),
    "cloud": (".ply", ".pcd"),
    "graph": (".graphml",),
    "g2o": (".g2o",),
    "mcap": (".mcap",),
    "output": (".mcap",),
    "initialpose": (".json", ".yaml", ".yml"),
    "plot": (".png",),
    "report": (".html", ".htm"),
    "csv": (".csv",),
}
"""By option: the suffixes of the files that it writes."""
_OF_OTHERS = {suffix for known in SUFFIXES.values() for suffix in known} | {".bag", ".db3", ".rrd"}
"""Suffixes of formats that a database or the stem of a map must not be named after."""


def check_file(option: str, path: Path | None, force: bool) -> None:
    """Refuse a file that the option `--{option}` cannot write; None is no file.

    A name without a suffix is taken, unless the suffix selects the format.

    Raises OutputError for a suffix of another format, and as `require_writable`.
    """
    if path is None:
        return
    known, suffix = SUFFIXES[option], path.suffix.lower()
    if suffix not in known and (suffix or option == "cloud"):
        raise OutputError(
            f"{path}: --{option} does not write the format {suffix or '(no suffix)'}",
            hint=f"end its name in {' or '.join(known)}",
        )
    require_writable(path, force)


def files_of(given: object, names: Iterable[str]) -> dict[str, Path]:
    """Return what is to be written, by the name of its option; options that were not given are left out."""
    return {name: path for name in names if (path := getattr(given, name)) is not None}


def written_files(outputs: Mapping[str, Path]) -> list[Path]:
    """Return the files of some options; `map` names the stem of two."""
    files = []
    for option, path in outputs.items():
        ends = (".yaml", ".pgm") if option == "map" else ("",)
        files += [path.with_name(f"{path.name}{end}") for end in ends]
    return files


def map_stem(path: Path) -> Path:
    """Return the stem of a nav2 map, whose files are STEM.yaml and STEM.pgm.

    Either of these may be named instead of the stem. Raises OutputError for the suffix of another format.
    """
    suffix = path.suffix.lower()
    if suffix in SUFFIXES["map"]:
        return path.with_suffix("")
    if suffix in _OF_OTHERS:
        raise OutputError(
            f"{path}: --map writes STEM.yaml and STEM.pgm, not the format {suffix}",
            hint=f"give the stem: --map {path.with_suffix('')}",
        )
    return path


def check_database_name(output: str) -> None:
    """Raise OutputError if the file of a new database has the suffix of another format."""
    path = Path(output)
    if path.suffix.lower() in _OF_OTHERS:
        raise OutputError(
            f"{output}: a submap database is not written as {path.suffix}",
            hint=f"end its name in .submaps: -o {path.with_suffix('.submaps')}",
        )


def check_database(output: str) -> None:
    """Raise OutputError if the file of a database cannot be written; a server is asked later."""
    if not is_url(output):
        require_writable(output, overwrite=True)


def make_folder(path: Path) -> None:
    """Make the folder for results. Raises OutputError if it cannot be made or written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot make this folder: {error.strerror}", hint="choose another one with --output"
        ) from error
    require_writable(path / "results", overwrite=True)


WIDEST = 10_000
"""Columns of text: a table is as wide as what it holds. A narrow terminal breaks its lines, but nothing is
left out."""


def table(title: str, texts: Iterable[str], numbers: Iterable[str] = ()) -> Table:
    """Return an empty table: columns of texts, aligned left, then columns of numbers, aligned right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        highlight=False,
    )
    for heading in texts:
        made.add_column(heading, no_wrap=True)
    for heading in numbers:
        made.add_column(heading, justify="right", no_wrap=True)
    return made


def show(*parts: Table | str) -> None:
    """Print tables, and sentences between them."""
    from rich.console import Console

    console = Console(width=WIDEST, highlight=False)
    for part in parts:
        if isinstance(part, str):
            print(part)
        else:
            console.print(part)


def sentence(report: ReadReport) -> str:
    """Return what was lost, by reason, for a warning."""
    parts = [f"{count} scans skipped ({reason})" for reason, count in report.scans_skipped.items()]
    if report.bytes_lost:
        parts.append(f"{report.bytes_lost} bytes unreadable")
    return f"data was lost: {', '.join(parts)}"


def ends_with_3(report: ReadReport, strict: bool) -> bool:
    """Return whether the loss is severe; with `strict` any loss is."""
    return report.severe or (strict and report.lossy)
