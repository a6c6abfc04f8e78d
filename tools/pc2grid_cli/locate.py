"""The database that a query of the command line is looked for in, and the query's path there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from pc2grid_cli import console
from signature.files import open_places

if TYPE_CHECKING:
    from pc2grid.model import Trajectory
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer


@contextlib.contextmanager
def searched(
    database: str, building: str | None, floor: str | None
) -> Iterator[tuple[SubmapDatabase, list[str]]]:
    """A database, or a map as one, to look in; only the sessions of a building and floor if they are given.

    Yields it, and what is damaged in it and left out, of which the user is warned.
    """
    with open_places(database, warn=console.warn) as opened:
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        left_out = [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]
        for damage in left_out:
            console.warn(f"{opened.location}: damaged and left out: {damage}")
        yield opened, left_out


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)
