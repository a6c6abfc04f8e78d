"""Open3D, loaded without its plots for web pages: `from pc2grid.open3d_core import o3d`.

With them (`open3d.visualization.draw_plotly`, on Dash and Plotly) the import takes 0.96 s of processor time,
without them 0.39 s. A stand-in takes the place of that one module; it loads the module itself when one of its
functions is called, so whoever uses this Open3D for plots gets them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

_PLOTS = "open3d.visualization.draw_plotly"


class _LaterLoaded(ModuleType):
    """A module whose public names are functions that load the module itself when they are called."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)

        def call(*arguments: Any, **keywords: Any) -> Any:
            if sys.modules.get(self.__name__) is self:
                del sys.modules[self.__name__]
            module = importlib.import_module(self.__name__)
            # The import has put the module where the package has its function of the same name.
            package, _, function = self.__name__.rpartition(".")
            setattr(sys.modules[package], function, getattr(module, function))
            return getattr(module, name)(*arguments, **keywords)

        return call


if "open3d" not in sys.modules:
    sys.modules.setdefault(_PLOTS, _LaterLoaded(_PLOTS))

import open3d as o3d  # noqa: E402  after the stand-in

__all__ = ["o3d"]
