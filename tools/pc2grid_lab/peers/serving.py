"""What the processes of the programs share: they locate each query and write all answers to one file.

    python PROGRAM.py NAME MAP_STEM ANSWERS.json QUERY_STEM...

This file imports nothing of pc2grid, because the environment of the other programs does not contain it.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

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
        begin_s = time.process_time()
        found = locate(query)
        cpu_s = time.process_time() - begin_s
        T, score = (None, 0.0) if found is None else found
        pose = None if T is None else [T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]
        answers.append({"pose": pose, "score": score, "cpu_s": cpu_s, "peak_mb": _peak_mb()})
    Path(out).write_text(json.dumps(answers))


def _peak_mb() -> float:
    """Largest resident memory of this process so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1000.0 for line in lines if line.startswith("VmHWM"))
