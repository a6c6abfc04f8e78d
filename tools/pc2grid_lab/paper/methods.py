"""The methods of the comparison by name: the paper's own and its six rivals (paper IV-A)."""

from __future__ import annotations

from collections.abc import Iterable

from pc2grid.arrays import F64
from pc2grid_lab.paper.learned import LEARNED, UNLEARNED, Learned, Unlearned, Vectors
from pc2grid_lab.paper.proposed import Proposed, Signatures
from pc2grid_lab.paper.protocol import Method
from pc2grid_lab.paper.rivals.sdf import DistanceFeatures
from pc2grid_lab.paper.rivals.shape_context import ShapeContext
from pc2grid_lab.paper.rivals.words import Vocabulary, Words, sift, surf
from pc2grid_lab.paper.several_centres import SeveralCentres
from signature.config import SignatureConfig

METHOD_NAMES = (
    "proposed",
    "proposed_ln_bc",
    "shape_context",
    "sift_bow",
    "surf_bow",
    "sift_tfidf",
    "surf_tfidf",
    "sdf",
)
"""The paper's method to the letter, with both readings of the distance d of Eq. 6, OpenCV's sqrt(1 - BC) and
-ln BC; its rivals in the order of Table III."""

OURS = (*METHOD_NAMES[:2], "as_used_here")
"""What stands beside the published row in both tables; the last one with the default settings."""

EXTRA_METHOD_NAMES = (
    "as_used_here",
    *LEARNED,
    "unlearned",
    "as_used_here_centres",
    "boundary_centres",
    "shape_context_centres",
)
"""Beyond the paper: the default settings; the boundary at several radii with a learned metric, with more and
fewer parts, and nothing learned; places described from several centres, by Eq. 6, by its boundary alone, and
by the shape context."""


def make_methods(
    names: Iterable[str], within: F64 | None = None, signatures: Signatures | None = None
) -> dict[str, Method]:
    """Methods by name, with the paper's parameters.

    Methods with the same features share them when they are made together, so that the features of a submap
    are extracted once. within : `learned.differences` of other maps, without which no method can be made that
    learns. Raises KeyError for a name that is not known.
    """
    signatures, vectors = signatures or Signatures(), Vectors()
    sift_words, surf_words = Vocabulary(sift), Vocabulary(surf)
    # A spread of 1e6 makes Omega of Eq. 6 equal to 1.
    boundary = Proposed(SignatureConfig(weight_boundary=1.0, symmetry_sigma=1e6))
    ln_bc = SignatureConfig.paper().model_copy(update={"histogram_distance": "bhattacharyya"})
    known: dict[str, Method] = {
        "proposed": Proposed(SignatureConfig.paper(), signatures),
        "proposed_ln_bc": Proposed(ln_bc, signatures),
        "as_used_here": Proposed(),
        "shape_context": ShapeContext(),
        "sift_bow": Words(sift_words, tfidf=False),
        "surf_bow": Words(surf_words, tfidf=False),
        "sift_tfidf": Words(sift_words, tfidf=True),
        "surf_tfidf": Words(surf_words, tfidf=True),
        "sdf": DistanceFeatures(),
        "unlearned": Unlearned(vectors, UNLEARNED),
        "as_used_here_centres": SeveralCentres(method=Proposed()),
        "boundary_centres": SeveralCentres(method=boundary),
        "shape_context_centres": SeveralCentres(method=ShapeContext()),
    }
    if within is not None:
        known |= {name: Learned(vectors, parts, within) for name, parts in LEARNED.items()}
    return {name: known[name] for name in names}
