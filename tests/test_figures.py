"""The figures of README are those of the pages that they come from.

Tables are compared cell by cell. Of figures in sentences the words that README must have are made from the
cells of the page.
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


def test_the_table_of_real_sensors_is_that_of_the_page() -> None:
    head = ("query by", "in a map by lidar")
    assert table("README.md", *head) == table("real.md", *head)


def test_elsewhere_is_what_the_page_counts() -> None:
    (total,) = [
        one
        for one in table("real.md", "building", "elsewhere: wrong of asked")
        if one["building"] == "all queries"
    ]
    wrong, _, asked, *_ = total["elsewhere: wrong of asked"].split()
    verb = "was" if wrong == "1" else "were"
    assert f"In the map of another building, {wrong} of {asked} queries {verb} located." in FLAT


def test_robots_that_are_carried_away_are_those_of_the_page() -> None:
    page = " ".join((ROOT / "examples" / "real.md").read_text("utf-8").split())
    (found,) = re.findall(
        r"Of (\d+) kidnaps of a robot that knew where it was, (\d+) are noticed, (\S+) s and (\S+) m after "
        r"it was put down, in the median. In (\d+) of them the map shows what it sees there; it is located "
        r"again (\d+) times, (\S+) s and (\S+) m after, in the median;.*? what it sees: (\d+) in (\d+) rows. "
        r"Of (\d+) places that can be judged, (\d+) are wrong.",
        page,
    )
    kidnaps, noticed, s, m, shown, again, again_s, again_m, alarms, rows, judged, wrong = found
    said = (
        f"Of {kidnaps} such robots, {noticed} noticed it, {s} s and {m} m after they were put down (median). "
        f"At {shown} of the new places the map shows what the robot sees: {again} robots were located again, "
        f"after {again_s} s and {again_m} m. There were {alarms} false alarms in {rows} drives, and of "
        f"{judged} poses {wrong} were wrong."
    )
    assert said in FLAT


MEASURED = ("comparisons", "paper", "real")


@pytest.mark.parametrize("page", MEASURED)
def test_a_page_of_figures_names_the_program_that_made_them(page: str) -> None:
    head = "\n".join((ROOT / "examples" / f"{page}.md").read_text("utf-8").splitlines()[:8])
    assert re.search(r"of commit [0-9a-f]{7}|\([0-9a-f]{7}\)", head)
