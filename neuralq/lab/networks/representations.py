"""One problem learned by several representations with one update: predicted, then measured, beside the exact answer.

The update is the expected semi-gradient sweep of `neuralq.lab.networks.expected`. A table and the problem's own linear
features make it linear, so that the prediction is global: it holds from any start for ever. In control the greedy
policy changes on the way, and what a network does depends on where its weights are: there the prediction is local, made
at the initial weights, for their neighbourhood. Of a network two things are told: whether its errors grow while the
tangent kernel stays as it is, and whether runs from nearby weights separate (curvature included; while errors are large
they often do, also where learning goes well). Only where both say the same is it a verdict.

Table and linear features learn what the problem is about, state values or values of pairs. The network layouts differ
in how they treat actions, so they always learn the values of pairs; where the problem is about state values, a pair
counts as often as the target policy takes it, and V(s) = Σ_a π(a|s) Q(s, a).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor, nn

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.exact import action_values, evaluate, predict_expected_td, rmsve, solve
from neuralq.lab.linear.process import check_values
from neuralq.lab.networks.expected import ExpectedBackup, QModule, expected_backup, expected_td_step, local_growth
from neuralq.lab.networks.tangent_kernel import local_system, local_verdict, observations_of, reduced_operator
from neuralq.lab.plain import fields_of
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, SeparateQ, TableQ
from neuralq.types import Floats
from neuralq_envs.counterexamples import Problem

__all__ = [
    "CAP",
    "REPRESENTATIONS",
    "PairLinearQ",
    "RepresentationPrediction",
    "RepresentationResult",
    "predict_representations",
    "run_representations",
]

CAP = 1e10  # a run stops when a value exceeds this: it has diverged, and the next thing to come is an overflow
REPRESENTATIONS = ("table", "linear", "action-input", "separate", "action-output")
_LAYOUTS: dict[str, Callable[..., QModule]] = {
    "action-input": ActionInputQ,
    "separate": SeparateQ,
    "action-output": ActionOutputQ,
}
_BODY = MLP(hidden=(16,))

Start = tuple[QModule, ExpectedBackup]


class PairLinearQ(nn.Module):
    """Linear in features of pairs: Q(s, a) = φ(s, a)·w with one weight vector; the observation is φ(s, ·), ``[A, d]``.

    Args:
        num_features: d.
        num_actions: A.

    Example:
        >>> q = PairLinearQ(num_features=3, num_actions=2)
        >>> q.all(torch.ones(5, 2, 3)).shape
        torch.Size([5, 2])
    """

    def __init__(self, num_features: int, num_actions: int) -> None:
        super().__init__()
        self.num_actions = num_actions
        self.weight = nn.Parameter(torch.zeros(num_features, dtype=torch.float64))

    def forward(self, s: Tensor) -> Tensor:
        """`all`, so that ``q(s)`` is what modules are called for."""
        return self.all(s)

    def all(self, s: Tensor) -> Tensor:
        """Action values of every action: ``[*n, A, d] -> [*n, A]``."""
        return s.to(self.weight.dtype) @ self.weight

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        """Action values of the given actions: ``([*n, A, d], [*n] int64) -> [*n]``."""
        return self.all(s).gather(-1, a[..., None])[..., 0]


@dataclass(frozen=True)
class RepresentationPrediction:
    """What is known about one representation before any update.

    Args:
        representation: one of `REPRESENTATIONS`.
        growth: factor per sweep by which the error will grow; for a network, by which a small change of its weights
            will, curvature included.
        scope: ``"global"`` or ``"local"``, as in `RepresentationResult`.
        verdict: ``"converges"``, ``"diverges"`` or ``"neutral"`` if global; if local ``"shrinks"`` or ``"grows"`` where
            both factors say so, else ``"unclear"``.
        kernel_growth: factor per sweep by which errors will grow while the tangent kernel stays as it is; the same as
            ``growth`` where values are linear in the weights.
    """

    representation: str
    growth: float
    scope: Literal["global", "local"]
    verdict: str
    kernel_growth: float


@dataclass(frozen=True, eq=False)
class RepresentationResult:
    """What was predicted for one representation, and what it did.

    Args:
        representation: one of `REPRESENTATIONS`.
        predicted_growth: factor per sweep by which the error should grow, known before training.
        prediction_scope: ``"global"`` where it holds from any start for ever (the update is linear), ``"local"`` where
            it holds only around the initial weights.
        verdict: of the prediction, as in `RepresentationPrediction`.
        measured_growth: factor per sweep of the RMSVE, fitted over the last half of the run; if the very first sweep
            passes the cap, what that takes at least.
        steps: sweeps that were run; fewer than asked for when the cap was reached.
        stopped_on_cap: whether a value passed `CAP`. What is recorded lies below it.
        rmsve: √(Σ_s d(s) (V(s) − v(s))²) before each sweep and after the last, ``[steps + 1]``; for a problem about Q
            √(Σ_{s,a} d(s) μ(a|s) (Q(s, a) − q(s, a))²).
        rise: largest |Q| of the run over the largest at its start.
        values: V(s) at the end, ``[S]``.
        exact_values: v_π(s), in control v*(s), ``[S]``.
        kernel_growth: of the prediction.
    """

    representation: str
    predicted_growth: float
    prediction_scope: Literal["global", "local"]
    verdict: str
    measured_growth: float
    steps: int
    stopped_on_cap: bool
    rmsve: Floats
    rise: float
    values: Floats
    exact_values: Floats
    kernel_growth: float

    def plain(self) -> dict[str, Any]:
        """Prediction and measurement, as JSON takes them."""
        names = ("representation", "predicted_growth", "prediction_scope", "verdict", "measured_growth")
        return fields_of(self, *names, "stopped_on_cap")


def run_representations(
    problem: Problem,
    num_steps: int = 5000,
    step_size: float | None = None,
    seed: int = 0,
    representations: Sequence[str] = REPRESENTATIONS,
    *,
    observations: Literal["features", "states"] = "features",
    body: MLP = _BODY,
) -> list[RepresentationResult]:
    """A problem learned by each representation with the same expected update, beside the exact answer.

    Args:
        problem: about state values or about values of pairs.
        num_steps: synchronous expected sweeps, at least 4.
        step_size: α > 0; default: the problem's.
        seed: of the networks' initial weights.
        representations: which, in the order wanted. The table starts at values of 1, linear features at the problem's
            initial weights.
        observations: what networks see of a state: the problem's features, or which state it is, one-hot.
        body: of the networks.

    Raises:
        ValueError: an argument out of range, or ``"linear"`` for a problem whose value function is not.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> table, linear = run_representations(star(), 100, representations=("table", "linear"))
        >>> table.verdict, linear.verdict, round(linear.predicted_growth, 7)
        ('converges', 'diverges', 1.0023925)
    """
    check_whole("num_steps", num_steps, minimum=4)
    alpha = _checked(problem, step_size, seed, representations)
    exact = _exact(problem)
    results = []
    with threadpool_limits(limits=1):  # the matrices are tiny: a second thread only waits for the first
        for name in representations:
            start = _start(problem, name, seed, observations, body)
            results.append(_run(exact, _predict(problem, name, start, alpha), start, num_steps, alpha))
    return results


def predict_representations(
    problem: Problem,
    step_size: float | None = None,
    seed: int = 0,
    representations: Sequence[str] = REPRESENTATIONS,
    *,
    observations: Literal["features", "states"] = "features",
    body: MLP = _BODY,
) -> list[RepresentationPrediction]:
    """What `run_representations` will show, known before anything is trained. Arguments as there.

    Raises:
        ValueError: an argument out of range.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> [one.scope for one in predict_representations(star(), representations=("linear", "separate"))]
        ['global', 'local']
    """
    alpha = _checked(problem, step_size, seed, representations)
    with threadpool_limits(limits=1):
        return [
            _predict(problem, name, _start(problem, name, seed, observations, body), alpha) for name in representations
        ]


def _checked(problem: Problem, step_size: float | None, seed: int, representations: Sequence[str]) -> float:
    check_whole("seed", seed, minimum=0)
    for name in representations:
        check_choice("representations", name, REPRESENTATIONS)
    alpha = problem.step_size if step_size is None else step_size
    check_positive("step_size", alpha)
    check_values(problem)
    if problem.value is not None and "linear" in representations:
        raise ValueError(
            f"the value function of {problem.name!r} is not linear in its parameters; leave 'linear' out of "
            "representations"
        )
    return alpha


def _start(problem: Problem, name: str, seed: int, observations: Literal["features", "states"], body: MLP) -> Start:
    if name == "table":
        return _table(problem)
    if name == "linear":
        return _linear(problem)
    seen = observations_of(problem, observations)
    rng = np.random.default_rng(seed)
    shape, num_actions = (seen.shape[1],), problem.mdp.num_actions
    q = _LAYOUTS[name](shape, num_actions, body=body, rng=rng, dtype=torch.float64)
    return q, expected_backup(problem, seen)


def _table(problem: Problem) -> Start:
    """Values start at 1, the direction in which a table is slowest, and a little off it for every other to show."""
    states = not problem.learns_q
    q = TableQ(problem.mdp.num_states, 1 if states else problem.mdp.num_actions)
    with torch.no_grad():
        q.weight.fill_(1.0)
        q.weight[:-1] += 1e-4
    return q, expected_backup(problem, torch.arange(problem.mdp.num_states), state_values=states)


def _linear(problem: Problem) -> Start:
    """The problem's features and initial weights."""
    weights = torch.tensor(problem.initial_weights)
    q = PairLinearQ(problem.num_weights, problem.mdp.num_actions) if problem.learns_q else LinearQ(len(weights), 1)
    with torch.no_grad():
        q.weight.copy_(weights.expand_as(q.weight))
    return q, expected_backup(problem, torch.tensor(problem.features), state_values=not problem.learns_q)


def _predict(problem: Problem, name: str, start: Start, step_size: float) -> RepresentationPrediction:
    kernel = predict_expected_td(reduced_operator(local_system(*start)), step_size).spectral_radius
    if name in _LAYOUTS:
        growth = local_growth(*start, step_size)
        return RepresentationPrediction(name, growth, "local", local_verdict(kernel, growth), kernel)
    if problem.control or problem.exploration is not None:
        return RepresentationPrediction(name, kernel, "local", local_verdict(kernel), kernel)
    verdict = {"grows": "diverges", "shrinks": "converges"}.get(local_verdict(kernel), "neutral")
    return RepresentationPrediction(name, kernel, "global", verdict, kernel)


@dataclass(frozen=True, eq=False)
class _Exact:
    """What should be learned: of states ``[S]``, and of pairs where the problem is about those, with error weights."""

    of_states: Floats
    of_pairs: Floats | None
    weights: Floats

    def error(self, values: Floats, q: Floats) -> float:
        if self.of_pairs is None:
            return rmsve(values, self.of_states, self.weights)
        return rmsve(q, self.of_pairs, self.weights)


def _exact(problem: Problem) -> _Exact:
    if not problem.learns_q:
        return _Exact(evaluate(problem.mdp, problem.target_policy, problem.gamma), None, problem.state_distribution)
    if problem.control or problem.exploration is not None:
        answer = solve(problem.mdp, problem.gamma)
        of_states, of_pairs = answer.v, answer.q
    else:
        of_states = evaluate(problem.mdp, problem.target_policy, problem.gamma)
        of_pairs = action_values(problem.mdp, of_states, problem.gamma)
    legal = problem.mdp.legal
    weights = np.where(legal, problem.state_distribution[:, None] * problem.behaviour_policy, 0.0)
    return _Exact(of_states, np.where(legal, of_pairs, 0.0), weights)


def _run(
    exact: _Exact, prediction: RepresentationPrediction, start: Start, num_steps: int, step_size: float
) -> RepresentationResult:
    q, backup = start
    errors: list[float] = []
    highest: list[float] = []
    values = np.zeros(len(backup.weights))
    stopped = False
    for _ in range(num_steps + 1):  # each step hands back the values from before it, so one more shows the last
        before = expected_td_step(q, backup, step_size)
        top = float(before[backup.legal].abs().max())
        stopped = not top <= CAP  # also where it is not a number
        if stopped:
            break
        values = backup.state_values(before).numpy()
        errors.append(exact.error(values, before.numpy()))
        highest.append(top)
    return RepresentationResult(
        representation=prediction.representation,
        predicted_growth=prediction.growth,
        prediction_scope=prediction.scope,
        verdict=prediction.verdict,
        measured_growth=_fitted_growth(errors, highest),
        steps=max(len(errors) - 1, 0),
        stopped_on_cap=stopped,
        rmsve=np.array(errors),
        rise=max(highest, default=1.0) / (highest[0] if highest and highest[0] > 0 else 1.0),
        values=values,
        exact_values=exact.of_states,
        kernel_growth=prediction.kernel_growth,
    )


def _fitted_growth(errors: list[float], highest: list[float]) -> float:
    """The factor per sweep of a geometric curve through the last half, by least squares on the logarithm."""
    if len(errors) < 2:
        return CAP / (highest[0] if highest and highest[0] > 0 else 1.0)
    tail = np.log(np.maximum(errors[min(len(errors) // 2, len(errors) - 2) :], np.finfo(np.float64).tiny))
    return float(np.exp(np.polyfit(np.arange(len(tail)), tail, 1)[0]))
