"""BLAS uses one thread while pc2grid works: on its small matrices more threads only spin."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest
import scipy.linalg  # noqa: F401  its BLAS is loaded, as that of a user's program is
from threadpoolctl import threadpool_info, threadpool_limits

import pc2grid
from pc2grid import libraries
from pc2grid.geometry import SE2
from pc2grid.model import RegisteredScan
from pc2grid.simulate import SimulationConfig, simulate_session
from tests.helpers.rooms import small_house


def blas_threads() -> set[int]:
    """The numbers of threads that the loaded BLAS libraries use."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def use(number: int) -> None:
    """Set the number for the whole process, in a thread that ends, so that other threads may set it, too."""
    setter = Thread(target=threadpool_limits, args=(number, "blas"))
    setter.start()
    setter.join()


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A program that uses two BLAS threads and has said nothing in the environment."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    (before,) = blas_threads()
    use(2)
    yield
    use(before)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    simulate_session(path, sensor="laser", grid=small_house(), config=SimulationConfig(length_m=2.0, seed=3))
    return path


def test_one_thread_while_a_call_runs_and_the_callers_number_after_it() -> None:
    inner = libraries.one_blas_thread(blas_threads)
    assert libraries.one_blas_thread(lambda: (blas_threads(), inner(), blas_threads()))() == ({1}, {1}, {1})
    assert blas_threads() == {2}


def test_the_number_is_restored_after_an_error() -> None:
    @libraries.one_blas_thread
    def fails() -> None:
        raise ValueError

    with pytest.raises(ValueError):
        fails()
    assert blas_threads() == {2}


def test_a_thread_of_the_callers_program_is_limited_too() -> None:
    """As a robot's node calls it, after the main thread did."""
    limited, seen = libraries.one_blas_thread(blas_threads), []
    worker = Thread(target=lambda: seen.append(limited()))
    worker.start()
    worker.join()
    assert seen == [{1}] and limited() == {1}


def test_what_the_user_has_set_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert libraries.one_blas_thread(blas_threads)() == {2}
    environment = {"OMP_NUM_THREADS": "4"}
    libraries.use_one(environment)
    assert environment == {"OMP_NUM_THREADS": "4"}


def test_a_library_call_maps_with_one_thread(log: Path, tmp_path: Path) -> None:
    seen: set[int] = set()

    class Watch(pc2grid.Observer):
        def on_scan(self, registered: RegisteredScan) -> None:
            seen.update(blas_threads())

    pc2grid.convert(log, tmp_path / "x.submaps", observer=Watch())
    assert seen == {1}
    assert blas_threads() == {2}


def test_a_stream_leaves_the_callers_number_between_scans(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a robot's own program uses it: scans come one by one, and each is given to a Localizer."""
    pc2grid.convert(log, tmp_path / "x.submaps", observer=pc2grid.Observer())
    inside: list[set[int]] = []
    inverse = SE2.inverse
    monkeypatch.setattr(SE2, "inverse", lambda pose: (inside.append(blas_threads()), inverse(pose))[1])
    with pc2grid.open_database(tmp_path / "x.submaps") as database, pc2grid.open_log(log) as opened:
        config = database.config()
        localizer = pc2grid.Localizer(pc2grid.MapIndex.of(database, config))
        for registered, planar_scan in pc2grid.follow(opened.scans(), config):
            assert blas_threads() == {2}
            localizer.add(registered, planar_scan)
            assert blas_threads() == {2}
        localizer.answer()
    assert len(inside) > 10 and all(found == {1} for found in inside)


@pytest.mark.parametrize(("said", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2")])
def test_the_program_starts_with_one_thread(log: Path, said: dict[str, str], used: str) -> None:
    code = (
        "import atexit, sys\n"
        "from pc2grid_cli.main import main\n"
        "def numbers():\n"
        "    import scipy.linalg, threadpoolctl\n"
        "    found = {i['num_threads'] for i in threadpoolctl.threadpool_info() if i['user_api'] == 'blas'}\n"
        "    print(*found, file=sys.stderr)\n"
        "atexit.register(numbers)\n"
        "main()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **said}
    done = subprocess.run(
        [sys.executable, "-c", code, "info", log], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.split()[-1] == used
