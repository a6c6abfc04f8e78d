"""Measure time and memory of the program: `make bench`.

A simulated lidar drives through an office, 10 m and 40 m far, and 8 m from another place. Printed are
processor times, with one thread, and peak memory: of `pc2grid convert` of the first two, also over bare
KISS-ICP; of describing a submap; and of a look-up of the third drive in the map of the second one. Those of
real recordings are in `examples/real.md`.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from pc2grid.io import open_log
from pc2grid.pipeline import follow
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_lab.experiments.recordings.children import Finished, pc2grid, python_module
from signature.database import SubmapDatabase, open_database
from signature.describe import describe
from signature.localization.localizer import Localizer
from signature.localization.map_index import MapIndex

Figure = tuple[str, float, str]
"""What was measured, how much, and its unit."""
_BARE = "pc2grid_lab.experiments.recordings.bare_kiss"
_TIMES = 5


def figures(folder: Path) -> Iterator[Figure]:
    """All figures. folder : for the recordings and the databases."""
    for name, length_m, seed in (("short", 10.0, 0), ("long", 40.0, 0), ("query", 8.0, 1)):
        config = SimulationConfig(length_m=length_m, seed=seed)
        simulate_session(folder / f"{name}.mcap", sensor="lidar", config=config)
    yield from _converting(folder)
    with open_database(folder / "long.submaps") as database:
        yield from _describing(database)
        yield from _looking_up(database, folder / "query.mcap")


def _converting(folder: Path) -> Iterator[Figure]:
    for name in ("short", "long"):
        log = folder / f"{name}.mcap"
        made = _done(pc2grid("convert", log, "-o", folder / f"{name}.submaps", "--json"))
        bare = _done(python_module(_BARE, log))
        (session,) = made.document["sessions"]
        what = f"convert of {session['path_m']:.0f} m, {session['scans']} scans"
        yield f"{what}: a scan", 1e3 * made.cpu_s / session["scans"], "ms"
        yield f"{what}: over bare KISS-ICP", made.cpu_s / bare.document["cpu_s"], "x"
        yield f"{what}: peak memory", made.peak_mb, "MB"


def _describing(database: SubmapDatabase) -> Iterator[Figure]:
    (info,) = database.sessions()
    config = database.config().signature
    taken = [_cpu_ms(partial(describe, submap, config)) for submap in database.submaps(info.name)]
    yield f"describe a submap, median of {len(taken)}", statistics.median(taken), "ms"


def _looking_up(database: SubmapDatabase, log: Path) -> Iterator[Figure]:
    config = database.config()
    localizer = Localizer(MapIndex.of(database, config))
    with open_log(log) as opened:
        for registered, planar_scan in follow(opened.scans(), config):
            localizer.add(registered, planar_scan)
    status = localizer.answer().status
    taken = [_cpu_ms(partial(localizer.search, localizer.query)) for _ in range(_TIMES)]
    yield f"look up 8 m and decide ({status}), median of {_TIMES}", statistics.median(taken), "ms"


def _done(finished: Finished) -> Finished:
    """Raises RuntimeError for a command that failed."""
    if finished.failed:
        raise RuntimeError(finished.error)
    return finished


def _cpu_ms(action: Callable[[], object]) -> float:
    begin = time.process_time()
    action()
    return 1e3 * (time.process_time() - begin)


def main() -> None:
    """Print the figures as they are measured."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        for what, value, unit in figures(Path(folder)):
            print(f"{what:<50} {value:10.3g} {unit}", flush=True)


if __name__ == "__main__":
    main()
