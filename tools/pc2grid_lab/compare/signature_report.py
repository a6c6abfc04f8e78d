"""Table and picture of what the signatures are worth."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid_cli.picture import BLUE, ORANGE, VERMILLION
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture

_SCOPES = ("building", "city")
_COLOURS = (VERMILLION, ORANGE, BLUE)
"""By metres driven."""


def _interval(values: Sequence[float] | None) -> str:
    if values is None:
        return ""
    share, low, high = values
    return f"{share:.2f}\n{low:.2f}-{high:.2f}"


def _cells(document: Mapping[str, Any]) -> dict[tuple[str, str, float], Mapping[str, Any]]:
    return {(row["scope"], row["selector"], row["travel_m"]): row for row in document["rows"]}


def print_table(document: Mapping[str, Any], selectors: Sequence[str]) -> None:
    """Print, for building and city, how often the right place is selected and the query located rightly."""
    for scope in _SCOPES:
        _print_scope(scope, document, selectors)
    _print_scale(document["scale"])
    title = "one place by two sensors against two places by one: area under the curve"
    one = table(title, ["signatures"], ["AUC", "5 % to 95 %", "pairs"])
    for name, measured in document["independence"].items():
        one.add_row(
            name,
            f"{measured['auc']:.3f}",
            f"{measured['low']:.3f}-{measured['high']:.3f}",
            f"{measured['same']:,} / {measured['other']:,}",
        )
    show(one)


def _print_scope(scope: str, document: Mapping[str, Any], selectors: Sequence[str]) -> None:
    some = next((row for row in document["rows"] if row["scope"] == scope), None)
    if some is None:
        return
    title = (
        f"{scope}: {some['places']} places, {some['queries']} queries of {some['sessions']} sessions"
        " (below: 5 % to 95 %, by session); processor time without alignment"
    )
    cells = _cells(document)
    travels_m = sorted({travel_m for _, _, travel_m in cells})
    heads = itertools.product(("selected", "right"), travels_m)
    figures = [f"{what}\n{travel_m:g} m" for what, travel_m in heads]
    shown = table(title, ["selected by"], ["places", *figures, "ms"])
    for selector in selectors:
        row = [cells.get((scope, selector, travel_m), {}) for travel_m in travels_m]
        last = next(filter(None, reversed(row)), None)
        if last is not None:
            shares = [_interval(cell.get(what)) for what, cell in itertools.product(("found", "right"), row)]
            shown.add_row(selector, str(last["looked_at"]), *shares, _milliseconds(last))
    show(shown)


def _milliseconds(cell: Mapping[str, Any]) -> str:
    return "" if cell["right"] is None else f"{cell['processor_ms']:.0f}"


def _print_scale(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print how often the right one of very many places is selected."""
    if not rows:
        return
    cells = {(r["places"], r["share"], r["selector"], r["query_sensor"], r["travel_m"]): r for r in rows}
    travels_m = sorted({r["travel_m"] for r in rows})
    title = "right place selected among very many (below: 5 % to 95 %, by session)"
    columns = ["places", "selected", *(f"{d:g} m" for d in travels_m), "ms"]
    shown = table(title, ["selected by", "query"], columns)
    for places, share, selector, sensor in dict.fromkeys(key[:4] for key in sorted(cells)):
        row = [cells.get((places, share, selector, sensor, d)) for d in travels_m]
        shown.add_row(
            selector,
            sensor,
            f"{places:,}",
            f"{100 * share:g} %",
            *(_interval(cell["found"]) if cell else "" for cell in row),
            f"{max(cell['processor_ms'] for cell in row if cell):.0f}",
        )
    show(shown)


def draw(path: Path, document: Mapping[str, Any], selectors: Sequence[str]) -> None:
    """One picture: share of the queries whose place is selected, that are located rightly, and whose place is
    selected among very many; what was not measured is left out."""
    panels = [("building", "found"), ("city", "found")]
    if any(row["right"] for row in document["rows"]):
        panels.append(("city", "right"))
    columns = len(panels) + bool(document["scale"])
    with picture(path, 5.0 * columns, 4.6) as figure:
        axes = figure.subplots(1, columns)
        for ax, (scope, what) in zip(axes, panels, strict=False):
            _draw_panel(ax, scope, what, document, selectors)
        if document["scale"]:
            _draw_scale(axes[-1], document["scale"])
        axes[1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)


def _draw_panel(
    ax: Any, scope: str, what: str, document: Mapping[str, Any], selectors: Sequence[str]
) -> None:
    """The shares of a scope: a bar for each selector and travel."""
    cells = _cells(document)
    travels_m = sorted({travel_m for _, _, travel_m in cells})
    values = {s: [cells.get((scope, s, t), {}).get(what) for t in travels_m] for s in selectors}
    named = [s for s in selectors if any(values[s])]
    height = 0.8 / max(len(travels_m), 1)
    for number, (travel_m, colour) in enumerate(zip(travels_m, _COLOURS, strict=False)):
        intervals = np.array([values[s][number] or (0.0, 0.0, 0.0) for s in named]).reshape(-1, 3)
        share, low, high = intervals.T
        ax.barh(
            np.arange(len(named)) + (number - (len(travels_m) - 1) / 2) * height,
            share,
            height,
            xerr=(np.maximum(share - low, 0), np.maximum(high - share, 0)),
            color=colour,
            ecolor="0.4",
            label=f"after {travel_m:g} m",
        )
    ax.set_yticks(np.arange(len(named)), named)
    ax.invert_yaxis()
    ax.set(xlim=(0, 1.02))
    ax.grid(axis="x", alpha=0.3)
    places = next((row["places"] for row in document["rows"] if row["scope"] == scope), 0)
    percent = 100 * document["setting"]["share"]
    title = "right place selected" if what == "found" else "located and right"
    ax.set_title(f"{title}\n{scope}: {percent:g} % of {places} places", fontsize=10)


def _draw_scale(ax: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    """Share selected against the share of the places that is looked at, for the largest number of places."""
    most = max(row["places"] for row in rows)
    chosen = [row for row in rows if (row["places"], row["query_sensor"]) == (most, "all")]
    travels_m, selectors, shares = (
        sorted({row[key] for row in chosen}) for key in ("travel_m", "selector", "share")
    )
    # Side by side, as several of them agree: lines would hide each other.
    series = list(itertools.product(reversed(selectors), travels_m))
    width = 0.8 / max(len(series), 1)
    for number, key in enumerate(series):
        selector, travel_m = key
        some = [r for r in chosen if (r["selector"], r["travel_m"]) == key]
        found, low, high = np.array([r["found"] for r in some]).T
        colour = _COLOURS[travels_m.index(travel_m)]
        ax.errorbar(
            np.searchsorted(shares, [r["share"] for r in some]) + (number - (len(series) - 1) / 2) * width,
            found,
            yerr=(found - low, high - found),
            fmt="o",
            color=colour,
            markerfacecolor=colour if selector == selectors[-1] else "white",
            markersize=6,
            elinewidth=1,
            label=selector if travel_m == travels_m[-1] else None,
        )
    ax.set(ylim=(0, 1.02), xlabel="% of the places looked at")
    ax.set_xticks(range(len(shares)), [f"{100 * share:g}" for share in shares])
    ax.grid(axis="y", alpha=0.3)
    ax.legend(loc="lower right", fontsize=8)
    ax.set_title(f"right place selected\nof {most:,} places", fontsize=10)
