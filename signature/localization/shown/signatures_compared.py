"""Why the best place, and why not the next one: their signatures on top of the query's, for the page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from signature.retrieval.explanation import compare_views

if TYPE_CHECKING:
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer
    from signature.retrieval.explanation import ComparedView


def why_here(answer: Answer, database: SubmapDatabase) -> dict[str, Any] | None:
    """The signatures of the query's views at the best place and at its best rival, elsewhere or in another
    map; None without a hypothesis or a view.

    views : where they lie in the query's frame. told_apart : the number of the view whose likelihoods differ
    most between the two, of those that stand on free floor at both. places : of each, the number of its
    hypothesis and for each view `log_ratio`, and [query, map] of each of the three signatures of
    `DrawnSignatures`.
    """
    if not answer.hypotheses or not answer.views_m:
        return None
    rival = next((k for k, place in enumerate(answer.places) if place != answer.places[0]), None)
    sight_m = database.config().partition.radius_m
    compared = []
    for number in (0,) if rival is None else (0, rival):
        hypothesis = answer.hypotheses[number]
        grid = database.grid(answer.sessions[hypothesis.session_index])
        views = compare_views(answer.local_map, answer.views_m, grid, hypothesis.fit.T_map_query, sight_m)
        compared.append((number, views))
    ratios = np.array([[view.log_ratio for view in views] for _, views in compared], np.float64)
    apart = ratios[0] - ratios[-1] if len(ratios) > 1 else ratios[0]
    return {
        "sight_m": sight_m,
        "views": [[round(v, 2) for v in at_m] for at_m in answer.views_m],
        "told_apart": int(np.argmax(np.where(np.isnan(apart), -np.inf, apart))),
        "places": [
            {
                "hypothesis": number,
                "views": [_document(view) for view in views],
            }
            for number, views in compared
        ],
    }


def _document(view: ComparedView) -> dict[str, Any]:
    names = ("boundary", "freespace", "symmetry")
    drawn = {name: [_short(getattr(side, name)) for side in (view.query, view.map)] for name in names}
    return {"log_ratio": None if view.log_ratio is None else round(view.log_ratio, 2)} | drawn


def _short(values: np.ndarray) -> list[float]:
    """Shares, to three digits behind the point."""
    return [round(v, 3) for v in values.tolist()]
