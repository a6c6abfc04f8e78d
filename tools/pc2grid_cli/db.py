"""`pc2grid db`: look into databases, check, change, merge, split and copy them.

`pc2grid db join`: which sessions show one building, and how they lie to each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import typer

from pc2grid.display import counted, probability
from pc2grid.errors import DatabaseError, one_line
from pc2grid.geometry import SE2
from pc2grid_cli import console
from pc2grid_cli.documents import (
    JoinedSession,
    OfDatabase,
    StoredInfo,
    buildings,
    joined_document,
    stored_document,
)
from pc2grid_cli.output import show, table
from signature.database import Problem, SessionInfo, SubmapDatabase, maintenance, open_database
from signature.database.maintenance import check, shown
from signature.database.protocol import largest_m
from signature.localization.answer_json import TypedDict, plain
from signature.localization.joining.building import Joined
from signature.localization.joining.join import JoinStatus, SessionPair
from signature.localization.shown.picture import draw_building


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


_SAID = {"joined": "joined", "ambiguous": "ambiguous", "different": "not the same building"}


class ComparedSessions(TypedDict):
    """Two sessions that were compared. status: joined, ambiguous, or different: nothing says that they show
    one building. accepted: the join counts; other pairs and labels do not contradict it. T_target_source:
    null if the status is `different`; covariance: (3, 3) of its x, y, yaw. probability: that it is right.
    agreement: of the walls where both know the ground, 0..1. common_m2: free ground that both know."""

    target: str
    source: str
    status: JoinStatus
    accepted: bool
    T_target_source: SE2 | None
    covariance: list[list[float]] | None
    probability: float
    agreement: float
    common_m2: float


class DbJoin(OfDatabase):
    """`pc2grid db join --json`. stored: false with --dry-run. sessions: those that were joined. alone: the
    names of the others."""

    stored: bool
    pairs: list[ComparedSessions]
    sessions: list[JoinedSession]
    alone: list[str]


def store(database: str, found: Joined, names: list[str]) -> None:
    """Store where the sessions lie; those of `names` that lie in no building are no longer in one."""
    maintenance.place(database, {name: found.frames.get(name) for name in names})


def report(found: Joined, names: list[str], *, dry_run: bool = False) -> None:
    """Print the pairs, and the buildings that they make."""
    pairs = table(
        "sessions compared",
        ("target", "source", ""),
        ("x, m", "y, m", "turn, deg", "sigma, m", "in common, m2", "agreement", "probability"),
    )
    for pair in found.pairs:
        pairs.add_row(*map(one_line, _row(pair)))
    show(pairs)
    for name, sessions in buildings(found.frames).items():
        show(f"in the frame of {one_line(name)}:")
        for session, at in sessions.items():
            T = at.T_building_session
            where = f"x {T.x:.2f} m, y {T.y:.2f} m, turned by {math.degrees(T.yaw):.1f} deg"
            bent = f", bent by {largest_m(at.bend):.2f} m at most" if at.bend else ""
            show(one_line(f"  {session}: {where}, sigma {_sigma_m(at.covariance):.2f} m{bent}"))
    alone = [name for name in names if name not in found.frames]
    if alone:
        show(one_line(f"alone: {', '.join(alone)}"))
    if dry_run:
        show("nothing was stored")
    elif found.frames:
        show("from now on answers in these are in the frame of the building; --frame session: as before")


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
    """The larger standard deviation of x and y."""
    return math.sqrt(max(covariance[0][0], covariance[1][1]))


def draw(path: Path, database: SubmapDatabase, found: Joined) -> None:
    """A picture of the building with most sessions; none if nothing is joined."""
    known = buildings(found.frames)
    if not known:
        console.warn(f"{path}: not written, no two sessions are joined")
        return
    name = max(known, key=lambda name: len(known[name]))
    draw_building(path, name, {s: (database.grid(s), at) for s, at in known[name].items()})


def document(where: str, found: Joined, names: list[str], dry_run: bool) -> DbJoin:
    """Return the document of the pairs and of the sessions that are joined."""
    return {
        "database": where,
        "stored": not dry_run,
        "pairs": [_compared(pair) for pair in found.pairs],
        "sessions": [joined_document(session, at) for session, at in found.frames.items()],
        "alone": [name for name in names if name not in found.frames],
    }


def _compared(pair: SessionPair) -> ComparedSessions:
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
