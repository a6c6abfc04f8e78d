"""The cells of the paper's tables as tasks: each runs independently and stores its results in files of its
own.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pc2grid._version import __version__
from pc2grid.config import PartitionConfig
from pc2grid.io.atomic import replace_file
from pc2grid.io.nav2_map import load_map
from pc2grid.model import UNKNOWN, OccupancyGrid
from pc2grid.submaps.partition import partition
from pc2grid_lab.baselines import METHOD_NAMES, Method, make_methods
from pc2grid_lab.baselines.proposed import Proposed
from pc2grid_lab.experiments.noise import NOISE_LEVELS, Noise
from pc2grid_lab.experiments.paper_experiment import BestMatches, Experiment, MatchMeasures, evaluate
from pc2grid_lab.experiments.paper_tables import MAPS, SIZE_PX
from signature.config import SignatureConfig

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
    ("opencv_shape_context",),
    ("verified",),
    ("proposed_centres",),
    ("boundary_centres",),
    ("shape_context_centres",),
)
"""Methods that share their features and therefore run together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingChoice:
    """Another setting of the proposed method, to measure what it moves.

    name : in a few words. paper : what the paper says of it. ours : what the default does instead.
    overrides : fields of SignatureConfig with the other values.
    """

    name: str
    paper: str
    ours: str
    overrides: tuple[tuple[str, Any], ...]


_NO_SYMMETRY = ("symmetry_sigma", 1e6)

ABLATION = (
    SettingChoice(
        name="boundary and free space",
        paper="Eq. 6 with Omega = 1",
        ours="Eq. 6",
        overrides=(_NO_SYMMETRY,),
    ),
    SettingChoice(
        name="boundary alone",
        paper="omega_b = 1, Omega = 1",
        ours="Eq. 6",
        overrides=(("weight_boundary", 1.0), _NO_SYMMETRY),
    ),
    SettingChoice(
        name="free space alone",
        paper="omega_b = 0, Omega = 1",
        ours="Eq. 6",
        overrides=(("weight_boundary", 0.0), _NO_SYMMETRY),
    ),
    SettingChoice(
        name="symmetry made to count",
        paper="sigma = 120",
        ours="sigma = 120; here 4",
        overrides=(("symmetry_sigma", 4.0),),
    ),
)
"""What each signature adds."""

OPEN_CHOICES = (
    SettingChoice(
        name="to the letter",
        paper="all of the next five",
        ours="none of them",
        overrides=tuple(
            (key, value) for key, value in SignatureConfig.paper() if value != getattr(SignatureConfig(), key)
        ),
    ),
    SettingChoice(
        name="-ln BC",
        paper="Bhattacharyya distance",
        ours="sqrt(1 - BC), which OpenCV calls so",
        overrides=(("histogram_distance", "bhattacharyya"),),
    ),
    SettingChoice(
        name="Zhang-Suen thinning",
        paper="thinning, not which one",
        ours="Guo-Hall in the signatures",
        overrides=(("thinning", "zhang_suen"),),
    ),
    SettingChoice(
        name="full resolution",
        paper="skeleton of the map",
        ours="free-space skeleton on blocks of 0.1 m",
        overrides=(("freespace_cell_m", 0.05),),
    ),
    SettingChoice(
        name="no limit in S^G",
        paper="no limit",
        ours="cut at 34, the value of a straight line",
        overrides=(("symmetry_limited", False),),
    ),
    SettingChoice(
        name="plain vote",
        paper="voting on the angles",
        ours="by length, blurred, refined",
        overrides=(("axis_vote", "plain"),),
    ),
    SettingChoice(
        name="boundary points 0.05 m", paper="-", ours="0.1 m", overrides=(("boundary_spacing_m", 0.05),)
    ),
    SettingChoice(
        name="boundary points 0.2 m", paper="-", ours="0.1 m", overrides=(("boundary_spacing_m", 0.2),)
    ),
    SettingChoice(
        name="nodes 0.4 m apart", paper="-", ours="0.6 m", overrides=(("freespace_spacing_m", 0.4),)
    ),
    SettingChoice(
        name="nodes 1.0 m apart", paper="-", ours="0.6 m", overrides=(("freespace_spacing_m", 1.0),)
    ),
    SettingChoice(
        name="eroded by 0.3 m",
        paper="erosion, not how much",
        ours="0.2 m",
        overrides=(("freespace_clearance_m", 0.3),),
    ),
    SettingChoice(
        name="nodes joined to 1.5 m",
        paper="all that see each other",
        ours="the same",
        overrides=(("freespace_join_m", 1.5),),
    ),
    SettingChoice(name="S^G peaks at 255", paper="-", ours="34", overrides=(("symmetry_peak", 255.0),)),
    SettingChoice(name="omega_b = 0.7", paper="0.9", ours="0.9", overrides=(("weight_boundary", 0.7),)),
)
"""Where the default departs from the paper, and other values of what the paper leaves open."""

_BY_SIGNATURES = ("proposed", "verified", "proposed_centres", "boundary_centres")
"""Methods whose results depend on SignatureConfig."""

_FORMAT = 2  # of the result files; a change of the meaning of their numbers changes it too


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTask:
    """Methods on one map at one noise level; one result file for each method.

    reading : the image of killian has 0.10 m a pixel, while the paper says 0.05. "paper" reads it as the
        paper does, half as large; "true" reads it in its true size. For all other maps both are the same.
    overrides : fields of SignatureConfig that differ from their defaults, for the proposed method.
    speckle_sigma_m : spread of the boundary noise, which the paper leaves open.
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
    speckle_sigma_m: float = Noise(boundary=0, freespace=0).speckle_sigma_m

    @property
    def noise(self) -> Noise:
        """The noise of the level, with the spread of this task."""
        return replace(NOISE_LEVELS[self.level], speckle_sigma_m=self.speckle_sigma_m)

    @property
    def map_name(self) -> str:
        """Name of the map, without suffix."""
        return self.map_path.stem

    def result_path(self, folder: Path, method: str) -> Path:
        """The file of one method's result."""
        changed = "".join(f".{key}={value}" for key, value in self.overrides)
        if self.speckle_sigma_m != NOISE_LEVELS[self.level].speckle_sigma_m:
            changed += f".speckles{self.speckle_sigma_m:g}"
        return folder / (
            f"{self.map_name}-{self.reading}.{method}.noise{self.level}.r{self.radius_m:g}"
            f".offset{self.offset_m:g}.q{self.queries}.seed{self.seed}{changed}.json"
        )


def paper_tasks(
    maps: Sequence[Path],
    *,
    methods: Sequence[str] = METHOD_NAMES,
    offsets_m: Sequence[float] = (1.0, 0.5),
    queries: int = 2000,
    seed: int = 1,
    choices: Sequence[SettingChoice] = (),
    speckle_sigma_m: float = NOISE_LEVELS[0].speckle_sigma_m,
) -> Iterator[PaperTask]:
    """Every task of Tables III and IV, and those that measure other `choices`.

    In its true size killian is given to the proposed method only, because it has five times as many submaps.
    """
    groups = [tuple(name for name in together if name in methods) for together in TOGETHER]
    for offset_m, group, path in itertools.product(offsets_m, filter(None, groups), maps):
        for facts in _cells_of(path, group, choices):
            yield PaperTask(
                map_path=path,
                methods=group,
                offset_m=offset_m,
                queries=queries,
                seed=seed,
                speckle_sigma_m=speckle_sigma_m,
                **facts,
            )


def _cells_of(
    path: Path, group: tuple[str, ...], choices: Sequence[SettingChoice]
) -> Iterator[dict[str, Any]]:
    """Reading, level, radius and overrides of the tasks of some methods on a map."""
    plain: dict[str, Any] = {"reading": "paper", "radius_m": 8.0}
    for level in range(len(NOISE_LEVELS)):
        yield {**plain, "level": level}
        if group == ("proposed",) and path.stem == "killian":
            yield {**plain, "level": level, "reading": "true"}
    if group == ("proposed",):
        for radius_m in (r for r in RADII_M if r != 8.0):
            yield {**plain, "level": 1, "radius_m": radius_m}
        for choice, level in itertools.product(choices, (0, 2)):
            yield {**plain, "level": level, "overrides": choice.overrides}


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
    """One cell of a table: the facts of its task, its measures, and the best match of every query.

    half_widths : half of the interval from 5 to 95 % of each measure, by bootstrap over the queries.
    """

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
    speckle_sigma_m: float
    half_widths: MatchMeasures

    def summary(self) -> dict[str, Any]:
        """Everything except the single queries, for JSON and CSV."""
        rest = ("matches", "overrides", "half_widths")
        return (
            {key: getattr(self, key) for key in self.__slots__ if key not in rest}
            | {f"{measure}_half_width": value for measure, value in self.half_widths._asdict().items()}
            | {"overrides": dict(self.overrides)}
        )


def fingerprint(task: PaperTask, method: str) -> str:
    """A hash of what a result depends on; a stored result with another hash is not used."""
    signature = SignatureConfig(**dict(task.overrides))
    facts = {
        "format": _FORMAT,
        "version": __version__,
        "map": hashlib.sha256(task.map_path.read_bytes() + _image_bytes(task.map_path)).hexdigest(),
        "noise": asdict(task.noise),
        "partition": PartitionConfig.paper(task.radius_m).model_dump(),
        "signature": signature.model_dump() if method in _BY_SIGNATURES else None,
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
        half_widths = MatchMeasures(*(stored.pop(f"{key}_half_width") for key in MatchMeasures._fields))
        stored["overrides"] = tuple((key, value) for key, value in stored["overrides"].items())
        return PaperCell(matches=matches, half_widths=half_widths, **stored)
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
    found = evaluate(_methods(missing, task), grid, submaps, experiment, task.noise, progress)
    seconds = round((time.perf_counter() - started) / len(missing), 2)
    for method, matches in found.items():
        measures = matches.measures()
        low, high = matches.intervals()
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
            auc=measures.auc,
            rp9=measures.rp9,
            f1=measures.f1,
            true_share=measures.r_at_1,
            matches=matches,
            speckle_sigma_m=task.speckle_sigma_m,
            half_widths=MatchMeasures(*((b - a) / 2 for a, b in zip(low, high, strict=True))),
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
        methods["proposed"] = Proposed(SignatureConfig(**dict(task.overrides)))
    return methods


def known_maps(path: Path) -> list[Path]:
    """The maps that a path names: itself, if it is a file; else those of the paper in the folder, in the
    paper's order; else every `*.yaml` in it, by name.
    """
    if path.is_file():
        return [path]
    published = [path / f"{name}.yaml" for name in MAPS if (path / f"{name}.yaml").is_file()]
    return published or sorted(path.glob("*.yaml"))
