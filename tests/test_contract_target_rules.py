"""Every target rule under every distribution, on every engine, is learned as the rule says or refused: never ignored.

A cell is a rule, a distribution, a representation and an engine, from the library's own lists. It is built as a run
builds it. Either its targets, and the step of plain SGD that follows them, are those of a formula written here from the
rule's definition, with the online and the target network far apart; or it is refused in one line that says what does
not go together, and whose way out leads to a cell that is learned. A rule or a distribution that has no formula here
fails until it gets one.

Mutants that must die here: double, Munchausen or both ignored under quantiles, double under categories, each in the
mean · double that chooses by the target network, believes the online one, or has them the wrong way round · Munchausen
without its bonus, its entropy or its own numbers, or by the online network · Peng's λ-returns for Watkins', and the
reverse · each of retrace, tree backup and Harutyunyan's by each other, all by Watkins', with the maximum, or by the
online network · time limits ignored by λ-returns, or one step in their place · expected Sarsa by the best action, by
the online network, or with its quantiles averaged · IQN with one draw of levels for both sides, or with fixed ones ·
compiled arrays that know Q-learning only · targets that are right, and an update that learns from others · rewards left
unscaled · DQRC with a target network, without its correction, its pull to 0 or its second function, or made a
Q-learning run · each refusal let through, a learned pair refused, a refusal in two lines, without a way out, or with
one that leads back · a learner that takes the settings of another · "torch" or "compiled" asked for and the other used
· a rule, a distribution or an engine added without a formula.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from neuralq import RunConfig, Transition
from neuralq.learners import DistributionalLearner, DQRCLearner, ReplayLearner, ReplaySettings
from neuralq.learners.replay.distributions.record import distributions
from neuralq.q import MLP
from neuralq.rules import target_rules
from neuralq.runs.recipe import build


def listed() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """All target rules and all distributions: the one place here that knows where the library lists them."""
    return tuple(target_rules()), tuple(distributions())


def built(config: RunConfig) -> Any:
    """The learner of a run, and the name of its engine: the one place here that knows who builds them."""
    with pytest.MonkeyPatch.context() as patch:  # what it finds is tested elsewhere, and takes most of the time here
        patch.setattr(build, "is_resumable", lambda *_: None)
        session = build.build_session(config)
    session.close()
    return session.learner, build.engine_name(session.learner)


ENGINES = ("auto", "torch", "compiled")
WORLDS = ("table", "network", "masked-network")
T, B, NUM_STATES, WIDTH, HIDDEN, NUM_ACTIONS, NUM_ATOMS = 6, 4, 7, 3, 4, 3, 5
SCALE, RATE, LAMBDA, EPSILON, TAU, ALPHA, FLOOR, BETA, RATE_H = 0.5, 0.5, 0.8, 0.3, 0.4, 0.7, -0.6, 0.3, 0.25
GRID = torch.linspace(-2.0, 3.0, NUM_ATOMS, dtype=torch.float64)  # in units of scaled rewards
EXACT = {"table": 1e-9, "network": 3e-5, "masked-network": 3e-5}  # networks are in float32


class Cell(NamedTuple):
    rule: str
    distribution: str
    world: str
    engine: str


class Ring(gym.Env[Any, Any]):
    """States around a ring, as an index or a vector, with a mask or without; only its spaces matter here."""

    action_space = spaces.Discrete(NUM_ACTIONS)

    def __init__(self, world: str) -> None:
        self.index = world == "table"
        self.info = {"action_mask": np.ones(NUM_ACTIONS, np.int8)} if world == "masked-network" else {}
        self.observation_space: Any = spaces.Box(-9, 9, (WIDTH,), np.float32)
        if self.index:
            self.observation_space = spaces.Discrete(NUM_STATES)
        self.s = 0

    def look(self) -> Any:
        return self.s if self.index else np.full(WIDTH, self.s, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = 0
        return self.look(), dict(self.info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.s = (self.s + 1) % NUM_STATES
        return self.look(), 0.0, self.s == 0, False, dict(self.info)


@pytest.fixture(scope="module", autouse=True)
def registered() -> Iterator[None]:
    gym.register("Ring-v0", Ring)
    yield
    del gym.registry["Ring-v0"]


# What is fed to the learner, and what it looks like through both networks.


def block(world: str) -> Transition:
    """Rows ``[T, B]`` with terminations, a time limit and, with masks, terminal states in which nothing is legal."""
    rng = np.random.default_rng(5)
    terminated, limited = np.zeros((2, T, B), bool)
    terminated[1, 0] = terminated[5, 2] = limited[3, 1] = True
    ends, a = terminated | limited, rng.integers(NUM_ACTIONS, size=(T, B))
    legal = rng.random((2, T + 1, B, NUM_ACTIONS)) < 0.6  # in the stream, and in the states where an episode ends
    legal[..., 0] |= ~legal.any(-1)
    np.put_along_axis(legal[0, :T], a[..., None], True, -1)
    legal[1, :T][terminated] = False
    s: Any = rng.normal(size=(2, T + 1, B, WIDTH)).astype(np.float32)
    if world == "table":
        s = rng.integers(NUM_STATES, size=(2, T + 1, B))
    elif world == "masked-network":
        s = np.concatenate([s, legal.astype(np.float32)], -1)
    s_t = s[0, 1:].copy()
    s_t[ends] = s[1, :T][ends]
    mu, r, discount = rng.uniform(0.2, 1.0, (T, B)), 2 * rng.normal(size=(T, B)), rng.uniform(0.6, 0.95, (T, B))
    discount[terminated] = 0.0
    floats = (x.astype(np.float32) for x in (mu, r, discount))  # as a replay buffer keeps them
    return Transition(*(torch.from_numpy(x) for x in (s[0, :T], a, *floats, s_t, ends)))


def layer(theta: Tensor, x: Tensor) -> Tensor:
    """A dense layer whose weights ``[in, out]`` and biases ``[out]`` follow each other in ``theta``."""
    rows = theta.reshape(x.shape[-1] + 1, -1)
    return x @ rows[:-1] + rows[-1]


def hidden(theta: Tensor, s: Tensor) -> Tensor:
    return torch.tanh(layer(theta[: (WIDTH + 1) * HIDDEN], s[..., :WIDTH].double()))


def numbers_of(world: str, theta: Tensor, s: Tensor, levels: Tensor | None = None) -> Tensor:
    """All K numbers of every action, ``[*n, A, K]``; of IQN at the levels ``[*n, K]``."""
    if world == "table":
        numbers = theta.reshape(NUM_STATES, NUM_ACTIONS, -1)[s]
        return numbers if levels is None else numbers @ cosines(levels).transpose(-1, -2)
    units, (lower, upper) = hidden(theta, s), ((WIDTH + 1) * HIDDEN, (HIDDEN + 1) * NUM_ACTIONS)
    if levels is None:
        out = layer(theta[lower:], units)
        return out.reshape(*out.shape[:-1], NUM_ACTIONS, -1)
    embedded = torch.relu(layer(theta[lower + upper :], cosines(levels)))  # Dabney, Ostrovski et al. 2018, eq. 4
    return layer(theta[lower : lower + upper], units[..., None, :] * embedded).transpose(-1, -2)


def cosines(levels: Tensor) -> Tensor:
    return torch.cos(torch.pi * torch.arange(64.0, dtype=torch.float64) * levels[..., None])


def drawn_levels(cell: Cell, rng: Any) -> Tensor | None:
    """Of one side of an update, ``[T, B, K]``; only IQN draws any."""
    return torch.from_numpy(rng.random((T, B, NUM_ATOMS))) if cell.distribution == "iqn" else None


def mean(distribution: str, numbers: Tensor) -> Tensor:
    """The value that K numbers stand for, ``[*n, K] -> [*n]``."""
    if distribution == "categorical":
        return torch.softmax(numbers, -1) @ GRID
    return numbers.mean(-1)


def values_of(world: str, distribution: str, theta: Tensor, s: Tensor) -> Tensor:
    """Action values ``[*n, A]``, −∞ where the mask says so."""
    midpoints = (torch.arange(32.0, dtype=torch.float64) + 0.5) / 32
    levels = midpoints.expand(*s.shape[: 2 if world == "table" else -1], -1) if distribution == "iqn" else None
    q = mean(distribution, numbers_of(world, theta, s, levels))
    return q.masked_fill(s[..., -NUM_ACTIONS:] == 0, -torch.inf) if world == "masked-network" else q


@dataclass(frozen=True)
class Seen:
    """A block in arrays ``[T, B]`` and what the networks say in its states, ``[T, B, A]`` or ``[T, B, A, K]``."""

    a: Any
    mu: Any
    r: Any
    discount: Any
    last: Any
    target_tm1: Any
    target_t: Any
    online_t: Any
    atoms_t: Any


def seen_through(cell: Cell, online: Tensor, target: Tensor, levels: Tensor | None) -> Seen:
    t = block(cell.world)
    rows = [t.a_tm1, t.mu_tm1.double(), SCALE * t.r_t.double(), t.discount_t.double(), t.last_t]
    looks = [(target, t.s_tm1), (target, t.s_t), (online, t.s_t)]
    values = [values_of(cell.world, cell.distribution, theta, s) for theta, s in looks]
    return Seen(*(x.numpy() for x in (*rows, *values, numbers_of(cell.world, target, t.s_t, levels))))


# The rules by their definitions, row by row.

Row = tuple[int, int]


def average(weights: Any, values: Any) -> Any:
    """``Σₐ weights[a] · values[a]`` over the actions that have weight."""
    return sum((w * v for w, v in zip(weights, values, strict=True) if w > 0), np.zeros_like(values[0]))


def greedy(q: Any, epsilon: float = 0.0) -> Any:
    """Probabilities of the ε-greedy policy; 0 everywhere if nothing is legal."""
    legal = q > -np.inf
    if not legal.any():
        return np.zeros(len(q))
    return epsilon * legal / legal.sum() + (1 - epsilon) * np.eye(len(q))[q.argmax()]


def soft(q: Any) -> Any:
    """Probabilities of the softmax policy; 0 everywhere if nothing is legal."""
    weights = np.exp(q / TAU)
    return weights / max(weights.sum(), 1e-300)


def followed(rule: str, seen: Seen, row: Row) -> tuple[Any, float, float]:
    """What a one-step rule does next, as probabilities, and what it adds to the reward and to the successor's value."""
    if rule == "munchausen":  # Vieillard, Pietquin & Geist 2020, eq. 2
        pi = soft(seen.target_t[row])
        bonus = ALPHA * max(TAU * np.log(soft(seen.target_tm1[row])[seen.a[row]]), FLOOR)
        return pi, bonus, -TAU * sum(p * np.log(p) for p in pi if p > 0)
    if rule == "expected_sarsa":  # van Seijen, van Hasselt, Whiteson & Wiering 2009, eq. 5
        return soft(seen.target_t[row]), 0.0, 0.0
    # Mnih et al. 2015 choose by the target network, van Hasselt, Guez & Silver 2016 by the online one.
    chooser = {"q_learning": seen.target_t, "double": seen.online_t, "dqrc": seen.online_t}[rule]
    return greedy(chooser[row]), 0.0, 0.0


def one_step(rule: str, seen: Seen, row: Row) -> Any:
    """The mean: reward and discounted value of what is followed."""
    pi, bonus, entropy = followed(rule, seen, row)
    believed = seen.online_t if rule == "dqrc" else seen.target_t  # Patterson et al. 2022 have no target network
    return seen.r[row] + bonus + seen.discount[row] * (average(pi, believed[row]) + entropy)


def moved_quantiles(rule: str, seen: Seen, row: Row) -> Any:
    """Dabney et al. 2018, eq. 13; under a policy that mixes actions every quantile is mixed."""
    pi, bonus, entropy = followed(rule, seen, row)
    return seen.r[row] + bonus + seen.discount[row] * (average(pi, seen.atoms_t[row]) + entropy)


def drawn(rule: str, seen: Seen, row: Row) -> Any:
    """How likely each action is to follow; where nothing is legal the world has ended, and any will do."""
    pi, _, _ = followed(rule, seen, row)
    return pi if pi.any() else np.eye(len(pi))[0]


def drawn_quantiles(rule: str, seen: Seen, row: Row) -> Any:
    """A policy that draws its action has the mixture for its return: the values of every action, as likely as it is."""
    return seen.r[row] + seen.discount[row] * seen.atoms_t[row].reshape(-1)


def moved_categories(rule: str, seen: Seen, row: Row) -> Any:
    """Bellemare, Dabney & Munos 2017, algorithm 1."""
    _, bonus, _ = followed(rule, seen, row)
    each = np.exp(seen.atoms_t[row]) / np.exp(seen.atoms_t[row]).sum(-1, keepdims=True)
    mass = drawn(rule, seen, row) @ each
    low, high = float(GRID[0]), float(GRID[-1])
    share = np.zeros(NUM_ATOMS)
    for p, z in zip(mass, GRID.tolist(), strict=True):
        b = (min(max(seen.r[row] + bonus + seen.discount[row] * z, low), high) - low) / (high - low) * (NUM_ATOMS - 1)
        below = min(int(b), NUM_ATOMS - 2)
        share[below] += p * (below + 1 - b)
        share[below + 1] += p * (b - below)
    return share


def lambda_return(rule: str, seen: Seen, row: Row) -> Any:
    """The n-step returns weighed by (1 − λ) λⁿ⁻¹, the longest by what is left.

    Peng's (Peng & Williams 1996) reach to the end of the stream or the block, Watkins' (1989) to the next action that
    explores.
    """
    k, n = row
    returns, rewards, reach = [], 0.0, 1.0
    for j in range(k, T):
        rewards, reach = rewards + reach * seen.r[j, n], reach * seen.discount[j, n]
        returns.append(rewards + (reach * seen.target_t[j, n].max() if reach > 0 else 0.0))
        if seen.last[j, n] or j + 1 == T:
            break
        if rule == "watkins" and seen.target_tm1[j + 1, n].argmax() != seen.a[j + 1, n]:
            break
    weights = (1 - LAMBDA) * LAMBDA ** np.arange(len(returns))
    weights[-1] = LAMBDA ** (len(returns) - 1)
    return weights @ returns


def corrected_return(rule: str, seen: Seen, row: Row) -> Any:
    """Munos et al. 2016, eq. 3: the errors of all rows that follow, each as far as the coefficients carry."""
    k, n = row
    total, reach = seen.target_tm1[row][seen.a[row]], 1.0
    for j in range(k, T):
        if j > k:
            pi = greedy(seen.target_tm1[j, n], EPSILON)[seen.a[j, n]]
            c = {"retrace": min(1.0, pi / seen.mu[j, n]), "tree_backup": pi, "harutyunyan": 1.0}[rule]
            reach *= seen.discount[j - 1, n] * LAMBDA * c
        q_t = seen.target_t[j, n]
        v_t = average(greedy(q_t, EPSILON), q_t)
        total += reach * (seen.r[j, n] + seen.discount[j, n] * v_t - seen.target_tm1[j, n][seen.a[j, n]])
        if seen.last[j, n]:
            break
    return total


# What this test knows: the settings of every rule and distribution, and how each pair that is learned is learned.

BLOCKS: dict[str, Any] = {"block_length": T, "lambda_": LAMBDA}
CORRECTED = {**BLOCKS, "target_epsilon": EPSILON}
RULES: dict[str, dict[str, Any]] = {
    "q_learning": {},
    "double": {},
    "expected_sarsa": {"temperature": TAU},
    "munchausen": {"temperature": TAU, "munchausen_alpha": ALPHA, "munchausen_floor": FLOOR},
    "peng": BLOCKS,
    "watkins": BLOCKS,
    "retrace": CORRECTED,
    "tree_backup": CORRECTED,
    "harutyunyan": CORRECTED,
    "dqrc": {"dqrc_beta": BETA, "dqrc_learning_rate": RATE_H},
}
LIMITS = {"value_min": float(GRID[0]) / SCALE, "value_max": float(GRID[-1]) / SCALE}
DISTRIBUTION_SETTINGS: dict[str, dict[str, Any]] = {
    "none": {"loss": "squared"},
    "quantile": {"num_atoms": NUM_ATOMS},
    "categorical": {"num_atoms": NUM_ATOMS, **LIMITS},
    "iqn": {"num_atoms": NUM_ATOMS},
}
QUANTILES = ("quantile", "iqn")
FORMULAS: dict[tuple[str, str], Callable[[str, Seen, Row], Any]] = {
    **{(rule, "none"): one_step for rule in ("q_learning", "double", "expected_sarsa", "munchausen", "dqrc")},
    **{(rule, "none"): lambda_return for rule in ("peng", "watkins")},
    **{(rule, "none"): corrected_return for rule in ("retrace", "tree_backup", "harutyunyan")},
    **{(rule, kind): moved_quantiles for rule in ("q_learning", "double", "munchausen") for kind in QUANTILES},
    **{("expected_sarsa", kind): drawn_quantiles for kind in QUANTILES},
    **{(rule, "categorical"): moved_categories for rule in ("q_learning", "double", "expected_sarsa")},
}


def config_of(cell: Cell) -> RunConfig:
    if cell.rule not in RULES:
        pytest.fail(f"teach this test the rule {cell.rule!r}: its settings and a formula of its own")
    if cell.distribution not in DISTRIBUTION_SETTINGS:
        pytest.fail(f"teach this test the distribution {cell.distribution!r}: its settings and formulas of its own")
    settings = ReplaySettings(
        target_rule=cell.rule, distribution=cell.distribution, optimiser="sgd", learning_rate=RATE, max_grad_norm=None,
        batch_size=T * B, learning_starts=T * B, capacity=T * B,
        **RULES[cell.rule], **DISTRIBUTION_SETTINGS[cell.distribution],
    )  # fmt: skip
    layout, body = ("table", None) if cell.world == "table" else ("action-output", MLP((HIDDEN,), activation="tanh"))
    return RunConfig(
        env="Ring-v0", env_kwargs={"world": cell.world}, learner="replay", layout=layout, body=body, replay=settings,
        reward_scale=SCALE, engine=cell.engine, evaluation_episodes=1,
    )  # fmt: skip


@functools.cache
def outcome(cell: Cell) -> Any:
    """The learner and the name of its engine, or what is said when they are refused."""
    try:
        return built(config_of(cell))
    except ValueError as error:
        return str(error)


def refusal(cell: Cell) -> str | None:
    return outcome(cell) if isinstance(outcome(cell), str) else None


def cells() -> list[Cell]:
    rules, distributions = listed()
    return [Cell(*names) for names in itertools.product(rules, distributions, WORLDS, ENGINES)]


def name_of(cell: Cell) -> str:
    return "-".join(cell)


# Learned.


@dataclass(frozen=True)
class Learning:
    """A learner with random parameters, and those of its two networks, and of DQRC's second function, before a step."""

    learner: Any
    online: Tensor
    target: Tensor
    second: Tensor | None


def learning_of(cell: Cell) -> Learning:
    learner, name = outcome(cell)  # nothing of earlier steps is left in it: plain SGD remembers none
    assert cell.engine == "auto" or name.startswith(cell.engine)
    rng = np.random.default_rng(7)
    flat = learner.engine.flat.values
    target, online = (torch.from_numpy(rng.normal(size=flat.shape)).to(flat.dtype) for _ in range(2))
    flat.copy_(target)
    learner.engine.sync_target()
    flat.copy_(online)
    second = None
    if cell.rule == "dqrc":
        state = learner.state_dict()
        second = torch.from_numpy(rng.normal(size=state["h"].shape)).to(flat.dtype)
        learner.load_state_dict({**state, "h": second})
    return Learning(learner, online.double(), target.double(), None if second is None else second.double())


def rows_for(cell: Cell) -> Transition:
    """The block, or its rows for a rule that takes single samples."""
    t = block(cell.world)
    return t if "block_length" in RULES[cell.rule] else t.map(lambda x: x.flatten(0, 1))


def expected_targets(cell: Cell, seen: Seen) -> Tensor:
    formula = FORMULAS[cell.rule, cell.distribution]
    return torch.from_numpy(np.array([formula(cell.rule, seen, row) for row in np.ndindex(T, B)]))


def chances(cell: Cell, seen: Seen, targets: Tensor) -> Tensor:
    """How likely each target value of every row is, where there are several."""
    if FORMULAS[cell.rule, cell.distribution] is not drawn_quantiles:
        return torch.full_like(targets, 1 / targets.shape[-1])
    each = [np.repeat(drawn(cell.rule, seen, row) / NUM_ATOMS, NUM_ATOMS) for row in np.ndindex(T, B)]
    return torch.from_numpy(np.array(each))


def loss(distribution: str, numbers: Tensor, targets: Tensor, likely: Tensor, levels: Tensor | None) -> Tensor:
    """Of every row, from its K numbers ``[N, K]``, those of IQN at the levels ``[N, K]``."""
    if distribution == "none":
        return 0.5 * (targets - numbers[:, 0]) ** 2
    if distribution == "categorical":
        return -(targets * torch.log_softmax(numbers, -1)).sum(-1)
    error = targets[:, None, :] - numbers[:, :, None]  # Dabney et al. 2018, eq. 10, with κ = 1
    if levels is None:
        levels = torch.tensor([(2 * i + 1) / (2 * NUM_ATOMS) for i in range(NUM_ATOMS)], dtype=error.dtype)
    huber = torch.where(error.abs() <= 1, 0.5 * error**2, error.abs() - 0.5)
    return ((levels[..., None] - (error < 0).double()).abs() * huber * likely[:, None, :]).sum(-1).sum(-1)


def expected_step(cell: Cell, before: Learning, targets: Tensor, likely: Tensor, levels: Tensor | None) -> list[Tensor]:
    """The parameters after one step of SGD, and after them those of DQRC's second function."""
    t = block(cell.world).map(lambda x: x.flatten(0, 1))
    theta, every = before.online.clone().requires_grad_(), torch.arange(T * B)
    levels = None if levels is None else levels.flatten(0, 1)
    numbers = numbers_of(cell.world, theta, t.s_tm1, levels)[every, t.a_tm1]
    if before.second is None:
        each = loss(cell.distribution, numbers, targets, likely, levels)
        return [before.online - RATE * torch.autograd.grad(each.mean(), theta)[0]]
    # Patterson et al. 2022: δ ∇Q − h γ ∇max Q' for the values, (δ − h) ∇h and a pull to 0 for h.
    second = before.second.clone().requires_grad_()
    if cell.world == "table":
        h = numbers_of(cell.world, second, t.s_tm1)[every, t.a_tm1, 0]
    else:
        h = layer(second, hidden(before.online, t.s_tm1))[every, t.a_tm1]
    ended, q_t = t.discount_t == 0, values_of(cell.world, "none", theta, t.s_t)
    v_t = q_t.masked_fill(ended[:, None], 0.0).amax(-1)
    delta = (targets - numbers[:, 0]).detach()
    corrected = (h.detach() * t.discount_t.double() * v_t - delta * numbers[:, 0]).mean()
    regression = (0.5 * (delta - h) ** 2).mean() + 0.5 * BETA * (second**2).sum()
    return [
        before.online - RATE * torch.autograd.grad(corrected, theta)[0],
        before.second - RATE_H * torch.autograd.grad(regression, second)[0],
    ]


def check_learned(cell: Cell) -> None:
    if (cell.rule, cell.distribution) not in FORMULAS:
        pytest.fail(f"teach this test the rule {cell.rule!r} under distribution={cell.distribution!r}: a formula")
    before, t = learning_of(cell), rows_for(cell)
    learner = before.learner
    draws = np.random.default_rng(9)
    levels_t, levels_tm1 = (drawn_levels(cell, draws) for _ in range(2))
    seen = seen_through(cell, before.online, before.target, levels_t)
    wanted = expected_targets(cell, seen)
    likely = chances(cell, seen, wanted)
    near = {"rtol": 0.0, "atol": EXACT[cell.world]}
    learner.rng = np.random.default_rng(9)
    if cell.rule != "dqrc":  # its targets are only to be seen in an update
        got = learner.targets(t).double()
        assert got.shape == (*t.r_t.shape, *wanted.shape[1:])
        torch.testing.assert_close(got.reshape(wanted.shape), wanted, **near)
    several = wanted @ GRID if cell.distribution == "categorical" else (wanted * likely).sum(-1)
    aims = wanted if wanted.ndim == 1 else several
    learner.rng = np.random.default_rng(9)
    update = learner.update(t)
    torch.testing.assert_close(update.targets.double(), aims, **near)
    after = [learner.engine.flat.values] + ([] if before.second is None else [learner.state_dict()["h"]])
    for got, values in zip(after, expected_step(cell, before, wanted, likely, levels_tm1), strict=True):
        torch.testing.assert_close(got.double(), values, **near)


# Refused.


def check_refused(cell: Cell, message: str) -> None:
    kernels = cell.world != "table" and cell.distribution == "none"
    known = (cell.rule, cell.distribution) in FORMULAS and (kernels or cell.engine != "compiled")
    assert not known, f"was learned before, and is refused now: {message}"
    problem, _, way_out = message.rpartition("; ")
    assert problem and way_out and "\n" not in message, message
    named = [cell.rule, f"distribution={cell.distribution!r}", f"{cell.distribution} distribution"]
    assert any(name in problem for name in (*named, f"engine={cell.engine!r}")), message
    follow(cell, [message])


def follow(cell: Cell, heard: list[str]) -> None:
    """All that the last message says to use leads to a cell that is learned, or to a refusal to be followed further."""
    ways = list(ways_out(cell, heard[-1].rpartition("; ")[2]))
    assert ways, f"no way out that names a rule, a distribution or an engine: {heard[-1]}"
    for way in ways:
        message = refusal(way)
        assert message not in heard, f"the way out leads back: {heard[-1]}"
        if message is not None:
            follow(way, [*heard, message])


def ways_out(cell: Cell, advice: str) -> Iterator[Cell]:
    rules, distributions = listed()
    yield from (cell._replace(rule=rule) for rule in rules if re.search(rf"\b{rule}\b", advice))
    yield from (cell._replace(distribution=x) for x in distributions if f"distribution={x!r}" in advice)
    yield from (cell._replace(engine=x) for x in ENGINES if f"engine={x!r}" in advice)


# The contract.


def test_every_engine_that_can_be_named_is_in_this_test() -> None:
    with pytest.raises(ValueError, match="engine must be one of") as refused:
        RunConfig(engine="none of them")
    assert tuple(re.findall(r"'(\w+)'", str(refused.value))) == ENGINES


@pytest.mark.parametrize("cell", cells(), ids=name_of)
def test_a_rule_is_learned_as_it_says_or_refused_with_a_way_out(cell: Cell) -> None:
    message = refusal(cell)
    if message is None:
        check_learned(cell)
    else:
        check_refused(cell, message)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("distribution", listed()[1])
def test_no_two_rules_learn_the_same_from_the_same_rows(distribution: str, world: str) -> None:
    learned = [Cell(rule, distribution, world, "auto") for rule in listed()[0]]
    learned = [cell for cell in learned if refusal(cell) is None]
    assert len(learned) > 1
    targets = {cell.rule: learning_of(cell).learner.update(rows_for(cell)).targets for cell in learned}
    for one, other in itertools.combinations(targets, 2):
        assert float((targets[one] - targets[other]).abs().max()) > 0.01, f"{one} and {other}"


@pytest.mark.parametrize(("rule", "distribution"), sorted(FORMULAS))
def test_a_learner_refuses_what_another_learner_is_for(rule: str, distribution: str) -> None:
    cell = Cell(rule, distribution, "table", "auto")
    learner, settings = outcome(cell)[0], config_of(cell).replay
    assert type(learner) in (ReplayLearner, DistributionalLearner, DQRCLearner)
    engines = {name: outcome(Cell("q_learning", name, "table", "auto"))[0].engine for name in DISTRIBUTION_SETTINGS}
    strangers: list[Any] = [(DistributionalLearner, engines[name]) for name in engines if name != distribution]
    if type(learner) is not ReplayLearner:
        strangers.append((ReplayLearner, engines[distribution]))
    for other, engine in strangers:
        with pytest.raises(ValueError, match=r"^[^\n]+; [^\n]+$"):
            other(engine, settings)
