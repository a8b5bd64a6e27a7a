"""The doctor's statistics beside SciPy's and sums written out, and how its decision weighs findings at its edges."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import spearmanr

from neuralq.doctor import examination, tree
from neuralq.doctor.estimates import area_under_curve, bounds_of, held_out_r2, held_out_scores, rank_correlation
from neuralq.doctor.findings import Finding
from neuralq.doctor.tree import decide

RNG = np.random.default_rng(0)


def test_the_interval_of_a_mean_is_that_of_the_normal_law_for_many_episodes() -> None:
    x = RNG.standard_normal(2000) + 3
    low, high = bounds_of(np.column_stack([x, np.ones(2000)]), lambda s: s[:, 0] / s[:, 1], np.random.default_rng(1))
    half = 1.96 * x.std() / math.sqrt(2000)
    assert low == pytest.approx(x.mean() - half, abs=0.006) and high == pytest.approx(x.mean() + half, abs=0.006)


def test_ranks_are_correlated_as_scipy_does_it_and_areas_are_counted() -> None:
    x, y = RNG.integers(5, size=60), RNG.integers(5, size=60)  # with ties
    assert rank_correlation(x, y) == pytest.approx(spearmanr(x, y).statistic) and rank_correlation(x, 0 * y) == 0
    scores, positive = RNG.integers(6, size=40), np.arange(40) < 15
    pairs = [(a > b) + (a == b) / 2 for a in scores[positive] for b in scores[~positive]]
    assert area_under_curve(scores, positive) == pytest.approx(np.mean(pairs))


def test_what_was_not_fitted_is_predicted_and_noise_is_not() -> None:
    x, episode = RNG.standard_normal((600, 2)), np.repeat(np.arange(30), 20)
    y = np.column_stack([50 + 3 * x[:, 0], np.sin(2 * x[:, 1]), RNG.standard_normal(600), np.full(600, 7.0)])
    predicted = held_out_scores(x, y, episode, np.random.default_rng(2))
    assert np.abs(predicted[:, 0] - y[:, 0]).mean() < 0.1 and predicted[:, 3] == pytest.approx(y[:, 3])
    r2 = held_out_r2(x, y, episode, np.random.default_rng(2))
    assert r2[0] > 0.99 and r2[1] > 0.9 and -0.6 < r2[2] < 0.05 and r2[3] == 0


def test_a_whole_episode_is_held_out() -> None:
    """What is the same within an episode, and random between them, nobody can predict who has not seen the episode."""
    episode = np.repeat(np.arange(40), 10)
    x, y = RNG.standard_normal(40)[episode][:, None], RNG.standard_normal(40)[episode][:, None]
    assert held_out_r2(x, y, episode, np.random.default_rng(3))[0] < 0.1


def flagged(name: str, cause: Any = "algorithm", value: float = 1.0, grade: Any = "B") -> Finding:
    return Finding(name, name, cause, grade, value, flagged=True)


def calm(name: str) -> Finding:
    return Finding(name, name, "algorithm", "B", 0.0)


def test_findings_are_weighed_at_the_edges() -> None:
    as_good, _ = decide([flagged("V1"), calm("V7"), flagged("V2")])
    assert {one.id: one.grade for one in as_good} == {
        "V2": "B",
        "V1": "C",
    }  # chance is as good, too
    far, mistake = flagged("V4", value=5.0), flagged("V3")
    assert decide([far, mistake, calm("R1")])[0][0].id == "V4" and decide([far, mistake])[0][0].id == "V3"
    assert decide([flagged("V4", value=3.0), mistake, calm("R1")])[0][0].id == "V3"
    assert decide([flagged("E3", "environment"), flagged("V4", value=math.nan)])[0][0].id == "V4"
    assert decide([flagged("V1"), flagged("V6a"), flagged("V7")])[1].startswith("Cannot tell the cause")
    for name, value, grade in (("E5", 1e4, "C"), ("E5", 10000.5, "B"), ("E4", 100.0, "C"), ("E4", 100.5, "B")):
        found = {one.id: one.grade for one in decide([flagged(name, "environment", value, "C"), flagged("V2")])[0]}
        assert found[name] == grade
    assert decide([flagged("E6", "environment"), flagged("V2")])[1].endswith("conditional on that.")
    assert not decide([flagged("V5"), flagged("V2")])[1].endswith("conditional on that.")
    assert not decide([flagged("E6", "environment")])[1].endswith("conditional on that.")  # there is nothing else
    assert decide([calm("V1")])[1].startswith("Nothing was found") and decide([calm("R1")])[1].startswith("Cannot tell")


def test_every_id_has_its_place_in_the_order_of_causes() -> None:
    assert sorted(tree._ORDER) == sorted([*examination._MEASUREMENTS, "X1", "X2", "X3"])
