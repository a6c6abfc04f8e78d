"""Of the pairs of sessions that look alike, those are compared that tell something new."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import pytest

from pc2grid.geometry import SE2
from signature.database.protocol import BuildingFrame
from signature.localization.joining import pairing
from signature.localization.joining.candidates import CandidateParameters
from signature.localization.joining.join import UNJOINED, JoinStatus
from signature.localization.joining.pairing import Buildings, along

RING = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "e"), ("a", "e")]


def frame(name: str) -> BuildingFrame:
    return BuildingFrame(name=name, T_building_session=SE2(), covariance=((0.0, 0.0, 0.0),) * 3)


def told(buildings: Buildings, status: JoinStatus, *pairs: tuple[str, str]) -> None:
    for pair in pairs:
        buildings.add(*pair, replace(UNJOINED, status=status))


def enough(patch: pytest.MonkeyPatch, count: int) -> None:
    patch.setattr(pairing, "CANDIDATES", CandidateParameters(enough=count))


def test_each_pair_is_compared_once_and_neighbours_share_a_session() -> None:
    ring = {*RING, ("x", "y")}
    order = along(ring)
    assert sorted(order) == sorted(ring)
    shared = [bool({*one} & {*other}) for one, other in pairwise(order)]
    # Only where the other component begins, or ends, is no session shared.
    assert shared.count(False) == 1


@pytest.mark.parametrize(("pair", "count", "tells"), [("ac", 2, False), ("ac", 3, True), ("fc", 2, True)])
def test_sessions_that_hang_together_by_joins_enough_are_not_compared(
    pair: str, count: int, tells: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five in a ring, each by two joins, and a sixth by one at one of them."""
    enough(monkeypatch, count)
    buildings = Buildings({})
    told(buildings, "joined", *RING, ("a", "f"))
    asked = [(pair[0], pair[1])]
    assert buildings.telling(asked) == (asked if tells else [])


def test_two_buildings_are_compared_until_pairs_enough_say_that_they_are_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    enough(monkeypatch, 3)
    buildings = Buildings({})
    between = [(a, x) for a in "abcde" for x in "xyz"]
    # While nothing is known, each pair is of two sessions that may be anywhere.
    assert buildings.telling(between) == between
    told(buildings, "joined", *RING, *combinations("xyz", 2))
    # That a pair is ambiguous tells nothing, and of those to come no more are asked for than are needed.
    told(buildings, "ambiguous", *between[:2])
    told(buildings, "different", between[2])
    assert buildings.telling(between[3:]) == between[3:5]
    told(buildings, "different", *between[3:5])
    # A third building is still to be compared with both.
    assert buildings.telling([*between[5:], ("a", "new"), ("new", "x")]) == [("a", "new"), ("new", "x")]


def test_what_one_session_was_told_counts_for_the_building_that_it_turns_out_to_be_of(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    enough(monkeypatch, 2)
    buildings = Buildings({})
    told(buildings, "different", ("a", "x"), ("b", "x"))
    assert buildings.telling([("c", "x")]) == [("c", "x")]
    told(buildings, "joined", ("a", "b"), ("b", "c"))
    assert buildings.telling([("c", "x")]) == []


def test_sessions_that_stay_are_one_building_that_needs_no_more_joins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A new session is compared with the building until it has joins enough."""
    enough(monkeypatch, 2)
    buildings = Buildings({"a": frame("a"), "b": frame("a"), "c": frame("a"), "x": frame("x")})
    told(buildings, "joined", ("a", "new"))
    assert buildings.telling([("b", "new"), ("a", "b"), ("c", "x")]) == [("b", "new"), ("c", "x")]
    told(buildings, "joined", ("b", "new"))
    assert buildings.telling([("c", "new")]) == []
