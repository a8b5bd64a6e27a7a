"""Lin's world against a slow readable one, what its agents are told, and what they must learn.

Mutants that die here: a sensor one cell off, of another shape, or of another kind's; an energy one unit or bit off, a
meal that does not cost the step, a last action turned the wrong way; enemies drawn to where the agent was, at the wrong
urge for a distance, that walk onto each other or over the wall, all at once or with another chance; a caught agent that
plays on, a starved one that eats first, a play that goes on when everything is eaten; food on a cell twice; a teacher
who passes close to an enemy or takes a long way; a model that counts moves where the agent was, that imagines enemies
onto obstacles or forgets that it was caught; a schedule of replays that does not fall, taught lessons passed over, a
test that learns; claims with another bound.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from neuralq.learners import TurnedNetwork, new_turned_network, turned_policy, turned_update, turned_values
from neuralq.systems import run_system, system_named
from neuralq.systems.lin import oracle, system, trainings
from neuralq.systems.lin.film import board_film
from neuralq.systems.lin.kernels import ACTOR_CRITIC, PLANNING, RANDOM, TEACHER, Rates
from neuralq.systems.lin.models import count_moves, new_enemy_model, plan
from neuralq.systems.lin.teacher import advised, new_plan
from neuralq.systems.lin.trainings import Settings, Training, baseline, train
from neuralq.tabular import new_stream
from neuralq_envs.lin_world.board import BOARD, new_world
from neuralq_envs.lin_world.environment import LinWorldEnv
from neuralq_envs.lin_world.kernels import World, enemy_chances, move, sense, settle
from neuralq_envs.lin_world.sensors import SENSOR_PLACES, turns

MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
Cell = tuple[int, int]


def reach(cells: Any) -> set[Cell]:
    return {(int(row), int(column)) for row, column in cells}


class Written:
    """The same world on sets of cells; it follows the draws of the environment."""

    def __init__(self, world: World) -> None:
        self.walls = reach(np.argwhere(world.obstacles == 0))  # cells that are none
        self.food = reach(np.argwhere(world.food == 1))
        self.enemies = [(int(row), int(column)) for row, column in world.starts]
        self.agent, self.energy = (int(world.start[0]), int(world.start[1])), int(world.start[2])
        self.last, self.bumped = -1, False

    def step(self, action: int, drawn: Any) -> tuple[float, bool]:
        self.energy, self.last = self.energy - 1, action
        to = (self.agent[0] + MOVES[action][0], self.agent[1] + MOVES[action][1])
        self.bumped, ate = to not in self.walls, False
        if not self.bumped:
            self.agent = to
        if self.agent in self.enemies:
            return -1.0, True
        if self.agent in self.food:
            self.food.remove(self.agent)
            self.energy, ate = self.energy + 15, True
            if not self.food:
                return 0.4, True
        if self.energy == 0:
            return -1.0, True
        for i in range(len(self.enemies)):
            if drawn[2 * i] < 0.8:
                law = self.law(i)
                if sum(law) > 0:
                    k = int(np.searchsorted(np.cumsum(law), drawn[2 * i + 1], side="right"))
                    row, column = self.enemies[i]
                    self.enemies[i] = (row + MOVES[k][0], column + MOVES[k][1])
                if self.enemies[i] == self.agent:
                    return -1.0, True
        return 0.4 if ate else 0.0, False

    def law(self, i: int) -> list[float]:
        (row, column), weights = self.enemies[i], []
        away = np.array([self.agent[0] - row, self.agent[1] - column], float)
        d = float(np.hypot(*away))
        urge = 15 - d if d <= 4 else 9 - d / 2 if d <= 15 else 1
        for down, right in MOVES:
            to = (row + down, column + right)
            angle = math.degrees(math.acos(np.clip((down * away[0] + right * away[1]) / d, -1, 1)))
            free = to in self.walls and to not in self.enemies
            weights.append(math.exp(0.33 * (180 - angle) / 180 * urge) if free else 0.0)
        return [one / sum(weights) for one in weights] if sum(weights) else weights

    def bits(self) -> list[int]:
        """By what a sensor of each shape covers."""

        def lit(things: Any, at: Cell, shape: str) -> int:
            apart = [(abs(r - self.agent[0] - at[0]), abs(c - self.agent[1] - at[1])) for r, c in things]
            if shape == "X":
                return int(any(r + c <= 1 for r, c in apart))
            return int(any(max(r, c) <= 1 or (shape == "Y" and (r, c) in ((0, 2), (2, 0))) for r, c in apart))

        food = [
            lit(self.food, at, "X" if i < 12 else "O" if i < 32 else "Y") for i, at in enumerate(SENSOR_PLACES[:52])
        ]
        enemies = [lit(self.enemies, at, "X" if i < 12 else "O") for i, at in enumerate(SENSOR_PLACES[52:84])]
        walls = [int((self.agent[0] + r, self.agent[1] + c) not in self.walls) for r, c in SENSOR_PLACES[84:]]
        level = [int(self.energy > 0 and i == min((self.energy - 1) // 4, 15)) for i in range(16)]
        return [*food, *enemies, *walls, *level, *(int(self.last == a) for a in range(4)), int(self.bumped)]


def test_sensors_stand_where_the_paper_has_them() -> None:
    near = {(r, c) for r in range(-2, 3) for c in range(-2, 3) if 0 < abs(r) + abs(c) <= 2}
    ring = {(r, c) for r in range(-6, 7, 2) for c in range(-6, 7, 2)}
    squares = {at for at in ring if sorted(map(abs, at)) in ([2, 2], [0, 4], [2, 4], [0, 6])}
    far = {(r, c) for r in range(-10, 11, 2) for c in range(-10, 11, 2) if abs(r) + abs(c) == 10}
    around = {(r, c) for r in range(-4, 5) for c in range(-4, 5) if 0 < abs(r) + abs(c) <= 4}
    for first, expected in ((0, near), (12, squares), (32, far), (52, near), (64, squares), (84, around)):
        assert set(SENSOR_PLACES[first : first + len(expected)]) == expected
    assert [len(one) for one in (near, squares, far, around)] == [12, 20, 20, 40]


def test_bits_turn_with_the_world() -> None:
    assert oracle.turned_mismatches(800) == 0
    assert (np.sort(turns(), axis=1) == np.arange(145)).all() and not (turns()[1] == turns()[3]).all()


def test_enemies_follow_their_law() -> None:
    assert oracle.enemy_law(3)[:3] == pytest.approx((0.77208, 0.10660, 0.01472), abs=5e-6)
    assert oracle.enemy_law(20)[:3] == pytest.approx((0.29285, 0.24831, 0.21054), abs=5e-6)
    assert oracle.catch_steps() == pytest.approx(5.8157, abs=5e-5)
    rng = np.random.default_rng(0)
    for _ in range(200):
        world = new_world()
        settle(world, rng.random(15))
        free = world.free[rng.permutation(len(world.free))[:5]]
        world.agent[:2], world.enemies[:] = free[0], free[1:]
        world.enemies[1] = world.enemies[0] + [0, 1]  # beside each other
        if world.obstacles[tuple(world.enemies[1])] or tuple(world.enemies[1]) in reach(free):
            continue
        world.guarded[:] = 0
        world.guarded[tuple(world.enemies.T)] = 1
        written = Written(world)
        written.agent, written.enemies = tuple(free[0].tolist()), [tuple(one) for one in world.enemies.tolist()]
        for i in range(4):
            enemy_chances(world, i)
            assert world.chances == pytest.approx(written.law(i), rel=1e-12)


def test_one_is_caught_in_a_closed_room_when_the_equations_say() -> None:
    env, counts = LinWorldEnv(board="..E\n...\nI..", num_food=0, energy=10_000), []
    env.reset(seed=1)
    for _ in range(2000):
        env.reset()
        count, over = 0, False
        while not over:
            _, reward, over, _, extra = env.step(2)
            count += 1
        assert reward == -1.0 and extra["caught"]
        counts.append(count)
    assert abs(np.mean(counts) - 5.8157) < 4 * np.std(counts) / math.sqrt(len(counts))


@pytest.mark.parametrize("num_steps", [600, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_environment_is_the_written_one(num_steps: int) -> None:
    """Draws are seen by a generator that is where the environment's was before each step."""
    env, rng, seen = LinWorldEnv(), np.random.default_rng(3), set()
    env.reset(seed=3)
    written, steps = Written(env.world), 0
    for step in range(num_steps):
        follower = np.random.Generator(type(env.np_random.bit_generator)())
        follower.bit_generator.state = env.np_random.bit_generator.state
        action = int(rng.integers(4)) if rng.random() < 0.4 else step // 5 % 4
        bits, reward, terminated, truncated, extra = env.step(action)
        expected, over = written.step(action, follower.random(8))
        steps += 1
        assert (reward, terminated, truncated) == (expected, over, False) and steps <= 250
        assert extra["energy"] == written.energy and extra["food_left"] == len(written.food)
        assert extra["caught"] == (over and expected < 0 and written.agent in written.enemies)
        assert extra["starved"] == (over and expected < 0 and not extra["caught"])
        assert extra["ate"] == (expected > 0) or extra["caught"]
        if step % max(num_steps // 500, 1) == 0 or over:
            world = env.world
            assert bits.tolist() == written.bits()
            assert reach(np.argwhere(world.guarded == 1)) == set(written.enemies) == reach(world.enemies)
            assert len(set(written.enemies)) == 4 and not world.obstacles[tuple(world.enemies.T)].any()
            assert reach(np.argwhere(world.food == 1)) == written.food
        seen |= {name for name in ("ate", "caught", "starved") if extra[name]}
        if over:
            env.reset()
            written, steps = Written(env.world), 0
            assert len(written.food) == 15 and not written.food & ({written.agent} | set(written.enemies))
    assert seen >= {"ate", "caught"}


def test_meals_and_the_end_of_energy() -> None:
    env = LinWorldEnv(board="I....", num_food=1)
    env.reset(options={"food": [(0, 1)]})
    assert env.step(1)[1:] == (0.4, True, False, {"ate": True, "caught": False, "starved": False, "energy": 54,
                                                  "food_left": 0})  # fmt: skip
    env.reset(options={"food": [(0, 4)]})
    for step in range(40):
        bits, reward, over, _, extra = env.step(0)
        assert over == (step == 39) == extra["starved"] and reward == -1.0 * over and bits[144] == 1
        assert bits[124:140].sum() == (step < 39)
    env = LinWorldEnv(board="I....", num_food=2, energy=2)
    env.reset(options={"food": [(0, 2), (0, 4)]})
    outcomes = [env.step(1) for _ in range(2)]  # the last unit of energy leads to food: no starving
    assert [one[1] for one in outcomes] == [0.0, 0.4] and not outcomes[1][2] and outcomes[1][4]["energy"] == 15
    sums = np.zeros((25, 25))
    for seed in range(400):
        env = LinWorldEnv()
        env.reset(seed=seed)
        sums += env.world.food[12:-12, 12:-12]
        assert env.world.food.sum() == 15
    open_cells = np.array([[sign == "." for sign in row] for row in BOARD.split()])
    assert sums[~open_cells].sum() == 0 and abs(sums[open_cells] - 6000 / 451).max() < 5 * math.sqrt(6000 / 451)


def test_the_environment_is_one_of_gymnasiums_and_can_be_looked_at() -> None:
    check_env(gymnasium.make("neuralq/LinWorld-v0", render_mode="rgb_array").unwrapped)
    env = LinWorldEnv("ansi", board="#.E\nI..", num_food=1)
    env.reset(options={"food": [(1, 2)]})
    assert env.render() == "#.E\nI.$\nenergy 40, food left 1\n"
    picture = LinWorldEnv("rgb_array", board="#.E\nI..", num_food=1)
    picture.reset(options={"food": [(1, 2)]})
    shown = picture.render()
    assert shown.shape == (32, 48, 3)
    assert shown[24, 8].tolist() == [40, 90, 190] and shown[8, 40].tolist() == [235, 170, 160]
    assert shown[4, 4].tolist() == [215, 215, 215] and shown[24, 40].tolist() == [170, 215, 170]


@pytest.mark.parametrize(
    ("act", "error", "said"),
    [
        (lambda: LinWorldEnv("human"), ValueError, "render_mode must be one of"),
        (lambda: LinWorldEnv(board="I.\n."), ValueError, "rows of one length"),
        (lambda: LinWorldEnv(board="I?"), ValueError, "rows of one length made of"),
        (lambda: LinWorldEnv(board="..."), ValueError, "one agent 'I', got 0"),
        (lambda: LinWorldEnv(board="I.I"), ValueError, "one agent 'I', got 2"),
        (lambda: LinWorldEnv(energy=0), ValueError, "energy must be"),
        (lambda: LinWorldEnv(board="I.", num_food=2), ValueError, "at most the board's 1 free cells, got 2"),
        (lambda: LinWorldEnv(num_food=-1), ValueError, "num_food must be"),
        (lambda: LinWorldEnv().step(0), ResetNeeded, "call reset"),
        (lambda: started().step(4), ValueError, "from 0 to 3"),
        (lambda: started(food=[(0, 0)]), ValueError, r"no food at \(0, 0\)"),
        (lambda: started(food=[(7, 7), (7, 7)]), ValueError, r"no food at \(7, 7\)"),
        (lambda: started(food=[(18, 12)]), ValueError, r"no food at \(18, 12\)"),
        (lambda: started(food="here"), ValueError, "must be pairs"),
        (lambda: started(food=[1, 2, 3]), ValueError, "must be pairs"),
        (lambda: train(np.random.SeedSequence(0), Settings(num_plays=24)), ValueError, "num_plays must be"),
        (lambda: baseline(np.random.SeedSequence(0), 0), ValueError, "kind must be one of"),
        (lambda: baseline(np.random.SeedSequence(0), RANDOM, 0), ValueError, "num_plays must be"),
    ],
)
def test_what_makes_no_sense_is_refused(act: Any, error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        act()


def started(**options: Any) -> LinWorldEnv:
    env = LinWorldEnv()
    env.reset(seed=0, options=options)
    return env


def test_a_play_that_is_over_needs_another_reset() -> None:
    env = LinWorldEnv(board="I.", num_food=1)
    env.reset()
    env.step(1)
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(1)


# -------------------------------------------------------------------------------------------------- who acts and learns


def shortest(world: World, care: int) -> float:
    """Moves to the nearest food that stay farther than that from every enemy."""
    start = (int(world.agent[0]), int(world.agent[1]))
    queue, seen = deque([(start, 0)]), {start}
    while queue:
        (row, column), moves = queue.popleft()
        if world.food[row, column]:
            return moves
        for down, right in MOVES:
            to = (row + down, column + right)
            near = (np.abs(world.enemies - to).sum(axis=1) <= care).any()
            if to not in seen and not world.obstacles[to] and not near:
                seen.add(to)
                queue.append((to, moves + 1))
    return math.inf


def test_the_teacher_takes_a_shortest_way_that_is_safe_or_flees() -> None:
    rng, cares = np.random.default_rng(5), []
    for n in range(80):
        world = new_world()
        settle(world, rng.random(int(rng.integers(1, 4))))
        cells = world.free[rng.permutation(len(world.free))[:4]]
        world.agent[:2] = cells[0] if world.food[tuple(cells[0])] == 0 else world.start[:2]
        world.enemies[:3], world.enemies[3] = cells[1:], world.agent[:2] + rng.integers(-3, 4, 2)
        if n % 2:  # all of them are near
            world.enemies[:] = world.agent[:2] + rng.integers(-3, 4, (4, 2))
        a = advised(world, new_plan(world))
        care = next((care for care in (3, 2, 1) if math.isfinite(shortest(world, care))), 0)
        cares.append(care)
        to = world.agent[:2] + MOVES[a]
        if care:
            before = shortest(world, care)
            world.agent[:2] = to
            assert (np.abs(world.enemies - to).sum(axis=1) > care).all() and shortest(world, care) == before - 1
        else:
            beside = [world.agent[:2] + one for one in MOVES]
            away = [
                int(np.abs(world.enemies - at).sum(axis=1).min()) for at in beside if not world.obstacles[tuple(at)]
            ]
            assert np.abs(world.enemies - to).sum(axis=1).min() == max(away)
    assert min(np.bincount(cares, minlength=4)) >= 5


def test_models_count_where_the_agent_was_for_an_enemy() -> None:
    world = new_world("E....\n.....\n...I.")
    settle(world, np.zeros(0))
    model = new_enemy_model(world, 145)
    world.enemies[0] += (1, 0)  # the agent is two rows down and three columns to the right of where it was
    count_moves(model, world)
    assert model.counts.sum() == 13 * 13 * 5 + 1 and model.counts[8, 9, 2] == 2.0


@pytest.mark.parametrize(
    ("board", "way", "enemies_then"),
    [
        (".E.\n#.I\n...", 2, [(1, 1)]),
        (".E.\n#.I\n...", 0, [(0, 1)]),  # there the board ends
        (".E.\n#.I\n...", 4, [(0, 1)]),  # not at all
        (".E.\n#.I\n...", 1, [(0, 2)]),
        (".EE\n#.I\n...", 1, [(0, 1), (0, 2)]),  # where another one is
    ],
)
def test_what_a_sure_model_imagines(board: str, way: int, enemies_then: list[Cell]) -> None:
    world, rng = new_world(board), np.random.default_rng(0)
    settle(world, np.zeros(0))
    before_it = {(int(row) - 12, int(column) - 12) for row, column in world.starts}
    model = new_enemy_model(world, 145)
    model.counts[:], model.counts[:, :, way] = 0.0, 1.0
    network = new_turned_network(np.tile(np.arange(145), (4, 1)), 5, rng, scale=0.5, shared=False)
    expected, before = TurnedNetwork(*(part.copy() for part in network)), [part.copy() for part in world]
    x, x_t = np.zeros((2, 145), np.int8)
    sense(world, x)
    plan(model, world, network, x, 1, 1.0, 0.0, 0.2, 0.9, new_stream(0))
    assert all(np.array_equal(part, was) for part, was in zip(world, before, strict=True))  # it goes on as it was
    for a, agent_then in ((0, (0, 2)), (2, (2, 2)), (3, (1, 1))):
        target = -1.0
        if agent_then not in before_it | set(enemies_then):
            then = new_world(board)
            settle(then, np.zeros(0))
            then.guarded[:], then.agent[:5] = 0, (agent_then[0] + 12, agent_then[1] + 12, 39, a, 0)
            then.guarded[tuple(np.array(enemies_then).T + 12)] = 1
            sense(then, x_t)
            target = 0.9 * turned_values(expected, x_t)
        turned_update(expected, x, a, target, 0.2)
    assert all(np.allclose(one, other, rtol=1e-12) for one, other in zip(network[:4], expected[:4], strict=True))
    chances = [turned_policy(network, x, a, 0.2) for a in range(4)]
    least, flat = sorted(chances)[2], network.w.copy()
    plan(model, world, network, x, int(np.argmax(chances)), 0.2, least, 0.2, 0.9, new_stream(0))
    changed = (network.w != flat).any(axis=(1, 2))
    assert changed.tolist() == [chance == least for chance in chances]  # others are too unlikely


def test_trainings_of_one_seed_are_alike_and_begin_alike() -> None:
    seed, short = np.random.SeedSequence(3), {"num_plays": 50, "num_test_plays": 10}
    one, other = (train(seed, Settings(replays=(2, 1), taught_replays=(1, 1), **short)) for _ in range(2))
    assert np.array_equal(one.food, other.food) and one.plays.tolist() == [25, 50]
    assert one.film is not None and other.film is not None and np.array_equal(one.film.agent, other.film.agent)
    for kind in (PLANNING, ACTOR_CRITIC):
        assert train(seed, Settings(kind, replays=(1, 0), **short)).food.shape == (2,)
    assert baseline(seed, TEACHER, 40).last > 10 and baseline(seed, RANDOM, 40).last < 2
    film = one.film
    assert film.bits.shape == (len(film.agent), 145) and len(np.unique(film.meals, axis=0)) == 15
    assert film.agent[0].tolist() == [18, 12, 40] and film.outcomes[-1] > 1 >= film.outcomes[:-1].max()
    steps = np.abs(np.diff(film.agent[:, :2], axis=0)).sum(axis=1)
    assert steps.max() == 1 and np.abs(np.diff(film.enemies, axis=0)).sum(axis=2).max() == 1
    assert (np.diff(film.agent[:, 2]) == np.where(np.isin(film.outcomes[1:], (1, 2)), 14, -1)).all()
    assert board_film("f", "A play", film).count("@keyframes") == 15 + 4 + 84 + 2


def test_replays_fall_and_pass_over_only_what_was_not_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, float, float]] = []
    monkeypatch.setattr(
        trainings, "replay_q", lambda _, lessons, __, *rest: seen.append((len(lessons.lengths), *rest[1:]))
    )
    train(np.random.SeedSequence(0), Settings(replays=(3, 1), taught_replays=(2, 0), num_plays=25, num_test_plays=1))
    own, taught = ([one for one in seen if one[0] == kept] for kept in (100, 10))
    assert len(own) == sum(round(3 - n / 12) for n in range(25)) and len(taught) == sum(
        round(2 - n / 12) for n in range(25)
    )
    assert {one[2] for one in own} == {0.01} and {one[2] for one in taught} == {0.0}
    assert own[0][1] == pytest.approx(1 / 20) and own[-1][1] == pytest.approx(1 / 60)


def made(early: float, last: float) -> tuple[Training, ...]:
    return (Training(np.array([25, 50, 75, 100, 125, 150]), np.array([0, early, *[last] * 4])),)


def test_the_page_says_what_came_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for picture in ("film_picture", "learning_picture"):
        monkeypatch.setattr(system, picture, lambda *_: None)
    found = {name: made(4, 8) for name in system.LIN.contenders} | {
        system.QCON: made(5, 9.8), system.REPLAY: made(6.5, 11), system.TAUGHT: made(6.5, 11),
        system.UNFILTERED: made(6, 10.5), system.SEPARATE: made(4, 9.8), system.UNTURNED: made(0, 0.5),
        system.RANDOMLY: made(0, 0.5), system.MODEL: made(6.5, 9.8),
    }  # fmt: skip
    page = system.LIN.page(found, False)
    assert page.reproduced and page.text[0].startswith("Reproduced") and "Here that gains" in page.text[3]
    for i, (name, bad) in enumerate(
        (
            (system.QCON, made(5.1, 9.8)), (system.TAUGHT, made(6.4, 11)), (system.QCON, made(5, 9.81)),
            (system.REPLAY, made(6.5, 10.99)), (system.UNFILTERED, made(6, 10.51)), (system.SEPARATE, made(4, 9.81)),
            (system.UNTURNED, made(0, 0.51)), (system.MODEL, made(6.4, 9.8)),
        )
    ):  # fmt: skip
        page = system.LIN.page({**found, name: bad}, False)
        assert page.rows[i].verdict == "not reproduced", page.rows[i]
        assert page.text[0].startswith("Not" if i < 4 else "Reproduced")
    assert not system.LIN.page({**found, system.MODEL: made(6.5, 9.7)}, False).reproduced
    assert page.measured[1].values == (6.5,) and "does not gain" in page.text[3]
    assert system.CONTENDERS[system.UNFILTERED].rates == Rates(least_chance=0.0)
    assert dataclasses.replace(system.CONTENDERS[system.UNTURNED], turned=True) == system.CONTENDERS[system.REPLAY]


def test_a_move_that_catches_ends_the_step() -> None:
    world = new_world("EIE")
    settle(world, np.zeros(0))
    assert move(world, 0, np.zeros(4)) == 3 and world.enemies[1, 1] == 14  # the second one has not moved


@pytest.mark.slow
def test_replay_and_teaching_help_and_without_rotation_nothing_does() -> None:
    found = run_system(system_named("lin"))
    mean = {one.what: float(np.mean(one.values)) for one in found.measured}
    assert len(found.measured[0].values) == 6 and not found.wrong
    early = {name: mean[f"{name}: food after 50 plays"] for name in ("QCON", "QCON-R", "QCON-T")}
    last = {name: mean[f"{name}: food, last four tests"] for name in system.LIN.contenders}
    assert early["QCON-R"] >= 1.3 * early["QCON"] and early["QCON-T"] >= early["QCON-R"]
    assert last["QCON-R"] >= last["QCON"] + 1.2 and last["QCON-R"] >= 11.0
    assert last["QCON-R"] >= last["QCON-R, nothing passed over"] + 0.5
    assert last["QCON-R, no rotation"] <= last["random moves"]  # the control that must fail
    assert last["QCON-R, a net for each action"] <= last["QCON-R"] - 1.2
