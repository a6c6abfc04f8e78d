"""What a session map says of itself, as the JSON documents of `convert` and `db info` show it.

The types are in `json_schemas`, which loads all experiments; so it is imported for checking only.
"""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pc2grid import model
    from pc2grid_cli.json_schemas import Consistency, OdometryCheck, Precision


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
