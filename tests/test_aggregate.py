"""Interquartile mean and bootstrap intervals, held to hand arithmetic, to SciPy and to every resample there is.

Mutants that must die here: one score too many or too few dropped at an end · a quarter rounded up · runs resampled
across tasks · drawn without replacement · an interval of the mean instead of the interquartile mean · tails of 95 %
on each side · points of a curve resampled each by themselves · an interval for a single run.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neuralq.runs.sweep.statistics import bootstrap_interval, estimate, interquartile_mean


@pytest.mark.parametrize(
    ("scores", "by_hand"),
    [
        ([7.0], 7.0),
        ([1.0, 5.0, 9.0], 5.0),  # ⌊3/4⌋ = 0 dropped: the plain mean
        ([8.0, 0.0, 1.0, 3.0], 2.0),  # (1 + 3) / 2
        ([0.0, 10.0, 2.0, 3.0, 7.0], 4.0),  # (2 + 3 + 7) / 3
        ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 1000.0], 4.5),  # (3 + 4 + 5 + 6) / 4
        (list(range(10)), 4.5),  # two dropped at each end: mean of 2 … 7
        ([0, 0, 0, 5, 6, 10, 50, 90, 100, 100], 26.833333333333332),  # (0 + 5 + 6 + 10 + 50 + 90) / 6
    ],
)
def test_by_hand(scores: list[float], by_hand: float) -> None:
    assert interquartile_mean(scores) == pytest.approx(by_hand, rel=1e-15)
    assert estimate(scores).iqm == pytest.approx(by_hand, rel=1e-15)


@given(arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(1, 13)), elements=st.floats(-1e6, 1e6)))
def test_equals_scipys_trimmed_mean_along_either_axis(scores: np.ndarray) -> None:
    for axis in (0, 1):
        ours = interquartile_mean(scores, axis=axis)
        np.testing.assert_allclose(ours, scipy.stats.trim_mean(scores, 0.25, axis=axis), rtol=1e-12, atol=1e-9)


def test_no_scores_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one score"):
        interquartile_mean([])
    with pytest.raises(ValueError, match="at least one score"):
        bootstrap_interval([], np.random.default_rng(0))
    with pytest.raises(ValueError, match="confidence"):
        bootstrap_interval([1.0, 2.0], np.random.default_rng(0), confidence=95.0)


def test_the_interval_is_that_of_every_possible_resample() -> None:
    # 4 runs: 4⁴ = 256 equally likely resamples, whose quantiles are known exactly.
    scores = np.array([0.0, 1.0, 10.0, 40.0])
    every = np.sort([scipy.stats.trim_mean(draw, 0.25) for draw in itertools.product(scores, repeat=4)])
    low, high = bootstrap_interval(scores, np.random.default_rng(1), confidence=0.8, num_resamples=40_000)
    assert low == pytest.approx(np.quantile(every, 0.1, method="inverted_cdf"))
    assert high == pytest.approx(np.quantile(every, 0.9, method="inverted_cdf"))
    mean = np.sort([np.mean(draw) for draw in itertools.product(scores, repeat=4)])
    assert high != pytest.approx(np.quantile(mean, 0.9))


def test_runs_are_drawn_within_their_task() -> None:
    # Two tasks of very different scale and no spread within: any resample within tasks is the sample itself.
    scores = np.array([[1.0, 100.0]] * 6)
    low, high = bootstrap_interval(scores, np.random.default_rng(0), num_resamples=500)
    assert low == high == interquartile_mean(scores.reshape(-1)) == 50.5


def test_tasks_are_drawn_independently_of_each_other() -> None:
    # One run of each task scores 1, in the same row. Pairing the tasks would double the spread of the sum.
    scores = np.zeros((2, 2))
    scores[0] = 1.0
    # Independent draws of 4 cells, IQM the mean of the middle two: P(IQM = 1) = P(≥ 3 ones) = 5/16.
    _, high = bootstrap_interval(scores, np.random.default_rng(0), confidence=1 - 2 * 0.30, num_resamples=40_000)
    _, below = bootstrap_interval(scores, np.random.default_rng(0), confidence=1 - 2 * 0.33, num_resamples=40_000)
    assert (high, below) == (1.0, 0.5)


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(4)
    runs = rng.standard_normal((300, 20))  # the IQM of a symmetric law is its centre, 0
    low, high = bootstrap_interval(runs[:, :, None], np.random.default_rng(5), num_resamples=400)
    covered = np.mean((low <= 0) & (0 <= high))
    # The percentile bootstrap of 20 runs covers a little less than it says (Efron 1987); s.e. of the share is 0.014.
    assert 0.86 < covered < 0.98


def test_points_of_a_curve_are_resampled_by_whole_runs() -> None:
    # The second point repeats the first and a third is its negative: the intervals must say so exactly.
    runs = np.random.default_rng(0).standard_normal(9)
    curve = np.stack([runs, runs, -runs])[:, :, None]
    low, high = bootstrap_interval(curve, np.random.default_rng(1), num_resamples=999)
    assert low.shape == (3,)
    assert low[0] == low[1] == pytest.approx(-high[2]) and high[0] == high[1] == pytest.approx(-low[2])


def test_many_resamples_are_drawn_in_pieces_of_the_same_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = np.random.default_rng(0).standard_normal(8)
    whole = bootstrap_interval(runs, np.random.default_rng(1), num_resamples=2_000)
    monkeypatch.setattr("neuralq.runs.sweep.statistics._MOST_DRAWN", 8 * 333)
    pieces = bootstrap_interval(runs, np.random.default_rng(1), num_resamples=2_000)
    np.testing.assert_array_equal(pieces, whole)


def test_an_estimate_repeats_and_one_run_has_no_interval() -> None:
    scores = [3.0, 1.0, 4.0, 1.0, 5.0]
    first = estimate(scores)
    assert first == estimate(scores) and first.num_runs == 5
    assert first.low is not None and first.high is not None and first.low < first.iqm < first.high
    alone = estimate([3.0])
    assert (alone.iqm, alone.low, alone.high, alone.num_runs) == (3.0, None, None, 1)
