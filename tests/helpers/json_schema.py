"""JSON Schemas for tests."""

from typing import Any


def closed(about: Any) -> Any:
    """The same schema without additional keys: everything that is printed must be in it."""
    if isinstance(about, list):
        return [closed(part) for part in about]
    if not isinstance(about, dict):
        return about
    inner = {key: closed(value) for key, value in about.items()}
    return {**inner, "additionalProperties": False} if "properties" in inner else inner


def keys(about: dict[str, Any]) -> set[str]:
    """The path of every key of a document of this schema, such as `sessions[].name`."""
    defined, found = about.get("$defs", {}), set[str]()

    def walk(part: dict[str, Any], path: str) -> None:
        if "$ref" in part:
            part = defined[part["$ref"].rpartition("/")[2]]
        for choice in part.get("anyOf", []):
            walk(choice, path)
        if "items" in part:
            walk(part["items"], f"{path}[]")
        if isinstance(part.get("additionalProperties"), dict):
            walk(part["additionalProperties"], f"{path}.*")
        for key, inner in part.get("properties", {}).items():
            at = f"{path}.{key}".removeprefix(".")
            found.add(at)
            walk(inner, at)

    walk(about, "")
    return found
