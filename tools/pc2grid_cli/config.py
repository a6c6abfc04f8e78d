"""`pc2grid config`: see all settings."""

from __future__ import annotations

from pc2grid_cli.settings import Assignments, ConfigFile, make_config


def dump_command(config: ConfigFile = None, set_: Assignments = None) -> None:
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """
    from pc2grid.settings import dump_settings

    print(dump_settings(make_config(config, set_)), end="")
