"""A submap is described with the libraries whose structures the paper names: graph and neighbour search."""

from __future__ import annotations

from collections import Counter
from typing import Any

import networkx as nx
import numpy as np
import pytest
import scipy.spatial

from signature.freespace import freespace_graph
from signature.paper import Signature, describe
from tests.helpers.rooms import random_rooms, submap_of


def test_a_description_is_made_of_a_networkx_graph_and_a_kd_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    built: Counter[str] = Counter()

    def counted(name: str, original: Any) -> Any:
        def build(*arguments: Any, **options: Any) -> Any:
            built[name] += 1
            return original(*arguments, **options)

        return build

    monkeypatch.setattr(nx, "Graph", counted("graph", nx.Graph))
    monkeypatch.setattr(scipy.spatial, "cKDTree", counted("tree", scipy.spatial.cKDTree))
    describe(submap_of(random_rooms(1)))
    assert built["graph"] >= 1 and built["tree"] >= 1


def test_the_free_space_signature_is_that_of_the_graph() -> None:
    """The shortest edge is the shortest path of its two nodes, so its bin is not empty."""
    submap = submap_of(random_rooms(1))
    lengths = [length for _, _, length in freespace_graph(submap).edges(data="length_m")]
    found = describe(submap).freespace
    assert len(lengths) > 0 and found.sum() == pytest.approx(1.0, abs=1e-5)
    assert found[int(min(lengths) / 0.4)] > 0


def test_a_signature_is_read_only_and_has_one_axis_each() -> None:
    rows = np.ones((2, 3), np.float32)
    with pytest.raises(ValueError, match=r"Signature\.freespace"):
        Signature(boundary=rows[0], freespace=rows, symmetry=rows[0, :2])
    signature = Signature(boundary=rows[0], freespace=rows[0], symmetry=rows[0, :2])
    with pytest.raises(ValueError, match="read-only"):
        signature.boundary[0] = 0.0
