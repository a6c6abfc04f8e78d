"""Which programs are compared, which are installed, how the others are installed, and what they answer.

MapClosures and KISS-Matcher need other versions of libraries than pc2grid, so they live in a virtual
environment of their own. Open3D and pc2grid are in this one, MRPT's particle filter is a package of Debian.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pc2grid.errors import Pc2GridError
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.recordings.children import run
from pc2grid_lab.peers.outcome import PeerAnswer
from pc2grid_lab.peers.particle_filter import PROGRAMS

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
