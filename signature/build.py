"""Session maps into the database: every submap described and stored."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

import pc2grid
from pc2grid.model import SessionMap
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
    from signature.database.sqlite import store

    entries = [(m, describe_all(m, config, progress), origin) for m, origin in sessions]
    store(Path(database), entries, keep=keep, force=force)
