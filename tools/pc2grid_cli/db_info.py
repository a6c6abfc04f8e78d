"""`pc2grid db info`: the sessions of a database."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli.options import AsJson, Database
from pc2grid_cli.plural import counted
from pc2grid_cli.session_documents import consistency_document, odometry_document, precision_document
from signature.database import open_database

if TYPE_CHECKING:
    from pc2grid_cli.json_schemas import DbInfo, Session


def db_info_command(database: Database, json: AsJson = False) -> None:
    """Show the sessions of a database.

    Example: pc2grid db info building.submaps
    """
    with open_database(database) as opened:
        sessions, where = opened.sessions(), opened.location
    if json:
        documents: list[Session] = [
            {
                "name": s.name,
                "sensor": s.sensor,
                "building": s.provenance.label.building,
                "floor": s.provenance.label.floor,
                "floor_height_m": s.provenance.label.floor_height_m,
                "source": s.provenance.source,
                "digest": s.digest,
                "submaps": s.submaps,
                "resolution_m": s.resolution_m,
                "area_m2": s.area_m2,
                "path_m": s.path_m,
                "duration_s": s.duration_s,
                "scans": s.scans,
                "lossy": s.lossy,
                "consistency": consistency_document(s.consistency),
                "odometry": odometry_document(s.odometry),
                "precision": precision_document(s.precision),
                "warnings": list(s.warnings),
                "versions": dict(s.provenance.versions),
                "config": s.provenance.config.model_dump(mode="json"),
            }
            for s in sessions
        ]
        document: DbInfo = {"schema_version": 1, "database": where, "sessions": documents}
        console.print_json(document)
        return
    print(
        f"{where}: {counted(len(sessions), 'session')}, {counted(sum(s.submaps for s in sessions), 'submap')}"
    )
    for s in sessions:
        travel = f", {counted(s.scans, 'scan')}, {s.path_m:.1f} m in {s.duration_s:.0f} s" if s.scans else ""
        label = s.provenance.label
        where = f", {label}" if label.building or label.floor else ""
        line = (
            f"  {s.name} ({s.sensor}{where}): {counted(s.submaps, 'submap')}, {s.area_m2:.0f} m2 free{travel}"
        )
        if s.consistency is not None and s.consistency.bent:
            line += f", bent: contradicts itself along {s.consistency.contradicted:.0%} of the travel"
        if s.precision is not None and s.precision.loose:
            line += f", loosely tied: places up to +- {s.precision.worst_m:.1f} m"
        print(one_line(line))
