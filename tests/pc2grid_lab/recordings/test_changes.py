"""What changed between two runs."""

import json
from dataclasses import replace
from typing import Any

import pytest

from pc2grid_lab.recordings.judging import warned
from pc2grid_lab.recordings.table import (
    JoinRow,
    MapRow,
    PairRow,
    QueryRow,
    RowChange,
    Table,
    changes,
    counts_of,
    markdown_page,
    sensor_matrix,
    show,
)

BENT = "the map contradicts itself along 6% of the travel and is probably bent: near x 1.0, y 2.0 m"
HEIGHT = "the height changes by 3.0 m, and from 5 s after the first scan on it is more than 2.0 m"
ODD = "something that no one has heard of before"


def map_row(name: str = "hall", **changed: Any) -> MapRow:
    fields: dict[str, Any] = {
        "name": name,
        "building": "hall",
        "sensor": "lidar",
        "minutes": 1.0,
        "metres": 30.0,
        "cpu_s": 10.0,
        "parts": 1,
        "lost": 0.0,
        "truth": "poses",
        "error_m": 0.03,
    }
    return MapRow(**{**fields, **changed})


def query(window: int, outcome: str) -> QueryRow:
    """right, wrong or refused."""
    return QueryRow(
        window=window,
        start_s=10.0 * window,
        status="ambiguous" if outcome == "refused" else "located",
        confidence=0.99,
        covered=True,
        right=outcome != "wrong",
        rank=0 if outcome != "wrong" else None,
        error_m=0.04 if outcome != "wrong" else 5.0,
        in_space={"right": "agrees", "wrong": "contradicts"}.get(outcome),
        cpu_s=2.0,
    )


def pair_row(*outcomes: str, building: str = "hall", **changed: Any) -> PairRow:
    fields: dict[str, Any] = {
        "query": "b",
        "map": "a",
        "kind": "other day",
        "building": building,
        "sensors": "laser",
        "truth": "poses",
        "queries": tuple(query(k, outcome) for k, outcome in enumerate(outcomes)),
    }
    return PairRow(**{**fields, **changed})


def table(*rows: MapRow | PairRow) -> Table:
    return Table(
        program="0123456789ab",
        commit="abc",
        quick=False,
        cpu_s=600.0,
        maps=tuple(row for row in rows if isinstance(row, MapRow)),
        pairs=tuple(row for row in rows if isinstance(row, PairRow)),
    )


def test_the_same_again_is_no_change() -> None:
    same = table(map_row(), pair_row("right", "wrong", "refused"))
    assert changes(same, same) == []
    read = Table.from_json(json.loads(same.to_text()))
    assert json.loads(same.to_text())["schema_version"] == 1 and changes(read, same) == []


@pytest.mark.parametrize(
    ("now", "text", "worse"),
    [
        ({"error_m": 0.73}, "error 0.030 -> 0.730 m", True),
        ({"error_m": 0.010}, "error 0.030 -> 0.010 m", False),
        ({"parts": 3}, "parts 1 -> 3", True),
        ({"lost": 0.2}, "scans lost 0 -> 20 %", True),
        ({"problem": "internal error: KeyError"}, "mapped -> internal error: KeyError", True),
    ],
)
def test_a_map_that_changed_is_told(now: dict[str, Any], text: str, worse: bool) -> None:
    found = changes(table(map_row()), table(map_row(**now)))
    assert found == [RowChange(row="hall", text=text, worse=worse)]


@pytest.mark.parametrize("now", [{"error_m": 0.036}, {"error_m": 0.032}, {"cpu_s": 11.0}])
def test_a_small_change_is_not_told(now: dict[str, Any]) -> None:
    assert changes(table(map_row()), table(map_row(**now))) == []


def test_warnings_that_come_and_go() -> None:
    old = map_row(warnings=warned([BENT], error_m=0.4), error_m=0.4)
    new = map_row(warnings=warned([HEIGHT, ODD], error_m=0.4), error_m=0.4)
    assert {(c.text, c.worse) for c in changes(table(old), table(new))} == {
        ("new warning: height (false)", True),
        ("new warning: something that no one has (unknown)", False),
        ("no longer warned of: bent (right)", True),
    }


def test_worse_by_more_than_chance_needs_five_windows() -> None:
    before = table(pair_row(*["right"] * 6))
    four = changes(before, table(pair_row(*["refused"] * 4, "right", "right")))
    assert not any(change.worse for change in four)
    five = changes(before, table(pair_row(*["refused"] * 5, "right")))
    assert [c.row for c in five if c.worse] == ["building hall", "all queries"]
    assert "0 windows more are located and right, 5 are no longer (p 0.031)" in five[-1].text
    better = changes(table(pair_row(*["refused"] * 6)), before)
    assert not any(change.worse for change in better)


def test_the_page_shows_each_row() -> None:
    rows = (
        map_row(warnings=warned([BENT], error_m=0.03)),
        map_row("wean|3", problem="internal error: KeyError", error_m=None),
        pair_row("right", "wrong", "refused"),
        pair_row(problem="laser/x.mcap: not in the data folder", query="x"),
        pair_row("wrong", kind="elsewhere", truth="elsewhere", building="intel"),
    )
    text = markdown_page(table(*rows), [RowChange(row="hall", text="error 0.030 -> 0.730 m", worse=True)])
    (bent,) = [line for line in text.splitlines() if line.startswith("| hall | hall | lidar")]
    assert "bent (false)" in bent and "| 0.030 |" in bent
    assert "| wean\\|3 |" in text and "internal error: KeyError |" in text
    cells = "3 | 3 | 2 | 1 | **1** | 0 | 1 | 1 of 3 [0.01, 0.91] | 0 | 0 | 0.040 | 1/0/1"
    assert f"| b | a | laser | {cells} |" in text
    assert "not in the data folder" in text
    assert "the window from 10.0 s, 5.00 m off, confidence 0.990" in text
    assert "- **worse** hall: error 0.030 -> 0.730 m" in text
    assert "2 of 2 [0.16, 1.00] (hall, intel)" in text
    widths = {line.count("|") - line.count("\\|") for line in text.splitlines() if line.startswith("| b |")}
    assert widths == {18}


def test_disturbed_recordings_are_compared_and_counted_once() -> None:
    rows = (
        map_row("room", error_m=0.02),
        map_row("room, disturbed 1", error_m=0.05),
        map_row("hall"),
        pair_row("right", "refused", "right", map="room 0..10 s"),
        pair_row("wrong", "right", "right", map="room, disturbed 1 0..10 s", kind="disturbed"),
        pair_row("wrong", map="hall"),
    )
    text = markdown_page(table(*rows))
    told = "0.020 to 0.050 m, 2.50 times; windows right in one of its maps and wrong in another: 1"
    assert [line for line in text.splitlines() if "times;" in line] == [f"- room, disturbed: {told}"]
    assert "| all queries | 1 | 4 | 4 | 2 of 4" in text
    worse = table(*rows[:-2], pair_row(*["refused"] * 9, map="room, disturbed 1 0..10 s", kind="disturbed"))
    better = replace(
        worse, pairs=(*worse.pairs[:-1], replace(worse.pairs[-1], queries=pair_row(*["right"] * 9).queries))
    )
    assert not any(change.worse for change in changes(better, worse))


def test_the_matrix_of_sensors_shows_its_gaps() -> None:
    """Sums over pairs of one building; nothing of other buildings, and a dash where there is no pair."""
    rows = [
        pair_row("right", "refused"),
        pair_row("wrong", building="office"),
        pair_row("right", sensors="depth in laser"),
        pair_row("right", "right", sensors="lidar", kind="elsewhere"),
        pair_row("right", sensors="laser in map"),
        pair_row("right", "wrong", sensors="driven lidar in laser"),
        pair_row("right", sensors="driven depth"),
    ]
    lines = sensor_matrix(table(*rows))
    cells = {line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines[2:5]}
    assert cells["lidar"] == ["-", "-", "-", "-"]
    assert cells["depth"] == ["-", "-", "1 of 1, 0 wrong (1 building)", "-"]
    assert cells["laser"] == ["-", "-", "1 of 3, 1 wrong (2 buildings)", "1 of 1, 0 wrong (1 building)"]
    driven = {line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines[10:13]}
    assert driven["driven lidar"] == ["-", "-", "1 of 2, 1 wrong (1 building)", "-"]
    assert driven["driven depth"] == ["-", "1 of 1, 0 wrong (1 building)", "-", "-"]
    assert driven["laser"] == ["-"] * 4  # what is not driven stands in the table above


def test_answers_that_are_not_judged_are_counted_beside_right_and_wrong() -> None:
    located = replace(query(0, "right"), right=None)
    row = pair_row(queries=(query(1, "right"), query(2, "refused"), located), sensors="laser in map")
    counts = counts_of(row.queries)
    assert [counts[outcome] for outcome in ("right", "wrong", "not judged", "refused")] == [1, 0, 1, 1]
    text = markdown_page(table(row))
    assert "0 wrong, 1 not judged (1 building)" in text
    assert "2 located answers none is known to be wrong; 1 are not judged" in text and "## Not judged" in text
    assert "not judged" not in sensor_matrix(table(pair_row("right", "wrong")))[2]


def test_wrong_answers_are_counted_by_confidence_and_by_drive() -> None:
    sure = pair_row("right", "wrong", "wrong", query="d")
    unsure = replace(query(1, "refused"), confidence=0.6)
    text = markdown_page(table(sure, pair_row("right", query="e"), pair_row(queries=(unsure,))))
    section = text.split("## By confidence")[1].split("##")[0]
    assert "| 0.99 and above | 4 | 2 of 4 [0.07, 0.93] | 1 of 2 [0.01, 0.99] |" in section
    assert "| 0.50 to 0.75 | 0 | 0 of 1 [0.00, 0.97] | 0 of 1 [0.00, 0.97] |" in section


def test_what_the_search_found_is_told_among_the_overlooked() -> None:
    first, later = (replace(query(k, "refused"), rank=k, fine=0.95) for k in (0, 1))
    not_fine = replace(query(2, "refused"), rank=0, fine=0.6)
    text = markdown_page(table(pair_row(queries=(first, later, not_fine, query(3, "right")))))
    assert "Of 2 overlooked queries 1 have the right place first" in text


def test_what_nobody_judges_is_not_called_right(capsys: pytest.CaptureFixture[str]) -> None:
    found = table(map_row(), pair_row(queries=(replace(query(0, "right"), right=None),), truth=None))
    show(found)
    words = "Of 1 located answers none is known to be wrong; 1 are not judged."
    assert words in markdown_page(found) and words in capsys.readouterr().out


def test_a_terminal_shows_each_row(capsys: pytest.CaptureFixture[str]) -> None:
    show(table(map_row(), pair_row("right", "wrong", "refused")))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["hall", "lidar", "1.0", "30", "10.0", "1", "0.0", "0.030", "poses"] in lines
    assert ["b", "a", "laser", "3", "3", "2", "1", "1", "0", "1", "0.040", "2.0", "poses"] in lines


def test_a_pair_of_maps_that_is_joined_wrongly_now_is_worse() -> None:
    kept = JoinRow(target="a", source="b", same=False, status="ambiguous", right=False)
    before = Table(program="", commit="", quick=False, cpu_s=0.0, maps=(), pairs=(), joins=(kept,))
    after = replace(before, joins=(replace(kept, status="joined"),))
    assert changes(before, before) == []
    assert changes(before, after) == [
        RowChange(row="b joined with a", text="not joined -> wrong", worse=True)
    ]
    page = " ".join(markdown_page(after).split())
    assert "| a | b | two | joined |" in page and "Of 1 pairs of two buildings 1 are joined" in page
    assert (
        Table.from_json(json.loads(after.to_text())) == after
        and "Of 0 pairs of one building 0 join right" in page
    )
