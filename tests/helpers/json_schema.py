"""JSON Schemas for tests."""

from __future__ import annotations

from typing import Any


def closed(about: Any) -> Any:
    """The same schema without additional keys: everything that is printed must be in it."""
    if isinstance(about, list):
        return [closed(part) for part in about]
    if not isinstance(about, dict):
        return about
    inner = {key: closed(value) for key, value in about.items()}
    return {**inner, "additionalProperties": False} if "properties" in inner else inner
