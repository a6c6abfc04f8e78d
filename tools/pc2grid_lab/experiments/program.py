"""Which program computed a stored result.

The number of a release stays the same while the program is developed, so it does not tell whether a result
that was computed before is still what the program would compute. Its sources do.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pc2grid
import signature

FRONT, BACK = Path(pc2grid.__file__).parent, Path(signature.__file__).parent
EXPERIMENTS = Path(__file__).parent
"""Folders of sources."""


@cache
def program_digest() -> str:
    """Twelve hexadecimal digits that change with any source file of these packages and experiments.

    >>> len(program_digest())
    12
    """
    return digest_of_sources((FRONT, BACK, EXPERIMENTS))


def digest_of_sources(paths: Iterable[Path]) -> str:
    """The same of these files, and of the Python files in these folders."""
    found = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            found.update(file.name.encode() + b"\0")
            found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:12]
