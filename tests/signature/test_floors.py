"""Floors that look alike stay apart by their labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.model import UNKNOWN, SessionMap
from signature.config import Config
from signature.database import Label, Provenance, open_database
from signature.localization.localizer import Answer, MapIndex, locate_map
from signature.sessions import add_sessions, provenance
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import cut, office

FLOORS = ("0", "1")


@pytest.fixture(scope="module")
def origin() -> Provenance:
    return provenance("house.mcap", "a" * 64, Config(), label=Label(building="house"))


@pytest.fixture(scope="module")
def floor() -> SessionMap:
    return session("house", office(), way())


def test_floors_that_look_alike_are_ambiguous(tmp_path: Path, floor: SessionMap, origin: Provenance) -> None:
    path = tmp_path / "house.submaps"
    maps = [
        (replace(floor, session=k), replace(origin, label=Label(building="house", floor=k))) for k in FLOORS
    ]
    add_sessions(path, maps, Config(), keep=False)
    with open_database(path) as database:
        answer = locate_map(cut(office(), 4.0, 3.0, 15.0, 12.0), MapIndex.of(database, Config()))
    assert answer.status == "ambiguous"
    assert {answer.labels[h.session_index].floor for h in answer.hypotheses} == {"0", "1"}


@pytest.mark.parametrize("known_m", [11.0, 17.5], ids=["nothing of it", "most of it"])
def test_a_floor_that_looks_alike_may_hold_what_its_map_does_not_show(
    tmp_path: Path, floor: SessionMap, origin: Provenance, known_m: float
) -> None:
    """The map of one floor ends in the office; the query is from beyond, or reaches beyond."""
    whole = office()

    def cells_up_to(end_m: float) -> NDArray[np.int8]:
        cells = whole.cells.copy()
        cells[:, round(end_m / whole.resolution_m) :] = UNKNOWN
        return cells

    half = session("half", replace(whole, cells=cells_up_to(known_m)), way())
    mirrored = session("half", replace(whole, cells=cells_up_to(11.0)[::-1]), way())
    query = cut(whole, 11.5, 0.0, 20.0, 14.0)
    labels = [replace(origin, label=Label(building="house", floor=k)) for k in FLOORS]

    def ask(other: SessionMap, name: str) -> Answer:
        path = tmp_path / f"{name}.submaps"
        maps = zip((floor, replace(other, session="other")), labels, strict=True)
        add_sessions(path, list(maps), Config(), keep=False)
        with open_database(path) as database:
            return locate_map(query, MapIndex.of(database, Config()))

    answer = ask(half, "alike")
    assert answer.status == "ambiguous"
    assert [answer.sessions[h.session_index] for h in answer.hypotheses][-1] == "other"
    assert ask(mirrored, "otherwise").status == "located"


def test_labels_say_whether_they_differ() -> None:
    first, second = (Label(building="house", floor=k) for k in FLOORS)
    assert first.contradicts(second) and first.agrees(first) and not first.agrees(second)
    assert first.contradicts(Label(building="hall", floor="0"))
    assert str(first) == "house, 0"
