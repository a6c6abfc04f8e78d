"""The pages of the documentation site that are made from README, examples/ and the code: a hook of mkdocs.

The site keeps the paths of the repository, so that the links of README and of the pages in examples/ work
in both. Commands and settings are what the program itself prints; the reference of Python is made by
mkdocstrings from the docstrings, which `Docstrings` rewrites as Markdown.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
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
    for source in sorted((ROOT / "examples").rglob("*")):
        if source.is_file():
            path = source.relative_to(ROOT).as_posix()
            files.append(File.generated(config, path, abs_src_path=str(source)))
    for path in LINKED:
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    add(f"{NOTEBOOK}.md", notebook_page(ROOT / f"{NOTEBOOK}.ipynb"))
    add("reference/commands.md", commands_page())
    add("reference/settings.md", settings_page())
    add("reference/pc2grid.md", needed_page())
    add("reference/pc2grid_more.md", python_page("pc2grid"))
    add("reference/signature.md", python_page("signature"))
    return files


def commands_page() -> str:
    """What `--help` prints, of every command."""
    from typer.main import get_command

    from pc2grid_cli.main import app

    parts = ["# Commands", "What `--help` prints of each.", *helps(get_command(app), "pc2grid", None)]
    return "\n\n".join(parts) + "\n"


def helps(command: Any, name: str, parent: Any) -> Iterator[str]:
    """A heading and the help of a command, then those of the commands in it."""
    word = name.split()[-1]
    # The width of --help where no terminal says another one.
    context = command.make_context(word, [], parent=parent, resilient_parsing=True, terminal_width=80)
    yield f"## {name}"
    command = context.command
    yield f"```text\n{command.get_help(context)}\n```"
    for inner in command.list_commands(context) if hasattr(command, "list_commands") else ():
        yield from helps(command.get_command(context, inner), f"{name} {inner}", context)


def settings_page() -> str:
    """What `pc2grid config dump` prints."""
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


def needed_page() -> str:
    """The twelve names that people need, for mkdocstrings to fill in."""
    about = (
        "Twelve names are enough for most programs. Each has an example that runs: `monday.mcap` and"
        " `tuesday.mcap` are recordings, `building.submaps` is the database of the first. [All other"
        " names](pc2grid_more.md) are on the next page."
    )
    entries = (_entry(f"pc2grid.{name}", getattr(import_module("pc2grid"), name)) for name in NEEDED)
    return "\n\n".join(("# pc2grid", about, *entries)) + "\n"


def python_page(package: str) -> str:
    """The docstring of a package, and its public names: those on other pages as links."""
    module = import_module(package)
    own, links = [], []
    for name in (name for name in module.__all__ if not name.startswith("_")):
        thing = getattr(module, name)
        if name in NEEDED or thing.__module__.split(".")[0] != package:
            links.append(f"[`{name}`][{thing.__module__}.{thing.__qualname__}]")
        else:
            own.append(_entry(f"{package}.{name}", thing))
    parts = [f"# {package}", as_markdown(module.__doc__ or ""), f"On other pages: {', '.join(links)}."]
    return "\n\n".join((*parts, *own)) + "\n"


def _entry(name: str, thing: Any) -> str:
    """A public name, for mkdocstrings to fill in."""
    label = name.partition(".")[2]
    path = f"{thing.__module__}.{thing.__qualname__}"
    return f"::: {path}\n    options:\n      heading: {name}\n      toc_label: {label}"


def notebook_page(path: Path) -> str:
    """A notebook with what its cells have shown."""
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
    """The richest form of what a cell has shown."""
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
    """A docstring of this project as Markdown: its examples as code, its parameters as a list."""
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
        """Of every class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
