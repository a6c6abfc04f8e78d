"""The one style of the tables that commands print on stdout."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from rich.table import Table

_WIDEST = 10_000
"""Columns of text: a table is as wide as what it holds. A narrow terminal breaks its lines, but nothing is
left out."""


def table(title: str, texts: Iterable[str], numbers: Iterable[str] = ()) -> Table:
    """An empty table: columns of texts, aligned left, and then columns of numbers, aligned right."""
    made = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        highlight=False,
    )
    for heading in texts:
        made.add_column(heading, no_wrap=True)
    for heading in numbers:
        made.add_column(heading, justify="right", no_wrap=True)
    return made


def show(*parts: Table | str) -> None:
    """Print tables, and sentences between them."""
    console = Console(width=_WIDEST, highlight=False)
    for part in parts:
        if isinstance(part, str):
            print(part)
        else:
            console.print(part)
