"""pc2grid and its peers locate the same robots: the experiment of `pc2grid compare peers`, made small.

With PC2GRID_DATA these are real recordings of a laser and of a lidar, else a lidar simulated in two offices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pc2grid.io.nav2_map import save_map
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import ROOT, Row
from pc2grid_lab.peers.environment import PEERS, PeerEnvironment
from pc2grid_lab.peers.experiment import run, tasks
from pc2grid_lab.peers.outcome import PeerCell, counted
from pc2grid_lab.peers.site import Site, recorded_site, simulated_site
from signature.config import Config

ENVIRONMENT = ROOT / ".venv" / "peers"
MAPPED_S = {"intel": 900.0, "fr079": 600.0, "hall": 12.5}


def compare(folder: Path, quick: bool) -> Iterator[Row]:
    """Processor time from the registered query to the pose, memory, and how many answers are right."""
    environment = PeerEnvironment(folder=ENVIRONMENT)
    if any("pip install" in (environment.missing(kind) or "") for kind in PEERS):
        environment.install()
    for kind in PEERS:
        if command := environment.missing(kind):
            yield Row(what=kind.title, measured=None, unit="s", note=f"not installed: {command}")
    (folder / "trials").mkdir()
    sites = list(_sites(folder, queries=2 if quick else 12))
    trials = [
        trial for task in tasks(sites, environment) for trial in run(task, environment, folder / "trials")
    ]
    yield from _rows(counted(trials))


def _rows(cells: Sequence[PeerCell]) -> Iterator[Row]:
    titles = {kind.name: kind.title for kind in PEERS}
    own_s = {cell.site: cell.cpu_s for cell in cells if cell.peer == "pc2grid"}
    for cell in cells:
        yield Row(
            what=f"query to pose in {cell.site}, {titles[cell.peer]}",
            measured=cell.cpu_s,
            cpu=cell.cpu_s,
            unit="s",
            note=f"right {cell.right}, wrong {cell.wrong} of {cell.covered} in the map; elsewhere wrong"
            f" {cell.elsewhere_wrong} of {cell.elsewhere}; {cell.peak_mb:.0f} MB",
        )
        here_s = own_s[cell.site]
        if cell.peer != "pc2grid" and here_s and cell.cpu_s:
            what = f"pc2grid over {titles[cell.peer]}, {cell.site}"
            yield Row(what=what, measured=here_s / cell.cpu_s, unit="x", goal=1.0)


def _sites(folder: Path, queries: int) -> Iterator[Site]:
    real = {
        name: log
        for name in MAPPED_S
        if (log := fixtures.data_file(f"{'lidar' if name == 'hall' else 'laser'}/{name}.mcap")) is not None
    }
    for name, log in real.items():
        yield recorded_site(
            log, folder / name, Config(), queries=queries, travel_m=10.0, mapped_s=MAPPED_S[name]
        )
    scan = fixtures.data_file("lidar/fr079_floor.ply")
    plans = [] if scan is None else [scan]
    if not real:
        plans = [save_map(fixtures.office(seed), folder / f"office{seed}")[0] for seed in (0, 1)]
    for plan in plans:
        yield simulated_site(plan, folder / plan.stem, Config(), queries=queries, travel_m=10.0)
