"""Every peer asked with every query: in the map of its own building, and in that of another one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from pc2grid.io.atomic import replace_file
from signature.evaluation.peers.environment import PEERS, PeerEnvironment, PeerKind
from signature.evaluation.peers.outcome import PeerTrial
from signature.evaluation.peers.site import Site

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


def run(task: Task, environment: PeerEnvironment, folder: Path) -> Iterator[PeerTrial]:
    """The judged answers, one by one. Those in `folder` from an earlier run are taken from there."""
    kind, site, map_site = task
    queries = site.queries()
    file = folder / f"{kind.name}.{site.name}.in.{map_site.name}.json"
    trials = [PeerTrial(**row) for row in json.loads(file.read_text())] if file.exists() else []
    yield from (trial for trial in trials if trial.query in queries)
    rest = {n: query for n, query in queries.items() if n not in {trial.query for trial in trials}}
    if not rest:
        return
    peer = environment.start(kind, map_site.map_stem)
    try:
        for number, query in rest.items():
            answer = peer.locate(site.stem(number))
            trials.append(PeerTrial.of(kind.name, site.name, map_site.name, number, query, answer))
            with replace_file(file) as draft:
                draft.write_text(json.dumps([asdict(trial) for trial in trials]))
            yield trials[-1]
    finally:
        peer.close()
