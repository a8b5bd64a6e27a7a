"""The stream of experience against a plain loop over single environments: the same in all three autoreset modes.

Mutants that these tests kill: NEXT_STEP's step that was never taken stored; SAME_STEP's successor read from the next
episode, or read after the environment overwrote its array; truncation given a discount of 0; `last_t` from termination
alone; the mask of the state that was left instead of the one that was reached; a stale mask; an episode's return that
counts the restart; the action sent without the space's start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import MaskedQ, TableQ
from neuralq.runs.folder.env_encode import encode_env
from neuralq.runs.folder.env_restore import restore_env
from neuralq.runs.stream import EnvironmentFault, Interaction, Step, interact, make_vector_env
from neuralq.runs.stream.acting import EpsilonGreedyPolicy
from neuralq.runs.stream.experience import ReplayExperience
from neuralq.types import Transition
from neuralq_envs import register  # noqa: F401 - which the import does

MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]
GAMMA = 0.9
NUM_ACTIONS = 3
NUM_ENVS = 3
# Length of each episode and how it ends; environment i begins with entry i.
EPISODES = ((3, "terminated"), (1, "truncated"), (4, "truncated"), (1, "terminated"), (2, "both"))


class Scripted(gym.Env[Any, Any]):
    """Episodes by a fixed script; the observation tells environment, episode, step and all that was done so far."""

    def __init__(
        self, env_index: int = 0, kind: str = "box", reuse: bool = False, masked: bool = False, start: int = 0
    ):
        self.env_index, self.kind, self.reuse, self.masked = env_index, kind, reuse, masked
        x = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.observation_space = x if kind == "box" else spaces.Dict({"x": x, "k": spaces.Discrete(2)})
        self.action_space = spaces.Discrete(NUM_ACTIONS, start=start)
        self.episode, self.t, self.trail = env_index - 1, 0, 0.0
        self.buffer = np.zeros(4, np.float32)
        self.both: dict[str, Any] = {"x": self.buffer, "k": 0}

    def mask(self) -> np.ndarray[Any, Any]:
        """Two of the three actions, depending on where the episode stands; none where it has ended by itself."""
        legal = np.arange(NUM_ACTIONS) != (self.t + self.episode) % NUM_ACTIONS
        return legal & (not self.ends()[0])

    def ends(self) -> tuple[bool, bool]:
        length, how = EPISODES[self.episode % len(EPISODES)]
        return self.t == length and how != "truncated", self.t == length and how != "terminated"

    def look(self) -> tuple[Any, dict[str, Any]]:
        self.buffer[:] = self.env_index, self.episode, self.t, self.trail
        x = self.buffer if self.reuse else self.buffer.copy()
        extra = {"action_mask": self.mask()} if self.masked else {}
        if self.kind == "box":
            return x, extra
        both = self.both if self.reuse else {}
        both["x"], both["k"] = x, self.t % 2
        return both, extra

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.t, self.trail = self.episode + 1, 0, 0.0
        return self.look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(np.int64(action))
        index = int(action) - int(self.action_space.start)
        assert not self.masked or self.mask()[index]
        self.t, self.trail = self.t + 1, 2 * self.trail + index
        observation, extra = self.look()
        return observation, 0.1 * self.t + index + self.env_index, *self.ends(), extra


def choose(row: np.ndarray[Any, Any], masked: bool) -> int:
    """A deterministic policy of the encoded observation, legal where it carries a mask."""
    if not masked:
        return int(row.sum() * 7) % NUM_ACTIONS
    legal = np.flatnonzero(row[-NUM_ACTIONS:])
    return int(legal[int(row[:-NUM_ACTIONS].sum() * 7) % len(legal)])


def policy_for(masked: bool) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    def policy(s: Tensor) -> tuple[Tensor, Tensor]:
        a = torch.tensor([choose(row, masked) for row in s.numpy()])
        return a, 1 / (2.0 + a)

    return policy


def encode(env: Scripted, observation: Any, extra: dict[str, Any]) -> np.ndarray[Any, Any]:
    """By hand: Dict keys in alphabetical order, Discrete as one-hot, then the mask (ones where nothing is legal)."""
    row = np.array(observation if env.kind == "box" else [*np.eye(2)[observation["k"]], *observation["x"]], np.float32)
    if not env.masked:
        return row
    mask = extra["action_mask"]
    return np.concatenate([row, mask if mask.any() else np.ones(NUM_ACTIONS)]).astype(np.float32)


def plain_loop(env: Scripted, num_steps: int) -> tuple[list[tuple[Any, ...]], list[tuple[float, int]]]:
    """One environment, one textbook loop: what each field should be, and every episode's return and length."""
    rows: list[tuple[Any, ...]] = []
    episodes = []
    s = encode(env, *env.reset())
    total, length = 0.0, 0
    for _ in range(num_steps):
        a = choose(s, env.masked)
        observation, reward, terminated, truncated, extra = env.step(a + int(env.action_space.start))
        s_next = encode(env, observation, extra)
        mu, discount = np.float32(1 / (2.0 + a)), 0.0 if terminated else GAMMA
        rows.append((s, a, mu, reward, discount, s_next, terminated or truncated))
        total, length, s = total + reward, length + 1, s_next
        if terminated or truncated:
            episodes.append((total, length))
            total, length = 0.0, 0
            s = encode(env, *env.reset())
    return rows, episodes


def stream_of(mode: AutoresetMode, **options: Any) -> Interaction:
    envs = SyncVectorEnv([lambda i=i: Scripted(i, **options) for i in range(NUM_ENVS)], autoreset_mode=mode)
    return Interaction(envs, GAMMA, seed=0)


def by_environment(steps: list[Step]) -> list[list[tuple[Any, ...]]]:
    found: list[list[tuple[Any, ...]]] = [[] for _ in range(NUM_ENVS)]
    for step in steps:
        t = step.transition
        fields = (t.s_tm1, t.a_tm1, t.mu_tm1, t.r_t, t.discount_t, t.s_t, t.last_t)
        for row, env_index in enumerate(step.env_indices):
            found[env_index].append(tuple(field[row].numpy() for field in fields))
    return found


def assert_same(got: list[tuple[Any, ...]], wanted: list[tuple[Any, ...]]) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        for x, y in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(x, y, strict=False)


OPTIONS: list[dict[str, Any]] = [
    {},
    {"reuse": True},
    {"kind": "dict"},
    {"kind": "dict", "reuse": True},
    {"masked": True},
    {"masked": True, "kind": "dict", "reuse": True},
    {"start": -5},
    {"masked": True, "start": 2},
]


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_environment_equals_a_plain_loop(mode: AutoresetMode, options: dict[str, Any]) -> None:
    stream = stream_of(mode, **options)
    masked = bool(options.get("masked"))
    steps = [stream.step(policy_for(masked)) for _ in range(40)]
    for env_index, got in enumerate(by_environment(steps)):
        rows, episodes = plain_loop(Scripted(env_index, **options), len(got))
        assert len(got) >= 25
        assert_same(got, rows)
        told = [(e.episode_return, e.length) for step in steps for e in step.episodes if e.env_index == env_index]
        np.testing.assert_allclose(told, episodes[: len(told)], rtol=1e-12)
        assert len(told) == len(episodes)
    assert stream.num_steps == sum(len(step.env_indices) for step in steps)
    assert {bool(x) for step in steps for x in step.transition.discount_t[step.transition.last_t] == 0} == {True, False}


@pytest.mark.parametrize("options", OPTIONS[:6], ids=str)
def test_replay_contents_are_the_same_in_all_modes(options: dict[str, Any]) -> None:
    contents = []
    for mode in MODES:
        stream = stream_of(mode, **options)
        buffer = ReplayBuffer(NUM_ENVS * 24, stream.spec.shape, stream.spec.dtype, num_envs=NUM_ENVS)
        experience = ReplayExperience(buffer, np.random.default_rng(0), 8, 1, 10**6, 1, 1)
        left = np.full(NUM_ENVS, 24)
        while left.any():  # stop each environment at the same number of steps: NEXT_STEP pauses, the others do not
            step = stream.step(policy_for(bool(options.get("masked"))))
            keep = left[step.env_indices] > 0
            left[step.env_indices[keep]] -= 1
            if keep.any():
                experience.add(Step(tuple(row[keep] for row in step.rows), step.env_indices[keep], ()))
        assert buffer.num_breaks == 0
        contents.append(flattened(buffer.state_dict()))
        sampled = buffer.sample(64, np.random.default_rng(1)).transition
        contents[-1] |= {f"sample {i}": x for i, x in enumerate(astuple(sampled))}
    for other in contents[1:]:
        assert other.keys() == contents[0].keys()
        for name, value in contents[0].items():
            np.testing.assert_array_equal(other[name], value, err_msg=name)


def astuple(t: Transition) -> list[np.ndarray[Any, Any]]:
    return [x.numpy().copy() for x in (t.s_tm1, t.a_tm1, t.mu_tm1, t.r_t, t.discount_t, t.s_t, t.last_t)]


def flattened(state: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in state.items():
        flat |= {f"{name}.{k}": np.array(v) for k, v in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def test_truncation_keeps_the_bootstrap_and_termination_does_not() -> None:
    rows = by_environment(
        [step for step, _ in zip(stream_of(MODES[0]).steps(policy_for(False)), range(20), strict=False)]
    )[0]
    ends = [(float(row[4]), bool(row[6])) for row in rows]
    on, end = (GAMMA, False), (0.0, True)
    assert ends[:11] == [on, on, end, (GAMMA, True), on, on, on, (GAMMA, True), end, on, end]


def test_the_native_vectorised_cartpole_is_read_in_its_own_mode() -> None:
    envs = gym.make_vec("CartPole-v1", num_envs=3, vectorization_mode="vector_entry_point", max_episode_steps=12)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    stream = Interaction(envs, GAMMA, seed=3)
    before: dict[int, np.ndarray[Any, Any]] = {}
    kinds = set()
    for _ in range(60):
        step = stream.step(lambda s: (s[:, 2].gt(0).long(), torch.ones(len(s))))
        for row, env_index in enumerate(step.env_indices):
            t = step.transition.map(lambda x, row=row: x[row].numpy())
            if env_index in before:
                np.testing.assert_array_equal(t.s_tm1, before[env_index])
            before[env_index] = t.s_t
            # The world ends where the pole or the cart leaves its range, and only there.
            outside = abs(t.s_t[0]) > 2.4 or abs(t.s_t[2]) > 12 * np.pi / 180
            assert (t.discount_t == 0) == outside and (t.last_t or not outside)
            kinds.add((bool(t.last_t), bool(outside)))
            if t.last_t:
                del before[env_index]
            assert np.abs(t.s_tm1).max() < 4 and t.r_t == 1
    assert kinds >= {(False, False), (True, False)}
    assert {e.length for e in step.episodes} <= {12}


def test_a_vector_environment_that_does_not_say_how_it_restarts_is_refused() -> None:
    envs = SyncVectorEnv([Scripted])
    envs.metadata = {}
    with pytest.raises(ValueError, match=r"SyncVectorEnv does not say how it restarts.*autoreset_mode"):
        Interaction(envs, GAMMA, 0)


def test_actions_that_are_not_discrete_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"must be Discrete, got Box\(-2.0, 2.0"):
        Interaction(make_vector_env(lambda: gym.make("Pendulum-v1"), 2), GAMMA, 0)


@pytest.mark.parametrize("gamma", [1.5, -0.1, float("nan")])
def test_discounts_outside_their_range_are_refused(gamma: float) -> None:
    with pytest.raises(ValueError, match="discount"):
        Interaction(make_vector_env(Scripted, 1), gamma, 0)


class Faulty(Scripted):
    """Breaks its contract in environment 1, in the second step of its second episode (or at that reset)."""

    def __init__(self, env_index: int, fault: str) -> None:
        super().__init__(env_index)
        self.fault = fault if env_index == 1 else ""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:  # type: ignore[override]
        observation, reward, terminated, truncated, extra = super().step(action)
        if self.episode != 2 or self.t != 2:
            return observation, reward, terminated, truncated, extra
        wrong: dict[str, Any] = {
            "nan reward": (observation, np.nan),
            "no reward": (observation, None),
            "two rewards": (observation, np.ones(2)),
            "inf": (np.array([0, 0, np.inf, 0], np.float32), reward),
            "shape": (np.zeros(3, np.float32), reward),
            "dtype": (np.array(list("abcd")), reward),
            "whole": (np.arange(4), reward),
            "nothing": (None, reward),
        }
        if self.fault == "raises":
            raise RuntimeError("the simulator is gone")
        return *wrong.get(self.fault, (observation, reward)), terminated, truncated, extra

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, extra = super().reset(seed=seed, options=options)
        if self.fault == "raises at reset" and self.episode == 3:
            raise RuntimeError("no licence")
        if self.fault == "nan at reset" and self.episode == 3:
            observation[2] = np.nan
        return observation, extra


FAULTS = {
    "nan reward": "environment 1, step 2 of its episode, field reward: must be finite, got nan",
    "no reward": "environment 1: reward must be a number, got None",
    "two rewards": "environment 1: reward must be a number, got array",
    "inf": r"environment 1: observation must be finite, got inf at index \(2,\)",
    "shape": r"environment 1: observation must have shape \[N, 4\], got \[1, 3\]",
    "dtype": "environment 1: observation must be floating-point .*got dtype <U1",
    "whole": "environment 1: observation must be floating-point .*got dtype int64",
    "nothing": "environment 1: observation must have shape",
    "raises": "environment 1 raised RuntimeError: the simulator is gone",
    "raises at reset": "environment 1 raised RuntimeError: no licence",
    "nan at reset": r"environment 1: observation must be finite, got nan at index \(2,\)",
}


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_names_environment_time_and_field_and_ends_the_stream(mode: AutoresetMode, fault: str) -> None:
    envs = SyncVectorEnv([lambda i=i: Faulty(i, fault) for i in range(NUM_ENVS)], autoreset_mode=mode)
    stream = Interaction(envs, GAMMA, 0)
    steps = 0
    with pytest.raises(EnvironmentFault, match=FAULTS[fault]) as caught:
        for _ in range(20):
            stream.step(policy_for(False))
            steps = stream.num_steps
    assert steps > 0
    assert int(str(caught.value).split("after ")[1].split(" ")[0]) >= steps
    with pytest.raises(EnvironmentFault, match="has ended with an error"):
        stream.step(policy_for(False))


@pytest.mark.parametrize("fault", ["raises", "shape"])
def test_a_fault_at_the_first_reset_names_the_environment(fault: str) -> None:
    class Broken(Scripted):
        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            if fault == "raises":
                raise RuntimeError("no display")
            return np.zeros((2, 2), np.float32), {}

    made = [Scripted, Scripted, Broken]
    with pytest.raises(
        EnvironmentFault, match=r"at reset, environment 2( raised RuntimeError: no display|: observation)"
    ):
        Interaction(SyncVectorEnv(made), GAMMA, 0)


def test_double_precision_observations_are_accepted_and_rounded_once() -> None:
    class Double(Scripted):
        def look(self) -> tuple[Any, dict[str, Any]]:
            observation, extra = super().look()
            return observation.astype(np.float64) + 0.1, extra

    stream = Interaction(make_vector_env(Double, 2), GAMMA, 0)
    step = stream.step(policy_for(False))
    assert step.transition.s_t[0, 2] == np.float32(1.1)


@pytest.mark.parametrize(
    ("mask", "problem"), [([1, 1], r"must have 3 entries, got shape \(2,\)"), ([0, 0, 0], "allows none")]
)
def test_a_mask_that_is_short_or_empty_is_refused(mask: list[int], problem: str) -> None:
    class Masked(Scripted):
        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            *rest, _ = super().step(action)
            return *rest, {"action_mask": np.array(mask)}  # type: ignore[return-value]

    stream = Interaction(make_vector_env(lambda: Masked(masked=True), 2), GAMMA, 0)
    with pytest.raises(EnvironmentFault, match=f"environment 0, step 1 of its episode, field info.*{problem}"):
        stream.step(policy_for(True))


def test_a_mask_that_comes_late_is_refused_and_one_that_is_left_out_allows_everything() -> None:
    class Sometimes(Scripted):
        def __init__(self, when: int) -> None:
            super().__init__()
            self.when = when

        def look(self) -> tuple[Any, dict[str, Any]]:
            return super().look()[0], {"action_mask": np.array([0, 1, 0])} if self.t == self.when else {}

    late = Interaction(make_vector_env(lambda: Sometimes(1), 2), GAMMA, 0)
    with pytest.raises(EnvironmentFault, match="not at the first reset"):
        late.step(policy_for(False))
    stream = Interaction(make_vector_env(lambda: Sometimes(0), 2), GAMMA, 0)
    t = stream.step(policy_for(True)).transition
    assert t.s_tm1[:, -3:].tolist() == [[0, 1, 0]] * 2 and t.s_t[:, -3:].tolist() == [[1, 1, 1]] * 2


def mitchell(vectorised: bool, num_envs: int) -> Any:
    if vectorised:
        return gym.make_vec("neuralq/MitchellGrid-v0", num_envs=num_envs, vectorization_mode="vector_entry_point")
    return make_vector_env(lambda: gym.make("neuralq/MitchellGrid-v0"), num_envs)


@pytest.mark.parametrize("vectorised", [True, False])
def test_only_legal_actions_are_ever_taken_on_mitchells_grid(vectorised: bool) -> None:
    stream = Interaction(mitchell(vectorised, 4), GAMMA, seed=0)
    spec = stream.spec
    assert (spec.masked, spec.shape, spec.inner_shape, spec.num_categories, spec.num_actions) == (True, (5,), (), 6, 4)
    q = MaskedQ(TableQ(6, 4), ())
    policy = EpsilonGreedyPolicy(lambda s: q.all(s).detach(), lambda: 1.0, np.random.default_rng(0))
    taken = set()
    for _ in range(150):
        step = stream.step(policy)
        for s, a, s_t, r in zip(*(x.tolist() for x in astuple(step.transition)[:2]), *_reached(step), strict=True):
            row, column = s[0] // 3, s[0] % 3
            d_row, d_column = ((-1, 0), (0, 1), (1, 0), (0, -1))[a]
            assert 0 <= row + d_row < 2 and 0 <= column + d_column < 3, "left the grid"
            assert s_t[0] == (row + d_row) * 3 + column + d_column
            assert r == (100 if s_t[0] == 2 else 0)
            taken.add((s[0], a))
    assert len(taken) == 12  # every legal pair, and no other


def _reached(step: Step) -> tuple[list[Any], list[Any]]:
    return step.transition.s_t.tolist(), step.transition.r_t.tolist()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_a_restored_stream_continues_bit_for_bit(mode: AutoresetMode, masked: bool) -> None:
    stream = stream_of(mode, masked=masked)
    for _ in range(6):
        stream.step(policy_for(masked))
    state, world = stream.state_dict(), encode_env(stream.envs)
    state = {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in state.items()}
    wanted = [stream.step(policy_for(masked)) for _ in range(12)]
    again = stream_of(mode, masked=masked)
    restore_env(again.envs, world)
    again.load_state_dict(state)
    got = [again.step(policy_for(masked)) for _ in range(12)]
    assert [step.episodes for step in got] == [step.episodes for step in wanted]
    for ours, theirs in zip(by_environment(got), by_environment(wanted), strict=True):
        assert_same(ours, theirs)
    assert again.num_steps == stream.num_steps


def test_interact_yields_the_transitions_of_the_stream() -> None:
    def act(s: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        assert isinstance(rng, np.random.Generator)
        return policy_for(False)(s)

    envs = SyncVectorEnv([lambda i=i: Scripted(i) for i in range(NUM_ENVS)])
    got = [t for t, _ in zip(interact(envs, act, np.random.default_rng(0), GAMMA), range(20), strict=False)]
    wanted = stream_of(AutoresetMode.NEXT_STEP).steps(policy_for(False))
    for ours, theirs in zip(got, wanted, strict=False):
        for x, y in zip(astuple(ours), astuple(theirs.transition), strict=True):
            np.testing.assert_array_equal(x, y)


def test_an_environment_inside_a_vector_wrapper_is_watched_as_well() -> None:
    envs = gym.wrappers.vector.RecordEpisodeStatistics(
        SyncVectorEnv([lambda i=i: Scripted(i, reuse=True) for i in range(3)], autoreset_mode=AutoresetMode.SAME_STEP)
    )
    stream = Interaction(envs, GAMMA, 0)
    for env_index, got in enumerate(by_environment([stream.step(policy_for(False)) for _ in range(30)])):
        assert_same(got, plain_loop(Scripted(env_index), len(got))[0])


# --- the checks above, turned on planted mistakes --------------------------------------------------------------------


def _forget_the_fake_step(stream: Interaction) -> None:
    class Never(np.ndarray):  # type: ignore[type-arg]
        def any(self, *args: Any, **kwargs: Any) -> Any:
            return False

    stream._pending = np.zeros(NUM_ENVS, bool).view(Never)
    original = stream._finish

    def finish(last: Any, arrived: Any) -> Any:
        episodes = original(last, arrived)
        stream.mode = AutoresetMode.SAME_STEP if stream.mode is AutoresetMode.NEXT_STEP else stream.mode
        return episodes

    stream._finish = finish  # type: ignore[method-assign]
    _next_episodes_successor(stream)


def _next_episodes_successor(stream: Interaction) -> None:
    def across(observation: Any, last: Any, terminated: Any, info: Any) -> Any:
        arrived = stream._observe(observation, info, stream._everyone)
        return arrived, arrived

    stream._across_the_end = across  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("mode", "plant"),
    [(AutoresetMode.NEXT_STEP, _forget_the_fake_step), (AutoresetMode.SAME_STEP, _next_episodes_successor)],
)
def test_planted_mistakes_are_found(mode: AutoresetMode, plant: Callable[[Interaction], None]) -> None:
    stream = stream_of(mode)
    plant(stream)
    with pytest.raises(AssertionError):
        for env_index, got in enumerate(by_environment([stream.step(policy_for(False)) for _ in range(20)])):
            assert_same(got, plain_loop(Scripted(env_index), len(got))[0])


def test_without_copies_a_reused_array_spoils_same_steps_successor() -> None:
    # What `SubEnv` is for: take it away and the comparison with the plain loop fails.
    stream = stream_of(AutoresetMode.SAME_STEP, reuse=True)
    stream.envs.envs = [env_index.env for env_index in stream.envs.envs]  # type: ignore[attr-defined]
    with pytest.raises(AssertionError):
        for env_index, got in enumerate(by_environment([stream.step(policy_for(False)) for _ in range(20)])):
            assert_same(got, plain_loop(Scripted(env_index), len(got))[0])
