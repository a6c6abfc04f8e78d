"""Submaps -> signatures -> database -> retrieval -> verified pose.

The back of pc2grid: one file per section of the paper (`boundary`, `freespace`, `symmetry`,
`similarity`), the database behind one protocol, and the decision where a query is. Importing this package
costs nothing: its names load their modules when first used.

>>> import pc2grid, signature
>>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
...     config = database.config()
...     answer = signature.locate(pc2grid.follow(log.scans(), config), database, config)
>>> answer.status, answer.session
('located', 'monday')
"""

from typing import TYPE_CHECKING

from pc2grid.lazy import lazy_names

if TYPE_CHECKING:
    from signature.answer import Answer as Answer
    from signature.build import add_session as add_session
    from signature.build import build_session as build_session
    from signature.build import provenance as provenance
    from signature.building import Building as Building
    from signature.config import Config as Config
    from signature.database import Label as Label
    from signature.database import SubmapDatabase as SubmapDatabase
    from signature.database import create_database as create_database
    from signature.database import open_database as open_database
    from signature.describe import Signature as Signature
    from signature.describe import describe as signature_of  # noqa: F401
    from signature.relocalize import Relocalizer as Relocalizer
    from signature.relocalize import locate_map as locate_map
    from signature.relocalize import relocalize as locate  # noqa: F401
    from signature.similarity import SignatureTable as SignatureTable
    from signature.similarity import distances as distances

# A function whose module has its name goes by another one here: the module would hide it.
_HOMES = {
    "Answer": "answer.Answer",
    "Building": "building.Building",
    "Config": "config.Config",
    "Label": "database.Label",
    "Relocalizer": "relocalize.Relocalizer",
    "Signature": "describe.Signature",
    "SignatureTable": "similarity.SignatureTable",
    "SubmapDatabase": "database.SubmapDatabase",
    "add_session": "build.add_session",
    "build_session": "build.build_session",
    "create_database": "database.create_database",
    "distances": "similarity.distances",
    "locate": "relocalize.relocalize",
    "locate_map": "relocalize.locate_map",
    "open_database": "database.open_database",
    "provenance": "build.provenance",
    "signature_of": "describe.describe",
}
__all__ = [*_HOMES]
__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
