"""`pc2grid db`: look into databases, check, change, merge, split and copy them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pc2grid.display import counted
from pc2grid.errors import DatabaseError, one_line
from pc2grid_cli import console
from pc2grid_cli.options import DATABASE, AsJson, Database, Force, WrittenDatabase
from pc2grid_cli.session_documents import (
    JoinedSession,
    OfDatabase,
    StoredInfo,
    buildings,
    joined_document,
    stored_document,
)
from signature.database import Problem, SessionInfo, open_database
from signature.database.maintenance import check, copy, merge, remove, rename, shown, split
from signature.localization.answer_json import plain

_Sessions = Annotated[list[str], typer.Argument(metavar="SESSION...", help="which of its sessions")]


class DbInfo(OfDatabase):
    """`pc2grid db info --json`. joined: where those of the sessions lie that are joined in a building."""

    sessions: list[StoredInfo]
    joined: list[JoinedSession]


class DbCheck(OfDatabase):
    """`pc2grid db check --json`; no problems: sound."""

    problems: list[Problem]


class DbWrite(OfDatabase):
    """`pc2grid db merge`, `copy`, `split`, `rename` and `remove` with `--json`. sessions: how many are in
    the database now; left_out: damage that was not copied."""

    sessions: int
    left_out: list[Problem]


def db_info_command(database: Database, json: AsJson = False) -> None:
    """Show the sessions of a database.

    Example: pc2grid db info building.submaps
    """
    with open_database(database) as opened:
        sessions, frames, where = opened.sessions(), opened.frames(), opened.location
    about: DbInfo = {
        "database": where,
        "sessions": [stored_document(session) for session in sessions],
        "joined": [joined_document(name, frame) for name, frame in frames.items()],
    }
    submaps = counted(sum(session.submaps for session in sessions), "submap")
    lines = [f"{where}: {counted(len(sessions), 'session')}, {submaps}", *map(_line, sessions)]
    lines += [f"  joined, in the frame of {name}: {', '.join(of)}" for name, of in buildings(frames).items()]
    console.print_result(plain(DbInfo, about) if json else "\n".join(map(one_line, lines)))


def _line(s: SessionInfo) -> str:
    """What a person is told of a session."""
    travel = f", {counted(s.scans, 'scan')}, {s.path_m:.1f} m in {s.duration_s:.0f} s" if s.scans else ""
    label = s.provenance.label
    where = f", {label}" if label.building or label.floor else ""
    line = f"  {s.name} ({s.sensor}{where}): {counted(s.submaps, 'submap')}, {s.area_m2:.0f} m2 free{travel}"
    if s.points:
        line += f", {s.points / 1e6:.2f} million points in space"
    if s.consistency is not None and s.consistency.bent:
        line += f", bent: contradicts itself along {s.consistency.contradicted:.0%} of the travel"
    if s.precision is not None and s.precision.loose:
        line += f", loosely tied: places up to +- {s.precision.worst_m:.1f} m"
    return line


def db_check_command(database: Database, json: AsJson = False) -> None:
    """Read everything in a database and list all damage; exit code 1 if there is any.

    Example: pc2grid db check building.submaps
    """
    problems = check(database)
    about: DbCheck = {"database": shown(database), "problems": list(problems)}
    damage = [one_line(f"{problem.where}: {problem.what}") for problem in problems]
    text = "\n".join(damage) or f"{shown(database)}: sound"
    console.print_result(plain(DbCheck, about) if json else text)
    if problems:
        raise typer.Exit(console.FAILED)


def db_merge_command(
    databases: Annotated[list[str], typer.Argument(metavar=f"{DATABASE} ...", help="what to merge")],
    output: WrittenDatabase,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Put the sessions of several databases into a new one.

    Example: pc2grid db merge monday.submaps tuesday.submaps -o week.submaps
    """
    count = merge(databases, output, overwrite=force)
    _tell(output, f"{shown(output)}: {counted(count, 'session')}", json)


def db_copy_command(
    database: Database,
    output: WrittenDatabase,
    recover: Annotated[bool, typer.Option("--recover", help="leave damaged parts out; exit code 3")] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a compact copy of a database.

    Example: pc2grid db copy --recover damaged.submaps -o good.submaps
    """
    problems = copy(database, output, recover=recover, overwrite=force)
    for problem in problems:
        console.warn(f"left out: {problem.where}: {problem.what}")
    _tell(output, f"{shown(output)}: {_size(output)}", json, problems)
    if problems:
        raise typer.Exit(console.LOSSY)


def _size(output: str) -> str:
    """The size of a copy: of a file in bytes, of anything else in sessions."""
    path = Path(output)
    return f"{path.stat().st_size / 1e6:.1f} MB" if path.is_file() else _sessions(output)


def _sessions(database: str) -> str:
    with open_database(database) as opened:
        return counted(len(opened.sessions()), "session")


def db_split_command(
    database: Database,
    sessions: _Sessions,
    output: WrittenDatabase,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Copy sessions of a database into a new one; the first stays as it is.

    Example: pc2grid db split building.submaps monday -o monday.submaps
    """
    count = split(database, sessions, output, overwrite=force)
    _tell(output, f"{shown(output)}: {counted(count, 'session')}", json)


def db_rename_command(
    database: Database,
    old: Annotated[str, typer.Argument(metavar="OLD", help="the session")],
    new: Annotated[str, typer.Argument(metavar="NEW", help="its new name")],
    json: AsJson = False,
) -> None:
    """Give a session another name, for example before databases with equal names are merged.

    Example: pc2grid db rename building.submaps monday first-floor
    """
    rename(database, old, new)
    _tell(database, one_line(f"{shown(database)}: {old} is now {new}"), json)


def db_remove_command(
    database: Database,
    sessions: _Sessions,
    force: Annotated[bool, typer.Option("--force", help="also if no session is left")] = False,
    json: AsJson = False,
) -> None:
    """Remove sessions from a database, all or none; they cannot be brought back.

    Example: pc2grid db remove building.submaps monday
    """
    if not force:
        _refuse_all(database, sessions)
    remove(database, sessions)
    _tell(database, f"{shown(database)}: {_sessions(database)} left", json)


def _refuse_all(database: str, sessions: list[str]) -> None:
    """Raises DatabaseError if no session of the database would be left."""
    with open_database(database) as opened:
        known = {info.name for info in opened.sessions()}
        if known and known <= set(sessions):
            raise DatabaseError(
                f"{opened.location}: no session would be left, and they cannot be brought back",
                hint="--force removes them all the same; `pc2grid db copy` keeps a copy",
            )


def _tell(output: str, text: str, json: bool, left_out: Sequence[Problem] = ()) -> None:
    """Print a text or the document about a database that was written."""
    with open_database(output) as opened:
        number, where = len(opened.sessions()), opened.location
    about: DbWrite = {"database": where, "sessions": number, "left_out": list(left_out)}
    console.print_result(plain(DbWrite, about) if json else text)
