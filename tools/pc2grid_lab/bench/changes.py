"""How many of the changes in a building `pc2grid diff` finds, and how many of what it reports are changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pc2grid_lab.bench.measure import Row
from pc2grid_lab.experiments.rearranged import ChangeCount, count_changes
from signature.config import Config

_FIRST, _COUNT, _QUICK = 8, 12, 2
"""Seeds of the offices. The first four were used to choose `ChangeParameters`, the next four to try it."""


def found_changes(folder: Path, quick: bool) -> Iterator[Row]:
    """Simulated offices, each mapped twice by a laser, with doors and furniture changed in between."""
    counts = [count_changes(_FIRST + k, Config()) for k in range(_QUICK if quick else _COUNT)]
    total = sum(counts, ChangeCount())
    joined = sum(count.joined for count in counts)
    note = f"{joined} of {len(counts)} pairs of sessions joined"
    yield Row(
        what="diff: precision of the patches that are reported",
        measured=total.right / max(total.reported, 1),
        unit=f"of {total.reported}",
        goal=0.9,
        at_least=True,
        note=note,
    )
    yield Row(
        what="diff: recall of the doors and things that both sessions saw",
        measured=total.found / max(total.seen, 1),
        unit=f"of {total.seen}",
        goal=0.8,
        at_least=True,
        note=note,
    )
