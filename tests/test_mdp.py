"""`FiniteMDP` and its simulators against hand-made models, frequencies and Gymnasium's own tables.

Mutants that die here: rows in (a, s) order instead of (s, a); R indexed [a, s]; terminated mass kept in the transition
matrix; duplicate successors overwritten instead of summed; the reward of a transition replaced by its row's mean;
garnet successors drawn with replacement; a draw searched in the neighbouring row; a mask taken before the move.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy import sparse

from neuralq.mdp import FiniteMDP, Outcomes

# Three states, two actions; action 1 is not legal in state 1, state 2 is terminal.
P = np.array(
    [
        [[0.5, 0.25, 0.25], [0.0, 0.6, 0.1], [0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)
R = np.array([[1.0, 2.0], [3.0, np.nan], [np.nan, np.nan]])


def small() -> FiniteMDP:
    return FiniteMDP.from_arrays(P, R, substochastic=True)


def test_arrays_give_one_row_per_legal_pair_in_state_order() -> None:
    mdp = small()
    assert list(zip(mdp.s_tm1, mdp.a_tm1, strict=True)) == [(0, 0), (0, 1), (1, 0)]
    assert mdp.reward.tolist() == [1.0, 2.0, 3.0]
    assert np.array_equal(mdp.transition.toarray(), [[0.5, 0.25, 0.25], [0, 1, 0], [0, 0.6, 0.1]])
    assert mdp.termination == pytest.approx([0, 0, 0.3])
    assert mdp.is_terminal.tolist() == [False, False, True]
    assert mdp.legal.tolist() == [[True, True], [True, False], [False, False]]
    assert mdp.row_index.tolist() == [[0, 1], [2, -1], [-1, -1]]
    assert mdp.row_starts.tolist() == [0, 2, 3, 3]
    assert mdp.start_distribution.tolist() == [0.5, 0.5, 0.0]
    assert isinstance(mdp.transition, sparse.csr_array)


def test_sparse_blocks_and_a_mask_say_the_same() -> None:
    blocks = [sparse.csr_array(p) for p in P]
    other = FiniteMDP.from_arrays(blocks, np.nan_to_num(R), legal=~np.isnan(R), substochastic=True)
    assert (other.transition != small().transition).nnz == 0
    assert np.array_equal(other.reward, small().reward)


def changed(**parts: object) -> dict[str, object]:
    mdp = small()
    fields = ("num_states", "num_actions", "s_tm1", "a_tm1", "transition", "reward", "discount", "start")
    return {name: getattr(mdp, name) for name in fields} | parts


def test_row_arrays_cannot_be_written_to() -> None:
    with pytest.raises(ValueError, match="read-only"):
        small().reward[0] = 5.0


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"s_tm1": [0, 0, 3]}, r"row 2: state 3 is not in 0\.\.2"),
        ({"a_tm1": [0, -1, 0]}, r"row 1: action -1 is not in 0\.\.1"),
        ({"s_tm1": [0, 1, 0]}, r"row 2 \(s=0, a=0\) must come after row 1 \(s=1, a=1\)"),
        ({"s_tm1": [0, 0, 0], "a_tm1": [0, 1, 1]}, r"row 2 \(s=0, a=1\) must come after"),
        ({"reward": [1.0, np.inf, 0.0]}, r"row 1 \(s=0, a=1\): reward must be finite, got inf"),
        ({"reward": [1.0, 2.0]}, r"reward must have shape \(3,\).*got \(2,\)"),
        ({"discount": [1.0, 1.0, 1.5]}, r"row 2 \(s=1, a=0\): discount must lie in \[0, 1\], got 1\.5"),
        ({"discount": [1.0, np.nan, 1.0]}, r"row 1 .*discount .* got nan"),
        ({"transition": [[1, 0, 0], [0, 0.75, 0.75], [0, 1, 0]]}, r"row 1 \(s=0, a=1\): probabilities sum to 1\.5"),
        ({"transition": [[1, 0, 0], [0, 1, 0], [0, -0.5, 1]]}, r"row 2 \(s=1, a=0\): P\(s_t=1\).*got -0\.5"),
        ({"transition": [[np.nan, 0, 0], [0, 1, 0], [0, 1, 0]]}, r"row 0 .*P\(s_t=0\).*got nan"),
        ({"transition": np.eye(3)[:2]}, r"transition must have shape \(3, 3\), got \(2, 3\)"),
        ({"start": [0.5, 0.4, 0.0]}, r"start must sum to 1, got 0\.9"),
        ({"start": [1.5, -0.5, 0.0]}, r"start\[1\] must be a probability, got -0\.5"),
        ({"start": [0.5, 0.0, 0.5]}, r"start puts probability 0\.5 on state 2, which has no action"),
        ({"state_names": ["x"]}, r"state_names must hold 3 names, got 1"),
        ({"num_states": 0}, r"num_states must be a whole number of at least 1, got 0"),
    ],
)
def test_a_broken_model_is_refused_by_row_and_value(parts: dict[str, object], message: str) -> None:
    arguments = changed(**parts)
    if "transition" in parts:
        arguments["transition"] = sparse.csr_array(np.array(parts["transition"], dtype=float))
    with pytest.raises(ValueError, match=message):
        FiniteMDP(**arguments)  # type: ignore[arg-type]


def test_other_sources_refuse_by_row_and_value_too() -> None:
    with pytest.raises(ValueError, match=r"got R of shape \(2, 3\)"):
        FiniteMDP.from_arrays(P, np.zeros((2, 3)))
    with pytest.raises(
        ValueError, match=r"row 2 \(s=1, a=0\): probabilities sum to 0\.7, less than 1; .*substochastic"
    ):
        FiniteMDP.from_arrays(P, R)
    with pytest.raises(
        ValueError, match=r"row 0 \(s=0, a=0\): probabilities sum to 0\.25, less than 1; .*substochastic"
    ):
        FiniteMDP.from_functions(1, 1, lambda s: [0], lambda s, a: [(0.25, 0, 0.0, True)])
    with pytest.raises(ValueError, match="every state is terminal"):
        FiniteMDP.from_arrays(P, np.full((3, 2), np.nan))
    for outcome, message in [
        ((0.5, 7, 0.0, False), r"row 1 \(s=1, a=0\): 7 is not a valid state of 0\.\.1"),
        ((-0.5, 0, 0.0, False), r"row 1 \(s=1, a=0\): -0\.5 is not a valid probability"),
        ((0.5, 0, np.nan, False), r"row 1 \(s=1, a=0\): nan is not a valid reward"),
        ((0.75, 0, 0.0, True), r"row 1 \(s=1, a=0\): probabilities sum to 1\.5"),
    ]:
        rows = {0: [(1.0, 0, 0.0, False)], 1: [outcome, outcome]}
        with pytest.raises(ValueError, match=message):
            FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a, rows=rows: rows[s])
    with pytest.raises(ValueError, match=r"has no transition table"):
        FiniteMDP.from_gymnasium(gymnasium.make("CartPole-v1"))


def test_a_long_build_tells_how_far_it_is() -> None:
    told: list[tuple[int, int]] = []
    FiniteMDP.from_functions(
        250,
        1,
        lambda s: [0],
        lambda s, a: [(1.0, s, 0.0, False)],
        progress=lambda built, total: told.append((built, total)),
    )
    assert told[0] == (3, 250) and told[-1] == (250, 250) and len(told) == 84


def test_indices_take_half_the_memory_where_they_can() -> None:
    mdp = FiniteMDP.garnet(5, 2, 2, seed=0)
    assert mdp.transition.indices.dtype == mdp.transition.indptr.dtype == np.int32


def test_functions_sum_duplicates_and_drop_terminated_mass() -> None:
    rows = [(0.25, 1, 4.0, False), (0.25, 1, 0.0, False), (0.25, 0, -8.0, False), (0.25, 1, 2.0, True)]
    mdp = FiniteMDP.from_functions(2, 1, lambda s: [0] if s == 0 else [], lambda s, a: rows)
    assert mdp.transition.toarray().tolist() == [[0.25, 0.5]]
    assert mdp.reward.tolist() == [-0.5]  # (4 + 0 − 8 + 2) / 4
    assert mdp.termination.tolist() == [0.25]


def newest(name: str) -> str:
    """The newest version that the installed Gymnasium has; it warns about, or refuses, the others."""
    return max(env_id for env_id in gymnasium.registry if env_id.startswith(f"{name}-v"))


@pytest.mark.parametrize("name", ["FrozenLake", "Taxi", "CliffWalking"])
def test_gymnasium_tables_are_carried_over(name: str) -> None:
    env = gymnasium.make(newest(name)).unwrapped
    mdp = FiniteMDP.from_gymnasium(env)
    table, num_states = env.P, env.observation_space.n  # type: ignore[attr-defined]
    assert mdp.num_rows == num_states * env.action_space.n  # type: ignore[attr-defined]
    for row in range(0, mdp.num_rows, 7):
        expected, reward = np.zeros(num_states), 0.0
        for p, s_t, r_t, terminated in table[mdp.s_tm1[row]][mdp.a_tm1[row]]:
            expected[s_t] += 0.0 if terminated else p
            reward += p * r_t
        assert mdp.transition[[row]].toarray()[0] == pytest.approx(expected)
        assert mdp.reward[row] == pytest.approx(reward)
    assert mdp.start_distribution == pytest.approx(env.initial_state_distrib)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("num_states", "branching"), [(7, 1), (7, 3), (7, 7), (1, 1), (1000, 2)])
def test_garnet_rows_are_distributions_over_distinct_states(num_states: int, branching: int) -> None:
    mdp = FiniteMDP.garnet(num_states, 2, branching, seed=3)
    assert mdp.num_rows == 2 * num_states
    assert np.all(np.diff(mdp.transition.indptr) == branching)
    assert all(len(set(row)) == branching for row in mdp.transition.indices.reshape(-1, branching).tolist())
    assert mdp.row_mass == pytest.approx(np.ones(2 * num_states))
    again = FiniteMDP.garnet(num_states, 2, branching, seed=3)
    assert np.array_equal(again.reward, mdp.reward) and (again.transition != mdp.transition).nnz == 0
    assert not np.array_equal(FiniteMDP.garnet(num_states, 2, branching, seed=4).reward, mdp.reward)


def test_garnet_chooses_every_successor_equally_often() -> None:
    mdp = FiniteMDP.garnet(5, 4000, 2, seed=0)  # 20,000 rows of 2 out of 5
    counts = np.bincount(mdp.transition.indices, minlength=5)
    assert np.abs(counts - 8000).max() < 4 * np.sqrt(20_000 * 0.4 * 0.6)
    with pytest.raises(ValueError, match="branching must be at most num_states=3, got 4"):
        FiniteMDP.garnet(3, 1, 4, seed=0)


# Ends with probability .2 on the way to state 1, .1 in place; pays differently on the way.
OUTCOMES = {
    0: [(0.3, 0, 1.0, False), (0.4, 1, 5.0, False), (0.2, 1, -7.0, True)],
    1: [(1.0, 0, 2.0, False)],
}


def test_simulated_frequencies_and_rewards_are_the_models_own() -> None:
    mdp = FiniteMDP.from_functions(
        3, 1, lambda s: [0] if s < 2 else [], lambda s, a: OUTCOMES[s], substochastic=True, start=[0.5, 0.5, 0]
    )
    num = 40_000
    envs = mdp.as_vector_env(num)
    s_tm1, _ = envs.reset(seed=5)
    assert abs((s_tm1 == 1).mean() - 0.5) < 4 * np.sqrt(0.25 / num)
    s_t, r_t, terminated, truncated, _ = envs.step(np.zeros(num, dtype=np.int64))
    assert not truncated.any()
    second = s_tm1 == 1
    seen = set(zip(s_t[second].tolist(), r_t[second].tolist(), terminated[second].tolist(), strict=True))
    assert seen == {(0, 2.0, False)}
    left = s_tm1 == 0
    expected = {(0, 1.0, False): 0.3, (1, 5.0, False): 0.4, (1, -7.0, True): 0.2, (0, 0.0, True): 0.1}
    for (s, r, e), p in expected.items():
        share = ((s_t == s) & (r_t == r) & (terminated == e))[left].mean()
        assert abs(share - p) < 4 * np.sqrt(p * (1 - p) / left.sum()), (s, r, e)


def test_simulation_without_outcomes_follows_the_matrix() -> None:
    mdp = FiniteMDP.from_arrays(P, R, substochastic=True, start=[0.0, 1.0, 0.0])
    num = 20_000
    envs = mdp.as_vector_env(num)
    envs.reset(seed=0)
    s_t, r_t, terminated, _, extra = envs.step(np.zeros(num, dtype=np.int64))
    assert set(r_t) == {3.0}
    for s, e, p in [(1, False, 0.6), (2, True, 0.1), (1, True, 0.3)]:  # entering 2 ends; so does the missing mass
        share = ((s_t == s) & (terminated == e)).mean()
        assert abs(share - p) < 4 * np.sqrt(p * (1 - p) / num)
    assert np.array_equal(extra["action_mask"], mdp.legal.astype(np.int8)[s_t])
    assert extra["action_mask"].dtype == np.int8


def test_a_discount_is_simulated_as_the_chance_to_go_on() -> None:
    mdp = FiniteMDP(1, 2, [0, 0], [0, 1], sparse.csr_array(np.ones((2, 1))), [1.0, 1.0], [0.25, 0.0])  # type: ignore[arg-type]
    envs = mdp.as_vector_env(10_000)
    envs.reset(seed=0)
    assert abs(envs.step(np.zeros(10_000, dtype=int))[2].mean() - 0.75) < 4 * np.sqrt(0.1875 / 10_000)
    envs.reset()
    assert envs.step(np.ones(10_000, dtype=int))[2].all()


def test_the_sampler_never_leaves_its_row() -> None:
    # Probabilities that sum to 1 only up to rounding, in many rows: the last of a row must not leak into the next.
    mdp = FiniteMDP.garnet(50, 3, 10, seed=1)
    envs = mdp.as_vector_env(50_000)
    s_tm1, _ = envs.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(3):
        actions = rng.integers(0, 3, 50_000)
        s_t, r_t, terminated, _, _ = envs.step(actions)
        row = mdp.row_index[s_tm1, actions]
        assert np.all(np.asarray(mdp.transition.toarray()[row, s_t]) > 0)
        assert np.array_equal(r_t, mdp.reward[row]) and not terminated.any()
        s_tm1 = s_t


def test_single_environment_passes_the_checker_and_repeats_itself() -> None:
    env = FiniteMDP.garnet(6, 3, 2, seed=0).as_env()
    check_env(env, skip_render_check=True)
    runs = []
    for _ in range(2):
        s, _ = env.reset(seed=11)
        runs.append([s, *(env.step(k % 3)[:2] for k in range(30))])
    assert runs[0] == runs[1]


def test_illegal_actions_stay_with_reward_zero_and_the_mask_tells() -> None:
    mdp = FiniteMDP.from_arrays(P, R, substochastic=True, start=[0.0, 1.0, 0.0])
    env = mdp.as_env()
    s, extra = env.reset(seed=0)
    assert s == 1 and extra["action_mask"].tolist() == [1, 0]
    assert env.step(1)[:4] == (1, 0.0, False, False)
    envs = mdp.as_vector_env(4)
    envs.reset(seed=0)
    s_t, r_t, terminated, _, _ = envs.step(np.ones(4, dtype=int))
    assert s_t.tolist() == [1] * 4 and r_t.tolist() == [0.0] * 4 and not terminated.any()


def test_ended_episodes_must_be_reset() -> None:
    env = FiniteMDP.from_arrays([[[0.0]]], [[1.0]], substochastic=True).as_env()
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    assert env.step(0)[2]
    with pytest.raises(ResetNeeded):
        env.step(0)
    env.reset()
    with pytest.raises(ValueError, match=r"action must be in 0\.\.0, got 1"):
        env.step(1)


def test_vector_environment_resets_what_the_mask_names() -> None:
    mdp = FiniteMDP.from_arrays(P, R, substochastic=True)
    envs = mdp.as_vector_env(64, max_episode_steps=3)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert envs.observation_space.shape == envs.action_space.shape == (64,)
    s, _ = envs.reset(seed=0)
    kept = s.copy()
    over = np.zeros(64, dtype=bool)
    lengths = np.zeros(64, dtype=int)
    for _ in range(20):
        if over.any():
            with pytest.raises(ResetNeeded, match=f"environment {np.argmax(over)} must be reset"):
                envs.step(np.zeros(64, dtype=int))
            before = s.copy()
            s, extra = envs.reset(options={"reset_mask": over})
            assert np.array_equal(s[~over], before[~over])
            assert not mdp.is_terminal[s].any() and extra["action_mask"].any(axis=1).all()
            lengths[over] = 0
        s, _, terminated, truncated, _ = envs.step(np.zeros(64, dtype=int))
        lengths += 1
        assert np.array_equal(truncated, (lengths == 3) & ~terminated)
        over = terminated | truncated
    assert np.array_equal(kept, envs.reset(seed=0)[0])  # the seed decides, and returned arrays are not written to
    with pytest.raises(ValueError, match="reset_mask must be bool"):
        envs.reset(options={"reset_mask": np.ones(64)})
    with pytest.raises(ValueError, match="actions must be 64 numbers"):
        envs.step(np.full(64, 2))


def test_outcomes_of_another_length_are_refused() -> None:
    one = Outcomes(np.array([0, 1]), np.ones(1), np.zeros(1, dtype=int), np.zeros(1), np.zeros(1, dtype=bool))
    with pytest.raises(ValueError, match="outcomes must describe 3 rows, got 1"):
        FiniteMDP(**changed(outcomes=one))  # type: ignore[arg-type]
