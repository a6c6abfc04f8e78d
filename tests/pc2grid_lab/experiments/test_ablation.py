"""What each signature contributes: distances by combinations, AUC across sensors, ablation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.ablation import (
    COMBINATIONS,
    Independence,
    independence,
    part_distances,
    ranks,
    recall_by_combination,
)
from pc2grid_lab.experiments.metrics import ConfidenceError
from pc2grid_lab.experiments.sensor_map import SensorMap
from signature.config import SignatureConfig
from signature.describe import Signature
from signature.localization.query import query_of
from signature.similarity import distances
from tests.helpers.simulated_drives import building, office, plan
from tests.helpers.trials import trial

SMALL = building({"small": plan(10, 8, [(4, 0, 4, 5), (6, 3, 10, 3), (6, 5, 6, 8)])})


def first() -> Signature:
    table = SMALL.places.table
    return Signature(boundary=table.boundary[0], freespace=table.freespace[0], symmetry=table.symmetry[0])


def test_all_three_together_are_eq_6_and_symmetry_alone_orders_by_symmetry() -> None:
    table, config = SMALL.places.table, SignatureConfig()
    parts = part_distances(first(), table, config)
    assert list(parts) == list(COMBINATIONS) and COMBINATIONS[-1] == "boundary+freespace+symmetry"
    np.testing.assert_allclose(parts[COMBINATIONS[-1]], distances(first(), table, config))
    apart = ((table.symmetry - table.symmetry[0]) ** 2).sum(axis=1)
    assert (np.argsort(parts["symmetry"], kind="stable") == np.argsort(apart, kind="stable")).all()
    np.testing.assert_allclose(parts["boundary+freespace"], parts["boundary"] + parts["freespace"])


def test_auc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    same, other = rng.integers(0, 9, 40).astype(float), rng.integers(3, 12, 60).astype(float)
    pairs = (same[:, None] < other).mean() + 0.5 * (same[:, None] == other).mean()
    measured = Independence(combination="boundary", same=same, other=other)
    assert measured.auc == pytest.approx(pairs)
    twice = Independence.together([measured, measured])
    assert twice.auc == pytest.approx(pairs) and len(twice.same) == 80
    assert math.isnan(Independence(combination="boundary", same=np.empty(0), other=other).auc)


def test_equal_maps_by_two_sensors_have_equal_signatures() -> None:
    """The same plan as the map of two sensors: the distance between its descriptions is 0."""
    there = SE2(30.0, -4.0, math.pi / 2)
    moved = plan(10, 8, [(4, 0, 4, 5), (6, 3, 10, 3), (6, 5, 6, 8)])
    maps = [
        SensorMap(name="small", sensor="lidar", T_plan_map=SE2(), index=SMALL),
        SensorMap(name="small", sensor="laser", T_plan_map=SE2(), index=building({"small": moved})),
    ]
    for measured in independence(maps):
        assert len(measured.same) == 2 * len(SMALL.places.table)
        assert np.ptp(measured.same) < 1e-6 and measured.auc > 0.9
    elsewhere = SensorMap(name="small", sensor="depth", T_plan_map=there, index=SMALL)
    assert all(len(measured.same) == 0 for measured in independence([maps[0], elsewhere]))


def test_a_query_of_the_map_itself_ranks_its_own_places_first() -> None:
    where = building({"office": office()})
    made_with = where.made_with
    query = query_of(
        office(),
        where.places.table.center_m[:8],
        made_with,
        where.config,
    )
    found = ranks(query, where.places, SE2(), made_with.signature, 1.0)
    assert found[COMBINATIONS[-1]] == 0 and set(found) == set(COMBINATIONS)
    away = ranks(query, where.places, SE2(500.0, 0.0), made_with.signature, 1.0)
    assert set(away.values()) == {-1}


def test_recall_by_combination_and_the_errors_of_the_confidence_by_hand() -> None:
    worse = dict.fromkeys(COMBINATIONS, 7)
    trials = [trial(), trial(alone=worse, rank=3, confidence=0.8, right=False), trial(travel_m=3.0, rank=-1)]
    table = recall_by_combination(trials, 10.0)
    assert table["all"]["boundary"] == {1: 0.5, 5: 0.5, 20: 1.0}
    assert table["depth"]["with isovists"] == {1: 0.5, 5: 1.0, 20: 1.0}
    errors = ConfidenceError.of(trials[:2])
    assert errors.brier == pytest.approx((0.05**2 + 0.8**2) / 2)
    assert errors.expected_error == pytest.approx((0.05 + 0.8) / 2)
    assert ConfidenceError.of([]).brier is None
