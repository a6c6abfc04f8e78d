"""Table and picture of `pc2grid compare peers`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pc2grid_cli.picture import BLUE, GREEN, VERMILLION
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.peers.environment import PEERS
from pc2grid_lab.peers.outcome import PeerCell


def print_table(cells: Sequence[PeerCell], sensors: Mapping[str, str], missing: Mapping[str, str]) -> None:
    """Print a row for each building and program. sensors : of each building."""
    title = "later parts of recordings in a map of an earlier part; of the queries that the map covers:"
    figures = ("covered", "right", "5-95 %", "wrong", "none", "uncovered\nwrong", "elsewhere\nwrong")
    shown = table(title, ("building", "program"), (*figures, "off by", "CPU", "CPU\nelsewhere", "memory"))
    by_pair = {(cell.site, cell.peer): cell for cell in cells}
    for site, sensor in sensors.items():
        for kind in PEERS:
            if sensor not in kind.sensors:
                continue
            cell = by_pair.get((site, kind.name))
            shown.add_row(f"{site}, {sensor}", kind.title, *(("",) * 11 if cell is None else _figures(cell)))
    notes = [f"{name} is not installed: {command}" for name, command in missing.items()]
    show(
        shown,
        "uncovered wrong, elsewhere wrong: answers to queries that have no right one. pc2grid decides itself;"
        " the others have the threshold with the most right answers less wrong ones in this very table",
        *notes,
    )


def _figures(cell: PeerCell) -> tuple[str, ...]:
    return (
        str(cell.covered),
        str(cell.right),
        "" if cell.right_low is None else f"{cell.right_low:.2f}-{cell.right_high:.2f}",
        str(cell.wrong),
        str(cell.unanswered),
        f"{cell.uncovered_wrong} of {cell.uncovered}",
        f"{cell.elsewhere_wrong} of {cell.elsewhere}",
        "" if cell.median_error_m is None else f"{cell.median_error_m:.2f} m",
        *("" if cpu_s is None else f"{cpu_s:.2f} s" for cpu_s in (cell.cpu_s, cell.elsewhere_cpu_s)),
        f"{cell.peak_mb:.0f} MB",
    )


def draw(path: Path, cells: Sequence[PeerCell], sensors: Mapping[str, str]) -> None:
    """A bar for each building and program: right, none and wrong of all queries, elsewhere included.

    In the building, queries that the map does not cover are rightly left without an answer, as those
    elsewhere are.
    """
    order = [cell for site in sensors for cell in cells if cell.site == site]
    with picture(path, 9.0, 0.9 + 0.3 * max(len(order), 1)) as figure:
        inside, outside = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        for y, cell in enumerate(order):
            rest, elsewhere = cell.covered - cell.right - cell.wrong, cell.uncovered + cell.elsewhere
            wrong = cell.uncovered_wrong + cell.elsewhere_wrong
            _draw_bar(inside, y, ((cell.right, GREEN), (rest, "0.85"), (cell.wrong, VERMILLION)))
            _draw_bar(outside, y, ((elsewhere - wrong, BLUE), (wrong, VERMILLION)))
        titles = {kind.name: kind.title for kind in PEERS}
        names = [f"{cell.site}: {titles[cell.peer]}" for cell in order]
        inside.set_yticks(range(len(order)), names, fontsize=8)
        if order:
            inside.invert_yaxis()
        inside.set_title("covered by the map: right, none, wrong", fontsize=9)
        outside.set_title("not in the map: refused, wrong", fontsize=9)
        for axes in (inside, outside):
            axes.set(xlim=(0, 1))
            axes.tick_params(labelsize=7, axis="x")
            axes.set_xlabel("share of the queries", fontsize=8)


def _draw_bar(axes: Any, y: int, parts: Sequence[tuple[int, str]]) -> None:
    """Counts and their colours, as shares of their sum."""
    left, total = 0.0, max(sum(count for count, _ in parts), 1)
    for count, colour in parts:
        axes.barh(y, count / total, left=left, color=colour, height=0.75)
        if count:
            axes.text(left + count / total / 2, y, str(count), ha="center", va="center", fontsize=7)
        left += count / total
