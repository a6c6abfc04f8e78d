"""Formats of the database, and what older ones lack.

| format | brought |
|---|---|
| 1 | sessions, grids, trajectories, submaps, signatures |
| 2 | the table `loop` |
| 3 | the table `graph` |
| 4 | the table `points` |
| 5 | the table `isovist` |

SQLite files and PostgreSQL databases count their formats alike. A reader never changes a database of an older
format: the tables that it lacks are added in memory (SQLite) or treated as empty (PostgreSQL). A writer
adds them to the database (PostgreSQL) or to the new file that replaces the old one (SQLite).
"""

from __future__ import annotations

from typing import Any

FORMAT = 5
SINCE = {"loop": 2, "graph": 3, "points": 4, "isovist": 5}
"""The format that brought a table; tables that are not listed were there from the first."""
REMOVED_SETTINGS = (("signature", "occupied_percent", 65),)
"""Settings that earlier versions stored, with the value that is now fixed; any other value is refused."""


def tables_of(version: int, tables: dict[str, str]) -> dict[str, str]:
    """Those of the tables (name -> definition) that a format has."""
    return {name: text for name, text in tables.items() if SINCE.get(name, 1) <= version}


def without_removed_settings(content: dict[str, Any]) -> dict[str, Any]:
    """A stored configuration without the settings of `REMOVED_SETTINGS` that have the value now fixed.

    Settings that are unknown for another reason stay, and the model of the configuration refuses them.
    """
    removed = {(section, key): value for section, key, value in REMOVED_SETTINGS}
    return {
        section: {key: value for key, value in keys.items() if removed.get((section, key), ...) != value}
        if isinstance(keys, dict)
        else keys
        for section, keys in content.items()
    }
