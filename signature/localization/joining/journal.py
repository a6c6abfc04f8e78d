"""The comparisons of sessions so far, in a file: joining that was interrupted goes on from there.

The file has a line for each pair, which is written when the pair was compared. A pair is known by the content
of its two maps, so a session that was replaced is compared again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid._version import __version__
from pc2grid.arrays import F64
from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from signature.localization.joining.comparing import Compare, ToCompare
from signature.localization.joining.join import Join
from signature.localization.joining.pieces import Link
from signature.localization.posterior import Evidence

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

_HEAD = "compared by pc2grid"


class JoinJournal:
    """The joins of pairs of maps, by their keys (`key_of`), read from a file and appended to it."""

    def __init__(self, path: Path) -> None:
        """Go on with a file, or begin it. What another version of the program has compared is left out, and
        so is a last line that is not whole.

        Raises OutputError if the file is another one, or cannot be written.
        """
        self.path = path
        self._joins: dict[str, Join] = {}
        try:
            self._read()
        except OSError as error:
            raise OutputError(f"{path}: {error.strerror or error}") from error

    def _read(self) -> None:
        head = json.dumps({_HEAD: __version__}) + "\n"
        text = self.path.read_text(encoding="utf-8", errors="replace") if self.path.exists() else ""
        whole = text[: text.rfind("\n") + 1]
        if whole and _HEAD not in whole.partition("\n")[0]:
            raise OutputError(
                f"{self.path}: is no list of compared sessions", hint="remove it, or choose another --journal"
            )
        if not whole.startswith(head):
            whole = head
        for line in whole.splitlines()[1:]:
            content = json.loads(line)
            self._joins[content["pair"]] = _join(content["join"])
        if whole != text:
            self.path.write_text(whole, encoding="utf-8")

    def __len__(self) -> int:
        return len(self._joins)

    def find(self, key: str) -> Join | None:
        """The join of a pair; None if it was not compared."""
        return self._joins.get(key)

    def add(self, key: str, join: Join) -> None:
        """Keep the join of a pair. Raises OutputError if it cannot be written."""
        self._joins[key] = join
        content = {"pair": key, "join": asdict(join)}
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(content, default=_listed) + "\n")
        except OSError as error:
            raise OutputError(f"{self.path}: {error.strerror or error}") from error

    def remove(self) -> None:
        """Remove the file: what was compared is stored."""
        self.path.unlink(missing_ok=True)


def remembered(database: SubmapDatabase, journal: JoinJournal, compare: Compare) -> Compare:
    """What looks for a pair in a journal first, and adds to it what it compares."""

    def known_or_compared(pairs: Sequence[ToCompare]) -> Iterator[Join]:
        keys = [
            key_of(database.grid(pair.target), database.grid(pair.source), labelled=pair.labelled)
            for pair in pairs
        ]
        known = [journal.find(key) for key in keys]
        found = compare([pair for pair, join in zip(pairs, known, strict=True) if join is None])
        for key, join in zip(keys, known, strict=True):
            if join is None:
                join = next(found)
                journal.add(key, join)
            yield join

    return known_or_compared


def key_of(target: OccupancyGrid, source: OccupancyGrid, *, labelled: bool) -> str:
    """What a join of two maps depends on, as text."""
    return " ".join((_digest(target), _digest(source), "one label" if labelled else "no label"))


def _digest(grid: OccupancyGrid) -> str:
    head = f"{grid.cells.shape} {grid.resolution_m} {grid.origin_m} {grid.height_m}"
    return hashlib.blake2b(head.encode() + grid.cells.tobytes(), digest_size=16).hexdigest()


def _listed(array: F64) -> Any:
    return array.tolist()


def _join(content: dict[str, Any]) -> Join:
    """The join that `asdict` and JSON have made this of."""
    evidence = Evidence(**{**content["evidence"], "tail": tuple(content["evidence"]["tail"])})
    links = tuple(
        Link(
            center_m=tuple(link["center_m"]),
            T_target_source=SE2(**link["T_target_source"]),
            covariance=np.array(link["covariance"]),
        )
        for link in content["links"]
    )
    T = SE2(**content["T_target_source"])
    return Join(**{**content, "T_target_source": T, "evidence": evidence, "links": links})
