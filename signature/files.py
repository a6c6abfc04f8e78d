"""From file to file: what `pc2grid convert` and `pc2grid relocalize` do with one recording, as functions."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.errors import ConfigError, OutputError
from pc2grid.io.atomic import require_writable
from pc2grid.io.recording import open_log
from pc2grid.mapping.drawn_map import is_drawn_map, load_drawn_map
from pc2grid.mapping.report import lost_warnings
from pc2grid.model import Health, SessionMap, Trajectory
from pc2grid.observer import Observer, ProgressBars
from pc2grid.pipeline import follow
from pc2grid.time_span import TimeSpan
from signature.config import Config
from signature.database import Label, open_database
from signature.database.maintenance import exists
from signature.database.postgres.server import is_url
from signature.localization.answer import NO_POSES, Asked
from signature.localization.answering import locate_map
from signature.localization.localizer import Estimate, Localizer
from signature.localization.located_path import followed
from signature.localization.map_index import MapIndex
from signature.localization.shown.report import Found
from signature.sessions import add_sessions, build_sessions

if TYPE_CHECKING:
    from pc2grid.clouds.planar_scan import PlanarScan
    from pc2grid.io.recording import Log
    from pc2grid.mapping.drawn_map import DrawnMap
    from pc2grid.model import RegisteredScan
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer
    from signature.localization.answer_json import QueryRecording
    from signature.localization.pose_check import PoseCheck
    from signature.localization.prior import Prior


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

    Of a recording that does not hang together every part becomes a session, and the one with the longest
    travel is returned.

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
    >>> monday = pc2grid.convert("monday.mcap", "new.submaps", span=pc2grid.TimeSpan(0.0, 2.0))
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
) -> Answer:
    """Find where a recording was made, or where a map lies.

    query : a recording, or a map as in `convert`.
    database : file or postgresql:// URL; or a map, which is converted for this one query.
    config : its sections `read`, `registration` and `relocalize` are used; see `query_config`.
    span : the part of the recording to use. recover : use what is whole of a damaged recording.
    prior : what is known of the robot's pose beforehand; other places are no answers.
    until_located : stop at the first estimate that is `located`; otherwise the recording is read to its end,
        and the answer is about its last metres.
    observer : gets the progress, and each scan with its tracked pose; None: a progress bar on a terminal
        or in a notebook.

    Raises the errors of `pc2grid.open_log` and `signature.open_database`, MapFileError for a map, and NoScans
    if no scan can be used. `Answer.plot`, `report` and `save` show the answer.

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
    with open_places(database, config, observer.on_warning) as opened:
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
    accept = config.relocalize.accept
    asked = Asked(poses=found.poses, about=found.about, database=str(database), accept=accept)
    return replace(found.answer, asked=asked)


@contextlib.contextmanager
def open_places(
    place: str | Path, config: Config = Config(), warn: Callable[[str], object] = lambda sentence: None
) -> Iterator[SubmapDatabase]:
    """Where to look: a database, or a map, which becomes a database for as long as it is used.

    place : file or postgresql:// URL of a database; or the map.yaml of a nav2 map, a point cloud or a mesh.
    config : how a map is read and divided. warn : gets what the user should know of a map.

    Raises the errors of `signature.open_database`, and MapFileError for a map.

    >>> with open_places("map.yaml") as places:
    ...     [session.name for session in places.sessions()]
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
    see: Callable[[RegisteredScan, Estimate | None], None] = lambda registered, estimate: None,
    observer: Observer = Observer(),
    index: MapIndex | None = None,
) -> Found:
    """Locate a map, or a recording, or the part of it that `span` names, in an open database.

    config, span, recover, until_located, observer : as in `relocalize`.
    prior : what is known of the pose; it may say so by the recording.
    see : called with each scan, and with what `Localizer.add` returned for it.
    index : of the database, if it is prepared.

    Raises the errors of `pc2grid.open_log`, MapFileError, NoScans, and what `prior` raises.
    """
    config = query_config(database, config)
    if is_drawn_map(path):
        drawn = load_drawn_map(path, config)
        answer = locate_map(drawn.grid, index or MapIndex.of(database, config, observer))
        about = about_map(path, drawn, answer)
        return Found(answer=answer, poses=NO_POSES, about=about, drawn=drawn.grid)
    with open_log(path, config.read, recover=recover) as log:
        known = prior(log, span)
        index = index or MapIndex.of(database, config, observer)
        localizer, seen = Localizer(index if known is None else index.within(known)), []
        with observer.step("locate", span.length_ns(log.info.start_ns, log.info.end_ns) * 1e-9):
            for registered, planar_scan in tracked(log, config, span, observer):
                estimate = localizer.add(registered, planar_scan)
                observer.on_scan(registered)
                see(registered, estimate)
                seen.append((registered.scan.stamp_ns, registered.T_session_base, registered.health))
                if until_located and estimate is not None and localizer.answer().status == "located":
                    break
            answer = localizer.answer()
        stamps_ns, poses, health = zip(*seen, strict=True)
        way = Trajectory(stamps_ns=np.array(stamps_ns), T_session_base=np.array(poses), health=health)
        about = about_log(path, log, answer, span, health)
        return Found(answer=answer, poses=followed(way, answer), about=about, report=log.report())


def tracked(
    log: Log, config: Config, span: TimeSpan, observer: Observer
) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
    """The registered scans of a part of a recording. observer : gets the share that is done."""
    for registered, planar_scan in follow(log.scans(span.start_s, span.duration_s), config, observer):
        yield registered, planar_scan
        observer.on_progress(span.share_done(registered.scan.stamp_ns, log.info.start_ns, log.info.end_ns))


def about_log(
    path: Path, query: Log, answer: Answer | PoseCheck, span: TimeSpan, health: Sequence[Health]
) -> QueryRecording:
    """The description of a recording, or of a part of it, in the JSON document of the answer.

    health : of its scans.
    """
    report = query.report()
    return {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "start_s": span.start_s,
        "duration_s": span.duration_s,
        "scans": len(health),
        "sensor": query.choose().sensor,
        "lossy": report.lossy,
        "warnings": [*report.warnings, *lost_warnings(health)],
    }


def about_map(path: Path, drawn: DrawnMap, answer: Answer) -> QueryRecording:
    """The same of a map."""
    return {
        "path_m": answer.path_m,
        "stamp_ns": answer.stamp_ns,
        "source": path.name,
        "start_s": 0.0,
        "duration_s": None,
        "scans": 0,
        "sensor": "map",
        "lossy": False,
        "warnings": list(drawn.warnings),
    }


def query_config(database: SubmapDatabase, config: Config) -> Config:
    """The settings for a query.

    It is drawn and described with those that made the database; how it is read and registered, and how the
    answer is found, is taken from `config`.
    """
    own = {section: getattr(config, section) for section in ("read", "registration", "relocalize")}
    return database.config().model_copy(update=own)
