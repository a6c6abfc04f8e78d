"""The packages that only some commands need, and how they are asked for: all before any work, all at once.

`pip install .` installs none of them. pc2grid is on no package index, so `pip install '.[live]'` works only
where its source is; the packages themselves can be named everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module

from pc2grid.errors import ClusterError, ConfigError, DatabaseError, LiveError, Pc2GridError


@dataclass(frozen=True, slots=True)
class Extra:
    """An optional dependency of `pyproject.toml`.

    modules : what is imported of it. packages : what pip is asked for. error : what its absence raises.
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
    """The extras that addresses such as `ws://robot` need, with the scheme that needs each; of others none.

    >>> of_addresses("ws://robot:8765", "postgresql://host/db", "monday.mcap", None)
    {'live': 'ws://', 'postgres': 'postgresql://'}
    """
    schemes = [str(address).partition("://")[0] for address in addresses if "://" in str(address)]
    return {_OF_ADDRESSES[scheme]: f"{scheme}://" for scheme in schemes if scheme in _OF_ADDRESSES}


def require(needs: Mapping[str, str]) -> None:
    """Refuse work for which packages are missing; all of them are named.

    needs : by extra, what needs it, as the user called it. The packages are imported, because one that is
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
