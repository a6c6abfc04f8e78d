"""Tables and pictures of the sensor matrix."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pc2grid_cli.picture import BLUE, ORANGE, VERMILLION
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare.picture import picture
from pc2grid_lab.experiments.ablation import Independence
from pc2grid_lab.experiments.metrics import MatrixCell
from pc2grid_lab.experiments.trial import Trial

_SENSORS = ("lidar", "laser", "depth")


def tables(cells: Sequence[MatrixCell], elsewhere: Sequence[Trial]) -> None:
    """Print the share located and right by metres driven, and the other figures of each cell."""
    distances = sorted({cell.travel_m for cell in cells})
    last = distances[-1] if distances else 0.0
    who = ("map", "query")
    shares = table("located and right, by metres driven", who, (*(f"{d:g} m" for d in distances), "n"))
    figures = ("wrong", "ambiguous", "not found", "recall 1/5/20", "median", "95 %", "ms")
    detail = table(f"after {last:g} m", who, figures)
    for pair in itertools.product(_SENSORS, _SENSORS):
        row = {c.travel_m: c for c in cells if (c.map_sensor, c.query_sensor) == pair}
        shares.add_row(*pair, *_shares(row, distances))
        if last in row:
            detail.add_row(*pair, *_figures(row[last]))
    show(shares, detail)
    if elsewhere:
        right = sum(t.status == "not_found" for t in elsewhere)
        show(f"queries from another building: {right} of {len(elsewhere)} answered not_found")


def _shares(row: Mapping[float, MatrixCell], distances: Sequence[float]) -> list[str]:
    """Of a pair of sensors; without a row no query drove where the map is."""
    shown = [f"{row[d].located_right:.2f}" if d in row else "" if row else "-" for d in distances]
    return [*shown, str(max((cell.trials for cell in row.values()), default=0))]


def _figures(cell: MatrixCell) -> tuple[str, ...]:
    return (
        f"{cell.wrong:.3f}",
        f"{cell.ambiguous:.2f}",
        f"{cell.not_found:.2f}",
        _recall(cell.recall),
        _metres(cell.median_error_m),
        _metres(cell.p95_error_m),
        f"{cell.look_up_ms:.0f}",
    )


def draw(
    path: Path,
    cells: Sequence[MatrixCell],
    reliability: Sequence[tuple[float, float, int]],
    *,
    fitted_on: bool,
) -> None:
    """One picture: share located and right by metres for each map sensor; calibration of confidence.

    fitted_on : the reliability is that in buildings that the confidence was fitted on.
    """
    colours = dict(zip(_SENSORS, (BLUE, ORANGE, VERMILLION), strict=True))
    with picture(path, 15.0, 3.8, dpi=130) as figure:
        axes = figure.subplots(1, 4)
        for ax, map_sensor in zip(axes, _SENSORS, strict=False):
            for query_sensor, marker in zip(_SENSORS, "os^", strict=True):
                row = [c for c in cells if (c.map_sensor, c.query_sensor) == (map_sensor, query_sensor)]
                ax.plot(
                    [c.travel_m for c in row],
                    [c.located_right for c in row],
                    marker=marker,
                    color=colours[query_sensor],
                    label=f"{query_sensor} query",
                )
            farthest_m = max((c.travel_m for c in cells), default=1.0)
            ax.set(title=f"{map_sensor} map", xlabel="driven, m", xlim=(0, 1.05 * farthest_m), ylim=(0, 1.03))
            ax.grid(alpha=0.3)
        axes[0].set_ylabel("located and right")
        axes[0].legend(loc="lower right")
        axes[3].plot([0, 1], [0, 1], color="0.6", lw=1)
        if reliability:
            confidence, right, count = zip(*reliability, strict=True)
            axes[3].scatter(confidence, right, s=[20 + 2 * min(n, 200) for n in count], color=BLUE, alpha=0.7)
        axes[3].set(title=_RELIABILITY[fitted_on], xlabel="confidence", ylabel="share that was right")
        axes[3].grid(alpha=0.3)


_RELIABILITY = {True: "confidence, buildings of its fit", False: "confidence, other buildings"}

Recalls = Mapping[str, Mapping[str, Mapping[int, float | None]]]
"""Recall by query sensor, by what is used, and by the number of retrieved places."""


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _recall(shares: Mapping[int, float | None]) -> str:
    return "/".join("-" if share is None else f"{share:.2f}" for share in shares.values())


def contribution_table(independent: Mapping[str, Independence], recalls: Recalls, travel_m: float) -> None:
    """Print what each signature contributes: AUC across sensors, and recall of places."""
    title = f"what the signatures contribute; recall at 1/5/20 after {travel_m:g} m"
    shown = table(title, ["signatures"], ["AUC across sensors", *recalls])
    for name in recalls["all"]:
        auc = f"{independent[name].auc:.3f}" if name in independent else ""
        shares = (_recall(row[name]) for row in recalls.values())
        shown.add_row(name, auc, *shares)
    show(shown)


def draw_signatures(path: Path, independent: Mapping[str, Independence], recalls: Recalls) -> None:
    """One picture: distances of one place across sensors against other places; AUC; the ablation."""
    with picture(path, 15.0, 4.2, dpi=130) as figure:
        left, middle, right = figure.subplots(1, 3)
        whole = list(independent.values())[-1]
        if len(whole.same) and len(whole.other):
            bins = np.linspace(0.0, float(np.quantile(np.concatenate((whole.same, whole.other)), 0.999)), 60)
            for values, colour, label in (
                (whole.same, BLUE, "one place, two sensors"),
                (whole.other, VERMILLION, "two places, one sensor"),
            ):
                left.hist(values, bins, density=True, color=colour, alpha=0.6, label=label)
            left.legend()
        left.set(title="distance by all three signatures (Eq. 6)", xlabel="distance", ylabel="density")
        names = list(independent)
        middle.barh(names, [independent[name].auc for name in names], color=BLUE)
        middle.set(title="AUC: one place across sensors before others", xlim=(0.5, 1.0))
        middle.invert_yaxis()
        rows = list(recalls["all"])
        height = 0.27
        for offset, (k, colour) in enumerate(zip((1, 5, 20), (VERMILLION, ORANGE, BLUE), strict=True)):
            at = np.arange(len(rows)) + (offset - 1) * height
            right.barh(
                at, [recalls["all"][name][k] or 0.0 for name in rows], height, color=colour, label=f"at {k}"
            )
        right.set(title="recall of the right place, all sensors", xlim=(0.0, 1.0))
        right.set_yticks(np.arange(len(rows)), rows)
        right.invert_yaxis()
        right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=3)
        for ax in (middle, right):
            ax.grid(axis="x", alpha=0.3)
