"""The weights of the bins, and how much a distance says."""

import numpy as np

from signature.visible import PARTS
from signature.weights import DIMENSIONS, SeenStatistics, seen_weights

SPREAD = SeenStatistics.load().spread()
COLUMNS = PARTS["symmetry"].stop


def test_each_signature_has_weights_of_its_own() -> None:
    assert seen_weights().matrix.shape == (COLUMNS, DIMENSIONS)
    for name, part in PARTS.items():
        alone = seen_weights(name).matrix
        assert alone[part].any() and not np.delete(alone, np.r_[part], axis=0).any()


def test_the_less_was_seen_the_less_a_distance_says() -> None:
    near, far = np.full(5, 20.0), np.full(5, 400.0)
    hidden = np.array([0.0, 0.4, 0.8, 1.2, 1.6])
    for_one, against = SPREAD.log_ratio(near, hidden), SPREAD.log_ratio(far, hidden)
    assert (for_one[:3] > 0.5).all() and (against[:3] < -0.5).all()
    assert (np.diff(for_one[:4]) < 0).all() and (np.diff(against[:4]) > 0).all()
    # Of two views that hide more than half of each other, a distance says little.
    assert for_one[3:].max() < 0.3 * for_one[0] and np.abs(against[3:]).max() < 0.3
    distances = SPREAD.log_ratio(np.linspace(15, 400, 50), np.zeros(50))
    assert (np.diff(distances) < 0).all()
