"""Compare your own descriptor of a submap with the paper's, on your own floor plan, as the paper does.

A descriptor is a `Method`, a function that takes the submaps of a map and returns a function that compares a
query with each of them. Queries are cut near a submap's centre and turned at random, with
obstacles that are not in the map. `pc2grid compare paper` runs the same experiment on the paper's maps. Both
need the package `pc2grid_lab`, which only a clone of the repository has: `pip install -e .` there.

python examples/own_descriptor.py map.yaml
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import typer

import pc2grid
from pc2grid.settings import PartitionConfig
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, Matcher, evaluate
from pc2grid_lab.paper.methods import make_methods


def wall_distances(submaps: Sequence[pc2grid.Submap]) -> Matcher:
    """Histogram of the distances of the walls from the centre; it does not depend on the rotation."""
    table = np.array([describe(submap) for submap in submaps])
    # (N,), larger is more similar.
    return lambda query: -np.abs(table - describe(query)).sum(axis=1)


def describe(submap: pc2grid.Submap) -> np.ndarray:
    """(B,) shares of the walls by distance, 0.25 m a bin."""
    grid = submap.grid
    middle = (np.array(grid.cells.shape) - 1) / 2
    distances = np.linalg.norm(np.argwhere(grid.occupied) - middle, axis=1) * grid.resolution_m
    counts, _ = np.histogram(distances, bins=np.arange(0.0, submap.radius_m + 0.25, 0.25))
    return counts / max(counts.sum(), 1)


def main(map_yaml: str, queries: int = 200) -> None:
    """Print the area under the precision-recall curve of three methods at the paper's noise levels."""
    grid = pc2grid.load_map(map_yaml)
    submaps = pc2grid.submaps_of(grid, PartitionConfig.paper())
    methods = {**make_methods(["proposed", "shape_context"]), "wall distances": wall_distances}
    experiment = Experiment(queries=queries)
    print(f"{len(submaps)} submaps, {queries} queries; area under the curve, share recognised")
    for level, noise in enumerate(NOISE_LEVELS):
        for name, matches in evaluate(methods, grid, submaps, experiment, noise).items():
            measures = matches.measures()
            print(f"noise {level}  {name:16} {measures.auc:.3f}  {measures.r_at_1:.2f}")


if __name__ == "__main__":
    typer.run(main)
