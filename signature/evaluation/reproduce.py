"""The cells of the paper's tables as tasks: each is run on its own and kept in files of its own."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pc2grid import __version__
from pc2grid.config import PartitionConfig
from pc2grid.io.atomic import replace_file
from pc2grid.io.nav2_map import load_map
from pc2grid.model import UNKNOWN, OccupancyGrid
from pc2grid.partition import partition
from signature.baselines import METHOD_NAMES, Method, make_methods
from signature.config import SignatureConfig
from signature.evaluation.evaluate import Experiment, Outcome, evaluate
from signature.evaluation.noise import NOISE_LEVELS
from signature.evaluation.published import MAPS, SIZE_PX

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
"""Methods that share their features and so are run together."""

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
"""Other values of what the paper leaves open (and of two that it does not), to see what moves a result."""

_FORMAT = 1  # of the result files, and of the meaning of their numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """Methods on a map at a noise level; one result file a method.

    reading : killian's image is at 0.10 m a pixel, the paper says 0.05. "paper" takes the image as the paper
        does, half as large; "true" takes the map at its own size. The same for all other maps.
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
        """Name of the map."""
        return self.map_path.stem

    def result_path(self, folder: Path, method: str) -> Path:
        """File of one method's result."""
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
) -> Iterator[Task]:
    """Every task of Tables III and IV, the dearest first; with `open_choices` also their effect.

    killian at its true size gets the proposed method only, as it has five times the submaps.
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
) -> Task:
    return Task(
        map_path=path,
        reading=reading,
        methods=methods,
        level=level,
        radius_m=radius_m,
        offset_m=offset_m,
        **rest,
    )


def read_map(path: Path, reading: Reading) -> OccupancyGrid:
    """A map as the task reads it; raises MapFileError."""
    grid = load_map(path)
    published = SIZE_PX.get(path.stem)
    if reading == "paper" and published is not None and grid.cells.shape[1] > 1.5 * published[0]:
        return halved(grid)
    return grid


def halved(grid: OccupancyGrid) -> OccupancyGrid:
    """The grid as an image of half the size, but said to have the same cells, so half as large in metres.

    A cell is occupied if any of its four is, else free if any is, else unknown.
    """
    height, width = (n // 2 * 2 for n in grid.cells.shape)
    fours = grid.cells[:height, :width].reshape(height // 2, 2, width // 2, 2)
    occupied, free = ((mask.any(axis=(1, 3))) for mask in (fours >= 65, (fours >= 0) & (fours < 20)))
    cells = np.where(occupied, 100, np.where(free, 0, UNKNOWN)).astype(np.int8)
    return OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=grid.origin_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One cell: its task's facts, its measures, and the outcome of every query."""

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
    outcome: Outcome

    def summary(self) -> dict[str, Any]:
        """Everything but the single queries, for JSON and CSV."""
        return {key: getattr(self, key) for key in self.__slots__ if key not in ("outcome", "overrides")} | {
            "overrides": dict(self.overrides)
        }


def fingerprint(task: Task, method: str) -> str:
    """What a result depends on, in short; a file with another one is not taken as this task's result."""
    signature = SignatureConfig(**dict(task.overrides))
    facts = {
        "format": _FORMAT,
        "version": __version__,
        "map": hashlib.sha256(task.map_path.read_bytes() + _image_bytes(task.map_path)).hexdigest(),
        "noise": asdict(NOISE_LEVELS[task.level]),
        "partition": PartitionConfig(radius_m=task.radius_m, view="disc").model_dump(),
        "signature": signature.model_dump() if method == "proposed" else None,
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def _image_bytes(map_path: Path) -> bytes:
    for suffix in (".png", ".pgm"):
        if map_path.with_suffix(suffix).exists():
            return map_path.with_suffix(suffix).read_bytes()
    return b""


def load_result(task: Task, method: str, folder: Path) -> Result | None:
    """The result of an earlier run, or None if there is none or it was made from something else."""
    path = task.result_path(folder, method)
    try:
        stored = json.loads(path.read_text())
        if stored.pop("fingerprint") != fingerprint(task, method):
            return None
        outcome = Outcome(
            similarity=np.array(stored.pop("similarity"), np.float64),
            correct=np.array(stored.pop("correct"), np.bool_),
        )
        stored["overrides"] = tuple((key, value) for key, value in stored["overrides"].items())
        return Result(outcome=outcome, **stored)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def run_task(task: Task, folder: Path, progress: Callable[[float], None] | None = None) -> None:
    """Run what is missing of a task and write a file a method, whole or not at all.

    Raises MapFileError, OutputError.
    """
    missing = [name for name in task.methods if load_result(task, name, folder) is None]
    if not missing:
        return
    started = time.perf_counter()
    grid = read_map(task.map_path, task.reading)
    submaps = partition(grid, PartitionConfig(radius_m=task.radius_m, view="disc"))
    experiment = Experiment(queries=task.queries, offset_m=task.offset_m, seed=task.seed)
    outcomes = evaluate(
        _methods(missing, task), grid, submaps, experiment, NOISE_LEVELS[task.level], progress
    )
    seconds = round((time.perf_counter() - started) / len(missing), 2)
    for method, outcome in outcomes.items():
        curve = outcome.curve()
        result = Result(
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
            true_share=float(outcome.correct.mean()),
            outcome=outcome,
        )
        document = result.summary() | {
            "fingerprint": fingerprint(task, method),
            "similarity": outcome.similarity.tolist(),
            "correct": outcome.correct.astype(int).tolist(),
        }
        with replace_file(task.result_path(folder, method)) as temporary:
            temporary.write_text(json.dumps(document))


def _methods(names: Sequence[str], task: Task) -> dict[str, Method]:
    methods = make_methods(names)
    if "proposed" in methods and task.overrides:
        from signature.baselines.proposed import Proposed

        methods["proposed"] = Proposed(SignatureConfig(**dict(task.overrides)))
    return methods


def known_maps(folder: Path) -> list[Path]:
    """The paper's maps that a folder has, as `map.yaml` paths in the paper's order."""
    return [folder / f"{name}.yaml" for name in MAPS if (folder / f"{name}.yaml").is_file()]
