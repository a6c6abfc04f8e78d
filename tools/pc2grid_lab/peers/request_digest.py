"""A digest of all that a result depends on: a stored result is used again only if it is the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from pc2grid_lab.experiments.program import BACK, EXPERIMENTS, FRONT

PREPARES = (
    FRONT,
    EXPERIMENTS / "registered_session.py",
    EXPERIMENTS / "sensor_matrix.py",
    Path(__file__).with_name("site.py"),
)
"""The sources that maps and queries are made with."""

MATCHERS = Path(__file__).with_name("cloud_matchers.py")
"""What the processes of the programs that match clouds run."""

OWN = (
    FRONT,
    BACK,
    EXPERIMENTS / "registered_session.py",
    Path(__file__).with_name("own_process.py"),
    MATCHERS,
)
"""The sources that pc2grid's answers come from."""


def digest(*parts: Any) -> str:
    """Twelve hexadecimal digits of values that JSON can hold; for names of files."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]
