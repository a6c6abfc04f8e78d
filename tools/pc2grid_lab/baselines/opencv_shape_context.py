"""Shape Context as OpenCV has it, the likeliest form of the paper's rival (paper IV-A).

The paper names the numbers of angular and radial bins as "the main parameters", 24 and 12: these are the
first arguments of OpenCV's `ShapeContextDistanceExtractor`. It assigns the points of one shape to those of
the other and bends one into the other by thin plate splines (Belongie et al. 2002). Rotation invariance is
off by default there; without it turned queries are not found at all, so it is on here.

The class is in the module `shape` of opencv-contrib 4. That package and opencv-python-headless exclude each
other, so the method runs in an environment of its own:

    pip install . && pip uninstall opencv-python-headless
    pip install 'opencv-contrib-python-headless<5'
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, cells_of
from pc2grid.errors import ConfigError
from pc2grid.model import Submap
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import thin

_FARTHEST = 1e6
"""Distance of a shape with too few points to be compared; OpenCV's are below some 10,000."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenCvShapeContext:
    """Parameters; bins as in the paper, the rest OpenCV's defaults.

    points : of the boundary that are compared; the time grows with their third power. spacing_m : least
    distance of the boundary points among which they are chosen evenly. Both chosen by hand.
    """

    angular_bins: int = 24
    radial_bins: int = 12
    points: int = 100
    spacing_m: float = 0.2

    def fit(self, submaps: Sequence[Submap]) -> _Shapes:
        """Sample every submap. Raises ConfigError if OpenCV has no module `shape`."""
        extractor = require_shapes()(self.angular_bins, self.radial_bins)
        extractor.setRotationInvariant(True)
        return _Shapes(self, extractor, [self.sample(submap) for submap in submaps])

    def sample(self, submap: Submap) -> F32:
        """Up to `points` boundary points (K, 1, 2) as column, row, spread evenly."""
        cells = sample_evenly(cells_of(thin(submap.grid.occupied)), self.spacing_m / submap.grid.resolution_m)
        chosen = np.linspace(0, len(cells) - 1, min(self.points, len(cells))).astype(np.int64)
        return cells[chosen][:, None, ::-1].astype(np.float32)


def require_shapes() -> Any:
    """What makes OpenCV's shape contexts. Raises ConfigError if OpenCV has no module `shape`."""
    make = getattr(cv2, "createShapeContextDistanceExtractor", None)
    if make is None:
        raise ConfigError(
            "opencv_shape_context: this OpenCV has no Shape Context",
            hint="in an environment of its own: pip install 'opencv-contrib-python-headless<5'",
        )
    return make


@dataclass(frozen=True, slots=True)
class _Shapes:
    method: OpenCvShapeContext
    extractor: Any
    shapes: list[F32]

    def similarities(self, query: Submap) -> F64:
        wanted = self.method.sample(query)
        return -np.array([self._distance(wanted, shape) for shape in self.shapes])

    def _distance(self, a: F32, b: F32) -> float:
        if min(len(a), len(b)) < 3:  # thin plate splines need three points
            return _FARTHEST
        distance = float(self.extractor.computeDistance(a, b))
        return distance if np.isfinite(distance) else _FARTHEST
