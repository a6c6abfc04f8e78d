"""Table and picture of what the signatures are worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pc2grid_cli.tables import show, table

_SCOPES = ("building", "city")


def _interval(values: Sequence[float] | None) -> str:
    if values is None:
        return ""
    share, low, high = values
    return f"{share:.2f}\n{low:.2f}-{high:.2f}"


def _cells(document: Mapping[str, Any]) -> dict[tuple[str, str, float], Mapping[str, Any]]:
    return {(row["scope"], row["selector"], row["travel_m"]): row for row in document["rows"]}


def print_table(document: Mapping[str, Any], selectors: Sequence[str]) -> None:
    """Print, for building and city, how often the right place is selected and the query located rightly."""
    cells = _cells(document)
    travels_m = sorted({travel_m for _, _, travel_m in cells})
    for scope in _SCOPES:
        rows = [row for row in document["rows"] if row["scope"] == scope]
        if not rows:
            continue
        some = rows[0]
        title = (
            f"{scope}: {some['places']} places, {some['queries']} queries of {some['sessions']} sessions"
            " (below: 5 % to 95 %, by session); processor time without alignment"
        )
        figures = [f"{what}\n{travel_m:g} m" for what in ("selected", "right") for travel_m in travels_m]
        shown = table(title, ["selected by"], ["places", *figures, "ms"])
        for selector in selectors:
            row = [cells.get((scope, selector, travel_m)) for travel_m in travels_m]
            if not any(row):
                continue
            last = next(cell for cell in reversed(row) if cell)
            shown.add_row(
                selector,
                str(last["looked_at"]),
                *(_interval(cell["found"]) if cell else "" for cell in row),
                *(_interval(cell["right"]) if cell else "" for cell in row),
                f"{last['processor_ms']:.0f}" if last["right"] is not None else "",
            )
        show(shown)
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
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    from pc2grid.io.atomic import replace_file
    from pc2grid_cli.picture import BLUE, ORANGE, VERMILLION

    cells = _cells(document)
    travels_m = sorted({travel_m for _, _, travel_m in cells})
    panels = [("building", "found"), ("city", "found")]
    if any(row["right"] for row in document["rows"]):
        panels.append(("city", "right"))
    columns = len(panels) + bool(document["scale"])
    figure, axes = plt.subplots(1, columns, figsize=(5 * columns, 4.6), constrained_layout=True)
    for ax, (scope, what) in zip(axes, panels, strict=False):
        named = [s for s in selectors if any(cells.get((scope, s, t), {}).get(what) for t in travels_m)]
        at, height = np.arange(len(named)), 0.8 / max(len(travels_m), 1)
        for number, (travel_m, colour) in enumerate(zip(travels_m, (VERMILLION, ORANGE, BLUE), strict=False)):
            values = [cells.get((scope, s, travel_m), {}).get(what) or (0.0, 0.0, 0.0) for s in named]
            share, low, high = np.array(values).reshape(-1, 3).T
            ax.barh(
                at + (number - (len(travels_m) - 1) / 2) * height,
                share,
                height,
                xerr=(np.maximum(share - low, 0), np.maximum(high - share, 0)),
                color=colour,
                ecolor="0.4",
                label=f"after {travel_m:g} m",
            )
        ax.set_yticks(at, named)
        ax.invert_yaxis()
        ax.set(xlim=(0, 1.02))
        ax.grid(axis="x", alpha=0.3)
        places = next((row["places"] for row in document["rows"] if row["scope"] == scope), 0)
        percent = 100 * document["setting"]["share"]
        title = "right place selected" if what == "found" else "located and right"
        ax.set_title(f"{title}\n{scope}: {percent:g} % of {places} places", fontsize=10)
    if document["scale"]:
        _draw_scale(axes[-1], document["scale"])
    axes[1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)
    with replace_file(path) as draft:
        figure.savefig(draft, format="png", dpi=110)
    plt.close(figure)


def _draw_scale(ax: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    """Share selected against the share of the places that is looked at, for the largest number of places."""
    from pc2grid_cli.picture import BLUE, ORANGE, VERMILLION

    most = max(row["places"] for row in rows)
    chosen = [row for row in rows if row["places"] == most and row["query_sensor"] == "all"]
    travels_m = sorted({row["travel_m"] for row in chosen})
    selectors = sorted({row["selector"] for row in chosen}, reverse=True)
    shares = sorted({row["share"] for row in chosen})
    # Side by side, as several of them agree: lines would hide each other.
    series = [(selector, travel_m) for selector in selectors for travel_m in travels_m]
    width = 0.8 / max(len(series), 1)
    colours = dict(zip(travels_m, (VERMILLION, ORANGE, BLUE), strict=False))
    for number, (selector, travel_m) in enumerate(series):
        some = {
            r["share"]: r["found"] for r in chosen if (r["selector"], r["travel_m"]) == (selector, travel_m)
        }
        at = [shares.index(share) + (number - (len(series) - 1) / 2) * width for share in some]
        found, low, high = zip(*some.values(), strict=True)
        around = [
            [f - a for f, a in zip(found, low, strict=True)],
            [b - f for f, b in zip(found, high, strict=True)],
        ]
        colour = colours[travel_m]
        ax.errorbar(
            at,
            found,
            yerr=around,
            fmt="o",
            color=colour,
            markerfacecolor=colour if selector == selectors[0] else "white",
            markersize=6,
            elinewidth=1,
            label=selector if travel_m == travels_m[-1] else None,
        )
    ax.set(ylim=(0, 1.02), xlabel="% of the places looked at")
    ax.set_xticks(range(len(shares)), [f"{100 * share:g}" for share in shares])
    ax.grid(axis="y", alpha=0.3)
    ax.legend(loc="lower right", fontsize=8)
    ax.set_title(f"right place selected\nof {most:,} places", fontsize=10)
