"""Which program computed a stored result."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path


@cache
def program_digest() -> str:
    """Twelve hexadecimal digits that change with any source file of `pc2grid` and `signature`.

    The number of a release stays the same while the program is developed, so it does not tell whether a
    result that was computed before is still what the program would compute.

    >>> len(program_digest())
    12
    """
    root = Path(__file__).parents[2]
    found = hashlib.sha256()
    for package in ("pc2grid", "signature"):
        for file in sorted((root / package).rglob("*.py")):
            found.update(file.relative_to(root).as_posix().encode() + b"\0")
            found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:12]
