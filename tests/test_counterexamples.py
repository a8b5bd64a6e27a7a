"""Problems on which learning goes wrong: the list, Baird's star and hall, the convergent controls, and what is refused.

Numbers with many digits were computed by an independent float64 matrix iteration, unless a source is named.

Mutants that die here: a star without its weight of 10 or with it elsewhere, with one state too many or too few, with
its lower features exchanged, with ``dashed`` leading down, updated unevenly; a lower state that never ends; ``dashed``
pairs that share a weight; a hall that pays before its last state; a walk whose actions are exchanged or whose coin is
not fair, a dependent row not of length 1; a discount on Boyan's chain, features of its terminal state left in; a
behaviour policy of Collision that never turns away, or may at once, two bits of six for three; on-policy garnets for
off-policy ones; episodes that end and do not start again.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from counterexample_algebra import Floats, chain, dense, fixed_point, rmspbe, rmsve, slowest, sweeps, td, values
from hypothesis import given
from hypothesis import strategies as st

from neuralq.lab.problems import PROBLEMS, Problem, problem
from neuralq.mdp import FiniteMDP
from neuralq_envs import boyan as boyan_chain
from neuralq_envs.counterexamples import (
    baird,
    bertsekas,
    boyan,
    chains,
    chattering,
    collision,
    hall,
    kolter,
    w2w,
    walks,
)
from neuralq_envs.counterexamples.garnet import garnet

# --- the list ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("entry", PROBLEMS, ids=lambda entry: entry.name)
def test_every_problem_can_be_had_by_its_name_and_says_what_is_known(entry) -> None:
    made = problem(entry.name)
    assert made.name == entry.name
    assert made.title and made.source and made.known.endswith(".")
    assert made.known == entry.make().known  # the same every time, random ones too
    np.testing.assert_array_equal(made.features, entry.make().features)


def test_names_are_words_and_unique_and_an_unknown_one_lists_them() -> None:
    names = [entry.name for entry in PROBLEMS]
    assert len(set(names)) == len(names)
    assert all(name == name.lower() and " " not in name for name in names)
    with pytest.raises(ValueError, match=r"no problem is called 'brid'; there are baird, .*kolter"):
        problem("brid")


UNSTABLE = {
    *("baird", "baird-1995", "baird-first-edition", "w2w", "w2w-single", "gordon", "kolter", "emphatic"),
}
ANYTHING = {"garnet", "garnet-skewed"}


@pytest.mark.parametrize("entry", PROBLEMS, ids=lambda entry: entry.name)
def test_td_diverges_where_the_text_says_so_and_only_there(entry) -> None:
    p = entry.make()
    if p.learns_q or p.value is not None or entry.name in ANYTHING:
        return
    assert (slowest(p) < -1e-9) == (entry.name in UNSTABLE)


# --- Baird's star -----------------------------------------------------------------------------------------------------


def test_star_eigenvalues_and_solutions() -> None:
    p = baird.star()
    eigenvalues = np.sort(np.linalg.eigvals(td(p)[0]).real)
    assert eigenvalues == pytest.approx([-0.2392504643, -0.0221781, 0] + [4 / 7] * 5, abs=5e-8)
    assert np.linalg.matrix_rank(p.features) == 7
    np.testing.assert_allclose(p.features @ [1, 1, 1, 1, 1, 1, 4, -2], 0)
    np.testing.assert_array_equal(p.importance_ratio, np.tile([0, 7], (7, 1)))
    np.testing.assert_array_equal(values(p), 0)


@pytest.mark.parametrize("n", range(1, 10))
def test_closed_form_star(n: int) -> None:
    for gamma in (0.0, 0.5, 0.9, 0.99, 1.0):
        m = np.array([[n + 4, 2 * (1 - gamma) - (n + 4) * gamma], [2 * n, 5 * (1 - gamma) - 2 * n * gamma]]) / (n + 1)
        expected = np.sort_complex(np.append(np.linalg.eigvals(m), [4 / (n + 1)] * (n - 1)))
        p = baird.star(n, gamma)
        a, _ = td(p)
        right = np.linalg.svd(p.features)[2][: n + 1].T
        actual = np.sort_complex(np.linalg.eigvals(right.T @ a @ right).astype(complex))
        np.testing.assert_allclose(actual, expected, atol=3e-8)  # 4/(n+1) is a multiple root
    threshold = baird.critical_gamma(n)
    assert (threshold < 1) == (n >= 5)
    if n >= 5:
        assert slowest(baird.star(n, threshold - 1e-5)) > 0 > slowest(baird.star(n, threshold + 1e-5))
    else:
        assert slowest(baird.star(n, 0.9999)) > 0


def test_star_of_five_swings_and_of_six_does_not() -> None:
    def complex_lead(p: Problem) -> bool:
        eigenvalues = np.linalg.eigvals(td(p)[0])
        return bool(abs(eigenvalues[eigenvalues.real.argmin()].imag) > 1e-6)

    assert complex_lead(baird.star(5)) and complex_lead(baird.star_1995())
    assert not complex_lead(baird.star(6))


# Sutton & Barto 2018, equation 11.9 from the weights of figure 11.2
SWEEPS = {1: (1.025371, 9.999829, 1.075771), 100: (3.894886, 9.971199, 9.627054), 1000: (114.433716, 6.850030, 335.001)}
ROOT_MEAN_SQUARES = {0: 5.318432, 10: 6.469824, 100: 19.545527, 500: 135.290776, 1000: 581.355105}


def test_star_figure_11_2_right() -> None:
    p = baird.star()
    for k, (upper, lower, shared) in SWEEPS.items():
        assert sweeps(p, k) == pytest.approx([upper] * 6 + [lower, shared], rel=2e-6)
    for k, error in ROOT_MEAN_SQUARES.items():
        assert rmsve(p, sweeps(p, k)) == pytest.approx(error, rel=1e-6)
    assert rmspbe(p, p.initial_weights) == pytest.approx(8.221408, rel=1e-6)
    assert rmspbe(p, sweeps(p, 1000)) == pytest.approx(98.369515, rel=1e-6)


@pytest.mark.parametrize(
    "mistaken",
    [
        replace(baird.star(), initial_weights=np.ones(8)),  # without the weight of 10
        baird.star(7),
        baird.star(5),
        replace(baird.star(), features=np.where(baird.star().features == 2, 1.0, baird.star().features)),
        replace(baird.star(), target_policy=baird.star().behaviour_policy),
    ],
    ids=["no weight of 10", "eight states", "six states", "ones for twos", "on the wrong policy"],
)
def test_a_wrong_star_misses_the_figure(mistaken: Problem) -> None:
    assert rmsve(mistaken, sweeps(mistaken, 1000)) != pytest.approx(ROOT_MEAN_SQUARES[1000], rel=1e-2)


def star_updates(step_size: float) -> tuple[Floats, Floats]:
    """Probabilities p(a, s' | s) ``[S, A, S]`` and update matrices I − αA ``[S, A, S, d, d]`` of single transitions."""
    p = baird.star()
    transition, _ = dense(p)
    x, rho = p.features, p.importance_ratio
    change = p.gamma * x[None] - x[:, None]  # [s, s', d]
    update = np.eye(8) + step_size * np.einsum("sa,si,stj->satij", rho, x, change)
    return p.behaviour_policy[:, :, None] * transition, update


def test_star_mean_under_markov_sampling() -> None:
    probability, update = star_updates(0.01)
    mean = np.tile(baird.star().initial_weights / 7, (7, 1))  # E[w 1{state}]
    operator = np.einsum("sat,satij->tisj", probability, update)
    expected = {100: (3.885836, 9.969783, 9.597074), 1000: (113.322089, 6.818048, 331.602364)}
    for k in range(1, 1001):
        mean = np.einsum("tisj,sj->ti", operator, mean)
        if k in expected:
            assert mean.sum(axis=0)[5:] == pytest.approx(np.array(expected[k]), rel=1e-6)


@pytest.mark.parametrize(
    ("step_size", "radii"),
    [(0.01, (1.0023925, 1.0023814, 1.0048556, 1.0048110)), (0.005, (1.0011963, 1.0011935, 1.0024095, 1.0023983))],
)
def test_star_spectral_radii(step_size: float, radii: tuple[float, ...]) -> None:
    probability, update = star_updates(step_size)
    twice = np.einsum("satij,satkl->satikjl", update, update).reshape(7, 2, 7, 64, 64)
    actual = []
    for matrix in (update, twice):
        size = matrix.shape[-1]
        actual.append(np.einsum("sat,satij->ij", probability, matrix) / 7)
        markov = np.einsum("sat,satij->tisj", probability, matrix).reshape(7 * size, 7 * size)
        actual.append(markov)
    assert [np.abs(np.linalg.eigvals(m)).max() for m in actual] == pytest.approx(radii, abs=6e-8)


def test_star_1995_is_the_star_of_five_and_its_first_edition_ends() -> None:
    np.testing.assert_allclose(td(baird.star_1995())[0], td(baird.star(5))[0], atol=1e-15)
    first = baird.star_1995(termination=0.01)
    step, _ = chain(first, first.target_policy)
    np.testing.assert_allclose(step.sum(axis=1), [1, 1, 1, 1, 1, 0.99])
    assert slowest(first) < 0


@pytest.mark.parametrize(
    ("solid", "smallest", "largest"),
    [
        (None, -0.0341786, {1000: 38.0893, 10000: 2010.963, 20000: 63565.35}),
        (0.5, -0.1196252, {1000: 163.305, 10000: 1.0663e7, 20000: 1.65975e12}),
    ],
)
def test_star_control(solid: float | None, smallest: float, largest: dict[int, float]) -> None:
    p = baird.star_control(solid_probability=solid)
    transition, _ = dense(p)
    phi, theta = p.features.reshape(14, 15), p.initial_weights
    weight = (p.state_distribution[:, None] * p.behaviour_policy).reshape(-1)
    moves = transition.reshape(14, 7)
    a = phi.T @ (weight[:, None] * (phi - p.gamma * moves @ p.features[:, baird.SOLID]))
    assert np.linalg.eigvals(a).real.min() == pytest.approx(smallest, abs=5e-8)
    for k in range(1, 20001):
        q = phi @ theta
        greedy = q.reshape(7, 2).max(axis=1)
        theta = theta + 0.01 * phi.T @ (weight * (p.gamma * moves @ greedy - q))
        if k in largest:
            assert np.abs(phi @ theta).max() == pytest.approx(largest[k], rel=1e-5)
    # the unstable mode alone explains it: on the whole way solid stays greedy
    assert (q.reshape(7, 2).argmax(axis=1) == baird.SOLID).all()


def test_star_control_is_the_star_on_solid() -> None:
    p = baird.star_control()
    assert p.control and p.exploration is None and p.num_weights == 15
    assert p.initial_weights[7] == 10 and p.initial_weights.sum() == 24
    star = baird.star()
    np.testing.assert_array_equal(p.features[:, baird.SOLID, 0], star.features[:, 7])
    np.testing.assert_array_equal(p.features[:, baird.SOLID] @ p.initial_weights, star.features @ star.initial_weights)
    np.testing.assert_array_equal(p.features[:, baird.DASHED, 8:], np.eye(7))  # a weight of its own for each


def test_controls_of_the_star() -> None:
    eigenvalues = np.sort(np.linalg.eigvals(td(baird.star_on_policy())[0]).real)
    np.testing.assert_allclose(eigenvalues, [0] * 7 + [0.05], atol=1e-12)
    table = baird.star_tabular()
    np.testing.assert_allclose(np.linalg.eigvals(td(table)[0]), [*[1 / 7] * 6, 0.01 / 7], atol=1e-12)
    assert slowest(baird.star_low_gamma()) > 0
    with pytest.raises(ValueError, match="15/17"):
        baird.star_low_gamma(0.9)


# --- the hall ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "discounted", "undiscounted"), [(6, 39.0, 64.9), (12, 98.9, 249.7), (24, 193.5, 969.4)])
def test_hall_condition_numbers(n: int, discounted: float, undiscounted: float) -> None:
    for gamma, expected in ((0.9, discounted), (1.0, undiscounted)):
        a, _ = td(hall.hall(n, gamma))
        np.testing.assert_allclose(np.linalg.eigvals(a), 1 / n, atol=1e-3)
        assert np.linalg.cond(a.T @ a) == pytest.approx(expected, abs=0.06)
    assert hall.residual_condition_number(n) == pytest.approx(np.linalg.cond(a.T @ a), rel=1e-9)
    assert hall.residual_condition_number(200) == pytest.approx(16 * 200**2 / np.pi**2, rel=0.01)


@pytest.mark.parametrize(("n", "gamma", "steps"), [(6, 0.9, (6, 88)), (12, 1.0, (12, 605)), (24, 1.0, (24, 2349))])
def test_hall_is_slow_for_residual_gradients(n: int, gamma: float, steps: tuple[int, int]) -> None:
    p = hall.hall(n, gamma)
    a, b = td(p)
    residual, right = n * a.T @ a, n * a.T @ b
    spread = np.linalg.eigvalsh(residual)
    taken = []
    for matrix, target, step_size in ((a, b, p.step_size), (residual, right, 2 / (spread[0] + spread[-1]))):
        w, k = p.initial_weights, 0
        while np.abs(w - values(p)).max() > 0.01:
            w, k = w + step_size * (target - matrix @ w), k + 1
        taken.append(k)
    assert tuple(taken) == steps


# --- controls ---------------------------------------------------------------------------------------------------------


def test_walks() -> None:
    five, nineteen = walks.walk5(), walks.walk19()
    np.testing.assert_allclose(values(five)[1:-1], np.arange(1, 6) / 6)
    np.testing.assert_allclose(values(nineteen)[1:-1], np.linspace(-0.9, 0.9, 19), atol=1e-12)
    np.testing.assert_allclose(fixed_point(nineteen, 0.8), values(nineteen)[1:-1], atol=1e-9)


def test_off_policy_walk() -> None:
    expected = (-0.269173, 0.218045, 0.542857, 0.759398, 0.903759)
    assert walks.walk_values() == pytest.approx(expected, abs=5e-7)
    for right in (0.0, 0.3, 0.5, 0.6, 1.0):
        p = walks.walk_off_policy(right=right)
        np.testing.assert_allclose(walks.walk_values(right), values(p)[1:-1], atol=1e-12)
    for features in ("tabular", "inverted"):
        p = walks.walk_off_policy(features)
        np.testing.assert_allclose((p.features @ fixed_point(p))[1:-1], expected, atol=1e-6)
    np.testing.assert_allclose(p.state_distribution * 9, [0, 1, 2, 3, 2, 1, 0], atol=1e-12)


def test_off_policy_walk_with_dependent_features() -> None:
    p = walks.walk_off_policy("dependent")
    w = fixed_point(p)
    assert w == pytest.approx((-0.187546, 0.324983, 0.719203), abs=5e-7)
    root = np.sqrt(p.state_distribution)
    best = np.linalg.lstsq(root[:, None] * p.features, root * values(p), rcond=None)[0]
    assert (rmsve(p, w), rmsve(p, best)) == pytest.approx((0.092986, 0.069767), abs=5e-7)
    assert slowest(p) == pytest.approx(0.098705, abs=5e-7)


def test_boyan_needs_a_terminal_row_of_zeros() -> None:
    p = boyan.boyan()
    np.testing.assert_allclose(values(p), -2.0 * np.arange(13), atol=1e-12)
    for lambda_ in (0.0, 0.5, 1.0):
        np.testing.assert_allclose(fixed_point(p, lambda_), [-24, -16, -8, 0], atol=1e-9)
    assert np.linalg.matrix_rank(td(p)[0]) == 4
    with pytest.raises(ValueError, match="terminal state 0 must be 0"):
        replace(p, features=boyan_chain.features())
    step, _ = chain(p, p.target_policy)
    step[1:, 0] = 1 - step[1:].sum(axis=1)  # the end as a state like any other
    x = boyan_chain.features()  # what the learner would then bootstrap from
    assert np.linalg.matrix_rank(x.T @ np.diag(p.state_distribution) @ (x - step @ x), tol=1e-9) == 3


def test_collision() -> None:
    p = collision.collision()
    np.testing.assert_allclose(values(p), 0.9 ** np.arange(7, -1, -1), atol=1e-12)
    assert values(p)[0] == pytest.approx(0.478297, abs=5e-7)
    np.testing.assert_allclose(p.state_distribution * 35, [2, 4, 6, 8, 8, 4, 2, 1], atol=1e-9)
    step, _ = chain(p, p.behaviour_policy)
    length = np.linalg.solve(np.eye(8) - step, np.ones(8))
    assert p.mdp.start_distribution @ length == pytest.approx(4.375)


def test_collision_features_are_three_of_six_and_td_is_stable_on_them() -> None:
    made = [collision.collision(seed) for seed in range(200)]
    assert all((p.features.sum(axis=1) == 3).all() and p.num_weights == 6 for p in made)
    assert len({p.features.tobytes() for p in made}) == 200
    # each bit is on in half of the states: 9600 draws, of which 3 in a row of 6 leave a variance of 1/4 each
    share = np.mean([p.features.mean(axis=0) for p in made], axis=0)
    np.testing.assert_allclose(share, 0.5, atol=4 * 0.5 / sqrt(1600))
    assert min(np.linalg.eigvals(td(p)[0]).real.min() for p in made) > -1e-12
    errors = np.array([rmsve(p, fixed_point(p)) for p in made])
    # .3061 is the mean over other 50 feature sets, whose own standard error is about that of 50 of ours
    assert errors.mean() == pytest.approx(0.3061, abs=4 * errors.std() / sqrt(40))


@pytest.mark.parametrize("seed", range(20))
def test_garnets_are_random_but_the_same_for_a_seed(seed: int) -> None:
    p, again, on_policy = garnet(seed=seed), garnet(seed=seed), garnet(seed=seed, updates="target")
    for field in ("features", "target_policy", "behaviour_policy", "state_distribution"):
        np.testing.assert_array_equal(getattr(p, field), getattr(again, field))
        assert not np.array_equal(getattr(p, field), getattr(garnet(seed=seed + 100), field))
    for q in (p, on_policy):
        step, _ = chain(q, q.behaviour_policy)
        np.testing.assert_allclose(q.state_distribution @ step, q.state_distribution, atol=1e-12)
    np.testing.assert_array_equal(on_policy.target_policy, p.target_policy)
    a = td(on_policy)[0]
    assert np.linalg.eigvalsh(a + a.T).min() > 0  # positive definite, on-policy


def test_some_garnets_diverge() -> None:
    def share(updates) -> float:
        return float(np.mean([slowest(garnet(seed=seed, updates=updates)) < 0 for seed in range(100)]))

    assert share("target") == 0.0
    assert 0.05 < share("behaviour") < share("random") < 0.9


# --- what a problem and a model refuse --------------------------------------------------------------------------------


def test_a_row_that_sums_to_one_and_a_half_is_refused() -> None:
    with pytest.raises(ValueError, match=r"sum to 1\.5"):
        FiniteMDP.from_arrays([[[1.0, 0.5], [0.0, 1.0]]], np.zeros((2, 1)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": np.ones((6, 8))}, r"features must have shape \(7, 8\)"),
        ({"initial_weights": np.ones(7)}, "initial_weights must have shape"),
        ({"state_distribution": np.full(7, 0.2)}, "must sum to 1"),
        ({"behaviour_policy": np.tile([1.0, 0.0], (7, 1))}, "never takes action 1"),
        ({"target_policy": np.tile([0.5, 0.6], (7, 1))}, "must sum to 1"),
        ({"control": True}, r"\[S, A, d\]"),
        ({"gamma": 1.01}, "gamma"),
    ],
)
def test_a_problem_refuses_what_makes_no_sense(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(baird.star(), **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: kolter.kolter(1.0), "strictly between"),
        (lambda: kolter.kolter(0.5, -0.05), "epsilon"),
        (lambda: hall.hall(0), "num_states"),
        (lambda: bertsekas.bertsekas(1), "num_states"),
        (lambda: w2w.w2w(0.9, 1.5), "epsilon"),
        (lambda: chattering.chattering(-0.1), "exploration"),
        (lambda: walks.walk_off_policy("binary"), "features must be one of"),  # type: ignore[arg-type]
        (lambda: collision.collision(-1), "seed"),
        (lambda: baird.star_1995(termination=2.0), "termination"),
        (lambda: baird.star_control(solid_probability=-1.0), "solid_probability"),
    ],
)
def test_constructors_refuse_parameters_out_of_range(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# --- long-run shares of time ------------------------------------------------------------------------------------------


@given(st.integers(0, 1000))
def test_stationary_distribution_of_episodes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.full(6, 0.3), size=(2, 5))[:, :, :5]  # the sixth share is the end
    model = FiniteMDP.from_arrays(transition, np.zeros((5, 2)), substochastic=True, start=rng.dirichlet(np.ones(5)))
    policy = rng.dirichlet(np.ones(2), size=5)
    step = np.einsum("sa,ast->st", policy, transition)
    visits = np.linalg.solve(np.eye(5) - step.T, model.start_distribution)  # expected visits in one episode
    np.testing.assert_allclose(chains.stationary_distribution(model, policy), visits / visits.sum(), atol=1e-9)


def test_stationary_distribution_of_two_separate_parts_is_refused() -> None:
    model = FiniteMDP.from_arrays([np.eye(2)], np.zeros((2, 1)))
    with pytest.raises(ValueError, match="2 separate parts"):
        chains.stationary_distribution(model, np.ones((2, 1)))
    one = FiniteMDP.from_arrays([np.eye(2)], np.zeros((2, 1)), start=[0.0, 1.0])
    assert chains.stationary_distribution(one, np.ones((2, 1))).tolist() == [0, 1]


def test_the_distribution_of_a_large_chain_is_stationary() -> None:
    from neuralq.mdp import FiniteMDP
    from neuralq_envs.counterexamples.chains import restarting_chain, stationary_distribution

    wide = FiniteMDP.garnet(4000, 1, 5, seed=0)  # its factors would be almost dense
    policy = np.ones((4000, 1))
    d = stationary_distribution(wide, policy)
    assert np.abs(d - restarting_chain(wide, policy).T @ d).sum() < 1e-13
    assert d.sum() == pytest.approx(1, abs=1e-12)
    ring = np.roll(np.eye(2100), 1, axis=1)  # never mixes by itself, and is narrow: d is uniform
    around = FiniteMDP.from_arrays([ring], np.zeros((2100, 1)))
    assert stationary_distribution(around, np.ones((2100, 1))) == pytest.approx(np.full(2100, 1 / 2100), rel=1e-9)
