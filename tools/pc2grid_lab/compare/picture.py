"""A picture of the results of a comparison."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pc2grid.io.atomic import replace_file


@contextmanager
def picture(path: Path, width_in: float, height_in: float, *, dpi: int = 110) -> Iterator[Any]:
    """A figure of matplotlib that is a PNG file when the body ends."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    with replace_file(path) as draft:
        figure.savefig(draft, format="png", metadata={"Software": "pc2grid"})
