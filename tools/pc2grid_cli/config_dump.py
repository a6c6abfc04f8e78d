"""`pc2grid config dump`: all settings with their values and meanings."""

from __future__ import annotations

from pc2grid.settings import dump_settings
from pc2grid_cli.options import Assignments, ConfigFile, Preset, PresetName, make_config


def config_dump_command(
    config: ConfigFile = None, set_: Assignments = None, preset: Preset = PresetName.default
) -> None:
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """
    print(dump_settings(make_config(config, set_, preset=preset)), end="")
