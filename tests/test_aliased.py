"""States that look alike: the optimum over histories, the value without memory, and the best policy without memory.

Mutants that die here: beliefs that forget weights, that keep whoever has ended, or that do not look at what is observed
next; a discount of rows left out; a bound that takes the least of a state's actions, or one of an action that was
decided against; a search that prunes what is better by less than a tenth, or calls itself complete when it was cut off;
policies that never end taken for cheap; percepts of the wrong neighbours.
"""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from neuralq.exact import best_memoryless, evaluate_memoryless, solve, solve_histories
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq_envs.aliased import AliasedGridEnv, littman, mccallum, mccallum_grid
from neuralq_envs.grids import Grid

SWAP = AliasedMDP(FiniteMDP.from_arrays([[[0, 1], [0, 1]], [[1, 0], [1, 0]]], [[1.0, -1.0], [-1.0, 1.0]]), [0, 0])
"""Singh, Jaakkola & Jordan 1994: a move to the other of two states pays 1, a refused one costs 1."""


def steps_of(aliased: AliasedMDP) -> AliasedMDP:
    """The same with every reward −1."""
    mdp = aliased.mdp
    costs = FiniteMDP(
        mdp.num_states, mdp.num_actions, mdp.s_tm1, mdp.a_tm1, mdp.transition, -np.ones(mdp.num_rows), start=mdp.start
    )
    return AliasedMDP(costs, aliased.observation)


def random_aliased(seed: int, *, certain: bool, costs: bool) -> AliasedMDP:
    """Six states of three looks, two to three actions by what it looks like, some rows that end or discount."""
    rng = np.random.default_rng(seed)
    observation = np.array([0, 0, 1, 1, 2, 2])
    p = np.zeros((3, 6, 6))
    for a, s in itertools.product(range(3), range(6)):
        p[a, s, rng.choice(6, 1 if certain else 2, replace=False)] = 1.0 if certain else 0.5
        if rng.random() < 0.25:
            p[a, s] *= 0.0 if certain else 0.5
    reward = -rng.random((6, 3)) if costs else rng.normal(size=(6, 3))
    reward[observation == rng.integers(3), 2] = np.nan
    made = FiniteMDP.from_arrays(p, reward, substochastic=True, start=rng.dirichlet(np.ones(6)))
    discount = np.where(rng.random(made.num_rows) < 0.2, 0.5, 1.0)
    mdp = FiniteMDP(6, 3, made.s_tm1, made.a_tm1, made.transition, made.reward, discount, made.start)
    return AliasedMDP(mdp, observation)


def plain_value(aliased: AliasedMDP, policy: tuple[int, ...], gamma: float) -> float:
    """Of the start: what 2^40 steps earn, twice as many at a time; −∞ where something is left after them."""
    mdp = aliased.mdp
    rows = [mdp.row_index[s, policy[o]] for s, o in enumerate(aliased.observation)]
    p = gamma * mdp.row_discount[rows][:, None] * mdp.transition.toarray()[rows]
    v = mdp.reward[rows]
    for _ in range(40):
        v, p = v + p @ v, p @ p
    return float(mdp.start_distribution @ v) if (mdp.start_distribution @ p).sum() < 1e-9 else -np.inf


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("certain", [True, False])
def test_branch_and_bound_finds_the_best_of_all_policies_without_memory(seed: int, certain: bool) -> None:
    for gamma, costs in ((0.9, False), (1.0, True)):
        aliased = random_aliased(seed, certain=certain, costs=costs)
        if gamma == 1.0:
            try:
                solve(aliased.mdp, 1.0)
            except ValueError:  # from somewhere nothing ends
                continue
        choices = [np.flatnonzero(one).tolist() for one in aliased.legal]
        values = {policy: plain_value(aliased, policy, gamma) for policy in itertools.product(*choices)}
        found = best_memoryless(aliased, gamma)
        best = max(values.values())
        assert found.proved and found.value == pytest.approx(best, abs=1e-9) and found.bound == found.value
        assert values[tuple(found.policy.tolist())] == pytest.approx(best, abs=1e-9)
        if gamma < 1:
            v = evaluate_memoryless(aliased, found.policy, gamma)
            assert v @ aliased.mdp.start_distribution == pytest.approx(best, abs=1e-9)
        cut = best_memoryless(aliased, gamma, max_bounds=1)
        assert cut.bound >= best - 1e-9 and cut.value <= best + 1e-9
        assert cut.proved == (cut.bound <= cut.value + 1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_beliefs_are_as_good_as_the_best_of_all_policies_of_histories(seed: int) -> None:
    """Two moves from one of four states of two looks, by all 2^10 policies of what was observed and done."""
    rng = np.random.default_rng(seed)
    to, reward, look = rng.integers(4, size=(4, 2)), rng.normal(size=(8, 2)), rng.integers(2, size=8)
    start, goes_on = rng.dirichlet(np.ones(4)), rng.random((4, 2)) < 0.8
    half = np.where(rng.random((4, 2)) < 0.3, 0.5, 1.0)
    gamma = 0.8
    p = np.zeros((2, 8, 8))
    for s, a in itertools.product(range(4), range(2)):
        p[a, s, 4 + to[s, a]] = goes_on[s, a]
    made = FiniteMDP.from_arrays(p, reward, substochastic=True, start=np.append(start, np.zeros(4)))
    discount = np.append(half.reshape(-1), np.ones(8))
    mdp = FiniteMDP(8, 2, made.s_tm1, made.a_tm1, made.transition, made.reward, discount, made.start)
    histories: list[Any] = [(o,) for o in range(2)]
    histories += [(o, a, o_t) for o, a, o_t in itertools.product(range(2), repeat=3)]
    best = -np.inf
    for policy in itertools.product(range(2), repeat=len(histories)):
        act = dict(zip(histories, policy, strict=True))
        total = 0.0
        for s in range(4):
            a = act[(look[s],)]
            total += start[s] * reward[s, a]
            s_t = 4 + to[s, a]
            then = act[(look[s], a, look[s_t])]
            total += start[s] * goes_on[s, a] * gamma * half[s, a] * reward[s_t, then]
        best = max(best, total)
    assert solve_histories(AliasedMDP(mdp, look), gamma).value == pytest.approx(best, abs=1e-9)


def test_littmans_maze_takes_416_steps_without_memory_and_404_with_the_cell_in_sight() -> None:
    """Littman 1994: 416 by branch and bound; the tests of ours that follow one policy count steps one by one."""
    maze = littman()
    assert np.count_nonzero(maze.mdp.start_distribution) == 46 and int(maze.legal.any(axis=1).sum()) == 30
    assert solve(maze.mdp, 1.0).v.sum() == pytest.approx(-404)
    found = best_memoryless(maze, 1.0)
    assert found.proved and 46 * found.value == pytest.approx(-416) and found.num_bounds < 1000
    env = gymnasium.make("neuralq/LittmanMaze-v0")
    assert isinstance(env.unwrapped, AliasedGridEnv)
    steps = 0
    for s in np.flatnonzero(maze.mdp.start_distribution).tolist():
        o, _ = env.reset(options={"state": s})
        terminated = False
        while not terminated:
            o, _, terminated, _, _ = env.step(int(found.policy[o]))
            steps += 1
    assert steps == 416


def test_the_m_takes_4_3_steps_with_memory_and_8_03_by_a_coin() -> None:
    maze = steps_of(mccallum())
    assert solve(maze.mdp, 1.0).v.sum() / 10 == pytest.approx(-3.9)
    found = solve_histories(maze, 1.0)
    assert found.value == pytest.approx(-4.3) and len(found.beliefs) == 14
    assert best_memoryless(maze, 1.0).value == -np.inf and best_memoryless(maze, 1.0).proved
    steps = [len(way) for way in followed(maze, found)]
    assert sum(steps) == 43 and len(steps) == 10
    north_of, east_of = maze.observation[5], maze.observation[1]  # {4, 5, 6} and {8, 10}
    policy = np.zeros((6, 4))
    policy[maze.observation[[0, 2, 4, 10]], [1, 2, 3, 0]] = 1.0  # the corners, the middle above, the feet
    values = {}
    for north, east in itertools.product((0.35, 0.4, 0.45), (0.45, 0.5, 0.55)):
        policy[north_of] = (north, 0, 1 - north, 0)
        policy[east_of] = (0, east, 0, 1 - east)
        v = evaluate_memoryless(maze, policy, 1.0)
        values[round(north, 2), round(east, 2)] = -float(v @ maze.mdp.start_distribution)
    best = min(values, key=lambda one: values[one])
    assert best == (0.4, 0.5) and values[best] == pytest.approx(8.03, abs=5e-3)


def followed(maze: AliasedMDP, found: Any) -> list[list[int]]:
    """The cells from every start under the optimal policy, which is only told what is observed."""
    numbers = {tuple(states.tolist()): b for b, (states, _) in enumerate(found.beliefs)}
    ways = []
    for first in np.flatnonzero(maze.mdp.start_distribution).tolist():
        possible = np.flatnonzero((maze.observation == maze.observation[first]) & (maze.mdp.start_distribution > 0))
        s, way = first, []
        while s >= 0:
            a = int(found.solution.policy[numbers[tuple(possible.tolist())]])
            moved = [maze.mdp.transition[[maze.mdp.row_index[one, a]]].indices for one in possible]
            way.append(s)
            (s,) = maze.mdp.transition[[maze.mdp.row_index[s, a]]].indices.tolist() or (-1,)
            possible = np.unique(
                [one[0] for one in moved if one.size and maze.observation[one[0]] == maze.observation[s]]
            )
        ways.append(way)
    return ways


def test_without_memory_a_coin_may_be_best_and_with_it_one_step_tells() -> None:
    """−γ/(1−γ) for either action, 0 for a coin, γ/(1−γ) for who remembers: after one move it is known where it led."""
    for policy, value in (([0], -9.0), ([1], -9.0), ([[0.5, 0.5]], 0.0)):
        assert evaluate_memoryless(SWAP, policy, 0.9).mean() == pytest.approx(value)
    assert best_memoryless(SWAP, 0.9).value == pytest.approx(-9.0)
    assert solve_histories(SWAP, 0.9).value == pytest.approx(9.0)


def test_who_has_ended_is_not_among_those_that_may_still_be() -> None:
    """1 → 0 → the end, which looks like both: 1/2 · 1 + 1/2 · γ."""
    way = FiniteMDP.from_arrays([[[0, 0, 1], [1, 0, 0], [0, 0, 0]]], [[1.0], [0.0], [np.nan]])
    assert solve_histories(AliasedMDP(way, np.zeros(3, dtype=int)), 0.5).value == pytest.approx(0.75)


def test_percepts_are_walls_around_a_cell() -> None:
    grid = Grid("..x\n.#.\nG..")
    # Walls N, E, S, W of each cell: the closed one and the edge count, the goal does not.
    assert grid.percepts().tolist() == [0, 1, 0, 2, 0, 3, 4, 5, 6]
    wide = Grid("...\n...\n...\n...\n..#")  # the cells in the middle of rows 1 and 3 differ in one corner
    assert wide.percepts(4)[4] == wide.percepts(4)[10] and wide.percepts(8)[4] != wide.percepts(8)[10]
    names = {int(o): set(np.flatnonzero(mccallum().observation == o).tolist()) for o in mccallum().observation}
    inside = {cell for cell, sign in enumerate(mccallum_grid().signs) if sign != "#"}
    assert sorted(map(sorted, (cells & inside for cells in names.values()))) == [
        [0], [1, 3], [2], [4], [5, 7, 9], [10, 12, 14]
    ]  # fmt: skip
    rows = mccallum().mdp
    assert rows.reward[rows.row_index[7]].tolist() == [-0.1, -1.0, 5.0, -1.0]


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: AliasedMDP(SWAP.mdp, [0]), "2 whole numbers from 0"),
        (lambda: AliasedMDP(SWAP.mdp, [0.0, 1.0]), "2 whole numbers from 0"),
        (lambda: AliasedMDP(SWAP.mdp, [0, -1]), "2 whole numbers from 0"),
        (lambda: AliasedMDP(SWAP.mdp, [0, 0], ["a", "b"]), "must hold 1 names, got 2"),
        (lambda: evaluate_memoryless(SWAP, [0, 0], 0.9), "one for each observation, got shape"),
        (lambda: best_memoryless(SWAP, 1.0), "row 0 .*has reward 1; use gamma < 1"),
        (lambda: solve_histories(SWAP, 0.9, max_beliefs=1), "more than 1 beliefs can come up"),
        (
            lambda: solve_histories(AliasedMDP(FiniteMDP.garnet(3, 1, 2, seed=0), [0, 0, 0]), 0.9),
            "row 0 .*to chance; .* best_memoryless",
        ),
        (lambda: Grid("S.G").percepts(5), "num_neighbours must be one of 4, 8"),
        (lambda: Grid("S.G", bump_reward=np.nan), "bump_reward must be finite"),
        (lambda: gymnasium.make("neuralq/LittmanMaze-v0", maze="thrun"), "maze must be one of"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act()


def test_ways_out_work() -> None:
    chancy = AliasedMDP(FiniteMDP.garnet(3, 2, 2, seed=0), [0, 0, 0])
    assert best_memoryless(chancy, 0.9).proved and best_memoryless(SWAP, 0.99).proved
    assert solve_histories(SWAP, 0.9, max_beliefs=3).value == pytest.approx(9.0)
    assert AliasedMDP(SWAP.mdp, [0, 1], ["here", "there"]).observation_name(1) == "observation 1 (there)"


@pytest.mark.parametrize("env_id", ["neuralq/LittmanMaze-v0", "neuralq/McCallumMaze-v0"])
def test_the_mazes_are_environments_of_gymnasium(env_id: str) -> None:
    check_env(gymnasium.make(env_id, render_mode="rgb_array").unwrapped)
    env = gymnasium.make(env_id, render_mode="ansi").unwrapped
    assert isinstance(env, AliasedGridEnv)
    o, extra = env.reset(seed=3)
    assert o == env.model.observation[extra["state"]] and str(env.render()).count("A") == 1
    again = [env.reset(seed=3)[1]["state"] for _ in range(2)]
    assert again == [extra["state"]] * 2


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["neuralq/LittmanMaze-v0", "neuralq/McCallumMaze-v0"])
def test_the_mazes_keep_their_word_for_many_random_steps(env_id: str) -> None:
    env = gymnasium.make(env_id)
    model = env.unwrapped.model  # type: ignore[attr-defined]
    rng, seen = np.random.default_rng(0), set()
    o, extra = env.reset(seed=0)
    for _ in range(100_000):
        s, a = extra["state"], int(rng.integers(4))
        row = model.mdp.row_index[s, a]
        o, reward, terminated, _, extra = env.step(a)
        assert o == model.observation[extra["state"]] and reward == model.mdp.reward[row]
        assert terminated == (model.mdp.termination[row] == 1.0)
        assert terminated or model.mdp.transition[[row]].indices.tolist() == [extra["state"]]
        seen.add((s, a))
        if terminated:
            o, extra = env.reset()
    assert len(seen) == model.mdp.num_rows
