"""What was compared is known again after an interruption, and nothing else is."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from signature.localization.joining.join import UNJOINED, Join
from signature.localization.joining.journal import JoinJournal, key_of
from signature.localization.joining.pieces import Link
from signature.localization.posterior import NO_EVIDENCE

JOIN = replace(
    UNJOINED,
    status="joined",
    T_target_source=SE2(1 / 3, -math.pi, 0.1),
    covariance=np.diag([1e-3 / 3, 2e-3, 3e-6]),
    probability=0.999,
    evidence=replace(NO_EVIDENCE, forward=2 / 3, tail=(-0.5, -1 / 3)),
    links=(Link(center_m=(1 / 3, -2.0), T_target_source=SE2(0.1, 1 / 7, -3.0), covariance=np.eye(3) / 3),),
)


def same(a: Join | None, b: Join) -> bool:
    """Bit by bit."""
    return a is not None and repr(a) == repr(b) and np.array_equal(a.covariance, b.covariance)


def test_what_was_compared_is_read_again_exactly(tmp_path: Path) -> None:
    path = tmp_path / "x.joining"
    journal = JoinJournal(path)
    journal.add("a b", JOIN)
    journal.add("a c", UNJOINED)
    again = JoinJournal(path)
    assert same(again.find("a b"), JOIN) and same(again.find("a c"), UNJOINED)
    assert again.find("b c") is None and len(again) == 2
    again.remove()
    assert not path.exists() and len(JoinJournal(path)) == 0


def test_a_line_that_was_not_finished_is_left_out_and_the_file_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "x.joining"
    journal = JoinJournal(path)
    journal.add("a b", JOIN)
    journal.add("a c", JOIN)
    path.write_bytes(path.read_bytes()[:-20])
    again = JoinJournal(path)
    assert len(again) == 1 and again.find("a c") is None
    again.add("b c", JOIN)
    assert same(JoinJournal(path).find("b c"), JOIN)


def test_another_version_of_the_program_begins_anew(tmp_path: Path) -> None:
    path = tmp_path / "x.joining"
    JoinJournal(path).add("a b", JOIN)
    head, *lines = path.read_text().splitlines()
    (key,) = json.loads(head)
    path.write_text("\n".join([json.dumps({key: "0.0.0"}), *lines]) + "\n")
    assert len(JoinJournal(path)) == 0


def test_another_file_is_refused_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("do not lose me\n")
    with pytest.raises(OutputError, match="is no list of compared sessions"):
        JoinJournal(path)
    assert path.read_text() == "do not lose me\n"
    with pytest.raises(OutputError, match="nowhere"):
        JoinJournal(tmp_path / "nowhere" / "x").add("a b", JOIN)


def test_a_pair_is_known_by_the_content_of_its_maps() -> None:
    a = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    others = [
        replace(a, cells=np.zeros((3, 2), np.int8)),
        replace(a, cells=np.ones((2, 3), np.int8)),
        replace(a, origin_m=(0.0, 1.0)),
        replace(a, height_m=0.2),
    ]
    keys = {key_of(a, other, labelled=False) for other in others}
    keys |= {key_of(other, a, labelled=False) for other in others}
    keys |= {key_of(a, a, labelled=labelled) for labelled in (False, True)}
    assert len(keys) == 10 and key_of(a, replace(a), labelled=True) in keys
