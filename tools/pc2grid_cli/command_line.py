"""How the words of a command are read, in addition to what typer does.

Global options are understood behind the command as well, where people put them. `--dask` and `--rerun` may
stand without a value, for which typer has no notation.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from typing import Any, Literal

import typer
from typer.core import TyperCommand, TyperGroup

from pc2grid_cli.console import Console
from pc2grid_cli.rerun_target import VIEWER, names_target

# Colours and boxes cost a tenth of a second at every --help; they are for terminals that want them.
_FANCY = sys.stderr.isatty() and sys.stdout.isatty() and not os.environ.get("NO_COLOR")
MARKUP: Literal["rich"] | None = "rich" if _FANCY else None
"""How typer prints help."""

_WITHOUT_VALUE: dict[str, tuple[str, Callable[[str], bool]]] = {
    "--dask": ("local", lambda word: "://" in word),
    "--rerun": (VIEWER, names_target),
}
"""By option: the value that it has if none follows, and whether a following word is a value."""


class Command(TyperCommand):
    """A command that takes the global options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Apply the global options, and complete options that stand without a value."""
        return super().parse_args(ctx, _read(self.params, ctx, args, until_command=False))


class Group(TyperGroup):
    """A group of commands that takes the global options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Apply the global options that stand before the command."""
        return super().parse_args(ctx, _read(self.params, ctx, args, until_command=True))


def _read(params: Iterable[Any], ctx: typer.Context, words: list[str], *, until_command: bool) -> list[str]:
    """The words without global options.

    Words that are the value of an option are left alone, and so are those behind `--`, and behind the name of
    a command if `until_command`.
    """
    console = ctx.ensure_object(Console)
    names = {name: param for param in params for name in param.opts if name.startswith("-")}
    left: list[str] = []
    position = 0
    while position < len(words):
        word = words[position]
        if word == "--" or (until_command and not word.startswith("-")):
            break
        position += 1
        if word in _WITHOUT_VALUE and word in names:
            value, is_value = _WITHOUT_VALUE[word]
            if position < len(words) and is_value(words[position]):
                value = words[position]
                position += 1
            left.append(f"{word}={value}")
        elif word in names and not names[word].is_flag and not names[word].count:
            left += [word, *words[position : position + names[word].nargs]]
            position += names[word].nargs
        elif not console.apply(word):
            left.append(word)
    return left + words[position:]
