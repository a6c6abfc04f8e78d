"""Recordings and maps into the database: as session maps, every submap described, and stored."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

import numpy as np

import pc2grid
from pc2grid.model import OccupancyGrid, RegisteredScan, SessionMap, Trajectory
from signature.config import Config
from signature.database import Label, Provenance
from signature.describe import Signature, describe


def provenance(
    source: str | Path,
    digest: str,
    config: Config,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    label: Label | None = None,
) -> Provenance:
    """What makes a session from `source` (its sha256 `digest`) here and now, without the time of day.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     origin = provenance(log.info.path, log.digest(), signature.Config())
    >>> origin.source, len(origin.digest), origin.versions["pc2grid"] == pc2grid.__version__
    ('monday.mcap', 64, True)
    """
    libraries = ("kiss-icp", "mcap", "numpy", "scipy", "opencv-python-headless", "scikit-image")
    versions = {"pc2grid": pc2grid.__version__, "python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in libraries}
    return Provenance(
        source=Path(source).name,
        digest=digest,
        config=config,
        start_s=start_s,
        duration_s=duration_s,
        versions=versions,
        label=label or Label(),
    )


def build_session(
    path: str | Path,
    name: str,
    config: Config,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    recover: bool = False,
    label: Label | None = None,
    progress: Callable[[float], None] | None = None,
    note: Callable[[str], None] | None = None,
    watch: Callable[[RegisteredScan], None] | None = None,
) -> tuple[SessionMap, Provenance]:
    """A recording or nav2 map as a session map, and what it came from.

    progress : told the share that is done. note : told which topic was chosen, and why.
    watch : shown each scan of a recording where tracking puts it.

    Raises LogError and its like, MapFileError.

    >>> import signature
    >>> session, origin = build_session("map.yaml", "plan", signature.Config())
    >>> session.sensor, len(session.trajectory), origin.source
    ('map', 0, 'map.yaml')
    """
    from pc2grid.io.nav2_map import is_map_file, load_map

    path = Path(path)
    if is_map_file(path):
        grid = load_map(path)
        return _map_session(grid, name, config), provenance(
            path, _map_digest(path, grid), config, label=label
        )

    from pc2grid.io import open_log
    from pc2grid.pipeline import build_map

    with open_log(path, config.read, recover=recover) as log:
        choice = log.choose()
        if note is not None:
            note(f"{path}: {choice.topic} ({choice.sensor}): {choice.reason}")
        session_map = build_map(
            log,
            config,
            session=name,
            start_s=start_s,
            duration_s=duration_s,
            progress=progress,
            watch=watch,
        )
        origin = provenance(path, log.digest(), config, start_s=start_s, duration_s=duration_s, label=label)
    return session_map, origin


def digest_of(path: Path, config: Config) -> str:
    """The sha256 that a session made from this recording or map says it came from."""
    from pc2grid.io.nav2_map import is_map_file, load_map

    if is_map_file(path):
        return _map_digest(path, load_map(path))
    from pc2grid.io import open_log

    with open_log(path, config.read) as log:
        return log.digest()


def _map_digest(path: Path, grid: OccupancyGrid) -> str:
    """Of the text and of the cells: the image may be of another format and say the same."""
    return hashlib.sha256(path.read_bytes() + grid.cells.tobytes()).hexdigest()


def _map_session(grid: OccupancyGrid, name: str, config: Config) -> SessionMap:
    """A map as a session in its own frame."""
    from pc2grid.partition import partition

    nowhere = Trajectory(stamps_ns=np.empty(0, np.int64), T_map_base=np.empty((0, 4, 4)))
    submaps = partition(grid, config.partition)
    return SessionMap(session=name, sensor="map", grid=grid, submaps=submaps, trajectory=nowhere)


def describe_all(
    session_map: SessionMap, config: Config, progress: Callable[[float], None] | None = None
) -> list[Signature]:
    """Signatures of all submaps of a session, in their order; `progress` is told the share that is done."""
    signatures = []
    for done, submap in enumerate(session_map.submaps, start=1):
        signatures.append(describe(submap, config.signature))
        if progress is not None:
            progress(done / len(session_map.submaps))
    return signatures


def add_session(
    database: str | Path,
    session_map: SessionMap,
    config: Config,
    provenance: Provenance,
    *,
    force: bool = False,
) -> None:
    """Describe a session and add it to a database file, which is made if it is missing.

    `force` replaces a session of the same name. Raises as `SubmapDatabase.add`.

    >>> import pc2grid, signature
    >>> config = signature.Config()
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = pc2grid.build_map(log, config, session="monday", duration_s=2.0)
    ...     add_session("new.submaps", monday, config, provenance(log.info.path, log.digest(), config))
    >>> with signature.open_database("new.submaps") as database:
    ...     [session.name for session in database.sessions()]
    ['monday']
    """
    add_sessions(database, [(session_map, provenance)], config, keep=True, force=force)


def add_sessions(
    database: str | Path,
    sessions: Sequence[tuple[SessionMap, Provenance]],
    config: Config,
    *,
    keep: bool = True,
    force: bool = False,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Describe several sessions and store them in one transaction.

    keep : add to what the file holds; otherwise they become its whole content.
    """
    from signature.database.transfer import store

    entries = [(m, describe_all(m, config, progress), origin) for m, origin in sessions]
    store(database, entries, keep=keep, force=force)
