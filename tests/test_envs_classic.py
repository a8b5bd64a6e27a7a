"""The vectorised Mountain Car and Acrobot against Gymnasium's scalar ones, step for step and start for start.

The oracle is Gymnasium itself: its environments in a `SyncVectorEnv`, and single ones put into chosen states.

Mutants that die here: gravity's cosine of x instead of 3x; the left wall that does not stop the car, or that stops it
when it leaves; velocity clipped after the position moved; the goal's velocity ignored; either bound of the goal
excluded; half a Runge-Kutta step where a whole one is due; weights 1, 2, 1, 2 of the four slopes; an angle not wrapped;
the other joint's velocity bound; reward −1 for arriving; the tip's height without its first link; x · x for x², in
three places; truncation one step late, or withheld where the episode terminates in that step; an episode that goes on
after truncation; step counts that a reset forgets, or resets everywhere; one seed or one generator for all;
starts drawn in environments that are not reset; a start that is not rounded to float32; an array handed out and
overwritten later; an action 3 let through; a twin for an environment with wrappers, unknown arguments or another time
limit.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

import neuralq_envs
from neuralq.runs import RunConfig
from neuralq.runs.folder.env_probe import is_resumable
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.stream import Interaction
from neuralq_envs import vector_twin
from neuralq_envs.classic import ClassicVectorEnv, make_acrobot_vector, make_mountain_car_vector

neuralq_envs.register()

IDS = {"MountainCar-v0": "neuralq/MountainCar-v0", "Acrobot-v1": "neuralq/Acrobot-v0"}
_ANGLES = np.linspace(-10, 10, 20_001)
SAME_COSINES = bool(
    (np.cos(_ANGLES) == [math.cos(x) for x in _ANGLES]).all()
    and (np.sin(_ANGLES) == [math.sin(x) for x in _ANGLES]).all()
)
needs_same_cosines = pytest.mark.skipif(not SAME_COSINES, reason="NumPy's cosines are not the C library's here")


def _theirs(env_id: str, num_envs: int, **kwargs: Any) -> VectorEnv:
    disabled = {"autoreset_mode": AutoresetMode.DISABLED}
    return gymnasium.make_vec(env_id, num_envs, vectorization_mode="sync", vector_kwargs=disabled, **kwargs)


def _ours(env_id: str, num_envs: int, **kwargs: Any) -> ClassicVectorEnv:
    envs = gymnasium.make_vec(IDS[env_id], num_envs, **kwargs)
    assert isinstance(envs, ClassicVectorEnv)
    return envs


def _swing(s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pushes that gain energy, with some at random, so that episodes end early and late: with the velocity."""
    gaining = np.where(s[:, -1] >= 0, 2, 0) if s.shape[1] == 2 else np.where(s[:, 4] >= 0, 0, 2)
    return np.where(rng.random(len(s)) < 0.3, rng.integers(3, size=len(s)), gaining)


def _assert_same(ours: Any, theirs: Any) -> None:
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.dtype == other.dtype and mine.tobytes() == other.tobytes()


@needs_same_cosines
@pytest.mark.parametrize("env_id", sorted(IDS))
def test_whole_episodes_are_gymnasiums_to_the_bit(env_id: str) -> None:
    ours, theirs, rng = _ours(env_id, 5), _theirs(env_id, 5), np.random.default_rng(0)
    s = ours.reset(seed=11)[0]
    _assert_same([s], theirs.reset(seed=11)[:1])
    terminated = truncated = 0
    for t in range(1500):
        # Random pushes alone seldom arrive: with them for 600 steps, episodes end by the time limit.
        a = rng.integers(3, size=5) if t < 600 else _swing(s, rng)
        step = ours.step(a)
        _assert_same(step[:4], theirs.step(a)[:4])
        assert [list(row) for row in ours._state] == [list(env.unwrapped.state) for env in theirs.envs]
        s, last = step[0], step[2] | step[3]
        terminated, truncated = terminated + int(step[2].sum()), truncated + int(step[3].sum())
        if last.any():
            s = ours.reset(options={"reset_mask": last})[0]
            _assert_same([s], theirs.reset(options={"reset_mask": last})[:1])
            assert (s == step[0]).all(axis=1).tolist() == (~last).tolist()
    assert terminated >= 10 and truncated >= 5


def _states(env_id: str, num: int, rng: np.random.Generator) -> np.ndarray:
    """All over the state space, its edges included."""
    high = np.array([0.6, 0.07] if env_id == "MountainCar-v0" else [np.pi, np.pi, 4 * np.pi, 9 * np.pi])
    low = np.array([-1.2, -0.07]) if env_id == "MountainCar-v0" else -high
    states = rng.uniform(low, high, (num, len(high)))
    at_edge = rng.random(states.shape)
    return np.where(at_edge < 0.1, low, np.where(at_edge > 0.9, high, states))


@pytest.mark.parametrize("env_id", sorted(IDS))
def test_one_step_from_anywhere_is_gymnasiums(env_id: str) -> None:
    rng, num = np.random.default_rng(1), 2000
    states, actions = _states(env_id, num, rng), rng.integers(3, size=num)
    ours, scalar = _ours(env_id, num), gymnasium.make(env_id).unwrapped
    ours.reset(seed=0)
    ours._state[:] = states
    observation, reward, terminated, truncated, _ = ours.step(actions)
    for i in range(num):
        scalar.state = tuple(states[i]) if env_id == "MountainCar-v0" else states[i]
        seen, r_t, ended, _, _ = scalar.step(int(actions[i]))
        assert np.abs(ours._state[i] - np.array(scalar.state)).max() <= 1e-12
        assert np.abs(observation[i] - seen).max() <= 4e-6  # a unit in the last place of 9π in float32
        assert (reward[i], terminated[i]) == (r_t, ended)
    assert 0 < terminated.sum() < num and not truncated.any()


def test_steps_worked_by_hand() -> None:
    cars = make_mountain_car_vector(3)
    cars.reset(seed=0)
    # At rest where cos 3x = 0 a push adds 0.001; at the wall velocity is lost; at 0.5 and faster it has arrived.
    cars._state[:] = [[-math.pi / 6, 0.0], [-1.19, -0.05], [0.46, 0.05]]
    _, reward, terminated, _, _ = cars.step(np.array([2, 0, 1]))
    assert cars._state[0] == pytest.approx([-math.pi / 6 + 0.001, 0.001], abs=1e-12)
    assert cars._state[1].tolist() == [-1.2, 0.0]
    assert reward.tolist() == [-1.0] * 3 and terminated.tolist() == [False, False, True]
    arms = make_acrobot_vector(2)
    arms.reset(seed=0)
    # Hanging at rest it stays; upright at rest it stays as well, with its tip at 2, above the bar at 1.
    arms._state[:] = [[0.0, 0.0, 0.0, 0.0], [math.pi, 0.0, 0.0, 0.0]]
    observation, reward, terminated, _, _ = arms.step(np.array([1, 1]))
    assert observation[0] == pytest.approx([1, 0, 1, 0, 0, 0], abs=1e-12)
    assert observation[1] == pytest.approx([-1, 0, 1, 0, 0, 0], abs=1e-6)
    assert reward.tolist() == [-1.0, 0.0] and terminated.tolist() == [False, True]


def test_the_arm_keeps_its_energy_without_torque() -> None:
    # Kinetic and potential energy of two links of mass 1, length 1 and moment 1 about their centres (Spong 1995).
    def energy(s: np.ndarray) -> np.ndarray:
        x1, x2, v1, v2 = s.T
        d11, d12, d22 = 3.5 + np.cos(x2), 1.25 + 0.5 * np.cos(x2), 1.25
        kinetic = 0.5 * (d11 * v1**2 + 2 * d12 * v1 * v2 + d22 * v2**2)
        return kinetic - 9.8 * (1.5 * np.cos(x1) + 0.5 * np.cos(x1 + x2))

    arms = make_acrobot_vector(50, max_episode_steps=None)
    arms.reset(seed=3, options={"low": -0.5, "high": 0.5})
    before = energy(arms._state)
    for _ in range(5):
        arms.step(np.ones(50, int))
    assert np.abs(energy(arms._state) - before).max() < 0.02  # the method's own error at steps of 0.2


@needs_same_cosines
@pytest.mark.parametrize(
    ("env_id", "options"), [("MountainCar-v0", {"low": 0.3, "high": 0.48}), ("Acrobot-v1", {"low": -0.3, "high": 3.0})]
)
def test_starts_are_drawn_lane_by_lane_as_gymnasium_draws_them(env_id: str, options: dict[str, float]) -> None:
    ours, theirs = _ours(env_id, 4), _theirs(env_id, 4)
    for seed, mask in ((5, None), (None, [0, 1, 0, 1]), (None, None), ([7, None, 7, 1], None), (9, [0, 0, 1, 0])):
        extra = dict(options) if mask is None else {**options, "reset_mask": np.array(mask, bool)}
        mine = ours.reset(seed=seed, options=dict(extra))[0]
        _assert_same([mine], theirs.reset(seed=seed, options=dict(extra))[:1])
    single = gymnasium.make(env_id).unwrapped.reset(seed=44)[0]
    assert single.tobytes() == ours.reset(seed=42)[0][2].tobytes()  # environment i is seeded with seed + i


def test_without_a_seed_starts_differ_between_lanes_and_makings() -> None:
    starts = np.concatenate([make_mountain_car_vector(3).reset()[0][:, 0] for _ in range(2)])
    assert len(set(starts.tolist())) == 6


@pytest.mark.parametrize("env_id", sorted(IDS))
def test_the_time_limit_truncates_and_shows_the_true_last_observation(env_id: str) -> None:
    limit = {"MountainCar-v0": 200, "Acrobot-v1": 500}[env_id]
    envs, unlimited = _ours(env_id, 2), _ours(env_id, 2, max_episode_steps=None)
    assert envs.spec.max_episode_steps == limit
    envs.reset(seed=0), unlimited.reset(seed=0)
    for t in range(1, limit + 1):
        s, _, terminated, truncated, _ = envs.step(np.ones(2, int))  # nothing is pushed: it never arrives
        beyond = unlimited.step(np.ones(2, int))
        assert truncated.tolist() == [t == limit] * 2 and not terminated.any() and not beyond[3].any()
    assert (s == beyond[0]).all()
    with pytest.raises(ResetNeeded, match="environment 0 must be reset before it is stepped"):
        envs.step(np.ones(2, int))
    envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeeded, match="environment 1"):
        envs.step(np.ones(2, int))
    fresh = envs.reset(options={"reset_mask": np.array([False, True])})[0]
    assert (fresh != s).any(axis=1).all() and not envs.step(np.ones(2, int))[3].any()


def test_arriving_with_the_last_step_is_termination_and_truncation_as_gymnasium_has_it() -> None:
    ours, theirs = _ours("MountainCar-v0", 1, max_episode_steps=3), _theirs("MountainCar-v0", 1, max_episode_steps=3)
    for envs in (ours, theirs):
        envs.reset(seed=0, options={"low": 0.43, "high": 0.43})
    ours._state[0, 1] = 0.03
    theirs.envs[0].unwrapped.state = np.array([0.43, 0.03])
    for t in (1, 2, 3):
        _assert_same(ours.step(np.array([2]))[1:4], flags := theirs.step(np.array([2]))[1:4])
        assert [f.item() for f in flags] == [-1.0, t == 3, t == 3]
    envs = make_mountain_car_vector(1, max_episode_steps=3)
    stream = Interaction(envs, 0.9, seed=0)
    envs._state[0] = [0.43, 0.03]
    steps = [stream.step(lambda s: (torch.full((1,), 2), torch.ones(1))).transition for _ in range(3)]
    assert [float(t.discount_t) for t in steps] == [0.9, 0.9, 0.0]


def test_the_goals_velocity_counts() -> None:
    ours, theirs = _ours("MountainCar-v0", 2, goal_velocity=0.06), _theirs("MountainCar-v0", 2, goal_velocity=0.06)
    for envs in (ours, theirs):
        envs.reset(seed=0)
    ours._state[:] = [[0.49, 0.05], [0.49, 0.065]]
    for env, state in zip(theirs.envs, ours._state.copy(), strict=True):
        env.unwrapped.state = state
    _assert_same(ours.step(np.array([1, 1]))[:4], theirs.step(np.array([1, 1]))[:4])
    assert ours._over.tolist() == [False, True]
    # Velocity 0.07, where it is clipped, brings a car from 0.43 to 0.5 exactly: both bounds belong to the goal.
    assert 0.43 + 0.07 == 0.5
    ours = _ours("MountainCar-v0", 1, goal_velocity=0.07)
    ours.reset(seed=0)
    ours._state[0] = [0.43, 0.07]
    assert ours.step(np.array([2]))[2].tolist() == [True]


@pytest.mark.parametrize("make", [make_mountain_car_vector, make_acrobot_vector])
def test_what_was_returned_never_changes_and_what_is_refused_changes_nothing(make: Any) -> None:
    envs = make(3)
    first = envs.reset(seed=0)[0]
    kept = first.copy()
    arrays = envs.step(np.array([0, 1, 2]))[:4]
    copies = [array.copy() for array in arrays]
    for wrong, said in (
        ([0, 3, 1], "got 3 for environment 1"),
        ([-1, 0, 0], "got -1 for environment 0"),
        ([0, 0], "actions must be 3 whole numbers, got int64 of shape"),
        ([0.0, 1.0, 2.0], "actions must be 3 whole numbers, got float64"),
    ):
        with pytest.raises(ValueError, match=said):
            envs.step(np.array(wrong))
    state = envs._state.copy()
    assert envs._steps.tolist() == [1, 1, 1]
    by_int32 = envs.step(np.array([0, 1, 2], np.int32))[0]
    assert (first == kept).all() and all((a == c).all() for a, c in zip(arrays, copies, strict=True))
    envs._state[:] = state
    assert (envs.step(np.array([0, 1, 2]))[0] == by_int32).all()


def test_wrong_arguments_are_refused() -> None:
    envs = make_acrobot_vector(2)
    with pytest.raises(ResetNeeded, match="environment 0"):
        envs.step(np.zeros(2, int))
    for options in ({"reset_mask": np.array([1, 0])}, {"reset_mask": np.array([True])}):
        with pytest.raises(ValueError, match=r"reset_mask must be bool of shape \(2,\)"):
            envs.reset(options=options)
    with pytest.raises(ValueError, match="seed must be one number or 2 of them, got 3"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="bound"):
        envs.reset(options={"low": 1.0, "high": 0.0})
    for wrong in ({"num_envs": 0}, {"max_episode_steps": 0}):
        with pytest.raises(ValueError, match="must be a whole number of at least 1"):
            make_acrobot_vector(**wrong)


@pytest.mark.parametrize("env_id", sorted(IDS))
def test_spaces_and_registration_are_gymnasiums(env_id: str) -> None:
    ours, scalar = _ours(env_id, 3), gymnasium.make(IDS[env_id])
    check_env(scalar.unwrapped, skip_render_check=True)  # warnings are errors; drawing is Gymnasium's
    theirs = gymnasium.make(env_id)
    assert type(scalar.unwrapped) is type(theirs.unwrapped)
    for field in ("max_episode_steps", "reward_threshold", "entry_point"):
        assert getattr(scalar.spec, field) == getattr(theirs.spec, field)
    assert ours.single_observation_space == theirs.observation_space
    assert ours.single_action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    s = ours.reset(seed=0)[0]
    assert s.dtype == np.float32 and ours.observation_space.contains(s)
    assert ours.observation_space.contains(ours.step(ours.action_space.sample())[0])
    # Other programs' environments stay as they are.
    assert gymnasium.spec(env_id).vector_entry_point is None
    assert isinstance(gymnasium.make_vec(env_id, num_envs=2), SyncVectorEnv)


@pytest.mark.parametrize("env_id", sorted(IDS))
def test_a_run_can_be_resumed_in_them(env_id: str) -> None:
    short = {"max_episode_steps": 20}  # episodes that end on both sides of the snapshot
    found = is_resumable(lambda: _ours(env_id, 3, **short), 0, np.random.default_rng(0))
    assert found.exact, found


@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize("env_id", [*IDS, *IDS.values()])
def test_training_takes_the_vectorised_one(env_id: str, num_envs: int) -> None:
    envs = make_envs(RunConfig(env=env_id, env_kwargs={"max_episode_steps": 7}), num_envs)
    assert isinstance(envs, ClassicVectorEnv) and envs.num_envs == num_envs
    envs.reset(seed=0)
    assert [bool(envs.step(np.ones(num_envs, int))[3].all()) for _ in range(7)] == [False] * 6 + [True]


def test_training_takes_gymnasiums_own_where_the_vectorised_one_would_not_be_the_same() -> None:
    for given in ({"render_mode": "rgb_array"}, {"disable_env_checker": True}):
        assert vector_twin(gymnasium.spec("MountainCar-v0"), given) is None
    assert isinstance(
        make_envs(RunConfig(env="Acrobot-v1", env_kwargs={"disable_env_checker": True}), 2), SyncVectorEnv
    )
    car = neuralq_envs.CLASSIC["neuralq/MountainCar-v0"].entry_point
    longer = gymnasium.envs.registration.EnvSpec("Longer-v0", car, max_episode_steps=900)
    assert vector_twin(longer, {}) == ("neuralq/MountainCar-v0", {"max_episode_steps": 900})
    assert vector_twin(longer, {"max_episode_steps": -1}) == ("neuralq/MountainCar-v0", {"max_episode_steps": None})
    assert vector_twin(longer, {"goal_velocity": 0.01})[1] == {"goal_velocity": 0.01, "max_episode_steps": 900}
    assert vector_twin(gymnasium.spec("CartPole-v1"), {}) is None
    wrapped = gymnasium.envs.registration.WrapperSpec("Noise", "somewhere:Noise", {})
    assert vector_twin(gymnasium.envs.registration.EnvSpec("W-v0", car, additional_wrappers=(wrapped,)), {}) is None
