"""Several steps: n-step TD, V-trace and the traces of pairs, in the mean and transition by transition.

Mutants that die here: n ± 1 steps; the ratio of the last step left out of the product; the discount applied to the
reward of its own step; rows that still wait at an end dropped, or updated with one bootstrap; the youngest row updated
first; V-trace that clips only the trace, or only the error; the clipped ratio of the present step in the trace's decay
of the present step; c of the pair left instead of the pair entered; π without μ in P_c of tree backup; Retrace's 1 as
max; the sampled next action in δ instead of the target's expectation; a trace that
survives the start of an episode.
"""

from __future__ import annotations

import numpy as np
import pytest
from lab_laws import Floats, assert_law, assert_long_run, min_real, process_of

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import SampledTransition, stream
from neuralq.lab.methods import Method
from neuralq.lab.methods.multistep import NSTEP, VTRACE
from neuralq.lab.methods.pair_traces import EXPECTED_SARSA, NAIVE_Q, RETRACE, TREE_BACKUP
from neuralq.lab.methods.td import TD
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.emphatic import emphatic

OF_PAIRS = [EXPECTED_SARSA, TREE_BACKUP, RETRACE, NAIVE_Q]
THETA = np.array([0.7, -1.1, 0.4])


def generator(one: Method, process: Process, **options: float) -> tuple[Floats, Floats]:
    """G and g."""
    found = one.expected(process, one.checked(options)).generator  # type: ignore[misc]
    assert found is not None
    return found


def chain(process: Process, seed: int, num_steps: int) -> list[SampledTransition]:
    """One seed's transitions."""
    samples = stream(process, "markov", 1, np.random.default_rng(seed))
    return [next(samples) for _ in range(num_steps)]


@pytest.mark.parametrize("pairs", [False, True])
def test_one_step_obeys_the_law(pairs: bool) -> None:
    process = process_of(3, pairs)
    assert_law(process, NSTEP, num_steps=1)
    assert_law(process, VTRACE, lambda_=0.0)
    assert_law(process, VTRACE, lambda_=0.0, rho_bar=0.9)


@pytest.mark.parametrize("one", OF_PAIRS, ids=lambda one: one.name)
def test_one_step_of_pairs_is_expected_sarsa(one: Method) -> None:
    process = process_of(4, pairs=True)
    assert_law(process, one)
    for ours, td in zip(generator(one, process), generator(TD, process), strict=True):
        np.testing.assert_allclose(ours, td, atol=1e-14)


@pytest.mark.parametrize("num_steps", [2, 3, 5])
@pytest.mark.parametrize("pairs", [False, True])
def test_n_step_in_the_long_run(pairs: bool, num_steps: int) -> None:
    assert_long_run(process_of(3, pairs), NSTEP, THETA, num_steps=num_steps)


@pytest.mark.parametrize("options", [{}, {"lambda_": 0.5, "rho_bar": 0.9, "c_bar": 0.7}, {"rho_bar": 1.2}])
@pytest.mark.parametrize("pairs", [False, True])
def test_v_trace_in_the_long_run(pairs: bool, options: dict[str, float]) -> None:
    assert_long_run(process_of(3, pairs), VTRACE, THETA, **options)


@pytest.mark.parametrize("one", OF_PAIRS, ids=lambda one: one.name)
def test_traces_of_pairs_in_the_long_run(one: Method) -> None:
    assert_long_run(process_of(3, pairs=True), one, THETA, lambda_=0.9)


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
@pytest.mark.parametrize("pairs", [False, True])
def test_n_step_is_the_books_algorithm(pairs: bool, num_steps: int) -> None:
    """S&B 2018, section 7.3, written out with whole episodes in lists and the times τ of the book."""
    process, alpha = process_of(6, pairs), 0.05
    samples = chain(process, 2, 80)
    learner = NSTEP.learner(process, np.ones((1, 3)), NSTEP.checked({"num_steps": num_steps}))  # type: ignore[misc]
    w, episode, lengths = np.ones(3), [], []
    for sample in samples:
        if sample.begins[0]:
            episode = []
        episode.append(sample)
        T = len(episode) if sample.next_row[0] < 0 else 10**9
        t = len(episode) - 1
        tau = t - num_steps + 1
        while tau < len(episode):  # once, or until T − 1 if the episode has ended
            if tau >= 0:
                steps = episode[tau : min(tau + num_steps, T)]
                G = sum(process.gamma**k * step.reward[0] for k, step in enumerate(steps))
                if tau + num_steps < T:
                    G += process.gamma**num_steps * (w @ steps[-1].x_next[0])
                ratio = np.prod([step.rho[0] for step in steps])
                x = episode[tau].x[0]
                w = w + alpha * ratio * (G - w @ x) * x
            tau += 1
            if T == 10**9:
                break
        if T < 10**9:
            lengths.append(T)
        learner.update(sample, alpha)
        np.testing.assert_allclose(learner.theta[0], w, rtol=1e-11)
    assert min(lengths) < 4 <= max(lengths)  # episodes shorter and longer than n


def test_n_step_seeds_do_not_mix() -> None:
    process = process_of(6)
    options = NSTEP.checked({"num_steps": 3})
    samples = stream(process, "markov", 5, np.random.default_rng(3))
    together = NSTEP.learner(process, np.ones((5, 3)), options)  # type: ignore[misc]
    alone = NSTEP.learner(process, np.ones((1, 3)), options)  # type: ignore[misc]
    for _ in range(60):
        sample = next(samples)
        together.update(sample, 0.05)
        alone.update(SampledTransition(*(getattr(sample, name)[3:4] for name in SampledTransition.__slots__)), 0.05)
        np.testing.assert_allclose(together.theta[3:4], alone.theta, rtol=1e-13)


def test_n_step_refuses_transitions_that_do_not_follow() -> None:
    process = process_of(6)
    learner = NSTEP.learner(process, np.ones((50, 3)), NSTEP.checked({"num_steps": 2}))  # type: ignore[misc]
    samples = stream(process, "iid", 50, np.random.default_rng(0))
    learner.update(next(samples), 0.1)
    with pytest.raises(ValueError, match="markov"):
        learner.update(next(samples), 0.1)


def test_n_step_operator_has_the_limits_it_should() -> None:
    process = process_of(5)
    for ours, td in zip(generator(NSTEP, process, num_steps=1), generator(TD, process), strict=True):
        np.testing.assert_allclose(ours, td, atol=1e-14)
    for ours, td in zip(generator(NSTEP, process, num_steps=400), generator(TD, process, lambda_=1.0), strict=True):
        np.testing.assert_allclose(ours, td, atol=1e-12)
    G, g = generator(NSTEP, process.with_features(np.eye(3)), num_steps=3)  # a table: the fixed point is v
    np.testing.assert_allclose(np.linalg.solve(G, g), process.v, rtol=1e-12)


def test_star_n_step() -> None:
    """Computed by an independent float64 matrix iteration: stable from n = 13 on."""
    process = linear_process(star())
    assert min_real(NSTEP, process, num_steps=12) == pytest.approx(-0.004896, abs=5.1e-7)
    assert min_real(NSTEP, process, num_steps=13) == pytest.approx(0.005867, abs=5.1e-7)
    assert [n for n in range(1, 40) if min_real(NSTEP, process, num_steps=n) > 0] == list(range(13, 40))


def test_critical_lambda() -> None:
    """λ* = 61/66 on the star and 4/9 on the two states (6 − 5/γ at γ = .9, by hand)."""
    for process, critical in ((linear_process(star()), 61 / 66), (linear_process(emphatic()), 4 / 9)):
        assert min_real(TD, process, lambda_=critical - 1e-9) < 0 < min_real(TD, process, lambda_=critical + 1e-9)


@pytest.mark.parametrize("pairs", [False, True])
def test_v_trace_without_clipping_is_td(pairs: bool) -> None:
    """With bars above every ratio: TD(λ) in the mean and transition by transition, where ρ moves into the trace."""
    process = process_of(7, pairs)
    wide = VTRACE.checked({"lambda_": 0.8, "rho_bar": 1e9, "c_bar": 1e9})
    td = TD.checked({"lambda_": 0.8})
    for ours, other in zip(generator(VTRACE, process, **wide), generator(TD, process, **td), strict=True):
        np.testing.assert_allclose(ours, other, atol=1e-12)
    one = VTRACE.learner(process, np.ones((1, 3)), wide)  # type: ignore[misc]
    two = TD.learner(process, np.ones((1, 3)), td)  # type: ignore[misc]
    for sample in chain(process, 4, 80):
        one.update(sample, 0.05)
        two.update(sample, 0.05)
        np.testing.assert_allclose(one.theta, two.theta, rtol=1e-11)


def test_v_trace_has_the_values_of_the_clipped_policy() -> None:
    """A table: V of π_ρ̄ ∝ min(ρ̄ μ, π), whatever c̄ and λ (Espeholt et al. 2018, section 4.1)."""
    process = process_of(8).with_features(np.eye(3))
    transitions = process.transitions
    clipped = transitions.probability * np.minimum(0.9, transitions.rho)
    total = np.bincount(transitions.row, weights=clipped)
    P, r = np.zeros((3, 3)), np.bincount(transitions.row, weights=clipped * transitions.reward) / total
    for row, following, p in zip(transitions.row, transitions.next_row, clipped, strict=True):
        if following >= 0:
            P[row, following] += p / total[row]
    value = np.linalg.solve(np.eye(3) - process.gamma * P, r)
    assert np.abs(value - process.v).max() > 0.01
    for lambda_, c_bar in ((0.0, 1.0), (1.0, 1.0), (0.7, 0.5)):
        G, g = generator(VTRACE, process, lambda_=lambda_, c_bar=c_bar, rho_bar=0.9)
        np.testing.assert_allclose(np.linalg.solve(G, g), value, rtol=1e-10)


@pytest.mark.parametrize("one", OF_PAIRS, ids=lambda one: one.name)
def test_tables_of_pairs_find_the_target_values(one: Method) -> None:
    """Every cut leaves the fixed point of a table where it was (Munos et al. 2016, theorem 1)."""
    process = process_of(9, pairs=True)
    process = process.with_features(np.eye(process.num_rows))
    G, g = generator(one, process, lambda_=0.8)
    np.testing.assert_allclose(np.linalg.solve(G, g), process.v, rtol=1e-10)


CUTS = {
    "expected-sarsa": lambda pi, mu: pi / mu,
    "tree-backup": lambda pi, mu: pi,
    "retrace": lambda pi, mu: min(1.0, pi / mu),
    "naive-q": lambda pi, mu: 1.0,
}


@pytest.mark.parametrize("one", OF_PAIRS, ids=lambda one: one.name)
def test_pairs_obey_the_forward_view(one: Method) -> None:
    """An episode's updates at fixed w: Σ_t x_t Σ_k γᵏ (Π c_{t+1..t+k}) δ_{t+k} (Munos et al. 2016, equation 3)."""
    process, lambda_, theta = process_of(10, pairs=True), 0.8, np.array([0.5, -0.2, 1.0])
    pi, mu, row_of, X = process.target_policy, process.behaviour_policy, process.row_of, process.X
    assert row_of is not None
    learner = one.learner(process, theta[None].copy(), one.checked({"lambda_": lambda_}))  # type: ignore[misc]
    episode: list[SampledTransition] = []
    done = 0
    measured = np.zeros(3)
    for sample in chain(process, 6, 100):
        learner.theta[:] = theta
        learner.update(sample, 1.0)
        measured += learner.theta[0] - theta
        episode.append(sample)
        if sample.next_row[0] >= 0:
            continue
        pairs = [process.pairs[step.row[0]] for step in episode]  # type: ignore[index]
        deltas = []
        for step, following in zip(episode, [*pairs[1:], None], strict=True):
            ahead = 0.0
            if following is not None:
                s = following[0]
                ahead = sum(pi[s, a] * theta @ X[row_of[s, a]] for a in range(3) if row_of[s, a] >= 0)
            deltas.append(step.reward[0] + process.gamma * ahead - theta @ step.x[0])
        total = np.zeros(3)
        for t, step in enumerate(episode):
            weight = 1.0
            for k in range(t, len(episode)):
                if k > t:
                    weight *= process.gamma * lambda_ * CUTS[one.name](pi[tuple(pairs[k])], mu[tuple(pairs[k])])
                total += weight * deltas[k] * step.x[0]
        np.testing.assert_allclose(measured, total, atol=1e-12)
        episode, measured, done = [], np.zeros(3), done + 1
    assert done > 10


@pytest.mark.parametrize("one", OF_PAIRS, ids=lambda one: one.name)
def test_operator_of_pairs_from_arcs(one: Method) -> None:
    """A and b as sums over paths: what is traced is followed along the behaviour's transitions, each times its c."""
    process, lambda_ = process_of(12, pairs=True), 0.8
    transitions, n = process.transitions, process.num_rows
    P_c = np.zeros((n, n))
    for row, following, chance in zip(transitions.row, transitions.next_row, transitions.probability, strict=True):
        if following >= 0:
            s, a = process.pairs[following]  # type: ignore[index]
            c = lambda_ * CUTS[one.name](process.target_policy[s, a], process.behaviour_policy[s, a])
            P_c[row, following] += chance * c
    reach, step = np.diag(process.D), np.diag(process.D)
    for _ in range(400):
        step = process.gamma * step @ P_c
        reach = reach + step
    G, g = generator(one, process, lambda_=lambda_)
    ahead = process.X - process.gamma * process.P @ process.X
    np.testing.assert_allclose(G, process.X.T @ reach @ ahead, atol=1e-12)
    np.testing.assert_allclose(g, process.X.T @ reach @ process.r, atol=1e-12)


@pytest.mark.parametrize("one", [VTRACE, *OF_PAIRS], ids=lambda one: one.name)
def test_a_new_episode_starts_a_new_trace(one: Method) -> None:
    """Independent draws begin an episode each, so λ makes no difference to them."""
    process, found = process_of(4, pairs=True), []
    for lambda_ in (0.0, 0.9):
        learner = one.learner(process, np.ones((3, 3)), one.checked({"lambda_": lambda_}))  # type: ignore[misc]
        samples = stream(process, "iid", 3, np.random.default_rng(0))
        for _ in range(20):
            learner.update(next(samples), 0.1)
        found.append(learner.theta)
    assert np.array_equal(*found)


def test_what_is_refused() -> None:
    states, pairs = process_of(1), process_of(1, pairs=True)
    for one in OF_PAIRS:
        with pytest.raises(ValueError, match="state-action pairs"):
            one.expected(states, one.checked({}))  # type: ignore[misc]
        with pytest.raises(ValueError, match="lambda_"):
            one.learner(pairs, np.ones((1, 3)), one.checked({"lambda_": -1.0}))  # type: ignore[misc]
    for options in ({"rho_bar": 0.0}, {"c_bar": -1.0}, {"lambda_": 1.5}):
        with pytest.raises(ValueError, match=next(iter(options))):
            VTRACE.expected(states, VTRACE.checked(options))  # type: ignore[misc]
        with pytest.raises(ValueError, match=next(iter(options))):
            VTRACE.learner(states, np.ones((1, 3)), VTRACE.checked(options))  # type: ignore[misc]
    for num_steps in (0, 1.5):
        with pytest.raises(ValueError, match="num_steps"):
            NSTEP.expected(states, NSTEP.checked({"num_steps": num_steps}))  # type: ignore[misc]
        with pytest.raises(ValueError, match="num_steps"):
            NSTEP.learner(states, np.ones((1, 3)), NSTEP.checked({"num_steps": num_steps}))  # type: ignore[misc]
