"""Trial after trial on the pole, learned by ASE/ACE, in one compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.ase_ace import AseAce, AseAceRates, ase_ace_action, ase_ace_update
from neuralq_envs.pole_kernels import box_of, has_fallen, pole_step

__all__ = ["balance"]


@lean_kernel
def balance(
    elements: AseAce,
    rates: AseAceRates,
    gamma: float,
    cart_friction: float,
    pole_friction: float,
    rng: NDArray[np.uint64],
    long_trial_steps: int,
    lengths: NDArray[np.int64],
    filmed: NDArray[np.int64],
    film: NDArray[np.float64],
) -> int:
    """Trials from upright and at rest, until one lasts ``long_trial_steps``; returns the failures before it.

    Args:
        elements: what is learned; changed in place.
        rates: constants of the learner.
        gamma: γ.
        cart_friction: μ_c.
        pole_friction: μ_p.
        rng: a stream; advanced.
        long_trial_steps: steps that count as balanced.
        lengths: steps of each trial, ``[most failures]``; written, 0 where there was no trial.
        filmed: which trials to film, ``[K]``.
        film: their states, ``[K, F, 4]``; written as far as a trial or F reaches.

    Example:
        >>> from neuralq.tabular.kernels.ase_ace import new_ase_ace
        >>> from neuralq.tabular.kernels.random_numbers import new_stream
        >>> lengths = np.zeros(3, np.int64)
        >>> balance(new_ase_ace(162), AseAceRates(), 0.95, 0.0, 0.0, new_stream(0), 1000, lengths,
        ...         np.zeros(0, np.int64), np.zeros((0, 0, 4)))
        3
        >>> bool((lengths > 5).all())
        True
    """
    for trial in range(len(lengths)):
        row = -1
        for k in range(len(filmed)):
            if filmed[k] == trial:
                row = k
        x, x_dot, theta, theta_dot = 0.0, 0.0, 0.0, 0.0
        s = box_of(x, x_dot, theta, theta_dot)
        steps = 0
        fallen = False
        while steps < long_trial_steps and not fallen:
            if row >= 0 and steps < film.shape[1]:
                film[row, steps, 0], film[row, steps, 1] = x, x_dot
                film[row, steps, 2], film[row, steps, 3] = theta, theta_dot
            a = ase_ace_action(elements, rates, s, rng)
            x, x_dot, theta, theta_dot = pole_step(x, x_dot, theta, theta_dot, a, cart_friction, pole_friction)
            steps += 1
            fallen = has_fallen(x, theta)
            s_t = box_of(x, x_dot, theta, theta_dot)
            reward, discount = (-1.0, 0.0) if fallen else (0.0, gamma)
            ase_ace_update(elements, rates, s, a, reward, discount, s_t, fallen)
            s = s_t
        lengths[trial] = steps
        if not fallen:
            return trial
    return len(lengths)
