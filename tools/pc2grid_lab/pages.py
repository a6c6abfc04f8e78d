"""The one writer of pages: tables in Markdown, shares with their intervals, pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import binomtest

from pc2grid.io.atomic import replace_file
from pc2grid_cli import output

ALPHA = 0.05

Cell = dict[str, Any]
"""A row of a printed table, by the names of its columns."""
Heads = tuple[Sequence[str], Sequence[str], Sequence[str]]
"""Of columns of text, of columns of numbers, and of further columns of text."""


def markdown(heads: Heads, rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    before, numbers, behind = heads
    sides = ["---"] * len(before) + ["---:"] * len(numbers) + ["---"] * len(behind)
    return [
        "| " + " | ".join([*before, *numbers, *behind]) + " |",
        "|" + "|".join(sides) + "|",
        *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows),
    ]


def print_cells(title: str, texts: int, cells: Sequence[Mapping[str, Any]]) -> None:
    """Print cells with the same names as the rows of a table. texts : how many columns are no numbers."""
    if cells:
        names = [name.replace("_", " ") for name in cells[0]]
        shown = output.table(title, names[:texts], names[texts:])
        for cell in cells:
            shown.add_row(*map(_shown, cell.values()))
        output.show(shown)


def _shown(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "/".join(map(_shown, value))
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def number(value: float | None, digits: int) -> str:
    """Return a number with so many digits behind the point; of None, nothing."""
    return "" if value is None else f"{value:.{digits}f}"


def strong(count: int) -> str:
    """Return a count that should be 0."""
    return f"**{count}**" if count else "0"


def share(part: int, whole: int) -> str:
    """Return a share with its interval; of nothing, nothing."""
    if not whole:
        return ""
    low, high = clopper_pearson(part, whole)
    return f"{part} of {whole} [{low:.2f}, {high:.2f}]"


def clopper_pearson(successes: int, trials: int, alpha: float = ALPHA) -> tuple[float, float]:
    """Return the exact interval of a share that was seen `successes` times in `trials` (Clopper and Pearson,
    1934).

    >>> low, high = clopper_pearson(0, 20)
    >>> low, round(high, 3)
    (0.0, 0.168)
    """
    interval = binomtest(successes, trials).proportion_ci(1.0 - alpha)
    return float(interval.low), float(interval.high)


def by_chance(worse: int, better: int) -> float:
    """Return the probability that at least `worse` of the queries whose result changed became worse.

    If either were as likely as the other (sign test of McNemar, one-sided).

    >>> by_chance(5, 0), by_chance(1, 1)
    (0.03125, 0.75)
    """
    return float(binomtest(worse, worse + better, alternative="greater").pvalue)


@contextmanager
def picture(path: Path, width_in: float, height_in: float, *, dpi: int = 110) -> Iterator[Any]:
    """Return a figure of matplotlib that is a PNG file when the body ends."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    with replace_file(path) as draft:
        figure.savefig(draft, format="png", metadata={"Software": "pc2grid"})
