"""Networks on finite problems: kernel, conditions, curvature against hand arithmetic, finite differences, the oracle.

Mutants that die here: D on the wrong side of the kernel · γ missing from the coupling · P transposed · the kernel of
all pairs where only the target's are coupled · a Jacobian in another order than the parameters · Achiam's row sum
with its diagonal · with 1 − γ where 1 + γ belongs · a norm over columns · a terminal state that is bootstrapped from
· ratios in the weights of a problem about Q · a greedy policy that counts illegal actions · zeros of redundant
weights counted as neutral · the curvature with the wrong sign, or without the weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from neuralq.exact import predict_expected_td, td_operator
from neuralq.exact.evaluation import policy_process
from neuralq.lab.networks.diagnosis import diagnose_network
from neuralq.lab.networks.expected import expected_backup, expected_td_step, local_growth, local_jacobian
from neuralq.lab.networks.representations import PairLinearQ
from neuralq.lab.networks.tangent_kernel import (
    local_system,
    local_verdict,
    observations_of,
    reduced_operator,
    value_jacobian,
)
from neuralq.lab.problems import problem as problem_of
from neuralq.mdp import FiniteMDP
from neuralq.q import MLP, ActionInputQ, ActionOutputQ, LinearQ, MaskedQ, SeparateQ, TableQ
from neuralq_envs.counterexamples import Problem, star

LAYOUTS = [ActionInputQ, SeparateQ, ActionOutputQ]
Floats = NDArray[np.float64]


def network(layout: Any = ActionOutputQ, num_actions: int = 1, seed: int = 0, width: int = 6, inputs: int = 8) -> Any:
    body = MLP(hidden=(width,), activation="tanh")
    return layout((inputs,), num_actions, body=body, rng=seed, dtype=torch.float64)


def linear_star() -> LinearQ:
    q = LinearQ(8, 1)
    with torch.no_grad():
        q.weight[0] = torch.tensor(star().initial_weights)
    return q


def flat(q: nn.Module) -> Floats:
    return torch.nn.utils.parameters_to_vector(q.parameters()).detach().numpy().copy()


def load(q: nn.Module, theta: Floats) -> None:
    with torch.no_grad():
        torch.nn.utils.vector_to_parameters(torch.from_numpy(theta.copy()), q.parameters())


def by_differences(q: Any, s: torch.Tensor, a: torch.Tensor) -> Floats:
    """J by central differences, ``[N, p]``."""
    theta, columns = flat(q), []
    for h in 1e-6 * np.eye(len(theta)):
        values = []
        for sign in (1, -1):
            load(q, theta + sign * h)
            with torch.no_grad():
                values.append(q.at(s, a).numpy().copy())
        columns.append((values[0] - values[1]) / 2e-6)
    load(q, theta)
    return np.array(columns).T


def nonzero(eigenvalues: Any) -> list[complex]:
    kept = eigenvalues[np.abs(eigenvalues) > 1e-9 * np.abs(eigenvalues).max()]
    return sorted(np.round(kept, 8).tolist(), key=lambda z: (z.real, z.imag))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_jacobian_is_that_of_finite_differences_in_the_order_of_the_parameters(layout: Any) -> None:
    q = network(layout, num_actions=3, inputs=4)
    rng = np.random.default_rng(0)
    s, a = torch.from_numpy(rng.normal(size=(5, 4))), torch.tensor([0, 1, 2, 2, 0])
    assert value_jacobian(q, s, a).numpy() == pytest.approx(by_differences(q, s, a), abs=1e-8)
    masked = torch.cat([s, torch.tensor([[1.0, 0, 1]] * 5)], 1)
    rows = value_jacobian(MaskedQ(q, (4,)), masked, a).numpy()
    expected = by_differences(q, s, a)
    expected[1] = 0.0  # an illegal action is −∞ whatever the weights are
    assert rows == pytest.approx(expected, abs=1e-8)


def neural_tangent_kernel(q: nn.Module, s: torch.Tensor, a: torch.Tensor) -> Any:
    """K = J Jᵀ (Jacot, Gabriel & Hongler 2018)."""
    jacobian = value_jacobian(q, s, a)
    return (jacobian @ jacobian.T).numpy()


def test_the_kernel_of_linear_features_is_x_xt_and_of_a_table_the_identity() -> None:
    x = star().features
    zeros = torch.zeros(7, dtype=torch.int64)
    assert neural_tangent_kernel(LinearQ(8, 1), torch.tensor(x), zeros) == pytest.approx(x @ x.T)
    assert np.array_equal(neural_tangent_kernel(TableQ(7, 2), torch.arange(7), zeros), np.eye(7))
    # Q-functions of pairs: features of different actions share nothing in LinearQ, all weights in PairLinearQ.
    mixed = torch.tensor([0, 1, 0, 1, 0, 1, 0])
    same = (mixed[:, None] == mixed[None]).numpy()
    assert neural_tangent_kernel(LinearQ(8, 2), torch.tensor(x), mixed) == pytest.approx(np.where(same, x @ x.T, 0))


def test_the_star_with_its_features() -> None:
    found = diagnose_network(linear_star(), star())
    assert (found.scope, found.verdict, found.num_cells, found.num_parameters, found.rank) == (
        "local",
        "grows",
        7,
        8,
        7,
    )
    # Sutton & Barto 2018, figure 11.2; eigenvalues of A and of I − .01 A by an independent double-precision iteration.
    assert found.kernel_growth == pytest.approx(1.0023925, abs=5e-8)
    assert found.growth == pytest.approx(1.0023925, abs=5e-8)
    assert found.eigenvalues.real == pytest.approx([-0.2392504643, -0.0221781] + [4 / 7] * 5, abs=1e-7)
    assert found.kernel_rate == pytest.approx(0.2392504643, abs=1e-9) == found.rate
    assert found.step_size_bound == 0 and not found.oscillates
    assert found.doubling_time == pytest.approx(np.log(2) / np.log(1.0023925046), rel=1e-6)
    # By hand: K is 5 on the diagonal, 1 between upper states, 2 between an upper and the lower. Row of the lower state
    # of U: 6 · .02/7 + |1 − .01/7 (5 − .99 (6 · 2 + 5))| = 1 + .2383/7; those of the upper ones: 1 + .0988/7.
    assert found.kernel_norm == pytest.approx(1 + 0.2383 / 7, rel=1e-12)
    # Achiam: (1 + γ)(6 · 2) against (1 − γ) 5 in the row of the lower state: two orders of magnitude, for a growth of
    # .24% per step. The factor: 1 − .01/7 (.01 · 5 − 1.99 · 12).
    assert not found.achiam_holds
    assert found.achiam_excess == pytest.approx(1.99 * 12 / 0.05, rel=1e-9)
    assert found.achiam_factor == pytest.approx(1 - 0.01 / 7 * (0.05 - 1.99 * 12), rel=1e-12)
    assert found.largest_error == pytest.approx(0.99 * 12 - 3)  # 3 at the top, 12 below
    for words in ("no step size", "478 times", "sufficient and not necessary", "present weights"):
        assert words in found.explain()


def test_a_table_is_a_contraction_by_both_criteria() -> None:
    found = diagnose_network(TableQ(7, 2), star())
    rate = 1 - 0.01 * 0.01 / 7  # 1 − α (1 − γ) d
    assert found.achiam_holds and found.achiam_excess == 0 and found.verdict == "shrinks"
    assert found.achiam_factor == pytest.approx(rate, abs=1e-15)
    assert found.kernel_growth == pytest.approx(rate, abs=1e-14)
    assert found.step_size_bound == pytest.approx(14, rel=1e-9)  # upper states: eigenvalue 1/7
    assert "shrinks" in found.explain() and "Every value is moved more by its own" in found.explain()
    too_large = diagnose_network(TableQ(7, 2), star(), step_size=7.0)  # α K_ii d_i = 1: the published proof stops here
    assert not too_large.achiam_holds and "step size is too large" in too_large.explain()


@pytest.mark.parametrize(("name", "smallest"), [
    ("baird-control", -0.0341786), ("baird-control-uniform", -0.1196252), ("emphatic", -0.2),
])  # fmt: skip
def test_published_eigenvalues_of_control_and_emphasis(name: str, smallest: float) -> None:
    """The star for Q-learning: 1/7 and 1/2 of the star's eigenvalue, by an independent matrix; emphatic: by hand."""
    problem = problem_of(name)
    q: Any = PairLinearQ(problem.num_weights, 2) if problem.learns_q else LinearQ(problem.num_weights, 1)
    with torch.no_grad():
        q.weight.copy_(torch.tensor(problem.initial_weights).expand_as(q.weight))
    found = diagnose_network(q, problem, observations=torch.tensor(problem.features))
    assert found.eigenvalues[0].real == pytest.approx(smallest, abs=1e-7)
    assert found.verdict == "grows"


@pytest.mark.parametrize(
    "name", ["walk5", "walk-dependent", "boyan", "collision", "garnet", "a-presplit", "w2w-on-policy"]
)
def test_linear_features_agree_with_the_oracle_also_with_terminal_states(name: str) -> None:
    problem = problem_of(name)
    q = LinearQ(problem.num_weights, 1)
    found = diagnose_network(q, problem)
    process = policy_process(problem.mdp, problem.target_policy)
    A, b = td_operator(*process, problem.features, problem.state_distribution, problem.gamma)
    expected = predict_expected_td(A, problem.step_size)
    assert found.kernel_growth == pytest.approx(expected.spectral_radius, rel=1e-9)
    assert found.growth == pytest.approx(expected.spectral_radius, rel=1e-8)
    assert nonzero(found.eigenvalues) == pytest.approx(nonzero(expected.eigenvalues), abs=1e-7)
    backup = expected_backup(problem, torch.tensor(problem.features), state_values=True)
    expected_td_step(q, backup, 1.0)  # from 0 the first sweep adds b
    assert q.weight[0].detach().numpy() == pytest.approx(b, abs=1e-12)


@pytest.mark.parametrize(("layout", "name"), [(ActionOutputQ, "baird"), (ActionInputQ, "garnet"), (SeparateQ, "walk5")])
def test_values_and_weights_have_the_same_nonzero_eigenvalues(layout: Any, name: str) -> None:
    problem = problem_of(name)
    q = network(layout, problem.mdp.num_actions, inputs=problem.num_weights, width=3)
    system = local_system(q, expected_backup(problem, observations_of(problem)))
    J, D = system.jacobian, np.diag(system.weights)
    ahead = np.eye(len(D)) - problem.gamma * system.transitions
    assert system.kernel == pytest.approx(J @ J.T)
    of_values = nonzero(np.linalg.eigvals(system.kernel @ D @ ahead))
    assert of_values == pytest.approx(nonzero(np.linalg.eigvals(J.T @ D @ ahead @ J)), abs=1e-7)
    assert of_values == pytest.approx(nonzero(np.linalg.eigvals(reduced_operator(system))), abs=1e-7)
    assert system.drift == pytest.approx(system.kernel @ D @ ahead)


@pytest.mark.parametrize("name", ["baird", "baird-control", "walk-tabular", "garnet"])
def test_one_step_is_the_kernel_times_the_errors_up_to_the_square_of_the_step(name: str) -> None:
    problem = problem_of(name)
    seen = observations_of(problem)
    mismatch = []
    for alpha in (1e-3, 1e-4, 1e-5):
        q = network(num_actions=problem.mdp.num_actions, inputs=seen.shape[1], seed=3)
        backup = expected_backup(problem, seen)
        system = local_system(q, backup)
        expected_td_step(q, backup, alpha)
        with torch.no_grad():
            moved = q.all(seen).numpy()[system.states, system.actions] - system.values
        told = alpha * system.kernel @ (system.weights * system.errors)
        mismatch.append(np.linalg.norm(moved - told) / np.linalg.norm(moved))
    assert mismatch[0] / mismatch[1] == pytest.approx(10, rel=0.05)
    assert mismatch[1] / mismatch[2] == pytest.approx(10, rel=0.05)
    assert mismatch[2] < 1e-4


@pytest.mark.parametrize("name", ["baird", "baird-control", "walk5"])
def test_the_whole_derivative_is_the_kernel_part_and_the_curvature(name: str) -> None:
    problem = problem_of(name)
    seen = observations_of(problem)
    q = network(num_actions=problem.mdp.num_actions, inputs=seen.shape[1], seed=1)
    backup = expected_backup(problem, seen)
    system = local_system(q, backup)
    theta, names = torch.from_numpy(flat(q)), [n for n, _ in q.named_parameters()]
    sizes = [p.numel() for p in q.parameters()]

    def weighted(at: torch.Tensor) -> torch.Tensor:
        parts = dict(zip(names, at.split(sizes), strict=True))
        shaped = {n: parts[n].reshape(p.shape) for n, p in q.named_parameters()}
        values = torch.func.functional_call(_Whole(q), {f"q.{n}": p for n, p in shaped.items()}, (seen,))
        picked = values[torch.from_numpy(system.states), torch.from_numpy(system.actions)]
        return (torch.from_numpy(system.weights * system.errors) * picked).sum()

    curvature = torch.autograd.functional.hessian(weighted, theta).numpy()
    J, ahead = system.jacobian, np.eye(len(system.weights)) - problem.gamma * system.transitions
    kernel_part = -J.T @ np.diag(system.weights) @ ahead @ J
    assert local_jacobian(q, backup) == pytest.approx(kernel_part + curvature, abs=1e-10)
    assert np.abs(curvature).max() > 1e-3


class _Whole(nn.Module):
    def __init__(self, q: nn.Module) -> None:
        super().__init__()
        self.q = q

    def forward(self, s: torch.Tensor) -> torch.Tensor:
        values: torch.Tensor = self.q.all(s)  # type: ignore[operator]
        return values


def test_the_derivative_in_control_is_that_of_finite_differences() -> None:
    problem = problem_of("baird-control")
    seen = observations_of(problem)
    q = network(num_actions=2, inputs=seen.shape[1], seed=2, width=2)
    backup = expected_backup(problem, seen)
    model, theta = problem.mdp, flat(q)
    weights = problem.state_distribution[:, None] * problem.behaviour_policy

    def update(at: Floats) -> Floats:
        load(q, at)
        with torch.no_grad():
            values = q.all(seen).numpy()
        delta = np.zeros((7, 2))
        for row in range(model.num_rows):
            s, a = model.s_tm1[row], model.a_tm1[row]
            ahead = model.transition[[row]].toarray()[0] @ values.max(1)
            delta[s, a] = model.reward[row] + problem.gamma * ahead - values[s, a]
        pairs = np.divmod(np.arange(14), 2)
        slope = value_jacobian(
            q, seen[pairs[0]], torch.from_numpy(pairs[1])
        ).numpy()  # itself held to differences above
        found: Floats = slope.T @ (weights * delta).reshape(-1)
        return found

    steps = 1e-5 * np.eye(len(theta))
    expected = np.array([(update(theta + h) - update(theta - h)) / 2e-5 for h in steps]).T
    load(q, theta)
    assert local_jacobian(q, backup) == pytest.approx(expected, abs=1e-8)


def test_the_kernel_alone_is_not_enough_where_errors_are_large() -> None:
    found = diagnose_network(network(seed=3, width=16), star())
    assert 0 < found.kernel_rate < 0.1 and found.rate is not None and found.rate > 5 * found.kernel_rate
    apart = diagnose_network(network(seed=2, width=8), star())  # one says shrinks, the other says separates
    assert apart.kernel_rate < 0 and apart.rate is not None and apart.rate > 0.1
    assert apart.verdict == "unclear" and "runs from nearby weights separate" in apart.explain()
    alone = diagnose_network(network(seed=2, width=8), star(), curvature=False)
    assert (alone.verdict, alone.growth, alone.rate) == ("shrinks", None, None)
    assert "curvature of the network was left out" in alone.explain()
    assert [local_verdict(1.0), local_verdict(1 - 1e-6, 1.0)] == ["unclear", "unclear"]


def test_the_growth_with_curvature_is_that_of_the_sweeps_own_derivative() -> None:
    q = network(LAYOUTS[0], num_actions=2, seed=5)
    found = diagnose_network(q, star())
    backup = expected_backup(star(), observations_of(star()))
    assert found.growth == pytest.approx(local_growth(q, backup, 0.01), rel=1e-9)


def test_achiams_factor_bounds_the_step_and_holds_for_the_maximum_too() -> None:
    rng = np.random.default_rng(0)
    held = 0
    for seed in range(30):
        mdp = FiniteMDP.garnet(4, 2, 2, seed=seed)
        features = np.eye(8).reshape(4, 2, 8) + 0.01 * rng.normal(size=(4, 2, 8))
        pairs = Problem.from_mdp(mdp, features, gamma=0.5)
        problem = Problem(**{**vars(pairs), "control": True, "state_distribution": np.full(4, 0.25)})
        q = PairLinearQ(8, 2)
        found = diagnose_network(q, problem, 0.5, observations=torch.tensor(features))
        assert found.kernel_norm <= found.achiam_factor + 1e-12
        held += found.achiam_holds
        backup = expected_backup(problem, torch.tensor(features))
        ends = []
        for _ in range(2):  # two value functions come together, though their greedy policies differ
            with torch.no_grad():
                q.weight.copy_(torch.from_numpy(rng.normal(size=8)))
            before = expected_td_step(q, backup, 0.5)
            with torch.no_grad():
                ends.append((before, q.all(backup.observations).clone()))
        apart = [float((x - y).abs().max()) for x, y in zip(*ends, strict=True)]
        assert apart[1] <= found.achiam_factor * apart[0] + 1e-12
    assert held == 30


def test_a_cell_that_is_never_updated_fails_the_condition_and_leaves_no_infinity_in_words() -> None:
    found = diagnose_network(network(inputs=1, seed=1), problem_of("w2w-single"))
    assert found.achiam_excess == np.inf and not found.achiam_holds
    assert "never updated itself" in found.explain() and "inf" not in found.explain()
    assert found.num_cells == 2 and found.rank == 1


def test_only_pairs_that_matter_are_cells() -> None:
    backup = expected_backup(star(), torch.arange(7))
    assert local_system(TableQ(7, 2), backup).actions.tolist() == [1] * 7
    chosen = problem_of("baird-control")
    assert len(local_system(TableQ(7, 2), expected_backup(chosen, torch.arange(7))).states) == 14


def test_the_greedy_policy_takes_legal_actions_and_the_lowest_of_several() -> None:
    mdp = FiniteMDP.from_functions(
        2, 3, lambda s: [1, 2] if s == 0 else [0, 1, 2], lambda s, a: [(1.0, 1 - s, 0.0, False)]
    )
    plain = Problem.from_mdp(mdp, np.ones((2, 3, 1)), gamma=0.9)
    backup = expected_backup(Problem(**{**vars(plain), "control": True}), torch.arange(2))
    q = torch.tensor([[9.0, 1.0, 2.0], [4.0, 4.0, 1.0]], dtype=torch.float64)
    assert backup.policy(q).tolist() == [[0, 0, 1], [1, 0, 0]]
    assert backup.errors(q)[0].tolist() == pytest.approx([0.0, 0.9 * 4 - 1, 0.9 * 4 - 2])
    exploring = expected_backup(Problem(**{**vars(plain), "control": True, "exploration": 0.5}), torch.arange(2))
    assert exploring.update_weights(q)[0].tolist() == pytest.approx([0.0, 0.125, 0.375])  # half of the time in state 0


@pytest.mark.parametrize("state_values", [False, True])
def test_terminal_states_are_worth_nothing_whatever_the_network_says(state_values: bool) -> None:
    problem = problem_of("walk5")
    outputs = 1 if state_values else problem.mdp.num_actions
    backup = expected_backup(problem, observations_of(problem), state_values=state_values)
    values = torch.ones(problem.mdp.num_states, outputs, dtype=torch.float64)
    other = values.clone()
    other[torch.from_numpy(problem.mdp.is_terminal)] = 100.0
    assert other.max() == 100
    assert torch.equal(backup.state_values(values), backup.state_values(other))
    assert torch.equal(backup.errors(values), backup.errors(other))
    system = local_system(network(inputs=problem.num_weights, num_actions=outputs), backup)
    assert not problem.mdp.is_terminal[system.states].any()


def test_values_of_pairs_need_no_ratio_for_their_own_action() -> None:
    problem = problem_of("baird-control")
    weights = expected_backup(problem, torch.arange(7)).weights
    assert weights[0].tolist() == pytest.approx([6 / 49, 1 / 49])


def test_a_diagnosis_only_reads_and_takes_single_precision() -> None:
    wide = network(num_actions=2)
    single = ActionOutputQ((8,), 2, body=MLP(hidden=(6,), activation="tanh"), rng=0)
    for p in single.parameters():
        p.grad = torch.ones_like(p)
    before = flat(single)
    found = diagnose_network(single, star())
    assert np.array_equal(flat(single), before) and all(bool((p.grad == 1).all()) for p in single.parameters())
    expected = diagnose_network(wide, star())
    assert found.kernel_growth == pytest.approx(expected.kernel_growth, abs=1e-6)
    assert found.growth == pytest.approx(expected.growth, abs=1e-5)
    assert found.rank == expected.rank


def test_broken_arguments_are_named() -> None:
    with pytest.raises(
        ValueError, match=r"one output for each of 2 actions \(or 1 for state values\), got num_actions=3"
    ):
        diagnose_network(network(num_actions=3), star())
    with pytest.raises(ValueError, match="one output for each of 2 actions, got num_actions=1"):
        diagnose_network(network(), problem_of("baird-control"))
    with pytest.raises(ValueError, match="step_size must be"):
        diagnose_network(linear_star(), star(), step_size=0.0)
    with pytest.raises(ValueError, match="one row for each of 7 states, got 3"):
        diagnose_network(linear_star(), star(), observations=torch.zeros(3, 8))
    with pytest.raises(ValueError, match="observations must be 'features' or 'states'"):
        observations_of(star(), "pixels")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="give the representation one output per action"):
        expected_backup(problem_of("baird-control"), torch.arange(7), state_values=True)
