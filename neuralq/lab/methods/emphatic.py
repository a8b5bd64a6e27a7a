"""Emphatic TD: updates weighted so that the expected one is stable on any behaviour.

Off-policy TD fails because states are updated as often as the behaviour visits them, not as often as the target would
reach them from there. The follow-on F counts the latter, from interest i (here 1 everywhere):

    F_t = ρ_{t−1} β F_{t−1} + i,  F_0 = i                  f = (I − βPᵀ)⁻¹ (d · i),     f(s) = d(s) E[F_t | s_t = s]
    M_t = λ i + (1 − λ) F_t                                m = λ (d · i) + (1 − λ) f
    e_t = ρ_t (γλ e_{t−1} + M_t x_t),   w += α δ_t e_t     A = Xᵀ diag(m) (I − γλP)⁻¹ (I − γP) X

With β = γ this is ETD(λ), m = (I − P_λᵀ)⁻¹ (d · i), and A is positive semi-definite: its mean is stable wherever d is
the behaviour's own distribution. Its price is variance: E[F²] grows by the radius of β² Σ_a μρ²P per step, and a radius
of 1 or more means that F has no variance. A smaller β buys a finite one with some of the stability: ETD(λ, β).
A run that begins at F_0 = i does not start at f but walks there, f_{k+1} = d · i + βPᵀ f_k.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import eigs

from neuralq.checks import check_fraction
from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.methods.chains import solve_chain
from neuralq.lab.methods.operators import ahead, traced_flow
from neuralq.lab.methods.record import LAMBDA, Expected, Method, Option, Options
from neuralq.lab.methods.trace import Trace, errors
from neuralq.types import Floats

__all__ = ["ETD", "decay_of", "emphasis", "expected_emphatic_run", "follow_on", "follow_on_second_moment"]

AS_GAMMA = -1.0
"""The value of option ``beta`` that stands for γ, whichever γ the problem has."""


def follow_on(process: Process, beta: float | None = None, num_steps: int | None = None) -> Floats:
    """The expected follow-on of every row, f(s) = d(s) E[F | s] with f = (I − βPᵀ)⁻¹ d, ``[n]``.

    Args:
        process: the problem; its D is taken for the behaviour's own distribution.
        beta: decay of the follow-on in [0, 1]; None for γ.
        num_steps: steps since a start with F_0 = 1 (then f_0 = d and f_{k+1} = d + βPᵀ f_k); None for the limit.

    Raises:
        ValueError: β out of range.

    Source: Sutton, Mahmood & White 2016, section 5; with β Hallak, Tamar, Munos & Mannor 2016.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> follow_on(linear_process(star())).round(6).tolist()[-2:]
        [0.142857, 99.142857]
    """
    decay = process.gamma if beta is None else beta
    check_fraction("beta", decay)
    if num_steps is None:
        return solve_chain(process.P, decay, process.D, transposed=True)
    f = process.D.copy()
    for _ in range(num_steps):
        f = process.D + decay * (process.P.T @ f)
    return f


def emphasis(process: Process, lambda_: float = 0.0, beta: float | None = None) -> Floats:
    """The expected emphasis of every row, m = λ d + (1 − λ) f, ``[n]``.

    Args:
        process: the problem.
        lambda_: λ in [0, 1].
        beta: decay of the follow-on in [0, 1]; None for γ, where m = (I − P_λᵀ)⁻¹ d.

    Raises:
        ValueError: λ or β out of range.

    Source: Sutton, Mahmood & White 2016, equations 17 to 20.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> emphasis(linear_process(star()), lambda_=1.0).round(6).tolist()[-1]  # λ = 1 weighs nothing
        0.142857
    """
    check_fraction("lambda_", lambda_)
    m: Floats = lambda_ * process.D + (1 - lambda_) * follow_on(process, beta)
    return m


def follow_on_second_moment(process: Process, beta: float | None = None) -> float:
    """The factor by which E[F²] grows per step: the spectral radius of β² Σ_a μ(a|s) ρ(s, a)² P(s'|s, a).

    At 1 or above the follow-on has no variance, and sampled runs are unusable even though their mean converges.

    Args:
        process: the problem.
        beta: decay of the follow-on in [0, 1]; None for γ.

    Raises:
        ValueError: β out of range.

    Source: Hallak, Tamar, Munos & Mannor 2016; Sutton & Barto 2018, section 11.9.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> round(follow_on_second_moment(linear_process(star())), 4)  # 7 γ²
        6.8607
    """
    decay = process.gamma if beta is None else beta
    check_fraction("beta", decay)
    ways = process.transitions
    chain = ways.matrix(ways.probability * ways.rho**2)
    if isinstance(chain, np.ndarray):
        radius = np.abs(np.linalg.eigvals(chain)).max()
    else:
        radius = np.abs(eigs(chain, k=1, return_eigenvectors=False, v0=np.ones(process.num_rows))).max()
    return float(decay**2 * radius)


def expected_emphatic_run(process: Process, w0: Floats, step_size: float, num_sweeps: int) -> Floats:
    """Weights before each expected sweep of ETD(0) and after the last, the emphasis starting with the run.

    Sweep k uses the exact conditional expectation of the emphasis k steps after the start, d(s) E[F_k | s_k = s], in
    which the first F is the interest alone: w += α Xᵀ diag(f_k) (r + γPXw − Xw), f_0 = d, f_{k+1} = d + γPᵀ f_k.

    Args:
        process: the problem.
        w0: ``[d]``.
        step_size: α.
        num_sweeps: how many.

    Source: Sutton & Barto 2018, section 11.8 and figure 11.6.

    Example:
        >>> from neuralq.lab.linear.process import linear_process
        >>> from neuralq_envs.counterexamples import star
        >>> run = expected_emphatic_run(linear_process(star()), star().initial_weights, 0.03, 200)
        >>> run.shape, bool(np.abs(star().features @ run[-1]).max() < 0.1)
        ((201, 8), True)
    """
    X, w, f = process.X, w0.copy(), process.D.copy()
    path = [w0.copy()]
    for _ in range(num_sweeps):
        error = process.r + process.gamma * (process.P @ (X @ w)) - X @ w
        w = w + step_size * (X.T @ (f * error))
        f = process.D + process.gamma * (process.P.T @ f)
        path.append(w)
    return np.array(path)


class _ETD:
    def __init__(self, process: Process, w0: Floats, options: Options) -> None:
        self.theta = w0.copy()
        self._lambda, beta = options["lambda_"], decay_of(options)
        self._beta = process.gamma if beta is None else beta
        self._trace = Trace(w0.shape, self._lambda)
        self._follow_on = np.zeros(len(w0))
        self._decay = np.zeros(len(w0))  # ρ_{t−1} β into the present row

    def update(self, sample: SampledTransition, step_size: float) -> None:
        self._follow_on = ~sample.begins * self._decay * self._follow_on + 1.0
        emphasis = self._lambda + (1 - self._lambda) * self._follow_on
        e = self._trace.advance(sample, sample.rho, x=emphasis[:, None] * sample.x)
        self.theta += step_size * errors(self.theta, sample)[:, None] * e
        self._decay = sample.rho * self._beta * (sample.next_row >= 0)


def _expected_etd(process: Process, options: Options) -> Expected:
    lambda_ = options["lambda_"]
    m = emphasis(process, lambda_, decay_of(options))
    return traced_flow(process, m, process.P, process.gamma * lambda_, ahead(process), process.r)


def decay_of(options: Options) -> float | None:
    """β of the options; None where it stands for γ."""
    return None if options["beta"] == AS_GAMMA else options["beta"]


ETD = Method(
    "etd", "ETD(λ, β)", "Sutton, Mahmood & White 2016; with β Hallak, Tamar, Munos & Mannor 2016",
    {"lambda_": LAMBDA,
     "beta": Option(AS_GAMMA, 0.0, 1.0, "β, decay of the follow-on", special=AS_GAMMA, special_label="γ")},
    _expected_etd, _ETD, remembers=lambda options: options["lambda_"] > 0 or options["beta"] != 0,
    note="beta = -1 stands for γ, which is ETD(λ); its mean is stable, but the follow-on may have no variance",
    memory_growth=lambda process, options: follow_on_second_moment(process, decay_of(options)), place=40,
)  # fmt: skip
