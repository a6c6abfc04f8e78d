"""Do the signatures find the place? Real logs, beside a shortlist drawn at random.

    python -m pc2grid_lab.fit.retrieval DATA FOLDER [--logs csail,...] [--floors 24]

The map of a building is that of the first part of its log at true poses, the queries are later parts after
1, 3 and 8 m. The other places are of office floors. FOLDER holds `without_NAME.npz` and
`without_NAME.places.npz` for each log: statistics that `signatures` has learned without this building.
For each selector, printed is the share of queries of which a right place is selected among 0.64 % and 5 % (at
least 50) of the places.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from pc2grid.arrays import I64
from pc2grid.geometry import SE2
from pc2grid_lab.experiments.answers import index_of
from pc2grid_lab.experiments.trial import JUDGEMENT
from pc2grid_lab.fit.queries import MAPPED_S, TRAVELS_M, Drawn, office_floor, queries_of, read
from signature.config import Config
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap
from signature.retrieval.place_index import PlaceIndex
from signature.retrieval.place_signatures import PlaceSignatures
from signature.retrieval.viewpoints import shortlist_size
from signature.seen_likelihood import COMBINATIONS, SeenStatistics, SeenWeights
from signature.similarity import SignatureTable

_FIRST_FLOOR = 1000
_ALL = "+".join(COMBINATIONS[-1])
RANDOM, SHUFFLED = "random", "shuffled"
NO_LOOK, ANY_LOOK = "no first look", "first look at random"
"""All viewpoints are compared; those of places drawn at random are."""
_NAMES = tuple("+".join(names) for names in COMBINATIONS)
_FEW = 0.0064
"""102 of 16,000 places, as in earlier measurements."""


Row = tuple[str, float, int, bool, float]
"""Selector, metres of travel, which size of shortlist, whether a right place is in it, and time in ms."""


@dataclass(frozen=True, slots=True)
class Building:
    """A log's map as the first session, floors of other buildings, and what places are compared by."""

    name: str
    index: MapIndex
    indexes: dict[str, PlaceIndex]
    first_looks: dict[str, PlaceSignatures]

    @staticmethod
    def of(name: str, maps: Sequence[MapIndex], learned: Path, config: Config) -> Building:
        """maps : that of the log, then the floors. learned : the statistics of the viewpoints."""
        statistics = SeenStatistics.load(learned)
        of_places = SeenStatistics.load(learned.with_suffix(".places.npz"))
        tables = [
            replace(one.places.table, session_index=np.full(len(one.places.table), k, np.int32))
            for k, one in enumerate(maps)
        ]
        grids = {f"{name}.{k}": one.grids[0] for k, one in enumerate(maps)}
        table = SignatureTable.concatenated(tables)
        index = MapIndex(grids, table, config, config)
        blocks = list(index.places.blocks())
        indexes = {
            "+".join(names): PlaceIndex.of(
                blocks, SeenWeights.of(statistics, names), statistics.spread(names)
            )
            for names in COMBINATIONS
            if len(names) in (1, 3)
        }
        indexes |= dict.fromkeys((NO_LOOK, ANY_LOOK), indexes[_ALL])
        indexes[SHUFFLED] = indexes[_ALL].shuffled(np.random.default_rng(0))
        looks = {
            names: PlaceSignatures.of(table, of_places, names.split("+"))
            for names in indexes
            if names in _NAMES
        }
        return Building(
            name, index, indexes, {names: look for names, look in looks.items() if look is not None}
        )

    def rows(self, selector: str, query: QueryMap, most: int, rng: np.random.Generator) -> I64:
        """The places that are selected, likeliest first."""
        count = len(self.index.places.table)
        if selector == RANDOM:
            return rng.permutation(count)[:most]
        among = None
        if selector != NO_LOOK:
            among = self.first_looks.get(selector, self.first_looks[_ALL]).likely(query.views, most)
        if among is not None and selector in (SHUFFLED, ANY_LOOK):
            among = rng.permutation(among)
        poses = self.indexes[selector].poses(query.views, query.center_m, among)
        return self.index.places.next_to(poses, most)


def right_places(query: QueryMap, T_map_query: SE2, places: SignatureTable) -> I64:
    """The places that the robot truly stands next to; none if half of the views of the query lie at none."""
    views_m = T_map_query.apply(np.array([view.center_m for view in query.views]).reshape(-1, 2))
    own = np.flatnonzero(places.session_index == 0)
    known = (cdist(views_m, places.center_m[own]) <= JUDGEMENT.retrieved_m).any(axis=1)
    base_m = T_map_query.apply(np.array([query.center_m]))
    near = cdist(base_m, places.center_m[own])[0] <= JUDGEMENT.retrieved_m
    return own[near] if known.mean() >= 0.5 else own[:0]


def asked_of(
    drawn: Drawn, places: SignatureTable, config: Config
) -> Iterator[tuple[float, QueryMap, SE2, I64]]:
    """The queries on the map: metres of travel, what was seen, its true frame, and the right places."""
    for session in drawn[1]:
        for travel_m, query, T_map_query in queries_of(session, config):
            right = right_places(query, T_map_query, places) if query.views else np.empty(0, np.int64)
            if len(right):
                yield travel_m, query, T_map_query, right


def recalls(building: Building, drawn: Drawn, config: Config) -> Iterator[Row]:
    """What each selector finds for each query."""
    places, rng = building.index.places.table, np.random.default_rng(0)
    sizes = (round(_FEW * len(places)), shortlist_size(len(places), config.relocalize))
    for travel_m, query, _, right in asked_of(drawn, places, config):
        for selector in (*building.indexes, RANDOM):
            begin = time.process_time()
            rows = building.rows(selector, query, max(sizes), rng)
            took_ms = 1000.0 * (time.process_time() - begin)
            for rank, size in enumerate(sizes):
                yield selector, travel_m, rank, bool(np.isin(rows[:size], right).any()), took_ms


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", default=",".join(MAPPED_S))
    parser.add_argument("--queries", type=int, default=24)
    parser.add_argument("--floors", type=int, default=24)
    options = parser.parse_args()
    config, kept = Config(), options.folder / "drives"
    kept.mkdir(parents=True, exist_ok=True)
    floors = [
        index_of(f"floor {number}", office_floor(_FIRST_FLOOR + number), config)
        for number in range(options.floors)
    ]
    found: list[Row] = []
    places = []
    for name in options.logs.split(","):
        drawn = read(options.data, name, options.queries, kept, config)
        own = index_of(name, drawn[0], config)
        building = Building.of(name, [own, *floors], options.folder / f"without_{name}.npz", config)
        places.append(len(building.index.places.table))
        found += recalls(building, drawn, config)
    _print_tables(found, places)


def _print_tables(found: Sequence[Row], places: Sequence[int]) -> None:
    """A table for each number of places that are selected."""
    for rank, what in enumerate(("0.64 %", "5 %, at least 50")):
        print(f"\n{what} of {min(places):,} to {max(places):,} places")
        for selector in dict.fromkeys(row[0] for row in found):
            rows = [r for r in found if (r[0], r[2]) == (selector, rank)]
            cells = []
            for travel_m in TRAVELS_M:
                hits = [r[3] for r in rows if r[1] == travel_m]
                cells.append(f"{np.mean(hits):.2f} of {len(hits)}")
            print(f"| {selector} | {' | '.join(cells)} | {np.median([r[4] for r in rows]):.0f} ms |")


if __name__ == "__main__":
    main()
