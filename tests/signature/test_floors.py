"""Sessions of several floors: what they are called, and that floors which look alike stay apart."""

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
from signature.sessions import add_sessions, on_floors, provenance
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import cut, office

FLOORS = ("0", "1")


@pytest.fixture(scope="module")
def origin() -> Provenance:
    return provenance("house.mcap", "a" * 64, Config(), label=Label(building="house"))


@pytest.fixture(scope="module")
def floor() -> SessionMap:
    return session("house", office(), way())


def asked(folder: Path, floor: SessionMap, sessions: dict[str, Provenance]) -> Answer:
    """Where a part of the office is, in a database in which every session shows the whole office."""
    path = folder / "house.submaps"
    maps = [(replace(floor, session=name), origin) for name, origin in sessions.items()]
    add_sessions(path, maps, Config(), keep=False)
    with open_database(path) as database:
        for info in database.sessions():
            assert info.provenance.label == sessions[info.name].label
        return locate_map(cut(office(), 4.0, 3.0, 15.0, 12.0), MapIndex.of(database, Config()))


def test_floors_that_look_alike_are_ambiguous(tmp_path: Path, floor: SessionMap, origin: Provenance) -> None:
    parts = [
        replace(floor, session=f"house#{k}", floor=k, floor_height_m=3.0 * number)
        for number, k in enumerate(FLOORS)
    ]
    _, origins = on_floors(parts, origin)
    assert [o.label.floor for o in origins] == ["0", "1"]
    assert all(o.label.told_apart for o in origins)
    assert [str(o.label) for o in origins] == ["house, floor 0 at 0.0 m", "house, floor 1 at 3.0 m"]
    answer = asked(tmp_path, floor, {"house": origins[0], "house#2": origins[1]})
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


def test_own_names_of_two_recordings_mean_nothing_to_each_other(
    tmp_path: Path, floor: SessionMap, origin: Provenance
) -> None:
    """Both recordings began on one floor of the house, which the second one calls otherwise."""
    first, second = (replace(origin, label=Label(building="house", floor=k, told_apart=True)) for k in FLOORS)
    answer = asked(tmp_path, floor, {"monday": first, "tuesday": second})
    assert answer.status == "located"
    given = [replace(o, label=replace(o.label, told_apart=False)) for o in (first, second)]
    assert asked(tmp_path, floor, dict(zip(("monday", "tuesday"), given, strict=True))).status == "ambiguous"


def test_the_user_names_floors_in_order(floor: SessionMap, origin: Provenance) -> None:
    def labelled(asked_floor: str | None, *own: str | None) -> tuple[list[Label], tuple[str, ...]]:
        made_from = replace(origin, label=Label(building="house", floor=asked_floor))
        maps, origins = on_floors([replace(floor, floor=k) for k in own], made_from)
        return [o.label for o in origins], maps[0].report.warnings

    assert labelled("2", None) == ([Label(building="house", floor="2")], ())
    labels, warnings = labelled("2, 3,2", "0", "lift 1", "lift 2")
    assert [label.floor for label in labels] == ["2", "3", "2"]
    assert not warnings and not any(label.told_apart for label in labels)
    labels, warnings = labelled("2", "0", "1", "0")
    assert [label.floor for label in labels] == ["0", "1", "0"]
    assert all(label.told_apart for label in labels)
    assert "the floor '2' is not used" in warnings[-1]


def test_labels_say_whether_they_differ() -> None:
    own = [Label(building="house", floor=k, told_apart=True) for k in FLOORS]
    assert own[0].contradicts(own[1], one_recording=True)
    assert not own[0].contradicts(own[1])
    assert not own[0].agrees(own[0]) and own[0].agrees(own[0], one_recording=True)
    assert not own[0].contradicts(Label(building="house", floor="1"))
    assert own[0].contradicts(Label(building="hall", floor="0"))
    assert str(own[0]) == "house, floor 0"
