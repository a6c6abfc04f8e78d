"""All sessions of a database joined: pairs of sessions become buildings with one frame each.

Sessions are compared in pairs (`pairing`). The pairs that were joined make buildings, and say where the
sessions lie (`placing`). One pose graph over all that they have measured says how they are bent
(`straightening`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pc2grid.observer import Observer
from pc2grid.threads import one_blas_thread
from signature.database.protocol import BuildingFrame
from signature.database.rows import no_session
from signature.localization.joining.pairing import Names, SessionPair, compare_pairs
from signature.localization.joining.placing import anchor_of, buildings_of, place
from signature.localization.joining.straightening import bodies_of, straighten

if TYPE_CHECKING:
    import networkx as nx

    from signature.database import SubmapDatabase


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """What joining the sessions of a database found.

    pairs : all that were compared. frames : of the sessions that were joined with another one, by name.
    """

    pairs: tuple[SessionPair, ...]
    frames: Mapping[str, BuildingFrame]


@one_blas_thread
def join_sessions(
    database: SubmapDatabase,
    *,
    frame: str | None = None,
    only: Collection[str] | None = None,
    observer: Observer = Observer(),
) -> Joined:
    """Which sessions of a database show one building, and how they lie in its frame.

    frame : the session whose map frame is that of its building. None: the frame of those that were joined
    before, else of the session that was stored first. only : sessions that are joined, with the others and
    with each other; the others stay where they are. None: all are joined anew, which `frame` needs.
    observer : gets the progress.

    Every two sessions are compared, so the time grows with the square of their number.

    Raises DatabaseError for a name that no session has.
    """
    known = database.frames()
    infos = {info.name: info for info in database.sessions()}
    for name in {*(only or ()), *(() if frame is None else (frame,))} - infos.keys():
        raise no_session(name, infos, database.location)
    moving = infos.keys() if only is None else only
    stay = {name: at for name, at in known.items() if name in infos and name not in moving}
    pairs = list(compare_pairs(database, infos, moving, observer))
    joined = [pair for pair in pairs if pair.join.status == "joined"]
    frames = dict(stay)
    accepted: set[Names] = set()
    for tree in buildings_of(infos, joined, stay):
        anchor = anchor_of([name for name in infos if name in tree], frame, known, stay)
        placed, counted = _lying(database, tree, anchor, joined, stay)
        frames |= placed
        accepted |= counted
    return Joined(
        pairs=tuple(replace(pair, accepted=pair.names in accepted) for pair in pairs),
        frames={name: frames[name] for name in infos if name in frames},
    )


def _lying(
    database: SubmapDatabase,
    tree: nx.Graph,
    anchor: tuple[str, BuildingFrame],
    joined: Sequence[SessionPair],
    stay: Mapping[str, BuildingFrame],
) -> tuple[dict[str, BuildingFrame], set[Names]]:
    """How the sessions of one building lie and are bent, and the names of the pairs that count."""
    within = [pair for pair in joined if pair.target in tree and pair.source in tree]
    placed, counted = place(tree, anchor, within, stay)
    links = {pair.names: pair.join.links for pair in within if pair.names in counted}
    return straighten(bodies_of(database, placed, stay), placed, links, placed.keys() & stay), counted
