"""Planning with a learned model: Dyna mazes, prioritized sweeping against value iteration, and the queue itself.

Planted mistakes that these tests kill: predecessors not measured again after a value changed; the queue ordered by the
smallest error; a bonus for real steps; untried actions planned with in plain Dyna-Q; the model of a pair that ends
bootstrapping; the last outcome used where the expected one is meant; imagined updates counted as visits.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from neuralq.exact import solve
from neuralq.mdp import AliasedMDP, FiniteMDP
from neuralq.tabular import (
    EpsilonGreedy,
    RunOptions,
    compile_model,
    dyna_q,
    over_seeds,
    prioritized_sweeping,
    q_lambda,
    q_learning,
    queue_dyna,
    sarsa_lambda,
)
from neuralq.tabular.engine import Learner, new_table
from neuralq.tabular.kernels.acting import FORGET, new_log, new_walk
from neuralq.tabular.kernels.sweeping import FULL, HEAP_SIZE, _offer, _pop, new_memory
from neuralq.tabular.planning import dyna_learner, sweeping_learner
from neuralq.tabular.policies import step_code

WALLS = {(1, 2), (2, 2), (3, 2), (4, 5), (0, 7), (1, 7), (2, 7)}
ROW_3 = {(3, x) for x in range(8)}  # the wall of the blocking maze, open at the right end


def maze(walls: set[tuple[int, int]], start: tuple[int, int]) -> FiniteMDP:
    """Sutton's 6 x 9 mazes: goal top right, reward 1 there; a step into a wall stays."""
    legal_cells = [9 * y + x for y in range(6) for x in range(9) if (y, x) != (0, 8)]

    def move(s: int, a: int) -> list[tuple[float, int, float, bool]]:
        dy, dx = [(-1, 0), (0, 1), (1, 0), (0, -1)][a]
        y, x = s // 9 + dy, s % 9 + dx
        s_t = s if not (0 <= y < 6 and 0 <= x < 9) or (y, x) in walls else 9 * y + x
        return [(1.0, s_t, float(s_t == 8), s_t == 8)]

    return FiniteMDP.from_functions(
        54, 4, lambda s: range(4) if s in legal_cells else [], move, start=np.eye(54)[9 * start[0] + start[1]]
    )


def greedy_steps(q: np.ndarray, mdp: FiniteMDP) -> int:
    """Length of the greedy path from the start, 10,000 if it never arrives."""
    successor, s = successors(mdp), int(np.argmax(mdp.start_distribution))
    for steps in range(1, 100):
        s = int(successor[mdp.row_index[s, int(np.argmax(q[s]))]])
        if s < 0:
            return steps
    return 10_000


@cache
def successors(mdp: FiniteMDP) -> np.ndarray:
    """The state each row of a deterministic model leads to, −1 for the end."""
    dense = mdp.transition.toarray()
    return np.where(dense.sum(axis=1) > 0, dense.argmax(axis=1), -1)


@cache
def dyna_maze() -> FiniteMDP:
    return maze(WALLS, (2, 0))


def test_the_optimum_of_the_dyna_maze_is_14_steps() -> None:
    answer = solve(dyna_maze(), 0.95)
    assert np.isclose(answer.v[18], 0.95**13)
    assert greedy_steps(np.nan_to_num(answer.q, nan=-1.0), dyna_maze()) == 14


def test_planning_steps_shorten_the_second_episode() -> None:
    model, options = compile_model(dyna_maze()), RunOptions(record_experience=True)
    mean = {}
    for num_planning, num_steps in ((0, 8000), (5, 4000), (50, 4000)):
        band = over_seeds(
            lambda seed, n=num_planning, t=num_steps: dyna_q(
                model, t, 0.95, num_planning=n, seed=seed, options=options
            ), 30,
        )  # fmt: skip
        mean[num_planning] = np.mean([run.episode_lengths[1] for run in band.runs])
        late = np.mean([run.episode_lengths[20:].mean() for run in band.runs if len(run.episode_lengths) > 20])
        if num_planning:
            assert late < 20
    # Published: the agent of n = 0 needs about 25 episodes, n = 5 about 5, n = 50 about 3; measured 1126, 139, 41.
    assert 700 < mean[0] < 1700 and 90 < mean[5] < 220 and 25 < mean[50] < 70


def test_dyna_without_planning_is_q_learning() -> None:
    mdp = FiniteMDP.garnet(5, 2, 3, seed=0)
    plain = q_learning(mdp, 500, 0.9, step_size=0.1, seed=3)
    dyna = dyna_q(mdp, 500, 0.9, num_planning=0, step_size=0.1, seed=3)
    assert np.array_equal(plain.q, dyna.q) and np.array_equal(plain.visits, dyna.visits) and dyna.num_backups == 500
    planned = dyna_q(mdp, 500, 0.9, num_planning=4, step_size=0.1, seed=3)
    assert planned.visits.sum() == 500 and planned.num_backups == 2500


def test_dyna_plus_believes_that_untried_actions_stay_and_rewards_neglect() -> None:
    # One state, two actions; action 0 gives 0 and stays. α = 1, γ = .5, κ = 2. After one real step action 1 was never
    # taken: τ = 1, believed target = 0 + 2·√1 + γ V; action 0: τ = 0, target 0 + γ V. Fixed point: Q1 = 4, Q0 = 2.
    mdp = FiniteMDP.from_arrays([[[1.0]], [[1.0]]], [[0.0, 0.0]])
    lazy = EpsilonGreedy(0.0, ties="lowest")
    plus = dyna_q(mdp, 1, 0.5, num_planning=200, kappa=2.0, step_size=1.0, policy=lazy)
    assert np.allclose(plus.q, [[2.0, 4.0]])
    plain = dyna_q(mdp, 1, 0.5, num_planning=200, step_size=1.0, policy=lazy)
    assert np.allclose(plain.q, [[0.0, 0.0]]) and plain.visits.tolist() == [[1, 0]]


@pytest.mark.parametrize(("before", "after", "change", "num_steps", "n", "kappa", "ratio", "expected"), [
    (ROW_3, {(3, x) for x in range(1, 9)}, 1000, 3000, 10, 1e-4, 1.2, 71),
    ({(3, x) for x in range(1, 9)}, {(3, x) for x in range(1, 8)}, 3000, 6000, 50, 1e-3, 1.25, 226),
], ids=["blocking", "shortcut"])  # fmt: skip
def test_dyna_plus_notices_that_the_maze_changed(
    before: set[tuple[int, int]], after: set[tuple[int, int]], change: int, num_steps: int, n: int, kappa: float,
    ratio: float, expected: float,
) -> None:  # fmt: skip
    model = compile_model(maze(before, (5, 3)))
    options = RunOptions(record_experience=True, change=(change, maze(after, (5, 3))))

    def reward_after(k: float) -> float:
        band = over_seeds(lambda seed: dyna_q(
            model, num_steps, 0.95, num_planning=n, kappa=k, step_size=1.0, seed=seed, options=options
        ), 12)  # fmt: skip
        return float(np.mean([run.experience.r_t[change:].sum() for run in band.runs]))  # type: ignore[union-attr]

    plain, plus = reward_after(0.0), reward_after(kappa)
    assert plus > plain * ratio and abs(plus - expected) < 15


@pytest.mark.parametrize("rule", ["watkins", "peng", "naive"])
def test_traces_shorten_the_second_episode_of_the_maze(rule: str) -> None:
    model, options = compile_model(dyna_maze()), RunOptions(record_experience=True)

    def second(lambda_: float) -> float:
        band = over_seeds(lambda seed: q_lambda(
            model, 8000, 0.95, lambda_=lambda_, rule=rule, trace="replacing", step_size=0.1, seed=seed, options=options
        ), 20)  # fmt: skip
        return float(np.mean([run.episode_lengths[1] for run in band.runs]))

    assert second(0.9) < 0.75 * second(0.0)


def littmans_view(mdp: FiniteMDP) -> np.ndarray:
    """What the agent sees of each cell of the Dyna maze: which of the eight neighbours are free."""
    free = {(y, x) for y in range(6) for x in range(9)} - WALLS
    around = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    codes = [sum(((s // 9 + dy, s % 9 + dx) in free) << k for k, (dy, dx) in enumerate(around)) for s in range(54)]
    seen = np.unique([codes[s] for s in range(54) if (s // 9, s % 9) in free and s != 8])
    assert len(seen) == 30
    return np.array([int(np.searchsorted(seen, code)) if code in seen else 30 for code in codes])


def total_steps(policy: np.ndarray, seen: np.ndarray, mdp: FiniteMDP) -> float:
    """Sum of the lengths of the paths from the 46 free cells under a policy over observations."""
    successor, total = successors(mdp), 0.0
    for start in range(54):
        if (start // 9, start % 9) in WALLS or start == 8:
            continue
        s = start
        for _ in range(100):
            s = int(successor[mdp.row_index[s, policy[seen[s]]]])
            total += 1
            if s < 0:
                break
        else:
            return np.inf
    return total


@pytest.mark.slow
def test_sarsa_lambda_finds_a_good_memoryless_policy_and_one_step_q_learning_does_not() -> None:
    maze_ = dyna_maze()
    cells = np.array([(s // 9, s % 9) not in WALLS and s != 8 for s in range(54)])
    mdp = FiniteMDP(54, 4, maze_.s_tm1, maze_.a_tm1, maze_.transition, maze_.reward, None, cells / 46,
                    outcomes=maze_.outcomes)  # fmt: skip
    seen = littmans_view(mdp)
    shortest = solve(mdp, 0.95).v[cells]
    assert np.isclose((1 + np.log(shortest) / np.log(0.95)).sum(), 404)
    model = compile_model(AliasedMDP(mdp, seen))
    policy = EpsilonGreedy(0.2, 0.0, 900_000)
    followed = over_seeds(
        lambda seed: sarsa_lambda(
            model, 1_000_000, 0.95, lambda_=0.9, trace="replacing", policy=policy, step_size=0.05, seed=seed
        ),
        10,
    )
    plain = over_seeds(lambda seed: q_learning(
        model, 1_000_000, 0.95, policy=policy, step_size=0.05, seed=seed), 10)  # fmt: skip
    good = [total_steps(run.policy, seen, mdp) for run in followed.runs]
    bad = [total_steps(run.policy, seen, mdp) for run in plain.runs]
    assert min(good) >= 416 and sum(x <= 420 for x in good) >= 8, (good, bad)
    assert sum(x > 420 for x in bad) >= 8


def backups_until_optimal(learner: Learner, seed: int, mdp: FiniteMDP) -> int:
    model, walk, log = compile_model(mdp), new_walk(seed), new_log(0, FORGET)
    for _ in range(4000):
        learner.run(model.arrays, walk, log, 0.95, 20)
        if greedy_steps(learner.table.q, mdp) == 14:
            assert learner.backups is not None
            return int(learner.backups[0])
    return 10**9


def test_prioritized_sweeping_needs_fewer_backups_than_dyna() -> None:
    mdp, policy = dyna_maze(), EpsilonGreedy(0.1)
    dyna, swept = [], []
    for seed in range(5):
        table, _ = new_table(mdp, RunOptions())
        dyna.append(backups_until_optimal(dyna_learner(table, policy, step_code(1.0, 1), 5, 0.0), seed, mdp))
        table, _ = new_table(mdp, RunOptions(initial_q=1.0))
        memory = new_memory(table.q.shape, 1)
        learner = sweeping_learner(table, policy, step_code(1.0, 1), memory, FULL, 5, 1e-4, bored=1, optimistic=1.0)
        swept.append(backups_until_optimal(learner, seed, mdp))
    assert np.median(dyna) >= 3 * np.median(swept) and max(swept) < 10**9


@pytest.mark.parametrize("seed", range(3))
def test_an_empty_queue_leaves_no_error_and_the_fixed_point_is_that_of_value_iteration(seed: int) -> None:
    mdp = FiniteMDP.garnet(6, 2, 3, seed=seed)
    table, ready = new_table(mdp, RunOptions())
    threshold = 1e-9
    memory = new_memory(table.q.shape, 3)
    learner = sweeping_learner(table, "random", step_code(1.0, 1), memory, FULL, 10_000, threshold)
    walk, options = new_walk(seed), new_log(0, FORGET)
    learner.run(ready.arrays, walk, options, 0.8, 3000)  # type: ignore[union-attr]
    assert memory.counters[HEAP_SIZE] == 0
    p = np.zeros((2, 6, 6))
    for s in range(6):
        for a in range(2):
            n = memory.times[2 * s + a]
            p[a, s, memory.s_t[2 * s + a].astype(int)] += n / n.sum()
    assert (memory.times.sum(axis=1).reshape(6, 2) == table.visits).all()
    r = (memory.reward / memory.times.sum(axis=1)).reshape(6, 2)
    error = r + 0.8 * np.einsum("ast,t->sa", p, table.q.max(axis=1)) - table.q
    assert np.abs(error).max() <= threshold * 1.01
    assert np.allclose(table.q, solve(FiniteMDP.from_arrays(p, r), 0.8).q, atol=1e-7)
    assert np.abs(table.q - solve(mdp, 0.8).q).max() < 0.6  # the counted model is near the true one


def test_the_queue_gives_the_largest_first_also_after_changes() -> None:
    rng, memory, threshold = np.random.default_rng(0), new_memory((1, 40), 1), 0.1
    held: dict[int, float] = {}
    popped = 0
    for _ in range(600):
        pair, priority = int(rng.integers(40)), float(rng.random())
        if rng.random() < 0.6:
            _offer(memory, np.uint64(pair), priority, threshold)
            if pair in held or priority > threshold:
                held[pair] = priority
        elif held:
            assert int(_pop(memory)) == max(held, key=held.__getitem__)
            held.pop(max(held, key=held.__getitem__))
            popped += 1
        assert memory.counters[HEAP_SIZE] == len(held)
        assert all(int(memory.heap[memory.place[pair]]) == pair for pair in held)
    assert popped > 150


def test_a_pair_is_worth_the_optimum_until_it_is_boring() -> None:
    # One state that pays nothing: r_opt / (1 − γ) = 2 until the second try, then γ · 2 = 1, and so on down.
    mdp = FiniteMDP.from_arrays([[[1.0]]], [[0.0]])
    for num_steps, value in ((1, 2.0), (2, 1.0), (3, 0.5)):
        learned = prioritized_sweeping(
            mdp, num_steps, 0.5, num_planning=1, bored_after=2, optimistic_reward=1.0, options=RunOptions()
        )
        assert learned.q.tolist() == [[value]]


def test_optimism_tries_every_pair_and_then_forgets_itself() -> None:
    mdp = FiniteMDP.garnet(6, 3, 1, seed=4)
    greedy = EpsilonGreedy(0.0, ties="lowest")
    best = float(mdp.reward.max())
    options = RunOptions(max_episode_steps=10)
    learned = prioritized_sweeping(mdp, 3000, 0.8, num_planning=500, threshold=1e-10, bored_after=3,
                                   optimistic_reward=best, policy=greedy, options=options)  # fmt: skip
    exact = solve(mdp, 0.8, method="policy-iteration")
    assert np.allclose(learned.v, exact.v, atol=1e-6)
    assert (learned.policy == exact.policy).all()


def test_queue_dyna_and_sweeping_solve_deterministic_models_exactly() -> None:
    mdp = FiniteMDP.garnet(8, 2, 1, seed=5)
    exact = solve(mdp, 0.9, method="policy-iteration").q
    options = RunOptions(max_episode_steps=20)
    for learn in (queue_dyna, prioritized_sweeping):
        learned = learn(mdp, 800, 0.9, num_planning=300, threshold=1e-12, policy="random", options=options)
        assert np.abs(learned.q - exact).max() < 1e-9
    half = queue_dyna(mdp, 800, 0.9, num_planning=300, threshold=1e-12, policy="random", step_size=0.5, options=options)
    assert np.abs(half.q - exact).max() < 1e-9


def test_planning_works_on_gymnasium_environments() -> None:
    env = dyna_maze().as_env()
    learned = prioritized_sweeping(env, 1500, 0.95, num_planning=50, policy=EpsilonGreedy(0.3))
    assert greedy_steps(np.nan_to_num(learned.q, nan=-1.0), dyna_maze()) == 14
    learned = dyna_q(env, 1500, 0.95, num_planning=50, step_size=1.0)
    assert greedy_steps(np.nan_to_num(learned.q, nan=-1.0), dyna_maze()) < 20


@pytest.mark.parametrize(("call", "message"), [
    (lambda: dyna_q(dyna_maze(), 5, 0.9, num_planning=-1), "num_planning"),
    (lambda: dyna_q(dyna_maze(), 5, 0.9, kappa=-1.0), "kappa"),
    (lambda: prioritized_sweeping(dyna_maze(), 5, 0.9, threshold=-1.0), "threshold"),
    (lambda: prioritized_sweeping(dyna_maze(), 5, 1.0, bored_after=2), "gamma below 1"),
    (lambda: prioritized_sweeping(FiniteMDP.garnet(4, 1, 4, seed=0).as_env(), 500, 0.9, max_outcomes=2),
     "max_outcomes"),
    (lambda: dyna_q(dyna_maze().as_env(), 5, 0.9, options=RunOptions(change=(3, dyna_maze()))), "changes by itself"),
    (lambda: dyna_q(dyna_maze(), 5, 0.9, options=RunOptions(change=(3, FiniteMDP.garnet(3, 2, 1, seed=0)))), "same"),
])  # fmt: skip
def test_bad_input_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]
