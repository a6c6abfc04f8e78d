"""`pc2grid db join`: which sessions show one building, and how they lie to each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pc2grid.display import probability
from pc2grid.errors import one_line
from pc2grid.geometry import SE2
from pc2grid_cli import console
from pc2grid_cli.session_documents import JoinedSession, OfDatabase, buildings, joined_document
from pc2grid_cli.tables import show, table
from signature.bend import largest_m
from signature.database import SubmapDatabase, maintenance
from signature.localization.answer_json import TypedDict
from signature.localization.joining.building import Joined
from signature.localization.joining.join import JoinStatus
from signature.localization.joining.pairing import SessionPair
from signature.localization.shown.picture import draw_building

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
