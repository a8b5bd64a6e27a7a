"""The lab on odd problems and odd requests, laws that every diagnosis obeys, and words that must stay true.

Oracles: exact symmetries (units of the features, names of the states), inequalities between moments, hand arithmetic,
and training itself.

Mutants that die here: an update that overflows reported as a number; a drift with a safe step size, or with a settled
scatter; an unstable point taken for one that attracts; the spectrum in the units of the features; a chain's mean that
does not tend to the expected update; leaps that look at their ends only; "no step size helps" about a target network.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy import sparse

from neuralq.checks import check_whole
from neuralq.exact import resolvent
from neuralq.lab.linear.process import linear_process
from neuralq.lab.methods import METHODS, Expected, method
from neuralq.lab.networks.sampled import SampleDiagnosis
from neuralq.lab.trial import run
from neuralq.lab.verdicts.critical import scan
from neuralq.lab.verdicts.diagnosis import diagnose
from neuralq.lab.verdicts.moments import mean_radius, second_moment_radius
from neuralq.lab.verdicts.piecewise import follow
from neuralq.lab.verdicts.remedies import prescribe
from neuralq.lab.verdicts.update_maps import update_maps
from neuralq.lab.watch.advice import RunTraits
from neuralq.lab.watch.growth import fit_growth
from neuralq.lab.watch.monitor import DivergenceMonitor
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star
from neuralq_envs.counterexamples.chains import stationary_distribution
from neuralq_envs.counterexamples.chattering import chattering
from neuralq_envs.counterexamples.kolter import kolter

SEEDS = st.integers(0, 10_000)
MEMORYLESS = ["td", "residual", "naive-residual", "gtd", "gtd2", "tdc", "tdrc", "htd", "polyak-target"]


def random_problem(seed: int, num_states: int = 4, num_weights: int = 2, gamma: float = 0.9) -> Problem:
    rng = np.random.default_rng(seed)
    P = rng.dirichlet(np.ones(num_states), size=(2, num_states))
    return Problem.from_mdp(
        FiniteMDP.from_arrays(P, rng.normal(size=(num_states, 2))), rng.normal(size=(num_states, num_weights)),
        gamma=gamma, target_policy=rng.dirichlet(np.ones(2), num_states),
        behaviour_policy=0.2 + 0.6 * rng.dirichlet(np.ones(2), num_states),
        initial_weights=rng.normal(size=num_weights),
        state_distribution=rng.dirichlet(np.ones(num_states)),
    )  # fmt: skip


def one_state(reward: float = 1.0, gamma: float = 0.9, weight: float = 1.0, x: ArrayLike = ((1.0,),)) -> Problem:
    mdp = FiniteMDP.from_arrays([[[1.0]]], [[reward]])
    return Problem.from_mdp(mdp, x, gamma=gamma, initial_weights=np.full(np.shape(x)[-1], weight))


# --- odd problems -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampling", ["expected", "iid", "markov"])
@pytest.mark.parametrize("name", MEMORYLESS)
def test_features_of_zero_move_nothing(name: str, sampling: str) -> None:
    found = diagnose(one_state(x=((0.0, 0.0),)), name, sampling=sampling)  # type: ignore[arg-type]
    assert found.verdict in ("converges", "stable but poor fixed point") and found.rank == 0
    assert "moves nothing" in found.explain()


@pytest.mark.slow
def test_nothing_that_moves_is_stable_everywhere() -> None:
    found = scan(one_state(x=((0.0, 0.0),)), "gamma")
    assert np.isfinite(found.margins).all() and found.boundaries == () and len(found.stable) == 1


def test_a_drift_has_no_safe_step_size_and_no_settled_scatter() -> None:
    """γ = 1 without end: constants are nobody's error, and the reward adds up for ever."""
    mdp = FiniteMDP.from_arrays([[[0.5, 0.5], [0.5, 0.5]]], [[1.0], [2.0]])
    problem = Problem.from_mdp(mdp, np.eye(2), gamma=1.0)
    for sampling in ("expected", "iid", "markov"):
        found = diagnose(problem, sampling=sampling)  # type: ignore[arg-type]
        assert found.verdict == "neutral" and found.drift > 0 and found.step_size_bound == 0.0
        radius = found.second_moment_radius
        assert radius is None or radius == pytest.approx(1.0, abs=1e-14)  # LAPACK's last bit depends on the processor
        assert "drift" in found.explain()
        assert not re.search("settles|every step size below|No step size", found.explain())


def test_a_power_that_overflows_is_named() -> None:
    with pytest.raises(ValueError, match="more than float64 holds"):
        diagnose(one_state(), "hard-target", 1e6)
    found = scan(one_state(), "period", step_size=1e6)
    assert np.isfinite(found.margins).all() and (found.margins < 0).all()
    assert run(one_state(), "hard-target", 300, 1e6).diverged.all()


@pytest.mark.parametrize("name", ["residual-adaptive", "projected-target"])
def test_resting_on_an_unstable_point_is_no_convergence(name: str) -> None:
    """Without rewards 0 is a fixed point at every step size, and one that starts there stays."""
    found = diagnose(one_state(0.0, weight=0.0), name, 1e6)
    assert found.verdict == "diverges" and not found.converges and found.spectral_radius > 1
    assert "only there" in found.explain() and "halves" not in found.explain()
    assert diagnose(one_state(0.0, weight=0.0), name).converges


def test_features_too_small_to_learn_from_are_neutral() -> None:
    found = diagnose(one_state(x=((1e-9,),)), "residual-adaptive")
    assert found.verdict == "neutral" and found.explain()
    assert diagnose(one_state(x=((1e-9,),))).verdict == "neutral"


@pytest.mark.parametrize("dense", [True, False])
def test_sums_without_end_and_discount_are_refused(dense: bool) -> None:
    """Rounding may hide that I − P is singular: what it then gives is of the order 1/ε."""
    for seed in range(5):
        P = np.random.default_rng(seed).dirichlet(np.ones(6), 6)
        with pytest.raises(ValueError, match="never ends"):
            resolvent(P if dense else sparse.csr_array(P), np.ones(6), 1.0)
    with pytest.raises(ValueError, match="never ends"):
        run(one_state(gamma=1.0), num_steps=3)
    assert resolvent(np.zeros((2, 2)), np.zeros(2), 1.0).tolist() == [0, 0]


def test_a_row_discount_ends_episodes_as_missing_mass_does() -> None:
    rng = np.random.default_rng(0)
    P, share = rng.dirichlet(np.ones(3), size=(2, 3)), rng.uniform(0.3, 1.0, size=(3, 2))
    start, policy = np.array([1.0, 0.0, 0.0]), rng.dirichlet(np.ones(2), 3)
    whole = FiniteMDP.from_arrays(P, np.zeros((3, 2)), start=start)
    short = FiniteMDP.from_arrays(P * share.T[:, :, None], np.zeros((3, 2)), substochastic=True, start=start)
    rows = replace(whole, discount=share[whole.s_tm1, whole.a_tm1])
    found = stationary_distribution(rows, policy)
    np.testing.assert_allclose(found, stationary_distribution(short, policy), atol=1e-12)
    assert np.abs(found - stationary_distribution(whole, policy)).max() > 0.05


ODD = {
    "one state": one_state(),
    "no discount on the future": one_state(gamma=0.0),
    "tiny features": replace(random_problem(0), features=1e-8 * random_problem(0).features),
    "huge features": replace(random_problem(0), features=1e8 * random_problem(0).features),
    "twice the same features": replace(
        random_problem(0), features=np.tile(random_problem(0).features, 2), initial_weights=np.ones(4)
    ),
    "more weights than states": random_problem(1, num_weights=7),
    "one state updated": replace(random_problem(2), state_distribution=np.array([1.0, 0.0, 0.0, 0.0])),
    "huge weights": replace(random_problem(3), initial_weights=np.array([1e12, -1e12])),
    "without rewards": replace(random_problem(4), initial_weights=np.zeros(2)),
}


@pytest.mark.parametrize("name", [one.name for one in METHODS if one.rows == "any"])
@pytest.mark.parametrize("odd", ODD)
def test_odd_problems_give_numbers(odd: str, name: str) -> None:
    problem = ODD[odd]
    if (odd, name) == ("huge features", "hard-target"):  # (1 − 1e15)^100
        with pytest.raises(ValueError, match="more than float64 holds"):
            diagnose(problem, name)
        return
    found = diagnose(problem, name)
    numbers = [found.spectral_radius, found.distance_to_singularity, found.drift, *np.abs(found.eigenvalues)]
    assert np.isfinite(numbers).all()
    assert found.fixed_point is None or np.isfinite(found.fixed_point).all()
    assert not re.search(r"\b(nan|inf)\b", found.explain())
    trained = run(problem, name, 50)
    assert np.isfinite(trained.rmsve).all() and np.isfinite(trained.rmspbe).all() and np.isfinite(trained.growth)


# --- odd requests -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("td", {"eta": -0.1}), ("td", {"lambda_": 1.5}), ("td", {"eta": float("inf")}), ("td", {"eta": float("nan")}),
        ("residual", {"phi": -1.0}), ("residual", {"phi": 2.0}), ("hard-target", {"period": 0}),
        ("hard-target", {"period": 2.5}), ("hard-target", {"period": float("nan")}), ("polyak-target", {"tau": 1.5}),
        ("polyak-target", {"tau": 0.0}), ("n-step", {"num_steps": float("inf")}), ("n-step", {"num_steps": 1e300}),
        ("n-step", {"num_steps": 0}), ("tdrc", {"beta": -1.0}), ("etd", {"beta": -0.5}), ("etd", {"beta": 2.0}),
        ("residual-adaptive", {"tracking": float("nan")}), ("residual-adaptive", {"tracking": 2.0}),
        ("tdc", {"beta_over_alpha": 0.0}), ("tdc", {"beta_over_alpha": 1e300}), ("v-trace", {"rho_bar": -1.0}),
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused_by_name(name: str, options: dict[str, float]) -> None:
    (option,) = options
    with pytest.raises(ValueError, match=option):
        diagnose(star(), name, **options)
    with pytest.raises(ValueError, match=option):
        run(star(), name, 10, options=options)


@pytest.mark.parametrize("bounds", [(0, 5), (5, 1), (1, float("inf")), (float("nan"), 3)])
def test_bounds_that_are_no_range_are_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="rising order"):
        scan(star(), "period", bounds=bounds)


def test_numbers_that_are_not_whole_are_refused() -> None:
    for value in (float("nan"), float("inf"), -float("inf")):
        with pytest.raises(ValueError, match="whole number"):
            check_whole("n", value)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seed must be a whole number"):
        run(star(), num_steps=1, sampling="iid", seed=1.5)  # type: ignore[arg-type]


# --- laws -------------------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.floats(-3, 3), st.sampled_from(["td", "residual", "tdc", "gtd2", "etd", "n-step", "polyak-target"]))
def test_the_units_of_the_features_do_not_matter(seed: int, exponent: float, name: str) -> None:
    """X → cX, w → w/c, α → α/c² changes no value."""
    c = 10.0**exponent
    problem = replace(random_problem(seed), step_size=0.05)
    other = replace(problem, features=c * problem.features, initial_weights=problem.initial_weights / c,
                    step_size=problem.step_size / c**2)  # fmt: skip
    one, two = diagnose(problem, name), diagnose(other, name)
    assert one.spectral_radius == pytest.approx(two.spectral_radius, rel=1e-9)
    assert one.verdict == two.verdict
    if one.fixed_point_error is not None and two.fixed_point_error is not None:
        assert one.fixed_point_error == pytest.approx(two.fixed_point_error, rel=1e-6, abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(SEEDS, st.permutations(range(4)), st.sampled_from(["expected", "iid", "markov"]))
@pytest.mark.slow
def test_the_names_of_the_states_do_not_matter(seed: int, order: list[int], sampling: str) -> None:
    problem, s = random_problem(seed), np.array(order)
    model = problem.mdp
    P = model.transition.toarray().reshape(4, 2, 4)[s][:, :, s].transpose(1, 0, 2)
    renamed = Problem.from_mdp(
        FiniteMDP.from_arrays(P, model.reward.reshape(4, 2)[s]), problem.features[s], gamma=problem.gamma,
        target_policy=problem.target_policy[s], behaviour_policy=problem.behaviour_policy[s],
        state_distribution=problem.state_distribution[s], initial_weights=problem.initial_weights,
    )  # fmt: skip
    one, two = (diagnose(p, sampling=sampling) for p in (problem, renamed))  # type: ignore[arg-type]
    assert one.spectral_radius == pytest.approx(two.spectral_radius, rel=1e-9)
    assert (one.second_moment_radius or 0.0) == pytest.approx(two.second_moment_radius or 0.0, rel=1e-9)
    assert one.fixed_point == pytest.approx(two.fixed_point, rel=1e-6, abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(SEEDS, st.sampled_from(["td", "tdc", "etd", "residual"]), st.sampled_from(["expected", "markov"]))
@pytest.mark.slow
def test_a_state_that_is_never_entered_does_not_matter(seed: int, name: str, sampling: str) -> None:
    problem = random_problem(seed)
    model = problem.mdp
    P = np.zeros((2, 5, 5))
    P[:, :4, :4] = model.transition.toarray().reshape(4, 2, 4).transpose(1, 0, 2)
    P[:, 4, 0] = 1.0
    more = Problem.from_mdp(
        FiniteMDP.from_arrays(P, np.vstack([model.reward.reshape(4, 2), [[9.0, 9.0]]]), start=[1.0, 0, 0, 0, 0]),
        np.vstack([problem.features, [[3.0, -3.0]]]), gamma=problem.gamma,
        target_policy=np.vstack([problem.target_policy, [[0.5, 0.5]]]),
        behaviour_policy=np.vstack([problem.behaviour_policy, [[0.5, 0.5]]]),
        state_distribution=np.append(problem.state_distribution, 0.0), initial_weights=problem.initial_weights,
    )  # fmt: skip
    one, two = (diagnose(p, name, sampling=sampling) for p in (problem, more))  # type: ignore[arg-type]
    assert one.verdict == two.verdict
    assert one.spectral_radius == pytest.approx(two.spectral_radius, rel=1e-9)
    assert (one.second_moment_radius or 0.0) == pytest.approx(two.second_moment_radius or 0.0, rel=1e-9)


@settings(max_examples=10, deadline=None)
@given(SEEDS, st.sampled_from(MEMORYLESS))
def test_moments_of_one_another(seed: int, name: str) -> None:
    """The i.i.d. mean is the expected update; a mean square grows at least like its mean; a chain tends to both."""
    problem, one = random_problem(seed), method(name)
    process = linear_process(problem)
    maps = update_maps(process, one, one.checked({}), 0.05)
    assert one.expected is not None
    M, c = one.expected(process, one.checked({})).at(np.zeros(1), 0.05)
    np.testing.assert_allclose(maps.mean()[0], M, atol=1e-12)
    np.testing.assert_allclose(maps.mean()[1], c, atol=1e-12)
    for sampling in ("iid", "markov"):
        assert second_moment_radius(maps, sampling) >= mean_radius(maps, sampling) ** 2 - 1e-12
    on_chain = replace(problem, state_distribution=stationary(problem))
    apart = []
    for alpha in (1e-3, 1e-4):
        maps = update_maps(
            linear_process(on_chain), one, one.checked({"tau": alpha} if name == "polyak-target" else {}), alpha
        )
        apart.append(abs(mean_radius(maps, "markov") - mean_radius(maps, "iid")))
    assert apart[1] < 0.02 * apart[0] + 1e-13  # of second order


def stationary(problem: Problem) -> np.ndarray:
    P_mu = np.asarray(linear_process(problem).P_mu)
    return np.linalg.matrix_power(P_mu, 10_000)[0] / np.linalg.matrix_power(P_mu, 10_000)[0].sum()


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from(["td", "residual", "tdc", "gtd2", "etd"]))
def test_the_verdict_turns_at_the_bound_and_the_fixed_point_is_reached(seed: int, name: str) -> None:
    problem = random_problem(seed, gamma=0.5)
    bound = diagnose(problem, name).step_size_bound
    assert bound is not None
    if bound == 0:
        return
    assert diagnose(problem, name, bound * (1 + 1e-6)).verdict == "diverges"
    below = diagnose(problem, name, bound * (1 - 1e-6))
    assert below.converges and below.spectral_radius < 1
    calm = diagnose(problem, name, bound / 2)
    trained = run(problem, name, 10**9, bound / 2)
    assert trained.weights[0] == pytest.approx(calm.fixed_point, rel=1e-6, abs=1e-6)
    assert trained.rmsve[-1, 0] == pytest.approx(calm.fixed_point_error, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("problem", [star(), kolter()], ids=["star", "kolter"])
@pytest.mark.slow
def test_every_remedy_converges_when_it_is_run(problem: Problem) -> None:
    remedies = prescribe(problem)
    assert len(remedies) > 5
    for remedy in remedies:
        trained = run(remedy.problem, remedy.method, 10**9, remedy.step_size, options=dict(remedy.options))
        assert not trained.diverged.any(), remedy.change
        assert trained.rmsve[-1, 0] == pytest.approx(remedy.diagnosis.fixed_point_error, rel=1e-3, abs=1e-3)


# --- pieces and words -------------------------------------------------------------------------------------------------


def test_leaps_look_between_their_ends() -> None:
    """θ turns by 45°: after 2, 4 and 8 updates nothing has happened, but at the sixth it meets the other piece."""
    turn = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])

    def at(theta: np.ndarray, step_size: float) -> tuple[np.ndarray, np.ndarray]:
        inside = theta[1] < -0.9 * np.linalg.norm(theta)  # downwards, within 25° of the vertical
        return (np.zeros((2, 2)), np.array([0.0, -1.0])) if inside else (turn, np.zeros(2))

    path = follow(Expected(2, at, linear=False), np.array([1.0, 0.0]), 0.1)
    assert path.outcome == "converges" and path.theta == pytest.approx(np.array([0.0, -1.0]))


def test_a_target_network_that_diverges_may_be_helped_by_larger_steps() -> None:
    unstable = diagnose(star(), "hard-target", 0.1, period=8)
    assert unstable.verdict == "diverges" and diagnose(star(), "hard-target", 0.5, period=8).converges
    assert "No step size helps" not in unstable.explain() and "no range from 0" in unstable.explain()
    assert "No step size helps" in diagnose(star()).explain()


def test_words_name_the_method_as_it_was_run() -> None:
    assert diagnose(star()).explain().startswith("TD(0) on baird with α = 0.01 diverges.")
    assert diagnose(star(), lambda_=0.95, eta=0.1).explain().startswith("TD(0.95) on baird with α = 0.01 (η = 0.1)")
    assert "(β/α = 10)" in diagnose(star(), "tdc").explain()
    assert "ETD(0, β) on baird with α = 0.01 (β = γ)" in diagnose(star(), "etd").explain()
    assert "doubles every 290 sweeps" in diagnose(star()).explain()
    assert "doubles every 290 updates" in diagnose(star(), sampling="iid").explain()
    assert "none of them contains" in diagnose(chattering(), "sarsa").explain()


# --- the monitor's rules ----------------------------------------------------------------------------------------------


def test_growth_that_slows_down_is_no_explosion() -> None:
    """log y = 6√(x/20): a straight line fits it at R² = .93; its second half rises .41 times as fast as its first."""
    x = np.arange(21.0)
    slowing = fit_growth(x, np.exp(6 * np.sqrt(x / 20)))
    assert slowing is not None and slowing.rise > 100 and slowing.fit > 0.9
    assert not slowing.sustained and not slowing.explosive
    steady = fit_growth(x, np.exp(6 * x / 20))
    assert steady is not None and steady.explosive


@pytest.mark.parametrize("plain", [True, False])
def test_a_step_size_is_too_large_only_for_plain_steps(plain: bool) -> None:
    """Adam scales its steps itself: there the kernel's bound on α says nothing."""
    found = SampleDiagnosis(
        num_samples=2, rank=2, step_size=3.0, growth=2.0, min_real_eigenvalue=0.5, largest_eigenvalue=1.0,
        step_size_bound=2.0, discount_share=1.0, overlap=0.1, largest_value=1.0, mean_error=1.0,
    )  # fmt: skip
    assert found.too_large_step and not found.unstable
    monitor = DivergenceMonitor(RunTraits(gamma=0.9, step_size=3.0, plain_steps=plain))
    with contextlib.suppress(UserWarning):
        for at in range(3):
            monitor._take(found, at)
    assert [alarm.kind for alarm in monitor.alarms] == (["kernel"] if plain else [])
