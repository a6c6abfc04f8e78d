"""A peer in a process of its own, which locates one query after the other.

The process gets its name and the stem of the map as arguments, and the stem of a query in each line of its
standard input; to each it writes one line of JSON, the fields of `PeerAnswer`.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from pc2grid.errors import Pc2GridError
from pc2grid_lab.experiments.program import EXPERIMENTS, FRONT

_PACKAGES = [str(FRONT.parent), str(EXPERIMENTS.parents[1])]
"""Folders in which the processes find the packages."""
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Processor time must not depend on the number of cores."""


def _inherited() -> list[str]:
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerAnswer:
    """What a peer says to one query.

    pose : x, y, yaw of the base in the map, None without an answer. score : how sure the peer is, larger is
        surer, in a unit of its own. cpu_s : processor time from the registered query to the pose.
    peak_mb : largest memory of the process so far, with the map and the libraries.
    """

    pose: tuple[float, float, float] | None
    score: float
    cpu_s: float
    peak_mb: float

    @staticmethod
    def of(fields: dict[str, Any]) -> PeerAnswer:
        """From the fields as JSON holds them."""
        pose = fields["pose"]
        return PeerAnswer(**{**fields, "pose": None if pose is None else tuple(pose)})


class Peer(Protocol):
    """A program that locates queries in one map."""

    def locate(self, query: Path) -> PeerAnswer:
        """The answer to a query, given by the stem of its files."""
        ...

    def close(self) -> None:
        """End the program."""
        ...


class PeerFailed(Pc2GridError):
    """A peer has ended or printed something else than an answer."""


class PeerProcess:
    """A peer that reads stems of queries and writes answers. Use as a context manager, or `close` it."""

    def __init__(self, command: Sequence[str | Path], name: str, map_stem: Path) -> None:
        self._name = name
        self._process = subprocess.Popen(
            [*map(str, command), name, str(map_stem)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": os.pathsep.join([*_PACKAGES, *_inherited()])},
        )

    def locate(self, query: Path) -> PeerAnswer:
        """Raises PeerFailed if no answer comes."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print(query, file=self._process.stdin, flush=True)
            fields = json.loads(self._process.stdout.readline())
        except (BrokenPipeError, ValueError) as error:
            raise PeerFailed(f"{self._name}: no answer to {query}") from error
        return PeerAnswer.of(fields)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()

    def __enter__(self) -> PeerProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
