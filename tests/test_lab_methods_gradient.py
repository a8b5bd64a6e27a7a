"""Gradient TD: expected against sampled updates, published sweeps, identities and recursions written out by hand.

The law: averaged over all transitions with their chances, the sampled update at a generic θ is the expected one, for
more points than θ has entries, so that the affine maps agree. With traces there is no finite list of cases; there the
long-run mean of the sampled increment is compared within 4 standard errors.

Mutants that die here, in gradient.py: h updated before w (each learner); the ratio missing from the trace, from either
line of GTD, or counted twice; (1−λ) lost in GTD2 and in TDC; the expected B scaled or not transposed; a trace that does
not start anew, or decays by the discount out of its row; the correction with the other sign; β outside the step size of
h; β/α missing from h or on w; the two traces of HTD swapped; z̄ with the ratio; A_mu without its transpose or without
λ; GTD2-MP that steps from the halfway point, or does not look there; C in place of I in GTD. In gq.py: no ratio, that
of the next pair, or one on the whole trace; ties to the highest action; the greedy action of this state instead of the
next; h·x for h·e; an end that bootstraps; illegal actions that win; the wrong chain in the expected Greedy-GQ.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import SampledTransition, sample_along, stream
from neuralq.lab.methods import METHODS, Expected, SampledUpdate, method
from neuralq.lab.methods.gq import greedy_rows
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star

Floats = NDArray[np.float64]

STATE_METHODS = ["gtd", "gtd2", "tdc", "tdrc", "htd"]
PAIR_METHODS = [*STATE_METHODS, "gq", "greedy-gq"]
TRACED = ["gtd2", "gtd2-mp", "tdc", "tdrc", "htd", "gq"]


def expected_of(process: Process, name: str, **options: float) -> Expected:
    one = method(name)
    assert one.expected is not None
    return one.expected(process, one.checked(options))


def generator_of(process: Process, name: str, **options: float) -> tuple[Floats, Floats]:
    generator = expected_of(process, name, **options).generator
    assert generator is not None
    return generator


def learner_of(process: Process, w0: Floats, name: str, **options: float) -> SampledUpdate:
    one = method(name)
    assert one.learner is not None
    return one.learner(process, w0, one.checked(options))


def printed(text: str) -> object:
    """A number as it was printed, equal to what rounds to it."""
    return pytest.approx(float(text), rel=1e-6, abs=0.51 * 10.0 ** -len(text.split(".")[1]))


def random_problem(seed: int, pairs: bool, on_policy: bool = False) -> Problem:
    """Four states, three actions of which one is illegal in state 1, transitions that may end the episode."""
    rng = np.random.default_rng(seed)
    legal = np.ones((4, 3), dtype=bool)
    legal[1, 0] = False
    transition = 0.8 * rng.dirichlet(np.ones(4), size=(3, 4)) * rng.uniform(0.7, 1, size=(3, 4, 1))

    def policy() -> Floats:
        chance = legal * rng.uniform(0.3, 1, size=(4, 3))
        return np.asarray(chance / chance.sum(axis=1, keepdims=True))

    mdp = FiniteMDP.from_arrays(transition, rng.normal(size=(4, 3)), legal=legal, substochastic=True)
    behaviour = policy()
    X = rng.normal(size=(4, 3, 5) if pairs else (4, 3))
    return Problem.from_mdp(
        mdp, X, gamma=0.9, behaviour_policy=behaviour, target_policy=behaviour if on_policy else policy()
    )


def control_star(behaviour: Floats) -> Problem:
    """Baird's star as a control problem (Sutton & Barto 2018, exercise 11.3; features after Maei et al. 2010)."""
    upper = star()
    features = np.zeros((7, 2, 15))
    features[:, 1, 0], features[:, 1, 1:8] = upper.features[:, 7], upper.features[:, :7]
    features[np.arange(7), 0, 8 + np.arange(7)] = 1.0
    weights = np.ones(15)
    weights[7] = 10.0
    return Problem.from_mdp(
        upper.mdp, features, gamma=0.99, target_policy=upper.target_policy, behaviour_policy=behaviour,
        state_distribution=np.full(7, 1 / 7), initial_weights=weights,
    )  # fmt: skip


def after_each_arc(process: Process, name: str, theta: Floats, step_size: float, **options: float) -> Floats:
    """θ after the sampled update along every transition, from θ, ``[K, size]``."""
    num_transitions = len(process.transitions.row)
    transition = np.arange(num_transitions)
    second = process.target_transitions.starts[process.transitions.row]
    learner = learner_of(process, np.zeros((num_transitions, process.num_weights)), name, **options)
    learner.theta[:] = theta
    learner.update(sample_along(process, transition, second, np.ones(num_transitions, dtype=bool)), step_size)
    return learner.theta


def mean_over_transitions(process: Process, values: Floats) -> Floats:
    weight = process.D[process.transitions.row] * process.transitions.probability
    return np.asarray(np.tensordot(weight, values, axes=1))


def problems(pairs: bool) -> list[Problem]:
    return [random_problem(seed, pairs) for seed in range(3)]


@pytest.mark.parametrize(
    ("name", "problem"),
    [(name, problem) for name in STATE_METHODS for problem in [star(), *problems(pairs=False)]]
    + [(name, problem) for name in PAIR_METHODS for problem in problems(pairs=True)]
    + [(name, control_star(star().behaviour_policy)) for name in ("gq", "greedy-gq")],
)
def test_the_mean_of_the_sampled_update_is_the_expected_one(name: str, problem: Problem) -> None:
    process, rng = linear_process(problem), np.random.default_rng(5)
    options = {"beta_over_alpha": 2.5, **({"beta": 0.7} if name == "tdrc" else {})}
    expected = expected_of(process, name, **options)
    for theta in rng.normal(size=(expected.size + 2, expected.size)):
        M, c = expected.at(theta, 0.07)
        mean = mean_over_transitions(process, after_each_arc(process, name, theta, 0.07, **options))
        assert mean == pytest.approx(M @ theta + c, abs=1e-12, rel=1e-12)
    if expected.generator is not None:
        G, g = expected.generator
        assert np.allclose(np.eye(expected.size) - 0.07 * G, M, atol=1e-15) and np.allclose(0.07 * g, c, atol=1e-15)
    assert expected.linear == (name != "greedy-gq")
    assert expected.initial(problem.initial_weights)[process.num_weights :].tolist() == [0.0] * process.num_weights


@pytest.mark.parametrize("problem", [random_problem(1, False), random_problem(1, True), star()])
def test_gtd2_mp_differs_from_its_mean_at_second_order_only(problem: Problem) -> None:
    """One sample used twice: E[(I − αG_t + α²G_t²)] = I − αG + α²E[G_t²], with G_t from what GTD2 does there."""
    process, rng, a = linear_process(problem), np.random.default_rng(2), 0.05
    size = 2 * process.num_weights
    zero = after_each_arc(process, "gtd2", np.zeros(size), 1.0, beta_over_alpha=3.0)
    units = [after_each_arc(process, "gtd2", unit, 1.0, beta_over_alpha=3.0) - zero for unit in np.eye(size)]
    G_arc = np.eye(size) - np.stack(units, axis=-1)  # [K, size, size]
    G, g = mean_over_transitions(process, G_arc), mean_over_transitions(process, zero)
    M, c = expected_of(process, "gtd2-mp", beta_over_alpha=3.0).at(zero[0], a)
    assert pytest.approx(np.eye(size) - a * G + a**2 * G @ G, abs=1e-12) == M
    assert c == pytest.approx(a * g - a**2 * G @ g, abs=1e-12)
    theta = rng.normal(size=size)
    mean = mean_over_transitions(process, after_each_arc(process, "gtd2-mp", theta, a, beta_over_alpha=3.0))
    twice = mean_over_transitions(process, np.einsum("kij,kj->ki", G_arc, G_arc @ theta - zero))
    assert mean == pytest.approx(theta + a * (g - G @ theta) + a**2 * twice, abs=1e-11)


def test_gtd2_mp_is_of_second_order() -> None:
    """(I + αG)⁻¹ = I − αG + α²G² − ..., so halving α divides the difference by 8."""
    process = linear_process(random_problem(0, False))
    G, _ = generator_of(process, "gtd2", beta_over_alpha=1.0)
    at = expected_of(process, "gtd2-mp", beta_over_alpha=1.0).at
    one, two = (np.abs(at(np.zeros(6), a)[0] - np.linalg.inv(np.eye(6) + a * G)).max() for a in (1e-2, 5e-3))
    assert one / two == pytest.approx(8, rel=0.02)


@pytest.mark.parametrize("name", [name for name in TRACED if name != "gtd2-mp"])
@pytest.mark.parametrize("lambda_", [0.4, 0.9])
def test_the_long_run_mean_with_traces_is_the_expected_update(name: str, lambda_: float) -> None:
    process, rng = linear_process(random_problem(7, name == "gq")), np.random.default_rng(11)
    options = {"lambda_": lambda_, "beta_over_alpha": 1.5}
    expected = expected_of(process, name, **options)
    theta = rng.normal(size=expected.size)
    M, c = expected.at(theta, 1.0)
    learner = learner_of(process, np.zeros((3000, process.num_weights)), name, **options)
    total = np.zeros((3000, expected.size))
    for t, sample in enumerate(itertools.islice(stream(process, "markov", 3000, rng), 120)):
        learner.theta[:] = theta
        learner.update(sample, 1.0)
        if t >= 30:  # what the first trace of 0 still lacks is then below (.72 λ)³⁰
            total += (learner.theta - theta) / 90
    error = np.std(total, axis=0) / np.sqrt(3000)
    assert (np.abs(total.mean(axis=0) - (M @ theta + c - theta)) <= 4 * error).all()
    assert method(name).remembers(options) and not method(name).remembers({**options, "lambda_": 0.0})


def by_hand(
    name: str, process: Process, samples: list[SampledTransition], n: int, w: Floats, o: dict[str, float]
) -> Floats:
    """θ of seed n after some samples: the textbook's lines, one transition at a time."""
    h, z, z_mu, e, before, a = np.zeros_like(w), 0 * w, 0 * w, 0 * w, 0.0, o["step_size"]
    b, lam = a * o["beta_over_alpha"], o.get("lambda_", 0.0)
    for t in samples:
        x, ahead, rho, r = t.x[n], t.discount[n] * t.x_next[n], t.rho[n], t.reward[n]
        before = 0.0 if t.begins[n] else before * lam
        z, z_mu = rho * (before * z + x), before * z_mu + x
        if name in ("gq", "greedy-gq"):
            s, u = process.pairs[t.row[n]]  # type: ignore[index]
            e = x + before * process.target_policy[s, u] / process.behaviour_policy[s, u] * e
            ahead = 0 * x
            if t.next_row[n] >= 0:
                s = process.state[t.next_row[n]]
                rows = [k for k in range(process.num_rows) if process.state[k] == s]
                pi = [process.target_policy[s, process.pairs[k, 1]] for k in rows]  # type: ignore[index]
                values = [process.X[k] @ w for k in rows]
                average = sum(p * process.X[k] for p, k in zip(pi, rows, strict=True))
                ahead = t.discount[n] * (average if name == "gq" else process.X[rows[int(np.argmax(values))]])
        d = r + w @ ahead - w @ x
        if name == "gtd":
            w = w + a * rho * (x - ahead) * (x @ h)
            h = h + b * (rho * d * x - h)
        elif name == "gtd2":
            w = w + a * ((x @ h) * x - (1 - lam) * (z @ h) * ahead)
            h = h + b * (d * z - (x @ h) * x)
        elif name in ("tdc", "tdrc"):
            w = w + a * (d * z - (1 - lam) * (z @ h) * ahead)
            h = h + b * (d * z - (x @ h) * x - o.get("beta", 0.0) * h)
        elif name == "htd":
            w = w + a * (d * z + (x - ahead) * ((z - z_mu) @ h))
            h = h + b * (d * z - (x - ahead) * (z_mu @ h))
        elif name in ("gq", "greedy-gq"):
            w = w + a * (d * e - (1 - lam) * (h @ e) * ahead)
            h = h + b * (d * e - (h @ x) * x)
        else:
            w_m, h_m = w + a * ((x @ h) * x - (1 - lam) * (z @ h) * ahead), h + b * (d * z - (x @ h) * x)
            d = r + w_m @ ahead - w_m @ x
            w = w + a * ((x @ h_m) * x - (1 - lam) * (z @ h_m) * ahead)
            h = h + b * (d * z - (x @ h_m) * x)
        before = t.discount[n]
    return np.concatenate([w, h])


@pytest.mark.parametrize(("name", "sampling"), [*itertools.product([*PAIR_METHODS, "gtd2-mp"], ["iid", "markov"])])
def test_learners_are_the_textbooks_recursions(name: str, sampling: str) -> None:
    process, rng = linear_process(random_problem(3, pairs=True)), np.random.default_rng(3)
    options = {"beta_over_alpha": 1.7}
    options |= {"lambda_": 0.8} if name in TRACED else {}
    options |= {"beta": 0.6} if name == "tdrc" else {}
    samples = list(itertools.islice(stream(process, sampling, 6, rng), 25))  # type: ignore[arg-type]
    assert sampling == "iid" or any(sample.begins.any() for sample in samples[1:])
    w0 = rng.normal(size=(6, process.num_weights))
    learner = learner_of(process, w0, name, **options)
    for sample in samples:
        learner.update(sample, 0.03)
    for n in range(6):
        hand = by_hand(name, process, samples, n, w0[n], {**options, "step_size": 0.03})
        assert learner.theta[n] == pytest.approx(hand, rel=1e-10, abs=1e-12)


def iterate(problem: Problem, name: str, step_size: float, sweeps: int, **options: float) -> Floats:
    """Weights w after so many expected updates."""
    process = linear_process(problem)
    expected = expected_of(process, name, **options)
    theta = expected.initial(problem.initial_weights)
    for _ in range(sweeps):
        M, c = expected.at(theta, step_size)
        theta = M @ theta + c
    return theta[: process.num_weights]


def errors_on_the_star(w: Floats) -> tuple[float, float]:
    """RMSVE and RMSPBE; X has full row rank, so the latter is the Bellman error, and every true value is 0."""
    value = star().features @ w
    return float(np.sqrt(np.mean(value**2))), float(np.sqrt(np.mean((0.99 * value[6] - value) ** 2)))


@pytest.mark.parametrize(
    ("name", "step_size", "options", "sweeps", "rmsve", "rmspbe"),
    [  # computed by an independent float64 iteration of the synchronous expected updates
        ("tdc", 0.005, {}, 100, "3.322961", ""),  # α = .005, β = .05 of Sutton & Barto 2018, figure 11.5
        ("tdc", 0.005, {}, 200, "2.283301", ""),
        ("tdc", 0.005, {}, 500, "1.936275", ""),
        ("tdc", 0.005, {}, 1000, "1.935465", ".00737856"),
        ("tdc", 0.005, {}, 20000, "1.931112", ""),
        ("gtd2", 0.005, {}, 1000, "1.935281", ".00737827"),
        ("gtd", 0.005, {}, 1000, "1.947767", ".00827898"),
        ("tdrc", 0.015625, {}, 1000, "5.673566", ".0219"),
        ("tdrc", 0.015625, {}, 20000, "4.407765", ".0170"),
    ],
)
def test_expected_sweeps_of_the_star(
    name: str, step_size: float, options: dict[str, float], sweeps: int, rmsve: str, rmspbe: str
) -> None:
    w = iterate(star(), name, step_size, sweeps, **options)
    value_error, projected_error = errors_on_the_star(w)
    assert value_error == printed(rmsve)
    if rmspbe:
        assert projected_error == printed(rmspbe)
    if (name, sweeps) == ("tdc", 1000):
        assert w.tolist() == [printed("2.135314")] * 6 + [printed("6.628051"), printed("-2.337956")]


@pytest.mark.parametrize(
    ("behaviour", "rmspbe", "largest"),
    [  # RMSPBE when sweep 1, 50, 1000, 20000 begins, by an independent float64 iteration; max|Q| at the end
        (star().behaviour_policy, ("3.603113", "1.633462", ".014658", ".009185"), "1.07"),
        pytest.param(
            np.full((7, 2), 0.5), ("5.977978", ".051938", ".005384", ".005367"), "1.09", marks=pytest.mark.slow
        ),
    ],
)
def test_expected_greedy_gq_of_the_control_star(behaviour: Floats, rmspbe: tuple[str, ...], largest: str) -> None:
    problem = control_star(behaviour)
    process = linear_process(problem)
    expected = expected_of(process, "greedy-gq", beta_over_alpha=5.0)
    theta = expected.initial(problem.initial_weights)
    C = process.X.T @ (process.D[:, None] * process.X)
    for k in range(1, 20001):
        if k in (1, 50, 1000, 20000):
            q = (process.X @ theta[:15]).reshape(7, 2)
            best = q.max(axis=1)
            target = 0.99 * np.stack([np.full(7, best[:6].mean()), np.full(7, best[6])], axis=1)  # dashed, solid
            gradient = process.X.T @ (process.D * (target - q).reshape(-1))
            error = np.sqrt(gradient @ np.linalg.pinv(C) @ gradient)
            assert error == printed(rmspbe[(1, 50, 1000, 20000).index(k)])
        M, c = expected.at(theta, 0.05)
        theta = M @ theta + c
    assert np.abs(process.X @ theta[:15]).max() == printed(largest)


def growth(name: str, step_size: float, **options: float) -> float:
    """Spectral radius of the expected update of the star, weights that no row sees left out."""
    process = linear_process(star())
    seen = process.with_features(process.X @ process.visible)
    M, _ = expected_of(seen, name, **options).at(np.zeros(14), step_size)
    return float(np.abs(np.linalg.eigvals(M)).max())


def slowest(name: str, **options: float) -> float:
    """Least real part of the eigenvalues of G: what decides in the limit of small steps."""
    process = linear_process(star())
    G, _ = generator_of(process.with_features(process.X @ process.visible), name, **options)
    return float(np.linalg.eigvals(G).real.min())


def test_tdc_on_the_star_needs_a_fast_enough_second_step() -> None:
    """In the limit of small steps the boundary is β/α = .14242651686 (root of the least real part of G)."""
    stable = [slowest("tdc", beta_over_alpha=ratio) > 0 for ratio in (0.01, 0.1, 0.142426, 0.142427, 0.2, 100.0)]
    assert stable == [False, False, False, True, True, True]
    short, long = (np.abs(iterate(star(), "tdc", 0.02, k, beta_over_alpha=0.1)).max() for k in (2000, 20000))
    assert long > 1e3 * short
    assert np.abs(iterate(star(), "tdc", 0.02, 20000, beta_over_alpha=0.2)).max() < 10


def test_htd_on_the_star_diverges_with_equal_steps() -> None:
    """HTD swings and grows at α = β = 2⁻⁸, and converges only where β/α > 8.4048."""
    assert growth("htd", 0.00390625) == pytest.approx(1.00046729, abs=1e-8)
    assert [slowest("htd", beta_over_alpha=ratio) > 0 for ratio in (1.0, 8.4048, 8.4049)] == [False, False, True]
    errors = [errors_on_the_star(iterate(star(), "htd", 0.00390625, k))[0] for k in (20000, 40000)]
    assert errors[0] > 1e4 and errors[1] > 1e3 * errors[0]
    assert errors_on_the_star(iterate(star(), "htd", 0.00390625, 20000, beta_over_alpha=20.0))[0] < 5


def test_tdrc_is_not_monotone_in_beta() -> None:
    """With equal steps in the limit: stable, unstable from .0222, stable from .2393, unstable from 14.52."""
    stable = [slowest("tdrc", beta=beta) > 0 for beta in (0.0, 0.02, 0.025, 0.2, 0.25, 1.0, 14.0, 15.0, 100.0)]
    assert stable == [True, True, False, False, True, True, True, False, False]


@pytest.mark.parametrize(
    ("name", "twin", "options", "pairs"),
    [
        ("tdrc", "tdc", {"beta": 0.0, "beta_over_alpha": 3.0}, False),
        ("tdrc", "tdc", {"beta": 0.0, "beta_over_alpha": 3.0, "lambda_": 0.7}, True),
        ("gq", "tdc", {"beta_over_alpha": 3.0}, True),
        ("gq", "tdc", {"beta_over_alpha": 3.0, "lambda_": 0.7}, True),
    ],
)
def test_two_names_of_one_expected_update(name: str, twin: str, options: dict[str, float], pairs: bool) -> None:
    process = linear_process(random_problem(4, pairs))
    shared = {key: value for key, value in options.items() if key != "beta"}
    one, other = generator_of(process, name, **options), generator_of(process, twin, **shared)
    for got, wanted in zip(one, other, strict=True):
        assert got == pytest.approx(wanted, abs=1e-14)


def run_both(process: Process, one: tuple[str, dict[str, float]], two: tuple[str, dict[str, float]]) -> list[Floats]:
    w0 = np.random.default_rng(0).normal(size=(5, process.num_weights))
    learners = [learner_of(process, w0, name, **options) for name, options in (one, two)]
    for sample in itertools.islice(stream(process, "markov", 5, np.random.default_rng(1)), 60):
        for learner in learners:
            learner.update(sample, 0.02)
    return [learner.theta for learner in learners]


def test_htd_on_policy_is_td_update_for_update() -> None:
    process = linear_process(random_problem(6, False, on_policy=True))
    htd, td = run_both(process, ("htd", {"lambda_": 0.7}), ("td", {"lambda_": 0.7}))
    assert htd[:, :3] == pytest.approx(td, abs=1e-12) and np.abs(htd[:, 3:]).min() > 0
    G, _ = generator_of(process, "htd", lambda_=0.7)
    assert np.abs(G[:3, 3:]).max() < 1e-14


def test_gq_is_tdc_on_pairs_where_the_next_action_is_certain() -> None:
    base = random_problem(6, True)
    problem = Problem.from_mdp(base.mdp, base.features, gamma=0.9, target_policy=np.array([2, 1, 0, 2]))
    process = linear_process(problem)
    gq, tdc = run_both(process, ("gq", {"lambda_": 0.7}), ("tdc", {"lambda_": 0.7}))
    assert gq == pytest.approx(tdc, abs=1e-12)


def test_gq_needs_no_behaviour_that_takes_every_action_of_the_target() -> None:
    base = random_problem(6, True)
    behaviour, target = np.eye(3)[[0, 1, 2, 0]], np.eye(3)[[1, 2, 0, 2]]
    problem = Problem.from_mdp(
        base.mdp, base.features, gamma=0.9, target_policy=target, behaviour_policy=behaviour,
        state_distribution=np.full(4, 0.25),
    )  # fmt: skip
    process, theta = linear_process(problem), np.random.default_rng(1).normal(size=10)
    M, c = expected_of(process, "gq").at(theta, 0.1)
    mean = mean_over_transitions(process, after_each_arc(process, "gq", theta, 0.1))
    assert mean == pytest.approx(M @ theta + c, abs=1e-12)


def test_ties_go_to_the_lowest_legal_action() -> None:
    process = linear_process(random_problem(0, True))
    greedy = greedy_rows(process, np.zeros(5))
    assert [process.pairs[k].tolist() for k in greedy] == [[0, 0], [1, 1], [2, 0], [3, 0]]  # type: ignore[index]
    learner = learner_of(process, np.zeros((1, 5)), "greedy-gq")
    transition = np.flatnonzero(
        (process.transitions.next_row >= 0) & (process.state[process.transitions.next_row] == 1)
    )[:1]
    learner.theta[0, 5:] = h = np.arange(1.0, 6.0)
    learner.update(
        sample_along(
            process,
            transition,
            process.target_transitions.starts[process.transitions.row[transition]],
            np.ones(1, bool),
        ),
        1,
    )
    x, r = process.X[process.transitions.row[transition[0]]], process.transitions.reward[transition[0]]
    assert learner.theta[0, :5] == pytest.approx(r * x - 0.9 * (x @ h) * process.X[greedy[1]])


def test_what_cannot_be_asked_is_refused() -> None:
    states, w0 = linear_process(star()), np.zeros((1, 8))
    for make in (lambda name, **o: expected_of(states, name, **o), lambda name, **o: learner_of(states, w0, name, **o)):
        for name in ("gq", "greedy-gq"):
            with pytest.raises(ValueError, match=r"give the problem features \[S, A, d\]"):
                make(name)
        for name in [*STATE_METHODS, "gtd2-mp"]:
            with pytest.raises(ValueError, match="beta_over_alpha"):
                make(name, beta_over_alpha=0.0)
        for name in ("gtd2", "gtd2-mp", "tdc", "tdrc", "htd"):
            with pytest.raises(ValueError, match="lambda_"):
                make(name, lambda_=1.5)
    assert len({one.name for one in METHODS}) == len(METHODS)
