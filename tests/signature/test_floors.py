"""Floors that look alike stay apart by their labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pc2grid.model import SessionMap
from signature.config import Config
from signature.database import Label, Provenance, open_database
from signature.localization.answering import locate_map
from signature.localization.map_index import MapIndex
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


def test_labels_say_whether_they_differ() -> None:
    first, second = (Label(building="house", floor=k) for k in FLOORS)
    assert first.contradicts(second) and first.agrees(first) and not first.agrees(second)
    assert first.contradicts(Label(building="hall", floor="0"))
    assert str(first) == "house, 0"
