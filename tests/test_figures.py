"""The figures of README are those of the pages that they come from.

Tables are compared cell by cell. Of figures in sentences the tests name the row of the page, and make the
words that README must have from its cells.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text("utf-8")
FLAT = " ".join(README.split())

Row = dict[str, str]


def tables(page: str) -> list[list[Row]]:
    """The tables of a page: of each row the cells by their heads. An empty first cell repeats that above."""
    found = []
    text = README if page == "README.md" else (ROOT / "examples" / page).read_text("utf-8")
    for block in re.findall(r"^\|.*(?:\n\|.*)+", text, re.MULTILINE):
        lines = [line.strip()[1:-1].split("|") for line in block.splitlines()]
        head, _, *body = [[cell.strip(" *") for cell in line] for line in lines]
        rows: list[Row] = []
        for cells in body:
            first = cells[0] or (rows[-1][head[0]] if rows else "")
            rows.append(dict(zip(head, [first, *cells[1:]], strict=False)))
        found.append(rows)
    return found


def table(page: str, *head: str) -> list[Row]:
    """The only table of a page that has these heads."""
    (found,) = [rows for rows in tables(page) if rows and set(head) <= rows[0].keys()]
    return found


def row(rows: list[Row], **cells: str) -> Row:
    """The only row with these cells; a name stands for the head with spaces in place of _."""
    wanted = {name.replace("_", " "): cell for name, cell in cells.items()}
    (found,) = [one for one in rows if wanted.items() <= one.items()]
    return found


SENSORS = ("lidar", "laser", "depth")


@pytest.mark.parametrize("map_by", SENSORS)
@pytest.mark.parametrize("query_by", SENSORS)
def test_the_table_of_sensors(map_by: str, query_by: str) -> None:
    measured = row(table("sensors.md", "map by", "3 m", "10 m"), map_by=map_by, query_by=query_by)
    shown = row(table("README.md", "map by", "lidar query"), map_by=map_by)
    assert shown[f"{query_by} query"] == f"{measured['3 m']} / {measured['10 m']}"


def test_the_table_of_peers() -> None:
    page = table("peers.md", "building", "elsewhere, wrong")
    shown = table("README.md", "recording", "wrong elsewhere")
    assert len(shown) == len(page)
    for here, there in zip(shown, page, strict=True):
        assert here["recording"].split(",")[0] == there["building"]
        assert re.sub(r" [\d.]+,", ",", here["program"]) == there["program"]
        assert here["right"] == f"{there['right']} of {there['covered']}"
        assert here["5-95 %"] == there["5-95 %"]
        wrong = int(there["wrong"]) + int(there["uncovered, wrong"].split()[0])
        assert int(here["wrong"]) == wrong
        assert here["wrong elsewhere"] == there["elsewhere, wrong"]
        assert float(here["CPU"].removesuffix(" s")) == pytest.approx(
            float(there["CPU"].split()[0]), abs=0.051
        )


def test_how_far_to_drive() -> None:
    rows = table("sensors.md", "map by", "3 m", "10 m")
    least = {m: min(round(100 * float(one[m])) for one in rows) for m in ("3 m", "10 m")}
    assert max(float(one[m]) for one in rows for m in least) == 1.0
    assert f"3 m of travel were enough for {least['3 m']} to 100 % of the drives" in FLAT
    assert f"and 10 m for {least['10 m']} to 100 %, by sensor" in FLAT


def centimetres(metres: str) -> str:
    """The median error of a row, in whole centimetres."""
    return f"{100 * float(metres.split()[0]):.0f}"


def test_one_real_floor() -> None:
    rows = table("sensors.md", "right place first", "median error")

    def counts(map_by: str, query_by: str) -> tuple[str, str]:
        one = row(rows, map_by=map_by, query_by=query_by)
        assert one["wrong"] == "0"
        return f"{one['located, right']} of {one['queries']}", centimetres(one["median error"])

    (laser, laser_cm), (lidar, lidar_cm) = counts("lidar", "laser"), counts("laser", "lidar")
    assert f"{laser} queries, none wrong, median {laser_cm} cm; the lidar in the" in FLAT
    assert f"in the laser's map: {lidar}, {lidar_cm} cm;" in FLAT
    assert f"the depth camera there: {counts('laser', 'depth')[0]}, none wrong" in FLAT
    scan = "the 3D scan itself"
    (a, a_cm), (b, b_cm), (c, c_cm) = (counts(scan, sensor) for sensor in ("lidar", "depth", "laser"))
    assert a == b
    assert f"lidar and depth camera are located {a} times, {a_cm} and {b_cm} cm, the laser's log" in FLAT
    assert f"the laser's log {c}, {c_cm} cm, none wrong" in FLAT


@pytest.mark.parametrize(
    ("said", "page", "measured"),
    [
        ("None of {1} answers `located` was wrong", "sensors.md",
         r"Wrong among located: \*\*(0) of (\d+)\*\*"),
        ("all {0} queries from another building were answered `not_found`", "sensors.md",
         r"\*\*(\d+) of (\1)\*\* `not_found`"),
    ],
)  # fmt: skip
def test_figures_in_sentences(said: str, page: str, measured: str) -> None:
    text = " ".join((ROOT / "examples" / page).read_text("utf-8").split())
    ((values),) = re.findall(measured, text)
    digits = [value.lstrip("0") if "." in value else value for value in values]
    assert said.format(*digits) in FLAT
