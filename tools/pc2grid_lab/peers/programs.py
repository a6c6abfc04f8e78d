"""Which programs are compared, which are installed, how the others are installed, and what they answer.

MapClosures and KISS-Matcher need other versions of libraries than pc2grid, so they live in a virtual
environment of their own. Open3D and pc2grid are in this one, MRPT's particle filter is a package of Debian.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pc2grid.errors import Pc2GridError
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.recordings.children import ROOT
from pc2grid_lab.peers.outcome import PeerAnswer
from pc2grid_lab.peers.particle_filter import PROGRAMS, ParticleFilter

PINS = ("map-closures==2.2.0", "kiss-matcher==1.0.2")
"""The versions that the parameters of `cloud_matchers` were chosen for."""
ENVIRONMENT = Path(sys.prefix) / "peers"
"""The virtual environment of these two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerKind:
    """A program that can be run. title : its name for readers. sensors : whose recordings are its input."""

    name: str
    title: str
    sensors: tuple[SensorKind, ...]


PEERS = (
    PeerKind(name="pc2grid", title="pc2grid", sensors=("laser", "lidar")),
    PeerKind(name="particle-filter", title="MRPT, particle filter", sensors=("laser",)),
    PeerKind(name="kiss-matcher", title="KISS-Matcher", sensors=("lidar",)),
    PeerKind(name="map-closures", title="MapClosures", sensors=("lidar",)),
    PeerKind(name="fpfh-ransac", title="Open3D, FPFH + RANSAC", sensors=("lidar",)),
)


class PeerFailed(Pc2GridError):
    """A program has not answered."""


def missing(kind: PeerKind) -> str | None:
    """The command that installs a program; None if it can be run."""
    if kind.name == "particle-filter" and not all(map(shutil.which, PROGRAMS)):
        return "apt-get install mrpt-apps"
    module, python = kind.name.replace("-", "_"), ENVIRONMENT / "bin" / "python"
    if kind.name in ("kiss-matcher", "map-closures") and not (
        python.exists() and not subprocess.run([python, "-c", f"import {module}"], check=False).returncode
    ):
        return f"python -m venv {ENVIRONMENT} && {python} -m pip install {' '.join(PINS)}"
    return None


def answers(kind: PeerKind, map_stem: Path, queries: Sequence[Path], kept: Path) -> list[PeerAnswer]:
    """What a program says to each query in a map. kept : the file of the answers; if it exists, it is read.

    Raises PeerFailed.
    """
    if kind.name == "particle-filter" and not kept.exists():
        program = ParticleFilter(map_stem)
        kept.write_text(json.dumps([program.locate(query) for query in queries]))
    elif not kept.exists():
        command: list[str | Path] = [sys.executable, "-m", "pc2grid_lab.peers.own"]
        if kind.name != "pc2grid":
            in_here = kind.name == "fpfh-ransac"
            python = Path(sys.executable) if in_here else ENVIRONMENT / "bin" / "python"
            command = [python, Path(__file__).with_name("cloud_matchers.py")]
        paths = [str(ROOT), str(ROOT / "tools"), os.environ.get("PYTHONPATH", "")]
        # Processor time must not depend on the number of cores.
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        subprocess.run(
            [*map(str, (*command, kind.name, map_stem, kept, *queries))],
            stdout=subprocess.DEVNULL,
            env={**os.environ, **one_thread, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
            check=False,
        )
    if not kept.exists():
        raise PeerFailed(f"{kind.name}: no answers to the queries of {queries[0].parent}")
    return [PeerAnswer(**fields) for fields in json.loads(kept.read_text())]
