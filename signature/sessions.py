"""Recordings and maps as sessions: mapped, described, stored in a database, and located in one.

`convert` and `relocalize` are the work of `pc2grid convert` and `pc2grid relocalize` with one recording, as
functions.
"""

from __future__ import annotations

import contextlib
import platform
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid._version import __version__
from pc2grid.clouds.cloud import VoxelCloud
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import ConfigError, OutputError
from pc2grid.estimation.tracker import follow
from pc2grid.grids.drawn import DrawnMap, digest_of_map, is_drawn_map, load_drawn_map
from pc2grid.io.atomic import require_writable
from pc2grid.io.recording import Log, open_log
from pc2grid.libraries import one_blas_thread
from pc2grid.model import Health, PointMap, ReadReport, RegisteredScan, SessionMap, Trajectory
from pc2grid.observer import Observer, ProgressBars, TimeSpan
from pc2grid.submaps.submaps import divide
from signature.config import Config
from signature.database import Label, Provenance, SubmapDatabase, open_database
from signature.database.maintenance import exists, store
from signature.database.postgres import is_url
from signature.localization.answer import Answer, corrected_path
from signature.localization.localizer import Localizer, locate_map
from signature.localization.pose_check import PoseCheck
from signature.paper import Signature, describe
from signature.places.map_index import MapIndex, Prior
from signature.session.build import build_maps, longest_of
from signature.session.part_maps import lost_warnings
from signature.shown.page import Found

# --- from file to file --------------------------------------------------------------------------------


def convert(
    source: str | Path,
    database: str | Path,
    config: Config = Config(),
    *,
    name: str | None = None,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    label: Label | None = None,
    add: bool = False,
    overwrite: bool = False,
    observer: Observer | None = None,
) -> SessionMap:
    """Make a session of a recording or a map, and store it in a database.

    Of a recording in several parts every part becomes a session, and the one with the longest travel is
    returned.

    source : a recording, the map.yaml of a nav2 map, or a point cloud or mesh of a building.
    database : the file to make, such as `building.submaps`, or a postgresql:// URL.
    name : of the session; by default that of the file.
    span, recover, label : as in `signature.build_session`.
    add : add the session to an existing database. overwrite : replace an existing database or, with `add`, a
        session of the same name.
    observer : gets the news; None: a progress bar on a terminal or in a notebook.

    Raises OutputError, before any work, for an existing database without `add` and `overwrite` and for one
    that cannot be written; else as `signature.build_session` and `signature.add_session`.

    >>> import pc2grid
    >>> monday = pc2grid.convert("monday.mcap", "made.submaps", span=pc2grid.TimeSpan(0.0, 2.0))
    >>> monday.session, monday.sensor
    ('monday', 'laser')
    """
    if not (add or overwrite) and exists(database):
        raise OutputError(f"{database}: exists already", hint="--force replaces it, --add adds to it")
    if not is_url(database):
        require_writable(Path(database), overwrite=True)
    maps, origin = build_sessions(
        source,
        name or Path(source).stem,
        config,
        span=span,
        recover=recover,
        label=label,
        observer=observer or ProgressBars(),
    )
    add_sessions(database, [(made, origin) for made in maps], config, keep=add, overwrite=overwrite)
    return max(maps, key=lambda part: part.trajectory.length_m)


def relocalize(
    query: str | Path,
    database: str | Path,
    config: Config = Config(),
    *,
    span: TimeSpan = TimeSpan(),
    prior: Prior | None = None,
    until_located: bool = False,
    recover: bool = False,
    observer: Observer | None = None,
) -> Found:
    """Find where a recording was made, or where a map lies.

    query : a recording, or a map as in `convert`.
    database : file or postgresql:// URL; or a map, which is converted for this one query.
    config : its sections `read`, `registration` and `relocalize` are used; see `query_config`.
    span : the part of the recording to use. recover : use the undamaged part of a recording.
    prior : prior knowledge of the robot's pose; other places are no answers.
    until_located : stop at the first answer that is `located`; otherwise the recording is read to its end,
        and the answer is about its last metres.
    observer : gets the progress, and each scan with its tracked pose; None: a progress bar on a terminal
        or in a notebook.

    Raises the errors of `pc2grid.open_log` and `signature.open_database`, MapFileError for a map, and NoScans
    if no scan can be used. `plot`, `report` and `save` show the answer.

    >>> import pc2grid
    >>> answer = pc2grid.relocalize("tuesday.mcap", "building.submaps", until_located=True)
    >>> answer.status, answer.session, answer.path_m < 4.0
    ('located', 'monday', True)
    >>> elsewhere = pc2grid.Prior.around(50.0, 50.0, radius_m=1.0)
    >>> pc2grid.relocalize("tuesday.mcap", "building.submaps", prior=elsewhere).status
    'not_found'
    """
    if prior is not None and is_drawn_map(Path(query)):
        raise ConfigError("prior: there is no robot in a map")
    observer = observer or ProgressBars()
    with open_database_or_map(database, config, observer.on_warning) as opened:
        found = find(
            Path(query),
            opened,
            config,
            span=span,
            recover=recover,
            prior=lambda log, span: prior,
            until_located=until_located,
            observer=observer,
        )
    # The name of a server's database in `found` has no password.
    return replace(found, database=str(database))


@contextlib.contextmanager
def open_database_or_map(
    place: str | Path, config: Config = Config(), warn: Callable[[str], object] = lambda sentence: None
) -> Iterator[SubmapDatabase]:
    """Open a database, or a map, which becomes a database for as long as it is used.

    place : file or postgresql:// URL of a database; or the map.yaml of a nav2 map, a point cloud or a mesh.
    config : how a map is read and divided. warn : gets warnings about a map.

    Raises the errors of `signature.open_database`, and MapFileError for a map.

    >>> with open_database_or_map("map.yaml") as database:
    ...     [session.name for session in database.sessions()]
    ['map']
    """
    with contextlib.ExitStack() as stack:
        if not is_url(place) and is_drawn_map(Path(place)):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            file = folder / f"{Path(place).stem}.submaps"
            for sentence in convert(place, file, config, observer=Observer()).report.warnings:
                warn(sentence)
            place = file
        yield stack.enter_context(open_database(place))


def find(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    prior: Callable[[Log, TimeSpan], Prior | None] = lambda log, span: None,
    until_located: bool = False,
    see: Callable[[RegisteredScan, Answer | None], None] = lambda registered, answer: None,
    observer: Observer = Observer(),
    index: MapIndex | None = None,
) -> Found:
    """Locate a map, or a recording, or the part of it that `span` names, in an open database.

    config, span, recover, until_located, observer : as in `relocalize`.
    prior : returns prior knowledge of the pose, perhaps from the recording.
    see : called with each scan, and with the result of `Localizer.add` for it.
    index : of the database, if it is prepared.

    Raises the errors of `pc2grid.open_log`, MapFileError, NoScans, and what `prior` raises.
    """
    config = query_config(database, config)
    asked = {"database": database.location, "accept": config.relocalize.accept}
    if is_drawn_map(path):
        drawn = load_drawn_map(path, config)
        answer = locate_map(drawn.grid, index or MapIndex.of(database, config, observer))
        about = about_query(path, answer, ReadReport(warnings=drawn.warnings))
        return Found.of(answer, about=about, drawn=drawn.grid, **asked)
    with open_log(path, config.read, recover=recover) as log:
        known = prior(log, span)
        index = index or MapIndex.of(database, config, observer)
        localizer, seen = Localizer(index if known is None else index.within(known)), []
        with observer.step("locate", span.length_ns(log.info.start_ns, log.info.end_ns) * 1e-9):
            for registered, planar_scan in tracked(log, config, span, observer):
                found = localizer.add(registered, planar_scan)
                observer.on_scan(registered)
                see(registered, found)
                seen.append((registered.scan.stamp_ns, registered.T_session_base, registered.health))
                if until_located and found is not None and localizer.answer().status == "located":
                    break
            answer = localizer.answer()
        stamps_ns, poses, health = zip(*seen, strict=True)
        way = Trajectory(stamps_ns=np.array(stamps_ns), T_session_base=np.array(poses), health=health)
        read, sensor = log.report(), log.choose().sensor
        about = about_query(path, answer, read, span, health, sensor)
        return Found.of(answer, about=about, poses=corrected_path(way, answer), read=read, **asked)


def tracked(
    log: Log, config: Config, span: TimeSpan, observer: Observer
) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
    """Yield the registered scans of a part of a recording. observer : gets the progress."""
    for registered, planar_scan in follow(log.scans(span.start_s, span.duration_s), config, observer):
        yield registered, planar_scan
        observer.on_progress(span.share_done(registered.scan.stamp_ns, log.info.start_ns, log.info.end_ns))


def query_config(database: SubmapDatabase, config: Config) -> Config:
    """Return the settings for a query.

    It is drawn and described with those of the database; the settings of reading, registration and answers
    are taken from `config`.
    """
    own = {section: getattr(config, section) for section in ("read", "registration", "relocalize")}
    return database.config().model_copy(update=own)


def about_query(
    path: Path,
    answer: Answer | PoseCheck,
    read: ReadReport,
    span: TimeSpan = TimeSpan(),
    health: Sequence[Health] = (),
    sensor: str = "map",
) -> dict[str, Any]:
    """Return the description of a recording, or of a part of it, or of a map, in the documents of answers.

    read : what was read of it, and what was lost. span : the part that was read. health : of its scans.
    sensor : lidar, laser, depth, or map.
    """
    return {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "start_s": span.start_s,
        "duration_s": span.duration_s,
        "scans": len(health),
        "sensor": sensor,
        "lossy": read.lossy,
        "warnings": [*read.warnings, *lost_warnings(health)],
    }


# --- from a recording or a map to a session -----------------------------------------------------------

_LIBRARIES = (
    "kiss-icp",
    "mcap",
    "networkx",
    "numba",
    "numpy",
    "open3d-cpu",
    "open3d",
    "opencv-python-headless",
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
    """Return the provenance of a session: the source, the settings, and the versions of the libraries that
    compute.

    source : path of the recording or map; only its name is kept. digest : its sha256. The time of day is left
    out, so that the same input gives the same bytes.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     origin = provenance(log.info.path, log.digest(), signature.Config())
    >>> origin.source, len(origin.digest), origin.versions["pc2grid"] == pc2grid.__version__
    ('monday.mcap', 64, True)
    """
    versions = {"pc2grid": __version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return Provenance(
        source=Path(source).name,
        digest=digest,
        config=config,
        start_s=span.start_s,
        duration_s=span.duration_s,
        versions=versions,
        label=label or Label(),
    )


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
    """Turn a recording or a map into a session map; returns it and its provenance.

    path : of a recording, or of a nav2 map, point cloud or mesh of a building. span : the part of the
    recording to use; a map is always used as a whole. recover : use the undamaged part of a recording.
    observer : gets the progress, each scan with its tracked pose, and a note with the topic that was chosen.
    Of a recording in several parts the one with the longest travel is returned; `build_sessions` returns all.

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
    """Turn a recording into one session map, or into several if its parts cannot be placed to each other.

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
            )
        origin = provenance(path, log.digest(), config, span=span, label=label)
    return maps, origin


def session_of_map(drawn: DrawnMap, name: str, config: Config) -> SessionMap:
    """Make a session of a map, in the frame of that map and without a trajectory."""
    no_poses = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    graph, submaps = divide(drawn.grid, config.partition)
    voxel_m, points = config.projection.points_voxel_m, None
    if voxel_m is not None and len(drawn.level_points_m):  # of a cloud or mesh; never finer than the map
        cloud = VoxelCloud(max(voxel_m, config.projection.resolution_m))
        cloud.add(drawn.level_points_m)
        points = PointMap.of(cloud.points_m(), cloud.edge_m, cloud.corner_m)
    return SessionMap(
        session=name,
        sensor="map",
        grid=drawn.grid,
        submaps=submaps,
        trajectory=no_poses,
        graph=graph,
        points=points,
        report=ReadReport(warnings=drawn.warnings),
    )


def digest_of(path: Path, config: Config) -> str:
    """Return the sha256 in the provenance of a session that is made from this recording or map."""
    if is_drawn_map(path):
        return digest_of_map(path)

    with open_log(path, config.read) as log:
        return log.digest()


@one_blas_thread
def describe_all(session_map: SessionMap, config: Config, observer: Observer = Observer()) -> list[Signature]:
    """Return the signatures of all submaps of a session, in the order of the submaps."""
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

    Raises the errors of `signature.database.maintenance.store`.

    >>> import pc2grid, signature
    >>> config = signature.Config()
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = pc2grid.build_map(log, config, session="monday", span=pc2grid.TimeSpan(0.0, 2.0))
    ...     add_session("again.submaps", monday, config, provenance(log.info.path, log.digest(), config))
    >>> with signature.open_database("again.submaps") as database:
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
