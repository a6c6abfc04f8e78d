"""Tables of all commands look alike, and nothing in them is cut off."""

from __future__ import annotations

import pytest

from pc2grid_cli.output import show, table


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
