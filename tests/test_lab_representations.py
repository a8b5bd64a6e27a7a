"""Every representation on problems of every kind: states and pairs, with and without ends, prediction and control.

The sweeps of Baird's star for control are an independent double-precision iteration of its expected Q-learning update.

Mutants that die here: the ratio in a problem about Q · weights of pairs that forget the state distribution · the mean
of the next values where the maximum belongs · initial weights that are ignored · networks that see the
features where states were asked for.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuralq.exact import solve
from neuralq.lab.networks.expected import expected_backup, expected_td_step
from neuralq.lab.networks.representations import (
    REPRESENTATIONS,
    PairLinearQ,
    predict_representations,
    run_representations,
)
from neuralq.lab.problems import problem as problem_of
from neuralq.mdp import FiniteMDP
from neuralq.q import MLP
from neuralq_envs.counterexamples import Problem, star

EXACT = ("table", "linear")


@pytest.mark.parametrize(("name", "sweeps"), [
    ("baird-control", {1000: 38.0893}), ("baird-control-uniform", {1000: 163.305}),
])  # fmt: skip
def test_q_learning_on_the_star_sweep_by_sweep(name: str, sweeps: dict[int, float]) -> None:
    problem = problem_of(name)
    q = PairLinearQ(problem.num_weights, 2)
    with torch.no_grad():
        q.weight.copy_(torch.tensor(problem.initial_weights))
    backup = expected_backup(problem, torch.tensor(problem.features))
    for k in range(1, max(sweeps) + 1):
        expected_td_step(q, backup, 0.01)
        if k in sweeps:
            with torch.no_grad():
                assert float(q.all(backup.observations).abs().max()) == pytest.approx(sweeps[k], rel=1e-5)


@pytest.mark.parametrize(("name", "step_size", "factor"), [
    ("w2w", 0.1, 1 - 0.1 * (5 - 0.99 * 6) / 2), ("w2w-single", 0.1, 1 + 0.1 * (2 * 0.99 - 1)), ("emphatic", 0.1, 1.02),
])  # fmt: skip
def test_one_weight_grows_by_the_factor_of_the_textbook(name: str, step_size: float, factor: float) -> None:
    """Sutton & Barto 2018, exercise 11.1 and equation 11.10 (1 − αA with A by hand); Sutton, Mahmood & White 2016."""
    problem = problem_of(name)
    (found,) = run_representations(problem, 100, step_size, representations=("linear",))
    gamma, A = problem.gamma, None
    if name == "w2w":  # (5 − γ(6 − 4ε)) / 2 with the problem's own γ and ε
        epsilon = float(problem.mdp.termination[1])
        A = (5 - gamma * (6 - 4 * epsilon)) / 2
    expected = factor if A is None else 1 - step_size * A
    assert (found.verdict, found.prediction_scope) == ("diverges", "global")
    assert found.predicted_growth == found.kernel_growth == pytest.approx(expected, rel=1e-9)
    assert found.measured_growth == pytest.approx(expected, rel=1e-6)


def test_fixed_points_are_those_of_the_oracle_and_of_the_papers() -> None:
    # Features that depend on each other, off-policy: w_TD and RMSVE by an independent double-precision solution.
    (found,) = run_representations(problem_of("walk-dependent"), 2000, 0.9, representations=("linear",))
    assert found.exact_values[1:6] == pytest.approx([-0.269173, 0.218045, 0.542857, 0.759398, 0.903759], abs=2e-6)
    assert found.rmsve[-1] == pytest.approx(0.092986, abs=2e-6)
    # A-presplit (Sutton & Barto 2018, exercise 11.3): the shared feature gets 1/2, B 1 and C 0.
    (split,) = run_representations(problem_of("a-presplit"), 500, 1.0, representations=("linear",))
    assert sorted(set(np.round(split.values, 4).tolist())) == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("name", ["walk5", "a-split", "gordon-averager", "w2w-on-policy"])
def test_the_table_reaches_the_exact_answer_at_its_rate(name: str) -> None:
    problem = problem_of(name)
    (found,) = run_representations(problem, 1000, 1.0, representations=("table",))
    assert found.rmsve[-1] < 1e-2 * found.rmsve[0]
    weighted = problem.state_distribution > 0
    assert found.values[weighted] == pytest.approx(found.exact_values[weighted], abs=0.02)


def test_the_table_learns_q_star_in_control_and_the_error_is_that_of_pairs() -> None:
    mdp = FiniteMDP.garnet(5, 3, 2, seed=1)
    plain = Problem.from_mdp(mdp, np.eye(15).reshape(5, 3, 15), gamma=0.8)
    problem = Problem(**{**vars(plain), "control": True, "state_distribution": np.full(5, 0.2)})
    table, linear = run_representations(problem, 1500, 3.0, representations=EXACT)
    answer = solve(mdp, 0.8)
    assert table.values == pytest.approx(answer.v, abs=1e-6) and table.exact_values == pytest.approx(answer.v)
    assert (table.verdict, table.prediction_scope) == ("shrinks", "local")
    assert linear.rmsve == pytest.approx(table.rmsve, abs=3e-4)  # one-hot pairs are a table; the start differs by 1e-4
    start = np.sqrt((1 / 15) * ((1.0 - answer.q) ** 2).sum())
    assert linear.rmsve[0] == pytest.approx(start, rel=1e-12)


@pytest.mark.slow
def test_networks_learn_the_chain_and_see_what_was_asked_for() -> None:
    results = run_representations(problem_of("walk5"), 800, 0.8, body=MLP(hidden=(12,), activation="tanh"))
    assert [found.representation for found in results] == list(REPRESENTATIONS)
    for found in results:
        assert found.rmsve[-1] < 0.05 and not found.stopped_on_cap
    by_features, by_states = (
        run_representations(star(), 50, representations=("separate",), observations=kind)[0]  # type: ignore[arg-type]
        for kind in ("features", "states")
    )
    assert not np.array_equal(by_features.rmsve, by_states.rmsve)
    # Where features are one-hot, both are the same.
    tabular = problem_of("baird-tabular")
    same = [
        run_representations(tabular, 50, representations=("separate",), observations=kind)[0].rmsve  # type: ignore[arg-type]
        for kind in ("features", "states")
    ]
    assert np.array_equal(*same)


@pytest.mark.parametrize("name", ["baird", "baird-control", "kolter", "walk5", "boyan", "collision", "garnet", "hall"])
def test_predictions_are_those_of_the_run_and_nothing_is_infinite(name: str) -> None:
    problem = problem_of(name)
    results = run_representations(problem, 20)
    for found, told in zip(results, predict_representations(problem), strict=True):
        assert (told.growth, told.scope, told.verdict, told.kernel_growth) == (
            found.predicted_growth, found.prediction_scope, found.verdict, found.kernel_growth)  # fmt: skip
        for numbers in (found.rmsve, found.values, found.exact_values, [found.rise, found.measured_growth]):
            assert np.isfinite(numbers).all()


def test_on_policy_learning_is_not_said_to_grow() -> None:
    told = predict_representations(problem_of("walk5"))
    assert [one.verdict for one in told[:2]] == ["converges", "converges"]
    assert {one.verdict for one in told[2:]} <= {"shrinks", "unclear"}
    assert all(one.kernel_growth < 1 for one in told)


def test_a_value_function_that_is_not_linear_is_learned_by_the_others() -> None:
    problem = problem_of("spiral")
    with pytest.raises(ValueError, match="'spiral' is not linear in its parameters; leave 'linear' out"):
        run_representations(problem, 10)
    (table,) = run_representations(problem, 10, representations=("table",))
    assert table.verdict == "converges"


def test_broken_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="representations must be one of 'table', 'linear'"):
        run_representations(star(), 10, representations=("tabel",))
    with pytest.raises(ValueError, match="step_size must be"):
        predict_representations(star(), -1.0)
    with pytest.raises(ValueError, match="num_steps must be"):
        run_representations(star(), 3)
