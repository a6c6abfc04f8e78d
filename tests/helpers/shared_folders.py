"""Folders of maps, recordings and databases that several tests read, filled once for all workers of a run."""

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Fill = Callable[[Path], object]


def shared_folder(base: str = "") -> Callable[[Fill], Any]:
    """Make a fixture of a function that fills a folder; each worker gets a copy of that folder.

    base : another such fixture, with whose files the folder begins.
    """

    def fixture_of(fill: Fill) -> Any:
        @pytest.fixture(scope="session", name=fill.__name__)
        def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
            mine, name = tmp_path_factory.mktemp("shared"), f"{fill.__module__}.{fill.__name__}"
            begin = request.getfixturevalue(base) if base else None
            if "PYTEST_XDIST_WORKER" not in os.environ:
                return _filled(mine, fill, begin)
            whole = tmp_path_factory.getbasetemp().parent / name
            with whole.with_name(f"{name}.lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not whole.is_dir():
                    _filled(mine, fill, begin).rename(whole)
            return Path(shutil.copytree(whole, mine, dirs_exist_ok=True))

        folder.__doc__ = fill.__doc__
        return folder

    return fixture_of


def _filled(folder: Path, fill: Fill, begin: Path | None) -> Path:
    if begin is not None:
        shutil.copytree(begin, folder, dirs_exist_ok=True)
    fill(folder)
    return folder
