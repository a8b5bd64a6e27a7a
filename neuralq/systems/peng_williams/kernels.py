"""Trial after trial on the pole, learned by the library's Q(λ), in one compiled loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neuralq.jit import lean_kernel
from neuralq.tabular.kernels.acting import Log, Table, Walk, choose
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq.tabular.kernels.traces import Traces, run_traces
from neuralq.tabular.model import ModelArrays
from neuralq.tabular.policies import ActingCode, StepCode
from neuralq_envs.pole_kernels import box_of, has_fallen, pole_step

__all__ = ["balance"]


@lean_kernel
def balance(
    model: ModelArrays,
    policy: ActingCode,
    table: Table,
    walk: Walk,
    log: Log,
    step_size: StepCode,
    traces: Traces,
    rule: int,
    replacing: bool,
    lambda_: float,
    gamma: float,
    start_spread: float,
    long_trial_steps: int,
    lengths: NDArray[np.int64],
    filmed: NDArray[np.int64],
    film: NDArray[np.float64],
) -> int:
    """Trials until one lasts ``long_trial_steps``; returns the failures before it.

    Each step is handed to `run_traces` as a recorded transition, so what is learned is the library's Q(λ) and no copy
    of it.

    Args:
        model: nothing (`neuralq.tabular.model.empty_arrays`).
        policy: how to act.
        table: what is learned; changed in place.
        walk: its stream draws starts and actions.
        log: room for one transition that is replayed.
        step_size: α.
        traces: no trace at first.
        rule: index of Q(λ)'s rule.
        replacing: a visit sets the trace to 1 instead of adding 1.
        lambda_: λ.
        gamma: γ.
        start_spread: each number of a first state is uniform between − and + this.
        long_trial_steps: steps that count as balanced.
        lengths: steps of each trial, ``[most failures]``; written, 0 where there was no trial.
        filmed: which trials to film, ``[K]``.
        film: their states, ``[K, F, 4]``; written as far as a trial or F reaches.
    """
    for trial in range(len(lengths)):
        row = -1
        for k in range(len(filmed)):
            if filmed[k] == trial:
                row = k
        x = start_spread * (2.0 * uniform(walk.rng) - 1.0)
        x_dot = start_spread * (2.0 * uniform(walk.rng) - 1.0)
        theta = start_spread * (2.0 * uniform(walk.rng) - 1.0)
        theta_dot = start_spread * (2.0 * uniform(walk.rng) - 1.0)
        s = box_of(x, x_dot, theta, theta_dot)
        steps = 0
        fallen = False
        while steps < long_trial_steps and not fallen:
            if row >= 0 and steps < film.shape[1]:
                film[row, steps, 0], film[row, steps, 1] = x, x_dot
                film[row, steps, 2], film[row, steps, 3] = theta, theta_dot
            a = int(choose(table, np.uint64(s), walk.counters[0], policy, walk.rng))
            x, x_dot, theta, theta_dot = pole_step(x, x_dot, theta, theta_dot, a, 0.0, 0.0)
            steps += 1
            fallen = has_fallen(x, theta)
            s_t = box_of(x, x_dot, theta, theta_dot)
            log.s_tm1[0], log.a_tm1[0], log.s_t[0], log.last_t[0] = s, a, s_t, fallen
            log.r_t[0], log.discount_t[0] = (-1.0, 0.0) if fallen else (0.0, gamma)
            run_traces(model, policy, table, walk, log, step_size, traces, rule, replacing, lambda_, gamma, 1)
            s = s_t
        lengths[trial] = steps
        if not fallen:
            return trial
    return len(lengths)
