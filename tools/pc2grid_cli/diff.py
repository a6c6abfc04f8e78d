"""`pc2grid diff`: what came, went and stands in a building between two sessions."""

from __future__ import annotations

import json as json_format
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from pc2grid.display import counted, probability
from pc2grid.errors import one_line
from pc2grid.io.atomic import replace_file
from pc2grid.io.export.cloud import write_cloud
from pc2grid_cli import console
from pc2grid_cli.json_schemas import Diff, plain
from pc2grid_cli.options import AsJson, Database, Force
from pc2grid_cli.output_files import check_file
from pc2grid_cli.picture import draw_changes
from pc2grid_cli.tables import show, table
from signature.database import open_database
from signature.localization.joining.changes import building_changes, sessions_of

if TYPE_CHECKING:
    from pc2grid.mapping.changes import ChangedPatch, MapChanges
    from pc2grid.model import OccupancyGrid

_INTENSITY = {"went": -1.0, "stood": 0.0, "came": 1.0}
"""Of the points of a cloud."""
_LISTED = 20
"""Patches in the table that is printed; files and `--json` have all."""


def diff_command(
    context: typer.Context,
    database: Database,
    before: Annotated[
        str, typer.Argument(metavar="BEFORE", help="a session, or a date (YYYY-MM-DD, UTC): all of that day")
    ],
    after: Annotated[str, typer.Argument(metavar="AFTER", help="the same, later")],
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT.png|.geojson|.pcd|.ply",
            help="a picture, polygons, or points; repeatable",
        ),
    ] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Show what changed in a building between two sessions that are joined (pc2grid db join).

    Only ground counts that both have seen. Files are in the frame of the building, in metres. Points have an
    intensity: 1 came, -1 went, 0 stands in both.

    Example: pc2grid diff building.submaps monday friday -o changes.png
    """
    outputs = output or []
    for path in outputs:
        check_file("changes", path, force)
    with open_database(database) as opened:
        where = opened.location
        names = [sessions_of(opened, named) for named in (before, after)]
        earlier, changes = building_changes(opened, *names)
        frame = opened.frames()[names[0][0]].name
    for path in outputs:
        _write(path, f"{before} to {after}, in the frame of {frame}", earlier, changes)
        console.of(context).note(f"wrote {path}")
    if json:
        document = _document(where, frame, names, changes, outputs)
        console.print_json(plain(Diff, document))
    else:
        _report(names, frame, changes)


def _document(
    where: str, frame: str, names: Sequence[Sequence[str]], changes: MapChanges, outputs: Sequence[Path]
) -> Diff:
    return {
        "schema_version": 1,
        "database": where,
        "frame": frame,
        "before": list(names[0]),
        "after": list(names[1]),
        "common_m2": changes.common_m2,
        "came_m2": changes.area_m2("came"),
        "went_m2": changes.area_m2("went"),
        "stood_m2": changes.stood_m2,
        "changes": [
            {
                "kind": patch.kind,
                "center_m": list(patch.center_m),
                "length_m": patch.length_m,
                "width_m": patch.width_m,
                "yaw": patch.yaw_rad,
                "area_m2": patch.area_m2,
                "probability": patch.probability,
            }
            for patch in changes.patches
        ],
        "written": [str(path) for path in outputs],
    }


def _report(names: Sequence[Sequence[str]], frame: str, changes: MapChanges) -> None:
    """Print the areas, and the largest patches."""
    before, after = (", ".join(some) for some in names)
    show(one_line(f"from {before} to {after}, in the frame of {frame}:"))
    came, went = changes.of("came"), changes.of("went")
    show(
        f"  {counted(len(came), 'thing')} came ({changes.area_m2('came'):.2f} m2),"
        f" {len(went)} went ({changes.area_m2('went'):.2f} m2), {changes.stood_m2:.1f} m2 of obstacles stand"
        f" in both, of {changes.common_m2:.0f} m2 that both know"
    )
    if not changes.patches:
        return
    patches = table(
        "the largest changes", ("",), ("x, m", "y, m", "length, m", "width, m", "turn, deg", "probability")
    )
    for patch in changes.patches[:_LISTED]:
        x, y = patch.center_m
        patches.add_row(
            patch.kind,
            *(f"{value:.2f}" for value in (x, y, patch.length_m, patch.width_m)),
            f"{math.degrees(patch.yaw_rad):.0f}",
            probability(patch.probability),
        )
    show(patches)
    if len(changes.patches) > _LISTED:
        show(f"{len(changes.patches) - _LISTED} smaller ones are in --output and --json")


def _write(path: Path, title: str, earlier: OccupancyGrid, changes: MapChanges) -> None:
    """Write a file of the format that its name ends in."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        draw_changes(path, title, earlier, changes)
    elif suffix == ".geojson":
        with replace_file(path) as temporary:
            temporary.write_text(json_format.dumps(_geojson(changes)), encoding="utf-8")
    else:
        parts = [(changes.stood_m, _INTENSITY["stood"])]
        parts += [(patch.points_m, _INTENSITY[patch.kind]) for patch in changes.patches]
        points_m = np.concatenate([points for points, _ in parts])
        intensity = np.repeat([value for _, value in parts], [len(points) for points, _ in parts])
        write_cloud(path, np.column_stack((points_m, np.zeros(len(points_m)))), intensity)


def _geojson(changes: MapChanges) -> dict[str, Any]:
    """A polygon for each patch, and a point for each cell that stands in both; metres, not degrees."""
    stood = {"type": "MultiPoint", "coordinates": changes.stood_m.round(3).tolist()}
    features = [{"type": "Feature", "geometry": stood, "properties": {"kind": "stood"}}]
    features += [_feature(patch) for patch in changes.patches]
    return {"type": "FeatureCollection", "features": features}


def _feature(patch: ChangedPatch) -> dict[str, Any]:
    corners = patch.corners_m().round(3).tolist()
    return {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [[*corners, corners[0]]]},
        "properties": {
            "kind": patch.kind,
            "area_m2": round(patch.area_m2, 4),
            "probability": round(patch.probability, 4),
        },
    }
