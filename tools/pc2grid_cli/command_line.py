"""How the words of a command are read, in addition to what typer does.

Global options are understood behind the command as well, where people put them. The declaration of a command
is imported when it is used, and what does its work when it runs (`commands.py`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from functools import cached_property
from importlib import import_module
from typing import Annotated, Any, ClassVar, Literal

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from pc2grid.errors import ConfigError
from pc2grid_cli import console
from pc2grid_cli.removed import REMOVED

# Colours and boxes cost a tenth of a second at every --help; they are for terminals that want them.
_FANCY = sys.stderr.isatty() and sys.stdout.isatty() and not os.environ.get("NO_COLOR")
MARKUP: Literal["rich"] | None = "rich" if _FANCY else None
"""How typer prints help."""

LABORATORY = "pc2grid_lab"
"""The package that a clone of the repository has, and the wheel has not."""


def _apply(context: typer.Context, option: typer.CallbackParam, value: int) -> None:
    """Add what a global option says to what the console knows."""
    terminal = console.of(context)
    if option.name == "verbose":
        terminal.verbose += value
    elif value:
        setattr(terminal, str(option.name), True)


def _global_options(
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            callback=_apply,
            expose_value=False,
            show_default=False,
            help="print more; twice: still more",
        ),
    ] = 0,
    quiet: Annotated[
        bool,
        typer.Option("--quiet", "-q", callback=_apply, expose_value=False, help="only warnings and errors"),
    ] = False,
    debug: Annotated[
        bool,
        typer.Option("--debug", callback=_apply, expose_value=False, help="tracebacks for errors"),
    ] = False,
) -> None:
    """The options that may stand before and behind any command."""


_made = typer.Typer(add_completion=False)
_made.command()(_global_options)
_GLOBAL = get_command(_made).params


class Command(TyperCommand):
    """A command that takes the global options."""

    def __init__(self, *arguments: Any, **about: Any) -> None:
        super().__init__(*arguments, **about)
        self.params += _GLOBAL

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Let an error say what to type."""
        try:
            return super().parse_args(ctx, args)
        except Exception as error:  # its class is not public
            _hint_of_removed(error, ctx, getattr(error, "option_name", ""))
            raise


class LateCommand(TyperCommand):
    """A command that is known by its name and one sentence until it is used."""

    def __init__(self, name: str, function: str, sentence: str) -> None:
        """function : "package.module:function". sentence : what lists of commands say of it."""
        super().__init__(name, help=sentence)
        self._function = function

    @cached_property
    def command(self) -> Any:
        """The command itself."""
        name, _, function = self._function.partition(":")
        try:
            module = import_module(name)
        except ModuleNotFoundError as error:
            if error.name != LABORATORY:
                raise
            raise ConfigError(
                f"pc2grid compare {self.name}: not installed; only a clone of the repository has it",
                hint="in the clone: pip install -e .",
            ) from None
        app = typer.Typer(add_completion=False, rich_markup_mode=MARKUP, pretty_exceptions_enable=False)
        app.command(self.name, cls=Command)(getattr(module, function))
        return get_command(app)

    def make_context(self, *arguments: Any, **more: Any) -> Any:
        """The context of the command itself."""
        return self.command.make_context(*arguments, **more)


class Group(TyperGroup):
    """A group of commands that takes the global options."""

    late: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """By name: "package.module:function", and one sentence about the command."""

    def __init__(self, **about: Any) -> None:
        super().__init__(**about)
        self.params += _GLOBAL
        self.commands = {**{name: LateCommand(name, *of) for name, of in self.late.items()}, **self.commands}

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the words name, with the words behind its name."""
        try:
            return super().resolve_command(ctx, args)
        except Exception as error:  # its class is not public
            _hint_of_removed(error, ctx, args[0])
            raise


def group(commands: Mapping[str, tuple[str, str]]) -> type[Group]:
    """A group of commands, which are imported when they are used; see `Group.late`."""
    return type("Group", (Group,), {"late": commands})


def _hint_of_removed(error: Exception, ctx: Any, word: str) -> None:
    """Let the error for an unknown command or option say what to use, if there was one of that name."""
    error.suggestion = REMOVED.get(f"{ctx.command_path} {word}")  # type: ignore[attr-defined]
