"""Likely places that lie on one line."""

from __future__ import annotations

import math

import pytest

from pc2grid.geometry import SE2
from signature.localization.answer import ambiguous_line

ALONG = math.radians(30.0)


def along(travel_m: float, *, beside_m: float = 0.0, turned_rad: float = 0.0) -> SE2:
    """A place so far along a corridor."""
    return SE2(1.0, 2.0, ALONG) @ SE2(travel_m, beside_m, turned_rad)


def test_places_along_a_corridor_are_one_line() -> None:
    bases = [along(4.0), along(9.0), along(-2.0), along(5.0, beside_m=0.2)]
    line = ambiguous_line(bases, (0.3, 0.2, 0.1, 0.1))
    assert line is not None
    assert line.length_m == pytest.approx(11.0, abs=0.1)
    assert {line.begin.x < line.end.x, line.begin.y < line.end.y} in ({True}, {False})
    assert line.yaw_rad == pytest.approx(ALONG)
    assert line.probability == pytest.approx(0.7)


def test_what_looks_the_other_way_is_not_on_it() -> None:
    """A corridor with both ends alike: the robot may drive either way."""
    bases = [along(4.0), along(9.0, turned_rad=math.pi), along(6.0)]
    line = ambiguous_line(bases, (0.4, 0.3, 0.2))
    assert line is not None
    assert line.length_m == pytest.approx(2.0) and line.probability == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("bases", "masses"),
    [
        ([along(4.0)], (0.9,)),
        ([along(4.0), along(9.0, turned_rad=1.0)], (0.5, 0.4)),
        ([along(4.0), along(9.0)], (0.3, 0.1)),
        ([], ()),
    ],
    ids=["one place", "another heading", "unlikely", "nothing"],
)
def test_else_there_is_no_line(bases: list[SE2], masses: tuple[float, ...]) -> None:
    assert ambiguous_line(bases, masses) is None


def test_the_line_with_most_of_the_mass_is_told() -> None:
    """The crossing of two corridors."""
    bases = [along(0.0), along(0.0, beside_m=6.0), along(5.0), along(8.0)]
    line = ambiguous_line(bases, (0.3, 0.25, 0.2, 0.15))
    assert line is not None and line.length_m == pytest.approx(8.0)
    assert line.probability == pytest.approx(0.65)
