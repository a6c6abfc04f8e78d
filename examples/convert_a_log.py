"""A recording becomes a database: what `pc2grid convert` does, in Python.

python examples/convert_a_log.py monday.mcap building.submaps
"""

from __future__ import annotations

import sys
from pathlib import Path

import signature


def main(recording: str, database: str) -> None:
    """Map a recording, describe its submaps, store both."""
    config = signature.Config()
    # A nav2 map.yaml may stand in the place of the recording.
    session, origin = signature.build_session(recording, Path(recording).stem, config, note=print)
    signature.add_session(database, session, config, origin)

    driven_m = session.trajectory.path_m()[-1]
    print(f"{len(session.trajectory)} scans, {driven_m:.1f} m driven, {len(session.submaps)} submaps")
    for warning in session.report.warnings:
        print(f"warning: {warning}")


if __name__ == "__main__":
    main(*sys.argv[1:])
