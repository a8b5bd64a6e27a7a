"""A learner of Pengo that is told something before it begins, on its way, or never; and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.checks import check_whole
from neuralq.learners import SmdpNetwork
from neuralq.q import MLP, ActionOutputQ, Rule, insert_rules
from neuralq.systems.advice.kernels import Room, learn_games, play_games
from neuralq.systems.advice.rules import Advice
from neuralq.tabular.kernels.random_numbers import new_stream
from neuralq_envs.pengo_kernels import NUM_ACTIONS, NUM_DEALT, NUM_DRAWN, NUM_INPUTS, new_game

__all__ = ["NUM_GAMES", "NUM_HIDDEN", "Study", "as_network", "compiled", "new_room", "study"]

NUM_GAMES, NUM_HIDDEN, NUM_TESTS = 8000, 20, 200
"""Of training, of units before anybody says anything, and games of each test."""
STEP_SIZE, GAMMA = 0.05, 0.9
_TEMPERATURES, _ANNEALED = (0.3, 0.05), 0.8
_WIDTH = 0.25  # of the weights at first
_MOST_SEEN = 4000  # states in which it is looked whether advice is followed
_TEST_GAMES = 20_262


@dataclass(frozen=True, eq=False)
class Study:
    """What came of one training.

    Args:
        games: before each test, ``[T]``.
        returns: mean of 200 greedy games, the same for everybody, in each test, ``[T]``.
        told_at: games before the advice; None without any.
        followed: of the states in these games for which the rules name one action, the share in which that is the best
            one, just after they were inserted and at the end; NaN without advice.
        worth: what the rules of each kind add to an action at the end (1 at first), by what they say.
        network: at the end.
    """

    games: NDArray[np.int64]
    returns: NDArray[np.float64]
    told_at: int | None
    followed: tuple[float, float]
    worth: dict[str, float]
    network: SmdpNetwork

    @property
    def late(self) -> float:
        """Mean of the tests in the last quarter of the training."""
        return float(self.returns[self.games >= 0.75 * self.games[-1]].mean())


def new_room() -> Room:
    """Room for what is seen and drawn.

    Example:
        >>> new_room().dealt.shape
        (48,)
    """
    return Room(np.zeros(NUM_INPUTS), np.zeros(NUM_INPUTS), np.zeros(NUM_DEALT), np.zeros(NUM_DRAWN))


def compiled(q: ActionOutputQ) -> SmdpNetwork:
    """The weights of a network with one layer of sigmoid units, copied to where compiled loops learn.

    Example:
        >>> compiled(ActionOutputQ(3, 2, MLP((5,), activation="sigmoid"))).w.shape
        (3, 5)
    """
    first, last = q.trunk.layers
    parts = [x.detach()[0].double().numpy() for x in (first.weight, first.bias, last.weight.mT, last.bias)]  # type: ignore[operator]
    flat = np.concatenate([part.ravel() for part in parts])
    ends = np.cumsum([part.size for part in parts])[:-1]
    w, b, v, c = (piece.reshape(part.shape) for piece, part in zip(np.split(flat, ends), parts, strict=True))
    return SmdpNetwork(flat, w, b, v, c, np.zeros(len(b)), np.zeros(len(c)))


def as_network(learned: SmdpNetwork) -> ActionOutputQ:
    """The same in PyTorch, in float64, with weights of its own.

    Example:
        >>> q = ActionOutputQ(3, 2, MLP((5,), activation="sigmoid"), dtype=torch.float64)
        >>> bool(torch.equal(as_network(compiled(q)).all(torch.ones(3)), q.all(torch.ones(3))))
        True
    """
    body = MLP((len(learned.b),), activation="sigmoid")
    q = ActionOutputQ(len(learned.w), len(learned.c), body, dtype=torch.float64)
    for parameter, values in zip(q.parameters(), (learned.w, learned.b, learned.v.T, learned.c), strict=True):
        parameter.data.copy_(torch.from_numpy(values))
    return q


def study(
    seed: np.random.SeedSequence,
    advice: Advice | None = None,
    *,
    told_at: int = 0,
    num_hidden: int = NUM_HIDDEN,
    num_games: int = NUM_GAMES,
    test_every: int = 500,
) -> Study:
    """Learns by one-step Q-learning from a softmax policy that gets cooler, and is tested greedily on the way.

    Args:
        seed: of the weights, the games and the actions.
        advice: what it is told; None for nothing.
        told_at: after how many games, a multiple of ``test_every``.
        num_hidden: units before.
        num_games: of the training.
        test_every: so many of them.

    Raises:
        ValueError: a count below 1, or advice that would come between two tests or after the end.

    Example:
        >>> one = study(np.random.SeedSequence(0), num_games=100, test_every=50)
        >>> one.games.tolist(), one.network.w.shape
        ([0, 50, 100], (44, 20))
    """
    check_whole("num_games", num_games)
    check_whole("test_every", test_every)
    check_whole("told_at", told_at, 0)
    if told_at % test_every or told_at > num_games:
        raise ValueError(f"told_at must be a multiple of {test_every} and at most {num_games}, got {told_at}")
    rules = [rule for kind in (advice or {}).values() for rule in kind]
    network, stream = _new_network(_child(seed, 0), num_hidden), new_stream(_child(seed, 1))
    temperatures = np.interp(np.arange(num_games), [0, _ANNEALED * num_games], _TEMPERATURES)
    game, room, returns, followed = new_game(), new_room(), [], [np.nan, np.nan]
    games = np.append(np.arange(0, num_games, test_every), num_games)
    for at, following in zip(games, [*games[1:], num_games], strict=True):
        if rules and at == told_at:
            network = compiled(insert_rules(as_network(network), rules))
        asked = [i for i, when in enumerate((told_at, num_games)) if rules and at == when]
        tested, seen = np.zeros(NUM_TESTS), np.zeros((_MOST_SEEN if asked else 0, NUM_INPUTS))
        count = play_games(network, game, room, tested, seen, new_stream(_TEST_GAMES))
        returns.append(tested.mean())
        for i in asked:
            followed[i] = _followed(network, rules, seen[:count])
        learn_games(network, game, room, STEP_SIZE, GAMMA, temperatures[at:following], stream)
    return Study(
        games, np.array(returns), told_at if rules else None, (followed[0], followed[1]),
        _worth(network, advice or {}), network,
    )  # fmt: skip


def _child(seed: np.random.SeedSequence, i: int) -> np.random.SeedSequence:
    """Not `spawn`, which gives every contender another one."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i))


def _new_network(seed: np.random.SeedSequence, num_hidden: int) -> SmdpNetwork:
    q = ActionOutputQ(NUM_INPUTS, NUM_ACTIONS, MLP((num_hidden,), activation="sigmoid"), dtype=torch.float64)
    network = compiled(q)
    network.flat[:] = np.random.default_rng(seed).uniform(-_WIDTH, _WIDTH, network.flat.size)
    return network


def _followed(network: SmdpNetwork, rules: list[Rule], seen: NDArray[np.float64]) -> float:
    """Share of the states with one advised action in which that is the best."""
    x = torch.from_numpy(seen)
    advised = torch.zeros(len(x), NUM_ACTIONS, dtype=torch.bool)
    for rule in rules:
        advised[:, rule.action] |= rule.holds(x)
    best = torch.nn.functional.one_hot(as_network(network).all(x).argmax(1), NUM_ACTIONS).bool()
    one = advised.sum(1) == 1
    return float((best & advised).any(1)[one].double().mean())


def _worth(network: SmdpNetwork, advice: Advice) -> dict[str, float]:
    """Mean weight from the units of each kind of rule to its action; the units are the last ones."""
    at, worth = len(network.b) - sum(map(len, advice.values())), {}
    for name, rules in advice.items():
        worth[name] = float(np.mean([network.v[rule.action, at + i] for i, rule in enumerate(rules)]))
        at += len(rules)
    return worth
