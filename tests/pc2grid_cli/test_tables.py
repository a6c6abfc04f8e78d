"""Tables of all commands look alike, and nothing in them is cut off."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pc2grid_cli
from pc2grid_cli import tables
from pc2grid_cli.tables import show, table


def test_a_table_has_a_title_on_the_left_and_numbers_on_the_right(capsys: pytest.CaptureFixture[str]) -> None:
    made = table("maps", ["map"], ["error, m"])
    made.add_row("lidar", "0.5")
    made.add_row("depth camera", "12.25")
    show("before", made, "after")
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "before" and lines[-1] == "after"
    assert lines[1] == "maps"
    first, second = (line for line in lines if line.startswith(("lidar", "depth")))
    assert len(first) == len(second) and first.endswith(" 0.5") and second.endswith("12.25")


def test_a_narrow_terminal_cuts_nothing_off(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    made = table("wide", ["map"], [f"number {k}" for k in range(30)])
    made.add_row("lidar", *(f"{k}.000" for k in range(30)))
    show(made)
    out = capsys.readouterr().out
    assert "…" not in out
    assert all(f"number {k}" in out and f"{k}.000" in out for k in range(30))


def test_no_command_draws_a_comparison_of_its_own() -> None:
    folder = Path(pc2grid_cli.__file__).parent
    for path in [*folder.glob("compare_*.py"), *folder.glob("*_report.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            made = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
            assert made not in ("Table", "Console"), f"{path.name}: use pc2grid_cli.tables"
    assert Path(tables.__file__).parent == folder
