"""Schedules, repairs, the environment and the system, against plain Python, exhaustive search and what must be reached.

Mutants that die here: a pool that is over-full at its capacity, the last conflict for the first, an interval a moment
too long or short, room that counts the task itself, a move that is offered twice, one before the tasks waited for, the
first earlier start for the last, what waits pushed too far or not at all, a repair taken back by halves; any feature's
constant; RDF by another length, a reward that forgets the last repair; a schedule of the list scheduler with a
conflict; a film of other repairs; IR-V that keeps everything or nothing; a search that leaves a schedule out.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from neuralq.learners import new_value_network
from neuralq.systems import system_named
from neuralq.systems.job_shop.film import frames_of, repair_film
from neuralq.systems.job_shop.oracle import least_cost, tiny_problems
from neuralq.systems.job_shop.system import GREEDY, IRV, LEARNED, SHUFFLED, problems_of
from neuralq.systems.job_shop.trials import STEP_COST, Repaired, Settings, list_schedule, repair, train
from neuralq_envs.job_shop import JobShop, JobShopEnv, Repair, random_job_shop
from neuralq_envs.job_shop.kernels import _MIDDLE, _SPREAD, NUM_FEATURES
from tests.job_shop_slowly import Slow, SlowShop


def slow_of(env: JobShopEnv) -> Slow:
    plan: Any = env._plan
    return Slow(tuple(plan.start.tolist()), tuple(map(tuple, plan.pool.tolist())))


@pytest.mark.parametrize(
    ("size", "seeds"), [((2, 8), range(6)), ((3, 17), range(1)), ((2, 5, [[3, 3, 5], [4, 3, 3]]), range(6))]
)
def test_repairs_and_what_they_lead_to_are_those_of_plain_python(size: Any, seeds: range) -> None:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        problem = random_job_shop(rng, *size)
        slow, env = SlowShop(problem), JobShopEnv(most_repairs=256)
        table, extra = env.reset(options={"problem": problem})
        schedule, total, steps, solved = slow.first, 0.0, 0, False
        assert (problem.first_length, problem.bound) == (slow.first_length, slow.bound)
        assert problem.first_trui == pytest.approx(slow.first_trui, rel=1e-12)
        while not solved:
            expected = slow.repairs(schedule)
            assert list(extra["repairs"]) == [Repair(*what) for what, _ in expected]
            assert extra["action_mask"].tolist() == [1] * len(expected) + [0] * (256 - len(expected))
            features = np.array([slow.features(one) for one in (schedule, *(led for _, led in expected))])
            assert np.allclose(table[: len(features)], (features - _MIDDLE) / _SPREAD, rtol=0, atol=2e-6)
            assert not table[len(features) :].any()
            a = int(rng.integers(len(expected)))
            schedule = expected[a][1]
            table, reward, solved, truncated, extra = env.step(np.int64(a))
            assert slow_of(env) == schedule and extra["length"] == slow.length(schedule) and not truncated
            total, steps = total + reward, steps + 1
            assert solved == (slow.conflict(schedule) is None)
        assert total == pytest.approx(-slow.rdf(schedule) - STEP_COST * steps, abs=1e-12)  # the return identity


def test_tasks_of_any_order_and_another_pool() -> None:
    """By hand: 2 waits for 0 and is listed before it; both units of type 0 are only free one after the other."""
    problem = JobShop([3, 2, 4], [[2], [0], [2]], ((2,), (0,), ()), [[2, 3]], [[0], [0], [0]])
    assert problem.arrays.start.tolist() == [4, 7, 0] and problem.num_conflicts == 0
    with pytest.raises(ValueError, match="nothing to repair"):
        JobShopEnv().reset(options={"problem": problem})
    problem = JobShop([3, 2, 4], [[2], [0], [2]], ((), (0,), ()), [[2, 3]], [[0], [0], [0]])
    env = JobShopEnv(most_repairs=9)
    _, extra = env.reset(options={"problem": problem})
    assert extra["repairs"] == (
        Repair(0, 0, 1, None), Repair(0, 0, None, 4), Repair(2, 0, 1, None), Repair(2, 0, None, 3)
    )  # fmt: skip
    # S0 is 5 long. Of 5 units a moment 2 + 2 are taken for three moments, and 2 is too many: (5·5 + 3·2) / 5.
    assert problem.first_trui == pytest.approx((5 * 5 + 3 * 2) / 5)
    _, reward, solved, _, extra = env.step(np.int64(1))
    assert solved and extra["length"] == 9 and reward == pytest.approx(-0.001 - 9 / 6.2)
    assert env._plan is not None and env._plan.start.tolist() == [4, 7, 0]  # what waits for it was pushed
    with pytest.raises(ResetNeeded):
        env.step(np.int64(0))


def test_a_task_that_was_moved_comes_back_by_one_moment() -> None:
    """By hand: 0 and 1 want the one unit of type 0 at once, 1 and 2 that of type 1; 4 waits for 3, and wants type 0."""
    before = ((), (), (), (), (3,))
    problem = JobShop([2, 1, 1, 2, 1], [[1, 0], [1, 1], [0, 1], [0, 0], [1, 0]], before, [[1], [1]])
    env = JobShopEnv(most_repairs=9)
    _, extra = env.reset(options={"problem": problem})
    offered, total = [], 0.0
    for a in (1, 0, 2):
        offered.append([(one.task, one.resource, one.start) for one in extra["repairs"]])
        _, reward, solved, _, extra = env.step(np.int64(a))
        total += reward
    assert offered == [
        [(0, 0, 3), (0, 0, 1), (1, 0, 3), (1, 0, 2)],
        [(1, 1, 3), (1, 1, 1), (2, 1, 1)],
        [(0, 0, 4), (0, 0, 3), (0, 0, 0), (4, 0, 4), (4, 0, 3)],
    ]
    # S0 takes three moments, in one of which either type is asked for twice: TRUI is 8. In the end it takes four.
    assert solved and total == pytest.approx(-0.003 - 2 * 4 / 8)


def test_the_environment_is_one_of_gymnasiums() -> None:
    for mode in ("ansi", "rgb_array"):
        env = gymnasium.make("neuralq/JobShop-v0", render_mode=mode)
        check_env(env.unwrapped)
    env = JobShopEnv("rgb_array", most_repairs=2)
    assert env.render() is None
    _, extra = env.reset(seed=0)
    assert len(extra["repairs"]) == 2  # more are not offered
    before = slow_of(env)
    picture = env.render()
    red, blue = ((picture == colour).all(axis=2) for colour in ((235, 170, 160), (40, 90, 190)))
    assert red.any() and blue.any()
    plan, shop = env._plan, env.problem
    assert plan is not None and shop is not None
    scale = 640 / (2.5 * shop.first_length)
    over = (plan.usage - shop.arrays.capacities[:, :, None]).clip(0, 4).sum() * 6  # six rows a unit
    assert red.sum() == pytest.approx(over * scale, rel=0.1)
    assert env.step(np.int64(env.action_space.n - 1))[1] < 0
    env.reset(seed=0)
    env._count = 1
    assert env.step(np.int64(1))[1:4] == (-0.001, False, False) and slow_of(env) == before
    for make, said in (
        (lambda: JobShopEnv("human"), "render_mode must be one of"),
        (lambda: JobShopEnv(num_tasks=1), "num_tasks must be"),
        (lambda: JobShopEnv(step_cost=0.0), "step_cost must be"),
        (lambda: JobShopEnv().reset(options={"problem": 3}), "must be a JobShop, got 3"),
    ):
        with pytest.raises(ValueError, match=said):
            make()
    with pytest.raises(ResetNeeded):
        JobShopEnv().step(np.int64(0))


@pytest.mark.slow
def test_100_000_random_repairs_keep_tasks_in_order_and_units_in_their_pools() -> None:
    env, rng = JobShopEnv(), np.random.default_rng(0)
    _, extra = env.reset(seed=0)
    episodes, lengths = 0, []
    for _ in range(100_000):
        plan, problem = env._plan, env.problem
        assert plan is not None and problem is not None
        shop = problem.arrays
        ends = np.append(plan.start + shop.durations, 0)
        assert (ends[shop.before].max(axis=1, where=shop.before >= 0, initial=0) <= plan.start).all()
        assert plan.usage.sum() == shop.durations @ shop.requests.sum(axis=1) and plan.usage.min() >= 0
        assert ((plan.pool >= 0) == (shop.requests > 0)).all() and plan.length[0] == ends.max() == extra["length"]
        _, _, solved, truncated, extra = env.step(rng.integers(len(extra["repairs"])))
        assert not truncated
        if solved:
            assert (plan.usage <= shop.capacities[:, :, None]).all()
            episodes, lengths = episodes + 1, [*lengths, extra["length"] / problem.bound]
            _, extra = env.reset()
    assert 100_000 / episodes == pytest.approx(19, abs=1.5) and min(lengths) >= 1.0


def check_schedule(problem: JobShop, found: Repaired) -> None:
    slow = SlowShop(problem)
    schedule = Slow(tuple(found.start.tolist()), tuple(map(tuple, found.pool.tolist())))
    assert slow.conflict(schedule) is None and slow.length(schedule) == found.length
    assert all(schedule.starts[i] >= slow.ready(list(schedule.starts), i) for i in slow.tasks)
    assert found.rdf == pytest.approx(slow.rdf(schedule), rel=1e-12)


def test_everybody_ends_with_a_schedule_and_its_film_is_of_its_repairs() -> None:
    problems = problems_of(3, 1, 2, 8)
    network = train(0, problems, settings=Settings(num_episodes=30)).network
    for name in ("learned", "least TRUI", "random", "IR-V"):
        for problem, found in zip(problems, repair(problems, name, network), strict=True):
            check_schedule(problem, found)
            assert found.solved and found.reward == pytest.approx(-found.rdf - 0.001 * len(found.repairs), abs=1e-12)
            frames = frames_of(problem, found)
            assert len(frames) == len(found.repairs) + 1
            assert np.array_equal(frames[-1].start, found.start) and np.array_equal(frames[-1].pool, found.pool)
            assert repair_film("x", problem, frames).count("<g class=") == len(frames)
    for problem in problems:
        check_schedule(problem, list_schedule(problem))


def test_the_baselines_choose_as_they_say() -> None:
    problem = random_job_shop(np.random.default_rng(3), 2, 8)
    slow, (found,) = SlowShop(problem), repair([problem], "least TRUI")
    schedule = slow.first
    for task, kind, resource, to in found.repairs.tolist():
        led = slow.repairs(schedule)
        truis = [slow.trui(one) for _, one in led]
        best = int(np.argmin(np.round(truis, 9)))
        assert led[best][0] == ((task, resource, None, to) if kind else (task, resource, to, None))
        schedule = led[best][1]
    many = [problem] * 300
    cold = np.mean([one.rdf for one in repair(many, "IR-V", seed=1)])
    assert cold < np.mean([one.rdf for one in repair(many, "random", seed=1)])
    with pytest.raises(ValueError, match=r"needs a network: network=train\(0, problems\).network"):
        repair([problem], "learned")
    repair([problem], "learned", network=train(0, [problem], settings=Settings(num_episodes=2)).network)
    with pytest.raises(ValueError, match="problems must hold at least one"):
        train(0, [])
    with pytest.raises(ValueError, match=r"problems\[0\] has no conflict"):
        repair([JobShop([1], [[1]], ((),), [[1]])], "random")
    for given in ({"lambda_": 1.5}, {"num_episodes": 0}, {"step_cost": 0.0}, {"first_epsilon": -1.0}):
        with pytest.raises(ValueError, match=next(iter(given))):
            Settings(**given)  # type: ignore[arg-type]


def test_nobody_is_below_the_optimum_of_40_tiny_problems() -> None:
    problems = tiny_problems()
    found = [least_cost(one) for one in problems]
    assert len(problems) == 40 and sum(tried for _, tried in found) > 400
    for problem, (cost, _) in list(zip(problems, found, strict=True))[:12]:
        assert cost == pytest.approx(SlowShop(problem).least_cost(STEP_COST), abs=1e-12)
    optimum = np.array([cost for cost, _ in found])
    networks = [train(0, problems, settings=Settings(num_episodes=800)).network, new_value_network(NUM_FEATURES, 5, 3)]
    tried = [repair(problems, "learned", network) for network in networks]
    tried += [repair(problems, name, seed=seed) for name in ("least TRUI", "random", "IR-V") for seed in range(5)]
    gaps = np.array([[-one.reward for one in all_] for all_ in tried]) - optimum
    assert gaps.min() >= -1e-12
    assert (gaps[0] < 1e-9).sum() >= 24 and gaps[0].mean() < 0.05 < gaps[-1].mean()


def test_training_is_repeatable_and_chooses_by_other_problems() -> None:
    problems, others = problems_of(4, 5, 2, 8), problems_of(4, 6, 2, 8)
    first, second = (train(7, problems, others, Settings(num_episodes=200)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first.network[:4], second.network[:4], strict=True))
    assert len(first.scores) == 50 and first.episodes[-1] == 200
    # An early score that is higher than all of the second half is not what the chosen one must beat.
    early = train(0, problems, others, Settings(num_episodes=50))
    assert max(early.scores[:25]) > max(early.scores[25:])
    for training in (first, early):  # the score is the mean return with the cost that learning is told
        repaired = repair(others, "learned", training.network)
        told = np.mean([-one.rdf - Settings().step_cost * len(one.repairs) for one in repaired])
        assert told == pytest.approx(max(training.scores[25:]), abs=1e-9)


# -------------------------------------------------------------------------------- what it must reach, and what must not


@pytest.mark.slow
def test_td_beats_the_look_ahead_and_random_repair_and_without_its_reward_it_does_not() -> None:
    system = system_named("job-shop")
    seeds = np.random.SeedSequence(0).spawn(3)
    found = {
        name: [system.contenders[name](seed, False) for seed in (seeds if name != GREEDY else seeds[:1])]
        for name in (LEARNED, GREEDY, IRV, SHUFFLED)
    }
    rdf = {name: np.array([np.mean([r.rdf for r in one.small]) for one in all_]) for name, all_ in found.items()}
    work = {
        name: np.array([np.mean([len(r.repairs) for r in one.small]) for one in all_]) for name, all_ in found.items()
    }
    assert {len(one.durations) for one in (p.arrays for p in problems_of(1, 13_5))} == {51}
    assert (rdf[LEARNED] <= 0.99 * rdf[GREEDY]).all() and (work[LEARNED] <= work[GREEDY]).all()
    assert (rdf[LEARNED] <= 0.65 * rdf[IRV]).all()
    big = {name: np.array([np.mean([r.rdf for r in one.big]) for one in found[name]]) for name in (LEARNED, GREEDY)}
    assert {len(one.start) for one in found[LEARNED][0].big} == {164}
    assert big[LEARNED].mean() <= big[GREEDY].mean()
    # The control that must fail.
    assert (rdf[SHUFFLED] > 1.1 * rdf[GREEDY]).all()
