"""JSON Schemas (draft 2020-12) of what the commands print with `--json`, made of the types of the documents.

A type stands beside the command that fills it, so that mypy compares what is printed with what the schema
says. It holds frozen types of the program as they are. Metres, radians, int64 nanoseconds, unless a name says
otherwise.
"""

from __future__ import annotations

import json
import pkgutil
from typing import Any

from signature.config import Config
from signature.localization.answer_json import SCHEMA_VERSION, adapter

_WRITTEN = "pc2grid_cli.db:DbWrite"
DOCUMENTS = {
    "convert": "pc2grid_cli.conversion:Convert",
    "db-check": "pc2grid_cli.db:DbCheck",
    "db-copy": _WRITTEN,
    "db-info": "pc2grid_cli.db:DbInfo",
    "db-join": "pc2grid_cli.join:DbJoin",
    "db-merge": _WRITTEN,
    "db-remove": _WRITTEN,
    "db-rename": _WRITTEN,
    "db-split": _WRITTEN,
    "export": "pc2grid_cli.export:Export",
    "info": "pc2grid_cli.info:Info",
    "info-map": "pc2grid_cli.info:InfoMap",
    "relocalize": "pc2grid_cli.relocalize:Relocalize",
    "relocalize-check": "pc2grid_cli.check_pose:RelocalizeCheck",
    "simulate": "pc2grid.simulate.record:SimulatedSession",
    "watch": "pc2grid_cli.watch:Watch",
    "watch-check": "pc2grid_cli.check_pose:WatchCheck",
}
"""By command, where the type of its document is: it is imported when its schema is asked for."""


def schema(name: str) -> dict[str, Any]:
    """JSON Schema of a command's document, or of all `settings` as TOML holds them. Raises KeyError."""
    if name == "settings":
        about = adapter(Config).json_schema()
    else:
        about = adapter(pkgutil.resolve_name(DOCUMENTS[name])).json_schema(mode="serialization")
        about["properties"] = {"schema_version": {"const": SCHEMA_VERSION}, **about["properties"]}
        about = json.loads(json.dumps(about), object_hook=_complete)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **about}


def _complete(about: dict[str, Any]) -> dict[str, Any]:
    """The schema of an object whose keys are always there, also those with a default."""
    return {**about, "required": [*about["properties"]]} if "properties" in about else about
