"""A recording becomes a database: what `pc2grid convert` does, in Python.

python examples/convert_a_log.py monday.mcap building.submaps
"""

from __future__ import annotations

import sys
from pathlib import Path

import pc2grid
import signature


class Notes(pc2grid.Observer):
    """Prints the choices of the program, for example which topic is used and why."""

    def on_note(self, text: str) -> None:
        """Print one choice."""
        print(text)


def main(recording: str, database: str) -> None:
    """Map a recording, describe its submaps, and store both."""
    config = signature.Config()
    # The recording may also be a nav2 map.yaml.
    session, origin = signature.build_session(recording, Path(recording).stem, config, observer=Notes())
    signature.add_session(database, session, config, origin)

    travel_m = session.trajectory.path_m()[-1]
    print(f"{len(session.trajectory)} scans, {travel_m:.1f} m driven, {len(session.submaps)} submaps")
    for warning in session.report.warnings:
        print(f"warning: {warning}")


if __name__ == "__main__":
    main(*sys.argv[1:])
