"""The laboratory, `pc2grid_lab`: no module of the product imports it, it is loaded when it is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from typer.main import get_command

from pc2grid_cli.command_line import Group


def laboratory(module: str) -> Any:
    """A module of the laboratory.

    module : its name without the package's.
    """
    return import_module(f"pc2grid_lab.{module}")


class Compare(Group):
    """The commands of `pc2grid compare`."""

    @property
    def commands(self) -> Any:
        """By name; the first use imports them."""
        app: Any = get_command(laboratory("compare").app)
        return app.commands

    @commands.setter
    def commands(self, _: Any) -> None:
        """A group of click sets its commands when it is made: these are known to the laboratory only."""
