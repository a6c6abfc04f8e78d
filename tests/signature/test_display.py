"""Answers, signatures and databases in a notebook: one short line each, and a table."""

from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.matching.score import Fit
from pc2grid.model import OccupancyGrid
from signature.database import Label, open_database
from signature.database.maintenance import store
from signature.localization.answer import Answer, Place
from tests.helpers.databases import make_entry

LONGEST_LINE = 200
SEEN = OccupancyGrid(cells=np.zeros((4, 4), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))


def hypothesis(x: float, session: int, score: float) -> Fit:
    return Fit(
        T_map_query=SE2(x, 2.0 / 3.0, 0.1),
        forward=score,
        backward=score,
        overlap=0.9,
        compared=90.0,
        looked_at=100,
        score=score,
        covariance=np.eye(3),
        session_index=session,
    )


def answer(status: str, confidence: float) -> Answer:
    best, other = hypothesis(4.0, 1, 0.8), hypothesis(9.0, 0, 0.3)
    return Answer(
        status=status,  # type: ignore[arg-type]
        stamp_ns=0,
        places=()
        if status == "not_found"
        else (Place(fits=(best,), mass=confidence), Place(fits=(other,), mass=0.0)),
        history=(),
        T_odom_base=SE2(1.0, 0.0, 0.0),
        path_m=3.25,
        sessions=("monday", "tuesday <x>"),
        labels=(Label(), Label()),
        local_map=SEEN,
    )


@pytest.mark.parametrize(
    ("status", "confidence", "words"),
    [
        ("located", 0.9999, "in 'tuesday <x>' at x 5.00 m, y 0.77 m, yaw 5.7 deg, confidence > 0.99, after"),
        ("ambiguous", 0.4, "Answer(ambiguous, 2 places, confidence 0.40, after 3.2 m)"),
        ("not_found", 0.0, "Answer(not_found, 0 places, confidence < 0.01, after 3.2 m)"),
    ],
)
def test_an_answer_is_one_short_line(status: str, confidence: float, words: str) -> None:
    text = repr(answer(status, confidence))
    assert words in text and len(text) < LONGEST_LINE and "\n" not in text


def test_the_table_of_an_answer_names_the_places_that_fit() -> None:
    page = answer("located", 0.95)._repr_html_()
    assert "located, confidence 0.95" in page and page.count("the answer") == 1
    assert "tuesday &lt;x&gt;" in page and "<x>" not in page
    assert page.index("x 5.00 m") < page.index("the answer") < page.index("monday")
    assert "the answer" not in answer("ambiguous", 0.4)._repr_html_()
    assert answer("not_found", 0.0)._repr_html_().startswith("<table><caption>not found")


def test_signatures_and_databases_are_one_short_line(tmp_path: Path) -> None:
    path = tmp_path / "building.submaps"
    entry = make_entry("monday")
    store(path, [entry, make_entry("<b>", seed=1)], keep=False)
    with open_database(path) as database:
        table, page = database.signatures(), database._repr_html_()  # type: ignore[attr-defined]
        infos = database.sessions()
        for thing in (entry[1][0], table, *infos, infos[0].provenance, database):
            text, name = repr(thing), "SubmapDatabase" if thing is database else type(thing).__name__
            assert text.startswith(f"{name}(") and len(text) < LONGEST_LINE
            assert "\n" not in text
    assert repr(table) == f"SignatureTable({len(table)} submaps of 2 sessions)"
    assert "monday" in page and "&lt;b&gt;" in page and "building.submaps" in page
    assert "SubmapDatabase(" in repr(database), "also when it is closed"
