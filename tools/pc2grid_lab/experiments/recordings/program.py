"""Which program made the results of a run."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

import pc2grid
import pc2grid_cli
from pc2grid_lab.experiments.program import BACK, FRONT, digest_of_sources
from pc2grid_lab.experiments.recordings.children import ROOT


@cache
def digest() -> str:
    """Twelve hexadecimal digits that change with any source file of the product and with the catalogue."""
    cli = Path(pc2grid_cli.__file__).parent
    return digest_of_sources((FRONT, BACK, cli, Path(__file__).with_name("catalogue.py")))


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
