"""Queries of the command line: a recording or a map, and the answer to it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.io import open_log
from pc2grid.mapping.drawn_map import is_drawn_map, load_drawn_map
from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console
from pc2grid_cli.known_pose import KnownPose
from signature.files import about_log, about_map, locate_log, open_places, query_config
from signature.localization.answer import NO_POSES, Answer
from signature.localization.answering import locate_map
from signature.localization.map_index import MapIndex
from signature.localization.shown.report import Found

if TYPE_CHECKING:
    from pc2grid.model import RegisteredScan, Trajectory
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.localizer import Estimate


@contextlib.contextmanager
def searched(
    database: str, building: str | None, floor: str | None
) -> Iterator[tuple[SubmapDatabase, list[str]]]:
    """A database, or a map as one, to look in; only the sessions of a building and floor if they are given.

    Yields it, and what is damaged in it and left out, of which the user is warned.
    """
    with open_places(database) as opened:
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        left_out = [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]
        for damage in left_out:
            console.warn(f"{opened.location}: damaged and left out: {damage}")
        yield opened, left_out


def find(
    path: Path,
    database: SubmapDatabase,
    config: Config,
    *,
    span: TimeSpan = TimeSpan(),
    recover: bool = False,
    observer: Observer = Observer(),
    see: Callable[[RegisteredScan, Estimate | None], None] = lambda registered, estimate: None,
    known: KnownPose = KnownPose(),
    index: MapIndex | None = None,
) -> Found:
    """Locate a map, or a recording, or the part of it that `span` names.

    see : see `signature.files.locate_log`. index : of the database, if it is prepared.
    """
    if is_drawn_map(path):
        return find_map(path, database, config, index)
    config = query_config(database, config)
    with open_log(path, config.read, recover=recover) as log:
        prior = known.prior(log, span)
        index = index or MapIndex.of(database, config, observer)
        index = index if prior is None else index.within(prior)
        answer, poses = locate_log(log, index, config, span=span, see=see, observer=observer)
        about = about_log(path, log, answer, span, poses.health)
        return Found(answer=answer, poses=poses, about=about, report=log.report())


def find_map(path: Path, database: SubmapDatabase, config: Config, index: MapIndex | None = None) -> Found:
    """Locate a map: of nav2, or a cloud or mesh. index : of the database, if it is prepared."""

    made_with = database.config().model_copy(update={"read": config.read})
    drawn = load_drawn_map(path, made_with)
    answer = locate_map(drawn.grid, index or MapIndex.of(database, config))
    about = about_map(path, drawn, answer)
    return Found(answer=answer, poses=NO_POSES, about=about, drawn=drawn.grid)


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)
