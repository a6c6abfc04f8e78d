"""What the processes of the programs share: they locate each query and write all answers to one file.

    python PROGRAM.py NAME MAP_STEM ANSWERS.json QUERY_STEM...

This file imports nothing of pc2grid, because the environment of the other programs does not contain it.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Found = tuple[Matrix, float] | None
"""T_map_base (4, 4) and a score, or None."""


def serve(locator: Callable[[str, str], Callable[[str], Found]], *, compiles: bool = False) -> None:
    """Answer the queries of the command line.

    locator : what locates the queries, of the name of the program and the stem of the map. compiles : the
    first query is located twice.
    """
    name, map_stem, out, *queries = sys.argv[1:]
    locate = locator(name, map_stem)
    if compiles and queries:
        locate(queries[0])
    answers = []
    for query in queries:
        begin_s = _cpu_s()
        found = locate(query)
        cpu_s = _cpu_s() - begin_s
        T, score = (None, 0.0) if found is None else found
        pose = None if T is None else [T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]
        answers.append({"pose": pose, "score": score, "cpu_s": cpu_s, "peak_mb": _peak_mb()})
    Path(out).write_text(json.dumps(answers))


def _cpu_s() -> float:
    """Processor time of this process, and of those that it has started and that have ended."""
    used = map(getrusage, (RUSAGE_SELF, RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def _peak_mb() -> float:
    """Largest resident memory so far of this process or of one that it has started."""
    lines = Path("/proc/self/status").read_text().splitlines()
    own_kb = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return max(own_kb, getrusage(RUSAGE_CHILDREN).ru_maxrss) / 1000.0
