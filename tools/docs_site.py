"""The pages of the documentation site that are made from README, examples/ and the code: a hook of mkdocs.

The site keeps the paths of the repository, so that the links of README and of the pages in examples/ work
in both. Commands and settings are what the program itself prints; the reference of Python is made by
mkdocstrings from the docstrings, which `Docstrings` rewrites as Markdown.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
NOTEBOOK = "examples/from_log_to_answer"
LINKED = ("LICENSE", "CITATION.cff")
"""Files beside README that pages link to."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages and pictures that are not in docs/, and those that are under the paths they have here."""
    sys.path[:0] = [str(ROOT), str(ROOT / "tools")]
    os.environ["NO_COLOR"] = "1"  # the texts of --help without the boxes of a terminal

    def add(path: str, text: str) -> None:
        files.append(File.generated(config, path, content=text))

    for file in list(files):
        if file.src_dir == config.docs_dir:
            files.remove(file)
            files.append(File.generated(config, f"docs/{file.src_uri}", abs_src_path=file.abs_src_path))
    for path in PAGES:
        add(path, (ROOT / path).read_text("utf-8").replace(f"{NOTEBOOK}.ipynb", f"{NOTEBOOK}.md"))
    examples = (file for file in sorted((ROOT / "examples").rglob("*")) if file.is_file())
    for source in (*examples, *(ROOT / path for path in LINKED)):
        path = source.relative_to(ROOT).as_posix()
        files.append(File.generated(config, path, abs_src_path=str(source)))
    add(f"{NOTEBOOK}.md", notebook_page(ROOT / f"{NOTEBOOK}.ipynb"))
    add("reference/settings.md", settings_page())
    for path, text in (*command_pages(), *python_pages("pc2grid"), *python_pages("signature")):
        add(f"reference/{path}.md", text)
    return files


def command_pages() -> Iterator[tuple[str, str]]:
    """Yield path and text of a page for each command with what `--help` prints of it, and of one that lists
    all."""
    from typer.main import get_command

    from pc2grid_cli.main import app

    (_, about), *others = helps(get_command(app), "pc2grid", None)
    table = _table(f"| [`{name}`](commands/{_file(name)}.md) | {_sentence(text)} |" for name, text in others)
    yield "commands", f"# Commands\n\n{table}\n\n```text\n{about}\n```\n"
    for name, text in others:
        yield f"commands/{_file(name)}", f"# {name}\n\n```text\n{text}\n```\n"


def helps(command: Any, name: str, parent: Any) -> Iterator[tuple[str, str]]:
    """Name and help of a command, then those of the commands in it."""
    word = name.split()[-1]
    # The width of --help where no terminal says another one.
    context = command.make_context(word, [], parent=parent, resilient_parsing=True, terminal_width=80)
    command = context.command
    yield name, command.get_help(context)
    for inner in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from helps(command.get_command(context, inner), f"{name} {inner}", context)


def _file(command: str) -> str:
    return command.removeprefix("pc2grid ").replace(" ", "_")


def _sentence(text: str) -> str:
    """Return the first sentence of a help or of a docstring, behind its usage."""
    said = next((part for part in text.split("\n\n") if not part.startswith("Usage:")), "")
    return re.split(r"(?<=[.?!])\s", " ".join(said.split()), maxsplit=1)[0]


def settings_page() -> str:
    """Return the page of what `pc2grid config dump` prints."""
    from pc2grid.settings import dump_settings
    from signature.config import Config

    about = (
        "Every setting with its default, as `pc2grid config dump` prints them. `--set section.key=value` sets"
        " one, `--config FILE` takes a file like this one, and so does the environment variable"
        " `PC2GRID_CONFIG`."
    )
    return f"# Settings\n\n{about}\n\n```toml\n{dump_settings(Config())}\n```\n"


NEEDED = (
    "convert", "relocalize", "Answer", "Prior", "TimeSpan", "Config",
    "open_log", "follow", "build_map", "map_scans", "open_database", "Localizer",
)  # fmt: skip
"""The names of `pc2grid` that people need, in the order in which they meet them."""
_ABOUT_NEEDED = (
    "Twelve names are enough for most programs. Each has an example that runs: `monday.mcap` and"
    " `tuesday.mcap` are recordings, `building.submaps` is the database of the first."
)


def python_pages(package: str) -> Iterator[tuple[str, str]]:
    """Yield path and text of a page for each public name of a package, and of one that lists them.

    What another package has, and what people need, has its page there.
    """
    module = import_module(package)
    names = [name for name in module.__all__ if not name.startswith("_")]
    parts = [f"# {package}", _sentence(module.__doc__ or "")]
    if package == "pc2grid":
        parts += [_ABOUT_NEEDED, _table(_row(package, name) for name in NEEDED), "## All others"]
    listed = [name for name in names if package != "pc2grid" or name not in NEEDED]
    parts.append(_table(_row(package, name) for name in listed))
    yield package, "\n\n".join(parts) + "\n"
    for name in names:
        thing = getattr(module, name)
        if _home(thing, name) == package:
            path = f"{thing.__module__}.{thing.__qualname__}"
            options = f"heading: {package}.{name}\n      heading_level: 1"
            yield f"{package}/{name}", f"::: {path}\n    options:\n      {options}\n"


def _table(rows: Iterable[str]) -> str:
    return "\n".join(("| name | what it is |", "|---|---|", *rows))


def _row(package: str, name: str) -> str:
    thing = getattr(import_module(package), name)
    sentence = _sentence(inspect.getdoc(thing) or "").replace("|", "\\|")
    return f"| [`{name}`]({_home(thing, name)}/{name}.md) | {sentence} |"


def _home(thing: Any, name: str) -> str:
    """Return the package whose reference has the page of a public name."""
    return "pc2grid" if name in NEEDED else thing.__module__.split(".")[0]


def notebook_page(path: Path) -> str:
    """Return a notebook with what its cells have shown."""
    parts = []
    for cell in json.loads(path.read_text("utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        parts += [shown for output in cell["outputs"] if (shown := _shown(output))]
    return "\n\n".join(parts) + "\n"


def _shown(output: dict[str, Any]) -> str:
    """Return the richest form of what a cell has shown."""
    data = output.get("data", {"text/plain": output.get("text", [])})
    if "text/html" in data:
        return "".join(data["text/html"])
    if "image/png" in data:
        return f'<img alt="" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    return "```text\n" + "".join(data["text/plain"]).strip() + "\n```"


_EXAMPLE = re.compile(r"^(>>> .*(?:\n.*\S.*)*)", re.MULTILINE)
"""Up to the next empty line."""
_NAMES = r"\w+(?: \([^)]*\))?(?:, \w+(?: \([^)]*\))?)*"
_PARAMETER = re.compile(rf"^({_NAMES}) : (.*)$", re.MULTILINE)
"""A line such as `stamp_ns : when the scan was taken`."""
_PARAMETERS = re.compile(rf"(?:^{_NAMES} : .*\n?(?:    .*\n?)*)+", re.MULTILINE)
_TITLE = re.compile(r"^(.*\S.*)\n-{3,}$", re.MULTILINE)
_BEFORE_INDENTED = re.compile(rf"^(?!{_NAMES} : )(\S.*)\n(?=    )", re.MULTILINE)


def as_markdown(docstring: str) -> str:
    """Return a docstring of this project as Markdown: its examples as code, its parameters as a list."""
    parts = _EXAMPLE.split(docstring)
    parts[::2] = [_text_as_markdown(text) for text in parts[::2]]
    parts[1::2] = [f"\n```pycon\n{example}\n```" for example in parts[1::2]]
    return "".join(parts)


def _text_as_markdown(text: str) -> str:
    text = _TITLE.sub(r"**\1**", text)
    text = _BEFORE_INDENTED.sub(r"\1\n\n", text)  # what is indented is set as it stands
    text = _PARAMETERS.sub(lambda block: f"\n{block[0]}\n", text)
    return _PARAMETER.sub(r"- `\1`: \2", text)


class Docstrings(griffe.Extension):
    """Rewrites the docstrings that mkdocstrings shows."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of every class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
