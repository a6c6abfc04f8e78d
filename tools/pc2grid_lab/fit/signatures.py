"""Learn the weights of the signatures from real recordings.

    python -m pc2grid_lab.fit.signatures DATA WORK OUT.npz [--without BUILDING]

Pairs of views and of the same points of a map are of two kinds: later parts of a log in the map of its
first part, drawn at true poses (`queries`), and the windows of `compare recordings` in the map of another
day, whose places WORK knows. Other places are those of these maps, of drawn maps, and of office floors.
DATA is as of `queries`; with `maps/NAME.yaml`, maps of buildings without queries. WORK is as of
`recorded_queries`.

--without leaves a building out, so that what has been learned can be judged there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from pc2grid.geometry import SE2
from pc2grid.io.maps import load_map
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.fit.queries import (
    MAPPED_S,
    Asked,
    Drawn,
    Window,
    index_of,
    office_floor,
    pairs_of,
    queries_of,
    read,
    windows,
)
from signature.config import Config
from signature.weights import SeenStatistics

_FIRST_FLOOR, _FLOORS = 30_010, 10
"""Office floors that are other places, besides the maps of other buildings."""


def in_logs(logs: Mapping[str, Drawn], config: Config) -> Iterator[Asked]:
    """The later parts of logs in the maps of their first parts."""
    for grid, driven in logs.values():
        for session in driven:
            for query, T_map_query in queries_of(session, config):
                yield query, T_map_query, [(grid, SE2())]


def in_maps(known: Sequence[Window], folder: Folder) -> Iterator[Asked]:
    """Windows of recordings, each in the session of its map that shows its place."""
    for window in known:
        index = index_of(folder.map(window.pair.map_name))
        session, T_map_base = next(iter(window.truth.items()))
        grid = index.grids[index.sessions.index(session)]
        yield window.whole, T_map_base @ window.whole.T_odom_base.inverse(), [(grid, SE2())]


def main(
    data: Path,
    work: Path,
    out: Path,
    without: Annotated[str, typer.Option(help="building that is left out")] = "",
    logs: str = ",".join(MAPPED_S),
    maps: str = "aces,workshop_1",
    queries: int = 24,
) -> None:
    """Learn and store the statistics."""
    config, kept = Config(), out.parent / "drives"
    kept.mkdir(parents=True, exist_ok=True)
    catalogue, folder = Catalogue.of(), Folder(data.resolve(), work.resolve())
    building = {name: recording.building for name, recording in catalogue.recordings.items()}
    drawn = {name: read(data, name, queries, kept, config) for name in logs.split(",") if name != without}
    known = [w for w in windows(catalogue, folder) if w.covered and building[w.pair.map] != without]
    names = [name for name in maps.split(",") if building[f"{name}.yaml"] != without]
    floors = [load_map(data / "maps" / f"{name}.yaml") for name in names]
    floors += [office_floor(_FIRST_FLOOR + number) for number in range(_FLOORS)]
    floors += [grid for grid, _ in drawn.values()]
    floors += [index_of(folder.map(name)).grids[0] for name in sorted({w.pair.map_name for w in known})]
    pairs = pairs_of(chain(in_logs(drawn, config), in_maps(known, folder)), floors, config)
    SeenStatistics.of(pairs).save(out)
    print(f"{out}: learned from {len(pairs.queries):,} pairs and {len(pairs.other):,} other places")


if __name__ == "__main__":
    typer.run(main)
