"""pc2grid makes maps without the package above it, whose names it only passes on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from pc2grid.io.maps import save_map
from tests.helpers.simulated_drives import office

ROOT = Path(__file__).resolve().parents[2]


def test_pc2grid_needs_no_signature(tmp_path: Path) -> None:
    save_map(office(), tmp_path / "map")
    code = (
        "import sys\n"
        "sys.modules['signature'] = None\n"  # importing it raises ImportError
        "import pc2grid\n"
        "from pc2grid.settings import Config\n"
        f"grid = pc2grid.load_map({str(tmp_path / 'map.yaml')!r})\n"
        "print(len(pc2grid.submaps_of(grid, Config().partition)) > 10, callable(pc2grid.build_map))\n"
        "try:\n"
        "    pc2grid.convert\n"
        "except ImportError:\n"
        "    print('only what is passed on is missing')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == "True True\nonly what is passed on is missing\n", done.stderr


def test_what_is_passed_on_is_the_same_thing() -> None:
    import pc2grid
    import signature

    for name in ("Answer", "Config", "convert", "Localizer", "open_database", "relocalize"):
        assert getattr(pc2grid, name) is getattr(signature, name)
