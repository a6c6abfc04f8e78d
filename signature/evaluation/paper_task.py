"""The cells of the paper's tables as tasks: each runs independently and stores its results in files of its
own.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pc2grid._version import __version__
from pc2grid.config import PartitionConfig
from pc2grid.io.atomic import replace_file
from pc2grid.io.nav2_map import load_map
from pc2grid.model import UNKNOWN, OccupancyGrid
from pc2grid.submaps.partition import partition
from signature.baselines import METHOD_NAMES, Method, make_methods
from signature.config import SignatureConfig
from signature.evaluation.noise import NOISE_LEVELS
from signature.evaluation.paper_experiment import BestMatches, Experiment, evaluate
from signature.evaluation.paper_tables import MAPS, SIZE_PX

Reading = Literal["paper", "true"]

RADII_M = (6.0, 8.0, 10.0)
"""Table IV."""

TOGETHER = (
    ("proposed",),
    ("sdf",),
    ("sift_bow", "sift_tfidf"),
    ("surf_bow", "surf_tfidf"),
    ("shape_context",),
    ("shape_rings",),
    ("point_contexts",),
    ("verified",),
)
"""Methods that share their features and therefore run together."""

OPEN_CHOICES: tuple[tuple[str, Any], ...] = (
    ("histogram_distance", "bhattacharyya"),
    ("boundary_spacing_m", 0.05),
    ("boundary_spacing_m", 0.2),
    ("freespace_spacing_m", 0.4),
    ("freespace_spacing_m", 1.0),
    ("freespace_cell_m", 0.05),
    ("freespace_clearance_m", 0.3),
    ("freespace_join_m", 1.5),
    ("thinning", "zhang_suen"),
    ("symmetry_peak", 255.0),
    ("symmetry_sigma", 1e6),
    ("weight_boundary", 0.7),
    ("weight_boundary", 1.0),
)
"""Other values of the parameters that the paper leaves open (and of two that it gives), to measure their
effect.
"""

_FORMAT = 1  # of the result files; a change of the meaning of their numbers changes it too


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTask:
    """Methods on one map at one noise level; one result file for each method.

    reading : the image of killian has 0.10 m a pixel, while the paper says 0.05. "paper" reads it as the
        paper does, half as large; "true" reads it in its true size. For all other maps both are the same.
    overrides : fields of SignatureConfig that differ from their defaults, for the proposed method.
    """

    map_path: Path
    reading: Reading
    methods: tuple[str, ...]
    level: int
    radius_m: float
    offset_m: float
    queries: int
    seed: int
    overrides: tuple[tuple[str, Any], ...] = ()

    @property
    def map_name(self) -> str:
        """Name of the map, without suffix."""
        return self.map_path.stem

    def result_path(self, folder: Path, method: str) -> Path:
        """The file of one method's result."""
        changed = "".join(f".{key}={value}" for key, value in self.overrides)
        return folder / (
            f"{self.map_name}-{self.reading}.{method}.noise{self.level}.r{self.radius_m:g}"
            f".offset{self.offset_m:g}.q{self.queries}.seed{self.seed}{changed}.json"
        )


def paper_tasks(
    maps: Sequence[Path],
    *,
    methods: Sequence[str] = METHOD_NAMES,
    offsets_m: Sequence[float] = (0.5, 1.0),
    queries: int = 2000,
    seed: int = 1,
    open_choices: bool = False,
) -> Iterator[PaperTask]:
    """Every task of Tables III and IV; with `open_choices` also those that measure `OPEN_CHOICES`.

    In its true size killian is given to the proposed method only, because it has five times as many submaps.
    """
    common = {"queries": queries, "seed": seed}
    for offset_m in offsets_m:
        for together in TOGETHER:
            group = tuple(name for name in together if name in methods)
            for path in maps:
                for level in range(len(NOISE_LEVELS)):
                    if group:
                        yield _task(path, "paper", group, level, 8.0, offset_m, **common)
                    if group == ("proposed",) and path.stem == "killian":
                        yield _task(path, "true", group, level, 8.0, offset_m, **common)
                if group == ("proposed",):
                    for radius_m in (r for r in RADII_M if r != 8.0):
                        yield _task(path, "paper", group, 1, radius_m, offset_m, **common)
                    for choice in OPEN_CHOICES if open_choices else ():
                        for level in (0, 2):
                            yield _task(
                                path, "paper", group, level, 8.0, offset_m, overrides=(choice,), **common
                            )


def _task(
    path: Path,
    reading: Reading,
    methods: tuple[str, ...],
    level: int,
    radius_m: float,
    offset_m: float,
    **rest: Any,
) -> PaperTask:
    return PaperTask(
        map_path=path,
        reading=reading,
        methods=methods,
        level=level,
        radius_m=radius_m,
        offset_m=offset_m,
        **rest,
    )


def read_map(path: Path, reading: Reading) -> OccupancyGrid:
    """A map in the size that `reading` names. Raises MapFileError."""
    grid = load_map(path)
    published = SIZE_PX.get(path.stem)
    if reading == "paper" and published is not None and grid.cells.shape[1] > 1.5 * published[0]:
        return halved(grid)
    return grid


def halved(grid: OccupancyGrid) -> OccupancyGrid:
    """The grid as an image of half the size with the same resolution, therefore half as large in metres.

    A cell is occupied if any of the four cells that it replaces is; else free if any is; else unknown.
    """
    height, width = (n // 2 * 2 for n in grid.cells.shape)
    occupied, free = (
        mask[:height, :width].reshape(height // 2, 2, width // 2, 2).any(axis=(1, 3))
        for mask in (grid.occupied, grid.free)
    )
    cells = np.where(occupied, 100, np.where(free, 0, UNKNOWN)).astype(np.int8)
    return OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=grid.origin_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperCell:
    """One cell of a table: the facts of its task, its measures, and the best match of every query."""

    map_name: str
    reading: Reading
    method: str
    level: int
    radius_m: float
    offset_m: float
    queries: int
    seed: int
    overrides: tuple[tuple[str, Any], ...]
    submaps: int
    seconds: float
    auc: float
    rp9: float
    f1: float
    true_share: float
    matches: BestMatches

    def summary(self) -> dict[str, Any]:
        """Everything except the single queries, for JSON and CSV."""
        return {key: getattr(self, key) for key in self.__slots__ if key not in ("matches", "overrides")} | {
            "overrides": dict(self.overrides)
        }


def fingerprint(task: PaperTask, method: str) -> str:
    """A hash of what a result depends on; a stored result with another hash is not used."""
    signature = SignatureConfig(**dict(task.overrides))
    facts = {
        "format": _FORMAT,
        "version": __version__,
        "map": hashlib.sha256(task.map_path.read_bytes() + _image_bytes(task.map_path)).hexdigest(),
        "noise": asdict(NOISE_LEVELS[task.level]),
        "partition": PartitionConfig.paper(task.radius_m).model_dump(),
        "signature": signature.model_dump() if method == "proposed" else None,
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def _image_bytes(map_path: Path) -> bytes:
    for suffix in (".png", ".pgm"):
        if map_path.with_suffix(suffix).exists():
            return map_path.with_suffix(suffix).read_bytes()
    return b""


def load_result(task: PaperTask, method: str, folder: Path) -> PaperCell | None:
    """The result of an earlier run; None if there is none or its `fingerprint` differs."""
    path = task.result_path(folder, method)
    try:
        stored = json.loads(path.read_text())
        if stored.pop("fingerprint") != fingerprint(task, method):
            return None
        matches = BestMatches(
            similarity=np.array(stored.pop("similarity"), np.float64),
            correct=np.array(stored.pop("correct"), np.bool_),
        )
        stored["overrides"] = tuple((key, value) for key, value in stored["overrides"].items())
        return PaperCell(matches=matches, **stored)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def run_task(task: PaperTask, folder: Path, progress: Callable[[float], None] | None = None) -> None:
    """Run the methods of a task that have no result yet. Each file is written completely or not at all.

    progress : called with the share that is done, 0..1. Raises MapFileError, OutputError.
    """
    missing = [name for name in task.methods if load_result(task, name, folder) is None]
    if not missing:
        return
    started = time.perf_counter()
    grid = read_map(task.map_path, task.reading)
    submaps = partition(grid, PartitionConfig.paper(task.radius_m))
    experiment = Experiment(queries=task.queries, offset_m=task.offset_m, seed=task.seed)
    found = evaluate(_methods(missing, task), grid, submaps, experiment, NOISE_LEVELS[task.level], progress)
    seconds = round((time.perf_counter() - started) / len(missing), 2)
    for method, matches in found.items():
        curve = matches.curve()
        result = PaperCell(
            map_name=task.map_name,
            reading=task.reading,
            method=method,
            level=task.level,
            radius_m=task.radius_m,
            offset_m=task.offset_m,
            queries=task.queries,
            seed=task.seed,
            overrides=task.overrides,
            submaps=len(submaps),
            seconds=seconds,
            auc=curve.auc,
            rp9=curve.recall_at_90,
            f1=curve.f1,
            true_share=float(matches.correct.mean()),
            matches=matches,
        )
        document = result.summary() | {
            "fingerprint": fingerprint(task, method),
            "similarity": matches.similarity.tolist(),
            "correct": matches.correct.astype(int).tolist(),
        }
        with replace_file(task.result_path(folder, method)) as temporary:
            temporary.write_text(json.dumps(document))


def _methods(names: Sequence[str], task: PaperTask) -> dict[str, Method]:
    methods = make_methods(names)
    if "proposed" in methods and task.overrides:
        from signature.baselines.proposed import Proposed

        methods["proposed"] = Proposed(SignatureConfig(**dict(task.overrides)))
    return methods


def known_maps(folder: Path) -> list[Path]:
    """Paths of the paper's maps (`NAME.yaml`) that are in a folder, in the paper's order."""
    return [folder / f"{name}.yaml" for name in MAPS if (folder / f"{name}.yaml").is_file()]
