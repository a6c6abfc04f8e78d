"""Reads settings from a TOML file and from `section.key=value`, and writes them as TOML.

The functions take any tree of `Section`s, so that the package above can add its own sections. TOML has no
null. In a dump, a setting that is null is a commented line if null is its default, else the text "null".
On the command line it is `section.key=null`.
"""

from __future__ import annotations

import difflib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from pc2grid.config import Section
from pc2grid.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ENVIRONMENT = "PC2GRID_CONFIG"

T = TypeVar("T", bound=Section)


def load_settings(
    model: type[T],
    file: Path | None = None,
    assignments: Sequence[str] = (),
    environment: Mapping[str, str] = os.environ,
    *,
    preset: T | None = None,
) -> T:
    """Settings of a tree: `assignments` override `file`, which overrides `preset`.

    file : a TOML file; None: the one that the environment variable PC2GRID_CONFIG names, if any.
    assignments : "section.key=value" each, the value as in TOML; text needs no quotes.
    preset : the settings that nothing else sets; None: the defaults of `model`.

    Raises ConfigError naming the key and the closest known one.
    """
    named = environment.get(ENVIRONMENT)
    path = file or (Path(named) if named else None)
    tree = _read_toml(path) if path else {}
    settings = _validated(model, tree, preset, str(path) if path else "--set")
    if not assignments:
        return settings
    for assignment in assignments:
        _assign(tree, assignment)
    return _validated(model, tree, preset, "--set")


def dump_settings(settings: Section) -> str:
    """The whole tree as TOML with a comment for every key; reading it back gives the same settings."""
    lines = ["# Settings of pc2grid. Lines that start with '# key =' are at null: chosen by the program."]
    for name, field in type(settings).model_fields.items():
        section, usual = getattr(settings, name), field.default
        lines += ["", f"# {(type(section).__doc__ or '').strip().splitlines()[0]}", f"[{name}]"]
        for key, info in type(section).model_fields.items():
            value = getattr(section, key)
            lines.append(f"# {info.description}" if info.description else f"# ({key})")
            kept = value is None and getattr(usual, key) is None
            lines.append(f"# {key} =" if kept else f"{key} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
        return {name: _with_nulls(section) for name, section in tree.items()}
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file", hint="`pc2grid config dump` prints one to start from"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from None


def _with_nulls(section: Any) -> Any:
    if not isinstance(section, dict):
        return section
    return {key: None if value == "null" else value for key, value in section.items()}


def _assign(tree: dict[str, Any], assignment: str) -> None:
    name, equals, text = assignment.partition("=")
    section, dot, key = name.strip().partition(".")
    if not equals or not dot or not key:
        raise ConfigError(
            f"--set {assignment}: expected section.key=value", hint="for example --set partition.radius_m=5"
        )
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = None if text.strip() == "null" else text
    branch = tree.setdefault(section, {})
    if isinstance(branch, dict):
        branch[key] = value


def _validated(model: type[T], tree: dict[str, Any], preset: T | None, origin: str) -> T:
    try:
        return model.model_validate(tree if preset is None else _over(preset, tree))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            if "." not in key and isinstance(first["input"], dict) and len(first["input"]) == 1:
                key = f"{key}.{next(iter(first['input']))}"
            closest = _closest(model, key)
            hint = f"did you mean {closest}?" if closest else "`pc2grid config dump` lists all settings"
            raise ConfigError(f"{origin}: unknown setting {key}", hint=hint) from None
        complaint = first["msg"][:1].lower() + first["msg"][1:]
        raise ConfigError(
            f"{origin}: {key}: {complaint}, found {first['input']!r:.60}",
            hint="`pc2grid config dump` explains every setting",
        ) from None


def _over(preset: Section, tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with the values of `preset` where it has none."""
    full = preset.model_dump()
    for name, section in tree.items():
        both = isinstance(section, dict) and isinstance(full.get(name), dict)
        full[name] = full[name] | section if both else section
    return full


def _closest(model: type[Section], key: str) -> str | None:
    """The known setting whose name is nearest, or whose last part is the same in another section; of a
    section, the section."""
    known = [] if "." in key else list(model.model_fields)
    for section, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            known += [f"{section}.{name}" for name in field.annotation.model_fields]
    last = key.rpartition(".")[2]
    same = [name for name in known if name.rpartition(".")[2] == last]
    near = same or difflib.get_close_matches(key, known, n=1)
    return near[0] if near else None


def _toml(value: Any) -> str:
    """A value as TOML, which writes numbers, booleans, texts and lists of them as JSON does."""
    text = "null" if value is None else value
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
