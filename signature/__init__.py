"""Submaps -> signatures -> database -> retrieval -> verified pose.

The back of pc2grid: one file for each section of the paper (`boundary`, `freespace`, `symmetry`,
`paper`), the database behind one protocol, and localization. Importing this package loads no library:
each name loads its module when it is first used. `help(signature.relocalize)` and so on explain them.

>>> import pc2grid, signature
>>> with signature.open_database("building.submaps") as database, pc2grid.open_log("tuesday.mcap") as log:
...     config = database.config()
...     localizer = signature.Localizer(signature.MapIndex.of(database, config))
...     for registered, planar_scan in pc2grid.follow(log.scans(), config):
...         found = localizer.add(registered, planar_scan)  # None but after every metre
>>> answer = localizer.answer()
>>> answer.status, answer.session
('located', 'monday')

The paper
    signature_of        a submap's three signatures: a Signature
    distances           of a query to the rows of a SignatureTable (Eq. 6)

Databases
    convert             a recording or nav2 map becomes a session in a database
    build_session       the same without storing; provenance: what a session was made from
    build_sessions      the same; several, if the recording does not hang together
    add_session         store a session
    open_database, SubmapDatabase, Label

Answers
    relocalize          where in a database a recording was made: a Found, an Answer that can be drawn
    Localizer           where registered scans were taken, in a MapIndex: an Answer after every metre
    locate_map          where a drawn map lies
    Prior               where the robot is known to be, roughly
    check_pose          whether a pose that is believed agrees with the map: a PoseCheck
    Config              settings
"""

from importlib import import_module
from typing import TYPE_CHECKING

# The public names, for type checkers and editors. A function with the name of its module has another name,
# as the module would hide it.
if TYPE_CHECKING:
    from signature.config import Config as Config
    from signature.database import (
        Label as Label,
        SubmapDatabase as SubmapDatabase,
        open_database as open_database,
    )
    from signature.localization.answer import Answer as Answer
    from signature.localization.localizer import Localizer as Localizer, locate_map as locate_map
    from signature.localization.pose_check import PoseCheck as PoseCheck, check_pose as check_pose
    from signature.paper import (
        Signature as Signature,
        SignatureTable as SignatureTable,
        describe as signature_of,  # noqa: F401
        distances as distances,
    )
    from signature.places.map_index import MapIndex as MapIndex, Prior as Prior
    from signature.sessions import (
        add_session as add_session,
        build_session as build_session,
        build_sessions as build_sessions,
        convert as convert,
        provenance as provenance,
        relocalize as relocalize,
    )
    from signature.shown.page import Found as Found

# Where each is found; with another name there, behind the colon. A test compares this with the list above.
_HOMES = {
    "Config": "signature.config",
    "Label": "signature.database",
    "SubmapDatabase": "signature.database",
    "open_database": "signature.database",
    "Signature": "signature.paper",
    "signature_of": "signature.paper:describe",
    "convert": "signature.sessions",
    "relocalize": "signature.sessions",
    "Answer": "signature.localization.answer",
    "Found": "signature.shown.page",
    "MapIndex": "signature.places.map_index",
    "PoseCheck": "signature.localization.pose_check",
    "check_pose": "signature.localization.pose_check",
    "Prior": "signature.places.map_index",
    "Localizer": "signature.localization.localizer",
    "locate_map": "signature.localization.localizer",
    "add_session": "signature.sessions",
    "build_session": "signature.sessions",
    "build_sessions": "signature.sessions",
    "provenance": "signature.sessions",
    "SignatureTable": "signature.paper",
    "distances": "signature.paper",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> object:
    """Load the module of a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, thing = _HOMES[name].partition(":")
    return getattr(import_module(module), thing or name)


def __dir__() -> list[str]:
    return __all__
