"""The description of a session map in the JSON documents of `convert` and `db info`."""

from __future__ import annotations

import statistics

from pc2grid.model import Precision, SessionMap
from pc2grid_cli.json_schemas import Converted, JoinedSession, PrecisionSummary
from signature.bend import largest_m
from signature.database import Provenance
from signature.database.protocol import BuildingFrame


def session_document(session: SessionMap, origin: Provenance) -> Converted:
    """The session made of one input, as the JSON document describes it."""
    report = session.report
    return {
        "session": session.session,
        "building": origin.label.building,
        "floor": origin.label.floor,
        "source": origin.source,
        "digest": origin.digest,
        "sensor": session.sensor,
        "scans": len(session.trajectory),
        "path_m": round(session.trajectory.length_m, 2),
        "duration_s": round(session.trajectory.duration_s, 2),
        "area_m2": round(session.grid.free_m2, 1),
        "submaps": len(session.submaps),
        "consistency": session.consistency,
        "odometry": session.odometry,
        "precision": precision_summary(session.precision),
        "report": {
            "scans_read": report.scans_read,
            "points_dropped": report.points_dropped,
            "scans_skipped": report.scans_skipped,
            "bytes_lost": report.bytes_lost,
            "warnings": list(report.warnings),
            "lossy": report.lossy,
        },
    }


def joined_document(session: str, frame: BuildingFrame) -> JoinedSession:
    """Where a session lies in its building, as `convert` and `db join` describe it."""
    T = frame.T_building_session
    return {
        "session": session,
        "frame": frame.name,
        "T_building_session": {"x": T.x, "y": T.y, "yaw": T.yaw},
        "covariance": [list(row) for row in frame.covariance],
        "bent_m": round(largest_m(frame.bend), 3),
    }


def precision_summary(precision: Precision | None) -> PrecisionSummary | None:
    """How exactly the places of a map lie to each other, in a few numbers."""
    if precision is None:
        return None
    return {
        "median_m": float(statistics.median(precision.sigma_m or (0.0,))),
        "worst_m": precision.worst_m,
        "loose": list(precision.loose),
    }
