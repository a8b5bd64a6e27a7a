"""The first actor-critic: an associative search element (ASE) that acts, an adaptive critic element (ACE) that judges.

Two actions, a state among S. The ASE takes action 1 if w(s) plus normal noise is at least 0, else action 0. Then, with
y = ±1 the action and the reward r_t with which s_t was reached,

* e ← δ e, and e(s_tm1) grows by (1 − δ) y; x̄ ← λ x̄, and x̄(s_tm1) grows by 1 − λ;
* r̂ = r_t + discount_t p(s_t) − p(s_tm1), the internal reinforcement;
* w ← w + α r̂ e, p ← p + β r̂ x̄; where the stream ends, e and x̄ become 0.

With β = 0 the critic stays silent, r̂ is r_t, and what is left is the ASE alone. The critic is TD(λ) with its trace
scaled by 1 − λ; that δ and λ decay traces without the discount is the original's way.

Source: Barto, Sutton & Anderson 1983, equations 1 to 4; the order of the updates is that of their published program.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.random_numbers import uniform

__all__ = ["AseAce", "AseAceRates", "ase_ace_action", "ase_ace_update", "new_ase_ace"]

_SMALLEST = 1e-100  # a trace below this is dropped: arithmetic with subnormal numbers takes twenty times as long


class AseAce(NamedTuple):
    """What both elements have learned and remember, each ``[S]``.

    Args:
        weights: w of the ASE: above 0 it takes action 1.
        eligibility: e, its trace.
        predictions: p of the ACE, the value of each state.
        traces: x̄, its trace.
    """

    weights: NDArray[np.float64]
    eligibility: NDArray[np.float64]
    predictions: NDArray[np.float64]
    traces: NDArray[np.float64]


class AseAceRates(NamedTuple):
    """The constants of Barto, Sutton & Anderson 1983.

    Args:
        alpha: α, the step size of the ASE.
        beta: β, the step size of the ACE; 0 turns it off.
        eligibility_decay: δ in [0, 1).
        trace_decay: λ in [0, 1).
        noise: standard deviation of what is added before an action is chosen; 0 for none.
    """

    alpha: float = 1000.0
    beta: float = 0.5
    eligibility_decay: float = 0.9
    trace_decay: float = 0.8
    noise: float = 0.01


def new_ase_ace(num_states: int) -> AseAce:
    """Two elements that know nothing.

    Example:
        >>> new_ase_ace(3).weights.tolist()
        [0.0, 0.0, 0.0]
    """
    return AseAce(*(np.zeros(num_states) for _ in AseAce._fields))


@lean_kernel
def ase_ace_action(elements: AseAce, rates: AseAceRates, s: int, rng: NDArray[np.uint64]) -> Any:
    """The action in state ``s``: 1 with the probability that normal noise does not pull w(s) below 0.

    Args:
        elements: what was learned.
        rates: constants.
        s: state.
        rng: a stream of `neuralq.tabular.kernels.random_numbers`; one number is drawn where there is noise.

    Example:
        >>> from neuralq.tabular.kernels.random_numbers import new_stream
        >>> elements = new_ase_ace(2)
        >>> elements.weights[:] = [-1.0, 1.0]
        >>> [ase_ace_action(elements, AseAceRates(), s, new_stream(0)) for s in (0, 1)]
        [0, 1]
    """
    w = elements.weights[s]
    if rates.noise > 0.0:
        return 1 if uniform(rng) < 0.5 * math.erfc(-w / (rates.noise * math.sqrt(2.0))) else 0
    return 1 if w >= 0.0 else 0


@lean_kernel
def ase_ace_update(
    elements: AseAce,
    rates: AseAceRates,
    s_tm1: int,
    a_tm1: int,
    r_t: float,
    discount_t: float,
    s_t: int,
    last_t: bool,
) -> Any:
    """Changes ``elements`` by one transition and returns the internal reinforcement r̂.

    Args:
        elements: changed in place.
        rates: constants.
        s_tm1: state that was left.
        a_tm1: 0 or 1.
        r_t: reward.
        discount_t: γ, or 0 where the world terminated.
        s_t: state that was reached; not looked at where ``discount_t`` is 0.
        last_t: whether the stream breaks here.

    Example:
        Action 1 ends with a reward of −1: r̂ = −1, so w(0) = 1000 · −1 · .1, p(0) = .5 · −1 · .2.

        >>> elements = new_ase_ace(2)
        >>> ase_ace_update(elements, AseAceRates(), 0, 1, -1.0, 0.0, 0, True)
        -1.0
        >>> elements.weights.round(9).tolist(), elements.predictions.round(9).tolist()
        ([-100.0, 0.0], [-0.1, 0.0])
    """
    w, e, p, x_bar = elements
    y = 1.0 if a_tm1 == 1 else -1.0
    internal = r_t - p[s_tm1]
    if discount_t != 0.0:
        internal = r_t + discount_t * p[s_t] - p[s_tm1]
    for i in range(len(w)):
        e[i] *= rates.eligibility_decay
        x_bar[i] *= rates.trace_decay
    e[s_tm1] += (1.0 - rates.eligibility_decay) * y
    x_bar[s_tm1] += 1.0 - rates.trace_decay
    smallest = np.inf if last_t else _SMALLEST
    for i in range(len(w)):
        w[i] += rates.alpha * internal * e[i]
        p[i] += rates.beta * internal * x_bar[i]
        e[i] = e[i] if abs(e[i]) > smallest else 0.0
        x_bar[i] = x_bar[i] if x_bar[i] > smallest else 0.0
    return internal
