"""Recordings that have what users report: the folder `field` beside the real data (PC2GRID_DATA)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[2] / ".." / "shared" / "data"))


def field_log(name: str) -> Path:
    """The recording of this name; the test that asks for it is skipped where it is not there."""
    path = DATA.resolve().parent / "field" / f"{name}.mcap"
    if not path.is_file():
        pytest.skip(f"{path}: no such recording here; PC2GRID_DATA names the folder beside it")
    return path
