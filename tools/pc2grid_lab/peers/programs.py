"""Which programs are compared, which are installed, how the others are installed, and what they answer.

MapClosures and KISS-Matcher need other versions of libraries than pc2grid, so they live in a virtual
environment of their own. Open3D and pc2grid are in this one, MRPT's particle filter is a package of Debian.

What the answers are worth: right, wrong or none, each program with the threshold that is best for it.

pc2grid decides by itself whether it answers. The others give an answer and a score. Their threshold is chosen
on these very answers, which is more than a user could do: it is the one with the most right answers less the
wrong ones, in the own building and in another one. So the comparison is in favour of the others.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

from pc2grid.errors import Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.recordings.page import clopper_pearson
from pc2grid_lab.experiments.recordings.run import run
from pc2grid_lab.experiments.truth import apart
from pc2grid_lab.peers.particle_filter import PROGRAMS
from pc2grid_lab.peers.site import SiteQuery

PINS = ("map-closures==2.2.0", "kiss-matcher==1.0.2")
"""The versions that the parameters of `cloud_matchers` were chosen for."""
ENVIRONMENT = Path(sys.prefix) / "peers"
"""The virtual environment of these two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerKind:
    """A program that can be run.

    title : its name for readers. sensors : whose recordings are its input. file : of this folder, which asks
    it. apart : whether it is in `ENVIRONMENT`.
    """

    name: str
    title: str
    sensors: tuple[SensorKind, ...]
    file: str = "cloud_matchers.py"
    apart: bool = False

    @property
    def python(self) -> Path:
        """The interpreter of its environment."""
        return ENVIRONMENT / "bin" / "python" if self.apart else Path(sys.executable)


PEERS = (
    PeerKind(name="pc2grid", title="pc2grid", sensors=("laser", "lidar"), file="own.py"),
    PeerKind(
        name="particle-filter",
        title="MRPT, particle filter",
        sensors=("laser",),
        file="particle_filter.py",
    ),
    PeerKind(name="kiss-matcher", title="KISS-Matcher", sensors=("lidar",), apart=True),
    PeerKind(name="map-closures", title="MapClosures", sensors=("lidar",), apart=True),
    PeerKind(name="fpfh-ransac", title="Open3D, FPFH + RANSAC", sensors=("lidar",)),
)


class PeerFailed(Pc2GridError):
    """A program has not answered."""


def missing(kind: PeerKind) -> str | None:
    """The command that installs a program; None if it can be run."""
    if kind.name == "particle-filter" and not all(map(shutil.which, PROGRAMS)):
        return "apt-get install mrpt-apps"
    if kind.apart:
        imports = [str(kind.python), "-c", f"import {kind.name.replace('-', '_')}"]
        if not kind.python.exists() or subprocess.run(imports, check=False).returncode:
            return f"python -m venv {ENVIRONMENT} && {kind.python} -m pip install {' '.join(PINS)}"
    return None


def answers(kind: PeerKind, map_stem: Path, queries: Sequence[Path], kept: Path) -> list[PeerAnswer]:
    """What a program says to each query in a map. kept : the file of the answers; if it exists, it is read.

    Raises PeerFailed.
    """
    if not kept.exists():
        paths = (path.absolute() for path in (map_stem, kept, *queries))
        command = (kind.python, Path(__file__).with_name(kind.file), kind.name, *paths)
        done = run(tuple(map(str, command)))
        if not kept.exists():
            raise PeerFailed(f"{kind.name}: no answers to the queries of {queries[0].parent}: {done.error}")
    return [PeerAnswer(**fields) for fields in json.loads(kept.read_text())]


Place = Literal["covered", "uncovered", "elsewhere"]
"""covered: the map shows what the query saw last. uncovered: it does not. elsewhere: the map is of another
building."""

DECIDES = "pc2grid"
"""The program whose answers need no threshold."""
RIGHT_M, RIGHT_RAD = 0.3, math.radians(5.0)
"""The truth is another program's map, good to some centimetres. By hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerAnswer:
    """What a program says to one query.

    pose : x, y, yaw of the base in the map, None without an answer. score : how sure it is, larger is surer,
        in a unit of its own. cpu_s : processor time from the registered query to the pose. peak_mb : largest
        memory of the process so far, with the map and the libraries.
    """

    pose: tuple[float, float, float] | None
    score: float
    cpu_s: float
    peak_mb: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerTrial:
    """One answer with its truth.

    site : the building of the query. right : near the true pose; false without a pose and elsewhere.
    error_m : None without a pose and elsewhere.
    """

    peer: str
    site: str
    place: Place
    answer: PeerAnswer
    right: bool
    error_m: float | None

    @staticmethod
    def of(peer: str, site: str, map_: str, query: SiteQuery, answer: PeerAnswer) -> PeerTrial:
        """The answer to a query, judged. map_ : the building of the map."""
        place: Place = "elsewhere" if map_ != site else "covered" if query.covered else "uncovered"
        right, error_m = False, None
        if answer.pose is not None and place != "elsewhere":
            error_m, error_rad = apart(SE2(*query.pose), SE2(*answer.pose))
            right = error_m <= RIGHT_M and error_rad <= RIGHT_RAD
        return PeerTrial(peer=peer, site=site, place=place, answer=answer, right=right, error_m=error_m)

    def answered(self, threshold: float) -> bool:
        """Whether there is an answer at this threshold of the score."""
        return self.answer.pose is not None and self.answer.score >= threshold


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerCell:
    """One program in the queries of one building.

    threshold: of its score; null if it decides by itself, or never answers. right, wrong: of the covered
    queries; interval: 5 and 95 % of the share that is right, null without such queries. The others are wrong
    answers to the queries that have no right one. cpu_s, elsewhere_cpu_s: median of an answer in the own and
    in another building's map.
    """

    peer: str
    site: str
    threshold: float | None
    covered: int
    right: int
    wrong: int
    interval: tuple[float, float] | None
    uncovered: int
    uncovered_wrong: int
    elsewhere: int
    elsewhere_wrong: int
    median_error_m: float | None
    cpu_s: float | None
    elsewhere_cpu_s: float | None
    peak_mb: float


def best_threshold(trials: Sequence[PeerTrial]) -> float:
    """The threshold with the most right answers less the wrong ones; of several the highest.

    Infinite, which is never to answer, if wrong answers outnumber the right ones at every threshold.
    """

    def gain(threshold: float) -> int:
        return sum(1 if t.right else -1 for t in trials if t.answered(threshold))

    scores = {t.answer.score for t in trials if t.answer.pose is not None}
    return max([math.inf, *sorted(scores, reverse=True)], key=gain)


def counted(trials: Sequence[PeerTrial]) -> list[PeerCell]:
    """A cell for each site and program, in the order of the trials. A program has one threshold for all."""
    thresholds = {
        name: -math.inf if name == DECIDES else best_threshold([t for t in trials if t.peer == name])
        for name in dict.fromkeys(t.peer for t in trials)
    }
    pairs = dict.fromkeys((t.site, t.peer) for t in trials)
    return [_cell([t for t in trials if (t.site, t.peer) == pair], thresholds[pair[1]]) for pair in pairs]


def _cell(trials: Sequence[PeerTrial], threshold: float) -> PeerCell:
    answered = [trial for trial in trials if trial.answered(threshold)]
    of_place = Counter(trial.place for trial in trials)
    wrong = Counter(trial.place for trial in answered if not trial.right)
    right = [trial for trial in answered if trial.right and trial.place == "covered"]
    covered = of_place["covered"]
    return PeerCell(
        peer=trials[0].peer,
        site=trials[0].site,
        threshold=threshold if math.isfinite(threshold) else None,
        covered=covered,
        right=len(right),
        wrong=wrong["covered"],
        interval=clopper_pearson(len(right), covered, 0.1) if covered else None,
        uncovered=of_place["uncovered"],
        uncovered_wrong=wrong["uncovered"],
        elsewhere=of_place["elsewhere"],
        elsewhere_wrong=wrong["elsewhere"],
        median_error_m=_median([t.error_m for t in right if t.error_m is not None]),
        cpu_s=_cpu_s(trials, elsewhere=False),
        elsewhere_cpu_s=_cpu_s(trials, elsewhere=True),
        peak_mb=max(t.answer.peak_mb for t in trials),
    )


def _cpu_s(trials: Sequence[PeerTrial], *, elsewhere: bool) -> float | None:
    return _median([t.answer.cpu_s for t in trials if (t.place == "elsewhere") is elsewhere])


def _median(values: Sequence[float]) -> float | None:
    return median(values) if values else None
