"""What an answer rests on, to be drawn: each hypothesis compared with its map, wall point by wall point."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pc2grid.matching.agreement import agreement
from pc2grid.matching.walls import Walls

if TYPE_CHECKING:
    from pc2grid.matching.agreement import Agreement
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer


def agreements(answer: Answer, database: SubmapDatabase) -> tuple[Agreement, ...]:
    """For each hypothesis of an answer, best first, what supports and what contradicts it."""
    query = Walls.of(answer.local_map)
    indices = {hypothesis.session_index for hypothesis in answer.hypotheses}
    maps = {index: Walls.of(database.grid(answer.sessions[index])) for index in indices}
    return tuple(
        agreement(maps[hypothesis.session_index], query, hypothesis.fit.T_map_query)
        for hypothesis in answer.hypotheses
    )
