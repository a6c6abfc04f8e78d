"""The program `pc2grid`: its commands, and the options that may stand anywhere.

A command is known by its name and one sentence until it is used. Then its declaration is imported: a type of
`options.py`, or of the laboratory. What does its work is imported when it runs.
"""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import pkgutil
import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, get_origin

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

import pc2grid
from pc2grid import libraries
from pc2grid.errors import ConfigError
from pc2grid_cli import console

# Colours and boxes cost a tenth of a second at every --help; they are for terminals that want them.
_FANCY = sys.stderr.isatty() and sys.stdout.isatty() and not os.environ.get("NO_COLOR")
MARKUP: Literal["rich"] | None = "rich" if _FANCY else None
"""How typer prints help."""

LABORATORY = "pc2grid_lab"
"""The package that a clone of the repository has, and the wheel has not."""


def _apply(context: typer.Context, option: typer.CallbackParam, value: int) -> None:
    """Set what a global option means on the console."""
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
    """Declare the options that may stand before and behind any command."""


_made = typer.Typer(add_completion=False)
_made.command()(_global_options)
_GLOBAL = get_command(_made).params


def _callback(options: Any, work: str) -> Callable[..., None]:
    """Return a function for typer, which makes the options of what is typed and gives them to the work.

    options : a type of `options.py`. work : "package.module:function", which takes the options and the
    console and returns the exit code, or None. What must be typed stands first, then the command's own
    options, then those of the types that it extends.
    """
    names = [name for kind in options.__mro__ for name in vars(kind).get("__annotations__", ())]
    place = {name: number for number, name in enumerate(names)}
    typed = inspect.signature(options).parameters.values()
    declared = [one for one in typed if get_origin(one.annotation) is Annotated]
    declared.sort(key=lambda one: (one.default is not one.empty, place[one.name]))

    def run(context: typer.Context, **given: Any) -> None:
        raise typer.Exit(pkgutil.resolve_name(work)(options(**given), console.of(context)) or console.OK)

    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    run.__signature__ = inspect.Signature([context, *declared])  # type: ignore[attr-defined]
    run.__doc__ = options.__doc__
    return run


class LateCommand(TyperCommand):
    """A command that is known by its name and one sentence until it is used."""

    def __init__(self, name: str, sentence: str, declaration: str, work: str) -> None:
        """Name a command without importing it.

        sentence : for lists of commands. declaration : "package.module:name" of its options. work : see
        `_callback`.
        """
        super().__init__(name, help=sentence)
        self._declaration, self._work = declaration, work

    @cached_property
    def command(self) -> Any:
        """Return the command itself."""
        try:
            declared = pkgutil.resolve_name(self._declaration)
        except ModuleNotFoundError as error:
            if error.name != LABORATORY:
                raise
            raise ConfigError(
                f"pc2grid compare {self.name}: not installed; only a clone of the repository has it",
                hint="in the clone: pip install -e .",
            ) from None
        app = typer.Typer(add_completion=False, rich_markup_mode=MARKUP, pretty_exceptions_enable=False)
        app.command(self.name)(_callback(declared, self._work))
        made = get_command(app)
        made.params += _GLOBAL
        return made

    def make_context(self, *arguments: Any, **more: Any) -> Any:
        """Return the context of the command itself."""
        return self.command.make_context(*arguments, **more)


class Group(TyperGroup):
    """A group of commands that takes the global options."""

    late: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """By name: what `LateCommand` takes."""

    def __init__(self, **about: Any) -> None:
        super().__init__(**about)
        self.params += _GLOBAL
        self.commands = {**{name: LateCommand(name, *of) for name, of in self.late.items()}, **self.commands}


def _group(commands: Mapping[str, tuple[str, ...]], sentence: str, **about: Any) -> typer.Typer:
    """Return a group of commands, see `Group.late`."""
    kind = type("Group", (Group,), {"late": commands})
    return typer.Typer(cls=kind, help=sentence, no_args_is_help=True, **about)


def _command(sentence: str, declaration: str, work: str) -> tuple[str, str, str]:
    """Return a command of the program. declaration : a type of `options.py`. work : "file:function"."""
    return sentence, f"pc2grid_cli.options:{declaration}", f"pc2grid_cli.{work}"


def _experiment(sentence: str, declaration: str, work: str) -> tuple[str, str, str]:
    """Return a command of the laboratory. No module of the product imports it: it is loaded by its name."""
    return sentence, f"{LABORATORY}.commands:{declaration}", f"{LABORATORY}.{work}"


COMMANDS = {
    "demo": _command("Map a simulated office, and find another robot in it.", "Demo", "demo:run"),
    "simulate": _command("Drive a robot through a building and record it.", "Simulate", "demo:simulate"),
    "info": _command("Say what is in a recording, a map or a database.", "ShowInfo", "info:run"),
    "convert": _command("Make a submap database from recordings or maps.", "Convert", "convert:run"),
    "relocalize": _command("Find where a recording was made.", "Relocalize", "relocalize:run"),
    "watch": _command("Find where a running robot is, while it drives.", "Watch", "watch:run"),
    "export": _command("Write a session's map, trajectory, picture or page.", "Export", "export:run"),
    "view": _command("Look into a database in the browser, and locate there.", "ViewDatabase", "view:run"),
}
DB = {
    "info": _command("Show the sessions of a database.", "DbInfo", "db:info"),
    "check": _command("Read everything and list all damage.", "DbCheck", "db:check"),
    "merge": _command("Put the sessions of several databases into one.", "DbMerge", "db:merge"),
    "join": _command("Find out how sessions of a building lie to each other.", "DbJoin", "db:join"),
    "copy": _command("Write a compact copy of a database.", "DbCopy", "db:copy"),
    "split": _command("Copy sessions into a database of their own.", "DbSplit", "db:split"),
    "rename": _command("Give a session another name.", "DbRename", "db:rename"),
    "remove": _command("Remove sessions from a database.", "DbRemove", "db:remove"),
}
CONFIG = {
    "dump": _command("Print every setting as TOML.", "ConfigDump", "output:dump"),
    "schema": _command("Print the JSON Schema of a document.", "ConfigSchema", "output:print_schema"),
}
COMPARE = {
    "recordings": _experiment(
        "Real recordings as maps, located in each other; and what changed.",
        "CompareRecordings",
        "recordings.compare:compare_recordings",
    ),
    "sensors": _experiment("Each sensor in the maps of each.", "CompareSensors", "sensors:compare_sensors"),
    "peers": _experiment(
        "Other programs, the same maps and queries.", "ComparePeers", "peers.programs:compare_peers"
    ),
    "paper": _experiment(
        "The paper's tables and figures 9 and 10.", "ComparePaper", "paper.tables:compare_paper"
    ),
    "scale": _experiment(
        "The paper's recall in larger databases.", "CompareScale", "paper.tables:compare_scale"
    ),
}

app = _group(
    COMMANDS,
    "Recordings to a submap database, and where in it a later recording was made.",
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"pc2grid {pc2grid.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and stop"),
    ] = False,
) -> None:
    """Take the options that stand before the command."""


for _name, _commands, _sentence in (
    ("compare", COMPARE, "Measure: recordings, sensors, peers, the paper's tables, scale. Only in a clone."),
    ("db", DB, "Look into databases, check, join, change, merge, split and copy them."),
    ("config", CONFIG, "Settings, and schemas of JSON documents."),
):
    app.add_typer(_group(_commands, _sentence), name=_name)

_NEW_OBJECTS = 100_000
"""After so many new objects the collector looks for cycles. `convert` leaves 2,000 objects in cycles in 150 s
of a laser."""


def main() -> None:
    """Run the program: the entry point of the console script."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for them in all packages
    libraries.use_one()
    # Imports make more than 100,000 objects, which stay. Python's collector of cycles would walk through them
    # again and again, also at the end.
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)
    terminal = console.Console()
    sys.exit(terminal.run(lambda: app(prog_name="pc2grid", standalone_mode=False, obj=terminal)))
