"""The JSON documents of the commands of the laboratory as types; see `pc2grid_cli.json_schemas`."""

from __future__ import annotations

from typing import Any

# Before Python 3.12 pydantic, which makes the schemas, does not take the TypedDict of typing.
from typing_extensions import TypedDict

from pc2grid_cli.json_schemas import Printed
from pc2grid_lab.experiments.metrics import ConfidenceError, MatrixCell
from pc2grid_lab.experiments.recordings.changes import RowChange
from pc2grid_lab.experiments.recordings.rows import FollowedRow, MapRow, PairRow
from pc2grid_lab.peers.outcome import PeerCell, PeerTrial


class ComparePaper(Printed):
    """`pc2grid compare paper --json`: a cell a map, method and noise level, measured beside published."""

    version: str
    queries: int
    seed: int
    cells: list[dict[str, Any]]


class ComparePeers(Printed):
    """`pc2grid compare peers --json`, and its peers.json.

    setting: the options, the seed of the intervals, and by name the seconds that `--mapped` gives.
    not_installed: by peer, the command that installs it.
    """

    recordings: list[str]
    setting: dict[str, float]
    not_installed: dict[str, str]
    cells: list[PeerCell]
    trials: list[PeerTrial]


class CompareRecordings(Printed):
    """`pc2grid compare recordings --json`; without `changes` its real.json. program: changes with any source
    file of the product and with the catalogue; cpu_s: of all commands together. changes: against the table
    of the run before; empty if there is none.
    """

    program: str
    commit: str
    quick: bool
    cpu_s: float
    maps: list[MapRow]
    pairs: list[PairRow]
    followed: list[FollowedRow]
    changes: list[RowChange]


class Elsewhere(TypedDict):
    """What was answered to queries from another building."""

    trials: int
    not_found: int
    located: int


class Apart(TypedDict):
    """How well distances separate one place seen by two sensors from two places; auc is null if nothing was
    compared."""

    auc: float | None
    same: int
    other: int


class Ablation(TypedDict):
    """Recall after travel_m metres by query sensor, by what is used, and by how many are retrieved."""

    travel_m: float
    recall: dict[str, dict[str, dict[str, float | None]]]


class CompareSensors(Printed):
    """`pc2grid compare sensors --json`, and its matrix.json. outside_the_map: trials where the map has not
    been. change: by plan, what differs in a session from the plan, mean of some sessions."""

    plans: list[str]
    queries: int
    setting: dict[str, float]
    change: dict[str, dict[str, float]]
    cells: list[MatrixCell]
    confidence: dict[str, ConfidenceError]
    outside_the_map: int
    elsewhere: Elsewhere
    independence: dict[str, Apart]
    ablation: Ablation


DOCUMENTS: dict[str, type] = {
    "compare-paper": ComparePaper,
    "compare-peers": ComparePeers,
    "compare-recordings": CompareRecordings,
    "compare-sensors": CompareSensors,
}
"""By command."""
