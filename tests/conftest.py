"""What tests of several folders are given."""

import os
from collections.abc import Iterator

import pytest

from pc2grid import libraries
from tests.helpers.browser import CHROMIUM, Browser, browser_in

libraries.use_one()  # as the program does; tests call functions that do not limit BLAS themselves


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all pages; on a server of tests its absence is a failure."""
    if CHROMIUM is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("chromium is not installed")
    with browser_in(tmp_path_factory.mktemp("browser")) as opened:
        yield opened
