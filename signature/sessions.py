"""Recordings and maps become session maps, whose submaps are described and stored in a database."""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid._version import __version__
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.io import open_log
from pc2grid.mapping.drawn_map import digest_of_map, is_drawn_map, load_drawn_map
from pc2grid.model import PointMap, ReadReport, SessionMap, Trajectory
from pc2grid.observer import Observer
from pc2grid.pipeline import build_maps, longest_of
from pc2grid.submaps.partition import divide
from pc2grid.threads import one_blas_thread
from pc2grid.time_span import TimeSpan
from signature.config import Config
from signature.database import Label, Provenance
from signature.database.maintenance import store
from signature.describe import Signature, describe
from signature.localization.place_recognition import recognizer_for

if TYPE_CHECKING:
    from pc2grid.mapping.drawn_map import DrawnMap

_LIBRARIES = (
    "kiss-icp",
    "mcap",
    "networkx",
    "numba",
    "numpy",
    "open3d-cpu",
    "open3d",
    "opencv-python-headless",
    "scikit-learn",
    "scipy",
)
"""The distributions that compute a session. open3d has two names, of which one is installed."""


def provenance(
    source: str | Path,
    digest: str,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    label: Label | None = None,
) -> Provenance:
    """What makes a session: the source, the settings, and the versions of the libraries that compute.

    source : path of the recording or map; only its name is kept. digest : its sha256.
    The time of day is left out, so that the same input gives the same bytes.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     origin = provenance(log.info.path, log.digest(), signature.Config())
    >>> origin.source, len(origin.digest), origin.versions["pc2grid"] == pc2grid.__version__
    ('monday.mcap', 64, True)
    """
    return Provenance(
        source=Path(source).name,
        digest=digest,
        config=config,
        start_s=span.start_s,
        duration_s=span.duration_s,
        versions={"pc2grid": __version__, "python": platform.python_version(), **_versions()},
        label=label or Label(),
    )


def _versions() -> dict[str, str]:
    versions = {}
    for name in _LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def build_session(
    path: str | Path,
    name: str,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    label: Label | None = None,
    observer: Observer = Observer(),
) -> tuple[SessionMap, Provenance]:
    """Turn a recording or a map into a session map, and say what it was made from.

    path : of a recording, or of a nav2 map, point cloud or mesh of a building.
    span : the part of the recording to use; a map is always used as a whole.
    recover : use what is whole of a damaged recording.
    observer : gets the progress, each scan with its tracked pose, and a note with the topic that was chosen.
    Of a recording that does not hang together the part with the longest travel is returned;
    `build_sessions` returns all.

    Raises LogError and its subclasses, NoScans, MapFileError.

    >>> import signature
    >>> session, origin = build_session("map.yaml", "plan", signature.Config())
    >>> session.sensor, len(session.trajectory), origin.source
    ('map', 0, 'map.yaml')
    """
    maps, origin = build_sessions(
        path, name, config, span=span, recover=recover, label=label, observer=observer
    )
    return longest_of(maps), origin


@one_blas_thread
def build_sessions(
    path: str | Path,
    name: str,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    label: Label | None = None,
    observer: Observer = Observer(),
) -> tuple[tuple[SessionMap, ...], Provenance]:
    """Turn a recording into one session map, or into several if it does not hang together.

    See `pc2grid.build_maps`, which names them. Parameters and errors are those of `build_session`.

    >>> import signature
    >>> sessions, origin = build_sessions("map.yaml", "plan", signature.Config())
    >>> [session.session for session in sessions]
    ['plan']
    """
    path = Path(path)
    if is_drawn_map(path):
        drawn = load_drawn_map(path, config)
        origin = provenance(path, drawn.digest, config, label=label)
        return (session_of_map(drawn, name, config),), origin

    with open_log(path, config.read, recover=recover) as log:
        choice = log.choose()
        observer.on_note(f"{path}: {choice.topic} ({choice.sensor}): {choice.reason}")
        length_s = span.length_ns(log.info.start_ns, log.info.end_ns) * 1e-9
        with observer.step(f"map {path.name}", length_s):
            maps = build_maps(
                log,
                config,
                session=name,
                span=span,
                observer=observer,
                recognizer=recognizer_for(config),
            )
        origin = provenance(path, log.digest(), config, span=span, label=label)
    return maps, origin


def digest_of(path: Path, config: Config) -> str:
    """The sha256 in the provenance of a session that is made from this recording or map."""
    if is_drawn_map(path):
        return digest_of_map(path)

    with open_log(path, config.read) as log:
        return log.digest()


def session_of_map(drawn: DrawnMap, name: str, config: Config) -> SessionMap:
    """A session of a map, in the frame of that map and without a trajectory."""
    no_poses = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    graph, submaps = divide(drawn.grid, config.partition)
    return SessionMap(
        session=name,
        sensor="map",
        grid=drawn.grid,
        submaps=submaps,
        trajectory=no_poses,
        graph=graph,
        points=_points(drawn, config),
        report=ReadReport(warnings=drawn.warnings),
    )


def _points(drawn: DrawnMap, config: Config) -> PointMap | None:
    """The points of a cloud or mesh in space, if they are to be kept; never finer than the map."""
    voxel_m = config.projection.points_voxel_m
    if voxel_m is None or not len(drawn.level_points_m):
        return None
    cloud = VoxelCloud(max(voxel_m, config.projection.resolution_m))
    cloud.add(drawn.level_points_m)
    return PointMap.of(cloud.points_m(), cloud.edge_m, cloud.corner_m)


@one_blas_thread
def describe_all(session_map: SessionMap, config: Config, observer: Observer = Observer()) -> list[Signature]:
    """Signatures of all submaps of a session, in the order of the submaps."""
    signatures = []
    for done, submap in enumerate(session_map.submaps, start=1):
        signatures.append(describe(submap, config.signature))
        observer.on_progress(done / len(session_map.submaps))
    return signatures


def add_session(
    database: str | Path,
    session_map: SessionMap,
    config: Config,
    provenance: Provenance,
    *,
    overwrite: bool = False,
) -> None:
    """Describe a session and add it to a database file, which is created if it does not exist.

    overwrite : replace a session of the same name.

    Raises the errors of `SubmapDatabase.add`.

    >>> import pc2grid, signature
    >>> config = signature.Config()
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = pc2grid.build_map(log, config, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))
    ...     add_session("new.submaps", monday, config, provenance(log.info.path, log.digest(), config))
    >>> with signature.open_database("new.submaps") as database:
    ...     [session.name for session in database.sessions()]
    ['monday']
    """
    add_sessions(database, [(session_map, provenance)], config, keep=True, overwrite=overwrite)


def add_sessions(
    database: str | Path,
    sessions: Sequence[tuple[SessionMap, Provenance]],
    config: Config,
    *,
    keep: bool = True,
    overwrite: bool = False,
    observer: Observer = Observer(),
) -> None:
    """Describe several sessions and store them in one transaction.

    keep : add them to the sessions of the file; otherwise they replace them.
    """
    entries = [(m, describe_all(m, config, observer), origin) for m, origin in sessions]
    store(database, entries, keep=keep, overwrite=overwrite)
