"""Judged answers for tests."""

from __future__ import annotations

from typing import Any

from pc2grid_lab.experiments.trial import Trial


def trial(**changes: Any) -> Trial:
    """A depth camera located rightly in a lidar's map after 10 m, with some fields changed."""
    fields: dict[str, Any] = {
        "building": "a",
        "map_sensor": "lidar",
        "query_sensor": "depth",
        "seed": 0,
        "travel_m": 10.0,
        "in_building": True,
        "mapped": 1.0,
        "status": "located",
        "confidence": 0.95,
        "right": True,
        "error_m": 0.05,
        "rank": 0,
        "look_up_ms": 10.0,
    }
    return Trial(**{**fields, **changes})
