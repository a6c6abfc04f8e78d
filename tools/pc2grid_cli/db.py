"""`pc2grid db`: look into databases, check, change, merge, split and copy them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from pc2grid.display import counted
from pc2grid.errors import DatabaseError, one_line
from pc2grid_cli import console
from pc2grid_cli.session_documents import (
    JoinedSession,
    OfDatabase,
    StoredInfo,
    buildings,
    joined_document,
    stored_document,
)
from signature.database import Problem, SessionInfo, open_database
from signature.database.maintenance import check, shown
from signature.localization.answer_json import plain


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


def tell_sessions(database: str, *, json: bool) -> None:
    """Print the sessions of a database."""
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


def tell_damage(database: str, *, json: bool) -> None:
    """Print all damage of a database. Raises typer.Exit if there is any."""
    problems = check(database)
    about: DbCheck = {"database": shown(database), "problems": list(problems)}
    damage = [one_line(f"{problem.where}: {problem.what}") for problem in problems]
    text = "\n".join(damage) or f"{shown(database)}: sound"
    console.print_result(plain(DbCheck, about) if json else text)
    if problems:
        raise typer.Exit(console.FAILED)


def size(output: str) -> str:
    """The size of a copy: of a file in bytes, of anything else in sessions."""
    path = Path(output)
    return f"{path.stat().st_size / 1e6:.1f} MB" if path.is_file() else sessions_in(output)


def sessions_in(database: str) -> str:
    """Return how many sessions are in a database, with the noun."""
    with open_database(database) as opened:
        return counted(len(opened.sessions()), "session")


def refuse_all(database: str, sessions: list[str]) -> None:
    """Raises DatabaseError if no session of the database would be left."""
    with open_database(database) as opened:
        known = {info.name for info in opened.sessions()}
        if known and known <= set(sessions):
            raise DatabaseError(
                f"{opened.location}: no session would be left, and they cannot be brought back",
                hint="--force removes them all the same; `pc2grid db copy` keeps a copy",
            )


def tell(output: str, text: str, json: bool, left_out: Sequence[Problem] = ()) -> None:
    """Print a text or the document about a database that was written."""
    with open_database(output) as opened:
        number, where = len(opened.sessions()), opened.location
    about: DbWrite = {"database": where, "sessions": number, "left_out": list(left_out)}
    console.print_result(plain(DbWrite, about) if json else text)
