"""A training from nothing: so many plays, replays after each, and a test every 25 plays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_whole
from neuralq.learners.lessons import Lessons, new_lessons, recent_lesson, replay_actor_critic, replay_q
from neuralq.learners.turned import new_turned_network
from neuralq.systems.lin.kernels import (
    ACTOR_CRITIC,
    FIXED,
    FRAME,
    Q_LEARNING,
    RANDOM,
    TEACHER,
    Player,
    Rates,
    Room,
    play,
)
from neuralq.systems.lin.models import new_enemy_model
from neuralq.systems.lin.teacher import new_plan
from neuralq.tabular.kernels.random_numbers import new_stream
from neuralq_envs.lin_world.board import NUM_FOOD, new_world
from neuralq_envs.lin_world.kernels import ATE, CLEARED, World
from neuralq_envs.lin_world.sensors import NUM_BITS, REACH, turns

__all__ = ["MOST_STEPS", "NUM_PLAYS", "TEST_EVERY", "Film", "Settings", "Training", "baseline", "train"]

NUM_PLAYS, TEST_EVERY = 300, 25
MOST_STEPS = 250
"""No play lasts longer: 40 units of energy, and 15 for each of 14 meals before the last."""
_HIDDEN, _TAUGHT, _KEPT = 30, 10, 100
_HOT, _COLD = 1 / 20, 1 / 60
_RECENCY = 3.0


_RATES = Rates()


@dataclass(frozen=True)
class Settings:
    """How one contender learns.

    Args:
        kind: `Q_LEARNING`, `PLANNING` or `ACTOR_CRITIC`.
        replays: lessons lived through again after the first play, and after the last; linear in between.
        taught_replays: of the teacher's lessons, likewise; (0, 0) for no teacher. Nothing of theirs is passed over.
        turned: whether an action is judged by what is seen looking in its direction.
        shared: whether one network judges all actions.
        num_plays: in all.
        num_test_plays: of a test.
        rates: step sizes, discount, and from which probability on actions are replayed.
    """

    kind: int = Q_LEARNING
    replays: tuple[int, int] = (0, 0)
    taught_replays: tuple[int, int] = (0, 0)
    turned: bool = True
    shared: bool = True
    num_plays: int = NUM_PLAYS
    num_test_plays: int = 50
    rates: Rates = _RATES


class Film(NamedTuple):
    """A play, state by state; rows and columns count from the corner of the board.

    Args:
        agent: row, column and energy, ``[F, 3]``.
        enemies: rows and columns, ``[F, E, 2]``.
        outcomes: what the step before led to (`neuralq_envs.lin_world.kernels`), ``[F]``.
        bits: what was seen, ``[F, 145]``.
        meals: where food was at first, ``[15, 2]``.
    """

    agent: NDArray[np.int64]
    enemies: NDArray[np.int64]
    outcomes: NDArray[np.int64]
    bits: NDArray[np.int8]
    meals: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Training:
    """What came of one training.

    Args:
        plays: after which it was tested, ``[P]``.
        food: that was eaten then without exploring or learning, means over the plays of a test, ``[P]``.
        film: a play at the end.
    """

    plays: NDArray[np.int64]
    food: NDArray[np.float64]
    film: Film | None = None

    def at(self, num_plays: int) -> float:
        """Food of the test after so many plays.

        Raises:
            ValueError: there was no test then.
        """
        return float(self.food[self.plays.tolist().index(num_plays)])

    @property
    def last(self) -> float:
        """Mean of the last four tests."""
        return float(self.food[-4:].mean())


class Table(NamedTuple):
    """What a play takes place on: world, room for it, lessons of whoever acts, the stream of boards and the other."""

    world: World
    room: Room
    lessons: Lessons
    boards: NDArray[np.uint64]
    rng: NDArray[np.uint64]


def _new_table(seed: np.random.SeedSequence, num_lessons: int = 1) -> Table:
    world = new_world()
    one, other = np.zeros((2, NUM_BITS), np.int8)
    moves, model = np.zeros(2 * len(world.starts)), new_enemy_model(world, NUM_BITS)
    room = Room(np.zeros(NUM_FOOD), moves, one, other, new_plan(world), model)
    return Table(world, room, new_lessons(num_lessons, MOST_STEPS, NUM_BITS), *map(new_stream, seed.spawn(2)))


def _new_player(settings: Settings, rng: np.random.Generator) -> Player:
    places = turns() if settings.turned else np.tile(np.arange(NUM_BITS), (4, 1))
    network = new_turned_network(places, _HIDDEN, rng, shared=settings.shared)
    critic = new_turned_network(np.arange(NUM_BITS)[None], _HIDDEN, rng)
    return Player(settings.kind, network, critic, settings.rates)


def _play(table: Table, player: Player, temperature: float = 0.0) -> int:
    """Food of one play."""
    no_film, no_bits = np.zeros((0, FRAME + table.world.enemies.size), np.int64), np.zeros((0, NUM_BITS), np.int8)
    world, room, lessons, boards, rng = table
    return play(world, player, temperature, lessons, room, boards, rng, no_film, no_bits)


def _filmed(player: Player, seed: np.random.SeedSequence) -> Film:
    """One play of somebody who does not learn."""
    world, room, lessons, boards, rng = _new_table(seed)
    shots = np.full((MOST_STEPS + 1, FRAME + world.enemies.size), -1)
    bits = np.zeros((len(shots), NUM_BITS), np.int8)
    play(world, player, 0.0, lessons, room, boards, rng, shots, bits)
    count = int(np.argmax(shots[:, 3] > ATE)) + 1
    shots, bits = shots[:count], bits[:count]
    agent = shots[:, :3] - [REACH, REACH, 0]
    eaten = (shots[:, 3] == ATE) | (shots[:, 3] == CLEARED)
    meals = np.vstack([agent[eaten, :2], np.argwhere(world.food == 1) - REACH])
    return Film(agent, shots[:, FRAME:].reshape(count, -1, 2) - REACH, shots[:, 3], bits, meals)


def _score(player: Player, seed: np.random.SeedSequence, num_plays: int) -> float:
    """Mean food of so many plays of somebody who does not learn."""
    table = _new_table(seed)
    return sum(_play(table, player) for _ in range(num_plays)) / num_plays


def _children(seed: np.random.SeedSequence, count: int) -> list[np.random.SeedSequence]:
    """The same ones for every contender, whoever came first."""
    return np.random.SeedSequence(seed.generate_state(4).tolist()).spawn(count)


def baseline(seed: np.random.SeedSequence, kind: int, num_plays: int = NUM_PLAYS) -> Training:
    """What `TEACHER` or `RANDOM` comes to, in one test.

    Raises:
        ValueError: another kind, or no play.

    Example:
        >>> baseline(np.random.SeedSequence(0), RANDOM, num_plays=20).last < 2
        True
    """
    check_choice("kind", kind, (TEACHER, RANDOM))
    check_whole("num_plays", num_plays)
    player = _new_player(Settings(), np.random.default_rng(0))._replace(kind=kind)
    return Training(np.array([num_plays]), np.array([_score(player, _children(seed, 1)[0], num_plays)]))


def train(seed: np.random.SeedSequence, settings: Settings) -> Training:
    """Plays, lives through lessons again after each play, and is tested every 25 plays.

    Args:
        seed: of everything; contenders with the same one begin with the same weights and face the same boards.
        settings: how it learns.

    Raises:
        ValueError: fewer plays than there are between two tests.

    Example:
        >>> found = train(np.random.SeedSequence(0), Settings(num_plays=25, num_test_plays=5))
        >>> found.plays.tolist(), found.film.meals.shape
        ([25], (15, 2))
    """
    num_plays = settings.num_plays
    check_whole("num_plays", num_plays, TEST_EVERY)
    start, playing, teaching, filming, *testing = _children(seed, 4 + num_plays // TEST_EVERY)
    player = _new_player(settings, np.random.default_rng(start))
    own, taught = _new_table(playing, _KEPT), _new_table(teaching, _TAUGHT)
    for _ in range(_TAUGHT if settings.taught_replays != (0, 0) else 0):
        _play(taught, player._replace(kind=TEACHER))
    food = []
    for n in range(num_plays):
        share = n / (num_plays - 1)
        temperature = _linear((_HOT, _COLD), share)
        _play(own, player, temperature)
        for _ in range(round(_linear(settings.replays, share))):
            _replay(player, own.lessons, recent_lesson(own.lessons, _RECENCY, own.rng), temperature)
        for _ in range(round(_linear(settings.taught_replays, share))):
            _replay(player, taught.lessons, recent_lesson(taught.lessons, 0.0, taught.rng), 0.0)
        if (n + 1) % TEST_EVERY == 0:
            test = testing[n // TEST_EVERY]
            food.append(_score(player._replace(kind=FIXED), test, settings.num_test_plays))
    plays = TEST_EVERY * (1 + np.arange(len(food)))
    return Training(plays, np.array(food), _filmed(player._replace(kind=FIXED), filming))


def _linear(ends: tuple[float, float], share: float) -> float:
    return ends[0] + (ends[1] - ends[0]) * share


def _replay(player: Player, lessons: Lessons, slot: int, temperature: float) -> None:
    """Lives through a lesson again; a temperature of 0 for one of which nothing is passed over."""
    rates = player.rates
    least = rates.least_chance if temperature > 0.0 else 0.0
    if player.kind != ACTOR_CRITIC:
        replay_q(player.network, lessons, slot, rates.step_size, temperature, least)
    else:
        steps = rates.merit_step_size, rates.critic_step_size
        replay_actor_critic(player.network, player.critic, lessons, slot, *steps, temperature, least)
