"""Exact means and second moments of sampled updates, against hand arithmetic, plain matrices and simulation.

Mutants that die here: ends of episodes forgotten (`_arrivals` without ``ends``), the chance of a transition squared,
M V M instead of M V Mᵀ, the crossed term of `_blocks` left out, the second successor ignored, classes of a chain merged
(a frozen weight then looks neutral), a chain that begins at the start distribution instead of D.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackNoConvergence

from neuralq.lab.linear.process import Process, linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.linear.spectrum import first_crossing, visible_process
from neuralq.lab.methods import Method, method
from neuralq.lab.methods.td import TD
from neuralq.lab.verdicts import moments
from neuralq.lab.verdicts.moments import (
    evolve,
    growth_factors,
    mean_radius,
    second_moment_radius,
    second_moment_stable,
)
from neuralq.lab.verdicts.update_maps import UpdateMaps, update_maps
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star
from neuralq_envs.counterexamples.walks import walk5

Floats = NDArray[np.float64]


def maps_of(process: Process, one: Method = TD, step_size: float = 0.01, **options: float) -> UpdateMaps:
    return update_maps(process, one, one.checked(options), step_size)


def steady_covariance(maps: UpdateMaps) -> tuple[Floats, Floats]:
    """The mean and covariance of θ in the long run of independent draws: Σ = E[M Σ Mᵀ] + E[e eᵀ], e = M m + c − m."""
    kept = maps.weight > 0
    V = moments._moved(maps, kept)
    part, weight, c = maps.within(kept, V), maps.weight[kept], maps.c[kept] @ V
    q = V.shape[1]
    M, mean_c = np.einsum("k,kij->ij", weight, part.M), weight @ c
    m = np.linalg.solve(np.eye(q) - M, mean_c)
    e = part.M @ m + c - m
    noise = np.einsum("k,ki,kj->ij", weight, e, e)
    L = np.einsum("k,kia,kjb->ijab", weight, part.M, part.M, optimize=True).reshape(q * q, q * q)
    covariance = np.linalg.solve(np.eye(q * q) - L, noise.reshape(-1)).reshape(q, q)
    return V @ m, V @ covariance @ V.T


def spread(maps: UpdateMaps, theta: Floats, num_steps: int, sampling: str) -> tuple[Floats, Floats]:
    """The exact mean and covariance of θ after so many updates."""
    mean, second = evolve(maps, theta, np.array([num_steps]), sampling)
    return mean[0], second[0] - np.outer(mean[0], mean[0])


def two_states(gamma: float = 0.9) -> Problem:
    """Sutton, Mahmood & White 2016: x = 1, 2; right leads to 2, left to 1; the target always goes right."""
    mdp = FiniteMDP.from_arrays([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, 1.0]]], np.zeros((2, 2)))
    return Problem.from_mdp(mdp, [[1.0], [2.0]], gamma=gamma, target_policy=[1, 1],
                            behaviour_policy=np.full((2, 2), 0.5))  # fmt: skip


def random_problem(seed: int, pairs: bool = False, ends: bool = True) -> Problem:
    rng = np.random.default_rng(seed)
    mdp = FiniteMDP.garnet(4, 2, 2, seed=seed)
    if ends:  # state 3 is the end
        P = np.zeros((2, 4, 4))
        P[mdp.a_tm1, mdp.s_tm1] = mdp.transition.toarray()
        P[:, 3] = 0.0
        mdp = FiniteMDP.from_arrays(P, mdp.reward.reshape(4, 2), substochastic=True, start=[0.5, 0.5, 0.0, 0.0])
    shape = (4, 2, 3) if pairs else (4, 2)
    legal = mdp.legal / np.maximum(mdp.legal.sum(axis=1, keepdims=True), 1)
    target = np.where(legal > 0, rng.dirichlet(np.ones(2), 4), 0.0)
    return Problem.from_mdp(mdp, rng.normal(size=shape), gamma=0.8, target_policy=target, behaviour_policy=legal)


@pytest.mark.parametrize(
    ("step_size", "radii"),
    [
        (0.01, (1.0023925, 1.0023814, 1.0048556, 1.0048110)),
        (0.005, (1.0011963, 1.0011935, 1.0024095, 1.0023983)),
    ],
)
def test_radii_of_the_star(step_size: float, radii: tuple[float, ...]) -> None:
    """Computed by an independent float64 iteration of 8x8 matrices per state, 448 unknowns."""
    process = linear_process(star())
    for one in (process, visible_process(process)[0]):
        maps = maps_of(one, step_size=step_size)
        found = [f(maps, sampling) for f in (mean_radius, second_moment_radius) for sampling in ("iid", "markov")]
        assert found == pytest.approx(radii, abs=6e-8)


def test_radii_of_the_two_state_problem() -> None:
    maps = maps_of(linear_process(two_states()))
    assert mean_radius(maps, "markov") == pytest.approx(1.0019881, abs=6e-8)  # independent float64 computation
    assert second_moment_radius(maps, "markov") == pytest.approx(1.0040316, abs=6e-8)
    # by hand: μ = ½, ρ = 2 to the right: 1 − α(x² − γ x·2)·2 with x = 1: 1 + .016, x = 2: 1 − .008
    assert mean_radius(maps, "iid") == pytest.approx((1.0 + 1.016 + 1.0 + 0.992) / 4, abs=1e-14)
    assert second_moment_radius(maps, "iid") == pytest.approx((2.0 + 1.016**2 + 0.992**2) / 4, abs=1e-14)
    chain = 0.5 * np.array([[1.0, 1.016**2], [1.0, 0.992**2]])  # from 1 and from 2: left to 1, right to 2
    assert second_moment_radius(maps, "markov") == pytest.approx(np.abs(np.linalg.eigvals(chain)).max(), abs=1e-14)


def kron_radius(process: Process, step_size: float, eta: float) -> float:
    """ρ of the whole Kronecker operator of ridge TD(0) along a chain, from the textbook's update."""
    n, d = process.X.shape
    whole = np.zeros((n, d * d, n, d * d))
    transitions = process.transitions
    for i, j, p, rho, discount in zip(
        transitions.row,
        transitions.next_row,
        transitions.probability,
        transitions.rho,
        transitions.discount,
        strict=True,
    ):
        after = process.X[j] if j >= 0 else np.zeros(d)
        M = np.eye(d) - step_size * (rho * np.outer(process.X[i], process.X[i] - discount * after) + eta * np.eye(d))
        for k in range(n):
            arrives = float(k == j) if j >= 0 else process.start[k]
            whole[k, :, i] += arrives * p * np.kron(M, M)
    return float(np.abs(np.linalg.eigvals(whole.reshape(n * d * d, n * d * d))).max())


@pytest.mark.parametrize("seed", range(4))
def test_second_moment_radius_is_that_of_the_kronecker_operator(seed: int) -> None:
    process = linear_process(random_problem(seed, ends=seed % 2 == 0))
    maps = maps_of(process, step_size=0.3, eta=0.1)
    expected = kron_radius(process, 0.3, 0.1)
    assert second_moment_radius(maps, "markov") == pytest.approx(expected, rel=1e-10)
    assert second_moment_stable(maps, "markov") == (expected < 1)


def test_large_operators_are_applied_without_a_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = [maps_of(linear_process(star())), maps_of(linear_process(random_problem(0)), step_size=0.2)]
    small = [f(one, "markov") for one in maps for f in (mean_radius, second_moment_radius)]
    monkeypatch.setattr(moments, "LARGEST_DENSE", 5)
    large = [f(one, "markov") for one in maps for f in (mean_radius, second_moment_radius)]
    assert large == pytest.approx(small, rel=1e-9)
    monkeypatch.setattr(moments, "LARGEST", 5)
    with pytest.raises(ValueError, match="too many for exact moments"):
        second_moment_radius(maps[0], "markov")


def test_stability_is_the_same_by_a_linear_system_and_by_eigenvalues(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ridge η = ½ on the star settles below α = .1441962 along a chain; 7 rows of 28 numbers are 196 unknowns."""
    process = visible_process(linear_process(star()))[0]
    maps = [maps_of(process, step_size=a, eta=0.5) for a in (0.1, 0.144, 0.1444, 0.3)]
    size = maps[0].M.shape[1]
    num_unknowns = len(np.unique(maps[0].row)) * size * (size + 1) // 2
    leading = moments._leading
    for most, by_eigenvalues in ((num_unknowns, False), (num_unknowns - 1, True)):
        asked: list[int] = []
        monkeypatch.setattr(moments, "LARGEST_DENSE", most)
        monkeypatch.setattr(
            moments, "_leading", lambda one, moment, asked=asked: asked.append(1) or leading(one, moment)
        )
        assert [second_moment_stable(one, "markov") for one in maps] == [True, True, False, False]
        assert bool(asked) == by_eigenvalues


def test_unknowns_are_counted_and_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    process = linear_process(two_states())
    assert moments.unknowns(process, 3, "iid") == 9 and moments.unknowns(process, 3, "markov") == 18
    one = method("td")
    found = moments.known_second_moment(two_states(), one, one.checked({}), 0.01, "markov")
    assert found == pytest.approx(second_moment_radius(maps_of(process), "markov"))
    least = moments.unknowns(process, 1, "markov")
    for most, known in ((least, True), (least - 1, False)):
        value = moments.known_second_moment(two_states(), one, one.checked({}), 0.01, "markov", most)
        assert (value is not None) == known
    assert moments.known_second_moment(two_states(), one, one.checked({"lambda_": 0.5}), 0.01, "markov") is None
    unlearned = dataclasses.replace(one, learner=None)
    assert moments.known_second_moment(two_states(), unlearned, one.checked({}), 0.01, "markov") is None
    for limit, refused in ((2, False), (1, True)):  # two rows of one number
        monkeypatch.setattr(moments, "LARGEST", limit)
        if refused:
            with pytest.raises(ValueError, match="2 unknowns are too many"):
                second_moment_radius(maps_of(process), "markov")
        else:
            assert second_moment_radius(maps_of(process), "markov") > 1


def test_leading_factors_that_came_out_are_taken_and_none_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = maps_of(linear_process(star()))
    monkeypatch.setattr(moments, "LARGEST_DENSE", 5)
    for found in ([0.5 + 0j], []):

        def stuck(*_: object, found: list[complex] = found, **__: object) -> None:
            raise ArpackNoConvergence("stuck", np.array(found), np.zeros((0, 0)))

        monkeypatch.setattr(moments, "eigs", stuck)
        if found:
            assert second_moment_radius(maps, "markov") == 0.5
        else:
            with pytest.raises(ArpackNoConvergence):
                second_moment_radius(maps, "markov")


def test_step_size_limits_of_ridge_on_the_star() -> None:
    """η = .5; .129883 from an independent scan, .1441962181 from the 448x448 operator of `kron_radius`."""
    process = visible_process(linear_process(star()))[0]
    for sampling, limit, rel in (("iid", 0.129883, 3e-6), ("markov", 0.1441962181, 1e-8)):
        found = first_crossing(
            lambda a, kind=sampling: second_moment_stable(maps_of(process, step_size=a, eta=0.5), kind), 0.02, 2.0
        )
        assert found == pytest.approx(limit, rel=rel)
    full = linear_process(star())
    assert kron_radius(full, 0.14419, 0.5) < 1 < kron_radius(full, 0.14420, 0.5)


@pytest.mark.parametrize("pairs", [False, True])
@pytest.mark.parametrize("name", ["td", "residual", "naive-residual", "tdc", "gtd2"])
def test_the_mean_of_the_maps_is_the_expected_update(name: str, pairs: bool) -> None:
    process, one = linear_process(random_problem(1, pairs)), method(name)
    maps = maps_of(process, one, 0.07)
    assert one.expected is not None
    M, c = one.expected(process, one.checked({})).at(np.zeros(1), 0.07)
    assert maps.mean()[0] == pytest.approx(M, abs=1e-12)
    assert maps.mean()[1] == pytest.approx(c, abs=1e-12)
    rows = np.bincount(maps.row, weights=maps.probability)
    assert rows == pytest.approx(np.ones(process.num_rows))
    assert (len(maps.M) > len(process.transitions.row)) == (name == "residual")  # two independent successors


def test_frozen_weights_are_no_neutral_mode() -> None:
    """0 → 1 → 1 → ...: the chain soon updates w_1 only, and w_0 rests; independent draws go on updating both."""
    mdp = FiniteMDP.from_arrays([[[0.0, 1.0], [0.0, 1.0]]], np.zeros((2, 1)))
    problem = Problem.from_mdp(mdp, np.eye(2), gamma=0.5, state_distribution=[0.5, 0.5])
    maps = maps_of(linear_process(problem), step_size=0.2)
    assert mean_radius(maps, "markov") == pytest.approx(0.9)  # 1 − α (1 − γ), every step in state 1
    assert second_moment_radius(maps, "markov") == pytest.approx(0.81)
    assert mean_radius(maps, "iid") == pytest.approx(0.95)
    nothing = maps_of(linear_process(problem).with_features(np.zeros((2, 2))))
    assert mean_radius(nothing, "iid") == second_moment_radius(nothing, "markov") == 0.0
    assert growth_factors(nothing, "markov").shape == (0,)


def test_steady_covariance_by_hand() -> None:
    """w ← (1 − α) w + α R with R = ±1: variance α² / (1 − (1 − α)²), from a bandit with two equal arms."""
    mdp = FiniteMDP.from_arrays(np.zeros((2, 1, 1)), [[1.0, -1.0]], substochastic=True)
    problem = Problem.from_mdp(mdp, [[1.0]], gamma=0.9)
    mean, covariance = steady_covariance(maps_of(linear_process(problem), step_size=0.2))
    assert mean == pytest.approx(np.zeros(1), abs=1e-14)
    assert covariance[0, 0] == pytest.approx(0.04 / (1 - 0.64))
    later = spread(maps_of(linear_process(problem), step_size=0.2), np.ones(1), 400, "iid")
    assert later[1] == pytest.approx(covariance)
    assert not second_moment_stable(maps_of(linear_process(star())), "iid")  # of the star there is none


@pytest.mark.parametrize("sampling", ["iid", "markov"])
@pytest.mark.parametrize("problem", [star(), walk5()], ids=["never ends", "ends"])
def test_moments_one_update_at_a_time(problem: Problem, sampling: str) -> None:
    """m_j ← Σ p_k (M_k m_i + c_k u_i) and V_j likewise, transition by transition; u is the chance to be in a row."""
    process = linear_process(problem)
    maps, w = maps_of(process, step_size=0.1), problem.initial_weights
    u, m = process.D.copy(), process.D[:, None] * w
    V = process.D[:, None, None] * np.outer(w, w)
    for _ in range(5):
        after = [np.zeros_like(x) for x in (u, m, V)]
        for k, (i, j, p) in enumerate(zip(maps.row, maps.next_row, maps.probability, strict=True)):
            M, c = maps.M[k], maps.c[k]
            mean, crossed = M @ m[i] + c * u[i], np.outer(M @ m[i], c)
            square = M @ V[i] @ M.T + crossed + crossed.T + u[i] * np.outer(c, c)
            arrives = process.D if sampling == "iid" else process.start if j < 0 else np.eye(len(u))[j]
            for whole, part in zip(after, (u[i], mean, square), strict=True):
                whole += p * arrives.reshape(-1, *[1] * np.ndim(part)) * part
        u, m, V = after
    found = evolve(maps, w, np.array([0, 5]), sampling)
    np.testing.assert_allclose(found[0], [w, m.sum(axis=0)], rtol=1e-12)
    np.testing.assert_allclose(found[1], [np.outer(w, w), V.sum(axis=0)], rtol=1e-12)


def test_methods_that_remember_have_no_maps() -> None:
    process = linear_process(star())
    with pytest.raises(ValueError, match="no memoryless sampled update"):
        maps_of(process, TD, lambda_=0.5)


def check_against_simulation(seed: int, sampling: str, num_chains: int) -> None:
    problem = random_problem(seed, pairs=seed % 3 == 2, ends=seed % 2 == 0)
    process, rng = linear_process(problem), np.random.default_rng(1000 + seed)
    theta = rng.normal(size=process.num_weights)
    learner = TD.learner(process, np.tile(theta, (num_chains, 1)), TD.checked({}))  # type: ignore[misc]
    samples = stream(process, sampling, num_chains, rng)  # type: ignore[arg-type]
    for _ in range(20):
        learner.update(next(samples), 0.1)
    mean, covariance = spread(maps_of(process, step_size=0.1), theta, 20, sampling)
    off = learner.theta - mean
    noise = off.std(axis=0) / np.sqrt(num_chains)
    assert (np.abs(off.mean(axis=0)) < 4 * noise + 1e-12).all()
    products = off[:, :, None] * off[:, None, :]
    noise = products.std(axis=0) / np.sqrt(num_chains)
    assert (np.abs(products.mean(axis=0) - covariance) < 4 * noise + 1e-12).all()


@pytest.mark.parametrize("sampling", ["iid", "markov"])
@pytest.mark.parametrize("seed", range(3))
def test_moments_agree_with_simulation(seed: int, sampling: str) -> None:
    check_against_simulation(seed, sampling, 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3, 23))
def test_moments_agree_with_long_simulation(seed: int) -> None:
    check_against_simulation(seed, "markov", 200_000)


@pytest.mark.parametrize(("second_row_begins", "growth"), [(0.0, 0.5), (0.25, 2.0)])
def test_rows_that_a_chain_never_comes_to_do_not_count(second_row_begins: float, growth: float) -> None:
    # Two rows that lead to themselves: θ is halved in the first and doubled in the second, where the chain never is.
    rows = np.array([0, 1])
    D = np.array([1 - second_row_begins, second_row_begins])
    maps = UpdateMaps(np.array([[[0.5]], [[2.0]]]), np.zeros((2, 1)), rows, rows, np.ones(2), D, np.array([1.0, 0.0]))
    assert mean_radius(maps, "markov") == pytest.approx(growth)
    assert second_moment_radius(maps, "markov") == pytest.approx(growth**2)
    assert second_moment_stable(maps, "markov") == (growth < 1)
    led = dataclasses.replace(maps, next_row=np.array([1, 1]))  # from the first row it comes to the second
    assert mean_radius(led, "markov") == pytest.approx(2.0)


def test_where_nothing_moves_nothing_grows() -> None:
    still = UpdateMaps(np.ones((1, 1, 1)), np.zeros((1, 1)), np.zeros(1, int), np.zeros(1, int), *np.ones((3, 1)))
    for sampling in ("iid", "markov"):
        assert mean_radius(still, sampling) == second_moment_radius(still, sampling) == 0.0
        assert len(growth_factors(still, sampling)) == 0 and second_moment_stable(still, sampling)


@pytest.mark.parametrize("most", [1000, 0])
@pytest.mark.parametrize(("first", "second"), [(0.5, 0.5), (0.5, 1.5), (1.5, 0.5)])
def test_every_class_of_a_chain_has_to_settle(
    first: float, second: float, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rows, each of which leads to itself; by a linear system, and by eigenvalues."""
    monkeypatch.setattr(moments, "LARGEST_DENSE", most)
    # ARPACK wants more than one number.
    monkeypatch.setattr(moments, "_leading", lambda one, power: one.M[0, 0] ** power)
    M, each, half = np.array([[[first]], [[second]]]), np.arange(2), np.full(2, 0.5)
    maps = UpdateMaps(M, np.zeros((2, 1)), each, each, np.ones(2), half, half)
    assert second_moment_stable(maps, "markov") == (max(first, second) < 1)


def test_a_step_to_the_first_row_is_no_end() -> None:
    # The first row leads to itself and doubles θ; what ends begins again in the second, which never comes back.
    rows, D, start = np.array([0, 1]), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    maps = UpdateMaps(np.array([[[2.0]], [[0.5]]]), np.zeros((2, 1)), rows, rows, np.ones(2), D, start)
    assert mean_radius(maps, "markov") == pytest.approx(2.0) and not second_moment_stable(maps, "markov")
