"""The replay buffer against plain lists of steps and sums written out here.

Planted mutants that die here: the window crossing `last_t`, or the newest step; the discount multiplied before the
reward instead of after; `s_t` of the first step instead of the last; eviction one step late (a row already
overwritten); an observation chain joined across a break; a break left unmarked; a new step without the largest
priority; draws that are not stratified; weights not divided by their maximum; priorities lost on load.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import neuralq.checks
from neuralq.learners.replay.buffer import Batch, Prioritised, ReplayBuffer
from neuralq.types import Transition

NAMES = [f.name for f in fields(Transition)]


@dataclass
class Step:
    s_tm1: int
    a_tm1: int
    mu_tm1: float
    r_t: float
    discount_t: float
    s_t: int
    last_t: bool


class Streams:
    """Random streams whose every observation is a number of its own, so that a wrong row cannot go unseen."""

    def __init__(self, num_envs: int, seed: int, p_end: float = 0.2) -> None:
        self.rng, self.p_end = np.random.default_rng(seed), p_end
        self.counter = 0
        self.current = [self.fresh() for _ in range(num_envs)]
        self.env_indices: list[list[Step]] = [[] for _ in range(num_envs)]

    def fresh(self) -> int:
        self.counter += 1
        return self.counter

    def step(self, env_index: int, *, broken: bool = False) -> Step:
        last = bool(self.rng.random() < self.p_end)
        terminated = last and self.rng.random() < 0.5
        discount = 0.0 if terminated else float(self.rng.choice([0.5, 0.75, 1.0]))
        reward, mu = float(self.rng.integers(-8, 9)), float(self.rng.choice([0.25, 1.0]))
        made = Step(self.current[env_index], int(self.rng.integers(9)), mu, reward, discount, self.fresh(), last)
        self.current[env_index] = self.fresh() if last or broken else made.s_t
        self.env_indices[env_index].append(made)
        if broken:
            self.env_indices[env_index][-1] = Step(
                **{**made.__dict__, "last_t": True}
            )  # what the buffer should make of it
        return made


def stacked(steps: list[Step], observation: Any) -> Transition:
    dtypes = (None, torch.int64, torch.float32, torch.float32, torch.float32, None, torch.bool)
    columns = []
    for name, dtype in zip(NAMES, dtypes, strict=True):
        values = [getattr(s, name) for s in steps]
        columns.append(torch.from_numpy(observation(values)) if dtype is None else torch.tensor(values, dtype=dtype))
    return Transition(*columns)


def as_pairs(values: list[int]) -> np.ndarray[Any, Any]:
    return np.stack([np.array(values), -np.array(values)], axis=1).astype(np.float32)


def filled(num_adds: int, num_envs: int, capacity: int, seed: int, **options: Any) -> tuple[ReplayBuffer, Streams]:
    """A buffer filled in uneven turns: each time some of the environments, in random order."""
    buffer = ReplayBuffer(capacity, (2,), np.float32, num_envs=num_envs, **options)
    streams = Streams(num_envs, seed)
    turns = np.random.default_rng(seed + 1)
    for _ in range(num_adds):
        env_indices = turns.permutation(num_envs)[: turns.integers(1, num_envs + 1)]
        buffer.add(stacked([streams.step(int(env_index)) for env_index in env_indices], as_pairs), env_indices)
    return buffer, streams


def n_step(stream: list[Step], t: int, n: int) -> Step:
    """Sutton & Barto eq. 7.1 with a discount per step, term by term from the list."""
    window = [stream[t]]
    while len(window) < n and not window[-1].last_t and t + len(window) < len(stream):
        window.append(stream[t + len(window)])
    total = sum(math.prod(w.discount_t for w in window[:k]) * window[k].r_t for k in range(len(window)))
    discount = math.prod(w.discount_t for w in window)
    return Step(window[0].s_tm1, window[0].a_tm1, window[0].mu_tm1, total, discount, window[-1].s_t, window[-1].last_t)


def rows_of(transition: Transition) -> list[tuple[float, ...]]:
    flat = transition.map(lambda x: x.reshape(-1, 2)[:, 0] if x.ndim > transition.r_t.ndim else x.reshape(-1))
    return list(zip(*(getattr(flat, name).tolist() for name in NAMES), strict=True))


def as_row(step: Step) -> tuple[float, ...]:
    return tuple(getattr(step, name) for name in NAMES)


@settings(max_examples=25, deadline=None)
@given(
    num_envs=st.integers(1, 4),
    per_env=st.integers(1, 9),
    num_adds=st.integers(1, 40),
    n=st.integers(1, 5),
    seed=st.integers(0, 999),
)
def test_samples_are_the_n_step_transitions_of_the_held_steps(
    num_envs: int, per_env: int, num_adds: int, n: int, seed: int
) -> None:
    buffer, streams = filled(num_adds, num_envs, per_env * num_envs, seed, num_steps=n)
    expected = {
        as_row(n_step(stream, t, n))
        for stream in streams.env_indices
        for t in range(max(0, len(stream) - per_env), len(stream))
    }
    batch = buffer.sample(600, np.random.default_rng(seed))
    assert torch.equal(batch.transition.s_t[:, 0], -batch.transition.s_t[:, 1])
    assert set(rows_of(batch.transition)) == expected  # every held step drawn, and nothing else
    assert len(buffer) == sum(min(per_env, len(stream)) for stream in streams.env_indices)
    assert buffer.num_breaks == 0


def test_termination_truncation_and_cursor_each_alone() -> None:
    # gamma 1/2, rewards 1, 2, 4; n = 3. Terminated at the second: 1 + 2/2 = 2, bootstrap 0.
    # Truncated there: the same sum, bootstrap 1/4 at the truncated step's own successor. Open end: all that is there.
    for last, discounts, expected in [
        ([0, 1, 0], [0.5, 0.0, 0.5], (2.0, 0.0, 3.0, 1.0)),
        ([0, 1, 0], [0.5, 0.5, 0.5], (2.0, 0.25, 3.0, 1.0)),
        ([0, 0, 0], [0.5, 0.5, 0.5], (3.0, 0.125, 4.0, 0.0)),
        ([0, 0], [0.5, 0.5], (2.0, 0.25, 3.0, 0.0)),
    ]:
        buffer = ReplayBuffer(8, (1,), np.float32, num_steps=3)
        for t, (end, discount) in enumerate(zip(last, discounts, strict=True)):
            near, far = np.array([t + 1], np.float32), np.array([t + 2], np.float32)
            buffer.add_step(0, near, 0, 1.0, 2.0**t, discount, far, bool(end))
        got = buffer.sample(64, np.random.default_rng(0)).transition
        first = got.map(lambda x, got=got: x[(got.s_tm1[:, 0] == 1).nonzero()[0, 0]])
        assert (float(first.r_t), float(first.discount_t), float(first.s_t[0]), float(first.last_t)) == expected


@settings(max_examples=20, deadline=None)
@given(num_envs=st.integers(1, 3), length=st.integers(1, 6), num_adds=st.integers(6, 40), seed=st.integers(0, 999))
def test_blocks_are_consecutive_steps_of_one_lane(num_envs: int, length: int, num_adds: int, seed: int) -> None:
    per_env = 7
    buffer, streams = filled(num_adds, num_envs, per_env * num_envs, seed)
    held = [stream[max(0, len(stream) - per_env) :] for stream in streams.env_indices]
    expected = {
        tuple(as_row(s) for s in stream[t : t + length]) for stream in held for t in range(len(stream) - length + 1)
    }
    if not expected:
        with pytest.raises(ValueError, match="the fullest environment holds"):
            buffer.sample_blocks(4, length, np.random.default_rng(seed))
        return
    blocks = buffer.sample_blocks(300, length, np.random.default_rng(seed))
    assert blocks.s_tm1.shape == (length, 300, 2)
    got = {tuple(rows_of(blocks.map(lambda x, i=i: x[:, i : i + 1]))) for i in range(300)}
    assert got == expected


def test_a_whole_rollout_is_stored_as_its_steps_one_by_one() -> None:
    one, whole = (ReplayBuffer(30, (2,), np.float32, num_envs=3) for _ in range(2))
    streams = Streams(3, seed=5)
    rollout = [stacked([streams.step(env_index) for env_index in range(3)], as_pairs) for _ in range(17)]
    for step in rollout:
        one.add(step)
    whole.add(Transition(*(torch.stack([getattr(x, name) for x in rollout]) for name in NAMES)))
    assert_same_state(one.state_dict(), whole.state_dict())


def test_a_stream_that_does_not_continue_is_marked_as_broken() -> None:
    buffer, streams = ReplayBuffer(50, (2,), np.float32, num_steps=3), Streams(1, 3, p_end=0.1)
    for t in range(40):
        buffer.add(stacked([streams.step(0, broken=t % 4 == 3 and t < 39)], as_pairs))
    expected = {as_row(n_step(streams.env_indices[0], t, 3)) for t in range(40)}
    assert set(rows_of(buffer.sample(800, np.random.default_rng(0)).transition)) == expected
    assert buffer.num_breaks > 0


@pytest.mark.parametrize("p_end", [0.0, 0.5, 1.0])
def test_large_observations_hold_what_they_promise(p_end: float) -> None:
    # 2 kB rows: 9/8 rows per step. Episodes of one step need two rows each, so 9/16 of the capacity remain.
    buffer, streams = ReplayBuffer(64, (2048,), np.uint8), Streams(1, 1, p_end)
    for _ in range(200):
        buffer.add(
            stacked([streams.step(0)], lambda v: np.repeat(np.array(v)[:, None] % 256, 2048, 1).astype(np.uint8))
        )
    assert len(buffer) == {0.0: 64, 1.0: 36}.get(p_end, len(buffer)) >= 36
    expected = {
        (s.s_tm1 % 256, s.a_tm1, s.mu_tm1, s.r_t, s.discount_t, s.s_t % 256, s.last_t)
        for s in streams.env_indices[0][-len(buffer) :]
    }
    got = buffer.sample(1000, np.random.default_rng(0)).transition
    assert (got.s_t == got.s_t[:, :1]).all()
    assert (got.s_tm1 == got.s_tm1[:, :1]).all()
    ends = got.map(lambda x: x[:, :2] if x.ndim == 2 else x)
    assert set(rows_of(ends)) == expected


@pytest.mark.parametrize(("shape", "dtype"), [((), np.int64), ((2, 3, 1), np.uint8), ((1,), np.bool_)])
def test_shapes_and_dtypes_come_back_as_they_went_in(shape: tuple[int, ...], dtype: Any) -> None:
    buffer = ReplayBuffer(10, shape, dtype)
    near, far = (np.full(shape, x).astype(dtype) for x in (0, 1))
    buffer.add_step(0, near, 3, 0.5, -2.0, 0.9, far, True)
    got = buffer.sample(5, np.random.default_rng(0)).transition
    assert got.s_tm1.numpy().dtype == dtype
    np.testing.assert_array_equal(got.s_tm1.numpy(), np.stack([near] * 5))
    np.testing.assert_array_equal(got.s_t.numpy(), np.stack([far] * 5))
    assert got.a_tm1.tolist() == [3] * 5 and got.last_t.tolist() == [True] * 5
    assert got.r_t.dtype == got.mu_tm1.dtype == got.discount_t.dtype == torch.float32


def test_arrays_with_gaps_float64_rewards_and_gradients_are_stored_alike() -> None:
    plain, odd = (ReplayBuffer(10, (2, 3), np.float32) for _ in range(2))
    near, far = np.arange(6, dtype=np.float32).reshape(2, 3), np.ones((2, 3), np.float32)
    reals = (torch.tensor([x]) for x in (0.5, 2.0, 0.5))
    plain.add(
        Transition(
            torch.from_numpy(near)[None], torch.tensor([1]), *reals, torch.from_numpy(far)[None], torch.tensor([False])
        )
    )
    odd.add_step(0, np.asfortranarray(near), 1, 0.5, 2.0, 0.5, np.repeat(far, 2, axis=1)[:, ::2], False)
    assert_same_state(plain.state_dict(), odd.state_dict())
    reals = (torch.tensor([x], dtype=torch.float64) for x in (0.5, 2.0, 0.5))
    near_t, far_t = torch.from_numpy(near)[None].requires_grad_(), torch.from_numpy(far)[None]
    third = ReplayBuffer(10, (2, 3), np.float32)
    third.add(Transition(near_t, torch.tensor([1]), *reals, far_t, torch.tensor([False])))
    assert_same_state(plain.state_dict(), third.state_dict())


def test_uniform_samples_are_uniform_over_steps_of_uneven_lanes() -> None:
    buffer, streams = filled(30, 3, 60, seed=2)
    held = [s.s_tm1 for stream in streams.env_indices for s in stream[-20:]]
    drawn = buffer.sample(10_000, np.random.default_rng(0)).transition.s_tm1[:, 0].numpy().astype(int)
    counts = np.array([np.count_nonzero(drawn == s) for s in held])
    assert counts.sum() == 10_000
    assert stats.chisquare(counts).pvalue > 1e-3


def test_prioritised_draws_and_weights_follow_the_paper() -> None:
    alpha, beta, epsilon = 0.7, 0.5, 0.01
    buffer = ReplayBuffer(8, (1,), np.float32, prioritised=Prioritised(alpha, beta, epsilon))
    errors = np.array([0.0, 0.5, -1.0, 2.0, -4.0])
    for t in range(5):
        buffer.add_step(0, np.array([t], np.float32), t, 1.0, 0.0, 1.0, np.array([t + 1], np.float32), False)
    rng = np.random.default_rng(0)
    fresh = buffer.sample(5, rng)
    assert sorted(fresh.transition.a_tm1.tolist()) == [0, 1, 2, 3, 4]  # equal weights: one draw from each fifth
    assert fresh.weights.tolist() == [1.0] * 5
    buffer.update_priorities(fresh.indices, torch.from_numpy(errors[fresh.transition.a_tm1.numpy()]))
    share = (np.abs(errors) + epsilon) ** alpha
    share /= share.sum()
    counts = np.zeros(5)
    for _ in range(300):
        batch = buffer.sample(32, rng)
        actions = batch.transition.a_tm1.numpy()
        counts += np.bincount(actions, minlength=5)
        raw = (5 * share[actions]) ** -beta
        np.testing.assert_allclose(batch.weights.numpy(), raw / raw.max(), rtol=1e-6)
        # Stratified: of 32 slices, step a owns at least all but its two border slices.
        assert (np.abs(np.bincount(actions, minlength=5) - 32 * share) < 2).all()
    np.testing.assert_allclose(counts / counts.sum(), share, atol=0.01)
    unweighted = buffer.sample(32, rng, beta=0.0)
    assert unweighted.weights.tolist() == [1.0] * 32


def test_new_steps_get_the_largest_priority_and_old_ones_leave_the_tree() -> None:
    buffer = ReplayBuffer(4, (1,), np.float32, prioritised=Prioritised(alpha=1.0, epsilon=1e-9))
    rng = np.random.default_rng(0)

    def add(t: int) -> None:
        buffer.add_step(0, np.array([t], np.float32), t, 1.0, 0.0, 1.0, np.array([t + 1], np.float32), False)

    for t in range(4):
        add(t)
    batch = buffer.sample(4, rng)
    buffer.update_priorities(batch.indices, np.where(batch.transition.a_tm1.numpy() == 1, 5.0, 1.0))
    add(4)  # takes the place of step 0: priorities 5 (new), 5, 1, 1
    counts = np.zeros(5)
    for _ in range(100):
        counts += np.bincount(buffer.sample(12, rng).transition.a_tm1.numpy(), minlength=5)
    assert counts[0] == 0
    np.testing.assert_allclose(counts / 1200, [0, 5 / 12, 1 / 12, 1 / 12, 5 / 12], atol=0.01)


def test_steps_that_leave_early_cannot_be_drawn_by_priority() -> None:
    # 2 kB observations and one-step episodes: rows run out before records do.
    buffer = ReplayBuffer(16, (2048,), np.uint8, prioritised=Prioritised())
    rng = np.random.default_rng(0)
    for t in range(40):
        near, far = np.full(2048, 2 * t, np.uint8), np.full(2048, 2 * t + 1, np.uint8)
        buffer.add_step(0, near, t, 1.0, 0.0, 0.0, far, True)
        if t % 3 == 0:
            drawn = buffer.sample(64, rng).transition
            assert set(drawn.a_tm1.tolist()) == set(range(t + 1 - len(buffer), t + 1))
            assert (drawn.s_tm1[:, 0] == 2 * drawn.a_tm1).all() and (drawn.s_t[:, 0] == 2 * drawn.a_tm1 + 1).all()


@pytest.mark.parametrize("prioritised", [None, Prioritised()])
@pytest.mark.parametrize("num_adds", [3, 60])
def test_state_continues_bit_for_bit(prioritised: Prioritised | None, num_adds: int) -> None:
    buffer, streams = filled(num_adds, 2, 20, seed=7, prioritised=prioritised, num_steps=2)
    learn(buffer, np.random.default_rng(1), 5)
    other = ReplayBuffer(20, (2,), np.float32, num_envs=2, prioritised=prioritised, num_steps=2)
    other.load_state_dict(copy.deepcopy(buffer.state_dict()))
    more = [stacked([streams.step(0), streams.step(1)], as_pairs) for _ in range(30)]
    results = []
    for x in (buffer, other):
        rng = np.random.default_rng(3)
        trace = []
        for step in more:
            x.add(step)
            trace += learn(x, rng, 1)
        results.append(trace)
    assert results[0] == results[1]
    assert_same_state(buffer.state_dict(), other.state_dict())


def learn(buffer: ReplayBuffer, rng: np.random.Generator, times: int) -> list[Any]:
    trace = []
    for _ in range(times):
        batch: Batch = buffer.sample(8, rng)
        trace.append((rows_of(batch.transition), batch.weights.tolist(), batch.indices.tolist()))
        if buffer.prioritised:
            buffer.update_priorities(batch.indices, batch.transition.r_t)
    return trace


def assert_same_state(left: dict[str, Any], right: dict[str, Any]) -> None:
    assert left.keys() == right.keys()
    for name, value in left.items():
        if isinstance(value, dict):
            assert_same_state(value, right[name])
        else:
            np.testing.assert_array_equal(value, right[name], err_msg=name)


def test_state_of_another_buffer_is_refused() -> None:
    state = ReplayBuffer(20, (2,), np.float32).state_dict()
    for options in ({"capacity": 21}, {"observation_dtype": np.float64}, {"num_envs": 2}):
        arguments: dict[str, Any] = {"capacity": 20, "observation_shape": (2,), "observation_dtype": np.float32}
        with pytest.raises(ValueError, match="construct it alike"):
            ReplayBuffer(**(arguments | options)).load_state_dict(state)


def test_what_does_not_fit_is_refused_before_allocating(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neuralq.checks, "available_bytes", lambda: 10**9)
    # 100,000 observations of 84·84·4 = 28,224 bytes, 112,500 rows: 3,175,200,000; and 32 bytes a step: 3,200,000.
    with pytest.raises(MemoryError, match=r"3,178,400,000 bytes .* 1,000,000,000 bytes .*memory_map="):
        ReplayBuffer(100_000, (84, 84, 4), np.uint8)
    with pytest.raises(MemoryError):
        ReplayBuffer(10**15, (4,), np.float32)
    monkeypatch.undo()
    with pytest.raises(MemoryError):
        ReplayBuffer(10**15, (4,), np.float32)


def test_available_memory_is_the_tightest_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neuralq.checks, "_machine", lambda: 100)
    monkeypatch.setattr(neuralq.checks, "_group_v2", lambda: 40)
    monkeypatch.setattr(neuralq.checks, "_group_v1", lambda: None)
    assert neuralq.checks.available_bytes() == 40


def test_a_memory_map_gives_the_same_samples_and_leaves_no_file(tmp_path: Path) -> None:
    (mapped, _), (plain, _) = (filled(40, 2, 20, 4, memory_map=m) for m in (tmp_path / "new", None))
    assert_same_state(mapped.state_dict(), plain.state_dict())
    left, right = (x.sample(32, np.random.default_rng(0)).transition for x in (mapped, plain))
    assert rows_of(left) == rows_of(right)
    assert list((tmp_path / "new").iterdir()) == []


def test_a_sample_lives_until_the_next_one_of_its_kind() -> None:
    buffer, _ = filled(40, 1, 20, 4)
    rng = np.random.default_rng(0)
    first = buffer.sample(8, rng).transition
    kept = first.map(torch.clone)
    buffer.sample_blocks(8, 1, rng)
    assert torch.equal(first.s_tm1, kept.s_tm1)
    second = buffer.sample(8, rng).transition
    assert second.s_tm1.data_ptr() == first.s_tm1.data_ptr()
    assert not torch.equal(first.s_tm1, kept.s_tm1)


def good() -> dict[str, Any]:
    return {
        "s_tm1": torch.zeros(2, 2),
        "a_tm1": torch.zeros(2, dtype=torch.int64),
        "mu_tm1": torch.ones(2),
        "r_t": torch.zeros(2),
        "discount_t": torch.ones(2),
        "s_t": torch.zeros(2, 2),
        "last_t": torch.zeros(2, dtype=torch.bool),
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"s_tm1": torch.zeros(2, 3)}, r"s_tm1 must have shape \(2, 2\), got \(2, 3\)"),
        ({"s_t": torch.zeros(2, 2, dtype=torch.float64)}, "s_t must be float32, got float64"),
        ({"a_tm1": torch.zeros(2)}, "a_tm1 must be int64, got float32"),
        ({"a_tm1": torch.zeros(3, dtype=torch.int64)}, "k = 2 environments, got"),
        ({"r_t": torch.zeros(2, 1)}, r"r_t must have shape \(2,\), got \(2, 1\)"),
        ({"r_t": torch.zeros(2, dtype=torch.int64)}, "r_t must be float32 or float64, got int64"),
        ({"last_t": torch.zeros(2)}, "last_t must be bool, got float32"),
        ({"env_indices": np.array([0, 2])}, r"env_indices must lie in \[0, 2\), got 0 to 2"),
        ({"env_indices": np.array([0.0, 1.0])}, "env_indices must be a row of int64"),
    ],
)
def test_wrong_steps_are_refused_and_not_stored(change: dict[str, Any], message: str) -> None:
    buffer = ReplayBuffer(10, (2,), np.float32, num_envs=2)
    values = good() | change
    env_indices = values.pop("env_indices", None)
    with pytest.raises(ValueError, match=message):
        buffer.add(Transition(**values), env_indices)
    assert len(buffer) == 0


def test_a_wrong_single_step_is_refused() -> None:
    buffer = ReplayBuffer(10, (2,), np.float32)
    s = np.zeros(2, np.float32)
    with pytest.raises(ValueError, match="s_t must be float32, got float64"):
        buffer.add_step(0, s, 0, 1.0, 0.0, 1.0, s.astype(np.float64), False)
    with pytest.raises(ValueError, match=r"s_tm1 must have shape \(1, 2\), got \(1, 3\)"):
        buffer.add_step(0, np.zeros(3, np.float32), 0, 1.0, 0.0, 1.0, s, False)
    with pytest.raises(ValueError, match="env_indices must lie"):
        buffer.add_step(1, s, 0, 1.0, 0.0, 1.0, s, False)
    assert len(buffer) == 0


def test_wrong_settings_and_calls_are_refused() -> None:
    rng = np.random.default_rng(0)
    for options in ({"capacity": 0}, {"num_envs": 0}, {"num_steps": 0}, {"observation_dtype": object}):
        arguments: dict[str, Any] = {"capacity": 9, "observation_shape": (2,), "observation_dtype": np.float32}
        with pytest.raises(ValueError, match="must be"):
            ReplayBuffer(**(arguments | options))
    uniform, by_priority = (ReplayBuffer(9, (2,), np.float32, prioritised=x) for x in (None, Prioritised()))
    with pytest.raises(ValueError, match="add steps first"):
        uniform.sample(1, rng)
    with pytest.raises(ValueError, match="empty replay buffer"):
        by_priority.sample(1, rng)
    with pytest.raises(ValueError, match="draws uniformly"):
        uniform.sample(1, rng, beta=0.5)
    with pytest.raises(ValueError, match="prioritised="):
        uniform.update_priorities(np.array([0]), np.array([1.0]))
    with pytest.raises(ValueError, match="holds no step"):
        by_priority.update_priorities(np.array([0]), np.array([1.0]))
    with pytest.raises(ValueError, match="not finite"):
        by_priority.update_priorities(np.array([0]), np.array([np.nan]))
    with pytest.raises(ValueError, match="alpha must lie"):
        Prioritised(alpha=1.5)
