"""The lab's runs: published sweeps, the exact mean under Markov sampling, caps, and the transitions they are made of.

Mutants that die here: the ratio applied twice; targets of a sweep taken in place; a chain that draws its next row anew;
an end that hands out features; a seed that goes on past the cap; powers of an affine map without its constant; errors
weighted by something else than D.
"""

from __future__ import annotations

import numpy as np
import pytest

from neuralq.lab.linear.process import linear_process
from neuralq.lab.linear.sampling import stream
from neuralq.lab.methods import METHODS
from neuralq.lab.trial import affine_power, run
from neuralq.mdp import FiniteMDP
from neuralq_envs.counterexamples import Problem, star

# Sutton & Barto 2018, figure 11.2 right: equation 11.9 from the figure's initial weights, by an independent
# double-precision matrix iteration.
SWEEPS = {
    1: (1.025371, 9.999829, 1.075771),
    10: (1.256735, 9.998188, 1.766580),
    100: (3.894886, 9.971199, 9.627054),
    500: (26.620084, 9.484751, 76.829754),
    1000: (114.433716, 6.850030, 335.001209),
}
RMSVE = {0: 5.318432, 10: 6.469824, 100: 19.545527, 500: 135.290776, 1000: 581.355105}


@pytest.mark.parametrize("sweeps", sorted(SWEEPS))
def test_expected_td_on_the_star_is_the_books_figure(sweeps: int) -> None:
    upper, lower, shared = SWEEPS[sweeps]
    weights = run(star(), "td", num_steps=sweeps, step_size=0.01).weights[0]
    assert weights == pytest.approx(np.array([upper] * 6 + [lower, shared]), rel=1e-6)


def test_errors_of_the_books_figure() -> None:
    sweeps = run(star(), "td", num_steps=1000, step_size=0.01)
    at = dict(zip(sweeps.steps.tolist(), sweeps.rmsve[:, 0], strict=True))
    for step, value in RMSVE.items():
        assert at[step] == pytest.approx(value, rel=1e-6)
    # X has full row rank on the star, so Π = I; numbers of the same independent iteration.
    assert sweeps.rmspbe[0, 0] == pytest.approx(8.221408, rel=1e-6)
    assert sweeps.rmspbe[-1, 0] == pytest.approx(98.369515, rel=1e-6)


def test_markov_chains_have_their_own_mean() -> None:
    # The mean of 200,000 independent chains, and the exact one by a jump-linear recursion, after 100 updates from a
    # uniform start: 3.885836, 9.969783, 9.597074; the expected sweeps of equation 11.9 give 9.627 for the last.
    chains = run(star(), "td", num_steps=100, step_size=0.01, sampling="markov", num_seeds=20_000, seed=3)
    mean, error = chains.weights.mean(axis=0), chains.weights.std(axis=0) / np.sqrt(20_000)
    exact = np.array([3.885836] * 6 + [9.969783, 9.597074])
    assert (np.abs(mean - exact) < 4 * error).all()


def test_affine_power_is_repeated_application() -> None:
    rng = np.random.default_rng(0)
    M, c, theta = rng.normal(size=(3, 3)) / 2, rng.normal(size=3), rng.normal(size=3)
    slow = theta
    for _ in range(13):
        slow = M @ slow + c
    power, offset = affine_power((M, c), 13)
    assert power @ theta + offset == pytest.approx(slow, rel=1e-12)


@pytest.mark.parametrize("sampling", ["expected", "iid", "markov"])
def test_a_diverged_run_stops_at_the_cap_and_reports_numbers(sampling: str) -> None:
    num_seeds = 1 if sampling == "expected" else 7
    wild = run(star(), "td", num_steps=20_000, step_size=0.5, sampling=sampling, num_seeds=num_seeds)  # type: ignore[arg-type]
    assert wild.diverged.all()
    for table in (wild.rmsve, wild.rmspbe, wild.weights, wild.quantiles(of="rmspbe")):
        assert np.isfinite(table).all()
    assert (wild.rmsve[-1] == wild.cap).all()
    assert np.isfinite(wild.growth) and wild.growth > 1
    assert (np.abs(wild.weights) <= wild.cap).all()


def test_growth_is_the_leading_factor_and_long_runs_are_cheap() -> None:
    # 1.0023925 is the spectral radius of I − 0.01 A on the star, from its eigenvalue −0.2392504643.
    assert run(star(), "td", num_steps=10**7, step_size=0.01).growth == pytest.approx(1 + 0.01 * 0.2392504643, abs=1e-8)


def test_convergent_runs_settle() -> None:
    calm = run(star(), "residual", num_steps=1000, step_size=0.01)
    assert not calm.diverged.any()
    assert calm.rmsve[-1, 0] == pytest.approx(1.935014, rel=1e-6)  # an independent matrix iteration


def test_seeds_are_reproducible_and_different() -> None:
    one, again = (run(star(), "td", 50, sampling="markov", num_seeds=4, seed=5).weights for _ in range(2))
    other = run(star(), "td", 50, sampling="markov", num_seeds=4, seed=6).weights
    assert (one == again).all()
    assert not (one == other).any(axis=1).all()
    assert len({row.tobytes() for row in one}) == 4


def test_streams_follow_the_model() -> None:
    rng = np.random.default_rng(1)
    mdp = FiniteMDP.from_arrays(
        [[[0.0, 0.7], [0.0, 0.0]], [[0.5, 0.5], [0.0, 0.2]]], [[1.0, 2.0], [3.0, 4.0]], substochastic=True, start=[1, 0]
    )
    problem = Problem.from_mdp(mdp, np.array([[1.0], [5.0]]), gamma=0.9, target_policy=[[0.5, 0.5], [0.1, 0.9]],
                               behaviour_policy=[[0.25, 0.75], [0.5, 0.5]])  # fmt: skip
    process = linear_process(problem)
    samples, n = stream(process, "markov", 4000, rng), 0
    counts, before = np.zeros((2, 3)), None
    for _, sample in zip(range(60), samples, strict=False):
        if before is not None:
            assert (sample.begins == (before.next_row < 0)).all()
            on = before.next_row >= 0
            assert (sample.row[on] == before.next_row[on]).all()
            assert (sample.row[~on] == 0).all()  # episodes start in state 0
        ended = sample.next_row < 0
        assert (sample.x_next[ended] == 0).all() and (sample.discount[ended] == 0).all()
        assert (sample.x_next[~ended, 0] == np.array([1.0, 5.0])[sample.next_row[~ended]]).all()
        np.add.at(counts, (sample.row, sample.next_row), 1)
        n += len(sample.row)
        before = sample
    chain = counts / counts.sum(axis=1, keepdims=True)
    # by hand, with μ: from 0: action 0 (.25) goes to 1 w.p. .7, action 1 (.75) to 0 or 1 w.p. .5
    by_hand = np.array([[0.375, 0.55, 0.075], [0.0, 0.1, 0.9]])
    se = np.sqrt(by_hand * (1 - by_hand) / counts.sum(axis=1, keepdims=True))
    assert (np.abs(chain - by_hand) <= 4 * se + 1e-12).all()
    assert process.P_mu == pytest.approx(by_hand[:, :2])
    assert process.P == pytest.approx(np.array([[0.25, 0.6], [0.0, 0.18]]))
    # d = d P with restarts in state 0: d0 = d0 (.375 + .075) + d1 .9 and d0 + d1 = 1, so d0 = .9 / 1.45
    assert process.D == pytest.approx([0.9 / 1.45, 0.55 / 1.45])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "sarsa-2"}, "there is no method 'sarsa-2'"),
        ({"options": {"phi": 0.5}}, "td has no option 'phi'; it has lambda_, eta"),
        ({"num_seeds": 3}, "num_seeds must be 1"),
        ({"step_size": 0.0}, "step_size must be a finite number above 0"),
        ({"sampling": "on-policy"}, "sampling must be one of"),
    ],
)
def test_mistakes_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(star(), **arguments)  # type: ignore[arg-type]


def test_ratios_need_actions_that_are_tried() -> None:
    mdp = FiniteMDP.garnet(3, 2, 2, seed=0)
    never = np.tile([0.0, 1.0], (3, 1))
    pairs = Problem.from_mdp(
        mdp, np.eye(6).reshape(3, 2, 6), gamma=0.9, target_policy=1 - never, behaviour_policy=never
    )
    with pytest.raises(ValueError, match="never takes action 0 in state 0"):
        run(pairs, "td", 10, sampling="iid")
    assert np.isfinite(run(pairs, "expected-sarsa", 10, sampling="iid").weights).all()


def test_every_method_has_a_name_of_its_own() -> None:
    names = [one.name for one in METHODS]
    assert len(set(names)) == len(names)
