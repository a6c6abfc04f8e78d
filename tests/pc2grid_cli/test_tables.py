"""Tables of all commands look alike, and nothing in them is cut off."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pc2grid_cli
from pc2grid_cli import tables
from pc2grid_cli.tables import show, table
from pc2grid_lab.compare import maps as compare_maps


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


def test_maps_are_compared_in_two_tables_that_fit_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    errors = {"ate_m": 0.0421, "rpe_m": 0.0052, "translation_m": 0.0, "rotation_deg": 0.0}
    grid = {"occupied_right": 0.991, "walls_found": 0.95, "free_wrong": 0.001, "unseen_free": float("nan")}
    row = {
        **{"plan": "maps/freiburg-079.yaml", "sensor": "lidar", "seed": 1, "odometry": True, "ours": errors},
        **{"bare": errors, "grid": grid, "lost": 0.0, "degenerate": 0.02, "loops": 12},
        **{"map_ms": 3.0, "bare_ms": 2.0},
    }
    columns = compare_maps._PLAN
    show(
        compare_maps._table("paths", columns, [*compare_maps._SIMULATED, *compare_maps._HEALTH], [row]),
        compare_maps._table("cells", columns, compare_maps._CELLS, [row]),
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 120
    paths, cells = (line.split() for line in lines if "freiburg-079" in line)
    assert paths[1:] == ["lidar", "1", "yes", "0.042", "0.005", "0.042", "0.00", "2.00", "12", "1.50"]
    assert cells[4:] == ["99.10", "95.00", "0.10", "-"]
