"""Where streams of experience begin, and what they say when an environment fails.

Mutants that die here: environments that begin alike whatever the generator; the step of a fault counted from 0, or not
at all.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from neuralq.runs.stream import EnvironmentFault, Episode, Interaction, Step, interact
from neuralq.runs.stream.early_returns import EarlyReturns
from neuralq.runs.stream.encoding import encoder_for
from neuralq.runs.stream.vector_env import make_vector_env


class Masking(gym.Env[Any, Any]):
    """Allows one action only, or says nothing of actions."""

    observation_space, action_space = spaces.Box(0, 1, (1,), np.float32), spaces.Discrete(3)

    def __init__(self, masks: bool) -> None:
        self.masks = masks

    def info(self) -> dict[str, Any]:
        return {"action_mask": np.array([0, 1, 0], np.int8)} if self.masks else {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), self.info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), 0.0, False, False, self.info()


class Failing(gym.Env[Any, Any]):
    """Says what its generator drew at reset; its third step of every episode gives what it is told to."""

    def __init__(self, third: float = 0.0, length: int = 4) -> None:
        self.observation_space, self.action_space = spaces.Box(0, 1, (1,), np.float64), spaces.Discrete(2)
        self.third, self.length, self.episodes = third, length, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.episodes = 0, self.episodes + 1
        return self.np_random.random(1), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        reward = self.third if self.t == 3 and self.episodes == 2 else 1.0
        return np.zeros(1), reward, self.t == self.length, False, {}


def push(s: torch.Tensor, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(len(s), dtype=torch.int64), torch.ones(len(s))


def envs_of(mode: AutoresetMode, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Failing(**kwargs) for _ in range(2)], autoreset_mode=mode)


def test_a_stream_begins_where_its_generator_says() -> None:
    def first(seed: int) -> list[list[float]]:
        stream = interact(envs_of(AutoresetMode.NEXT_STEP), push, np.random.default_rng(seed))
        found: list[list[float]] = next(stream).s_tm1.tolist()
        return found

    assert first(0) == first(0)
    firsts = [tuple(map(tuple, first(seed))) for seed in range(5)]
    assert len(set(firsts)) == 5 and all(one != other for one, other in firsts)
    drawn = int(np.random.default_rng(0).integers(2**31))  # one whole number of 31 bits, as Gymnasium takes seeds
    assert first(0)[0] == pytest.approx(Failing().reset(seed=drawn)[0].tolist(), rel=1e-6)


@pytest.mark.parametrize(("mode", "rows"), [(AutoresetMode.NEXT_STEP, 7), (AutoresetMode.DISABLED, 6)])
def test_a_fault_is_told_by_environment_and_step(mode: AutoresetMode, rows: int) -> None:
    stream = Interaction(envs_of(mode, third=float("nan")), 0.9, 0)
    for _ in range(rows):  # four steps, a wait under NEXT_STEP, and two
        stream.step(lambda s: push(s, np.random.default_rng(0)))
    with pytest.raises(EnvironmentFault, match="after 12 environment steps, environment 0, step 3 of its episode"):
        stream.step(lambda s: push(s, np.random.default_rng(0)))
    with pytest.raises(EnvironmentFault, match="this interaction has ended with an error"):
        stream.step(lambda s: push(s, np.random.default_rng(0)))
    assert stream.running_episodes() == [(2.0, 2), (2.0, 2)]


def test_an_environment_without_a_mask_may_do_everything_beside_one_that_has_one() -> None:
    envs = SyncVectorEnv([lambda: Masking(True), lambda: Masking(False)], autoreset_mode=AutoresetMode.DISABLED)
    stream = Interaction(envs, 0.9, 0)
    ones = torch.ones(2, dtype=torch.int64)
    for _ in range(2):
        step = stream.step(lambda s: (ones, torch.ones(2)))
        assert step.transition.s_t[:, 1:].tolist() == [[0, 1, 0], [1, 1, 1]]


def test_masks_of_a_vector_environment_need_not_say_whose_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    envs = SyncVectorEnv([lambda: Masking(True)] * 2, autoreset_mode=AutoresetMode.DISABLED)
    reset = envs.reset

    def plain(**kwargs: Any) -> Any:  # Gymnasium's own vector environments add "_action_mask", others need not
        observation, info = reset(**kwargs)
        return observation, {"action_mask": info["action_mask"]}

    monkeypatch.setattr(envs, "reset", plain)
    assert Interaction(envs, 0.9, 0).state_dict()["s"][:, 1:].tolist() == [[0, 1, 0], [0, 1, 0]]


def masks_given(monkeypatch: pytest.MonkeyPatch, masks: list[Any], held: list[bool]) -> Interaction:
    """A stream whose first reset tells three masks, as an array of objects, of which some are there."""
    envs = SyncVectorEnv([lambda: Masking(True)] * 3, autoreset_mode=AutoresetMode.DISABLED)
    reset, given = envs.reset, np.empty(3, dtype=object)
    given[:] = masks

    def of_objects(**kwargs: Any) -> Any:
        observation, _ = reset(**kwargs)
        return observation, {"action_mask": given, "_action_mask": np.array(held)}

    monkeypatch.setattr(envs, "reset", of_objects)
    return Interaction(envs, 0.9, 0)


def test_masks_may_come_as_objects_and_each_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = [[0, 1, 0], None, np.array([True, False, True])]
    stream = masks_given(monkeypatch, given, [True, False, True])
    assert stream.state_dict()["s"][:, 1:].tolist() == [[0, 1, 0], [1, 1, 1], [1, 0, 1]]
    with pytest.raises(EnvironmentFault, match=r"environment 2, step 1 .* must have 3 entries, got shape \(2,\)"):
        masks_given(monkeypatch, [[0, 1, 0], [0, 0, 1], [1, 1]], [True, True, True])
    with pytest.raises(EnvironmentFault, match=r"environment 2, step 1 .* got shape \(4,\)"):
        masks_given(monkeypatch, [[0, 1, 0], None, [1, 1, 1, 1]], [True, False, True])


@pytest.mark.parametrize(
    ("stops_at", "error", "note"),
    [(0, OSError, None), (1, OSError, "1 of 3 were made before"), (2, OSError, "2 of 3 were made before"),
     (2, KeyboardInterrupt, None), (3, OSError, None)],
)  # fmt: skip
def test_how_many_environments_were_made_is_told_where_that_may_be_the_reason(
    stops_at: int, error: type[BaseException], note: str | None
) -> None:
    closed: list[int] = []

    class Counted(Masking):
        def close(self) -> None:
            closed.append(made)

    made = 0

    def make() -> gym.Env[Any, Any]:
        nonlocal made
        if made == stops_at:
            raise error("no more")
        made += 1
        env = Counted(False)
        if stops_at == made == 3:  # all are made, and do not go together
            env.observation_space = spaces.Box(0, 1, (2,), np.float32)
        return env

    with pytest.raises(BaseException) as raised:
        make_vector_env(make, 3)
    assert isinstance(raised.value, error) == (stops_at < 3) and len(closed) == made
    notes = getattr(raised.value, "__notes__", [])
    assert [] == notes if note is None else note in notes[0]


@pytest.mark.parametrize("reward", ["1.0", b"1.0", np.str_("1"), np.array("1.0"), np.array(b"1")], ids=repr)
def test_the_text_of_a_number_is_no_reward(monkeypatch: pytest.MonkeyPatch, reward: Any) -> None:
    stream = Interaction(envs_of(AutoresetMode.DISABLED), 0.9, 0)
    monkeypatch.setattr(Failing, "step", lambda self, action: (np.zeros(1), reward, False, False, {}))
    with pytest.raises(EnvironmentFault, match=r"environment 0: reward must be a number, got .*1"):
        stream.step(lambda s: push(s, np.random.default_rng(0)))
    for batch in ([reward, 1.0], np.array(["1.0", "2.0"]), np.array([1.0, reward], dtype=object)):
        stream = Interaction(envs_of(AutoresetMode.DISABLED), 0.9, 0)
        found = (np.zeros((2, 1)), batch, np.zeros(2, bool), np.zeros(2, bool), {})
        with monkeypatch.context() as patched, pytest.raises(EnvironmentFault, match="field reward: must be numbers"):
            patched.setattr(stream.envs, "step", lambda actions, found=found: found)
            stream.step(lambda s: push(s, np.random.default_rng(0)))


def test_numbers_of_every_kind_are_rewards(monkeypatch: pytest.MonkeyPatch) -> None:
    for reward in (1, True, np.float32(1), np.int8(1), np.array(1.0), torch.tensor(1.0), Fraction(1)):
        stream = Interaction(envs_of(AutoresetMode.DISABLED), 0.9, 0)
        with monkeypatch.context() as patched:
            patched.setattr(Failing, "step", lambda self, action, r=reward: (np.zeros(1), r, False, False, {}))
            assert stream.step(lambda s: push(s, np.random.default_rng(0))).rows[3].tolist() == [1.0, 1.0]
    for batch in ([1, 2.0], (np.float32(1), Fraction(2)), np.array([1, 2], np.int8)):
        stream = Interaction(envs_of(AutoresetMode.DISABLED), 0.9, 0)
        found = (np.zeros((2, 1)), batch, np.zeros(2, bool), np.zeros(2, bool), {})
        with monkeypatch.context() as patched:
            patched.setattr(stream.envs, "step", lambda actions, found=found: found)
            assert stream.step(lambda s: push(s, np.random.default_rng(0))).rows[3].tolist() == [1.0, 2.0]


def early(low: float, high: float, said: list[str], num_envs: int = 2) -> EarlyReturns:
    return EarlyReturns(low, high, 0.5, num_envs, said.append)


def one_step(rewards: list[float], moved: list[int], ended: tuple[int, ...] = ()) -> Step:
    fields = tuple(np.array(rewards) if i == 3 else np.zeros(len(moved)) for i in range(7))
    return Step(fields, np.array(moved), tuple(Episode(i, 0.0, 1) for i in ended))


@pytest.mark.parametrize(
    ("low", "high", "outside"), [(2.0, 9.0, False), (-9.0, 2.0, False), (2.1, 9.0, True), (-9.0, 1.9, True)]
)
def test_a_discounted_return_outside_of_what_is_represented_is_told_once(
    low: float, high: float, outside: bool
) -> None:
    said: list[str] = []
    watch = early(low, high, said)
    # Environment 1 earns 8, then 1 + ½ · 2 = 2 in an episode of its own; 0 does not end.
    assert early(-9.0, 9.0, said).add(one_step([7.0, 8.0], [0, 1], (1,))) is not None
    assert watch.add(one_step([5.0, 1.0], [0, 1])) is watch
    assert watch.add(one_step([2.0], [1], (1,))) is (None if outside else watch)
    assert [f"a discounted return of 2 lies outside of {low:g}..{high:g}"] * outside == [
        text.split(",")[0] for text in said
    ]


def test_the_next_episode_begins_anew_and_after_a_thousand_steps_nobody_watches() -> None:
    said: list[str] = []
    watch = early(1.0, 1.0, said)  # a return of 1 is all that there is
    for k in range(499):
        assert watch.add(one_step([1.0, 1.0], [0, 1], (0, 1))) is watch and not said, k
    assert watch.add(one_step([1.0], [1], (1,))) is watch  # 999 steps of environments
    assert watch.add(one_step([1.0], [0], (0,))) is None and not said


def test_one_observation_of_parts_is_told_from_many() -> None:
    encoder = encoder_for(spaces.Dict({"place": spaces.Box(-1, 1, (2,)), "kind": spaces.Discrete(3)}))
    assert not encoder.is_batch({"place": np.zeros(2), "kind": 1})
    assert encoder.is_batch({"place": np.zeros((4, 2)), "kind": np.ones(4, dtype=np.int64)})
    assert not encoder.is_batch(np.zeros(2))


def test_bytes_of_two_axes_are_frames_and_of_one_are_numbers() -> None:
    layouts = [encoder_for(spaces.Box(0, 255, shape, np.uint8)).layout for shape in ((6,), (6, 6), (3, 6, 6))]
    assert layouts[1:] == ["image", "image"] and layouts[0] != "image"
