"""Slopes in the loss, and explanation-based learning on the linear-quadratic task, against autograd and closed forms.

Mutants that die here: a Jacobian that is not transposed, a discount one row early or late, rows explained in the order
of time, a bootstrap that is dropped; weights ignored or inside the square, no ½; LOB* that grows with the error or goes
below 0; a slope without its graph; in the compiled gradient 1 − h for 1 − h², the 2 of its derivative left out, μ of
another row, the mean taken twice; Adam without its corrections, with β₁ and β₂ exchanged or with a step that does not
fall; an episode that follows the law from the start, a chain along predicted states, C without its factor 2.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from neuralq import rules
from neuralq.learners import SlopeNet, fit_slopes, new_slope_net
from neuralq.systems import run_system, system_named
from neuralq.systems.ebnn import fits, oracle, theory
from neuralq.systems.ebnn.system import BAD_THEORY, BELIEVED_THEORY, GOOD_THEORY, PLAIN
from neuralq_envs.linear_quadratic import GAMMA, LAW, PUSH, LinearQuadraticEnv, action_value_slopes, action_values


def test_slopes_of_returns_are_autograds_of_the_rollout() -> None:
    """Through ρ(s) = |s|² and a tanh of another matrix in every row, with a bootstrap, and an end in the middle."""
    torch.manual_seed(0)
    matrices, discount = torch.randn(4, 3, 3, dtype=torch.float64), torch.full((4, 5), 0.8, dtype=torch.float64)
    discount[1, 2] = 0.0
    s = torch.randn(5, 3, dtype=torch.float64)
    states = [s.requires_grad_()]
    for matrix in matrices:
        states.append(torch.tanh(states[-1] @ matrix.T))
    value = states[-1].pow(3).sum(-1)
    for r, factor in zip([(x * x).sum(-1) for x in states[3::-1]], discount.flip(0), strict=True):
        value = r + factor * value
    left = torch.stack(states[:4]).detach()
    jacobians = torch.stack(
        [(1 - torch.tanh(x @ m.T) ** 2)[..., None] * m for x, m in zip(left, matrices, strict=True)]
    )
    ours = rules.return_slopes(2 * left, discount, jacobians, 3 * states[-1].detach() ** 2)
    torch.testing.assert_close(ours[0], rules.input_slopes(value, s), rtol=1e-10, atol=1e-12)
    assert ours.shape == (4, 5, 3)
    torch.testing.assert_close(ours[1, 2], 2 * left[1, 2])  # nothing after an end


def test_the_loss_of_slopes_by_hand_and_how_far_an_explanation_is_believed() -> None:
    """½ (3² + 4²) = 12.5, ½ · 1² = .5, times 2 and 3."""
    error = torch.tensor([[3.0, 4.0], [0.0, -1.0]])
    assert rules.squared_slopes(error).tolist() == [12.5, 0.5]
    assert rules.squared_slopes(error, torch.tensor([2.0, 3.0])).tolist() == [25.0, 1.5]
    believed = rules.lob_star(torch.tensor([0.0, 1.0, -1.0, 5.0]), torch.zeros(4), largest=4.0)
    assert believed.tolist() == [1.0, 0.75, 0.75, 0.0]


def test_any_network_learns_slopes_by_the_rules() -> None:
    """A network of PyTorch's own, told two points and their tangents of s², passes near the others."""
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(1, 16), torch.nn.Softplus(), torch.nn.Linear(16, 1))
    optimiser = torch.optim.Adam(net.parameters(), 0.02)
    s = torch.tensor([[-1.0], [1.0]], requires_grad=True)
    for _ in range(300):
        v = net(s)[:, 0]
        wrong = 2 * s.detach() - rules.input_slopes(v, s)
        loss = (rules.squared(1 - v) + rules.squared_slopes(wrong)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss.item() < 1e-3 and abs(net(torch.zeros(1, 1)).item()) < 0.5


@pytest.mark.parametrize("given", [(7, 3, 5, 0), (1, 1, 2, 1), (4, 2, 10, 2)])
def test_the_compiled_gradient_is_autograds(given: tuple[int, int, int, int]) -> None:
    assert oracle.gradient_difference(*given) < 1e-12


def test_the_compiled_descent_is_pytorchs_adam() -> None:
    rng = np.random.default_rng(0)
    net = new_slope_net(2, 4, rng)
    s, slope = rng.normal(size=(2, 6, 2))
    y, weight = rng.normal(size=6), rng.uniform(size=6)
    ours = fit_slopes(net, s, y, slope, weight, num_steps=40, step_size=0.05)
    module, states = net.module(), torch.from_numpy(s).requires_grad_()
    optimiser = torch.optim.Adam(module.parameters(), 0.05)
    falls = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1 - step / 40)
    for _ in range(40):
        v = module(states)[:, 0]
        wrong = torch.from_numpy(slope) - rules.input_slopes(v, states)
        loss = (rules.squared(torch.from_numpy(y) - v) + rules.squared_slopes(wrong, torch.from_numpy(weight))).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falls.step()
    theirs = torch.nn.utils.parameters_to_vector(module.parameters()).detach().numpy()
    assert np.abs(theirs - net.parameters).max() > 0.1 and np.allclose(ours.parameters, theirs, rtol=0, atol=1e-9)


def test_slopes_of_the_network_are_finite_differences_and_any_leading_axes_will_do() -> None:
    net = new_slope_net(3, 6, np.random.default_rng(1))
    s = np.random.default_rng(2).normal(size=(2, 4, 3))
    steps = 1e-5 * np.eye(3)
    numeric = np.stack([(net.values(s + e) - net.values(s - e)) / 2e-5 for e in steps], axis=-1)
    assert net.values(s).shape == (2, 4) and np.abs(net.slopes(s) - numeric).max() < 1e-9


def test_without_slopes_nothing_is_said_of_them() -> None:
    net, s, y = new_slope_net(1, 3, np.random.default_rng(0)), np.array([[0.0], [1.0]]), np.array([1.0, -1.0])
    alone = fit_slopes(net, s, y, num_steps=20)
    assert np.array_equal(alone.parameters, fit_slopes(net, s, y, [[9.0], [9.0]], 0.0, num_steps=20).parameters)
    assert not np.array_equal(alone.parameters, fit_slopes(net, s, y, [[9.0], [9.0]], num_steps=20).parameters)


NET = new_slope_net(2, 3, np.random.default_rng(0))
ONE = np.zeros((1, 2))


@pytest.mark.parametrize(
    ("act", "error", "said"),
    [
        (lambda: fit_slopes(NET, np.zeros((3, 1)), np.zeros(3)), ValueError, r"s must be \[N, 2\]"),
        (lambda: fit_slopes(NET, np.zeros((0, 2)), np.zeros(0)), ValueError, "N of at least 1"),
        (lambda: fit_slopes(NET, ONE, [np.nan]), ValueError, "y must be finite"),
        (lambda: fit_slopes(NET, ONE, [0.0], ONE, -1.0), ValueError, "weight must be at least 0"),
        (lambda: fit_slopes(NET, ONE, [0.0, 1.0]), ValueError, r"y must be finite and of shape \[1\]"),
        (lambda: fit_slopes(NET, ONE, [0.0], num_steps=0), ValueError, "num_steps must be a whole number"),
        (lambda: new_slope_net(0, 3, np.random.default_rng(0)), ValueError, "num_inputs must be"),
        (lambda: rules.lob_star(torch.ones(2), torch.ones(2), 0.0), ValueError, "largest must be"),
        (lambda: rules.lob_star(torch.ones(2), torch.ones(2, 1), 1.0), ValueError, "predicted must have the shape"),
        (lambda: rules.squared_slopes(torch.ones(2, 3), torch.ones(3)), ValueError, "weight must have the shape"),
        (lambda: rules.input_slopes(torch.ones(2), torch.ones(2, 3)), ValueError, r"call s.requires_grad_\(\)"),
        (
            lambda: rules.input_slopes(torch.ones(2), torch.ones(2, 3, requires_grad=True)),
            ValueError,
            "computed from s",
        ),
        (
            lambda: rules.input_slopes(torch.ones(2, requires_grad=True), torch.ones(2, 3)),
            ValueError,
            "computed from s",
        ),
        (
            lambda: rules.return_slopes(torch.ones(2, 3), torch.ones(2), torch.ones(2, 2, 3), torch.ones(3)),
            ValueError,
            "a column of jacobian_t",
        ),
        (
            lambda: rules.return_slopes(torch.ones(0, 3), torch.ones(0), torch.ones(0, 3, 3), torch.ones(3)),
            ValueError,
            "T of at least 1",
        ),
        (lambda: LinearQuadraticEnv().step(0), ResetNeeded, "call reset"),
        (lambda: LinearQuadraticEnv(start_spread=0.0), ValueError, "start_spread must be"),
        (lambda: LinearQuadraticEnv("human"), ValueError, "render_mode must be one of"),
        (lambda: LinearQuadraticEnv().reset(options={"state": (1, np.inf)}), ValueError, "a velocity within"),
        (lambda: action_values([0.0, 0.0], 3), ValueError, "a must be one of 0, 1, 2"),
        (lambda: action_values([0.0, 0.0], 0, gamma=1.5), ValueError, "gamma must lie in"),
        (lambda: fits.fit(np.random.SeedSequence(0), "none of these"), ValueError, "source must be one of"),
        (lambda: theory.learn_theory(0, np.random.default_rng(0)), ValueError, "num_transitions must be"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        act()


# ------------------------------------------------------------------------------------------------ the task, the system


def test_values_and_slopes_of_the_task_are_those_of_its_episodes() -> None:
    assert oracle.value_difference() < 1e-12 and oracle.slope_difference() < 1e-9
    s = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    for a in range(3):
        numeric = [(action_values(s + e, a) - action_values(s - e, a)) / 2e-4 for e in 1e-4 * np.eye(2)]
        assert np.abs(np.stack(numeric, axis=-1) - action_value_slopes(s, a)).max() < 1e-9
    assert np.abs(action_values(s, PUSH) - theory.observe(s)[1]).max() < 1e-5


def test_what_is_explained_is_the_chain_along_what_was_seen() -> None:
    assert oracle.chain_difference() < 1e-12
    # A theory of nothing changes nothing and earns 2 s₁: its slope is 2 (1 + γ + … ) whatever is seen.
    nothing = SlopeNet(np.zeros(5), 2)
    line = SlopeNet(np.array([1e-4, 0.0, 0.0, 2e4, 0.0]), 2)
    slopes = theory.explain(theory.Theory(line, {PUSH: (nothing,) * 2, LAW: (nothing,) * 2}), np.ones((30, 1, 2)))
    assert slopes[0, 0] == pytest.approx(2 * (1 - GAMMA**30) / (1 - GAMMA), rel=1e-6) and slopes[0, 1] == 0


@pytest.mark.parametrize("num_steps", [300, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_task_keeps_its_word_for_many_random_steps(num_steps: int) -> None:
    env = gymnasium.make("neuralq/LinearQuadratic-v0")
    check_env(gymnasium.make("neuralq/LinearQuadratic-v0", render_mode="rgb_array").unwrapped)
    rng = np.random.default_rng(0)
    s, _ = env.reset(seed=0)
    starts = [s]
    for action in rng.integers(3, size=num_steps).tolist():
        u = (-1.0, -(0.8 * s[0] + s[1]), 1.0)[action]
        s_t, reward, terminated, truncated, _ = env.step(action)
        assert s_t.tolist() == pytest.approx([s[0] + 0.2 * s[1], 0.9 * s[1] + 0.3 * u], abs=1e-12)
        assert reward == pytest.approx(-(s[0] ** 2) - 0.1 * s[1] ** 2) and not terminated
        s = s_t
        assert s in env.observation_space
        if truncated:
            s, _ = env.reset()
            starts.append(s)
    assert (np.abs(starts) <= 1).all() and len(starts) == 1 + num_steps // 100


def test_the_line_ends() -> None:
    env = LinearQuadraticEnv()
    s, _ = env.reset(options={"state": (99.0, 60.0)})
    assert s in env.observation_space
    s, _, terminated, truncated, _ = env.step(LAW)
    assert truncated and not terminated and s in env.observation_space
    with pytest.raises(ResetNeeded, match="off its line"):
        env.step(LAW)


def test_the_task_can_be_looked_at() -> None:
    env = LinearQuadraticEnv("ansi")
    assert env.render() is None
    env.reset(options={"state": (-1.0, 0.5)})
    line, said = env.render().splitlines()
    assert line.index(">") == 20 and line.index("+") == 30 and said == "position -1.00, velocity +0.50"
    picture = LinearQuadraticEnv("rgb_array")
    picture.reset(options={"state": (1.5, 1.5)})
    row, column = np.argwhere((picture.render() == (40, 90, 190)).all(axis=2)).mean(axis=0)
    assert abs(row - 64) < 2 and abs(column - 176) < 2


def test_contenders_of_one_seed_learn_from_the_same_episodes() -> None:
    seed = np.random.SeedSequence(3)
    plain, exact, bad = (fits.fit(seed, source, (5,)) for source in (fits.NONE, fits.EXACT, fits.WEIGHED))
    assert np.array_equal(plain.points, exact.points) and np.array_equal(plain.points, bad.points)
    assert exact.errors[5] < 0.5 * plain.errors[5] and not plain.weights.any() and exact.weights.all()
    assert ((bad.weights >= 0) & (bad.weights <= 1)).all() and bad.weights.mean() < 0.5
    assert np.abs(exact.slopes - action_value_slopes(exact.points, PUSH)).max() == 0


@pytest.mark.slow
def test_a_good_theory_helps_and_a_bad_one_hurts_only_where_it_is_believed() -> None:
    found = run_system(system_named("ebnn"))
    errors = {one.what: np.mean(one.values) for one in found.measured}

    def ratio(name: str, n: int, beside: str = PLAIN) -> float:
        said = f"mean squared error after {n} episodes"
        return float(errors[f"{name}: {said}"] / errors[f"{beside}: {said}"])

    assert ratio(GOOD_THEORY, 5) <= 0.3 and ratio(GOOD_THEORY, 10) <= 0.3
    assert ratio(BAD_THEORY, 10) <= 1.3 and ratio(BAD_THEORY, 10, BELIEVED_THEORY) <= 0.7
    assert ratio(BELIEVED_THEORY, 10) >= 1.5  # the control that must fail
    assert found.reproduced
