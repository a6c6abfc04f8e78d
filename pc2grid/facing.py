"""Which way the surface at each point of a sweep faces.

A thin wall has two faces, a door post three. Seen from one side after the other they are a few centimetres
apart, and a matcher that takes them for one surface is pulled over by half of that at every door.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32

_NEAR_M, _NEAR_PER_M = 0.08, 0.02  # reach of a neighbourhood, growing with the distance between beams
_SPARSE = 4.0  # times as far where that holds too few
_MAX_FLATNESS = 0.3  # thickness over length, squared: above it is no surface


def facing(hits_m: F32, origin_m: F64) -> F32:
    """Directions (M,) in radians that the surfaces at hits (M, 2) face, in the hits' frame.

    The normal of the neighbours in the sweep, on the side of the sensor at `origin_m` (2,). A point that
    lies on no surface faces the sensor.
    """
    away = hits_m.astype(np.float64) - origin_m
    bearings = np.arctan2(away[:, 1], away[:, 0])
    return _normals(away, np.argsort(bearings, kind="stable"), bearings)


@njit(cache=True)
def _normals(away: F64, order: NDArray[np.intp], bearings: F64) -> F32:
    count = len(order)
    angles = np.empty(count, dtype=np.float32)
    for place in range(count):
        i = order[place]
        x, y = away[i]
        distance = math.hypot(x, y)
        towards = math.atan2(-y, -x)
        angles[i] = towards
        for scale in (1.0, _SPARSE):
            reach = scale * (_NEAR_M + _NEAR_PER_M * distance)
            window = reach / max(distance, reach)
            n = 1.0
            sx = sy = sxx = sxy = syy = 0.0
            for step, farthest in ((-1, (count - 1) // 2), (1, count // 2)):  # each neighbour once
                for k in range(1, farthest + 1):
                    j = order[(place + step * k) % count]
                    turn = abs(bearings[j] - bearings[i])
                    if min(turn, 2.0 * math.pi - turn) > window:
                        break
                    dx, dy = away[j, 0] - x, away[j, 1] - y
                    if dx * dx + dy * dy < reach * reach:
                        n += 1.0
                        sx += dx
                        sy += dy
                        sxx += dx * dx
                        sxy += dx * dy
                        syy += dy * dy
            if n < 3.0:
                continue
            mx, my = sx / n, sy / n
            a, b, d = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
            spread = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
            if 0.5 * (a + d) - spread < _MAX_FLATNESS * (0.5 * (a + d) + spread):
                normal = 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
                if math.cos(normal - towards) < 0.0:
                    normal += math.pi
                angles[i] = normal
            break
    return angles
