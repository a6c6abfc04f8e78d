"""Which real recordings are mapped, and which are located in which maps.

The files are those of the data folder that the README there describes. A row here is all that is known of a
recording: another recording is another row, and no other file changes. Some are simulated drives through the
real 3D scan of a building, with their true poses: nobody has recorded one building with a lidar, a depth
camera and a laser, so the first two are driven through what a laser has recorded in another year.

In a folder that the catalogue does not name, such as one's own, later parts of each recording are located in
the map of its beginning, and parts of each in the maps of the others; true poses lie beside them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from pc2grid import simulate
from pc2grid.errors import ConfigError, MapFileError, Pc2GridError
from pc2grid.io.recording import open_log
from pc2grid.model import SensorKind
from pc2grid.observer import TimeSpan
from pc2grid.simulate import Building, SimulationConfig, load_building, simulate_session
from pc2grid_lab.runner import digest_of_sources

PairKind = Literal[
    "later part",
    "fewer scans",
    "same recording",
    "other day",
    "other sensor",
    "published map",
    "disturbed",
    "elsewhere",
]
"""How the query of a pair differs from what its map was made from. "same recording": all of it is the map,
and the query may lack odometry. "disturbed": the map of another pair, of a `Recording.disturbed`.
"elsewhere": it is of another building."""
PAIR_KINDS: tuple[PairKind, ...] = get_args(PairKind)

Source = Literal["lidar", "depth", "laser", "map", "unknown"]
"""What a recording is of; "map": it is a map or a 3D scan; "unknown": it cannot be read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedDrive:
    """A simulated drive through the real 3D scan of a building. seed : of its way and of its obstacles."""

    sensor: SensorKind
    length_m: float
    seed: int


MAP_DRIVE = SimulatedDrive(sensor="lidar", length_m=150.0, seed=1000)
"""The drive that makes a map of a 3D scan. Map sessions and query sessions never share a seed: other clutter,
start, direction and noise."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording, or a map, as one run of `pc2grid convert` takes it.

    file : below the data folder. building : recordings of one building are one group of the statistics.
    drive : what is recorded in the 3D scan `file`; None: the file is the recording.
    options : of `convert` and of `relocalize`. every : only every nth of
        its scans is used. disturbed : seed of the numbers by which it is moved, see `write_disturbed`; 0: as
        it is. mapped : whether all of it becomes a map, which is a row of the page.
    truth : what its trajectory is compared with, relations or poses; None: there is none.
    same_place : numbers of scans between which the sensor came back to where it was.
    poses : true poses that place its windows, in one frame for all recordings that name the same `poses`.
        Both of a drive are what the simulation knows, in the frame of the scan.
    late_s : by how much its stamps are later than those of the true poses: some drivers stamp a scan at its
        end.
    of_base : whether these are poses of the base, not of the sensor.
    quick : whether it belongs to the quick form.
    """

    name: str
    file: str
    building: str
    sensor: Source
    _: KW_ONLY
    drive: SimulatedDrive | None = None
    options: tuple[str, ...] = ()
    every: int = 1
    disturbed: int = 0
    mapped: bool = True
    truth: str | None = None
    same_place: tuple[int, ...] = ()
    poses: str | None = None
    late_s: float = 0.0
    of_base: bool = False
    quick: bool = False

    @property
    def sensor_shown(self) -> str:
        """Return the sensor as the page names it."""
        return self.sensor if self.drive is None else f"driven {self.sensor}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """Where the base of a recording is in a map, if neither true poses nor answers that agree tell it.

    at_s : seconds after its first scan. x_m, y_m, yaw_deg : in the map. within_m : how far off a right answer
        may be there.
    by : how it was found, once: by hand, the recording's own map laid over the other one; or by the clouds of
        both, each registered in space to the other one.
    """

    at_s: float
    x_m: float
    y_m: float
    yaw_deg: float
    within_m: float
    by: Literal["hand", "clouds"] = "hand"


@dataclass(frozen=True, slots=True)
class Pair:
    """Windows of one recording that are located in the map of another, or of its own beginning.

    query, map : names of recordings. until_s : only so many seconds of `map` become the map; None: all of it.
    window_s : length of a window. windows : how many, evenly spread over the recording, in the map of its own
        beginning over what comes after it. within_s : seconds of the recording over which they are spread.
    placed : judges the answers, by the recording's own trajectory from there.
    """

    kind: PairKind
    query: str
    map: str
    window_s: float
    windows: int
    _: KW_ONLY
    until_s: float | None = None
    within_s: tuple[float, float] | None = None
    placed: Placed | None = None
    quick: bool = False

    @property
    def map_name(self) -> str:
        """Return the map, with the part of the recording that it is made from."""
        return beginning_of(self.map, self.until_s)


def beginning_of(name: str, until_s: float | None) -> str:
    """Return the name of the map of a recording, or of its first seconds."""
    return name if until_s is None else f"{name} 0..{until_s:g} s"


def _corrected(name: str, building: str, *, relations: bool = True, quick: bool = False) -> Recording:
    """Return a log of the SLAM benchmark, with gmapping's poses of its laser."""
    poses = f"laser/{name}_corrected.tum"
    truth = f"laser/{name}.relations" if relations else poses
    return Recording(name, f"laser/{name}.mcap", building, "laser", truth=truth, poses=poses, quick=quick)


def _posed(name: str, file: str, building: str, sensor: Source = "lidar", **known: Any) -> Recording:
    """Return a recording with the true poses of its sensor beside it."""
    poses = str(Path(file).with_suffix(".tum"))
    return Recording(name, file, building, sensor, truth=poses, poses=poses, **known)


def _without_odometry(recording: Recording, *, quick: bool = False) -> Recording:
    name, options = f"{recording.name} without odometry", ("--odometry", "none")
    return replace(recording, name=name, options=options, quick=quick)


def _with_control(recording: Recording) -> tuple[Recording, Recording]:
    """Return a recording whose scans are far apart, and the same without KISS-ICP, which must do worse."""
    without = ("--set", "registration.icp=none")
    name = f"{recording.name}, without KISS-ICP"
    return recording, replace(recording, name=name, options=recording.options + without, quick=False)


_SCAN, _JARVIS = "lidar/fr079_floor.ply", "laser/jarvis/circular_path_fast.mcap"


def _driven(name: str, drive: SimulatedDrive, *, mapped: bool = True) -> Recording:
    """Return a drive through the 3D scan of fr079's floor."""
    return Recording(
        name,
        _SCAN,
        "fr079",
        drive.sensor,
        drive=drive,
        mapped=mapped,
        truth=_SCAN,
        poses=_SCAN,
        of_base=True,
    )


_HALL = _posed("hall", "lidar/hall.mcap", "hall", quick=True)
_E1R = _posed("e1r_office_a", "lidar/e1r_office_a.mcap", "e1r office")
# A phone has its own visual-inertial odometry, which places its body.
_ROOM_A = _posed("room_a", "depth/room/room_a.mcap", "room", "depth", of_base=True)
_ROOM_B = _posed("room_b", "depth/room/room_b.mcap", "room", "depth", of_base=True, quick=True)
_CORRIDOR = _posed(
    "corridor", "depth/corridor_phone/corridor.mcap", "corridor", "depth", of_base=True, quick=True
)
_CSAIL = _corrected("csail", "csail", quick=True)

_AGAIN = SimulatedDrive(sensor="lidar", length_m=70.0, seed=1)

RECORDINGS: tuple[Recording, ...] = (
    _HALL,
    *_with_control(replace(_HALL, name="hall, every 2nd scan", every=2)),
    *_with_control(replace(_HALL, name="hall, every 3rd scan", every=3)),
    _E1R,
    *_with_control(replace(_E1R, name="e1r_office_a, every 4th scan", every=4)),
    _ROOM_A,
    _without_odometry(_ROOM_A),
    _ROOM_B,
    _without_odometry(_ROOM_B, quick=True),
    _posed("kitchen", "depth/kitchen.mcap", "kitchen", "depth"),
    _CORRIDOR,
    _without_odometry(_CORRIDOR),
    _corrected("fr079", "fr079"),
    _corrected("intel", "intel"),
    _CSAIL,
    _corrected("killian", "killian", relations=False),
    _without_odometry(_CSAIL),
    Recording("aces", "laser/aces_ros1.bag", "aces", "laser"),
    _posed("acapulco", "laser/sparse/acapulco.mcap", "acapulco", "laser"),
    _posed("belgioioso", "laser/sparse/belgioioso.mcap", "belgioioso", "laser"),
    _posed("orebro", "laser/sparse/orebro.mcap", "orebro", "laser"),
    Recording("workshop_1", "laser/workshop/workshop_1.mcap", "workshop", "laser"),
    Recording("workshop_1_changed", "laser/workshop/workshop_1_changed.mcap", "workshop", "laser"),
    Recording("wean 1", "laser/wean/robotdata1.mcap", "wean", "laser", quick=True),
    Recording("wean 2", "laser/wean/robotdata2.mcap", "wean", "laser"),
    Recording("wean 3", "laser/wean/robotdata3.mcap", "wean", "laser"),
    Recording("kidnap dec13 before", "laser/kidnap/dec13_before.mcap", "kidnap", "laser", quick=True),
    Recording("kidnap dec13 after", "laser/kidnap/dec13_after.mcap", "kidnap", "laser", quick=True),
    Recording("kidnap dec14 before", "laser/kidnap/dec14_before.mcap", "kidnap", "laser"),
    Recording("kidnap may9 before", "laser/kidnap/may9_before.mcap", "kidnap", "laser"),
    Recording("kidnap may9 after", "laser/kidnap/may9_after.mcap", "kidnap", "laser"),
    Recording("hallway", "laser/hallway/hallway.mcap", "hallway", "laser"),
    Recording("hallway2", "laser/hallway/hallway2.mcap", "hallway", "laser"),
    Recording(
        "small room", "laser/small_room/indoor_small_01.mcap", "small room", "laser", same_place=(0, 326, 649)
    ),
    Recording(
        "small room, 360 bins",
        "laser/small_room/indoor_small_01_360.mcap",
        "small room",
        "laser",
        same_place=(0, 326, 649),
    ),
    Recording("birmingham", "laser/birmingham/lgfloor2.mcap", "birmingham", "laser"),
    # One turn takes 0.125 s. Its headings fit the true ones best 0.12 s before its stamps.
    _posed(
        "jarvis nav",
        _JARVIS,
        "jarvis",
        "laser",
        options=("--topic", "/nav_scan"),
        of_base=True,
        late_s=0.12,
        quick=True,
    ),
    _posed(
        "jarvis safety",
        _JARVIS,
        "jarvis",
        "laser",
        options=("--topic", "/safety_scan"),
        of_base=True,
        quick=True,
    ),
    _driven("fr079 lidar", MAP_DRIVE),
    _driven("fr079 depth", replace(MAP_DRIVE, sensor="depth")),
    _driven("fr079 lidar again", _AGAIN, mapped=False),
    _driven("fr079 depth again", replace(_AGAIN, sensor="depth"), mapped=False),
    Recording("fr079_floor.ply", _SCAN, "fr079", "map"),
    Recording("fr079.yaml", "maps/fr079.yaml", "fr079", "map"),
    Recording("intel.yaml", "maps/intel.yaml", "intel", "map"),
    Recording("csail.yaml", "maps/csail.yaml", "csail", "map"),
    Recording("aces.yaml", "maps/aces.yaml", "aces", "map"),
    Recording("killian.yaml", "maps/killian.yaml", "killian", "map"),
    Recording("workshop_1.yaml", "maps/workshop_1.yaml", "workshop", "map", quick=True),
    Recording("wean.yaml", "laser/wean/wean.yaml", "wean", "map", quick=True),
    Recording("lgfloor.yaml", "laser/birmingham/lgfloor.yaml", "birmingham", "map"),
)
"""Everything that becomes a map or is asked in one, in the order of the page."""
_DISTURBED = (1, 2)
"""Seeds. All maps and answers of one take some five minutes of processor time."""
_CARRIED = ("e1r_office_a", "room_a", "room_b", "kitchen", "corridor")
RECORDINGS += tuple(
    replace(recording, name=f"{recording.name}, disturbed {seed}", disturbed=seed, quick=False)
    for recording in RECORDINGS
    for seed in _DISTURBED
    if recording.name in _CARRIED
)


PAIRS: tuple[Pair, ...] = (
    # Windows of 3 to 8 m of travel, or 20 s where the robot hardly moves.
    Pair("later part", "hall", "hall", 4.0, 4, until_s=10.0),
    Pair("fewer scans", "hall, every 2nd scan", "hall", 6.0, 6, quick=True),
    Pair("fewer scans", "hall, every 3rd scan", "hall", 9.0, 4),
    Pair("later part", "e1r_office_a", "e1r_office_a", 4.0, 4, until_s=10.0),
    Pair("later part", "kitchen", "kitchen", 2.0, 3, until_s=4.0),
    Pair("later part", "fr079", "fr079", 20.0, 10, until_s=600.0),
    Pair("later part", "intel", "intel", 25.0, 10, until_s=900.0),
    Pair("later part", "csail", "csail", 6.0, 10, until_s=250.0, quick=True),
    Pair("later part", "killian", "killian", 8.0, 10, until_s=900.0),
    Pair("later part", "aces", "aces", 15.0, 10, until_s=700.0),
    Pair("same recording", "corridor", "corridor", 8.0, 8, within_s=(4.0, 68.0), quick=True),
    Pair("same recording", "corridor without odometry", "corridor", 8.0, 8, within_s=(4.0, 68.0)),
    Pair("other day", "wean 1", "wean 2", 20.0, 8),
    Pair("other day", "wean 3", "wean 2", 20.0, 8),
    Pair("other day", "wean 2", "wean 1", 20.0, 8, quick=True),
    Pair("other day", "kidnap dec13 after", "kidnap dec13 before", 10.0, 8, quick=True),
    Pair("other day", "kidnap may9 after", "kidnap may9 before", 10.0, 8),
    Pair("other day", "kidnap may9 before", "kidnap dec13 before", 10.0, 8),
    Pair("other day", "kidnap dec14 before", "kidnap dec13 before", 10.0, 6),
    Pair("other day", "kidnap dec13 before", "kidnap may9 before", 10.0, 8),
    Pair("other day", "workshop_1_changed", "workshop_1", 4.0, 8),
    Pair("other day", "hallway", "hallway2", 8.0, 8),
    Pair("other day", "hallway2", "hallway", 6.0, 6),
    Pair(
        "other day",
        "room_b",
        "room_a",
        5.0,
        4,
        quick=True,
        placed=Placed(at_s=0.0, x_m=-0.0734, y_m=-0.0081, yaw_deg=0.518, within_m=0.3, by="clouds"),
    ),
    Pair(
        "other day",
        "room_a",
        "room_b",
        5.0,
        8,
        placed=Placed(at_s=0.0, x_m=0.0736, y_m=0.0076, yaw_deg=-0.590, within_m=0.3, by="clouds"),
    ),
    Pair("other sensor", "jarvis safety", "jarvis nav", 6.0, 6, quick=True),
    Pair("other sensor", "jarvis nav", "jarvis safety", 6.0, 6, quick=True),
    # The log is asked every 50 s, 7 m in the median.
    # Lidar and depth camera are driven through the real 3D scan of the floor; the laser and its log are real.
    Pair("other sensor", "fr079", "fr079 lidar", 40.0, 21, within_s=(0.0, 1040.0)),
    Pair("other sensor", "fr079", "fr079 depth", 40.0, 21, within_s=(0.0, 1040.0)),
    Pair("other sensor", "fr079", "fr079_floor.ply", 40.0, 21, within_s=(0.0, 1040.0)),
    Pair("other sensor", "fr079 lidar again", "fr079", 14.0, 10),
    Pair("other sensor", "fr079 lidar again", "fr079 depth", 14.0, 10),
    Pair("other sensor", "fr079 lidar again", "fr079_floor.ply", 14.0, 10),
    Pair("other sensor", "fr079 depth again", "fr079", 14.0, 10),
    Pair("other sensor", "fr079 depth again", "fr079 lidar", 14.0, 10),
    Pair("other sensor", "fr079 depth again", "fr079_floor.ply", 14.0, 10),
    # Drawn maps. In wean.yaml no three answers agree: along the hall, from a room's door to the end, it is
    # some 0.8 m longer than both drives.
    Pair(
        "published map",
        "wean 1",
        "wean.yaml",
        20.0,
        8,
        placed=Placed(at_s=30.0, x_m=46.4, y_m=9.2, yaw_deg=-3.6, within_m=1.0),
        quick=True,
    ),
    Pair(
        "published map",
        "wean 3",
        "wean.yaml",
        20.0,
        8,
        placed=Placed(at_s=30.0, x_m=43.5, y_m=9.4, yaw_deg=-3.8, within_m=1.0),
    ),
    Pair("published map", "birmingham", "lgfloor.yaml", 15.0, 10),
    Pair("published map", "workshop_1", "workshop_1.yaml", 3.0, 10, quick=True),
    Pair("published map", "workshop_1_changed", "workshop_1.yaml", 3.0, 10),
    Pair("published map", "fr079", "fr079.yaml", 20.0, 8),
    Pair("published map", "intel", "intel.yaml", 25.0, 8),
    Pair("published map", "csail", "csail.yaml", 6.0, 8),
    Pair("published map", "killian", "killian.yaml", 8.0, 6),
    Pair("published map", "aces", "aces.yaml", 15.0, 8),
    Pair("elsewhere", "csail", "fr079", 10.0, 4),
    Pair("elsewhere", "fr079", "intel", 20.0, 4),
    Pair("elsewhere", "intel", "aces", 25.0, 4),
    Pair("elsewhere", "wean 2", "kidnap dec13 before", 20.0, 4, quick=True),
    Pair("elsewhere", "kidnap dec13 before", "wean 2", 10.0, 4),
    Pair("elsewhere", "birmingham", "wean 2", 15.0, 4),
    Pair("elsewhere", "hall", "fr079", 6.0, 2),
    Pair("elsewhere", "room_b", "kitchen", 5.0, 2),
    Pair("elsewhere", "room_a", "hall", 5.0, 8),
    Pair("elsewhere", "e1r_office_a", "room_b", 4.0, 4),
    Pair("elsewhere", "jarvis nav", "room_a", 6.0, 2),
    # The height of a laser is not known, or is that of a robot; this map's is at 2.0 m.
    Pair("elsewhere", "fr079", "jarvis nav", 20.0, 4),
    Pair("elsewhere", "intel", "jarvis nav", 25.0, 4),
    Pair("elsewhere", "csail", "jarvis nav", 6.0, 4),
    Pair("elsewhere", "killian", "jarvis nav", 8.0, 4),
    Pair("elsewhere", "aces", "jarvis nav", 15.0, 4),
    Pair("elsewhere", "acapulco", "jarvis nav", 15.0, 4),
    Pair("elsewhere", "belgioioso", "jarvis nav", 15.0, 4),
    Pair("elsewhere", "orebro", "jarvis nav", 15.0, 4),
    Pair("elsewhere", "workshop_1", "jarvis nav", 4.0, 4),
    Pair("elsewhere", "wean 2", "jarvis nav", 20.0, 4),
    Pair("elsewhere", "kidnap dec13 before", "jarvis nav", 10.0, 4),
    Pair("elsewhere", "kidnap may9 before", "jarvis nav", 10.0, 4),
    Pair("elsewhere", "hallway", "jarvis nav", 8.0, 4),
    Pair("elsewhere", "small room, 360 bins", "jarvis nav", 10.0, 4),
    Pair("elsewhere", "birmingham", "jarvis nav", 15.0, 4),
)
"""All pairs, in the order of the page."""
PAIRS += tuple(
    replace(
        pair,
        kind="disturbed",
        map=f"{pair.map}, disturbed {seed}",
        quick=pair.quick and seed == _DISTURBED[0],
    )
    for pair in PAIRS
    for seed in _DISTURBED
    if pair.map in _CARRIED and pair.query in _CARRIED and pair.kind != "elsewhere"
)


UNTIL_S = {
    pair.query: pair.until_s for pair in PAIRS if pair.kind == "later part" and pair.until_s is not None
}
"""Seconds of a recording that become the map in which its later parts are located."""

NOT_ALIKE = (("fr079", "wean.yaml"),)
"""Maps of two buildings that were joined once: walls of one are drawn .3 m thick."""
FOREIGN_MAPS = 2
"""Each map is compared with so many of other buildings, those that come next on the page."""


def evenly_spaced(first_s: float, last_s: float, count: int, duration_s: float) -> tuple[TimeSpan, ...]:
    """Return `count` parts of `duration_s`, evenly distributed over the time from `first_s` to `last_s`."""
    starts_s = np.linspace(first_s, max(last_s - duration_s, first_s), count)
    return tuple(TimeSpan(float(start_s), duration_s) for start_s in starts_s)


_QUICK_EVERY = 2
"""The quick form asks for every second window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Catalogue:
    """The recordings and pairs of one run.

    recordings : by name, in the order of the page. mapped : those whose map is a row of the page; the others
        are only needed for pairs. pairs : in the order of the page. quick : of each pair every second window.
    """

    recordings: dict[str, Recording]
    mapped: tuple[Recording, ...]
    pairs: tuple[Pair, ...]
    quick: bool = False

    @staticmethod
    def in_folder(data: Path) -> tuple[tuple[Recording, ...], tuple[Pair, ...]]:
        """Return the recordings and pairs of this file, if the folder has one of the recordings; else
        nothing."""
        if any((data / recording.file).exists() for recording in RECORDINGS):
            return RECORDINGS, PAIRS
        return (), ()

    @staticmethod
    def of(
        recordings: Sequence[Recording] = RECORDINGS,
        pairs: Sequence[Pair] = PAIRS,
        *,
        only: str | None = None,
        quick: bool = False,
    ) -> Catalogue:
        """Return what the quick form holds, or all; of it what `only` names.

        recordings, pairs : of which. only : a pattern of the shell for names of recordings, buildings or
            kinds of pairs.
        """

        def wanted(*names: str) -> bool:
            return any(fnmatch(name, only or "*") for name in names)

        known = {recording.name: recording for recording in recordings}
        return Catalogue(
            recordings=known,
            mapped=tuple(
                r
                for r in recordings
                if r.mapped and (r.quick or not quick) and wanted(r.name, r.building, r.sensor)
            ),
            pairs=tuple(
                p
                for p in pairs
                if (p.quick or not quick)
                and wanted(p.query, p.map, p.kind, known[p.query].building, known[p.map].building)
            ),
            quick=quick,
        )

    def building(self, name: str) -> str:
        """Return the building of a recording or map."""
        return self.recordings[name].building

    @property
    def joins(self) -> tuple[tuple[str, str], ...]:
        """Return the maps that are compared to be joined, in pairs: all of one building, and some of others.

        Maps of recordings as they are: not thinned nor disturbed, and with their odometry.
        """
        maps = [r for r in self.mapped if r.every == 1 and not r.disturbed and "--odometry" not in r.options]
        pairs: list[tuple[Recording, ...]] = []
        for k, one in enumerate(maps):
            after = [*maps[k + 1 :], *maps[:k]]
            foreign = [r for r in after if r.building != one.building][:FOREIGN_MAPS]
            pairs += [
                tuple(sorted((one, other), key=maps.index))
                for other in after
                if other.building == one.building or other in foreign or (one.name, other.name) in NOT_ALIKE
            ]
        return tuple((a.name, b.name) for a, b in dict.fromkeys(pairs))

    def windows(self, pair: Pair, length_s: float) -> list[tuple[int, TimeSpan]]:
        """Return the windows of a pair with their numbers, in a recording of `length_s`.

        They begin at whole milliseconds, as commands are told: else the last scan might be another one.
        """
        first_s, last_s = pair.within_s or (0.0, length_s)
        first_s = first_s if pair.until_s is None else pair.until_s
        spans = evenly_spaced(first_s, last_s, pair.windows, pair.window_s)
        numbered = [(k, replace(span, start_s=round(span.start_s, 3))) for k, span in enumerate(spans)]
        return numbered[:: _QUICK_EVERY if self.quick else 1]


_SUFFIXES = (".mcap", ".bag", ".db3")
_MAPPED_S, _WINDOW_S, _WINDOWS = 600.0, 20.0, 10
"""The beginning, and windows: at most so long, and so many. As in the catalogue."""


def beginning_s(length_s: float) -> float:
    """Return how much of a recording becomes the map in which the rest is located."""
    return round(min(_MAPPED_S, length_s / 2), 1)


def own_recordings(data: Path, *, without: Path, of_base: bool) -> tuple[list[Recording], list[Pair]]:
    """Return the recordings of a folder that the catalogue does not name, and which are asked in which maps.

    Each is asked in the map of its own beginning, and in those of the others beside it: Tuesday in Monday's.

    without : a folder that is left out. of_base : whether the poses in `NAME.tum` are of the base, not of the
        sensor. Raises ConfigError if the folder is not there.
    """
    if not data.is_dir():
        raise ConfigError(f"{data}: no such folder", hint="give the folder of recordings")
    named = {recording.file for recording in RECORDINGS}
    lengths_s = dict(
        _row(data, file, of_base)
        for file in _recordings(data, without.resolve())
        if file.relative_to(data).as_posix() not in named
    )
    pairs = []
    for query, length_s in lengths_s.items():
        if length_s is None:
            continue
        until_s = beginning_s(length_s)
        pairs.append(_asked("later part", query, query, length_s - until_s, until_s))
        pairs += [
            _asked("other day", query, other, length_s)
            for other, other_s in lengths_s.items()
            if other_s is not None and other != query and other.building == query.building
        ]
    return list(lengths_s), pairs


def state_of(data: Path, recordings: Sequence[Recording]) -> str:
    """Return digits that change when a file of one of these recordings is written; empty without
    recordings."""
    found = hashlib.sha256()
    for recording in recordings:
        path = data / recording.file
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            about = file.stat()
            found.update(f"{file} {about.st_size} {about.st_mtime_ns}\n".encode())
    return found.hexdigest()[:8] if recordings else ""


def _recordings(folder: Path, without: Path) -> Iterator[Path]:
    """Yield the recordings in a folder and in those below it. One of rosbag2, which is a folder, is one."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and path.resolve() != without:
            if (path / "metadata.yaml").exists():
                yield path
            else:
                yield from _recordings(path, without)
        elif path.suffix in _SUFFIXES:
            yield path


def _row(data: Path, file: Path, of_base: bool) -> tuple[Recording, float | None]:
    """Return a recording, and how long it lasts, seconds; None if it cannot be read."""
    name = file.relative_to(data)
    beside = {suffix: name.with_suffix(suffix).as_posix() for suffix in (".tum", ".relations")}
    there = [beside[suffix] for suffix in beside if file.with_suffix(suffix).exists()]
    sensor: Source = "unknown"  # if it cannot be read: `convert` says why, in the row of its map
    length_s = None
    with suppress(Pc2GridError, OSError), open_log(file) as log:
        sensor = log.choose().sensor
        length_s = (log.info.end_ns - log.info.start_ns) * 1e-9
    recording = Recording(
        name=name.as_posix(),
        file=name.as_posix(),
        building=name.parent.as_posix() if name.parent.name else data.resolve().name,
        sensor=sensor,
        truth=there[-1] if there else None,
        poses=beside[".tum"] if beside[".tum"] in there else None,
        of_base=of_base,
        quick=True,
    )
    return recording, length_s


def _asked(
    kind: PairKind, query: Recording, map_: Recording, asked_s: float, until_s: float | None = None
) -> Pair:
    """Return windows of the last `asked_s` of a recording, or of all of it. until_s : see `Pair`."""
    window_s = round(min(_WINDOW_S, asked_s / 2), 1)
    windows = min(_WINDOWS, round(2 * asked_s / max(window_s, 0.1)))
    return Pair(kind, query.name, map_.name, window_s, windows, until_s=until_s, quick=True)


_CLUTTER, _RATE_HZ, _COLUMNS = 15, 5.0, 720
"""Things that are in the way, others in each drive; scans a second; columns in a turn of the lidar, as one at
10 Hz sends them: fewer scans save time, not detail. Chosen by hand."""


def write_drive(scan: Path, target: Path, drive: SimulatedDrive) -> None:
    """Drive through a 3D scan: write the MCAP file `target`, and its true poses beside it as `.tum`.

    Raises MapFileError if the scan cannot be read or is a plan, ConfigError if there is no room in it.
    """
    building = load_building(scan)
    if not isinstance(building, Building):
        raise MapFileError(f"{scan}: a plan, not a 3D scan", hint="a drive needs a cloud or a mesh")
    config = drive_config(drive.length_m, drive.seed)
    simulate_session(target, sensor=drive.sensor, grid=building, config=config, overwrite=True)


def drive_config(length_m: float, seed: int, start_m: tuple[float, float] | None = None) -> SimulationConfig:
    """Return the configuration of one drive."""
    return SimulationConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": _CLUTTER,
            "start_m": start_m,
            "lidar": {"rate_hz": _RATE_HZ, "columns": _COLUMNS},
            "depth": {"rate_hz": _RATE_HZ},
        }
    )


@cache
def digest_of_drive(scan: Path, drive: SimulatedDrive) -> str:
    """Return twelve hexadecimal digits that change with the scan, the drive and the simulation."""
    sources = digest_of_sources((Path(simulate.__file__).parent, Path(__file__)))
    shown = hashlib.sha256(f"{sources} {drive}".encode() + scan.read_bytes())
    return shown.hexdigest()[:12]
