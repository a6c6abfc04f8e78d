"""pc2grid itself as one of the peers, in a process of its own.

python -m pc2grid_lab.peers.own_process pc2grid MAP_STEM

It gets the nav2 map and the registered planar scans, and asks as `pc2grid relocalize` does: again after every
metre, and at the end. Only `located` is an answer; the score is the confidence.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pc2grid.io.nav2_map import load_map
from pc2grid.submaps.partition import partition
from pc2grid_lab.experiments.answers import localize
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.peers.cloud_matchers import Found, answer_stream, serve
from signature.config import Config
from signature.describe import describe
from signature.localization.map_index import MapIndex
from signature.similarity import SignatureTable


def index_of(map_yaml: Path) -> MapIndex:
    """A database of one map."""
    config, grid = Config(), load_map(map_yaml)
    submaps = partition(grid, config.partition)
    table = SignatureTable.of([describe(s, config.signature) for s in submaps], [s.center_m for s in submaps])
    return MapIndex({map_yaml.parent.name: grid}, table, config, config)


def locate(index: MapIndex, query: str) -> Found:
    """The pose, if the query is located."""
    session = RegisteredSession.load(Path(f"{query}.npz"))
    scans = ((registered, planar_scan) for registered, planar_scan, _ in session.scans())
    (found,) = localize(scans, [index])
    (answer,) = found.answers
    if answer.T_map_base is None:
        return None
    return answer.T_map_base.lift(), answer.confidence


def main() -> None:
    """Load the map, then answer."""
    answers = answer_stream()
    index = index_of(Path(f"{sys.argv[2]}.yaml"))
    serve(lambda query: locate(index, query), answers, compiles=True)


if __name__ == "__main__":
    main()
