"""What a session map says of itself, as the JSON documents of `convert` and `db info` show it.

The types are in `json_schemas`, which loads all experiments; so it is imported for checking only.
"""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pc2grid import model
    from pc2grid_cli.json_schemas import Consistency, Converted, OdometryCheck, Precision
    from signature.database import Provenance


def session_document(session: model.SessionMap, origin: Provenance) -> Converted:
    """The session made of one input, as the JSON document describes it."""
    path_m = session.trajectory.path_m()
    grid = session.grid
    stamps = session.trajectory.stamps_ns
    report = session.report
    return {
        "session": session.session,
        "building": origin.label.building,
        "floor": origin.label.floor,
        "floor_height_m": origin.label.floor_height_m,
        "source": origin.source,
        "digest": origin.digest,
        "sensor": session.sensor,
        "scans": len(session.trajectory),
        "path_m": round(float(path_m[-1]), 2) if len(path_m) else 0.0,
        "duration_s": round(float(stamps[-1] - stamps[0]) / 1e9, 2) if len(stamps) else 0.0,
        "area_m2": round(grid.free_m2, 1),
        "submaps": len(session.submaps),
        "consistency": consistency_document(session.consistency),
        "odometry": odometry_document(session.odometry),
        "precision": precision_document(session.precision),
        "report": {
            "scans_read": report.scans_read,
            "points_dropped": report.points_dropped,
            "scans_skipped": report.scans_skipped,
            "bytes_lost": report.bytes_lost,
            "warnings": list(report.warnings),
            "lossy": report.lossy,
        },
    }


def consistency_document(consistency: model.Consistency | None) -> Consistency | None:
    """How well a map agrees with its own scans, as the documents show it."""
    if consistency is None:
        return None
    return {
        "hits_on_free": round(consistency.hits_on_free, 4),
        "contradicted": round(consistency.contradicted, 4),
        "bent": consistency.bent,
        "stretches": [
            {
                "from_ns": stretch.from_ns,
                "to_ns": stretch.to_ns,
                "x_m": round(stretch.x_m, 2),
                "y_m": round(stretch.y_m, 2),
                "length_m": round(stretch.length_m, 2),
                "share": round(stretch.share, 4),
            }
            for stretch in consistency.stretches
        ],
    }


def odometry_document(check: model.OdometryCheck | None) -> OdometryCheck | None:
    """How well odometry agrees with the scans, as the documents show it."""
    if check is None:
        return None
    return {
        "compared": check.compared,
        "overruled": check.overruled,
        "stretches": [
            {
                "from_ns": stretch.from_ns,
                "to_ns": stretch.to_ns,
                "distance_m": round(stretch.distance_m, 3),
                "turn_rad": round(stretch.turn_rad, 4),
            }
            for stretch in check.stretches
        ],
    }


def precision_document(precision: model.Precision | None) -> Precision | None:
    """How exactly the places of a map lie to each other, as the documents show it."""
    if precision is None:
        return None
    return {
        "median_m": round(float(statistics.median(precision.sigma_m or (0.0,))), 3),
        "worst_m": round(precision.worst_m, 3),
        "loose": [
            {
                "from_ns": stretch.from_ns,
                "to_ns": stretch.to_ns,
                "x_m": round(stretch.x_m, 2),
                "y_m": round(stretch.y_m, 2),
                "length_m": round(stretch.length_m, 2),
                "sigma_m": round(stretch.sigma_m, 3),
            }
            for stretch in precision.loose
        ],
    }
