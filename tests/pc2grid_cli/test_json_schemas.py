"""What --json prints is what its published schema says, and every command has an example."""

import json
import re
import shutil
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args, get_type_hints

import jsonschema
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pc2grid.display import adapter
from pc2grid.geometry import SE2
from pc2grid.io.source import TopicInfo
from pc2grid.model import (
    Consistency,
    Contradiction,
    MapOf,
    OdometryCheck,
    OdometryOutlier,
    ReadReport,
    SensorKind,
    UncertainSegment,
)
from pc2grid.settings import dump_settings
from pc2grid.simulate import SimulatedSession
from pc2grid_cli.console import print_result
from pc2grid_cli.info import ChosenTopics, Info
from pc2grid_cli.main import app
from pc2grid_cli.options import Export, Simulate
from pc2grid_cli.output import DOCUMENTS, schema
from signature.config import Config
from signature.database import Problem
from signature.localization.answer import AmbiguousLine, Point
from tests.helpers.json_schema import closed, keys
from tests.helpers.shared_folders import shared_folder


@shared_folder("metre_folder")
def folder(folder: Path) -> None:
    """Also a database of joined sessions, and one that is damaged."""
    join = f"convert {folder}/office.yaml {folder}/part.yaml -o {folder}/joined.submaps --join"
    assert CliRunner().invoke(app, join.split(), catch_exceptions=False).exit_code == 0
    data = bytearray((folder / "b.submaps").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "damaged.submaps").write_bytes(data)


COMMANDS = [
    ("info", "info drive.mcap", 0),
    ("info-map", "info office.yaml", 0),
    ("db-info", "info b.submaps", 0),
    ("simulate", "simulate office.yaml out.mcap --sensor laser --length 0.5 --clutter 0", 0),
    ("convert", "convert office.yaml -o out.submaps", 0),
    ("convert", "convert drive.mcap -o out.submaps --building B --floor 2", 0),
    ("relocalize", "relocalize part.yaml -d b.submaps", 0),
    ("relocalize", "relocalize drive.mcap -d b.submaps --set relocalize.accept=0.9999999", 4),
    ("relocalize", "relocalize drive.mcap -d b.submaps --near 99 99 1", 4),
    ("relocalize-check", "relocalize drive.mcap -d b.submaps --check 99 99 0", 4),
    ("export", "export b.submaps --map out --plot out.png --mcap out.mcap", 0),
    ("export", "export b.submaps --report out.html", 0),
    ("db-info", "db info b.submaps", 0),
    ("db-check", "db check b.submaps", 0),
    ("db-check", "db check damaged.submaps", 1),
    ("db-join", "db join two.submaps", 0),
    ("db-copy", "db copy b.submaps -o out.submaps", 0),
    ("db-copy", "db copy --recover damaged.submaps -o out.submaps", 3),
    ("db-merge", "db merge b.submaps -o out.submaps", 0),
    ("db-split", "db split b.submaps office -o out.submaps", 0),
    ("db-rename", "db rename b.submaps office plan", 0),
    ("db-remove", "db remove b.submaps office --force", 0),
]


@pytest.mark.parametrize(("name", "command", "code"), COMMANDS)
def test_documents_are_as_their_schema_says(
    name: str, command: str, code: int, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree(folder, tmp_path, dirs_exist_ok=True))
    done = CliRunner().invoke(app, [*command.split(), "--json"], catch_exceptions=False)
    assert done.exit_code == code, done.stderr
    jsonschema.validate(json.loads(done.stdout), closed(schema(name)))
    assert all(Path(written).stat().st_size > 0 for written in re.findall(r"out\.\w+", command))


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_keys_of_a_document_stay(name: str) -> None:
    """Scripts rely on them. What is printed is what the schema says (the test above); more keys may come."""
    known = json.loads((Path(__file__).parent / "json_keys.json").read_text())
    assert set(known[name]) - keys(schema(name)) == set()


@pytest.mark.parametrize(
    "kind",
    [
        SE2, Consistency, Contradiction, OdometryCheck, OdometryOutlier, ReadReport, UncertainSegment,
        TopicInfo, ChosenTopics, Info, SimulatedSession, Problem, AmbiguousLine, Point,
    ],
)  # fmt: skip
def test_frozen_types_are_printed_as_the_schema_says(kind: Any) -> None:
    """Also those that no command of the tests prints."""
    names = {"Info": "info", "SimulatedSession": "simulate"}
    schemas = json.loads(files("pc2grid_cli").joinpath("schemas.json").read_text())["$defs"]
    printed = adapter(kind).json_schema(mode="serialization")["properties"]
    assert [*printed] == [*schemas[names.get(kind.__name__, kind.__name__)]["properties"]]


def test_every_document_is_validated_by_a_test() -> None:
    elsewhere = {"watch": "pc2grid_cli/test_watch.py", "watch-check": "pc2grid_cli/test_known_pose.py"}
    for name, file in elsewhere.items():
        assert f'schema("{name}")' in (Path(__file__).parents[1] / file).read_text()
    assert {name for name, _, _ in COMMANDS} | set(elsewhere) == set(DOCUMENTS)


@pytest.mark.parametrize("name", ["settings", *DOCUMENTS])
def test_schemas_are_sound_and_explained(name: str) -> None:
    done = CliRunner().invoke(app, ["config", "schema", name], catch_exceptions=False)
    document = json.loads(done.stdout)
    jsonschema.Draft202012Validator.check_schema(document)
    assert all(about.get("description") for about in (document, *document.get("$defs", {}).values()))


def test_the_schema_of_settings_fits_what_dump_prints() -> None:
    tomllib = pytest.importorskip("tomllib" if sys.version_info >= (3, 11) else "tomli")
    settings = tomllib.loads(dump_settings(Config()))
    jsonschema.validate(settings, schema("settings"))
    settings["partition"]["radius_m"] = -1.0
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(settings, schema("settings"))


def commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """All commands with their full names."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command.command


@pytest.mark.parametrize(
    ("name", "command"), [pytest.param(n, c, id=n) for n, c in commands(get_command(app))]
)
def test_every_command_shows_an_example_that_parses(name: str, command: Any) -> None:
    (example,) = re.findall(r"^Example: pc2grid (.*)$", command.help, re.MULTILINE)
    assert example.startswith(name)
    words = example.removeprefix(name).partition(" > ")[0].split()
    command.make_context(name, words)
    for option in command.params:
        assert option.help, f"{name}: {option.name} is not explained"


@pytest.mark.parametrize(
    ("command", "option", "values"), [(Simulate, "sensor", SensorKind), (Export, "map_of", MapOf)]
)
def test_an_option_takes_all_values_of_its_type(command: Any, option: str, values: Any) -> None:
    """Their types are in modules that help does not load: the declarations repeat the values."""
    declared = get_type_hints(command)[option]
    assert values in (declared, *get_args(declared))


def test_json_is_offered_where_there_is_a_schema_and_only_there() -> None:
    for name, command in commands(get_command(app)):
        has_json = any("--json" in option.opts for option in command.params)
        assert has_json == (name.replace(" ", "-") in DOCUMENTS), name


def test_what_is_not_known_is_null(capsys: pytest.CaptureFixture[str]) -> None:
    print_result({"error_m": float("nan"), "ranges": (1.0, float("inf")), "count": 2})
    assert json.loads(capsys.readouterr().out) == {"error_m": None, "ranges": [1.0, None], "count": 2}
