"""Hints for the command line, read in Python."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import pc2grid
from pc2grid.errors import TopicError, in_python
from pc2grid.simulate import SimulationConfig, simulate_session
from tests.helpers.simulated_drives import office

ROOT = Path(__file__).resolve().parents[2]


def hints() -> list[str]:
    """The texts of all hints of the library, without what is filled in."""
    found = []
    for file in (*ROOT.glob("pc2grid/**/*.py"), *ROOT.glob("signature/**/*.py")):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "hint":
                parts = [part.value for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
                found += [part for part in parts if isinstance(part, str)]
    return found


def test_no_hint_names_an_option_of_the_command_line_in_python() -> None:
    found = hints()
    assert len(found) > 100
    for hint in found:
        # What is in backticks is typed in a shell.
        said = re.sub(r"`[^`]*`", "", in_python(hint))
        assert not re.search(r"(^|\s|\()--[a-z]", said), said


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ("--set read.up=y says so", "config=Config(read={'up': 'y'}) says so"),
        ("--set read.floor_z=-0.4 (metres)", "config=Config(read={'floor_z': -0.4}) (metres)"),
        (
            "such as --topic /front,/rear, or one",
            "such as config=Config(read={'topic': '/front,/rear'}), or one",
        ),
        ("check --start and --duration", "check span=TimeSpan(start_s, duration_s)"),
        ("--recover reads what is whole", "recover=True reads what is whole"),
        ("`pc2grid db copy --recover` keeps the rest", "`pc2grid db copy --recover` keeps the rest"),
        (
            "make one: `pc2grid convert a.mcap -o b.submaps`",
            'make one: pc2grid.convert("a.mcap", "b.submaps")',
        ),
    ],
)
def test_options_become_arguments(hint: str, said: str) -> None:
    assert in_python(hint) == said


def test_what_a_hint_says_works(tmp_path: Path) -> None:
    config = SimulationConfig(length_m=0.5, seed=3, clutter=0)
    simulate_session(tmp_path / "a.mcap", sensor="laser", grid=office(), config=config)
    wrong = pc2grid.Config.model_validate({"read": {"odometry": "/wrong"}})
    with pytest.raises(TopicError, match="odometry") as caught:
        pc2grid.convert(tmp_path / "a.mcap", tmp_path / "a.submaps", wrong)
    (argument,) = re.findall(r"config=(Config\(.*\}\))", str(caught.value))
    config = eval(argument, {"Config": pc2grid.Config})
    assert pc2grid.convert(tmp_path / "a.mcap", tmp_path / "a.submaps", config).session == "a"
