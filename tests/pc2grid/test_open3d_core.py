"""Open3D is loaded without its plots for web pages, and still has them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]


def _printed(code: str) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=_ROOT).stdout


def test_plots_are_loaded_when_one_is_drawn_and_not_before() -> None:
    # In a process of its own: here Open3D is loaded already.
    code = """
import sys
from pc2grid.open3d_core import o3d
print("dash" in sys.modules, "plotly" in sys.modules)
mesh = o3d.geometry.TriangleMesh.create_box()
for _ in range(2):
    print(type(o3d.visualization.get_plotly_fig([mesh])).__name__)
drawn = o3d.visualization.draw_plotly
print(drawn.__module__, drawn.__name__, "dash" in sys.modules)
"""
    assert _printed(code).split("\n")[:4] == [
        "False False",
        "Figure",
        "Figure",
        "open3d.visualization.draw_plotly draw_plotly True",
    ]


def test_an_open3d_that_is_loaded_already_stays_as_it_is() -> None:
    code = """
import open3d
before = open3d.visualization.draw_plotly
from pc2grid.open3d_core import o3d
print(o3d is open3d, before is o3d.visualization.draw_plotly, before.__module__)
"""
    assert _printed(code).strip() == "True True open3d.visualization.draw_plotly"
