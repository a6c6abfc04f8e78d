"""Which program computed a stored result.

The number of a release stays the same while the program is developed, so it does not tell whether a result
that was computed before is still what the program would compute. Its sources do.
"""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pc2grid
import pc2grid_cli
import signature

FRONT, BACK = Path(pc2grid.__file__).parent, Path(signature.__file__).parent
LABORATORY = Path(__file__).parents[1]
"""Folders of sources."""
ROOT = LABORATORY.parents[1]
"""The folder of the packages; `tools/` is below it."""


def digest_of_sources(paths: Iterable[Path]) -> str:
    """Twelve hexadecimal digits that change with any of these files, and the Python files in these folders.

    >>> len(digest_of_sources([FRONT]))
    12
    """
    found = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            found.update(file.name.encode() + b"\0")
            found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:12]


@cache
def digest_of_product() -> str:
    """The same of every source file of the product, and of the catalogue of real recordings."""
    cli, catalogue = Path(pc2grid_cli.__file__).parent, LABORATORY / "experiments/recordings/catalogue.py"
    return digest_of_sources((FRONT, BACK, cli, catalogue))


def commit() -> str:
    """The commit of the sources, "-dirty" if they differ from it; outside of a repository the version."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--exclude=*"],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip() or pc2grid.__version__
