"""Names of a package that load their modules when they are first used, so that importing it costs nothing.

The list of the names is the block `if TYPE_CHECKING:` of the package, which type checkers and editors read as
well. Each of its lines has the form `from package.module import thing as name`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

_LINE = re.compile(r"^    from ([\w.]+) import (\w+) as (\w+)", re.MULTILINE)


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], list[str]]:
    """`__getattr__` (PEP 562) and `__all__` of a package.

    package, file : its `__name__` and `__file__`.
    """
    source = Path(file).read_text(encoding="utf-8")
    homes = {name: (module, thing) for module, thing, name in _LINE.findall(source)}

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, thing = homes[name]
        return getattr(import_module(module), thing)

    return load, sorted(homes)
