"""Baird's star learned by five representations with one update: predicted first, then measured.

The target policy's true values are all 0, and every representation can say so. The table converges: an update moves its
own pair alone. The linear features share weights, so correcting one state raises the state it bootstraps from; for γ
above (n + 9) / (2n + 5) the error grows for ever. What a network does depends on where its weights are, so its
prediction is local: made at the initial weights, for their neighbourhood.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from neuralq.checks import check_whole
from neuralq.exact import evaluate, policy_process, predict_expected_td, rmsve, td_operator
from neuralq.lab.expected import ExpectedBackup, QModule, expected_backup, expected_td_step, local_growth
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq_envs.counterexamples import Problem, star
from neuralq_envs.counterexamples.baird import SOLID

__all__ = ["CAP", "REPRESENTATIONS", "BairdPrediction", "BairdResult", "predict_baird", "run_baird"]

CAP = 1e10  # a run stops when a value exceeds this: it has diverged, and the next thing to come is an overflow
REPRESENTATIONS = ("table", "linear", "action-input", "separate", "action-output")
_BODY = MLP(hidden=(16,))

Start = tuple[QModule, ExpectedBackup]


@dataclass(frozen=True)
class BairdPrediction:
    """What is known about one representation before any update.

    Args:
        representation: one of `REPRESENTATIONS`.
        growth: factor per sweep by which the error will grow.
        scope: ``"global"`` or ``"local"``, as in `BairdResult`.
        verdict: ``"converges"`` or ``"diverges"`` if global, ``"shrinks"`` or ``"grows"`` if local.
    """

    representation: str
    growth: float
    scope: Literal["global", "local"]
    verdict: str


@dataclass(frozen=True, eq=False)
class BairdResult:
    """What was predicted for one representation, and what it did.

    Args:
        representation: one of `REPRESENTATIONS`.
        predicted_growth: factor per sweep by which the error should grow, known before training.
        prediction_scope: ``"global"`` where it holds from any start for ever (the update is linear), ``"local"`` where
            it holds only around the initial weights.
        verdict: of the prediction; ``"converges"`` or ``"diverges"`` if global, ``"shrinks"`` or ``"grows"`` if local.
        measured_growth: factor per sweep of the RMSVE, fitted over the last half of the run; if the very first sweep
            passes the cap, what that takes at least.
        steps: sweeps that were run; fewer than asked for when the cap was reached.
        stopped_on_cap: whether a value passed `CAP`. What is recorded lies below it.
        rmsve: √(Σ_s d(s) (V(s) − v_π(s))²) before each sweep and after the last, ``[steps + 1]``.
        rise: largest |Q| of the run over the largest at its start.
        values: V(s) at the end, ``[S]``.
        exact_values: v_π(s), ``[S]``.
    """

    representation: str
    predicted_growth: float
    prediction_scope: Literal["global", "local"]
    verdict: str
    measured_growth: float
    steps: int
    stopped_on_cap: bool
    rmsve: NDArray[np.float64]
    rise: float
    values: NDArray[np.float64]
    exact_values: NDArray[np.float64]


def run_baird(
    num_steps: int = 5000,
    gamma: float = 0.99,
    step_size: float = 0.01,
    num_upper: int = 6,
    seed: int = 0,
) -> list[BairdResult]:
    """The star learned by a table, by its linear features and by three network layouts, in this order.

    Args:
        num_steps: synchronous expected sweeps, at least 4.
        gamma: γ in [0, 1).
        step_size: α > 0.
        num_upper: upper states of the star.
        seed: of the networks' initial weights (each has one hidden layer of 16 rectified units).

    Raises:
        ValueError: an argument out of range.

    Source: Baird 1995; Sutton & Barto 2018, equation 11.9.

    Example:
        >>> table, linear, *networks = run_baird(num_steps=100)
        >>> table.verdict, linear.verdict, round(linear.predicted_growth, 7)
        ('converges', 'diverges', 1.0023925)
    """
    check_whole("num_steps", num_steps, minimum=4)
    problem = _problem(gamma, step_size, num_upper, seed)
    with threadpool_limits(limits=1):  # the matrices are tiny: a second thread only waits for the first
        return [_run(problem, name, num_steps, seed) for name in REPRESENTATIONS]


def predict_baird(
    gamma: float = 0.99, step_size: float = 0.01, num_upper: int = 6, seed: int = 0
) -> list[BairdPrediction]:
    """What `run_baird` will show, known before anything is trained. Arguments as there.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> predict_baird(gamma=0.85)[1].verdict  # below 15/17 the linear features converge as well
        'converges'
    """
    problem = _problem(gamma, step_size, num_upper, seed)
    with threadpool_limits(limits=1):
        return [_predict(problem, name, _start(problem, name, seed)) for name in REPRESENTATIONS]


def _problem(gamma: float, step_size: float, num_upper: int, seed: int) -> Problem:
    check_whole("seed", seed, minimum=0)
    if gamma == 1:
        raise ValueError("gamma must be below 1, got 1: the star never ends, so its values would not be defined")
    return replace(star(num_upper), gamma=gamma, step_size=step_size)


def _table(problem: Problem) -> Start:
    """Values start at 1, the direction in which a table is slowest, and a little off it for every other to show."""
    q = TableQ(problem.mdp.num_states, problem.mdp.num_actions)
    with torch.no_grad():
        q.weight.fill_(1.0)
        q.weight[:-1] += 1e-4
    return q, expected_backup(problem, torch.arange(problem.mdp.num_states))


def _linear(problem: Problem) -> Start:
    """The star's features and initial weights, for the target's action; the other starts at 0 and is never updated."""
    q = LinearQ(problem.features.shape[1], problem.mdp.num_actions)
    with torch.no_grad():
        q.weight[SOLID] = torch.tensor(problem.initial_weights)
    return q, expected_backup(problem, torch.tensor(problem.features))


def _network(problem: Problem, layout: Callable[..., QModule], seed: int) -> Start:
    """A network that sees the star's features."""
    rng = np.random.default_rng(seed)
    shape = (problem.features.shape[1],)
    q = layout(shape, problem.mdp.num_actions, body=_BODY, rng=rng, dtype=torch.float64)
    return q, expected_backup(problem, torch.tensor(problem.features))


def _start(problem: Problem, name: str, seed: int) -> Start:
    if name == "table":
        return _table(problem)
    if name == "linear":
        return _linear(problem)
    layouts = {"action-input": ActionInputQ, "separate": SeparateQ, "action-output": ActionOutputQ}
    return _network(problem, layouts[name], seed)


def _predict(problem: Problem, name: str, start: Start) -> BairdPrediction:
    if name in ("table", "linear"):
        features = np.eye(problem.mdp.num_states) if name == "table" else problem.features
        process = policy_process(problem.mdp, problem.target_policy)
        A, _ = td_operator(*process, features, problem.state_distribution, problem.gamma)
        answer = predict_expected_td(A, problem.step_size)
        verdict = "converges" if answer.converges else "diverges"
        return BairdPrediction(name, answer.spectral_radius, "global", verdict)
    growth = local_growth(*start, problem.step_size)
    return BairdPrediction(name, growth, "local", "grows" if growth > 1 else "shrinks")


def _run(problem: Problem, name: str, num_steps: int, seed: int) -> BairdResult:
    q, backup = start = _start(problem, name, seed)
    prediction = _predict(problem, name, start)
    exact_values = evaluate(problem.mdp, problem.target_policy, problem.gamma)
    errors: list[float] = []
    highest: list[float] = []
    values = np.zeros(problem.mdp.num_states)
    stopped = False
    for _ in range(num_steps + 1):  # each step hands back the values from before it, so one more shows the last
        before = expected_td_step(q, backup, problem.step_size)
        top = float(before.abs().max())
        stopped = not top <= CAP  # also where it is not a number
        if stopped:
            break
        values = backup.state_values(before).numpy()
        errors.append(rmsve(values, exact_values, problem.state_distribution))
        highest.append(top)
    return BairdResult(
        representation=name,
        predicted_growth=prediction.growth,
        prediction_scope=prediction.scope,
        verdict=prediction.verdict,
        measured_growth=_fitted_growth(errors, highest[0]),
        steps=len(errors) - 1,
        stopped_on_cap=stopped,
        rmsve=np.array(errors),
        rise=max(highest) / highest[0],
        values=values,
        exact_values=exact_values,
    )


def _fitted_growth(errors: list[float], highest: float) -> float:
    """The factor per sweep of a geometric curve through the last half, by least squares on the logarithm."""
    if len(errors) < 2:
        return CAP / highest
    tail = np.log(np.maximum(errors[min(len(errors) // 2, len(errors) - 2) :], np.finfo(np.float64).tiny))
    return float(np.exp(np.polyfit(np.arange(len(tail)), tail, 1)[0]))
