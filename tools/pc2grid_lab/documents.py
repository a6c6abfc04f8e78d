"""The JSON documents of the commands of the laboratory as types; see `pc2grid_cli.json_schemas`."""

from __future__ import annotations

from typing import Any

# Before Python 3.12 pydantic, which makes the schemas, does not take the TypedDict of typing.
from typing_extensions import TypedDict

from pc2grid_lab.experiments.metrics import ConfidenceError, MatrixCell
from pc2grid_lab.experiments.recordings.changes import RowChange
from pc2grid_lab.experiments.recordings.rows import MapRow, PairRow
from pc2grid_lab.peers.outcome import PeerCell, PeerTrial
from signature.localization.answer_json import Version


class Simulate(TypedDict):
    """`pc2grid simulate --json`; clutter: objects that could be placed. change: what differs from the
    building as drawn, counts and metres, and the share of its visible walls."""

    schema_version: Version
    recording: str
    truth: str
    sensor: str
    scans: int
    duration_s: float
    length_m: float
    clutter: int
    change: dict[str, float]


class ComparePaper(TypedDict):
    """`pc2grid compare paper --json`: a cell a map, method and noise level, measured beside published."""

    schema_version: Version
    version: str
    queries: int
    seed: int
    cells: list[dict[str, Any]]


class ComparePeers(TypedDict):
    """`pc2grid compare peers --json`, and its peers.json.

    setting: the options, the seed of the intervals, and by name the seconds that `--mapped` gives.
    not_installed: by peer, the command that installs it.
    """

    schema_version: Version
    recordings: list[str]
    setting: dict[str, float]
    not_installed: dict[str, str]
    cells: list[PeerCell]
    trials: list[PeerTrial]


class CompareRecordings(TypedDict):
    """`pc2grid compare recordings --json`; without `changes` its real.json. program: changes with any source
    file of the product and with the catalogue; cpu_s: of all commands together. changes: against the table
    of the run before; empty if there is none.
    """

    schema_version: Version
    program: str
    commit: str
    quick: bool
    cpu_s: float
    maps: list[MapRow]
    pairs: list[PairRow]
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


class SelectionRow(TypedDict):
    """One way to select places, in one building or a city of many, after travel_m metres.

    found, right: share of the queries whose place is selected, and that are located rightly, each with its
    5th and 95th percentile by session; right and wrong, the share located wrongly, are null if not tried.
    places, looked_at: how many there are and how many are selected; processor_ms: median processor time
    of the selection and the comparison of isovists.
    """

    scope: str
    selector: str
    travel_m: float
    queries: int
    sessions: int
    places: int
    looked_at: int
    found: list[float]
    right: list[float] | None
    wrong: float | None
    processor_ms: float


class ScaleRow(TypedDict):
    """Selection among very many places, by all signatures of what was seen: share of the queries whose place
    is selected, with its 5th and 95th percentile by session, and median processor time of the selection."""

    places: int
    selector: str
    share: float
    travel_m: float
    query_sensor: str
    queries: int
    found: list[float]
    processor_ms: float


class SeenApart(TypedDict):
    """How well signatures of what was seen separate one place seen by two sensors from two places: area under
    the curve, its 5th and 95th percentile, and pairs compared."""

    auc: float
    low: float
    high: float
    same: int
    other: int


class CompareSignatures(TypedDict):
    """`pc2grid compare signatures --json`, and its signatures.json."""

    schema_version: Version
    plans: list[str]
    setting: dict[str, float]
    rows: list[SelectionRow]
    scale: list[ScaleRow]
    independence: dict[str, SeenApart]


class CompareSensors(TypedDict):
    """`pc2grid compare sensors --json`, and its matrix.json. outside_the_map: trials where the map has not
    been. change: by plan, what differs in a session from the plan, mean of some sessions."""

    schema_version: Version
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
    "compare-signatures": CompareSignatures,
    "simulate": Simulate,
}
"""By command."""
