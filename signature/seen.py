"""The three signatures of what was seen: of an isovist, without the rays whose ends are hidden.

A submap of a map is known whole, a view of a query often in part: a camera that has driven a metre has seen a
quarter of what surrounds it. The histograms of III-B to III-D then compare a part with a whole. Here every
bin is a share of what *was seen*: a ray that ends on unknown cells, and each pair of rays with such a ray,
counts neither for nor against. A part then has about the histogram of the whole. All three are invariant to
rotation, as in the paper. Each stands beside that of a submap, in `signature.boundary`, `signature.freespace`
and `signature.symmetry`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32
from pc2grid.submaps.isovist import HIDDEN
from signature.boundary import RANGE_BINS, RIMS, boundary_seen, rim_columns
from signature.freespace import DETOUR_BINS, PATH_BINS, STEPS_M, freespace_seen
from signature.symmetry import BESIDE, QUANTILES, symmetry_seen

_AT_ONCE = 4096
"""Isovists whose pairs are in memory at the same time."""


def parts() -> dict[str, slice]:
    """Which columns of `seen_signatures` belong to which of the three signatures."""
    sizes = {
        "boundary": RANGE_BINS + 1 + sum(len(rim_columns(rim)) for rim in RIMS),
        "freespace": PATH_BINS + DETOUR_BINS + len(STEPS_M) + 1,
        "symmetry": len(BESIDE) + 2 + len(QUANTILES) + 1,
    }
    ends = np.cumsum(list(sizes.values())).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def signature_columns() -> slice:
    """All columns of the three signatures; the last one, the share of rays that were seen, is left out."""
    return slice(0, -1)


def seen_signatures(ranges_m: F32, ends: NDArray[np.int8], sight_m: float) -> F32:
    """The signatures of what was seen, side by side, and the share that was seen: (N, K) float32.

    ranges_m, ends : (N, B) of isovists, as of `pc2grid.submaps.isovist.look_around` with `sight_m`, B a
    multiple of 8. The columns of each signature are those of `parts`. Histograms are square roots of shares,
    so that their Euclidean distance is that of Hellinger, and 0 where nothing was seen. The last column is
    the share of the rays, 0..1, whose ends are known.
    """
    found = [
        np.concatenate(
            (
                boundary_seen(ranges_m[part], ends[part], sight_m),
                freespace_seen(ranges_m[part], ends[part], sight_m),
                symmetry_seen(ranges_m[part], ends[part]),
                np.mean(ends[part] != HIDDEN, axis=1, keepdims=True),
            ),
            axis=1,
        )
        for part in (slice(at, at + _AT_ONCE) for at in range(0, max(len(ranges_m), 1), _AT_ONCE))
    ]
    return np.concatenate(found).astype(np.float32)
