"""Files of older formats, and what they lack.

None is changed where it stands: a reader gets what is missing for itself, in memory; a writer, which works on
a copy anyway, puts it into that.
"""

from __future__ import annotations

import contextlib
import sqlite3

from signature.database import rows, schema


def bring_along(connection: sqlite3.Connection, *, beside: bool = False) -> None:
    """Give a file of an older format what this version reads. Nothing is done to one of this format.

    Format 1 knew no loops: its sessions have none.

    beside : not in the file, but for this connection alone.
    """
    version = schema.version_of(connection)
    if version >= schema.FORMAT:
        return
    if beside:
        connection.execute("PRAGMA temp_store = MEMORY")
    known = schema.statements(version)
    for table, statement in schema.statements().items():
        if table not in known:
            connection.execute(statement.replace("TABLE", "TEMP TABLE", 1) if beside else statement)
    # Whoever reads damaged sessions hears of it then; that a copy of them is written must not happen.
    with contextlib.suppress(*schema.COMPLAINTS if beside else ()):
        for (session_id,) in connection.execute("SELECT id FROM session"):
            rows.insert(connection, "loop", {"session_id": session_id, **rows.loop_row(())})
    if not beside:
        connection.execute(f"PRAGMA user_version = {schema.FORMAT}")
