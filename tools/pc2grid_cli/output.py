"""What commands write: files, which are checked before any work begins, tables, warnings of lost data, and
JSON documents: their schemas (draft 2020-12), and how a session is described in them.

`schemas.json` holds the keys of all documents, with what they mean: a command prints no others, and leaves
none out, which tests compare. Frozen types of the program are printed as they are. Metres, radians, int64
nanoseconds, unless a name says otherwise.
"""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pc2grid.display import SCHEMA_VERSION, adapter
from pc2grid.errors import ConfigError, OutputError
from pc2grid.io.atomic import require_writable
from pc2grid.model import Precision, ReadReport, SessionMap
from pc2grid.settings import dump_settings
from pc2grid_cli import console, options
from signature.config import Config
from signature.database import Provenance, SessionInfo
from signature.database.postgres import is_url
from signature.database.protocol import BuildingFrame, largest_m

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


def check_file(option: str, path: Path, force: bool) -> None:
    """Refuse a file that the option `--{option}` cannot write.

    A name without a suffix is taken, unless the suffix selects the format.

    Raises OutputError for a suffix of another format, and as `require_writable`.
    """
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
    ends = {"map": (".yaml", ".pgm")}
    return [
        path.with_name(f"{path.name}{end}")
        for option, path in outputs.items()
        for end in ends.get(option, ("",))
    ]


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


# --- JSON documents -----------------------------------------------------------------------------------

Document = dict[str, Any]
"""Plain and frozen types, by key."""


def _complete(about: Document) -> Document:
    """Return the schema of an object, of which all keys are always there."""
    return {**about, "required": [*about["properties"]]} if "properties" in about else about


_SCHEMAS = files("pc2grid_cli").joinpath("schemas.json").read_text(encoding="utf-8")
_TYPES: Document = json.loads(_SCHEMAS, object_hook=_complete)["$defs"]
DOCUMENTS = tuple(name for name in _TYPES if name.islower())
"""The commands that print documents; the other types of the file are parts of them."""


def dump(given: options.ConfigDump, terminal: console.Console) -> None:
    """Print all settings."""
    print(dump_settings(given.settings(preset=given.preset)), end="")


def print_schema(given: options.ConfigSchema, terminal: console.Console) -> None:
    """Print a schema, or the names of all. Raises ConfigError for another name."""
    names = ["settings", *DOCUMENTS]
    if given.name is None:
        print("\n".join(names))
    elif given.name in names:
        console.print_result(schema(given.name))
    else:
        raise ConfigError(f"no schema {given.name!r}", hint=f"there are {', '.join(names)}")


def schema(name: str) -> Document:
    """Return the schema of a command's document, or of all `settings` as TOML holds them. Raises KeyError."""
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    if name == "settings":
        return draft | adapter(Config).json_schema()
    about = _TYPES[_TYPES[name].get("$ref", name).rpartition("/")[2]]
    parts: Document = {}
    waiting = [about]
    while waiting:
        named = re.findall(r"#/\$defs/(\w+)", json.dumps(waiting.pop()))
        waiting += [_TYPES[part] for part in named if part not in parts]
        parts |= {part: _TYPES[part] for part in named}
    keys = {"schema_version": {"const": SCHEMA_VERSION}, **about["properties"]}
    return draft | {"$defs": parts} | _complete({**about, "properties": keys})


def session_document(session: SessionMap, origin: Provenance) -> Document:
    """Return the description of a session that was made of one input."""
    return {
        "session": session.session,
        "building": origin.label.building,
        "floor": origin.label.floor,
        "source": origin.source,
        "digest": origin.digest,
        "sensor": session.sensor,
        "scans": len(session.trajectory),
        "path_m": round(session.trajectory.length_m, 2),
        "duration_s": round(session.trajectory.duration_s, 2),
        "area_m2": round(session.grid.free_m2, 1),
        "submaps": len(session.submaps),
        "consistency": session.consistency,
        "odometry": session.odometry,
        "precision": _summary(session.precision),
        "report": session.report,
    }


def stored_document(s: SessionInfo) -> Document:
    """Return the description of a session of a database."""
    return {
        "name": s.name,
        "sensor": s.sensor,
        "building": s.provenance.label.building,
        "floor": s.provenance.label.floor,
        "source": s.provenance.source,
        "digest": s.provenance.digest,
        "submaps": s.submaps,
        "resolution_m": s.resolution_m,
        "area_m2": s.area_m2,
        "path_m": s.path_m,
        "duration_s": s.duration_s,
        "scans": s.scans,
        "points": s.points,
        "lossy": s.report.lossy,
        "consistency": s.consistency,
        "odometry": s.odometry,
        "precision": _summary(s.precision),
        "warnings": list(s.report.warnings),
        "versions": dict(s.provenance.versions),
        "config": s.provenance.config.model_dump(mode="json"),
    }


def joined_document(session: str, frame: BuildingFrame) -> Document:
    """Return the description of where a session lies in its building."""
    return {
        "session": session,
        "frame": frame.name,
        "T_building_session": frame.T_building_session,
        "covariance": frame.covariance,
        "bent_m": round(largest_m(frame.bend), 3),
    }


def _summary(precision: Precision | None) -> Document | None:
    """Return how exactly the places of a map lie to each other, in a few numbers."""
    if precision is None:
        return None
    return {
        "median_m": round(statistics.median(precision.sigma_m or (0.0,)), 3),
        "worst_m": round(precision.worst_m, 3),
        "loose": list(precision.loose),
    }
