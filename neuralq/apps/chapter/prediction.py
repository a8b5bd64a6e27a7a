"""Section 13.5: the λ-return as a sum and as a recursion, and Sutton's random walk."""

from __future__ import annotations

import numpy as np
import torch

from neuralq.apps.chapter.ordering import part_of
from neuralq.exact import evaluate, solve
from neuralq.rules import lambda_returns
from neuralq.runs.report.claims import ChapterPage, Chart, Row, Series, claim, misprint, number, own, spread
from neuralq.tabular import Experience, RunOptions, batch_td, predict, td_lambda
from neuralq.types import Floats
from neuralq_envs import mitchell, random_walk

__all__ = ["lambda_recursion", "random_walk_page"]


_TRUTH = np.arange(1, 6) / 6
_START = np.full(7, 0.5)  # what Sutton begins with; the two ends are never read
_SEQUENCES = 10
_LAMBDAS = (0.0, 0.3, 0.7, 1.0)
_STEP_SIZES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)


def lambda_recursion() -> ChapterPage:
    """The recursion of Q^λ equals its sum with the value of s_{t+1} in the bracket, not with that of s_t as printed.

    Source: Mitchell 1997, section 13.5.

    Example:
        >>> lambda_recursion().reproduced
        True
    """
    gamma = mitchell.GAMMA
    # From the bottom left to G with one detour: north, east, west, east, east. Cells 3, 0, 1, 0, 1, then G.
    r, v_tm1 = np.array([0.0, 0.0, 0.0, 0.0, 100.0]), np.array([30.0, 60.0, 80.0, 60.0, 80.0])
    v_t = np.append(v_tm1[1:], 0.0)  # nothing follows G
    rows: list[Row] = []
    for lambda_ in (0.3, 0.7, 0.9):
        total = _sum_of_returns(r, v_t, gamma, lambda_)
        right, printed = _recursion(r, v_t, gamma, lambda_), _recursion(r, v_tm1, gamma, lambda_)
        rows.append(number(f"λ = {lambda_}: recursion with max Q̂(s_t+1, ·), against the sum", total, right))
        note = "the sum is what it should be; the printed index gives another number"
        rows.append(misprint(f"λ = {lambda_}: recursion with max Q̂(s_t, ·), as printed", printed, total, right, note))
        library = _library(r, v_t, gamma, lambda_)
        rows.append(number(f"λ = {lambda_}: neuralq.rules.lambda_returns", total, library))
    rows.append(number("λ = 0: one step, 0.9 · 60", 54.0, _recursion(r, v_t, gamma, 0.0)))
    rows.append(number("λ = 1: rewards only, 0.9⁴ · 100", 65.61, _recursion(r, v_t, gamma, 1.0)))
    rows += _best_and_detour(gamma)
    text = (
        "The estimate from n observed rewards, Q⁽ⁿ⁾, trusts the table after n moves. Q^λ averages them all, with "
        "weights (1 − λ) λⁿ⁻¹. The average can be computed backwards: each move's return is its reward plus γ times a "
        "mixture of the table's opinion about the next state and the next move's return.",
        "The book prints the state that was left inside the bracket. The one-step part of the sum uses the state that "
        "was reached, so the index must be t + 1: with it both ways agree to the last digit, with the printed one they "
        "do not.",
        "λ = 1 believes only what was observed. Along an optimal path that is exact, whatever the table says; after a "
        "detour it blames the first move for it. Watkins cuts the return at the exploring move, Peng does not.",
    )
    every = [i / 20 for i in range(21)]
    curves = (
        Series("the sum", every, [_sum_of_returns(r, v_t, gamma, x) for x in every]),
        Series("recursion, s_t+1", every, [_recursion(r, v_t, gamma, x) for x in every]),
        Series("recursion, s_t as printed", every, [_recursion(r, v_tm1, gamma, x) for x in every]),
    )
    charts = (Chart("Q^λ of the first move", "λ", "Q^λ", curves),)
    return ChapterPage("td-lambda", "Q^λ: the sum and the recursion", "13.5", text, tuple(rows), charts)


def _sum_of_returns(r: Floats, v_t: Floats, gamma: float, lambda_: float) -> float:
    """(1 − λ) Σ λⁿ⁻¹ Q⁽ⁿ⁾ over n up to the end, and the rest of the weight on the return that ends the episode."""
    num = len(r)
    n_step = [float(gamma ** np.arange(n) @ r[:n] + gamma**n * v_t[n - 1]) for n in range(1, num + 1)]
    return sum((1 - lambda_) * lambda_ ** (n - 1) * n_step[n - 1] for n in range(1, num)) + (
        lambda_ ** (num - 1) * n_step[-1]
    )


def _recursion(r: Floats, v: Floats, gamma: float, lambda_: float) -> float:
    """Backwards from the end: r + γ [(1 − λ) v + λ (the same one move later)]."""
    result = float(r[-1])
    for reward, value in zip(r[-2::-1], v[-2::-1], strict=True):
        result = float(reward) + gamma * ((1 - lambda_) * float(value) + lambda_ * result)
    return result


def _library(r: Floats, v_t: Floats, gamma: float, lambda_: float) -> float:
    discount, last = np.append(np.full(len(r) - 1, gamma), 0.0), np.arange(len(r)) == len(r) - 1
    r_t, discount_t, value_t = (torch.from_numpy(x) for x in (r, discount, v_t))
    return float(lambda_returns(r_t, discount_t, value_t, lambda_, torch.from_numpy(last))[0])


def _best_and_detour(gamma: float) -> list[Row]:
    """λ = 1 along the best path with a table of nonsense, and after a detour."""
    exact = float(solve(mitchell.mdp(), gamma).q[3, 0])
    nonsense = np.array([7.0, -3.0, 0.0])
    best = _recursion(np.array([0.0, 0.0, 100.0]), nonsense, gamma, 1.0)
    detour = _recursion(np.array([0.0, 0.0, 0.0, 0.0, 100.0]), np.zeros(5), gamma, 1.0)
    return [
        number("λ = 1 along an optimal path, any table: the true Q", exact, best),
        claim("λ = 1 after a detour", f"less than {exact:g}", detour, detour < exact, "Peng's return, uncut"),
    ]


def random_walk_page(num_sets: int = 100) -> ChapterPage:
    """Sutton's random walk: TD(λ) with λ < 1 predicts better than waiting for the end, from the same ten walks.

    Args:
        num_sets: training sets of ten walks; all λ see the same ones.

    Source: Sutton 1988, figures 3 to 5; Mitchell 1997, section 13.5.

    Example:
        >>> random_walk_page(num_sets=3).rows[0].verdict
        'agrees'
    """
    mdp = random_walk.mdp()
    exact = evaluate(mdp, np.zeros(mdp.num_states, dtype=np.int64), random_walk.GAMMA)
    rows = [number(f"V({mdp.state_names[s]})", s / 6, float(exact[s]), note=f"{s}/6") for s in range(1, 6)]  # type: ignore[index]
    sets = _training_sets(num_sets)
    many_rows, many_chart = _repeated_presentations(sets)
    once_rows, once_chart = _one_presentation(sets)
    rows += [*many_rows, *once_rows]
    text = (
        "Five states in a row; each step goes left or right with equal chances; falling off the right end pays 1, off "
        "the left end 0. The value of a state is its chance to end on the right: 1/6, 2/6, … 5/6.",
        "Waiting for the outcome (λ = 1) fits what was seen in ten walks best, and predicts worst: it ignores that "
        "walks which meet in a state have the same future. λ = 0 learns from the next prediction and so combines the "
        "walks. Shown ten walks just once, a little of both is best.",
    )
    return ChapterPage("random-walk", "Predicting a random walk", "13.5", text, tuple(rows), (many_chart, once_chart))


def _repeated_presentations(sets: list[Experience]) -> tuple[list[Row], Chart]:
    """Each set presented until no value moves."""
    fits = [[batch_td(_START, one, lambda_=x, step_size=0.02, tol=1e-4) for one in sets] for x in _LAMBDAS]
    errors = np.array([[_rms(v) for v, _ in fit] for fit in fits])
    settled = all(converged for fit in fits for _, converged in fit)
    means = errors.mean(axis=1)
    rows = [own(f"repeated presentations, λ = {x:g}: error", spread(e)) for x, e in zip(_LAMBDAS, errors, strict=True)]
    rising = settled and bool((np.diff(means) > -0.001).all() and means[3] > 1.1 * means[2])
    rows.append(claim("repeated presentations: mean error over λ", "rises, worst at 1", _arrow(means), rising))
    curve = Series("until nothing moves", _LAMBDAS, means)
    return rows, Chart("mean error after repeated presentations", "λ", "RMS error", (curve,))


def _one_presentation(sets: list[Experience]) -> tuple[list[Row], Chart]:
    """Each set shown once, with several step sizes."""
    once = np.array([[_mean_rms_once(sets, x, alpha) for alpha in _STEP_SIZES] for x in _LAMBDAS])
    best = once.min(axis=1)
    ratio = float(best[3] / best[1])
    rows = [
        claim("one presentation, best α: λ = 0, then 0.3", "no worse", _arrow(best[:2]), best[1] <= best[0] + 0.003),
        claim("one presentation, best α: λ = 1 against λ = 0.3", "1.7× or worse", ratio, ratio >= 1.7),
    ]
    series = (Series(f"λ = {x:g}", _STEP_SIZES, e) for x, e in zip(_LAMBDAS, once, strict=True))
    return rows, Chart("mean error after one presentation", "α", "RMS error", tuple(series))


def _training_sets(num_sets: int) -> list[Experience]:
    """Walks cut into sets of ten."""
    options = RunOptions(record_experience=True)
    # A walk takes 9 steps on average; half as many again is enough for any number of sets.
    run = td_lambda(random_walk.mdp(), 140 * num_sets + 500, random_walk.GAMMA, seed=1988, options=options)
    e = run.experience
    assert e is not None
    ends = [0, *(np.flatnonzero(e.last_t)[_SEQUENCES - 1 :: _SEQUENCES] + 1).tolist()]
    return [part_of(e, slice(ends[i], ends[i + 1])) for i in range(num_sets)]


def _rms(v: Floats) -> float:
    return float(np.sqrt(np.mean((v[1:6] - _TRUTH) ** 2)))


def _mean_rms_once(sets: list[Experience], lambda_: float, alpha: float) -> float:
    """Each walk shown once, values changed at its end."""
    found = [_rms(predict(_START, one, lambda_=lambda_, update="episode", step_size=alpha).v) for one in sets]
    return float(np.mean(found))


def _arrow(values: Floats) -> str:
    return " → ".join(f"{value:.4f}" for value in values)
