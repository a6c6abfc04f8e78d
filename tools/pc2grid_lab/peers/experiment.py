"""Every peer locates every query: in the map of its own building, and in that of another one."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from pc2grid_lab.experiments.stored import write_text
from pc2grid_lab.peers.environment import PEERS, PeerEnvironment, PeerKind
from pc2grid_lab.peers.outcome import PeerTrial
from pc2grid_lab.peers.peer_process import PeerAnswer
from pc2grid_lab.peers.site import Site

Task = tuple[PeerKind, Site, Site]
"""A peer, the site of the queries and the site of the map."""


def tasks(sites: Sequence[Site], environment: PeerEnvironment) -> list[Task]:
    """What is run: each installed peer with the sites of its sensors, own map first, then the next one's."""
    made: list[Task] = []
    for kind in PEERS:
        if environment.missing(kind):
            continue
        for sensor in kind.sensors:
            of_sensor = [site for site in sites if site.sensor == sensor]
            for k, site in enumerate(of_sensor):
                made += [(kind, site, other) for other in dict.fromkeys((site, of_sensor[k - 1]))]
    return made


def run(task: Task, environment: PeerEnvironment, folder: Path) -> list[PeerTrial]:
    """The judged answers.

    An answer in `folder` from an earlier run is used again if map, query and program are the same; it is
    judged again in any case.
    """
    kind, site, map_site = task
    named = (kind.name, site.folder.name, "in", map_site.folder.name, environment.version(kind))
    file = folder / (".".join(named) + ".json")
    answers = _kept(file)
    queries = site.queries()
    rest = [number for number in queries if number not in answers]
    if rest:
        with contextlib.closing(environment.start(kind, map_site.map_stem)) as peer:
            for number in rest:
                answers[number] = peer.locate(site.stem(number))
                write_text(file, json.dumps({n: asdict(answer) for n, answer in answers.items()}))
    names = (kind.name, site.name, map_site.name)
    return [PeerTrial.of(*names, number, query, answers[number]) for number, query in queries.items()]


def _kept(file: Path) -> dict[int, PeerAnswer]:
    """The answers of an earlier run by the numbers of their queries."""
    rows = json.loads(file.read_text()) if file.exists() else {}
    return {int(number): PeerAnswer.of(fields) for number, fields in rows.items()}
