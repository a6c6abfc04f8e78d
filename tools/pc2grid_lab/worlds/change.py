"""What is different in a session from the building as it was drawn or scanned.

Doors are opened and closed and furniture is moved and exchanged by the seed of the session. Relief of
walls, glass and mirrors belong to the building: its seed decides them, and they are alike in all sessions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pc2grid.arrays import F64, U8, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.model import FREE, OccupancyGrid
from pc2grid.simulate.clutter import KINDS, Furniture, Prism
from pc2grid.simulate.passage import clearance_m, outline_mask
from pc2grid.simulate.scene import Mesh
from pc2grid_lab.worlds.config import ChangeConfig
from pc2grid_lab.worlds.doors import Doorway, find_doorways, open_angle

OPAQUE, GLASS, MIRROR = 0, 1, 2

_PIECE_M = (0.2, 1.8)  # shortest and longest side of a solid part that is furniture and not a wall
_STANDS_FREE = 0.5  # share of the cells around a piece that are free
_MOVED_M, _TURNED_RAD = 0.6, math.radians(25.0)  # standard deviations
_PIECE_TOP_M, _PIECE_BOTTOM_M = 2.0, 0.1  # a piece of a real building is cut out between these heights
_KEPT_REACHABLE = 0.5  # share of the robot's space that closed doors leave in one part
_PANE_M = 0.75  # half the width of a pane or mirror
_RELIEF = ("radiator", "pilaster", "case")
_RELIEF_M = {  # length, depth, bottom, top of each, metres: from and to
    "radiator": ((0.5, 1.4), (0.08, 0.14), (0.1, 0.15), (0.6, 0.9)),
    "pilaster": ((0.2, 0.5), (0.05, 0.2), (0.0, 0.0), (2.4, 2.5)),
    "case": ((0.3, 1.0), (0.1, 0.2), (0.5, 1.0), (1.2, 1.8)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What was changed in one session.

    added : doors, moved and exchanged furniture, relief. kind : (H, W) OPAQUE, GLASS or MIRROR for each
    cell of the plan, None if all is opaque.
    doorways, closed, ajar : doors of the plan, and how many of them are now shut or have their leaf standing
    open; in the others nothing stands.
    pieces, moved, exchanged : free-standing furniture of the plan, and what became of it.
    relief : things on walls. glass_m, mirror_m : length of wall that is glass or mirror.
    walls_changed : share of the wall cells seen from free space that were removed or are newly solid.
    """

    added: tuple[Furniture, ...] = ()
    kind: U8 | None = None
    doorways: int = 0
    closed: int = 0
    ajar: int = 0
    pieces: int = 0
    moved: int = 0
    exchanged: int = 0
    relief: int = 0
    glass_m: float = 0.0
    mirror_m: float = 0.0
    walls_changed: float = 0.0

    def counts(self) -> dict[str, float]:
        """Its figures by name."""
        return {key: value for key, value in asdict(self).items() if key not in ("added", "kind")}

    def describe(self) -> str:
        """One sentence for people."""
        parts = [
            f"{self.closed} of {self.doorways} doors closed, {self.ajar} ajar" if self.doorways else "",
            f"{self.moved} of {self.pieces} pieces of furniture moved, {self.exchanged} exchanged"
            if self.pieces
            else "",
            f"{self.relief} things on walls" if self.relief else "",
            f"{self.glass_m:.0f} m of glass" if self.glass_m else "",
            f"{self.mirror_m:.0f} m of mirrors" if self.mirror_m else "",
            f"{100 * self.walls_changed:.0f} % of the visible walls differ",
        ]
        return ", ".join(part for part in parts if part)


NO_CHANGE = Change()


def change_building(
    plan: OccupancyGrid,
    shell: Mesh | None,
    config: ChangeConfig,
    rng: np.random.Generator,
    building_rng: np.random.Generator,
    *,
    robot_m: float,
    start_m: tuple[float, float] | None = None,
) -> tuple[OccupancyGrid, Mesh | None, Change]:
    """The building as it is in one session.

    shell : geometry of a real building, None for a plan. rng : of the session; building_rng : of the
    building. robot_m : doors are closed only so far that a robot of this radius keeps half of its space.
    """
    if config == ChangeConfig():
        return plan, shell, NO_CHANGE
    relief = _relief(plan, config.relief_per_m, building_rng)
    kind = _panes(plan, config.glass, config.mirrors, building_rng)
    pieces = _pieces(plan) if config.furniture else []
    chosen = [piece for piece in pieces if rng.random() < config.furniture]
    shell, furniture, exchanged = _refurnished(plan, shell, chosen, config.exchanged, rng)
    emptied = _without(plan, chosen)
    doorways = find_doorways(plan) if config.doors else ()
    doors, closed = _doors(emptied, doorways, config, rng, robot_m, start_m)
    glass_m, mirror_m = (_length_m(plan, kind, what) for what in (GLASS, MIRROR))
    change = Change(
        added=(*doors, *furniture, *relief),
        kind=kind,
        doorways=len(doorways),
        closed=closed,
        ajar=len(doors) - closed,
        pieces=len(pieces),
        moved=len(chosen) - exchanged,
        exchanged=exchanged,
        relief=len(relief),
        glass_m=glass_m,
        mirror_m=mirror_m,
        walls_changed=_walls_changed(plan, emptied, (*doors, *furniture)),
    )
    return emptied, shell, change


def _refurnished(
    plan: OccupancyGrid, shell: Mesh | None, chosen: list[BoolGrid], share: float, rng: np.random.Generator
) -> tuple[Mesh | None, list[Furniture], int]:
    """The building without some pieces, what became of them, and how many were exchanged.

    share : of the pieces that are exchanged, not moved.
    """
    tops_m = [_PIECE_TOP_M] * len(chosen)
    if shell is not None and chosen:
        shell, tops_m = _cut(shell, plan, chosen)
    furniture, exchanged = [], 0
    for piece, top_m in zip(chosen, tops_m, strict=True):
        swap = rng.random() < share
        exchanged += swap
        furniture.append(_exchanged(piece, plan, rng) if swap else _moved(piece, plan, top_m, rng))
    return shell, furniture, exchanged


def _doors(
    plan: OccupancyGrid,
    doorways: Sequence[Doorway],
    config: ChangeConfig,
    rng: np.random.Generator,
    robot_m: float,
    start_m: tuple[float, float] | None,
) -> tuple[list[Furniture], int]:
    """The leaves of the doors that stand in the doorways, and how many of them are closed."""
    doors: list[Furniture] = []
    closed = 0
    for doorway in doorways:
        if rng.random() >= config.doors:
            continue
        leaf = doorway.leaf(0.0)
        if rng.random() < config.closed and _leaves_room(plan, [*doors, leaf], robot_m, start_m):
            closed += 1
        else:
            leaf = doorway.leaf(open_angle(rng), at_b=bool(rng.random() < 0.5))
        doors.append(leaf)
    return doors, closed


def _length_m(plan: OccupancyGrid, kind: U8 | None, what: int) -> float:
    """Length of the visible wall that is of a kind."""
    if kind is None:
        return 0.0
    return float((_visible_walls(plan) & (kind == what)).sum()) * plan.resolution_m


def _footprint(plan: OccupancyGrid, furniture: Furniture) -> BoolGrid:
    corners = (furniture.pose.apply(furniture.outline_m) - plan.origin_m) / plan.resolution_m
    return outline_mask(corners, (plan.cells.shape[0], plan.cells.shape[1]))


def _visible_walls(plan: OccupancyGrid) -> BoolGrid:
    """Occupied cells next to free ones."""
    beside: BoolGrid = ndimage.binary_dilation(plan.free, np.ones((3, 3), bool))
    return plan.occupied & beside


def _walls_changed(plan: OccupancyGrid, emptied: OccupancyGrid, added: tuple[Furniture, ...]) -> float:
    visible = _visible_walls(plan)
    gone = visible & ~emptied.occupied
    new = np.zeros_like(gone)
    for furniture in added:
        new |= _footprint(plan, furniture)
    new &= ~plan.occupied
    # As with walls, only the outline of a thing is seen.
    new &= ~ndimage.binary_erosion(new, np.ones((3, 3), bool))
    return float((gone.sum() + new.sum()) / max(visible.sum(), 1))


def _pieces(plan: OccupancyGrid) -> list[BoolGrid]:
    """A mask (H, W) for each solid part that is small and stands free: furniture, not walls."""
    labels, _ = ndimage.label(plan.occupied, np.ones((3, 3), bool))
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        sides = sorted((s.stop - s.start) * plan.resolution_m for s in box)
        if sides[1] < _PIECE_M[0] or sides[1] > _PIECE_M[1]:
            continue
        around = tuple(slice(max(s.start - 2, 0), s.stop + 2) for s in box)
        part = labels[around] == number
        ring = ndimage.binary_dilation(part, np.ones((3, 3), bool)) & ~part
        if plan.free[around][ring].mean() >= _STANDS_FREE:
            mask = np.zeros(labels.shape, bool)
            mask[around] = part
            found.append(mask)
    return found


def _hull(mask: BoolGrid, plan: OccupancyGrid) -> F64:
    """Convex outline (N, 2) of the cells of a mask, map frame."""
    cells = np.argwhere(mask)
    half = plan.resolution_m / 2
    corners = plan.to_point(cells)[:, None] + np.array(
        [(-half, -half), (half, -half), (half, half), (-half, half)]
    )
    hull: F64 = cv2.convexHull(corners.reshape(-1, 2).astype(np.float32))[:, 0].astype(np.float64)
    return hull


def _moved(mask: BoolGrid, plan: OccupancyGrid, top_m: float, rng: np.random.Generator) -> Furniture:
    """The piece as an upright prism of its outline, some decimetres away."""
    hull = _hull(mask, plan)
    middle = hull.mean(axis=0)
    x, y = (float(v) for v in middle + rng.normal(0.0, _MOVED_M, 2))
    pose = SE2(x, y, float(rng.normal(0.0, _TURNED_RAD)))
    outline = hull - middle
    return Furniture("moved", pose, outline, (Prism(outline, 0.0, top_m),))


def _exchanged(mask: BoolGrid, plan: OccupancyGrid, rng: np.random.Generator) -> Furniture:
    """Something else in the place of the piece."""
    name = ("table", "box")[rng.integers(2)]
    outline, parts = KINDS[name][0](rng)
    middle = _hull(mask, plan).mean(axis=0)
    pose = SE2(float(middle[0]), float(middle[1]), float(rng.uniform(-math.pi, math.pi)))
    return Furniture(name, pose, outline, tuple(parts))


def _without(plan: OccupancyGrid, pieces: list[BoolGrid]) -> OccupancyGrid:
    """The plan with some pieces removed."""
    if not pieces:
        return plan
    cells = plan.cells.copy()
    for mask in pieces:
        cells[mask] = FREE
    return OccupancyGrid(cells=cells, resolution_m=plan.resolution_m, origin_m=plan.origin_m)


def _cut(shell: Mesh, plan: OccupancyGrid, pieces: list[BoolGrid]) -> tuple[Mesh, list[float]]:
    """The geometry of a real building without some pieces of its plan, and how high each of them was."""
    number = np.zeros(plan.cells.shape, np.int64)  # of the piece in each cell, from 1
    for k, piece in enumerate(pieces, start=1):
        number[piece] = k
    number = np.maximum(number, ndimage.grey_dilation(number, size=3))
    middle = shell.vertices_m[shell.triangles].mean(axis=1)
    cells = plan.to_cell(middle[:, :2].astype(np.float64))
    inside: NDArray[np.bool_] = np.all((cells >= 0) & (cells < number.shape), axis=1)
    inside &= (middle[:, 2] > _PIECE_BOTTOM_M) & (middle[:, 2] < _PIECE_TOP_M)
    of_piece = np.zeros(len(middle), np.int64)
    of_piece[inside] = number[cells[inside, 0], cells[inside, 1]]
    tops = np.full(len(pieces) + 1, _PIECE_BOTTOM_M)
    np.maximum.at(tops, of_piece, middle[:, 2].astype(np.float64))
    return Mesh(shell.vertices_m, shell.triangles[of_piece == 0]), tops[1:].tolist()


def _leaves_room(
    plan: OccupancyGrid, doors: list[Furniture], robot_m: float, start_m: tuple[float, float] | None
) -> bool:
    """Whether the part of the free space that the robot is in, or else the largest one, stays half of what
    it could reach without the doors."""
    free = plan.free.copy()
    before = _largest(ndimage.label(clearance_m(free, plan.resolution_m) >= robot_m)[0], None, plan)
    for door in doors:
        free &= ~_footprint(plan, door)
    after = _largest(ndimage.label(clearance_m(free, plan.resolution_m) >= robot_m)[0], start_m, plan)
    return after >= _KEPT_REACHABLE * before


def _largest(labels: Any, start_m: tuple[float, float] | None, plan: OccupancyGrid) -> int:
    """Cells of the largest part, or of the part nearest to the start."""
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    if start_m is None or not sizes.any():
        return int(sizes.max())
    cells = np.argwhere(labels > 0)
    nearest = cells[np.argmin(np.hypot(*(plan.to_point(cells) - start_m).T))]
    return int(sizes[labels[nearest[0], nearest[1]]])


def _wall_points(plan: OccupancyGrid) -> tuple[F64, F64]:
    """Points (N, 2) on visible walls, and unit vectors (N, 2) from there into the free space."""
    visible = np.argwhere(_visible_walls(plan))
    # The gradient of the smoothed free space points away from the wall.
    smooth = cv2.GaussianBlur(plan.free.astype(np.float32), (0, 0), 3.0)
    gy, gx = np.gradient(smooth)
    normal = np.column_stack([g[visible[:, 0], visible[:, 1]] for g in (gx, gy)]).astype(np.float64)
    length = np.linalg.norm(normal, axis=1)
    kept = length > 1e-6
    return plan.to_point(visible[kept]), normal[kept] / length[kept, None]


def _relief(plan: OccupancyGrid, per_m: float, rng: np.random.Generator) -> list[Furniture]:
    """Radiators, pilasters and cases on the walls, where no doorway is."""
    points, normals = _wall_points(plan) if per_m else (np.empty((0, 2)), np.empty((0, 2)))
    if not len(points):
        return []
    doorways = np.array([np.mean((d.a_m, d.b_m), axis=0) for d in find_doorways(plan)]).reshape(-1, 2)
    made = []
    for k in rng.choice(len(points), rng.poisson(per_m * len(points) * plan.resolution_m)):
        kind = _RELIEF[rng.integers(len(_RELIEF))]
        length, depth, bottom, top = (float(rng.uniform(*span)) for span in _RELIEF_M[kind])
        if len(doorways) and np.hypot(*(doorways - points[k]).T).min() < 1.0 + length / 2:
            continue
        outline = np.array([(0, -length / 2), (depth, -length / 2), (depth, length / 2), (0, length / 2)])
        x, y = (float(v) for v in points[k])
        pose = SE2(x, y, math.atan2(normals[k, 1], normals[k, 0]))
        made.append(Furniture(kind, pose, outline, (Prism(outline, bottom, top),)))
    return made


def _panes(plan: OccupancyGrid, glass: float, mirrors: float, rng: np.random.Generator) -> U8 | None:
    """What each cell is made of, None if all is opaque. Panes are stretches of wall some decimetres wide."""
    points, _ = _wall_points(plan) if glass or mirrors else (np.empty((0, 2)), None)
    if not len(points):
        return None
    kind = np.zeros(plan.cells.shape, np.uint8)
    walls = np.argwhere(plan.occupied)
    at = plan.to_point(walls)
    visible = _visible_walls(plan)
    for what, share in ((MIRROR, mirrors), (GLASS, glass)):
        for k in rng.permutation(len(points)):
            if (visible & (kind == what)).sum() >= share * visible.sum():
                break
            near = walls[np.hypot(*(at - points[k]).T) < _PANE_M]
            kind[near[:, 0], near[:, 1]] = what
    return kind
