"""The JSON documents of the commands: their schemas (draft 2020-12), and how a session is described in them.

`schemas.json` holds the keys of all documents, with what they mean: a command prints no others, and leaves
none out, which tests compare. Frozen types of the program are printed as they are. Metres, radians, int64
nanoseconds, unless a name says otherwise.
"""

from __future__ import annotations

import json
import re
import statistics
from importlib.resources import files
from typing import Any

from pc2grid.display import SCHEMA_VERSION, adapter
from pc2grid.errors import ConfigError
from pc2grid.model import Precision, SessionMap
from pc2grid.settings import dump_settings
from pc2grid_cli import console, options
from signature.config import Config
from signature.database import Provenance, SessionInfo
from signature.database.protocol import BuildingFrame, largest_m

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
        "digest": s.digest,
        "submaps": s.submaps,
        "resolution_m": s.resolution_m,
        "area_m2": s.area_m2,
        "path_m": s.path_m,
        "duration_s": s.duration_s,
        "scans": s.scans,
        "points": s.points,
        "lossy": s.lossy,
        "consistency": s.consistency,
        "odometry": s.odometry,
        "precision": _summary(s.precision),
        "warnings": list(s.warnings),
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
