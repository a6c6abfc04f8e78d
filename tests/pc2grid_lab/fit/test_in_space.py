"""The factor in space of `fit.posterior` on made queries whose model is known, and as its users run it."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import F64
from pc2grid.matching.evidence import Evidence
from pc2grid_lab.fit.posterior import Compared, compared_of, fit_factor_in_space, left_out, main, shuffled
from signature.localization.in_space import masses_in_space

TRUTH = np.array([6.0, -15.0, -60.0, -2.0])
FITS = Evidence(known_agreement=0.9, compared=80.0, backward=0.8, looked_at=80.0, lead=0.1, likeness=0.3)
IN_MAP = {"log": "a", "map": "a", "start": "one 0.0", "travel_m": 5.0, "place": "in the map"}


def queries(count: int) -> list[Compared]:
    """Two places each; which of them is the true one, if any, is drawn by the masses that `TRUTH` gives."""
    rng = np.random.default_rng(0)
    made = []
    for number in range(count):
        in_plane = rng.uniform(0.05, 0.4, 2)
        shares = rng.dirichlet((12.0, 1.5, 0.7), 2)
        terms = np.column_stack((rng.uniform(0.3, 0.8, (2, 1)) * shares, np.zeros(2)))
        terms[rng.random(2) < 0.2] = 0.0, 0.0, 0.0, 1.0
        drawn = rng.random() - np.cumsum(masses_in_space(in_plane, terms @ TRUTH)[0])
        right = frozenset(k for k in (0, 1) if drawn[k] < 0.0 and (k == 0 or drawn[0] >= 0.0))
        of = "abc"[number % 3]
        made.append(
            Compared(building=of, buildings=frozenset(of), in_plane=in_plane, terms=terms, right=right)
        )
    return made


def test_the_fit_recovers_what_each_kind_of_ray_tells() -> None:
    """To what the number of queries allows; that some truths are taken for none makes the fit steeper."""
    on, through, before, left = fit_factor_in_space(queries(1600))
    assert on == pytest.approx(TRUTH[0], rel=0.4)
    assert before == pytest.approx(TRUTH[2], rel=0.4)
    assert before < 2.0 * through and through < 0.0 and left < 0.0


def test_a_query_is_judged_without_its_building() -> None:
    """In building c the rays tell the opposite, which the others do not show."""
    some = [replace(q, terms=-q.terms) if q.building == "c" else q for q in queries(30)]

    def fitted(some: Sequence[Compared]) -> F64:
        """Fit in no time; what is left out shows as well as with a minimizer."""
        return np.asarray(np.concatenate([q.terms for q in some]).mean(axis=0))

    of_others = fitted([q for q in some if q.building != "c"])
    judged = [q.masses(x) for q, x in zip(some, left_out(some, fitted), strict=True)]
    assert all(
        masses == pytest.approx(q.masses(of_others))
        for q, masses in zip(some, judged, strict=True)
        if q.building == "c"
    )
    assert np.abs(fitted(some) - of_others).max() > 0.1


def test_shuffled_rays_do_not_tell_places_apart() -> None:
    some = queries(300)
    right = [sum(int(q.masses(TRUTH).argmax()) in q.right for q in given) for given in (some, shuffled(some))]
    assert right[0] > 1.3 * right[1]


def row(error_m: float, *, at: str = "a") -> dict[str, object]:
    evidence = [asdict(FITS), asdict(FITS)]
    compared = {"1": {"terms": [0.5, 0.0, 0.0, 0.0], "error": [error_m, 0.0]}}
    return IN_MAP | {"map": at, "evidence": evidence, "errors": [[3.0, 1.0]] * 2, "in_space": compared}


def test_the_place_that_counts_is_where_icp_ends() -> None:
    rows = [row(0.1), row(0.6) | {"start": "two 0.0"}]
    near, far = compared_of(rows + rows[:1])  # a window that is asked twice counts once
    assert near.right == {1} and far.right == frozenset()
    assert np.isnan(near.terms[0]).all() and near.terms[1, 0] == 0.5
    assert near.masses(TRUTH)[1] > near.in_plane[1]


def test_it_prints_what_is_located(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row(0.1 if at == of else 9.0, at=at) | {"log": of, "start": of} for of in "abc" for at in "abc"]
    file = tmp_path / "evidence.json"
    file.write_text(json.dumps(rows))
    main([file], in_space=True)
    printed = capsys.readouterr().out
    assert "in use: " in printed and "of 3 right" in printed and "fitted without the building: " in printed
