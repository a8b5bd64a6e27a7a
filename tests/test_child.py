"""Temporal transition hierarchies against a recursive version, Ring's mazes against their maps, and what CHILD must do.

Mutants that die here: a modifier whose value of now is added instead of that of the moment before, an error that is not
multiplied by the input, that goes to the weight as well as to its unit, or a moment too far back; a weight that is
learned twice; averages that are not begun anew, or those of another unit; a threshold without its ratio or without its
floor; units beyond the room for them or for what was seen; a beginning that remembers, or that learns nothing; a unit
too many in a chain; mazes with a wall or a blind alley elsewhere, a target without its cost, or without its discount.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from neuralq.exact import solve
from neuralq.systems import run_system, system_named
from neuralq.systems.child import lives, oracle, system
from neuralq.systems.child.pictures import mazes_picture, steps_picture, tree_picture
from neuralq.tabular import (
    HierarchyRates,
    hierarchy_begin,
    hierarchy_learn,
    hierarchy_observe,
    new_stream,
    new_transition_hierarchy,
)
from neuralq.tabular.kernels.random_numbers import uniform
from neuralq_envs.ring_mazes import NUM_MAZES, WAY, corridors, make, model, shortest_way


class Written:
    """A transition hierarchy as its formulas are written; a unit is named by the weights that lead to it."""

    def __init__(self, num_outputs: int, rates: HierarchyRates, max_units: int, max_delay: int) -> None:
        self.rates, self.max_delay, self.room = rates, max_delay, max_units
        self.units: list[tuple[int, ...]] = [(i,) for i in range(num_outputs)]
        self.w: dict[tuple[tuple[int, ...], int], float] = {}
        self.told: dict[tuple[tuple[int, ...], int], float] = {}
        self.size: dict[tuple[tuple[int, ...], int], float] = {}
        self.begin()

    def begin(self) -> None:
        self.seen: list[Any] = []
        self.u: list[dict[tuple[int, ...], float]] = []

    def observe(self, s: Any) -> None:
        self.seen.append(s)
        before = self.u[-1] if self.u else {}
        self.u.append(
            {
                unit: sum((self.w.get((unit, j), 0.0) + before.get((*unit, j), 0.0)) * x for j, x in enumerate(s))
                for unit in self.units
            }
        )

    def learn(self, errors: Any, ago: int) -> None:
        for i, error in enumerate(errors):
            self.give((i,), error, len(self.seen) - 1 - ago)

    def give(self, unit: tuple[int, ...], error: float, t: int) -> None:
        for j, x in enumerate(self.seen[t]):
            if x != 0.0:
                if (*unit, j) in self.units and t > 0:
                    self.give((*unit, j), error * x, t - 1)
                else:
                    key = unit, j
                    self.w[key] = self.w.get(key, 0.0) + self.rates.step_size * error * x
                    if (*unit, j) not in self.units:
                        self.notice(unit, j, error * x)

    def notice(self, unit: tuple[int, ...], j: int, change: float) -> None:
        share, key = self.rates.averaging, (unit, j)
        self.told[key] = (1 - share) * self.told.get(key, 0.0) + share * change
        self.size[key] = (1 - share) * self.size.get(key, 0.0) + share * abs(change)
        torn = self.size[key] > self.rates.ratio * abs(self.told[key]) + self.rates.threshold
        if torn and self.room and len(unit) <= self.max_delay:
            self.units.append((*unit, j))
            self.room -= 1
            for one in [one for one in self.told if one[0] == unit]:
                self.told[one] = self.size[one] = 0.0


def name_of(net: Any, unit: int) -> tuple[int, ...]:
    parent, j = net.modifies[unit].tolist()
    return (unit,) if parent < 0 else (*name_of(net, parent), j)


@pytest.mark.parametrize(
    ("num_outputs", "room", "max_delay", "at_once"), [(2, 99, 3, 1), (2, 399, 3, 2), (1, 5, 3, 1), (2, 99, 1, 2)]
)
def test_a_hierarchy_is_its_formulas(num_outputs: int, room: int, max_delay: int, at_once: int) -> None:
    rates = HierarchyRates(step_size=0.2, averaging=0.2, ratio=0.6, threshold=0.15)
    net, written = (
        new_transition_hierarchy(4, num_outputs, room, max_delay),
        Written(num_outputs, rates, room, max_delay),
    )
    rng = np.random.default_rng(at_once)
    for _ in range(120):
        hierarchy_begin(net)
        written.begin()
        seen: list[int] = []
        for moment in range(int(rng.integers(2, 9))):
            s = np.zeros(4)
            s[rng.choice(4, at_once, replace=False)] = rng.choice([0.5, 1.0, -1.0], at_once)
            seen.append(int(np.abs(s).argmax()))
            hierarchy_observe(net, s)
            written.observe(s)
            told = [written.u[-1][(i,)] for i in range(num_outputs)]
            assert np.allclose(net.value[:num_outputs], told, atol=1e-12)
            ago = int(moment > 0 and rng.random() < 0.5)
            wanted = np.array([float(seen[0] == 0), float(seen[-1] > seen[-2 if moment else -1])])
            errors = wanted[:num_outputs] - [written.u[-1 - ago][(i,)] for i in range(num_outputs)]
            hierarchy_learn(net, rates, errors, ago)
            written.learn(errors, ago)
    names = [name_of(net, unit) for unit in range(net.counts[0])]
    assert sorted(names) == sorted(written.units)
    assert max(map(len, names)) == max_delay + 1 or room == 5
    assert len(names) - num_outputs == room if room == 5 else 8 < len(names) < room
    for i, name in enumerate(names):
        assert net.delay[i] == len(name) - 1
        for kept, plain in ((net.weight, written.w), (net.told, written.told), (net.size, written.size)):
            assert np.allclose(kept[i], [plain.get((name, j), 0.0) for j in range(4)], atol=1e-12)


def test_a_moment_that_never_was_teaches_nothing() -> None:
    net = new_transition_hierarchy(2, 1, max_delay=1)
    for _ in range(9):
        hierarchy_observe(net, np.full(2, 7.0))  # before the beginning
    hierarchy_begin(net)
    hierarchy_observe(net, np.ones(2))
    hierarchy_learn(net, HierarchyRates(), np.ones(1), 1)
    assert not net.weight.any()
    hierarchy_learn(net, HierarchyRates(), np.ones(1), 0)
    assert net.weight[0].tolist() == [0.15, 0.15]


@pytest.mark.parametrize("maze", range(1, NUM_MAZES + 1))
def test_a_maze_is_its_way_with_two_blind_alleys_at_every_crossing(maze: int) -> None:
    one = corridors(maze)
    ways = [(corridor[0], int(corridor[1:])) for corridor in WAY.split()[-maze - 1 :]]
    s, crossings = 0, []
    for direction, length in ways:
        for _ in range(length):
            s_t = int(one.led[s, "NESW".index(direction)])
            assert s_t != s and one.led[s_t, ("NESW".index(direction) + 2) % 4] == s
            s = s_t
        crossings.append(s)
    assert crossings.pop() == s == 1
    assert len(one.places) == len({tuple(place) for place in one.places.tolist()})  # nothing lies on anything else
    assert len(one.places) == 1 + sum(length for _, length in ways) + 2 * len(crossings)
    open_sides = (~one.walls).sum(axis=1)
    assert (open_sides[crossings] == 4).all() and open_sides[:2].tolist() == [1, 1]
    assert sorted(open_sides)[: 2 + 2 * len(crossings)] == [1] * (2 + 2 * len(crossings))  # the ends, and the alleys
    moves = one.places[one.led] - one.places[:, None]
    assert (
        moves[~one.walls] == np.tile([(-1, 0), (0, 1), (1, 0), (0, -1)], (len(one.led), 1))[~one.walls.ravel()]
    ).all()


@pytest.mark.parametrize("num_steps", [400, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_mazes_are_walked_as_on_their_maps(num_steps: int) -> None:
    rng = np.random.default_rng(0)
    for maze in (1, 5, 9):
        check_env(gymnasium.make("neuralq/RingMaze-v0", maze=maze, render_mode="rgb_array").unwrapped)
        env, one, ends = gymnasium.make("neuralq/RingMaze-v0", maze=maze), corridors(maze), 0
        (o, extra), steps = env.reset(seed=0), 0
        for a in rng.integers(0, 4, num_steps).tolist():
            s = extra["state"]
            row, column = one.places[s] + [(-1, 0), (0, 1), (1, 0), (0, -1)][a]
            assert o == sum(1 << side for side in range(4) if one.led[s, side] == s)
            o, reward, terminated, truncated, extra = env.step(a)
            steps += 1
            moved = not o >> (a + 2) % 4 & 1 and (one.places[extra["state"]] == (row, column)).all()
            assert moved if one.led[s, a] != s else extra["state"] == s
            assert terminated == (extra["state"] == 1) and reward == float(terminated) - 1.0
            assert truncated == (steps == 1000)
            if terminated or truncated:
                ends += 1
                (o, extra), steps = env.reset(), 0
                assert extra["state"] == 0
        assert ends >= num_steps // 1000


def test_the_model_of_the_cells_is_the_maze() -> None:
    for maze in range(1, NUM_MAZES + 1):
        solved = solve(model(maze).mdp, 1.0)
        assert 1.0 - solved.v[0] == len(shortest_way(maze))
        paid = model(maze, step_reward=0.0, goal_reward=1.0).mdp
        assert solve(paid, 0.5).v[0] == 0.5 ** (len(shortest_way(maze)) - 1)
        s = 0
        for a in shortest_way(maze):
            assert solved.optimal_actions[s].tolist() == [b == a for b in range(4)]  # there is one shortest way
            s = int(corridors(maze).led[s, a])
    assert [len(shortest_way(maze)) for maze in range(1, 10)] == [4, 5, 7, 10, 12, 14, 17, 18, 20]


def test_a_maze_pays_what_it_is_told() -> None:
    env = make(maze=1, step_reward=0.5, goal_reward=2.0)
    env.reset()
    assert [env.step(a)[1] for a in shortest_way(1)] == [0.5, 0.5, 0.5, 2.0]
    assert {make(maze=maze).observation_space.n for maze in range(1, 10)} == {16}


def test_a_maze_can_be_looked_at() -> None:
    env = make("ansi", maze=2)
    env.reset(seed=0)
    assert env.render() == "  .   .\n  |   |\n.-.-.-.-.\n  |   |\n  A   .\n      |\n      G\n"
    picture = make("rgb_array", maze=1)
    picture.reset(seed=0)
    row, column = np.argwhere((picture.render() == (40, 90, 190)).all(axis=2)).mean(axis=0)
    assert abs(row - 1.5 * 48) < 1 and abs(column - 0.5 * 48) < 1


@pytest.mark.parametrize("k", range(1, 9))
def test_a_context_of_k_moments_grows_a_chain_of_k_units(k: int) -> None:
    found = oracle.learn_context(k)
    assert found.num_units == 2 * k and found.depths == (tuple(range(1, k + 1)),) * 2
    assert found.error <= 1e-12
    assert oracle.learn_context(k, grows=False).error > 0.8  # what must fail


@pytest.mark.parametrize("settings", [lives.Settings(), lives.GOAL_ONLY])
def test_a_life_is_q_learning_on_the_outputs(settings: lives.Settings) -> None:
    """The same steps in Python; the stream is drawn as the kernel draws it."""
    limit, (gamma, step, goal) = 1000, settings.rewards
    found = lives.live(3, settings, mazes=(1, 2), limit=limit)
    stream = new_stream(3)
    net = new_transition_hierarchy(lives.NUM_INPUTS, 4, settings.max_units)

    def best() -> int:
        q, chosen, equal = net.value[:4], 0, 1
        for a in range(1, 4):
            if q[a] > q[chosen]:
                chosen, equal = a, 1
            elif q[a] == q[chosen]:
                equal += 1
                chosen = a if uniform(stream) * equal < 1.0 else chosen
        return chosen

    def see(percept: int, a: int) -> None:
        hierarchy_observe(net, np.eye(80)[5 * percept + a + 1])

    taken = []
    for maze in (1, 2):
        one, steps, trials, walked = corridors(maze), 0, 0, False
        while steps < limit and not walked:
            hierarchy_begin(net)
            s = 0
            see(one.percepts[s], -1)
            while s != 1 and steps < limit:
                a = best()
                if uniform(stream) < 0.1:
                    a = int(uniform(stream) * 4)
                q, s = net.value[a], int(one.led[s, a])
                steps += 1
                if s != 1:
                    see(one.percepts[s], a)
                target = goal if s == 1 else step + gamma * net.value[best()]
                hierarchy_learn(net, settings.rates, np.eye(4)[a] * (target - q), int(s != 1))
            trials += s == 1
            if s == 1 and trials % 5 == 0:
                hierarchy_begin(net)
                at, a = 0, -1
                for _ in shortest_way(maze):
                    if at != 1:
                        see(one.percepts[at], a)
                        a = best()
                        at = int(one.led[at, a])
                walked = at == 1
        taken.append(steps if walked else limit + 1)
    assert found.steps == tuple(taken) and found.solved[0] and np.array_equal(found.net.weight, net.weight)


@pytest.mark.slow
def test_mazes_are_learned_one_after_the_other_and_not_without_growth() -> None:
    found = run_system(system_named("child"), num_seeds=4)
    assert not found.wrong
    solved = {one.what.partition(":")[0]: one.values for one in found.measured[:4]}
    assert sum(one >= 7 for one in solved["CHILD"]) >= 3
    assert sum(one <= 80_000 for one in found.measured[4].values) >= 3
    assert max(solved["without growth"]) <= 2  # what must fail
    for seed in np.random.SeedSequence(0).spawn(4):
        assert sum(lives.live(seed).steps[:6]) <= 80_000  # there maze 7 is reached
        assert not any(lives.live(seed, lives.NO_GROWTH).solved[2:])


def test_the_page_says_what_came_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("mazes_picture", "tree_picture", "steps_picture"):
        monkeypatch.setattr(system, picture, lambda *_: None)

    def life(num_solved: int, steps: int = 100, units: int = 30, limit: int = 40_000) -> lives.Life:
        taken = tuple(steps if maze < num_solved else limit + 1 for maze in range(9))
        return lives.Life(taken, (units,) * 9, limit, None)  # type: ignore[arg-type]

    def verdicts(learned: lives.Life, nothing: int = 4, blind: int = 2, units: int = 30) -> list[str]:
        found = {"CHILD": learned, "each maze from nothing": life(nothing), "without growth": life(blind),
                 "paid at the goal only": life(9, units=units)}  # fmt: skip
        page = system.CHILD.page({name: (one,) for name, one in found.items()}, False)
        assert page.text[0].startswith("Reproduced") == all(row.verdict == "agrees" for row in page.rows[:4])
        return [row.verdict[0] for row in page.rows[:5]]

    assert verdicts(life(7)) == ["a", "a", "a", "a", "n"]
    assert verdicts(life(6)) == ["n", "n", "a", "a", "n"]
    assert verdicts(life(9, steps=11_428)) == ["a", "a", "a", "a", "n"]
    assert verdicts(life(9, steps=11_429)) == ["a", "n", "a", "a", "n"]
    assert verdicts(life(9), nothing=6) == ["a", "a", "n", "a", "n"]
    assert verdicts(life(9), blind=3) == ["a", "a", "a", "n", "n"]
    assert verdicts(life(9, units=26)) == ["a"] * 5


def test_pictures_say_what_they_show() -> None:
    found = lives.live(0, mazes=(1, 2, 3))
    assert tree_picture(found).svg.count("<rect") == found.num_units[-1] > 3
    svg = mazes_picture().svg
    assert svg.count("<polyline") == 9 and svg.count("<path") == sum(
        int(corridors(m).walls.sum()) for m in range(1, 10)
    )
    assert "9 mazes" in steps_picture({"CHILD": [lives.live(0, limit=2)]}).svg


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (lambda: corridors(10), "maze must be at most 9, got 10"),
        (lambda: make(maze=0), "maze must be a whole number of at least 1, got 0"),
        (lambda: make("human"), "render_mode must be one of"),
        (lambda: new_transition_hierarchy(0, 2), "num_inputs must be"),
        (lambda: new_transition_hierarchy(2, 0), "num_outputs must be"),
        (lambda: new_transition_hierarchy(2, 2, max_units=-1), "max_units must be"),
        (lambda: new_transition_hierarchy(2, 2, max_delay=-1), "max_delay must be"),
        (lambda: oracle.learn_context(0), "num_moments must be"),
        (lambda: lives.live(0, limit=0), "limit must be"),
        (lambda: lives.live(0, lives.Settings(epsilon=2.0)), "epsilon must lie in"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        act()
