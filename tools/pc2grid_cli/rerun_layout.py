"""How the rerun viewer opens: the map from above with north up, and the confidence on an axis from 0 to 1."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from pc2grid_cli.rerun_target import require_rerun

if TYPE_CHECKING:
    from pc2grid.model import OccupancyGrid

LOOPS, GRAPH, GRID, CONFIDENCE = "map/loops", "map/ways", "map/grid", "query/confidence"
_HEIGHT, _LEAST_RATIO = 1.1, 1.2
"""The eye is so many times the height of the map (+y) above it, or its width by the ratio of a window, to
have the whole map in sight. Tried in the viewer, whose eye sees as much as it is high."""
_START_HEIGHT_M = 40.0
"""As long as there is no map yet: above the start of the robot; chosen by hand."""
_MAP_SHARE = 5
"""The view of the map is so many times as high as that of the confidence."""


def layout(grid: OccupancyGrid | None, *, has_query: bool = False, hidden: Collection[str] = ()) -> Any:
    """The blueprint of a viewer.

    grid : the map that is shown, to look at from above its middle; None if it is still being made.
    has_query : whether a recording is being located, so that there is a confidence to show.
    hidden : entities that are off until they are switched on, beside the loops, the junction graph and the
        grid, which would cover the rest.
    """
    require_rerun()
    import rerun.blueprint as rrb

    x, y, height_m = 0.0, 0.0, _START_HEIGHT_M
    if grid is not None:
        rows, columns = (length * grid.resolution_m for length in grid.cells.shape)
        x, y = grid.origin_m[0] + 0.5 * columns, grid.origin_m[1] + 0.5 * rows
        height_m = _HEIGHT * max(rows, columns / _LEAST_RATIO)
    off = rrb.EntityBehavior(visible=False)
    world = rrb.Spatial3DView(
        origin="/",
        contents=["+ /**", f"- /{CONFIDENCE}"],
        name="map",
        overrides=dict.fromkeys((LOOPS, GRAPH, GRID, *hidden), off),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=(x, y, height_m), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
        ),
    )
    if not has_query:
        return rrb.Blueprint(world, collapse_panels=True)
    curve = rrb.TimeSeriesView(
        origin=f"/{CONFIDENCE}",
        name="confidence",
        axis_y=rrb.ScalarAxis(range=(0.0, 1.0), zoom_lock=True),
    )
    return rrb.Blueprint(rrb.Vertical(world, curve, row_shares=[_MAP_SHARE, 1]), collapse_panels=True)
