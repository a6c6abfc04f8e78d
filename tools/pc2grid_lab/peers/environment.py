"""Which peers there are, which are installed, and how the others are installed.

MapClosures and KISS-Matcher need other versions of libraries than pc2grid, so they live in a virtual
environment of their own. Open3D and pc2grid are in this one, MRPT's particle filter is a package of Debian.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from pc2grid.errors import Pc2GridError
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.program import digest_of_sources
from pc2grid_lab.peers import particle_filter
from pc2grid_lab.peers.particle_filter import PROGRAMS, ParticleFilter
from pc2grid_lab.peers.peer_process import Peer, PeerProcess
from pc2grid_lab.peers.request_digest import MATCHERS, OWN, digest

PINS = ("map-closures==2.2.0", "kiss-matcher==1.0.2")
"""The versions that the parameters of `cloud_matchers` were chosen for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerKind:
    """A peer that can be run. title : its name for readers. sensors : whose recordings are its input."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerEnvironment:
    """Where the peers are. folder : the virtual environment of MapClosures and KISS-Matcher."""

    folder: Path

    @property
    def python(self) -> Path:
        """The interpreter of that environment."""
        return self.folder / "bin" / "python"

    def missing(self, kind: PeerKind) -> str | None:
        """The command that installs a peer; None if it can be run."""
        if kind.name == "particle-filter" and not all(map(shutil.which, PROGRAMS)):
            return "apt-get install mrpt-apps"
        if kind.name in ("kiss-matcher", "map-closures") and not self._has(kind.name.replace("-", "_")):
            return f"python -m venv {self.folder} && {self.python} -m pip install {' '.join(PINS)}"
        return None

    def _has(self, module: str) -> bool:
        found = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
        return self.python.exists() and not subprocess.run([self.python, "-c", found], check=False).returncode

    def install(self) -> None:
        """Make the environment. Raises InstallFailed."""
        pip = [self.python, "-m", "pip", "install", "-q", *PINS]
        for command in ([sys.executable, "-m", "venv", self.folder], pip):
            if subprocess.run(list(map(str, command)), check=False, stdout=sys.stderr).returncode:
                raise InstallFailed(
                    f"{self.folder}: {' '.join(PINS)} cannot be installed", hint=" ".join(map(str, command))
                )

    def version(self, kind: PeerKind) -> str:
        """A digest of what its answers depend on besides map and query: sources, versions, programs."""
        if kind.name == "pc2grid":
            return digest_of_sources(OWN)
        if kind.name == "particle-filter":
            programs = [Path(found) for name in PROGRAMS if (found := shutil.which(name)) is not None]
            return digest_of_sources([Path(particle_filter.__file__), *programs])
        own = [metadata.version(name) for name in metadata.packages_distributions().get("open3d", ())]
        return digest(own if kind.name == "fpfh-ransac" else PINS, digest_of_sources([MATCHERS]))

    def start(self, kind: PeerKind, map_stem: Path) -> Peer:
        """The peer, with a map."""
        if kind.name == "particle-filter":
            return ParticleFilter(map_stem)
        if kind.name == "pc2grid":
            own = [sys.executable, "-m", "pc2grid_lab.peers.own_process"]
            return PeerProcess(own, kind.name, map_stem)
        python = sys.executable if kind.name == "fpfh-ransac" else self.python
        return PeerProcess([python, MATCHERS], kind.name, map_stem)


class InstallFailed(Pc2GridError):
    """The environment of the peers could not be made."""
