"""How libraries are used: extras that a command asks for, threads of BLAS, and functions that numba compiles.

Extras: `pip install .` installs none of them. pc2grid is on no package index, so `pip install '.[live]'`
works only where its source is; the packages themselves can be named everywhere. A command asks for all that
it needs at once, before any work.

Threads: one for BLAS. The matrices of pc2grid have some hundred rows. OpenBLAS divides the work on them among
threads that spin while they wait: a depth camera took five times the processor time of one thread, a lidar
nearly twice. The threads of Open3D and OpenCV cost nothing and keep their own defaults. KISS-ICP runs with
one thread, because its sums depend on the number (`pc2grid.estimation.registration`).
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from pc2grid.errors import ClusterError, ConfigError, DatabaseError, LiveError, Pc2GridError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@dataclass(frozen=True, slots=True)
class Extra:
    """An optional dependency of `pyproject.toml`.

    modules : names to import. packages : names for pip. error : raised if it is missing.
    """

    modules: tuple[str, ...]
    packages: tuple[str, ...]
    error: type[Pc2GridError] = ConfigError


EXTRAS = {
    "paper": Extra(("mahotas", "sklearn"), ("mahotas", "scikit-learn")),
    "cluster": Extra(("dask", "distributed"), ("dask", "distributed"), ClusterError),
    "live": Extra(("websockets",), ("websockets",), LiveError),
    "postgres": Extra(("psycopg",), ("'psycopg[binary]'",), DatabaseError),
    "docs": Extra(("mkdocs", "material", "mkdocstrings"), ("mkdocs-material", "'mkdocstrings[python]'")),
}
_OF_ADDRESSES = {
    "ws": "live",
    "wss": "live",
    "postgresql": "postgres",
    "postgres": "postgres",
}


def of_addresses(*addresses: object) -> dict[str, str]:
    """Return the extras that addresses such as `ws://robot` need, with the scheme that needs each.

    >>> of_addresses("ws://robot:8765", "postgresql://host/db", "monday.mcap", None)
    {'live': 'ws://', 'postgres': 'postgresql://'}
    """
    schemes = [str(address).partition("://")[0] for address in addresses if "://" in str(address)]
    return {_OF_ADDRESSES[scheme]: f"{scheme}://" for scheme in schemes if scheme in _OF_ADDRESSES}


def require(needs: Mapping[str, str]) -> None:
    """Refuse work for which packages are missing; all of them are named.

    needs : by extra, the word of the user that needs it. The packages are imported, because one that is
    installed in part fails only then.

    Raises the `Extra.error` of the first extra that cannot be imported.
    """
    missing = {}
    for name, what in needs.items():
        try:
            for module in EXTRAS[name].modules:
                import_module(module)
        except ImportError as error:
            missing[name] = f"the extra `{name}`, for {what}, is not installed ({error})"
    if missing:
        first = EXTRAS[next(iter(missing))]
        packages = [package for name in missing for package in EXTRAS[name].packages]
        raise first.error("; ".join(missing.values()), hint=f"pip install {' '.join(packages)}") from None


P = ParamSpec("P")
T = TypeVar("T")

_SETTINGS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
"""Environment variables by which a user says how many threads BLAS uses."""


def set_by_user(environment: MutableMapping[str, str] = os.environ) -> bool:
    """Return whether the user has said how many threads BLAS uses; that is left as it is."""
    return any(name in environment for name in _SETTINGS)


def use_one(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let BLAS use one thread in this process and its children, unless the user has said how many.

    A program calls it before it loads numpy, because BLAS reads the environment when it is loaded.
    """
    if not set_by_user(environment):
        environment["OPENBLAS_NUM_THREADS"] = environment["MKL_NUM_THREADS"] = "1"


_found: tuple[int, ThreadpoolController] | None = None


def _blas() -> ThreadpoolController:
    """Return the BLAS libraries that are loaded. To find them takes 0.5 ms: it is done after imports only."""
    global _found
    if _found is None or _found[0] != len(sys.modules):
        import scipy.linalg  # noqa: F401  it has a BLAS of its own, which would be loaded on the way
        from threadpoolctl import ThreadpoolController

        _found = len(sys.modules), ThreadpoolController().select(user_api="blas")
    return _found[1]


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Make BLAS use one thread while a function runs (a decorator), unless the user has said how many.

    The number of the caller's own program is restored when the function returns.
    """

    @functools.wraps(function)
    def limited(*arguments: P.args, **keywords: P.kwargs) -> T:
        if set_by_user():
            return function(*arguments, **keywords)
        with _blas().limit(limits=1):
            return function(*arguments, **keywords)

    return limited


def one_blas_thread_each(items: Iterator[T]) -> Iterator[T]:
    """Yield the items of an iterator; BLAS uses one thread while each of them is made."""
    advance = one_blas_thread(functools.partial(next, items))
    with suppress(StopIteration):
        while True:
            item = advance()
            yield item


class _Compiled:
    """A function that numba compiles when it is called first; importing numba takes 0.2 s."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        self._function, self._options = function, options
        functools.update_wrapper(self, function)

    def __call__(self, *args: Any, **named: Any) -> Any:
        return self.dispatcher(*args, **named)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Compile the function; in its module numba's function takes the place of this one, for others that
        call it."""
        from numba import njit

        names = self._function.__globals__
        options = {"cache": True, "no_cfunc_wrapper": True, **self._options}  # C calls none of them
        found = self.__dict__["dispatcher"] = njit(**options)(self._function)
        for name, value in list(names.items()):
            if isinstance(value, _Compiled):
                names[name] = value.dispatcher
        return found


_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[_Function], _Function]:
    """Compile a function of numbers and arrays by `numba.njit(cache=True, **options)` at its first call."""

    def decorate(function: _Function) -> _Function:
        return cast(_Function, _Compiled(function, options))

    return decorate
