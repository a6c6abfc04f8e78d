"""The fit finds the model that made the answers, and is judged on what was left out."""

from dataclasses import replace

import numpy as np
import pytest

from pc2grid_lab.experiments.calibration import Known, fit, left_out, log_loss, roc_area, share_by_session
from signature.localization.confidence import Calibration, Evidence

TRUTH = Calibration(bias=-5.0, support=4.0, clearance=1.5)


def answers(count: int) -> list[Known]:
    rng = np.random.default_rng(0)
    made = []
    for i in range(count):
        evidence = Evidence(
            forward=float(rng.uniform(0.3, 0.98)),
            walls=float(rng.uniform(30, 300)),
            backward=float(rng.uniform(0.3, 0.98)),
            looked_at=float(rng.uniform(30, 300)),
            lead=float(rng.uniform(0.05, 0.3)),  # so long that the places are not equal
            likeness=float(rng.uniform(0.0, 1.0)),
        )
        right = bool(rng.random() < TRUTH.probability(evidence))
        buildings = frozenset("abc"[i % 3])
        made.append(Known(buildings=buildings, session=str(i // 4), evidence=evidence, right=right))
    return made


def test_the_fit_recovers_the_model_that_made_the_answers() -> None:
    found = fit(answers(6000))
    assert found.bias == pytest.approx(TRUTH.bias, abs=0.5)
    assert found.support == pytest.approx(TRUTH.support, rel=0.15)
    assert found.clearance == pytest.approx(TRUTH.clearance, rel=0.15)


def test_right_answers_weigh_what_they_are_told_to() -> None:
    """Half of the wrong answers left out: with a given weight of the right ones, the fit is the same."""
    some = answers(6000)
    kept = [a for i, a in enumerate(some) if a.right or i % 2]
    by_number, by_weight = ([fit(of, share_right).bias for of in (some, kept)] for share_right in (None, 0.5))
    assert by_number[1] - by_number[0] == pytest.approx(np.log(2.0), abs=0.2)
    assert by_weight[1] == pytest.approx(by_weight[0], abs=0.2)


def test_answers_are_judged_by_a_fit_without_their_group() -> None:
    some = answers(1500)
    held_out = left_out(some)
    own = np.array([TRUTH.probability(a.evidence) for a in some])
    assert log_loss(some, held_out) == pytest.approx(log_loss(some, own), abs=0.02)
    assert roc_area(some, held_out) == pytest.approx(roc_area(some, own), abs=0.02)
    assert roc_area(some, np.zeros(len(some))) == 0.5


def test_no_answer_of_a_building_takes_part_in_the_fit_that_judges_it() -> None:
    """Here the queries of a in the map of b would teach a fit that nothing is ever right."""
    some = [replace(a, buildings=frozenset("ab"), right=False) for a in answers(900)]
    known = [a for a in answers(1500) if a.buildings != frozenset("b")] + some
    held_out = left_out(known)
    for name in "ac":
        here = np.array([a.buildings == frozenset(name) for a in known])
        without = fit([a for a in known if name not in a.buildings])
        wanted = [without.probability(a.evidence) for a in known if a.buildings == frozenset(name)]
        assert held_out[here] == pytest.approx(wanted)
    only_c = fit([a for a in known if a.buildings == frozenset("c")])
    assert held_out[-1] == pytest.approx(only_c.probability(some[-1].evidence))


def test_a_fit_needs_both_kinds() -> None:
    with pytest.raises(ValueError, match="right and wrong"):
        fit([a for a in answers(50) if a.right])


def test_the_interval_counts_sessions_not_answers() -> None:
    yes = np.repeat([True, False], 50)
    share, low, high = share_by_session([f"{i}" for i in range(100)], yes)
    _, wide_low, wide_high = share_by_session(["a"] * 50 + ["b"] * 50, yes)
    assert share == 0.5 and 0.4 < low < 0.5 < high < 0.6
    assert (wide_low, wide_high) == (0.0, 1.0)
