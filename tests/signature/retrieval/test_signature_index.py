"""The index against comparing all rows one by one: the answers are equal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from signature.config import SignatureConfig
from signature.describe import Signature
from signature.retrieval import signature_index
from signature.retrieval.signature_index import Nearest, SignatureIndex, sessions_by_likeness
from signature.similarity import SignatureTable, distances


def many(count: int, seed: int, bins: tuple[int, int] = (50, 47)) -> SignatureTable:
    """Places of a dozen kinds, each many times with small differences, some of them unknown altogether."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(0, 12, count)

    def histograms(width: int) -> np.ndarray:
        rows = rng.dirichlet(np.full(width, 0.5), 12)[kinds] * np.exp(
            0.2 * rng.standard_normal((count, width))
        )
        rows /= rows.sum(axis=1, keepdims=True)
        rows[::101] = 0.0
        return rows.astype(np.float32)

    return SignatureTable(
        boundary=histograms(bins[0]),
        freespace=histograms(bins[1]),
        symmetry=(rng.uniform(0, 34, (12, 2))[kinds] + rng.normal(0, 2, (count, 2))).astype(np.float32),
        session_index=np.zeros(count, np.int32),
        submap_id=np.arange(count, dtype=np.int32),
        center_m=np.zeros((count, 2)),
    )


def row(table: SignatureTable, i: int) -> Signature:
    return Signature(boundary=table.boundary[i], freespace=table.freespace[i], symmetry=table.symmetry[i])


TABLE = many(12_000, 0)
INDEX = SignatureIndex.of(TABLE)


@settings(max_examples=12, deadline=None)
@given(
    i=st.integers(0, len(TABLE) - 1),
    k=st.sampled_from([1, 20, 400]),
    kind=st.sampled_from(["hellinger", "bhattacharyya"]),
    weight=st.sampled_from([0.0, 0.3, 0.9, 1.0]),
    sigma=st.sampled_from([0.5, 5.0, 120.0]),
)
def test_the_same_rows_as_by_comparing_all(i: int, k: int, kind: str, weight: float, sigma: float) -> None:
    config = SignatureConfig(histogram_distance=kind, weight_boundary=weight, symmetry_sigma=sigma)
    exact = distances(row(TABLE, i), TABLE, config)
    found = INDEX.nearest(row(TABLE, i), k, config)
    order = np.argsort(exact, kind="stable")[:k]
    assert found.scores == pytest.approx(exact[order], rel=1e-9, abs=1e-12)
    assert exact[found.rows] == pytest.approx(exact[order], rel=1e-9, abs=1e-12)
    assert len(np.unique(found.rows)) == k
    if sigma == 120.0:  # sharper, and a few rows of the sample decide
        assert found.mean == pytest.approx(exact.mean(), rel=0.05)
        assert found.spread == pytest.approx(exact.std(), rel=0.05)


def test_no_bound_exceeds_the_distance_it_bounds() -> None:
    for kind in ("hellinger", "bhattacharyya"):
        config = SignatureConfig(histogram_distance=kind)
        for i in (0, 1, 500):
            bound = INDEX.bounds([row(TABLE, i)], config)[0]
            assert (bound <= distances(row(TABLE, i), TABLE, config)).all()
            assert np.median(bound) > 0


def test_a_large_and_a_small_table_give_equal_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    table, config = many(1000, 1), SignatureConfig()
    whole = SignatureIndex.of(table).nearest(row(table, 7), 30, config)
    monkeypatch.setattr(signature_index, "DIRECT", 50)
    sketched = SignatureIndex.of(table)
    assert sketched.boundary.size and sketched.freespace.size
    assert sketched.nearest(row(table, 7), 30, config).rows.tolist() == whole.rows.tolist()
    # Twins come in the order of their rows, and asking for more than there is gives all.
    twins = SignatureTable.of([row(table, 7)] * 200, np.zeros((200, 2)))
    found = SignatureIndex.of(twins).nearest(row(table, 7), 5, config)
    assert found.rows.tolist() == [0, 1, 2, 3, 4] and (found.scores == 0).all()
    assert len(sketched.nearest(row(table, 7), 5000, config).rows) == 1000


def test_arrays_that_are_not_histograms_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signature_index, "DIRECT", 50)
    wrong = many(100, 2)
    with pytest.raises(ValueError, match="more than 1"):
        SignatureIndex.of(
            SignatureTable(
                **{n: getattr(wrong, n) for n in wrong.__slots__} | {"boundary": wrong.boundary * 2}
            )
        )
    with pytest.raises(ValueError, match="bins"):
        SignatureIndex.of(wrong).nearest(row(many(1, 0, (40, 40)), 0), 3, SignatureConfig())


def test_the_likeliest_session_is_where_the_best_of_all_lists_stand_out() -> None:
    session_index = np.array([5, 5, 7, 7, 9, 9], np.int32)
    found = [
        Nearest(np.array([2, 0, 4]), np.array([0.1, 0.5, 0.6]), mean=1.0, spread=0.5),
        Nearest(np.array([3, 1]), np.array([10.0, 12.0]), mean=20.0, spread=4.0),
    ]
    # In standard deviations: 7 has -1.8 and -2.5, 5 has -1 and -2, 9 has -0.8 and nothing in the second list.
    assert sessions_by_likeness(found, session_index).tolist() == [7, 5, 9]
    assert found[0].only(np.array([True, False, True])).rows.tolist() == [2, 4]
