"""What solvers say they did, beside slow methods that follow the text of the fast ones, and what little they may do.

Mutants that die here: iterations or backups that begin or step wrongly; rows left out too early, or for ever; patience
and shares of other sizes; a unit of rewards that decides when rows come back.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.exact import Solution, policies, solve, sweeping
from neuralq.exact.policies import policy_values
from neuralq.exact.problem import prepare
from neuralq.mdp import FiniteMDP

Floats = NDArray[np.float64]
EPS = 2.0**-52


class Slow:
    """A random model in which every row goes on with γ and has two successors, as dense arrays."""

    def __init__(self, seed: int, gamma: float, num_states: int = 20, num_actions: int = 4) -> None:
        self.mdp = FiniteMDP.garnet(num_states, num_actions, 2, seed=seed)
        self.gamma, self.n, self.rows = gamma, num_states, num_states * num_actions
        self._p = self.mdp.transition.toarray()

    def values(self, v: Floats) -> Floats:
        return (self.mdp.reward + self.gamma * self._p @ v).reshape(self.n, -1)

    def rounding(self, size: float) -> float:
        return (2 + 4) * EPS * (float(np.abs(self.mdp.reward).max()) + size)

    def is_close(self, change: Floats, v: Floats, tol: float) -> bool:
        error = self.gamma / (1 - self.gamma) * np.ptp(change) / 2  # half of what MacQueen's bounds leave
        return bool(error + self.rounding(np.abs(v).max()) / (1 - self.gamma) <= tol)


def counts(answer: Solution, slow: Slow) -> tuple[int, int]:
    """Without the last look ahead, which proves the answer."""
    return answer.iterations, answer.backups - slow.rows


def value_iteration(slow: Slow, tol: float) -> tuple[int, int]:
    """Rows that are far below the best are left out until the values have moved apart by as much."""
    v, kept = np.zeros(slow.n), np.ones((slow.n, slow.rows // slow.n), dtype=bool)
    rounding = 2 * slow.rounding(float(np.abs(slow.mdp.reward).max()) / (1 - slow.gamma))
    slack, budget, before, sweeps, backups = np.inf, np.inf, np.inf, 0, 0
    while True:
        values = np.where(kept, slow.values(v), -np.inf)
        before_each = np.maximum.accumulate(np.column_stack([np.full(slow.n, -np.inf), values[:, :-1]]), axis=1)
        with np.errstate(invalid="ignore"):
            beaten = int(np.sum(kept & (values < before_each - (slack + rounding))))
        change = values.max(axis=1) - v
        v, sweeps, backups = v + change, sweeps + 1, backups + int(kept.sum())
        if slow.is_close(change, v, tol):
            return sweeps, backups
        drift = slow.gamma * (max(change.max(), 0.0) - min(change.min(), 0.0))
        if change.min() > 0 or change.max() < 0:
            drift = slow.gamma * np.ptp(change)
        budget -= drift
        rate = min(drift / before, slow.gamma)
        slack = 1.5 * drift * rate / (1 - rate) if before < np.inf else np.inf
        before = drift
        if budget < 0:
            kept[:], budget = True, np.inf
        elif beaten > 0.2 * kept.sum():
            values = np.where(kept, slow.values(v), -np.inf)
            kept = values >= values.max(axis=1, keepdims=True) - (slack + rounding)
            budget, backups = min(budget, slack), backups + beaten


@pytest.mark.parametrize("gamma", [0.9, 0.99])
def test_value_iteration_leaves_out_the_rows_that_its_text_says(gamma: float) -> None:
    for seed in range(12):  # in most of these rows come back
        slow = Slow(seed, gamma)
        assert counts(solve(slow.mdp, gamma, "value-iteration", 1e-8), slow) == value_iteration(slow, 1e-8), seed


def test_rows_come_back_in_any_unit_of_rewards() -> None:
    for seed in (0, 3, 6):
        mdp = FiniteMDP.garnet(20, 4, 2, seed=seed)
        found = []
        for unit in (2.0**-20, 1.0, 2.0**20):
            answer = solve(dataclasses.replace(mdp, reward=mdp.reward * unit), 0.99, "value-iteration", 1e-8 * unit)
            found.append((answer.iterations, answer.backups, answer.converged))
        assert found == found[:1] * 3 and found[0][2]


@pytest.mark.parametrize("gamma", [0.8, 0.99])
def test_sweeps_in_place_are_counted_and_proven(gamma: float) -> None:
    for seed in range(5 if gamma < 0.9 else 1):
        slow, v, sweeps, checks, tol = Slow(seed, gamma), np.zeros(20), 0, 0, 1e-8
        while True:
            before, order = v.copy(), range(20) if sweeps % 2 == 0 else range(19, -1, -1)
            for s in order:
                v[s] = slow.values(v)[s].max()
            sweeps += 1
            allowance = slow.rounding(np.abs(v).max()) / (1 - gamma)
            if gamma / (1 - gamma) * np.abs(v - before).max() + allowance <= tol:
                checks += 1
                change = slow.values(v).max(axis=1) - v
                up = gamma / (1 - gamma) * max(change.max(), -change.min())
                if up + allowance <= tol:
                    break
        assert counts(solve(slow.mdp, gamma, "gauss-seidel", tol), slow) == (sweeps, (sweeps + checks) * slow.rows)


@pytest.mark.parametrize("gamma", [0.8, 0.95])
def test_sweeps_of_a_policy_are_counted(gamma: float) -> None:
    for seed in range(6):
        slow, tol = Slow(seed, gamma), 1e-8
        v, policy, improvements, sweeps = np.zeros(20), np.zeros(20, dtype=int), 0, 0
        while True:
            values = slow.values(v)
            policy = np.where(values.max(axis=1) > values[np.arange(20), policy], values.argmax(axis=1), policy)
            change = values.max(axis=1) - v
            v, improvements = values.max(axis=1), improvements + 1
            if slow.is_close(change, v, tol):
                break
            for _ in range(200):
                better = slow.values(v)[np.arange(20), policy]
                span, v, sweeps = np.ptp(better - v), better, sweeps + 1
                if span <= 0.001 * np.ptp(change):
                    break
        expected = improvements, improvements * slow.rows + 20 * sweeps
        assert counts(solve(slow.mdp, gamma, "modified-policy-iteration", tol), slow) == expected


def test_the_error_of_a_factored_evaluation_grows_with_the_steps_that_it_looks_ahead() -> None:
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[1.0], [0.0]])
    for gamma in (0.5, 0.999):
        problem = prepare(mdp, gamma)
        v, error, sweeps = policy_values(problem, np.arange(2), np.zeros(2))
        assert v == pytest.approx([1 / (1 - gamma**2), gamma / (1 - gamma**2)]) and sweeps == 0
        assert error == pytest.approx(2 / (1 - gamma) * problem.rounding(v))


def test_a_span_that_falls_no_more_is_waited_for_twenty_times() -> None:
    problem = prepare(FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[1.0], [0.0]]), 1 - 1e-6)

    def patience(progress: sweeping._Progress) -> int:
        progress.stalls(1.0)
        return next(n for n in range(2, 10**6) if progress.stalls(1.0))

    assert patience(sweeping._Progress(problem, span=True)) == 22  # the first is a low; 20 may be none; then one more
    assert patience(sweeping._Progress(problem, span=False)) == 100_002
    constant, v = sweeping._Constant(problem, 1e-300), np.zeros(2)
    assert not any(constant.settles(v, 1.0, 1.0 + 2**-20, last=False) for _ in range(21))
    assert not constant.settles(v, 1.0, 1.0 + 2**-20, last=False)  # it stalls: the constant is taken out
    assert v[0] > 1e5 and constant._progress._patience == 20
    more = next(n for n in range(1, 1000) if constant.settles(v, 1.0, 1.0 + 2**-20, last=False))
    assert more == 4 * 22  # it is taken out four times, and then no more


def test_an_evaluation_by_sweeps_looks_at_its_policy_again_after_two_hundred() -> None:
    # 0 → 1 → 0 with γ near 1: the span of the change shrinks by γ a sweep, never by a thousand in two hundred.
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [1.0, 0.0]]], [[1.0], [0.0]])
    answer = solve(mdp, 0.9999, "modified-policy-iteration", max_iterations=3)
    assert (answer.iterations, answer.backups) == (3, 3 * 2 + 2 * 200 * 2 + 2)


def test_policies_are_counted_whether_factored_or_swept(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(6):
        slow = Slow(seed, 0.9)
        p, reward = slow.mdp.transition.toarray().reshape(20, 4, 20), slow.mdp.reward.reshape(20, 4)
        policy, evaluations = reward.argmax(axis=1), 0
        while True:
            chain = p[np.arange(20), policy]
            values = slow.values(np.linalg.solve(np.eye(20) - 0.9 * chain, reward[np.arange(20), policy]))
            evaluations += 1
            if np.all(values.max(axis=1) <= values[np.arange(20), policy] + 1e-9):
                break
            policy = np.where(values.max(axis=1) > values[np.arange(20), policy] + 1e-9, values.argmax(axis=1), policy)
        factored = solve(slow.mdp, 0.9, "policy-iteration")
        assert counts(factored, slow) == (evaluations, evaluations * slow.rows) and factored.converged
        with monkeypatch.context() as patched:
            patched.setattr(policies, "_MOST_FACTORED", 19)
            swept = solve(slow.mdp, 0.9, "policy-iteration")
        iterations, backups = counts(swept, slow)
        assert iterations == evaluations and np.abs(swept.v - factored.v).max() <= swept.bound + factored.bound
        # Of 20 states each sweep backs up one row; the first policy takes about log(ε)/log(γ) of them.
        assert (backups - evaluations * slow.rows) % 20 == 0 and backups - evaluations * slow.rows > 20 * 300


def test_a_linear_program_counts_the_sweeps_that_evaluate_its_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow(0, 0.9)
    assert counts(solve(slow.mdp, 0.9, "linear-programming"), slow)[1] == 0  # factored
    monkeypatch.setattr(policies, "_MOST_FACTORED", 19)
    backups = counts(solve(slow.mdp, 0.9, "linear-programming"), slow)[1]
    assert backups >= 20 and backups % 20 == 0


def test_paths_are_looked_for_no_longer_than_is_said() -> None:
    chain = FiniteMDP.from_arrays([np.eye(6, k=1)], [[-1.0]] * 5 + [[np.nan]])
    assert [solve(chain, 1.0, "bellman-ford", max_iterations=n).iterations for n in (1, 2, 100)] == [1, 2, 6]


def test_the_error_of_an_evaluation_by_sweeps_is_no_less_than_it_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    # A constant error of c changes by (1 − γ) c in a sweep, so one that is a little above what changes by the scale
    # of rounding is left as it is.
    monkeypatch.setattr(policies, "_MOST_FACTORED", 1)
    mdp, gamma = FiniteMDP.from_arrays([[[0.5, 0.5], [0.25, 0.75]]], [[1.0], [1.0]]), 0.999
    problem, exact = prepare(mdp, gamma), np.full(2, 1 / (1 - gamma))
    scale = 2 * problem.rounding(exact)
    for share in (0.9, -0.9):
        v, error, sweeps = policy_values(problem, np.array([0, 1]), exact + share * problem.reach * scale)
        off = np.abs(v - exact).max()
        assert sweeps == 1 and 0.8 * problem.reach * scale < off < error < 10 * problem.reach * scale


@pytest.mark.parametrize("method", ["value-iteration", "gauss-seidel", "policy-iteration", "modified-policy-iteration"])
def test_one_iteration_backs_every_row_up_once_and_the_proof_does_so_again(method: str) -> None:
    mdp = FiniteMDP.garnet(5, 3, 2, seed=0)
    answer = solve(mdp, 0.9, method, max_iterations=1)
    assert (answer.iterations, answer.backups) == (1, 2 * 15)


def test_an_answer_that_is_right_at_once_is_seen_to_be() -> None:
    # One state that ends: nothing changes after the first sweep, so there are two of them, and in place one check more.
    mdp = FiniteMDP.from_arrays([[[0.0]]], [[3.0]], substochastic=True)
    for method, iterations, backups in (("value-iteration", 1, 1), ("gauss-seidel", 1, 2), ("bellman-ford", 2, 2)):
        answer = solve(mdp, 1.0, method)
        assert (answer.v.tolist(), answer.iterations, answer.backups) == ([3.0], iterations, backups + 1), method


@pytest.mark.parametrize("gamma", [0.5, 0.9])
def test_the_queue_of_priorities_is_counted(gamma: float) -> None:
    for seed in range(4):
        slow, tol = Slow(seed, gamma), 1e-6
        p = slow.mdp.transition.toarray()
        size = float(np.abs(slow.mdp.reward).max()) / (1 - gamma)
        threshold = max(0.5 * tol * (1 - gamma), slow.rounding(size))
        v, waits = np.zeros(20), np.abs(slow.values(np.zeros(20)).max(axis=1))
        backed_up = 0
        while waits.max() > threshold:
            s = int(waits.argmax())
            best = slow.values(v)[s].max()
            change, v[s], waits[s] = abs(best - v[s]), best, 0.0
            waits += gamma * change * p[:, s].reshape(20, -1).sum(axis=1)
            backed_up += 1
        answer = solve(slow.mdp, gamma, "prioritized-sweeping", tol)
        assert counts(answer, slow) == (-(-backed_up // 20), slow.rows + 4 * backed_up)


def corridor() -> FiniteMDP:
    """0 → 1 → 2 → end at −1 each; from 1 a second way, to the end, costs 9."""

    def transitions(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        return [(1.0, s + 1, -1.0, False)] if a == 0 and s < 2 else [(1.0, 0, (-1.0, -9.0)[a], True)]

    mdp = FiniteMDP.from_functions(3, 2, lambda s: [0, 1] if s == 1 else [0], transitions)
    return dataclasses.replace(mdp, start=np.array([1.0, 0.0, 0.0]))


def test_trials_are_counted_and_so_are_the_checks_between_them() -> None:
    # A trial from 0 backs up three states with 1, 2 and 1 rows. It is checked when as many states as there are were
    # backed up: after 64 trials, or those that are allowed; a check, like the proof at the end, looks at all 4 rows.
    for allowed, iterations in ((None, 64), (5, 5), (1, 1)):
        answer = solve(corridor(), 1.0, "rtdp", max_iterations=allowed)
        assert (answer.iterations, answer.backups) == (iterations, 4 * iterations + 4 + 4)
    # Of 300 states only the first is visited: 64 times, then 32 + 64 trials at a time, until 352 are at least 300.
    many = FiniteMDP.from_functions(300, 1, lambda s: [0], lambda s, a: [(1.0, 0, -float(s == 0), True)])
    answer = solve(dataclasses.replace(many, start=np.eye(300)[0]), 0.5, "rtdp")
    assert (answer.iterations, answer.backups) == (352, 352 + 300 + 300)


def test_labelled_trials_are_counted() -> None:
    # From 0 the first trial makes −1 of all three (4 rows). Backwards: 2 is right (1 row); 1 is not (2), and is backed
    # up (2). The second trial goes through 0 and 1 (3 rows); then 1 (2) and 0 (1) are right. The proof takes 4.
    answer = solve(corridor(), 1.0, "labelled-rtdp")
    assert (answer.iterations, answer.backups) == (2, 4 + 1 + 2 + 2 + 3 + 2 + 1 + 4)
    assert answer.v.tolist() == [-3.0, -2.0, -1.0] and answer.converged
    stopped = solve(corridor(), 1.0, "labelled-rtdp", max_iterations=1)
    assert (stopped.iterations, stopped.backups, stopped.converged) == (1, 4 + 1 + 2 + 2 + 4, False)


@pytest.mark.parametrize(("residual", "iterations"), [(3.9, 64 + 21 * 33), (4.2, 1500)])
def test_trials_stop_where_rounding_keeps_the_residual_from_falling(residual: float, iterations: int) -> None:
    """Two loops with γ = 1 − 1e-7, one of which earns a little less than the upper bound of both says.

    Its residual, some roundings of one backup, is a whole number of units in the last place of values of 1e7, and
    loses one of them in 4e5 backups. A round of trials makes 33 · 120 of them: after the first check 21 find no lower
    one. Above four roundings nothing stops them.
    """
    mdp, gamma = FiniteMDP.from_arrays([[[1.0, 0.0], [0.0, 1.0]]], [[1.0], [1.0]]), 1 - 1e-7
    rounding = prepare(mdp, gamma).rounding(np.full(1, 1e7))
    less = dataclasses.replace(mdp, reward=np.array([1.0 - residual * rounding, 1.0]))
    assert solve(less, gamma, "rtdp", max_iterations=1500).iterations == iterations
