"""Which recognised places become loops."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.mapping.loops import LoopCandidates, Recognition

STEP_M = 4.0


def corridor(count: int) -> tuple[F64, F64]:
    """PlaceMaps along a straight corridor that was driven back and forth: poses and travel."""
    x = STEP_M * np.minimum(np.arange(count), 2 * (count // 2) - np.arange(count))
    nodes = np.column_stack((x, np.zeros(count), np.where(np.arange(count) < count // 2, 0.0, math.pi)))
    return nodes, STEP_M * np.arange(count)


NODES = corridor(41)[0]


def seen(older: int, newer: int, *, off: SE2 = SE2(0.2, 0.0, 0.0)) -> Recognition:  # noqa: B008
    """A candidate that is `off` from where tracking puts the newer stretch."""
    T = SE2(*NODES[older]).inverse() @ SE2(*NODES[newer]) @ off
    return Recognition(older=older, newer=newer, T_older_newer=T, probability=0.99)


def accepted(*batches: list[Recognition]) -> list[Recognition]:
    candidates = LoopCandidates()
    for batch in batches:
        candidates.add(batch)
    return candidates.take(*corridor(41))


def test_far_from_the_tracked_pose_others_must_agree() -> None:
    off = SE2(0.0, 4.0, 0.0)  # of 84 m; 2.4 m are a standard deviation
    alone = [seen(10, 31, off=off)]
    again = [seen(7, 34, off=off)]
    contrary = [seen(7, 34, off=SE2(0.0, -4.0, 0.0))]
    assert accepted(alone) == [] and accepted(alone, contrary) == []
    assert accepted(alone, again) == [*alone, *again]
    same_stretch = [seen(13, 31, off=off)]
    assert accepted([*alone, *same_stretch]) == []


def test_a_building_turned_by_half_is_never_accepted() -> None:
    turned = [[seen(10 - 3 * k, 31 + 3 * k, off=SE2(0.0, 0.0, math.pi))] for k in range(3)]
    assert accepted(*turned) == []


def test_of_two_places_for_one_stretch_the_supported_one_is_accepted() -> None:
    right, wrong = seen(10, 31), seen(10, 31, off=SE2(2.5, 0.0, 0.0))
    assert accepted([right, wrong]) == []
    support = seen(7, 34)
    assert accepted([right, wrong], [support]) == [right, support]


def test_what_is_not_accepted_waits_and_what_cannot_be_is_forgotten() -> None:
    candidates = LoopCandidates()
    off = SE2(0.0, 4.0, 0.0)
    first, impossible = seen(10, 31, off=off), seen(10, 31, off=SE2(0.0, 90.0, 2.0))
    candidates.add([first, impossible])
    assert candidates.take(*corridor(41)) == []
    second = seen(7, 34, off=off)
    candidates.add([second])
    assert candidates.take(*corridor(41)) == [first, second]
    assert candidates.take(*corridor(41)) == []
