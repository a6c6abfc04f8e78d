"""Tables of all commands look alike, and nothing in them is cut off."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pc2grid_cli
from pc2grid_cli import tables
from pc2grid_cli.tables import show, table


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
