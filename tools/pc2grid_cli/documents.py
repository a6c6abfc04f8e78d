"""The JSON documents of the commands: their schemas (draft 2020-12), and how a session is described in them.

A schema is made of the type of a document, which stands beside the command that fills it, so that mypy
compares what is printed with what the schema says. It holds frozen types of the program as they are. Metres,
radians, int64 nanoseconds, unless a name says otherwise.
"""

from __future__ import annotations

import json
import pkgutil
import statistics
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.model import (
    Consistency,
    OdometryCheck,
    Precision,
    ReadReport,
    SessionMap,
    ThreeDigits,
    UncertainSegment,
)
from pc2grid.settings import dump_settings
from pc2grid_cli import console, options
from signature.config import Config
from signature.database import Provenance, SessionInfo
from signature.database.protocol import BuildingFrame, Covariance, largest_m
from signature.localization.answer_json import SCHEMA_VERSION, Labelled, TypedDict, adapter

_WRITTEN = "pc2grid_cli.db:DbWrite"
DOCUMENTS = {
    "convert": "pc2grid_cli.convert:Convert",
    "db-check": "pc2grid_cli.db:DbCheck",
    "db-copy": _WRITTEN,
    "db-info": "pc2grid_cli.db:DbInfo",
    "db-join": "pc2grid_cli.db:DbJoin",
    "db-merge": _WRITTEN,
    "db-remove": _WRITTEN,
    "db-rename": _WRITTEN,
    "db-split": _WRITTEN,
    "export": "pc2grid_cli.export:Export",
    "info": "pc2grid_cli.info:Info",
    "info-map": "pc2grid_cli.info:InfoMap",
    "relocalize": "pc2grid_cli.relocalize:Relocalize",
    "relocalize-check": "pc2grid_cli.known_pose:RelocalizeCheck",
    "simulate": "pc2grid.simulate.session:SimulatedSession",
    "watch": "pc2grid_cli.watch:Watch",
    "watch-check": "pc2grid_cli.watch:WatchCheck",
}
"""By command, where the type of its document is: it is imported when its schema is asked for."""


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


def schema(name: str) -> dict[str, Any]:
    """Return the schema of a command's document, or of all `settings` as TOML holds them. Raises KeyError."""
    if name == "settings":
        about = adapter(Config).json_schema()
    else:
        about = adapter(pkgutil.resolve_name(DOCUMENTS[name])).json_schema(mode="serialization")
        about["properties"] = {"schema_version": {"const": SCHEMA_VERSION}, **about["properties"]}
        about = json.loads(json.dumps(about), object_hook=_complete)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **about}


def _complete(about: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an object whose keys are always there, also those with a default."""
    return {**about, "required": [*about["properties"]]} if "properties" in about else about


class OfDatabase(TypedDict):
    """A document about a database: its path, or its URL without a password."""

    database: str


class PrecisionSummary(TypedDict):
    """How exactly the places of a map lie to each other: standard deviations of a position in the least
    certain direction. median_m: half of the places are known better. worst_m: the largest. loose: stretches
    where it is too large to rely on, the least certain first."""

    median_m: ThreeDigits
    worst_m: ThreeDigits
    loose: list[UncertainSegment]


class Mapped(Labelled):
    """A session. digest: sha256 of what it was made from, hex. area_m2: free space. consistency, odometry,
    precision: null for an imported map."""

    source: str
    digest: str
    sensor: str
    scans: int
    path_m: float
    duration_s: float
    area_m2: float
    submaps: int
    consistency: Consistency | None
    odometry: OdometryCheck | None
    precision: PrecisionSummary | None


class Converted(Mapped):
    """What became of one input."""

    session: str
    report: ReadReport


class StoredInfo(Mapped):
    """A session of a database, with the versions and settings that made it. points: how many in space."""

    name: str
    resolution_m: float
    points: int
    lossy: bool
    warnings: list[str]
    versions: dict[str, str]
    config: dict[str, Any]


class JoinedSession(TypedDict):
    """Where a session lies in its building. frame: name of the building's frame. bent_m: how far the map is
    bent there at most, where another session straightens it."""

    session: str
    frame: str
    T_building_session: SE2
    covariance: Covariance
    bent_m: float


def session_document(session: SessionMap, origin: Provenance) -> Converted:
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
        "precision": precision_summary(session.precision),
        "report": session.report,
    }


def stored_document(s: SessionInfo) -> StoredInfo:
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
        "precision": precision_summary(s.precision),
        "warnings": list(s.warnings),
        "versions": dict(s.provenance.versions),
        "config": s.provenance.config.model_dump(mode="json"),
    }


def joined_document(session: str, frame: BuildingFrame) -> JoinedSession:
    """Return the description of where a session lies in its building."""
    return {
        "session": session,
        "frame": frame.name,
        "T_building_session": frame.T_building_session,
        "covariance": frame.covariance,
        "bent_m": round(largest_m(frame.bend), 3),
    }


def buildings(frames: Mapping[str, BuildingFrame]) -> dict[str, dict[str, BuildingFrame]]:
    """Return the joined sessions by the frame of their building. frames : by session."""
    found: dict[str, dict[str, BuildingFrame]] = defaultdict(dict)
    for session, at in frames.items():
        found[at.name][session] = at
    return found


def precision_summary(precision: Precision | None) -> PrecisionSummary | None:
    """Return how exactly the places of a map lie to each other, in a few numbers."""
    if precision is None:
        return None
    return {
        "median_m": float(statistics.median(precision.sigma_m or (0.0,))),
        "worst_m": precision.worst_m,
        "loose": list(precision.loose),
    }
