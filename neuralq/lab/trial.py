"""A method trained on a problem over many seeds, with the errors of its weights along the way, never an overflow.

Two errors are recorded. With v the exact values of the target policy and Π the projection on the features in the norm
of D,

    RMSVE  = √Σ_i D_i (x_i·w − v_i)²,      RMSPBE = ‖Π(T Xw − Xw)‖_D = √((b − Aw)ᵀ C⁺ (b − Aw))

(Sutton & Barto 2018, sections 9.2 and 11.7). A seed whose weights pass the cap has diverged: it stops there, and its
errors are reported as the cap from then on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import Sampling, stream
from neuralq.lab.methods import Expected, Method
from neuralq.lab.methods import method as method_named
from neuralq.lab.methods.operators import covariance, td
from neuralq.lab.methods.record import Options, Piece
from neuralq.lab.plain import fields_of, plain
from neuralq.types import Floats, Indices
from neuralq_envs.counterexamples import Problem

__all__ = ["CAP", "Trial", "affine_power", "check_coverage", "run"]


CAP = 1e10
"""A seed has diverged when an entry of its weights is larger than this times the largest initial one (at least 1)."""

_CHECK_EVERY = 8  # updates between looks for seeds that passed the cap: float64 holds many more
_MOST_RECORDS = 200


@dataclass(frozen=True, eq=False)
class Trial:
    """What a method did on a problem.

    Args:
        problem: its name.
        method: its name.
        options: of the method.
        sampling: ``"expected"``, ``"iid"`` or ``"markov"``.
        step_size: α.
        steps: updates after which errors were recorded, first 0, ``[R]``.
        rmsve: value error of every seed, ``[R, N]``; ``cap`` from where a seed diverged.
        rmspbe: projected Bellman error likewise, ``[R, N]``.
        weights: w of every seed at the end, or the last that was below the cap, ``[N, d]``.
        stopped_at: update at which a seed had passed the cap, -1 where it never did, ``[N]``.
        cap: largest entry of the weights that is not called divergence.
        path: w of the first seed at the recorded updates, ``[R, d]``; it stays where it was before it passed the cap.
    """

    problem: str
    method: str
    options: Options
    sampling: Sampling
    step_size: float
    steps: Indices
    rmsve: Floats
    rmspbe: Floats
    weights: Floats
    stopped_at: Indices
    cap: float
    path: Floats

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Which seeds passed the cap, ``[N]``."""
        return self.stopped_at >= 0

    @cached_property
    def growth(self) -> float:
        """Factor per update of the median RMSVE over the last half of what was recorded below the cap.

        Near 1 where it has settled; 0 where the error vanished altogether.
        """
        alive = (self.rmsve < self.cap).mean(axis=1) > 0.5
        curve, steps = np.median(self.rmsve[alive], axis=1), self.steps[alive]
        if len(curve) < 2:  # it left at once: what that takes at least
            return float((self.cap / max(curve[0], 1.0)) ** (1 / max(int(self.steps[1]), 1)))
        half = steps >= min(steps[-1] / 2, steps[-2])
        tail = curve[half]
        if not tail.all():
            return 0.0
        return float(np.exp(np.polyfit(steps[half], np.log(tail), 1)[0]))

    def quantiles(self, probabilities: ArrayLike = (0.1, 0.5, 0.9), *, of: str = "rmsve") -> Floats:
        """Quantiles over seeds at each recorded update, ``[R, len(probabilities)]``.

        Args:
            probabilities: in [0, 1].
            of: ``"rmsve"`` or ``"rmspbe"``.
        """
        check_choice("of", of, ("rmsve", "rmspbe"))
        table: Floats = np.quantile(getattr(self, of), np.asarray(probabilities, dtype=np.float64), axis=1).T
        return table

    def plain(self) -> dict[str, Any]:
        """The settings, quantiles of both errors and the first seed's last weights, as JSON takes them."""
        return {
            **fields_of(self, "problem", "method", "options", "sampling", "step_size", "growth", "steps"),
            "num_steps": int(self.steps[-1]),
            "num_seeds": len(self.stopped_at),
            "num_diverged": int(self.diverged.sum()),
            "rmsve": plain(self.quantiles()),
            "rmspbe": plain(self.quantiles(of="rmspbe")),
            "weights": plain(self.weights[:1]),
        }


def run(
    problem: Problem,
    method: str = "td",
    num_steps: int = 1000,
    step_size: float | None = None,
    sampling: Sampling = "expected",
    num_seeds: int = 1,
    seed: int = 0,
    options: Options | None = None,
) -> Trial:
    """A method trained on a problem.

    Args:
        problem: what to learn.
        method: one of `neuralq.lab.methods.METHODS`.
        num_steps: updates.
        step_size: α; the problem's own by default.
        sampling: ``"expected"`` (one deterministic run, every row updated at once with its weight), ``"iid"`` (rows
            drawn from D) or ``"markov"`` (chains that follow the behaviour policy).
        num_seeds: independent runs; 1 for ``"expected"``.
        seed: of all of them.
        options: of the method, by name, such as ``{"lambda_": 0.9}``.

    Raises:
        ValueError: an argument out of range, an unknown method or option, or a method that has no such update.

    Example:
        >>> from neuralq_envs.counterexamples import star
        >>> sweeps = run(star(), "td", num_steps=1000)
        >>> round(float(sweeps.rmsve[-1, 0]), 3)  # Sutton & Barto 2018, figure 11.2
        581.355
    """
    check_whole("num_steps", num_steps)
    check_whole("num_seeds", num_seeds)
    check_whole("seed", seed, 0)
    check_choice("sampling", sampling, ("expected", "iid", "markov"))
    alpha = problem.step_size if step_size is None else step_size
    check_positive("step_size", alpha)
    chosen = method_named(method)
    given = chosen.checked(options or {})
    process = linear_process(problem)
    with threadpool_limits(limits=1), np.errstate(over="ignore", invalid="ignore"):
        if sampling == "expected":
            if num_seeds != 1:
                raise ValueError(
                    f"the expected update is the same for every seed: num_seeds must be 1, got {num_seeds}"
                )
            return _expected_run(problem, process, chosen, given, num_steps, alpha)
        rng = np.random.default_rng(seed)
        return _sampled_run(problem, process, chosen, given, num_steps, alpha, sampling, num_seeds, rng)


def check_coverage(problem: Problem, chosen: Method) -> None:
    """The behaviour policy tries every action that the importance ratios of a method need.

    Methods for pairs that look at all actions of the next state need no ratio for it.

    Raises:
        ValueError: an action that the target takes and the behaviour never does.
    """
    mdp = problem.mdp
    missing = np.argwhere((problem.behaviour_policy == 0) & (problem.target_policy > 0) & mdp.legal)
    if chosen.rows == "any" and missing.size:
        s, a = missing[0]
        raise ValueError(
            f"{chosen.title} weighs actions by importance ratios, but the behaviour policy never takes action {a} in "
            f"{mdp.state_name(s)}, which the target policy takes; use a method for pairs, such as expected-sarsa or gq"
        )


def affine_power(piece: Piece, k: int) -> Piece:
    """So many applications of θ ← M θ + c as one, by repeated squaring.

    Example:
        >>> M, c = affine_power((np.array([[0.5]]), np.array([1.0])), 3)
        >>> M.tolist(), c.tolist()
        ([[0.125]], [1.75])
    """
    M, c = piece
    total = (np.eye(len(c)), np.zeros(len(c)))
    while k:
        if k & 1:
            total = (M @ total[0], M @ total[1] + c)
        M, c = M @ M, M @ c + c
        k >>= 1
    return total


class _Errors:
    """RMSVE and RMSPBE of weights ``[N, d]``."""

    def __init__(self, process: Process) -> None:
        self._X, self._v = process.X, process.v
        self._root_d = np.sqrt(process.D)
        self._A, self._b = td(process)
        values, vectors = np.linalg.eigh(covariance(process))
        kept = values > 1e-12 * max(values.max(initial=0.0), 1e-300)
        self._whiten = vectors[:, kept] / np.sqrt(values[kept])

    def __call__(self, w: Floats) -> tuple[Floats, Floats]:
        off = (w @ self._X.T - self._v) * self._root_d
        residual = (self._b - w @ self._A.T) @ self._whiten
        return np.sqrt(np.einsum("nk,nk->n", off, off)), np.sqrt(np.einsum("nk,nk->n", residual, residual))


class _Record:
    """Errors at the recorded updates, seeds that have left at the cap."""

    def __init__(self, process: Process, w: Floats) -> None:
        self.cap = CAP * max(1.0, float(np.abs(w).max()))
        self._errors = _Errors(process)
        self.steps: list[int] = []
        self.rmsve: list[Floats] = []
        self.rmspbe: list[Floats] = []
        self.path: list[Floats] = []
        self.stopped_at = np.full(len(w), -1, dtype=np.int64)
        self.weights = w.copy()
        self.add(0, w)

    def leave(self, step: int, theta: Floats) -> None:
        """Seeds beyond the cap stop: their θ is set to 0 and not looked at again."""
        gone = ~(np.abs(theta).max(axis=1) <= self.cap)
        self.stopped_at[gone & (self.stopped_at < 0)] = step
        theta[self.stopped_at >= 0] = 0.0

    def add(self, step: int, w: Floats) -> None:
        alive = self.stopped_at < 0
        self.weights[alive] = w[alive]
        self.path.append(self.weights[0].copy())
        self.steps.append(step)
        for rows, error in zip((self.rmsve, self.rmspbe), self._errors(w), strict=True):
            rows.append(np.where(alive, np.minimum(error, self.cap), self.cap))

    def finish(self, problem: Problem, chosen: Method, options: Options, sampling: Sampling, alpha: float) -> Trial:
        return Trial(
            problem.name, chosen.name, options, sampling, alpha, np.array(self.steps, dtype=np.int64),
            np.array(self.rmsve), np.array(self.rmspbe), self.weights, self.stopped_at, self.cap,
            np.array(self.path),
        )  # fmt: skip


def _record_steps(num_steps: int) -> list[int]:
    """Every update of a short run; evenly spread ones, with the first few, of a long one."""
    if num_steps <= _MOST_RECORDS:
        return list(range(1, num_steps + 1))
    spread = np.linspace(0, num_steps, _MOST_RECORDS + 1)[1:].round().astype(int)
    return sorted({1, 2, 5, 10, 20, 50, 100, *spread.tolist()})


def _expected_run(
    problem: Problem, process: Process, chosen: Method, options: Options, num_steps: int, alpha: float
) -> Trial:
    if chosen.expected is None:
        raise ValueError(f"{chosen.title} has no expected update; use sampling='iid' or 'markov'")
    expected = chosen.expected(process, options)
    d, period = process.num_weights, expected.updates_per_sweep
    theta = expected.initial(np.array(problem.initial_weights))
    record = _Record(process, theta[None, :d])
    before, ahead = 0, _record_steps(max(num_steps // period, 1))[::-1]
    while ahead:
        sweep = ahead.pop()
        moved = _sweeps(expected, theta, alpha, sweep - before, record.cap)
        if not np.abs(moved).max() <= record.cap and sweep - before > 1:
            ahead += [sweep, (sweep + before) // 2]  # it left in between: look closer
            continue
        theta, before = moved, sweep
        moving = theta[None, :].copy()
        record.leave(sweep * period, moving)
        record.add(sweep * period, moving[:, :d])
        if record.stopped_at[0] >= 0:
            break
    return record.finish(problem, chosen, options, "expected", alpha)


def _sweeps(expected: Expected, theta: Floats, alpha: float, count: int, cap: float) -> Floats:
    """``count`` expected updates; a linear map is applied as its power."""
    if expected.linear:
        M, c = affine_power(expected.at(theta, alpha), count)
        total: Floats = M @ theta + c
        return total
    for _ in range(count):
        M, c = expected.at(theta, alpha)
        theta = M @ theta + c
        if not np.abs(theta).max() <= cap:
            break
    return theta


def _sampled_run(
    problem: Problem, process: Process, chosen: Method, options: Options, num_steps: int, alpha: float,
    sampling: Sampling, num_seeds: int, rng: np.random.Generator,
) -> Trial:  # fmt: skip
    assert sampling != "expected"
    if chosen.learner is None:
        raise ValueError(f"{chosen.title} has no update from single transitions; use sampling='expected'")
    check_coverage(problem, chosen)
    w0 = np.tile(problem.initial_weights, (num_seeds, 1))
    learner = chosen.learner(process, w0, options)
    record = _Record(process, learner.theta[:, : process.num_weights])
    marks = set(_record_steps(num_steps))
    for step, sample in enumerate(stream(process, sampling, num_seeds, rng), start=1):
        learner.update(sample, alpha)
        if step % _CHECK_EVERY == 0 or step in marks:
            record.leave(step, learner.theta)
        over = step == num_steps or bool((record.stopped_at >= 0).all())
        if over or step in marks:
            record.add(step, learner.theta[:, : process.num_weights])
        if over:
            break
    return record.finish(problem, chosen, options, sampling, alpha)
