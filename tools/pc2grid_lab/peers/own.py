"""pc2grid itself as one of the programs.

It gets the nav2 map and the registered planar scans, and asks as `pc2grid relocalize` does: again after every
metre, and at the end. Only `located` is an answer; the score is the confidence.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pc2grid.io.maps import load_map
from pc2grid_lab.experiments.answers import index_of, localize
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.peers.serving import Found, serve
from signature.config import Config


def locator(_: str, map_stem: str) -> Callable[[str], Found]:
    """Locates in one map."""
    index = index_of("map", load_map(Path(f"{map_stem}.yaml")), Config())

    def locate(query: str) -> Found:
        session = RegisteredSession.load(Path(f"{query}.pickle"))
        (found,) = localize(session.scans(), [index])
        (answer,) = found.answers
        return None if answer.T_map_base is None else (answer.T_map_base.lift(), answer.confidence)

    return locate


if __name__ == "__main__":
    serve(locator, compiles=True)
