"""The most similar submaps of a whole database: exact by Eq. 6, or from a shortlist found by an embedding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from signature.database.protocol import Neighbour
from signature.similarity import distances

if TYPE_CHECKING:
    from pc2grid.arrays import F32
    from signature.config import SignatureConfig
    from signature.describe import Signature
    from signature.similarity import SignatureTable


def embedding(boundary: F32, freespace: F32, config: SignatureConfig) -> F32:
    """Vectors (N, Nb + Nf) whose inner product is the weighted Bhattacharyya coefficient, 0..1.

    The coefficient is omega_b BC(H^b) + omega_f BC(H^f) with BC = sum sqrt(a b), so the vector consists of
    the square roots of both histograms, each times the root of its weight.
    """
    roots = (
        np.sqrt(config.weight_boundary * boundary.astype(np.float64)),
        np.sqrt((1.0 - config.weight_boundary) * freespace.astype(np.float64)),
    )
    return np.hstack(roots).astype(np.float32)


def rank(
    query: Signature,
    table: SignatureTable,
    names: Sequence[str],
    count: int,
    config: SignatureConfig,
    among: NDArray[np.bool_] | None = None,
) -> tuple[Neighbour, ...]:
    """The `count` rows of a table that are most similar by Eq. 6, best first; ties in the order of the table.

    names : of the sessions that `table.session_index` counts. among : (N,) rows to choose from; None: all.
    """
    if not len(table):
        return ()
    scores = distances(query, table, config)
    order = np.argsort(scores, kind="stable")
    if among is not None:
        order = order[among[order]]
    return tuple(
        Neighbour(
            session=names[table.session_index[row]],
            submap_id=int(table.submap_id[row]),
            center_m=(float(table.center_m[row, 0]), float(table.center_m[row, 1])),
            score=float(scores[row]),
        )
        for row in order[:count]
    )
