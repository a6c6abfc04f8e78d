"""The methods of the comparison by name: the paper's own and its six rivals (paper IV-A)."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from pc2grid import extras
from pc2grid_lab.paper.proposed import Proposed
from pc2grid_lab.paper.protocol import Method
from pc2grid_lab.paper.rivals.sdf import DistanceFeatures
from pc2grid_lab.paper.rivals.shape_context import ShapeContext
from pc2grid_lab.paper.rivals.words import FEATURES, Vocabulary, Words
from pc2grid_lab.paper.several_centres import SeveralCentres
from signature.config import SignatureConfig

METHOD_NAMES = (
    "proposed",
    "as_used_here",
    "shape_context",
    "sift_bow",
    "surf_bow",
    "sift_tfidf",
    "surf_tfidf",
    "sdf",
)
"""The paper's method to the letter and with our default settings; its rivals in the order of Table III."""

OURS = METHOD_NAMES[:2]
"""Both stand beside the published row."""

EXTRA_METHOD_NAMES = ("as_used_here_centres", "boundary_centres", "shape_context_centres")
"""Beyond the paper: places described from several centres, by Eq. 6, by its boundary alone, and by the shape
context."""


def require_packages(names: Collection[str]) -> None:
    """Raise ConfigError if packages are missing that the methods with these names need."""
    wanted = [name for name in names if name.startswith("surf")]
    if wanted:
        extras.require({"paper": ", ".join(wanted)})


def make_methods(names: Iterable[str]) -> dict[str, Method]:
    """Methods by name, with the paper's parameters.

    Methods with the same local features share them when they are made together, so that the features of a
    submap are extracted once. Raises KeyError for a name that is not known.
    """
    vocabularies: dict[str, Vocabulary] = {}
    return {name: _make(name, vocabularies) for name in names}


def _make(name: str, vocabularies: dict[str, Vocabulary]) -> Method:
    if name == "boundary_centres":
        # A spread of 1e6 makes Omega of Eq. 6 equal to 1.
        return SeveralCentres(method=Proposed(SignatureConfig(weight_boundary=1.0, symmetry_sigma=1e6)))
    if name in EXTRA_METHOD_NAMES:
        return SeveralCentres(method=_make(name.removesuffix("_centres"), vocabularies))
    if name == "proposed":
        return Proposed(SignatureConfig.paper())
    if name == "as_used_here":
        return Proposed()
    if name == "shape_context":
        return ShapeContext()
    if name == "sdf":
        return DistanceFeatures()
    feature, _, weighting = name.partition("_")
    if name in METHOD_NAMES:
        vocabulary = vocabularies.setdefault(feature, Vocabulary(FEATURES[feature]))
        return Words(vocabulary, tfidf=weighting == "tfidf")
    raise KeyError(f"no method {name!r}; there are {', '.join(METHOD_NAMES + EXTRA_METHOD_NAMES)}")
