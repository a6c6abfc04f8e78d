"""Learn the weights of the signatures from real logs besides simulated sessions.

Walls that are drawn from real scans vary more than simulated ones, and real buildings are less alike than
simulated floors. Of the statistics that `simulated` has learned, by all three sensors, a fifth of the
variation within one place is kept; the rest, the variation between places and the means are those of real
logs. Pairs are views of later parts of a log, and the same points of a map of its first part; other
places are those of the other logs' maps, of drawn maps, and of office floors.

    python -m pc2grid_lab.fit.signatures DATA SIMULATED.npz OUT.npz [--logs csail,...] [--maps aces,...]

The weights of the signatures of places, by which the first look is taken, are learned from the same logs, and
from the place of the map that is nearest to each view.

DATA is as of `queries`; with `maps/NAME.yaml`, maps of buildings without queries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer
from scipy.spatial import cKDTree
from signature.retrieval.place_signatures import table_rows, view_rows

from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.model import OccupancyGrid
from pc2grid_lab.experiments.answers import index_of
from pc2grid_lab.experiments.trial import JUDGEMENT
from pc2grid_lab.fit.queries import MAPPED_S, Drawn, office_floor, pairs_of, queries_of, read
from signature.boundary import boundary_bins
from signature.config import Config
from signature.freespace import freespace_bins
from signature.seen_likelihood import Pairs, SeenStatistics, fitted_spreads

_SIMULATED = 0.2
"""With half, a twentieth fewer queries of real lasers found their place; without any, as many as with this,
but only lasers would be known."""
_FIRST_FLOOR, _FLOORS = 30_010, 10
"""Office floors that are other places, besides the maps of other buildings."""


def pairs_of_logs(logs: dict[str, Drawn], floors: Sequence[OccupancyGrid], config: Config) -> Pairs:
    """Pairs of the logs; `floors` and the maps of the logs are the other places."""

    asked = (
        (query, T_map_query, [(grid, SE2())])
        for grid, driven in logs.values()
        for session in driven
        for query, T_map_query in queries_of(session, config)
    )
    return pairs_of(asked, [*floors, *(grid for grid, _ in logs.values())], config)


def place_pairs_of_logs(logs: dict[str, Drawn], floors: Sequence[OccupancyGrid], config: Config) -> Pairs:
    """Views of the logs, and the places of their maps that are nearest to each, if within
    `JudgementParameters.retrieved_m`."""
    queries, same = [], []
    maps = {name: index_of(name, grid, config).places.table for name, (grid, _) in logs.items()}
    for name, (_, driven) in logs.items():
        tree, rows = cKDTree(maps[name].center_m), table_rows(maps[name])
        for session in driven:
            for query, T_map_query in queries_of(session, config):
                if query.views:
                    views_m = T_map_query.apply(np.array([view.center_m for view in query.views]))
                    distance_m, nearest = tree.query(views_m)
                    near = distance_m <= JUDGEMENT.retrieved_m
                    queries.append(view_rows(query.views)[near])
                    same.append(rows[nearest[near]])
    tables = [*maps.values(), *(index_of("", grid, config).places.table for grid in floors)]
    other = np.concatenate([table_rows(table) for table in tables])
    return Pairs(np.concatenate(queries), np.concatenate(same), other)


def place_statistics_of(pairs: Pairs, config: Config) -> SeenStatistics:
    """The statistics of `place_pairs_of_logs`."""
    radius_m, signature = config.partition.radius_m, config.signature
    return SeenStatistics.of(
        pairs, (boundary_bins(radius_m, signature), freespace_bins(radius_m, signature), 2)
    )


def statistics_of(pairs: Pairs, simulated: SeenStatistics) -> SeenStatistics:
    """The statistics of real pairs, with a share of the variation within one place from simulated ones."""
    real = SeenStatistics.of(pairs)
    mixed = replace(real, within=(1.0 - _SIMULATED) * real.within + _SIMULATED * simulated.within)
    return replace(mixed, spreads=fitted_spreads(mixed, pairs))


def main(
    data: Path,
    simulated: Path,
    out: Path,
    logs: str = ",".join(MAPPED_S),
    maps: str = "aces,workshop_1",
    queries: int = 24,
) -> None:
    """Learn and store the statistics of viewpoints and of places, in one file."""
    config, kept = Config(), out.parent / "drives"
    kept.mkdir(parents=True, exist_ok=True)
    drawn = {name: read(data, name, queries, kept, config) for name in logs.split(",")}
    floors = [load_map(data / "maps" / f"{name}.yaml") for name in maps.split(",")]
    floors += [office_floor(_FIRST_FLOOR + number) for number in range(_FLOORS)]
    pairs = pairs_of_logs(drawn, floors, config)
    of_viewpoints = statistics_of(pairs, SeenStatistics.load(path=simulated))
    of_places = place_statistics_of(place_pairs_of_logs(drawn, floors, config), config)
    SeenStatistics.save(out, viewpoints=of_viewpoints, places=of_places)
    print(f"{out}: learned from {len(pairs.queries):,} pairs and {len(pairs.other):,} other places")


if __name__ == "__main__":
    typer.run(main)
