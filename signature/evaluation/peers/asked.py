"""What was asked, as a digest: what was made or answered before is used again only if it is the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[3]

PREPARES = (
    _ROOT / "pc2grid",
    _ROOT / "signature" / "evaluation" / "registered_session.py",
    _ROOT / "signature" / "evaluation" / "sensor_matrix.py",
    Path(__file__).with_name("site.py"),
)
"""The sources that maps and queries are made with."""

MATCHERS = Path(__file__).with_name("cloud_matchers.py")
"""What the processes of the programs that match clouds run."""

OWN = (
    _ROOT / "pc2grid",
    *(path for path in sorted((_ROOT / "signature").iterdir()) if path.name != "evaluation"),
    _ROOT / "signature" / "evaluation" / "registered_session.py",
    Path(__file__).with_name("own_process.py"),
    MATCHERS,
)
"""The sources that pc2grid's answers come from."""


def digest(*parts: Any) -> str:
    """Twelve hexadecimal digits of values that JSON can hold; for names of files."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def digest_of_sources(paths: Iterable[Path]) -> str:
    """The digest of these files, and of the Python files in these folders."""
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    return digest(*([file.name, hashlib.sha256(file.read_bytes()).hexdigest()] for file in files))
