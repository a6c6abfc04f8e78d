"""An independent reading of nav2 maps."""

from __future__ import annotations

from typing import Any


def oracle(grey: int, keys: dict[str, Any], mode: str) -> int:
    """The cell of a grey value, 0..255, as the documentation of nav2 defines it."""
    shade = grey / 255
    if mode == "raw":
        return grey if grey <= 100 else -1
    occupied = shade if keys["negate"] else 1 - shade
    if occupied > keys["occupied_thresh"]:
        return 100
    if occupied < keys["free_thresh"]:
        return 0
    if mode == "trinary":
        return -1
    return round((occupied - keys["free_thresh"]) / (keys["occupied_thresh"] - keys["free_thresh"]) * 100)
