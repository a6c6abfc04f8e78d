"""A recording becomes a database: what `pc2grid convert` does, in Python.

python examples/convert_a_log.py monday.mcap building.submaps
"""

from __future__ import annotations

import typer

import pc2grid


class Notes(pc2grid.Observer):
    """Prints the choices of the program, for example which topic is used and why."""

    def on_note(self, text: str) -> None:
        """Print one choice."""
        print(text)


def main(recording: str, database: str) -> None:
    """Map a recording, describe its submaps, and store both."""
    # The recording may also be a nav2 map.yaml.
    session = pc2grid.convert(recording, database, observer=Notes())
    print(session)
    for warning in session.report.warnings:
        print(f"warning: {warning}")


if __name__ == "__main__":
    typer.run(main)
