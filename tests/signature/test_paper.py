"""A submap is described with the libraries whose structures the paper names: graph and neighbour search."""

import math
from collections import Counter
from typing import Any

import networkx as nx
import numpy as np
import pytest
import scipy
from hypothesis import given, settings, strategies as st

from signature.config import SignatureConfig
from signature.freespace import freespace_graph
from signature.paper import Signature, SignatureTable, describe, distances, histogram_distance, similarity
from tests.helpers.rooms import cross, degenerate, disc, l_shape, random_rooms, rectangle, submap_of


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


# --- Eq. 6-8 of the paper, and signatures of submaps with nothing in them ---


CONFIG = SignatureConfig()


def signature(boundary: list[float], freespace: list[float], symmetry: list[float]) -> Signature:
    return Signature(boundary=np.array(boundary), freespace=np.array(freespace), symmetry=np.array(symmetry))


def table(*signatures: Signature) -> SignatureTable:
    return SignatureTable.of(signatures, np.zeros((len(signatures), 2)))


def test_eq_6_to_8_by_hand() -> None:
    query = signature([0.5, 0.5, 0.0], [1.0, 0.0], [50.0, 20.0])
    other = signature([0.5, 0.0, 0.5], [0.64, 0.36], [110.0, 60.0])
    boundary = math.sqrt(1 - 0.5)  # BC = sqrt(0.25)
    freespace = math.sqrt(1 - 0.8)  # BC = sqrt(0.64)
    phi_alpha = 0.08 * math.exp(60**2 / (2 * 120**2))
    phi_beta = 0.08 * math.exp(40**2 / (2 * 120**2))
    expected = phi_alpha * phi_beta * (0.9 * boundary + 0.1 * freespace)
    assert distances(query, table(other), CONFIG)[0] == pytest.approx(expected, rel=1e-6)
    log = SignatureConfig(histogram_distance="bhattacharyya")
    expected = phi_alpha * phi_beta * (0.9 * math.log(2) - 0.1 * math.log(0.8))
    assert distances(query, table(other), log)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("config", [CONFIG, SignatureConfig.paper()])
def test_a_submap_is_most_similar_to_itself(config: SignatureConfig) -> None:
    itself = signature([1.0, 0.0], [0.0, 1.0], [50.0, 20.0])
    assert similarity(distances(itself, table(itself), config)).tolist() == [math.inf]


def test_alike_submaps_are_nearer_than_others() -> None:
    shapes = l_shape(), disc(4.0), cross(6.0, 2.0), rectangle(8.0, 5.0)
    rooms = table(*(describe(submap_of(cells)) for cells in shapes))
    for i, cells in enumerate(shapes):
        turned = describe(submap_of(np.rot90(cells).copy()))
        assert int(np.argmin(distances(turned, rooms))) == i


@given(seed=st.integers(0, 300))
@settings(max_examples=10, deadline=None)
def test_all_rows_at_once_are_the_rows_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def random() -> Signature:
        return signature(rng.dirichlet(np.ones(80)), rng.dirichlet(np.ones(80)), rng.uniform(0, 34, 2))

    rows, query = [random() for _ in range(7)], random()
    together = distances(query, table(*rows))
    assert together == pytest.approx([distances(query, table(row))[0] for row in rows], rel=1e-9)
    assert together == pytest.approx([distances(row, table(query))[0] for row in rows], rel=1e-9)


@pytest.mark.parametrize("kind", ["hellinger", "bhattacharyya"])
@pytest.mark.parametrize("name", list(degenerate()))
def test_degenerate_submaps_are_defined(name: str, kind: str) -> None:
    config = SignatureConfig(histogram_distance=kind)
    found = describe(degenerate()[name], config)
    for histogram in (found.boundary, found.freespace):
        assert histogram.shape == (80,)
        assert histogram.sum() == pytest.approx(0.0) or histogram.sum() == pytest.approx(1.0)
    assert np.isfinite(found.symmetry).all()
    others = table(
        found, describe(submap_of(rectangle(8.0, 5.0)), config), describe(degenerate()["unknown"], config)
    )
    assert np.isfinite(distances(found, others, config)).all()


def test_empty_tables_and_wrong_shapes() -> None:
    room = describe(submap_of(rectangle(8.0, 5.0)))
    assert distances(room, SignatureTable.of([], np.empty((0, 2)))).shape == (0,)
    with pytest.raises(ValueError, match="bins"):
        histogram_distance(np.ones((1, 80), np.float32) / 80, np.ones((1, 60), np.float32) / 60, CONFIG)
    rows = {"boundary": np.zeros((2, 80)), "freespace": np.zeros((1, 80)), "symmetry": np.zeros((2, 2))}
    with pytest.raises(ValueError, match=r"SignatureTable.freespace: expected shape \(2, "):
        SignatureTable(
            **rows, session_index=np.zeros(2, int), submap_id=np.zeros(2, int), center_m=np.zeros((2, 2))
        )
