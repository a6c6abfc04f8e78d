"""The program `pc2grid`: global options and the list of commands.

How the words of a command are read, in addition to what typer does.

Global options are understood behind the command as well, where people put them. The declaration of a command
is imported when it is used, and what does its work when it runs (`commands.py`).

What is said of commands and options that the program had before.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Mapping
from functools import cached_property
from importlib import import_module
from typing import Annotated, Any, ClassVar, Literal

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

import pc2grid
from pc2grid import libraries as threads
from pc2grid.errors import ConfigError
from pc2grid_cli import console

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


_NEW_OBJECTS = 100_000
"""After so many new objects the collector looks for cycles. `convert` leaves 2,000 objects in cycles in 150 s
of a laser."""
# Name, "package.module:function", and what lists of commands say of it.
COMMANDS = {
    "demo": ("pc2grid_cli.commands:demo_command", "Map a simulated office, and find another robot in it."),
    "simulate": ("pc2grid_cli.commands:simulate_command", "Drive a robot through a building and record it."),
    "info": ("pc2grid_cli.commands:info_command", "Say what is in a recording, a map or a database."),
    "convert": ("pc2grid_cli.commands:convert_command", "Make a submap database from recordings or maps."),
    "relocalize": ("pc2grid_cli.commands:relocalize_command", "Find where a recording was made."),
    "watch": ("pc2grid_cli.commands:watch_command", "Find where a running robot is, while it drives."),
    "export": ("pc2grid_cli.commands:export_command", "Write a session's map, trajectory, picture or page."),
    "view": ("pc2grid_cli.commands:view_command", "Look into a database in the browser, and locate there."),
}
DB = {
    "info": ("pc2grid_cli.commands:db_info_command", "Show the sessions of a database."),
    "check": ("pc2grid_cli.commands:db_check_command", "Read everything and list all damage."),
    "merge": ("pc2grid_cli.commands:db_merge_command", "Put the sessions of several databases into one."),
    "join": (
        "pc2grid_cli.commands:db_join_command",
        "Find out how sessions of a building lie to each other.",
    ),
    "copy": ("pc2grid_cli.commands:db_copy_command", "Write a compact copy of a database."),
    "split": ("pc2grid_cli.commands:db_split_command", "Copy sessions into a database of their own."),
    "rename": ("pc2grid_cli.commands:db_rename_command", "Give a session another name."),
    "remove": ("pc2grid_cli.commands:db_remove_command", "Remove sessions from a database."),
}
CONFIG = {
    "dump": ("pc2grid_cli.commands:config_dump_command", "Print every setting as TOML."),
    "schema": ("pc2grid_cli.commands:config_schema_command", "Print the JSON Schema of a document."),
}
# Commands of the laboratory. No module of the product imports it: it is loaded by name when it is asked for.
COMPARE = {
    "recordings": (
        "pc2grid_lab.commands:compare_recordings_command",
        "Real recordings as maps, located in each other; and what changed.",
    ),
    "sensors": ("pc2grid_lab.commands:compare_sensors_command", "Each sensor in the maps of each."),
    "peers": (
        "pc2grid_lab.commands:compare_peers_command",
        "Other programs, the same maps and queries.",
    ),
    "paper": ("pc2grid_lab.commands:compare_paper_command", "The paper's tables and figures 9 and 10."),
    "scale": ("pc2grid_lab.commands:compare_scale_command", "The paper's recall in larger databases."),
}

app = typer.Typer(
    cls=group(COMMANDS),
    help="Recordings to a submap database, and where in it a later recording was made.",
    no_args_is_help=True,
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if wanted:
        print(f"pc2grid {pc2grid.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="print the version and stop"),
    ] = False,
) -> None:
    """Recordings to a submap database, and where in it a later recording was made."""


app.add_typer(
    typer.Typer(
        cls=group(COMPARE),
        help="Measure: recordings, sensors, peers, the paper's tables, scale. Only in a clone.",
        no_args_is_help=True,
    ),
    name="compare",
)
app.add_typer(
    typer.Typer(
        cls=group(DB),
        help="Look into databases, check, join, change, merge, split and copy them.",
        no_args_is_help=True,
    ),
    name="db",
)
app.add_typer(
    typer.Typer(cls=group(CONFIG), help="Settings, and schemas of JSON documents.", no_args_is_help=True),
    name="config",
)


def main() -> None:
    """Entry point of the console script."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for them in all packages
    threads.use_one()
    # Imports make more than 100,000 objects, which stay. Python's collector of cycles would walk through them
    # again and again, also at the end.
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)
    terminal = console.Console()
    sys.exit(terminal.run(lambda: app(prog_name="pc2grid", standalone_mode=False, obj=terminal)))


REMOVED = {
    "pc2grid diff": "`pc2grid db join --plot OUT.png` draws the walls of joined sessions over each other",
    **dict.fromkeys(
        ("pc2grid convert --rerun", "pc2grid export --rerun"),
        "`pc2grid export --mcap OUT.mcap` writes the map, `rerun OUT.mcap` shows it",
    ),
    "pc2grid relocalize --rerun": "`--output OUT.mcap` writes the answer, `rerun OUT.mcap` shows it",
    **dict.fromkeys(
        ("pc2grid db join --journal", "pc2grid db join --dask", "pc2grid db join --jobs"),
        "one process compares every two sessions, some seconds a pair",
    ),
    "pc2grid compare floors": "a recording is one floor: cut it with `--start` and `--duration`",
    **dict.fromkeys(
        ("pc2grid simulate --floors", "pc2grid simulate --ride", "pc2grid simulate --slope"),
        "a recording is one floor: `pc2grid simulate` makes one for each `--seed`",
    ),
    **dict.fromkeys(
        ("pc2grid simulate --change", "pc2grid simulate --walkers", "pc2grid simulate --relief"),
        "another `--seed` and `--clutter` place other objects in the same building",
    ),
    **dict.fromkeys(
        ("pc2grid simulate --glass", "pc2grid simulate --mirrors"),
        "all walls of a simulated building are opaque",
    ),
    "pc2grid simulate --alike": "a recording is one floor: the same `--seed` places the same objects",
    **dict.fromkeys(
        ("pc2grid compare log", "pc2grid compare maps"),
        "`pc2grid compare recordings FOLDER`, with true poses in NAME.tum beside NAME.mcap",
    ),
    "pc2grid compare signatures": "`pc2grid relocalize --set relocalize.shortlist_by=shuffled`: without them",
    "pc2grid compare real": "its rows are those of `pc2grid compare recordings DATA --only 'other sensor'`",
    "pc2grid watch --last": "a finished recording is followed whole, and ws://ROBOT:8765 while it runs",
    "pc2grid watch --keep": "`pc2grid watch` goes on to the end; `--first` stops when it is located",
    "pc2grid db update": "`pc2grid db join` puts sessions into one frame, `pc2grid export --map` draws them",
    "pc2grid convert --update": "`--join` puts what is new into the frame of the other sessions",
}
"""By command, or by command and option: what to use instead."""
