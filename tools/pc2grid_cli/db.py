"""`pc2grid db`: the sessions of a database: shown, checked, copied, renamed, removed, joined.

What is said of a database is the same for all commands that write one: how many sessions it holds now, and
what damage was left out of a copy. `db join` draws and lists the pairs of sessions that were compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.display import counted, plain, probability
from pc2grid.errors import ConfigError, DatabaseError, one_line
from pc2grid_cli import console, options, output
from pc2grid_cli.output import Document, joined_document, stored_document
from signature.database import Problem, SessionInfo, SubmapDatabase, maintenance, open_database
from signature.database.maintenance import shown
from signature.database.protocol import by_building, largest_m

if TYPE_CHECKING:
    from signature.join.building import Joined
    from signature.join.join import SessionPair


def info(given: options.DbInfo, terminal: console.Console) -> None:
    """Print the sessions of a database."""
    with open_database(given.database) as opened:
        sessions, frames, where = opened.sessions(), opened.frames(), opened.location
    about = {
        "database": where,
        "sessions": [stored_document(session) for session in sessions],
        "joined": [joined_document(name, frame) for name, frame in frames.items()],
    }
    submaps = counted(sum(session.submaps for session in sessions), "submap")
    lines = [f"{where}: {counted(len(sessions), 'session')}, {submaps}", *map(_line, sessions)]
    lines += [
        f"  joined, in the frame of {name}: {', '.join(of)}" for name, of in by_building(frames).items()
    ]
    console.print_result(plain(about) if given.json else "\n".join(map(one_line, lines)))


def _line(s: SessionInfo) -> str:
    """Return a session in one line."""
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


def check(given: options.DbCheck, terminal: console.Console) -> int | None:
    """Print all damage of a database. Return the exit code."""
    problems, where = maintenance.check(given.database), shown(given.database)
    about = {"database": where, "problems": list(problems)}
    damage = [one_line(f"{problem.where}: {problem.what}") for problem in problems]
    console.print_result(plain(about) if given.json else "\n".join(damage) or f"{where}: sound")
    return console.FAILED if problems else None


def merge(given: options.DbMerge, terminal: console.Console) -> None:
    """Store the sessions of several databases in a new one."""
    maintenance.merge(given.databases, given.output, overwrite=given.force)
    _print(given.output, given.json)


def copy(given: options.DbCopy, terminal: console.Console) -> int | None:
    """Store a compact copy of a database. Return the exit code."""
    made, path = given.output, Path(given.output)
    problems = maintenance.copy(given.database, made, recover=given.recover, overwrite=given.force)
    for problem in problems:
        console.warn(f"left out: {problem.where}: {problem.what}")
    size = f"{path.stat().st_size / 1e6:.1f} MB" if path.is_file() else None
    _print(made, given.json, size, left_out=problems)
    return console.LOSSY if problems else None


def split(given: options.DbSplit, terminal: console.Console) -> None:
    """Copy sessions of a database into a new one."""
    maintenance.split(given.database, given.sessions, given.output, overwrite=given.force)
    _print(given.output, given.json)


def rename(given: options.DbRename, terminal: console.Console) -> None:
    """Give a session another name."""
    maintenance.rename(given.database, given.old, given.new)
    _print(given.database, given.json, f"{given.old} is now {given.new}")


def remove(given: options.DbRemove, terminal: console.Console) -> None:
    """Remove sessions; without --force, not all. Raises DatabaseError."""
    with open_database(given.database) as opened:
        known = {info.name for info in opened.sessions()}
        if not given.force and known and known <= set(given.sessions):
            raise DatabaseError(
                f"{opened.location}: no session would be left, and they cannot be brought back",
                hint="--force removes them all the same; `pc2grid db copy` keeps a copy",
            )
    maintenance.remove(given.database, given.sessions)
    _print(given.database, given.json, behind=" left")


def _print(
    database: str, json: bool, said: str | None = None, *, behind: str = "", left_out: Sequence[Problem] = ()
) -> None:
    """Print what a database is now that it was written, or the document about it.

    said : None: how many sessions it holds. behind : ends the text.
    """
    with open_database(database) as opened:
        number, where = len(opened.sessions()), opened.location
    text = one_line(f"{shown(database)}: {said or counted(number, 'session')}{behind}")
    about = {"database": where, "sessions": number, "left_out": list(left_out)}
    console.print_result(plain(about) if json else text)


_SAID = {"joined": "joined", "ambiguous": "ambiguous", "different": "not the same building"}


def join(given: options.DbJoin, terminal: console.Console) -> None:
    """Compare every two sessions, store how they lie to each other, and print it."""
    from signature.join.building import join_sessions

    if given.plot is not None:
        output.check_file("plot", given.plot, given.force)
    with open_database(given.database) as opened:
        names = [info.name for info in opened.sessions()]
        if len(names) < 2:
            raise ConfigError(
                f"{opened.location}: holds {counted(len(names), 'session')}, and two can be joined",
                hint="`pc2grid convert LOG --add` adds one, `pc2grid db merge` puts databases together",
            )
        found = join_sessions(opened, frame=given.frame, observer=terminal)
        if given.plot is not None:
            _draw(given.plot, opened, found)
    if not given.dry_run:  # those that lie in no building are no longer in one
        maintenance.store_frames(given.database, {name: found.frames.get(name) for name in names})
    alone = [name for name in names if name not in found.frames]
    about = {
        "database": shown(given.database),
        "stored": not given.dry_run,
        "pairs": [_compared(pair) for pair in found.pairs],
        "sessions": [joined_document(session, at) for session, at in found.frames.items()],
        "alone": alone,
    }
    if given.json:
        console.print_result(plain(about))
    else:
        _report(found, alone, stored=not given.dry_run)


def _report(found: Joined, alone: Sequence[str], *, stored: bool) -> None:
    """Print the pairs, and the buildings that they make."""
    pairs = output.table(
        "sessions compared",
        ("target", "source", ""),
        ("x, m", "y, m", "turn, deg", "sigma, m", "in common, m2", "agreement", "probability"),
    )
    for pair in found.pairs:
        pairs.add_row(*map(one_line, _row(pair)))
    lines = []
    for name, sessions in by_building(found.frames).items():
        lines.append(f"in the frame of {name}:")
        for session, at in sessions.items():
            T = at.T_building_session
            where = f"x {T.x:.2f} m, y {T.y:.2f} m, turned by {math.degrees(T.yaw):.1f} deg"
            bent = f", bent by {largest_m(at.bend):.2f} m at most" if at.bend else ""
            lines.append(f"  {session}: {where}, sigma {_sigma_m(at.covariance):.2f} m{bent}")
    if alone:
        lines.append(f"alone: {', '.join(alone)}")
    if not stored:
        lines.append("nothing was stored")
    elif found.frames:
        said = "from now on answers in these are in the frame of the building; --frame session: as before"
        lines.append(said)
    output.show(pairs, *map(one_line, lines))


def _row(pair: SessionPair) -> tuple[str, ...]:
    join, T = pair.join, pair.join.T_target_source
    said = _SAID[join.status]
    if join.status == "joined" and not pair.accepted:
        said = "contradicts the others"
    where = ("", "", "", "")
    if join.status != "different":
        turn_deg, sigma_m = math.degrees(T.yaw), _sigma_m(join.covariance.tolist())
        where = (f"{T.x:.2f}", f"{T.y:.2f}", f"{turn_deg:.1f}", f"{sigma_m:.2f}")
    measured = (f"{join.common_m2:.0f}", f"{join.agreement:.2f}", probability(join.probability))
    return (pair.target, pair.source, said, *where, *measured)


def _sigma_m(covariance: Sequence[Sequence[float]]) -> float:
    """Return the larger standard deviation of x and y."""
    return math.sqrt(max(covariance[0][0], covariance[1][1]))


def _draw(path: Path, database: SubmapDatabase, found: Joined) -> None:
    """Draw the building with most sessions; nothing if none is joined."""
    from signature.shown.picture import draw_building

    known = by_building(found.frames)
    if not known:
        console.warn(f"{path}: not written, no two sessions are joined")
        return
    name = max(known, key=lambda name: len(known[name]))
    draw_building(path, name, {s: (database.grid(s), at) for s, at in known[name].items()})


def _compared(pair: SessionPair) -> Document:
    """Return the description of two sessions that were compared."""
    join = pair.join
    known = join.status != "different"
    return {
        "target": pair.target,
        "source": pair.source,
        "status": join.status,
        "accepted": pair.accepted,
        "T_target_source": join.T_target_source if known else None,
        "covariance": join.covariance.tolist() if known else None,
        "probability": join.probability,
        "agreement": join.agreement,
        "common_m2": join.common_m2,
    }
