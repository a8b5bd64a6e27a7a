"""Snapshots of environments: what is restored takes the very steps of the original, bit for bit, or is refused.

The oracle is the original environment itself, stepped beside the restored one by a loop written here.
Mutants that must die here: generator not restored or restored as a copy of a shared one · sub-environments skipped ·
arrays aliased with the tree · class constants overwritten in place · attributes set later left behind · mid-episode
counters of wrappers lost · the autoreset flag lost · probe restores before the original has gone on.
"""

from __future__ import annotations

import enum
import random
import re
import threading
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

import neuralq_envs
from neuralq.mdp import FiniteMDP
from neuralq.runs.folder import checkpoint
from neuralq.runs.folder.env_encode import NotCopyable, encode_env
from neuralq.runs.folder.env_probe import is_resumable
from neuralq.runs.folder.env_restore import restore_env
from neuralq.runs.stream import make_vector_env

NEWEST_TAXI = max(name for name in gymnasium.registry if name.startswith("Taxi-v"))
CLASSIC = ["CartPole-v1", NEWEST_TAXI, "FrozenLake-v1", "Blackjack-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1"]
MDP = FiniteMDP.garnet(30, 3, 4, seed=2)


def cartpoles(mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3, autoreset_mode=mode)


def delayed_rewards(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """A wrapped function with memory of its own: a counter and a generator in its closure."""
    count, rng = [0], np.random.default_rng(8)

    def noisy(reward: Any) -> float:
        count[0] += 1
        return float(reward) * count[0] + float(rng.normal())

    return wrappers.TransformReward(env, noisy)


def wrapped(wrap: Callable[[Any], Any], env_id: str = "CartPole-v1") -> Callable[[], Any]:
    return lambda: wrap(gymnasium.make(env_id))


MAKERS: dict[str, Callable[[], Any]] = {
    **{name: partial(gymnasium.make, name) for name in CLASSIC},
    **{f"sync {mode.name}": partial(cartpoles, mode) for mode in AutoresetMode},
    "vector CartPole": lambda: gymnasium.make_vec("CartPole-v1", num_envs=8, vectorization_mode="vector_entry_point"),
    "wrapped vector": lambda: wrappers.vector.RecordEpisodeStatistics(
        wrappers.vector.NormalizeObservation(cartpoles(AutoresetMode.NEXT_STEP))
    ),
    "TimeLimit": wrapped(lambda e: wrappers.TimeLimit(e, 7)),
    "RecordEpisodeStatistics": wrapped(wrappers.RecordEpisodeStatistics),
    "NormalizeObservation": wrapped(wrappers.NormalizeObservation),
    "NormalizeReward": wrapped(wrappers.NormalizeReward),
    "FrameStackObservation": wrapped(lambda e: wrappers.FrameStackObservation(e, 4)),
    "TransformReward": wrapped(lambda e: wrappers.TransformReward(e, lambda r: 2 * r)),
    "TransformReward with a memory": wrapped(delayed_rewards),
    "DelayObservation": wrapped(lambda e: wrappers.DelayObservation(e, 3)),
    "StickyAction": wrapped(lambda e: wrappers.StickyAction(e, 0.4)),
    "ClipAction": wrapped(lambda e: wrappers.ClipAction(wrappers.RescaleAction(e, -1, 1)), "Pendulum-v1"),
    "FiniteMDP": MDP.as_env,
    "vector FiniteMDP": lambda: MDP.as_vector_env(4, max_episode_steps=6),
}


def play(env: Any, num: int, rng: np.random.Generator, ended: np.ndarray[Any, Any] | None = None) -> list[Any]:
    """``num`` steps with actions from ``rng``, as arrays and numbers; episodes are begun anew where they must be."""
    seen: list[Any] = []
    ended = np.zeros(getattr(env, "num_envs", 1), bool) if ended is None else ended
    is_vector = isinstance(env, VectorEnv)
    resets_itself = is_vector and env.metadata["autoreset_mode"] is not AutoresetMode.DISABLED
    single = env.single_action_space if is_vector else env.action_space
    for _ in range(num):
        if ended.any() and not resets_itself:
            seen.append(np.array(env.reset(options={"reset_mask": ended.copy()} if is_vector else None)[0]))
        if isinstance(single, gymnasium.spaces.Discrete):
            action = rng.integers(single.n, size=env.num_envs) if is_vector else int(rng.integers(single.n))
        else:
            action = rng.uniform(-1, 1, size=single.shape).astype(np.float32)
        obs, reward, terminated, truncated, _ = env.step(action)
        ended = np.atleast_1d(np.logical_or(terminated, truncated))
        seen += [np.array(obs), np.array(reward), np.array(terminated), np.array(truncated)]
    return [*seen, ended]


def equal(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(
        x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True)
    )


def through_a_file(tree: Any, folder: Path) -> Any:
    return checkpoint.load(checkpoint.save(folder, 1, {"env": tree})).state["env"]


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("before", [1, 23])
def test_a_restored_environment_repeats_every_step(name: str, before: int, tmp_path: Path) -> None:
    env, fresh = MAKERS[name](), MAKERS[name]()
    env.reset(seed=11)
    ended = play(env, before, np.random.default_rng(0))[-1]
    tree = encode_env(env)
    expected = play(env, 120, np.random.default_rng(1), ended)
    restore_env(fresh, through_a_file(tree, tmp_path))
    assert equal(play(fresh, 120, np.random.default_rng(1), ended), expected)


@pytest.mark.parametrize("name", MAKERS)
def test_the_probe_agrees(name: str) -> None:
    found = is_resumable(MAKERS[name], 3, np.random.default_rng(4))
    assert found.exact and found.reason.startswith("resumes bit-exact"), found.reason


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_state_between_an_end_and_its_autoreset_is_kept(mode: AutoresetMode) -> None:
    env, fresh = cartpoles(mode), cartpoles(mode)
    env.reset(seed=0)
    rng, ended = np.random.default_rng(0), np.zeros(3, bool)
    while not ended.any():
        ended = play(env, 1, rng, ended)[-1]
    restore_env(fresh, encode_env(env))
    assert equal(play(fresh, 60, np.random.default_rng(1), ended), play(env, 60, np.random.default_rng(1), ended))


def test_a_tree_shares_nothing_with_its_environment() -> None:
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    tree, again = encode_env(env), encode_env(env)
    play(env, 5, np.random.default_rng(0))
    fresh = gymnasium.make("CartPole-v1")
    restore_env(fresh, tree)
    play(fresh, 5, np.random.default_rng(0))
    restore_env(other := gymnasium.make("CartPole-v1"), tree)
    assert str(encode_env(other)) == str(again) == str(tree)


FORMER_NAMES = {
    "neuralq_envs.rendering.RenderedEnv": "neuralq_envs.drawn.DrawnEnv",
    "neuralq.mdp.environment.": "neuralq.simulate.",
    "neuralq.mdp.sampler.": "neuralq.simulate.",
    "neuralq.mdp.outcomes.": "neuralq.simulate.",
    "neuralq.mdp.model.": "neuralq.mdp.",
    "neuralq.runs.stream.vector_env.SubEnv": "neuralq.interact.lanes.Lane",
    "neuralq.runs.stream.encoding.": "neuralq.features.",
}
"""As of 0.3.1: where classes that stand in the state were, before they were moved."""


def with_former_names(node: Any, seen: set[str]) -> Any:
    if isinstance(node, dict):
        return {key: with_former_names(value, seen) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return type(node)(with_former_names(item, seen) for item in node)
    for now, before in FORMER_NAMES.items():
        if isinstance(node, str) and node.startswith(now):
            seen.add(before)
            return before + node.removeprefix(now)
    return node


def test_a_tree_that_knows_classes_by_former_names_is_restored() -> None:
    neuralq_envs.register()
    seen: set[str] = set()
    env, fresh = (gymnasium.make("neuralq/BlockingMaze-v0") for _ in range(2))
    env.reset(seed=3)
    ended = play(env, 5, np.random.default_rng(0))[-1]
    restore_env(fresh, with_former_names(encode_env(env), seen))
    assert equal(play(fresh, 50, np.random.default_rng(1), ended), play(env, 50, np.random.default_rng(1), ended))
    model = FiniteMDP.garnet(5, 2, 2, seed=0)
    makers = (
        lambda: make_vector_env(model.as_env, 2),
        lambda: make_vector_env(lambda: gymnasium.make("CartPole-v1"), 2),
        lambda: model.as_vector_env(3, max_episode_steps=4),
    )
    for make in makers:
        saved, restored = make(), make()
        saved.reset(seed=3)
        saved.step(np.zeros(saved.num_envs, np.int64))
        restore_env(restored, with_former_names(encode_env(saved), seen))
        actions = np.ones(saved.num_envs, np.int64)
        np.testing.assert_array_equal(saved.step(actions)[0], restored.step(actions)[0])
    assert seen == set(FORMER_NAMES.values())


def test_the_sampling_of_the_action_space_goes_on_where_it_was() -> None:
    env, fresh = gymnasium.make("CartPole-v1"), gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    env.action_space.seed(5)
    env.action_space.sample()
    restore_env(fresh, encode_env(env))
    assert [env.action_space.sample() for _ in range(40)] == [fresh.action_space.sample() for _ in range(40)]


class Mood(enum.Enum):
    CALM = "calm"
    WILD = "wild"


class Point(NamedTuple):
    x: int
    y: int


@dataclass
class Walker:
    rng: np.random.Generator
    place: Point
    trail: list[Any]


@dataclass(frozen=True)
class Score:
    total: float
    moves: int


class Slotted:
    __slots__ = ("__hidden", "home")

    def __init__(self, home: Any) -> None:
        self.home, self.__hidden = home, 0

    def tick(self) -> int:
        self.__hidden += 1
        return self.__hidden


START = np.zeros(4)


class Zoo(gymnasium.Env[Any, Any]):
    """Holds one of each kind of state, and lets all of it show in its observations."""

    origin = np.zeros(4)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,))
    action_space = gymnasium.spaces.Discrete(3)

    def __init__(self) -> None:
        self.board = np.zeros((2, 4))
        self.row = self.board[1]  # a view: must go on being one
        self.walkers: list[Walker] = []
        self.mood: Mood | None = None
        self.score = Score(0.0, 0)
        self.slotted = Slotted(self)
        self.seen: set[Any] = set()
        self.frozen_set: frozenset[int] = frozenset()
        self.tally: Counter[int] = Counter()
        self.table: defaultdict[Any, int] = defaultdict(int)
        self.ordered: OrderedDict[str, int] = OrderedDict()
        self.queue: deque[Any] = deque(maxlen=3)
        self.python_random, self.old_random = random.Random(1), np.random.RandomState(1)
        self.mersenne = np.random.Generator(np.random.MT19937(1))
        self.tensor, self.torch_rng = torch.zeros(4, dtype=torch.float64), torch.Generator().manual_seed(1)
        self.odd = (1 + 2j, b"\x00\xff", 2**100, float("nan"), np.float32(2))
        self.step_function = self.move
        self.bonus = partial(max, 0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.position, self.corner = START, self.origin  # the module's and the class's own, until replaced
        self.board[:] = 0
        self.walkers = [Walker(self.np_random, Point(0, 0), []) for _ in range(2)]
        self.mood, self.greeting = None, 100.0  # greeted once, then the attribute is gone
        return self.position + self.corner, {}

    def step(self, action: Any) -> Any:
        return self.step_function(int(action))

    def move(self, action: int) -> Any:
        noise = [w.rng.normal() for w in self.walkers[:2]] + [self.python_random.random(), self.old_random.rand()]
        self.row += noise
        self.position, self.corner = self.position + self.board[1], self.corner + 1
        self.mood = Mood.WILD if noise[0] > 0 else Mood.CALM
        self.score = replace(self.score, total=self.score.total + noise[1], moves=self.score.moves + 1)
        for walker in self.walkers[: 1 + action]:
            walker.place = Point(walker.place.x + action, walker.place.y + 1)
            walker.trail.append(walker.place)
        if action == 2 and len(self.walkers) < 5:
            self.walkers.append(Walker(self.np_random, Point(9, 9), [self.walkers[0]]))
            self.late = np.array([self.score.moves])
        self.seen.add((action, self.score.moves % 3))
        self.frozen_set |= {action}
        self.tally[action] += 1
        self.table[action, "n"] += 1
        self.ordered[str(action)] = self.score.moves
        self.queue.append(self.position)
        self.tensor += torch.rand(4, generator=self.torch_rng, dtype=torch.float64)
        shown = self.position + self.tensor.numpy() + self.mersenne.random() + getattr(self, "late", 0)
        shown = (
            shown
            + vars(self).pop("greeting", 0.0)
            + len(self.seen)
            + sum(self.queue)
            + self.slotted.tick()
            + self.score.total
        )
        shown = shown + sum(len(w.trail) + w.place.x for w in self.walkers) + (self.mood is Mood.WILD)
        shown = shown + next(iter(self.ordered.values())) + self.table[0, "n"] + self.tally[1] + len(self.frozen_set)
        return shown, self.bonus(noise[0]), noise[0] > 2, False, {}


def test_every_kind_of_state_survives_and_sharing_with_it(tmp_path: Path) -> None:
    for before in (1, 2, 3, 20):
        env, fresh = Zoo(), Zoo()
        env.reset(seed=2)
        ended = play(env, before, np.random.default_rng(before))[-1]
        tree = encode_env(env)
        expected = play(env, 60, np.random.default_rng(5), ended)
        restore_env(fresh, through_a_file(tree, tmp_path))
        assert fresh.walkers[0].rng is fresh.np_random and fresh.row.base is fresh.board
        assert fresh.slotted.home is fresh and isinstance(fresh.walkers[-1], Walker)
        assert equal(play(fresh, 60, np.random.default_rng(5), ended), expected)
        assert not START.any() and not Zoo.origin.any()
    assert is_resumable(Zoo, 1, np.random.default_rng(0)).exact


class OwnProtocol(gymnasium.Env[Any, Any]):
    """Its state is out of reach (a lock stands for a simulator), but it knows how to save itself."""

    observation_space = gymnasium.spaces.Discrete(100)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self) -> None:
        self.simulator, self._n = threading.Lock(), 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._n = 0
        return self._n, {}

    def step(self, action: Any) -> Any:
        self._n = (self._n + int(action) + int(self.np_random.integers(5))) % 100
        return self._n, float(self._n), self._n > 95, False, {}

    def get_state(self) -> dict[str, Any]:
        return {"n": self._n, "also": np.arange(2)}

    def set_state(self, state: dict[str, Any]) -> None:
        assert state["also"].tolist() == [0, 1]
        self._n = state["n"]


class HalfProtocol(OwnProtocol):
    def set_state(self, state: dict[str, Any]) -> None:
        self._n = 50


class WrongProtocol(OwnProtocol):
    def get_state(self, which: str) -> dict[str, Any]:  # type: ignore[override]
        raise AssertionError("never to be called without which")


class Generates(OwnProtocol):
    get_state = set_state = None  # type: ignore[assignment]

    def __init__(self) -> None:
        self.script = (i for i in range(9))


class Global(gymnasium.Env[Any, Any]):
    observation_space, action_space = gymnasium.spaces.Discrete(10**6), gymnasium.spaces.Discrete(2)
    counter = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return 0, {}

    def step(self, action: Any) -> Any:
        Global.counter += 1
        return Global.counter, 0.0, False, False, {}


class Breaks(Global):
    def step(self, action: Any) -> Any:
        raise RuntimeError("the motor is gone")


def test_an_environment_may_save_itself(tmp_path: Path) -> None:
    env, fresh = (wrappers.TimeLimit(OwnProtocol(), 9) for _ in range(2))
    env.reset(seed=1)
    ended = play(env, 4, np.random.default_rng(0))[-1]
    restore_env(fresh, through_a_file(encode_env(env), tmp_path))
    assert equal(play(fresh, 50, np.random.default_rng(1), ended), play(env, 50, np.random.default_rng(1), ended))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: wrappers.TimeLimit(WrongProtocol(), 9), r"env\.env\.simulator is a _thread\.lock"),
        (Generates, r"env\.script is a builtins\.generator"),
        (Global, "a restored environment went another way"),
        (HalfProtocol, "differs after restoring"),
        (Breaks, "raised RuntimeError: the motor is gone"),
        (lambda: 1 / 0, "raised ZeroDivisionError"),
        (lambda: gymnasium.make_vec("CartPole-v1", num_envs=2, vectorization_mode="async"), "in other processes"),
    ],
)
def test_what_cannot_be_restored_is_said_with_its_reason(make: Callable[[], Any], reason: str) -> None:
    found = is_resumable(make, 0, np.random.default_rng(0))
    assert not found.exact and found.reason.startswith("resumes at an episode boundary, not bit-exact: ")
    assert re.search(reason, found.reason), found.reason


def test_a_verdict_is_never_used_as_a_truth_value() -> None:
    with pytest.raises(TypeError, match="exact"):
        bool(is_resumable(Breaks, 0, np.random.default_rng(0)))


def test_the_probe_leaves_the_callers_environment_and_the_global_generators_alone() -> None:
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    before = random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
    random.seed(1), np.random.seed(1), torch.manual_seed(1)  # noqa: NPY002
    is_resumable(MAKERS["CartPole-v1"], 0, np.random.default_rng(0))
    assert before == (random.random(), np.random.rand(), torch.rand(1))  # noqa: NPY002


@pytest.mark.parametrize(
    ("env_id", "other"), [("CartPole-v1", "Acrobot-v1"), (NEWEST_TAXI, "FrozenLake-v1"), ("CartPole-v1", NEWEST_TAXI)]
)
def test_a_state_of_another_environment_is_refused(env_id: str, other: str) -> None:
    (env := gymnasium.make(env_id)).reset(seed=0)
    with pytest.raises(NotCopyable):
        restore_env(gymnasium.make(other), encode_env(env))


def test_another_construction_is_refused() -> None:
    (env := gymnasium.make("FrozenLake-v1", is_slippery=True)).reset(seed=0)
    tree = encode_env(env)
    with pytest.raises(NotCopyable, match=r"env\.env\.env\.env\.P is not what it was"):
        restore_env(gymnasium.make("FrozenLake-v1", is_slippery=False), tree)
    with pytest.raises(NotCopyable):
        restore_env(cartpoles(AutoresetMode.DISABLED), tree)
    for foreign in ({}, {"snapshot": 2}, {"snapshot": 1}, {"snapshot": 1, "root": {"kind": "object"}}):
        with pytest.raises(NotCopyable):
            restore_env(gymnasium.make("CartPole-v1"), foreign)
