"""What a database holds already of the sessions that `convert` would make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pc2grid.errors import DatabaseError, OutputError, Pc2GridError
from pc2grid.model import is_part_of
from pc2grid_cli.output_files import check_database_name
from signature.conversion_jobs import Job
from signature.database import Provenance, maintenance, open_database
from signature.database.postgres.server import is_url
from signature.sessions import digest_of


def stored_sessions(output: str, jobs: Sequence[Job], *, add: bool, force: bool) -> dict[str, Provenance]:
    """Provenance of the sessions that are stored already and stay; without any, a new database is made.

    Raises OutputError if a database exists that the inputs must not be written to, DatabaseError if one that
    they are added to has a session of the same name that was made otherwise.
    """
    there = maintenance.exists(output)
    if not is_url(output) and not (there and add):
        check_database_name(output)
    if not there or (force and not add):
        return {}
    present = _present(output, jobs, add=add)
    if force:
        return {}
    difference = _difference(present, jobs)
    if not add:
        _refuse_others(output, present, jobs, difference)
    elif difference:
        raise DatabaseError(
            f"{maintenance.shown(output)}: holds the session{difference}",
            hint="--force replaces it; --name gives this one another name",
        )
    return present


def _present(output: str, jobs: Sequence[Job], *, add: bool) -> dict[str, Provenance]:
    """Provenance of the stored sessions by name."""
    try:
        with open_database(output) as opened:
            # A database may hold a whole fleet: for adding, only sessions of the same names matter.
            known = opened.sessions([job.name for job in jobs] if add else None)
        return {info.name: info.provenance for info in known}
    except DatabaseError:
        if add:
            raise
        where = maintenance.shown(output)
        raise OutputError(f"{where}: exists already", hint="--force replaces it") from None


def _refuse_others(
    output: str, present: Mapping[str, Provenance], jobs: Sequence[Job], difference: str
) -> None:
    """Raises OutputError unless the database is what an interrupted conversion of these jobs left behind."""
    others = {
        name for name in present if not any(name == job.name or is_part_of(name, job.name) for job in jobs)
    }
    if others:
        difference = f" and holds {', '.join(map(repr, sorted(present)))}"
        difference += f" instead of {', '.join(repr(job.name) for job in jobs)}"
    elif len(jobs) == 1 and not difference:
        difference = " and is made from the same input with the same settings"
    if difference:
        raise OutputError(
            f"{maintenance.shown(output)}: exists already{difference}",
            hint="--force replaces it, --add adds to it",
        )


def _difference(present: Mapping[str, Provenance], jobs: Sequence[Job]) -> str:
    """How a stored session differs from the one that would be made, as the end of a sentence; empty: none."""
    for job in jobs:
        if job.name not in present:
            continue
        was = present[job.name]
        old, new = _settings(was), _settings(job.made_from(was.digest))
        for key in (*new, *(old.keys() - new.keys())):
            if old.get(key) != new.get(key):
                return f", {job.name!r} made with {key} = {old.get(key)!r}, not {new.get(key)!r}"
        # Of several inputs each job compares its own content.
        if was.source != job.path.name or (len(jobs) == 1 and _changed(was, job)):
            return f", {job.name!r} made from a file {was.source!r} with other content"
    return ""


def _settings(origin: Provenance) -> dict[str, Any]:
    """What a session is made with: label, part of the recording, settings, versions of the libraries."""
    found: dict[str, Any] = {"start": origin.start_s, "duration": origin.duration_s}
    found |= {"building": origin.label.building, "floor": origin.label.floor}
    found |= {f"{section}.{key}": value for section, part in origin.config for key, value in part}
    return found | dict(origin.versions)


def _changed(was: Provenance, job: Job) -> bool:
    """Whether the input has other content than that of the stored session."""
    try:
        return digest_of(job.path, job.config) != was.digest
    except Pc2GridError:
        return False  # the input cannot be read; with --force its error is shown
