"""`pc2grid_lab.fit.posterior` on made answers whose model is known, and as its users run it."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.matching.evidence import EVIDENCE, Evidence, masses
from pc2grid_lab.fit import posterior
from pc2grid_lab.fit.posterior import Known, fit, known_of, left_out, log_loss

TRUTH = replace(EVIDENCE, bias=-4.0, fit=2.0, lead=4.0)


def place(rng: np.random.Generator, lead: float) -> Evidence:
    return Evidence(
        known_agreement=float(rng.uniform(0.3, 0.98)),
        compared=float(rng.uniform(30, 300)),
        backward=float(rng.uniform(0.3, 0.98)),
        looked_at=float(rng.uniform(30, 300)),
        lead=lead,
        likeness=float(rng.uniform(0.0, 1.0)),
    )


def answers(count: int) -> list[Known]:
    """Two places each; which of them is the true one, if any, is drawn by the masses that `TRUTH` gives."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(count):
        lead = float(rng.uniform(0.0, 0.15))
        places = (place(rng, lead), place(rng, -lead))
        drawn = rng.random() - np.cumsum(masses(places, p=TRUTH))
        first = next((k for k in (0, 1) if drawn[k] < 0.0), None)
        buildings = frozenset("abc"[i % 3])
        made.append(Known(kind="", buildings=buildings, session=str(i // 4), places=places, first=first))
    return made


def test_the_fit_recovers_the_model_that_made_the_answers() -> None:
    """To what the number of answers allows; that some truths are taken for none makes the fit a little
    steeper. The bias is that of a world in which half of the places are found."""
    some = answers(6000)
    found, share = fit(some), np.mean([a.first is not None for a in some])
    assert found.bias == pytest.approx(TRUTH.bias - np.log(share / (1.0 - share)), abs=0.5)
    assert found.fit == pytest.approx(TRUTH.fit, rel=0.25)
    assert found.lead == pytest.approx(TRUTH.lead, rel=0.25)
    kept = [a for i, a in enumerate(some) if a.first is not None or i % 2]
    assert fit(kept).bias == pytest.approx(found.bias, abs=0.3)
    with pytest.raises(ValueError, match="found and others"):
        fit([a for a in some if a.first is not None])


def test_no_answer_of_a_building_takes_part_in_the_fit_that_judges_it() -> None:
    """Here the queries of a in the map of b would teach a fit that nothing is ever right."""
    some = [replace(a, buildings=frozenset("ab"), first=None) for a in answers(450)]
    known = [a for a in answers(900) if a.buildings != frozenset("b")] + some
    models = left_out(known, fit)
    held_out = np.array([a.probability(p) for a, p in zip(known, models, strict=True)])
    for name in "ac":
        here = np.array([a.buildings == frozenset(name) for a in known])
        without = fit([a for a in known if name not in a.buildings])
        wanted = [a.probability(without) for a in known if a.buildings == frozenset(name)]
        assert held_out[here] == pytest.approx(wanted)
    only_c = fit([a for a in known if a.buildings == frozenset("c")])
    assert held_out[-1] == pytest.approx(some[-1].probability(only_c))


def test_the_log_loss_by_hand() -> None:
    right, wrong = (replace(answers(1)[0], first=first) for first in (0, None))
    assert log_loss([right, wrong], np.array([0.8, 0.1])) == pytest.approx(-np.log([0.8, 0.9]).mean())


def row(log: str, evidence: Evidence, error: list[float], **changes: Any) -> dict[str, Any]:
    """As `recorded_queries` writes it."""
    one = {"log": log, "map": log, "place": "in the map", "start": "0", "travel_m": 3.0}
    return one | {"evidence": [asdict(evidence)], "errors": [error]} | changes


def test_one_command_fits_and_judges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    good, poor = (
        replace(place(rng, lead), known_agreement=f, backward=f) for lead, f in ((0.2, 0.98), (0.01, 0.3))
    )
    rows = []
    for log in ("a", "fr079"):
        rows += [row(log, good, [0.1, 0.01]), row(log, poor, [7.0, 0.0])]
    rows += [
        row("a", poor, [float("inf"), 3.0], map="fr079", place="elsewhere"),
        row("a", poor, [9.0, 0.0], place="blanked"),
        row("a", poor, [0.2, 0.0], place="blanked"),  # beside its place: neither right nor wrong
        row("a", poor, [float("inf"), 3.0]),  # no true pose
    ]
    kinds = [k.kind for k in known_of(rows)]
    assert kinds.count("in its own building") == 4 and len(kinds) == 6

    def run(rows: list[dict[str, Any]]) -> str:
        (tmp_path / "rows.json").write_text(json.dumps(rows))
        posterior.main([tmp_path / "rows.json"])
        return capsys.readouterr().out

    # Without both buildings of "a in the map of fr079" nothing is left to fit to.
    with pytest.raises(SystemExit, match="without a and fr079 not both kinds"):
        run(rows)
    said = run([*rows, row("b", good, [0.1, 0.01]), row("b", poor, [7.0, 0.0])])
    assert "in use, in its own building: of 6 located 3 of 3 right ones, 0 wrong ones" in said
    assert "fitted without the building: log loss" in said and "EvidenceParameters(bias=" in said
