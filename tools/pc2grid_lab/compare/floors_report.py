"""Table and picture of `pc2grid compare floors`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from scipy.stats import binomtest

from pc2grid.model import UNKNOWN, OccupancyGrid
from pc2grid_cli.picture import GREEN, GREY, ORANGE, VERMILLION
from pc2grid_cli.tables import table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.floors import (
    STATUSES,
    FloorAnswer,
    FloorResult,
    FloorStatus,
    FloorTask,
    share_of,
)
from pc2grid_lab.experiments.trial import JUDGEMENT

House = tuple[FloorTask, FloorResult]

_LIGHT_BLUE = "#A6CBE6"
_COLOURS: dict[FloorStatus, str] = {
    "right": GREEN,
    "ambiguous": _LIGHT_BLUE,
    "not_found": GREY,
    "wrong": VERMILLION,
}
_SHOWN: dict[FloorStatus, str] = {
    "right": "right floor",
    "ambiguous": "ambiguous",
    "not_found": "not found",
    "wrong": "wrong floor",
}
_EXPLAINED: dict[FloorStatus, str] = {**_SHOWN, "ambiguous": "ambiguous: several places fit"}


def mapped(result: FloorResult, grids: Mapping[str, OccupancyGrid]) -> FloorResult:
    """The result without the queries from where the map of their floor shows nothing, or little.

    grids : of the sessions of the house's database.
    """

    def is_in_the_map(answer: FloorAnswer) -> bool:
        shares = []
        for name in (name for name, floor in result.floors.items() if floor == answer.floor):
            grid, T_map_query = grids[name], result.frames[name].inverse() @ answer.T_house_query
            cells = grid.to_cell(T_map_query.apply(answer.walls_m))
            inside = np.all((cells >= 0) & (cells < grid.cells.shape), axis=1)
            known = grid.cells[tuple(cells[inside].T)] != UNKNOWN
            shares.append(known.sum() / max(len(cells), 1))
        return max(shares, default=0.0) >= JUDGEMENT.mapped

    return replace(result, answers=tuple(filter(is_in_the_map, result.answers)))


def floors_table(houses: Sequence[House], in_the_map: Sequence[House]) -> Table:
    """A row for each way and kind of furniture. in_the_map : the same houses, as `mapped` has them."""
    counts = ("houses", "told apart", "named", *(_SHOWN[status] for status in STATUSES), "misplaced")
    made = table(
        "floors with one plan",
        ("by", "furniture"),
        (*counts, "wrong up to", "in the map", "right or ambiguous there"),
    )
    for way, alike in dict.fromkeys((task.way, task.alike) for task, _ in houses):
        group, there = (
            [(task, result) for task, result in some if (task.way, task.alike) == (way, alike)]
            for some in (houses, in_the_map)
        )
        made.add_row(way, _furniture(alike), *_row([result for _, result in group]), *_share(there))
    return made


def _row(results: Sequence[FloorResult]) -> list[str]:
    """The counts of some houses, and the upper bound of the share that is wrong."""
    named = (sum(result.told_apart for result in results), sum(result.named for result in results))
    counts = [sum(result.count(status) for result in results) for status in STATUSES]
    misplaced = sum(result.misplaced for result in results)
    wrong, queries = counts[STATUSES.index("wrong")], sum(len(result.answers) for result in results)
    bound = binomtest(wrong, queries).proportion_ci(method="wilson").high
    return [*map(str, (len(results), *named, *counts, misplaced)), f"{bound:.1%}"]


def _share(there: Sequence[House]) -> tuple[str, str]:
    """Queries in the map, and the share of them that is right or ambiguous with its interval."""
    count = sum(len(result.answers) for _, result in there)
    share = "{:.3f} [{:.3f}, {:.3f}]".format(*share_of(there, ("right", "ambiguous"))) if count else ""
    return str(count), share


def _furniture(alike: bool) -> str:
    return "alike" if alike else "differs"


def draw(path: Path, houses: Sequence[House], grids: Mapping[str, OccupancyGrid], example: House) -> None:
    """The answers in each house, a panel for each way, and below them one query on the map of each floor.

    example : the house of that query. grids : of the sessions of its database.
    """

    of_way: dict[str, list[House]] = {}
    for house in houses:
        of_way.setdefault(house[0].way, []).append(house)
    task, result = example
    answer = example_answer(result)
    bars_in = 1.2 + 0.22 * max(map(len, of_way.values()))
    with picture(path, 11.0, bars_in + 4.2) as figure:
        bars, maps = figure.subfigures(2, 1, height_ratios=(bars_in, 4.2))
        _draw_bars(bars, of_way)
        floors = maps.subplots(1, len(task.floors), squeeze=False, sharex=True, sharey=True)[0]
        for ax, floor in zip(floors, task.floors, strict=True):
            _draw_floor(ax, floor, result, answer, grids)
        maps.suptitle(
            f"a query made on floor {answer.floor} of house {task.seed} (by {task.way}, furniture"
            f" {_furniture(task.alike)}) fits on {len(answer.poses)} floors: {_SHOWN[answer.status]},"
            f" confidence {answer.confidence:.3f}",
            fontsize=10,
        )


def example_of(houses: Sequence[House]) -> House:
    """The house that says most: the first with a wrong answer, else the first with an ambiguous one, else
    the first."""
    for status in _BY_INTEREST:
        for house in houses:
            if house[1].count(status):
                return house
    return houses[0]


def example_answer(result: FloorResult) -> FloorAnswer:
    """The answer that is drawn: the most telling status and, of these, the one that fits on most maps."""
    return min(result.answers, key=lambda answer: (_BY_INTEREST.index(answer.status), -len(answer.poses)))


_BY_INTEREST: tuple[FloorStatus, ...] = ("wrong", "ambiguous", "right", "not_found")


def _draw_bars(figure: Any, of_way: Mapping[Any, Sequence[House]]) -> None:
    """A panel for each way, and above them how many answers name a wrong floor."""
    panels = figure.subplots(1, len(of_way), squeeze=False)[0]
    for ax, (way, houses) in zip(panels, of_way.items(), strict=True):
        _draw_answers(ax, way, houses)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    results = [result for houses in of_way.values() for _, result in houses]
    wrong = sum(result.count("wrong") for result in results)
    queries = sum(result.count(status) for result in results for status in _COLOURS)
    figure.suptitle(
        f"floors with one plan: {wrong} of {queries} answers name a wrong floor"
        " (houses with furniture alike (a) or different (d) on each floor; x: floors not told apart)",
        fontsize=10,
    )


def _draw_answers(ax: Any, way: str, houses: Sequence[House]) -> None:
    """A bar for each house."""
    names = [f"{task.seed}{'a' if task.alike else 'd'}" for task, _ in houses]
    rows, before = range(len(houses)), [0] * len(houses)
    for status, colour in _COLOURS.items():
        counts = [result.count(status) for _, result in houses]
        ax.barh(rows, counts, left=before, color=colour, height=0.8, label=_EXPLAINED[status])
        before = [a + b for a, b in zip(before, counts, strict=True)]
    for row, (_, result) in enumerate(houses):
        if not result.told_apart:
            ax.plot(before[row] + 0.5, row, "x", color=VERMILLION, ms=6)
    ax.set_yticks(rows, names, fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("queries", fontsize=8)
    ax.set_title(way, fontsize=9)
    ax.tick_params(labelsize=7)


def _draw_floor(
    ax: Any, floor: int, result: FloorResult, answer: FloorAnswer, grids: Mapping[str, OccupancyGrid]
) -> None:
    """The maps of a floor in the frame of the house, and the query where it fits on them."""
    sessions = [name for name, other in result.floors.items() if other == floor]
    for name in sessions:
        T_house_map, grid = result.frames[name], grids[name]
        for cells, colour, size in ((grid.free, "0.9", 2.2), (grid.occupied, "0.2", 1.6)):
            points = T_house_map.apply(grid.to_point(np.argwhere(cells)))
            ax.plot(*points.T, "s", color=colour, ms=size, mew=0)
    if floor == answer.floor:
        true = answer.T_house_query.apply(answer.walls_m)
        ax.plot(*true.T, ".", color=GREEN, ms=6.0, mew=0, alpha=0.4, label="query, true place")
    label: str | None = "query, where it fits"
    for name in filter(answer.poses.__contains__, sessions):
        walls = (result.frames[name] @ answer.poses[name]).apply(answer.walls_m)
        colour = VERMILLION if name == answer.session and answer.status == "wrong" else ORANGE
        ax.plot(*walls.T, ".", color=colour, ms=2.5, mew=0, label=label)
        label = None  # once in the legend
    called = ", ".join(f"{name} ({result.names[name]})" for name in sessions)
    ax.set_title(f"floor {floor}: {called or 'no map'}", fontsize=8)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, loc="upper left", markerscale=2.0)
