"""Every environment with a model steps as its model says, alone and as many copies: each successor, reward and end.

Environments are found in Gymnasium's registry, so a new one is held too; one without a model or without a vectorised
twin is named below with the reason. The twin is held to the model of the scalar environment made with the same
keywords, and every keyword that changes the model is given another value at least once. The law of a transition is read
from the public fields of `FiniteMDP`, never from its sampler: what it excludes may not occur even once, cells are held
by exact binomial tests with Bonferroni's bound, rows by chi-square tests summed over all rows.

Mutants that must die here: a twin without slip, with half of it or nine tenths, also where its ``mdp()`` tells the true
model; half the slip in the scalar one; all of the slip to one side; a twin that drops or swaps a keyword, or has its
own default; the reward of the successor, or the row's mean for the outcome's; an end missed, where a terminal state is
entered or mass is missing; a discount not simulated, the wrong way round, or drawn once for all copies; starts drawn
uniformly, all alike after a restart, or never from some; a successor, cell or row off by one; one draw for all copies;
an illegal action that moves, pays or ends; a restart of everyone; truncation a step late, or counted on over restarts;
the legal actions of the state before; noise with a mean, of another deviation, none, or one for all copies; a changed
maze that tells or steps the old one; a state asked for and ignored; expectations that are not those of the outcomes; a
keyword without a variant; a new environment without a model or a twin, or with another's.
"""

from __future__ import annotations

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv
from scipy import sparse, stats

import neuralq_envs
from neuralq.mdp import FiniteMDP
from neuralq_envs import vector_twin

neuralq_envs.register()

IDS = sorted(env_id for env_id in gymnasium.registry if env_id.startswith("neuralq/"))
TO_THE_BIT = "continuous; held bit for bit to Gymnasium's in test_envs_classic.py"
WITHOUT_MODEL = {
    "neuralq/Acrobot-v0": TO_THE_BIT,
    "neuralq/Backgammon-v0": "some 10^20 positions",
    "neuralq/Checkers-v0": "some 5 * 10^20 positions",
    "neuralq/LinWorld-v0": "some 10^40 states; held to a world written in plain Python in test_lin.py",
    "neuralq/LinearQuadratic-v0": "continuous; its values are known in closed form, held in test_slopes.py",
    "neuralq/Elevators-v0": "continuous, with people who come when they like",
    "neuralq/JobShop-v0": "every reset draws another problem, and a schedule of 51 tasks has more states than atoms",
    "neuralq/LittmanMaze-v0": "cells look alike; held to the model of its cells in test_aliased.py",
    "neuralq/McCallumMaze-v0": "cells look alike; held to the model of its cells in test_aliased.py",
    "neuralq/MountainCar-v0": TO_THE_BIT,
    "neuralq/Pengo-v0": "10^15 positions; held to plain Python in test_advice.py",
    "neuralq/Obelix-v0": "continuous; held to plain geometry in test_obelix.py",
    "neuralq/PoleBoxes-v0": "the next box depends on more than the box",
    "neuralq/RingMaze-v0": "cells look alike; held to the model of its cells in test_child.py",
    "neuralq/ThrunRobot-v0": "continuous; held to the geometry of the ground in test_thrun_robot.py",
    "neuralq/Woods1-v0": "sees bits and no cells; held to the model of its cells in test_bucket_brigade.py",
}
WITHOUT_TWIN = {
    "neuralq/Backgammon-v0": "has no model to simulate",
    "neuralq/BlockingMaze-v0": "two models in turn, by a clock of its own",
    "neuralq/Checkers-v0": "has no model to simulate",
    "neuralq/LinWorld-v0": "has no model to simulate",
    "neuralq/LinearQuadratic-v0": "has no model to simulate",
    "neuralq/Elevators-v0": "has no model to simulate",
    "neuralq/JobShop-v0": "has no model to simulate",
    "neuralq/LittmanMaze-v0": "has no model to simulate",
    "neuralq/McCallumMaze-v0": "has no model to simulate",
    "neuralq/Pengo-v0": "has no model to simulate",
    "neuralq/Obelix-v0": "has no model to simulate",
    "neuralq/PoleBoxes-v0": "has no model to simulate",
    "neuralq/RingMaze-v0": "has no model to simulate",
    "neuralq/ThrunRobot-v0": "has no model to simulate",
    "neuralq/Woods1-v0": "has no model to simulate",
    "neuralq/ShortcutMaze-v0": "two models in turn, by a clock of its own",
}
NOISE = {"neuralq/MaximizationBias-v0": "standard_deviation"}  # of rewards about the model's; the model is deaf to it

_SIGNS = "S..G\n.#..\n.T.x\n..CC"
_GRID = {
    "layout": _SIGNS, "step_reward": -0.5, "goal_reward": 2.0, "trap_reward": -3.0, "cliff_reward": -7.0,
    "bump_reward": -0.25, "wind": (0, 1, 0, 2), "slip": 0.3, "num_moves": 8, "blocked": "illegal",
}  # fmt: skip
# Other values than the defaults; each keyword must change the model in one of them.
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "neuralq/BairdStar-v0": ({"num_upper": 3},),
    "neuralq/BlockingMaze-v0": ({"change_step": 0}, {"change": "shortcut"}),
    "neuralq/DynaMaze-v0": ({"random_start": True},),
    "neuralq/ExerciseGrid-v0": ({"goal": 5, "goal_reward": 3.0},),
    "neuralq/Gridworld-v0": (
        {"slip": 0.1}, {"slip": 0.5, "num_moves": 8}, {"blocked": "illegal", "slip": 0.2}, {"wind": (1, 0, 2, 0)},
        _GRID,
    ),
    "neuralq/Landmarks-v0": ({"tasks": ("AB", "C"), "step_reward": -0.2, "goal_reward": 3.0},),
    "neuralq/MaximizationBias-v0": (
        {"num_actions": 3, "mean": 0.5, "standard_deviation": 2.0}, {"mean": 0.5, "standard_deviation": 0.0},
    ),
    "neuralq/MitchellGrid-v0": ({"goal": 3, "goal_reward": -3.0},),
    "neuralq/RandomWalk-v0": ({"num_states": 4, "left_reward": -2.0, "right_reward": 5.0},),
    "neuralq/RandomWalk19-v0": ({"num_states": 2, "left_reward": -2.0, "right_reward": 5.0},),
    "neuralq/ShortcutMaze-v0": ({"change_step": 0}, {"change": "blocking"}),
    "neuralq/SlideMaze-v0": ({"size": 9}, {"size": 7, "num_rectangles": 3, "wall_share": 0.1, "seed": 2},),
    "neuralq/TicTacToe-v0": (
        {"opponent": "random"},
        {"opponent": "optimal", "player": "O", "win_reward": 3.0, "draw_reward": 0.5, "loss_reward": -2.0},
    ),
    "neuralq/WindyGridworld-v0": ({"num_moves": 8},),
}  # fmt: skip
WITH_MODEL = [env_id for env_id in IDS if env_id not in WITHOUT_MODEL]
CASES = [(env_id, given) for env_id in WITH_MODEL for given in ({}, *VARIANTS.get(env_id, ()))]
# As they are by default, moves at random do not come everywhere in the time: these twins are tried in smaller worlds.
TOO_WIDE = [("neuralq/Landmarks-v0", {}), ("neuralq/SlideMaze-v0", {})]
TWINS = [(env_id, given) for env_id, given in CASES if env_id not in WITHOUT_TWIN and (env_id, given) not in TOO_WIDE]

ALPHA = 1e-5  # chance of each of the tests below to fail by bad luck; seeds are fixed, so it had its chance already
LIMIT = 100  # steps of an episode of the twins: worlds that never end start again too


class Law:
    """All that can follow each pair of a model, illegal ones included: M cells (pair, s_t, ended, reward) and chances.

    Missing mass ends the episode where it stands, a discount is the chance to go on, and an illegal action leaves the
    state with reward 0.
    """

    def __init__(self, model: FiniteMDP) -> None:
        self.size = num_states, num_actions = model.num_states, model.num_actions
        rows, found = np.arange(model.num_rows), model.outcomes
        if found is None:  # the row's reward comes whatever follows
            matrix = model.transition.tocoo()
            row, s_t = np.r_[matrix.row, rows], np.r_[matrix.col, model.s_tm1]
            p, reward = np.r_[matrix.data, model.termination], model.reward[row]
            ended = np.arange(len(row)) >= matrix.nnz
        else:
            missing = 1 - np.bincount(found.row, found.probability, minlength=len(rows))
            row, s_t = np.r_[found.row, rows], np.r_[found.s_t, model.s_tm1]
            p, reward = np.r_[found.probability, np.where(missing > 1e-9, missing, 0)], np.r_[found.reward, 0 * rows]
            ended = np.r_[found.terminated, rows >= 0]
        ended = ended | model.is_terminal[s_t]
        goes_on = model.row_discount[row]
        row, s_t, reward = (np.r_[x, x] for x in (row, s_t, reward))
        p, ended = np.r_[p * goes_on, p * (1 - goes_on)], np.r_[ended, ended | True]
        # The summaries that planning reads are those of this law.
        matrix = model.transition.multiply(~model.is_terminal * 1.0).multiply(model.row_discount[:, None])
        mine = sparse.coo_array((p * ~ended, (row, s_t)), shape=model.transition.shape)
        assert abs(mine.tocsr() - matrix.tocsr()).max() < 1e-12
        assert np.allclose(np.bincount(row, p * reward), model.reward, rtol=1e-12, atol=1e-12)
        s, a = np.nonzero(~model.legal & ~model.is_terminal[:, None])
        pair = np.r_[(model.s_tm1 * num_actions + model.a_tm1)[row], s * num_actions + a]
        s_t, ended, reward = np.r_[s_t, s], np.r_[ended, s < 0], np.r_[reward, 0.0 * s]
        p = np.r_[p, np.ones(len(s))]
        self._rewards, keep = np.unique(reward), p > 0
        keys = self._key(pair, s_t, ended, reward)[keep]
        self.key, first, cell = np.unique(keys, return_index=True, return_inverse=True)
        self.pair, self.s_t, self.ended, self.reward = (x[keep][first] for x in (pair, s_t, ended, reward))
        self.p = np.bincount(cell, p[keep])
        self.mean = np.bincount(self.pair, self.p * self.reward, minlength=num_states * num_actions)
        self.start = model.start_distribution
        assert np.allclose(np.bincount(self.pair, self.p)[self.pair], 1.0, atol=1e-9)

    def _key(self, pair: Any, s_t: Any, ended: Any, reward: Any) -> np.ndarray:
        number = np.minimum(np.searchsorted(self._rewards, reward), len(self._rewards) - 1)
        return ((pair * self.size[0] + s_t) * 2 + ended) * len(self._rewards) + number

    def cells(self, pair: np.ndarray, s_t: np.ndarray, ended: np.ndarray, reward: np.ndarray) -> np.ndarray:
        """The cell of each transition; −1 where the law has none."""
        key = self._key(pair, s_t, ended, reward)
        found = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        same = (self.key[found] == key) & (self.s_t[found] == s_t) & (self.reward[found] == reward)
        return np.where(same, found, -1)

    def reachable(self) -> np.ndarray:
        """Whether each state can be met on the way from the start, ``[S]``."""
        seen, before = self.start > 0, None
        while before is None or (seen != before).any():
            before = seen.copy()
            seen[self.s_t[~self.ended & seen[self.pair // self.size[1]]]] = True
        return seen

    def same(self, other: Law) -> bool:
        """Whether two models are one, to the bit."""
        fields = ("key", "pair", "s_t", "ended", "reward", "p", "start")
        return self.size == other.size and all(np.array_equal(getattr(self, f), getattr(other, f)) for f in fields)


law_of = functools.lru_cache(maxsize=64)(Law)  # a model never changes


class Tally:
    """What was seen, against a law; ``sigma`` is the deviation of normal noise on some pairs' rewards."""

    def __init__(self, model: FiniteMDP, sigma: float = 0.0) -> None:
        self.law, self.legal, self.sigma = law_of(model), model.legal, sigma
        self._count, self._starts = np.zeros(len(self.law.p), int), np.zeros(model.num_states, int)
        self._noise: list[tuple[np.ndarray, np.ndarray]] = []

    def begin(self, s: Any, mask: Any) -> None:
        """First states drawn, and the actions that are said to be legal there."""
        s = np.atleast_1d(s)
        assert (self.law.start[s] > 0).all(), f"started in {s[self.law.start[s] == 0][0]}, which is no start"
        assert (np.atleast_2d(mask) == self.legal[s]).all()
        self._starts += np.bincount(s, minlength=len(self._starts))

    def add(self, s: Any, a: Any, s_t: Any, reward: Any, ended: Any, mask: Any) -> None:
        """Transitions, and the actions that are said to be legal afterwards."""
        s, a, s_t, reward, ended = (np.atleast_1d(x) for x in (s, a, s_t, reward, ended))
        pair = s * self.law.size[1] + a
        if self.sigma > 0:
            self._noise.append((pair, reward - self.law.mean[pair]))
            reward = self.law.mean[pair]
        cells = self.law.cells(pair, s_t, ended, reward)
        assert (cells >= 0).all(), "never happens by the model: s={}, a={} -> s_t={}, reward={}, terminated={}".format(
            *(x[cells < 0][0] for x in (s, a, s_t, reward, ended))
        )
        assert (np.atleast_2d(mask) == self.legal[s_t]).all()
        self._count += np.bincount(cells, minlength=len(self._count))

    def judge(self, must_try: np.ndarray) -> None:
        """Every pair of ``must_try``, ``[S, A]``, was tried, and all frequencies are the law's."""
        law, tries = self.law, np.bincount(self.law.pair, self._count, minlength=must_try.size)
        untried = np.argwhere(must_try & (tries.reshape(must_try.shape) == 0))
        assert not untried.size, f"never tried: {untried[:5].tolist()} and more, {len(untried)} in all"
        _binomial(self._starts, self._starts.sum(), law.start)
        n, is_open = tries[law.pair], law.p < 1 - 1e-9
        expected = n * law.p
        _binomial(self._count[is_open], n[is_open], law.p[is_open])
        few = np.bincount(law.pair, expected < 5)[law.pair] > 0  # chi-square is for rows with enough in every cell
        rows = is_open & ~few
        if rows.any():
            off = ((self._count[rows] - expected[rows]) ** 2 / expected[rows]).sum()
            freedom = rows.sum() - len(np.unique(law.pair[rows]))
            assert stats.chi2.sf(off, freedom) > ALPHA, f"chi-square of {off:.0f} with {freedom} degrees of freedom"
        if self.sigma > 0:
            self._judge_noise()

    def _judge_noise(self) -> None:
        pair, noise = (np.concatenate(x) for x in zip(*self._noise, strict=True))
        noisy = np.unique(pair[noise != 0])
        assert noisy.size, "no reward is noisy"
        for one in noisy:
            z = noise[pair == one] / self.sigma
            mean, square = stats.norm.sf(abs(z.sum()) / np.sqrt(len(z))), stats.chi2.cdf((z**2).sum(), len(z))
            assert min(mean, square, 1 - square) > ALPHA / len(noisy), f"noise of pair {one}"


def _binomial(count: np.ndarray, n: Any, p: np.ndarray) -> None:
    tail = 2 * np.minimum(stats.binom.cdf(count, n, p), stats.binom.sf(count - 1, n, p))
    worst = int(np.argmin(tail)) if tail.size else -1
    assert not tail.size or tail[worst] * len(tail) > ALPHA, (
        f"{count[worst]} of {np.broadcast_to(n, p.shape)[worst]} where the chance is {p[worst]:.4f}"
    )


def sample_states(env: gymnasium.Env[Any, Any], tally: Tally) -> None:
    """From every state that has an action: each action once, twelve random rows 200 times; then some episodes."""
    law, rng = tally.law, np.random.default_rng(0)
    illegal = np.argwhere(~tally.legal & tally.legal.any(axis=1, keepdims=True))
    random_pairs = np.unique(law.pair[(law.p < 1 - 1e-9) | (tally.sigma > 0)])
    deep = np.stack(np.divmod(rng.permutation(random_pairs)[:12], law.size[1]), axis=1).repeat(200, axis=0)
    env.reset(seed=1)
    seen = []
    for s, a in np.concatenate([np.argwhere(tally.legal), rng.permutation(illegal)[:200], deep]).tolist():
        assert env.reset(options={"state": s})[0] == s, "an episode must start in the state that options name"
        seen.append((s, a, *_step(env, a)))
    tally.add(*map(np.array, zip(*seen, strict=True)))
    begun, seen = [_begin(env) for _ in range(200)], []
    s, mask = begun[-1]
    for _ in range(200):
        a = int(rng.choice(np.flatnonzero(mask)))
        seen.append((s, a, *_step(env, a)))
        s, _, ended, mask = seen[-1][2:]
        if ended:
            begun.append(_begin(env))
            s, mask = begun[-1]
    tally.add(*map(np.array, zip(*seen, strict=True)))
    tally.begin(*map(np.array, zip(*begun, strict=True)))
    tally.judge(tally.legal)


def _begin(env: gymnasium.Env[Any, Any]) -> tuple[int, np.ndarray]:
    s, extra = env.reset()
    return s, extra["action_mask"]


def _step(env: gymnasium.Env[Any, Any], a: int) -> tuple[int, float, bool, np.ndarray]:
    s_t, reward, terminated, truncated, extra = env.step(a)
    assert not truncated
    return s_t, float(reward), terminated, extra["action_mask"]


def sample_copies(envs: VectorEnv[Any, Any, Any], tally: Tally, limit: int = LIMIT) -> None:
    """Random episodes of all copies, one action in ten from the illegal ones too; whoever is over starts again."""
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED, "another mode restarts by itself: say how here"
    num_envs, rng = envs.num_envs, np.random.default_rng(0)
    age, a, lane = np.zeros(num_envs, int), np.zeros(num_envs, int), np.arange(num_envs)
    s, extra = envs.reset(seed=1)
    tally.begin(s, extra["action_mask"])
    for _ in range(2 * limit if num_envs < 10_000 else 40):
        allowed = extra["action_mask"] | (rng.random(num_envs) < 0.1)[:, None]
        again = (rng.random(num_envs) < 0.7) & (allowed[lane, a] > 0)  # runs of one action get to far corners
        a = np.where(again, a, (rng.random(allowed.shape) * allowed).argmax(axis=1))
        s_t, reward, terminated, truncated, extra = envs.step(a)
        tally.add(s, a, s_t, reward, terminated, extra["action_mask"])
        age += 1
        assert (truncated == (age == limit))[~terminated].all()
        over, s = terminated | truncated, s_t
        if over.any():
            s, extra = envs.reset(options={"reset_mask": over})
            assert (s == s_t)[~over].all(), "a copy was moved that was not to start again"
            tally.begin(s[over], extra["action_mask"][over])
            age[over] = 0
    tally.judge(tally.legal & tally.law.reachable()[:, None])


def num_copies(model: FiniteMDP) -> int:
    return 20_000 if model.num_states > 1000 else 1000


def made(env_id: str, given: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(env_id, disable_env_checker=True, **given)


def sigma(env_id: str, given: dict[str, Any]) -> float:
    if env_id not in NOISE:
        return 0.0
    spec, keyword = gymnasium.spec(env_id), NOISE[env_id]
    return {keyword: _keywords(spec.entry_point)[keyword].default, **spec.kwargs, **given}[keyword]


def _keywords(entry_point: Any) -> dict[str, inspect.Parameter]:
    creator: Callable[..., Any] = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return dict(inspect.signature(creator).parameters)


def _name(value: Any) -> str:
    return value.removeprefix("neuralq/") if isinstance(value, str) else ",".join(value) or "default"


@pytest.mark.parametrize(("env_id", "given"), CASES, ids=_name)
def test_an_environment_steps_as_its_model_says(env_id: str, given: dict[str, Any]) -> None:
    env = made(env_id, given)
    model = FiniteMDP.from_gymnasium(env)
    assert (env.observation_space.n, env.action_space.n) == (model.num_states, model.num_actions)
    sample_states(env, Tally(model, sigma(env_id, given)))
    assert law_of(FiniteMDP.from_gymnasium(env)).same(law_of(model)), "the world changed while it was sampled"


@pytest.mark.parametrize(("env_id", "given"), TWINS, ids=_name)
def test_a_vectorised_twin_steps_as_the_model_of_one_says(env_id: str, given: dict[str, Any]) -> None:
    model = FiniteMDP.from_gymnasium(made(env_id, given))
    envs = gymnasium.make_vec(
        env_id, num_copies(model), vectorization_mode="vector_entry_point", max_episode_steps=LIMIT, **given
    )
    own = getattr(envs.unwrapped, "mdp", None)
    assert own is None or law_of(own()).same(law_of(model)), "the twin has another model"
    sample_copies(envs, Tally(model, sigma(env_id, given)))


def _models() -> dict[str, FiniteMDP]:
    """Whatever a row can have: an end on the way, missing mass, illegal actions, a discount, rewards of its own."""
    rows: dict[tuple[int, int], list[tuple[float, int, float, bool]]] = {
        (0, 0): [(0.3, 0, 1.0, False), (0.4, 1, 5.0, False), (0.2, 1, -7.0, True)],
        (0, 2): [(0.5, 1, 1.0, False), (0.25, 1, 2.0, False), (0.25, 3, 2.0, False)],
        (1, 1): [(0.6, 2, 0.5, False), (0.3, 3, 4.0, False), (0.1, 3, 5.0, True)],
        (2, 0): [(1.0, 0, 2.0, False)],
        (2, 1): [(0.05, 0, 0.0, False), (0.95, 1, 0.0, False)],
    }
    outcomes = FiniteMDP.from_functions(
        4, 3, lambda s: [a for b, a in rows if b == s], lambda s, a: rows[s, a], substochastic=True,
        start=[0.1, 0.6, 0.3, 0.0],
    )  # fmt: skip
    matrix = FiniteMDP.from_arrays(
        [[[0.2, 0.5, 0.2], [0.1, 0.6, 0.3], [0, 0, 0]], [[0, 0, 0], [0.5, 0.0, 0.1], [0, 0, 0]]],
        [[3.0, np.nan], [-1.0, 2.0], [np.nan, np.nan]],
        substochastic=True,
    )
    garnet = FiniteMDP.garnet(20, 3, 5, seed=1)
    discount = np.linspace(0.2, 1.0, garnet.num_rows)
    discounted = FiniteMDP(20, 3, garnet.s_tm1, garnet.a_tm1, garnet.transition, garnet.reward, discount)
    lake = FiniteMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"))
    return {"outcomes": outcomes, "matrix": matrix, "garnet": garnet, "discounted": discounted, "lake": lake}


@pytest.mark.parametrize("name", _models())
def test_any_model_is_simulated_as_it_stands(name: str) -> None:
    model = _models()[name]
    sample_states(model.as_env(), Tally(model))
    sample_copies(model.as_vector_env(num_copies(model), max_episode_steps=LIMIT), Tally(model))


@pytest.mark.parametrize("env_id", WITH_MODEL)
def test_every_keyword_is_tried_with_a_value_that_changes_the_model(env_id: str) -> None:
    spec = gymnasium.spec(env_id)
    known = set(_keywords(spec.entry_point)) - {"render_mode"}
    if env_id not in WITHOUT_TWIN:
        assert set(_keywords(spec.vector_entry_point)) - {"num_envs", "max_episode_steps"} == known
    deaf = {NOISE[env_id]} if env_id in NOISE else set()
    told = {keyword for given in VARIANTS.get(env_id, ()) for keyword in given if _changes(env_id, given, keyword)}
    assert told == known - deaf, "give each keyword a value in VARIANTS"
    assert deaf <= {keyword for given in VARIANTS.get(env_id, ()) for keyword in given}


def _changes(env_id: str, given: dict[str, Any], keyword: str) -> bool:
    without = {name: value for name, value in given.items() if name != keyword}
    one, other = (law_of(FiniteMDP.from_gymnasium(made(env_id, kwargs))) for kwargs in (given, without))
    return not one.same(other)


def test_who_has_no_model_or_no_twin_is_named() -> None:
    assert len(IDS) >= 17 and set(VARIANTS) <= set(IDS) and set(NOISE) <= set(IDS)
    assert {i for i in IDS if gymnasium.spec(i).vector_entry_point is None} == set(WITHOUT_TWIN)
    for env_id in WITHOUT_MODEL:
        with pytest.raises(ValueError, match="no transition table"):
            FiniteMDP.from_gymnasium(made(env_id, {}))


def test_the_twins_without_a_model_are_held_to_the_bit_elsewhere() -> None:
    elsewhere = importlib.import_module("test_envs_classic")
    assert callable(elsewhere.test_whole_episodes_are_gymnasiums_to_the_bit)
    assert callable(elsewhere.test_one_step_from_anywhere_is_gymnasiums)
    twins = {i: twin[0] for i, spec in gymnasium.registry.items() if (twin := vector_twin(spec, {})) is not None}
    assert set(twins.values()) == set(neuralq_envs.CLASSIC) == {i for i in IDS if WITHOUT_MODEL.get(i) == TO_THE_BIT}
    assert elsewhere.IDS.items() <= twins.items() and set(elsewhere.IDS.values()) == set(twins.values())
