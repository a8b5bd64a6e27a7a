"""The registered environments: Gymnasium's checker, the exact models, pictures, vector entry points.

Mutants that die here: G placed at the bottom right; reward for leaving instead of entering G; south and north swapped;
episodes that may start in G; a grid that is not seeded; one picture for two states; noise drawn from a generator that
the seed does not reach; a start that is asked for and ignored.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import neuralq_envs
from neuralq.mdp import FiniteMDP
from neuralq.runs.folder.env_probe import is_resumable
from neuralq_envs import mitchell
from neuralq_envs.counterexamples import star
from neuralq_envs.counterexamples.baird import make as make_star

neuralq_envs.register()

N, E, S, W = range(4)
# Figure 13.2: cell, action -> cell; 0 1 G / 3 4 5.
ARROWS = {
    (0, E): 1, (0, S): 3, (1, E): 2, (1, S): 4, (1, W): 0, (3, N): 0, (3, E): 4,
    (4, N): 1, (4, E): 5, (4, W): 3, (5, N): 2, (5, W): 4,
}  # fmt: skip


@pytest.mark.parametrize("env_id", sorted(neuralq_envs.ENVIRONMENTS))
def test_every_environment_passes_the_checker(env_id: str) -> None:
    check_env(gymnasium.make(env_id).unwrapped)  # warnings are errors


@pytest.mark.parametrize("env_id", sorted(i for i, one in neuralq_envs.ENVIRONMENTS.items() if one.has_vector))
def test_every_environment_that_is_one_model_has_a_vector_entry_point(env_id: str) -> None:
    envs = gymnasium.make_vec(env_id, num_envs=5, vectorization_mode="vector_entry_point")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    s, extra = envs.reset(seed=0)
    assert s.shape == (5,) and extra["action_mask"].shape[0] == 5
    assert envs.single_observation_space == gymnasium.make(env_id).observation_space


def test_a_world_that_changes_is_still_vectorised_copy_by_copy() -> None:
    envs = gymnasium.make_vec("neuralq/BlockingMaze-v0", num_envs=2, vectorization_mode="sync")
    assert envs.reset(seed=0)[0].tolist() == [48, 48]
    envs.close()


@pytest.mark.parametrize("env_id", sorted(set(neuralq_envs.ENVIRONMENTS) - {"neuralq/BairdStar-v0"}))
def test_every_environment_is_drawn_in_both_modes(env_id: str) -> None:
    with pytest.raises(ValueError, match="render_mode must be one of"):
        gymnasium.make(env_id, render_mode="human")
    for mode in ("ansi", "rgb_array"):
        env, rng, seen = gymnasium.make(env_id, render_mode=mode).unwrapped, np.random.default_rng(0), {}
        shape = np.shape(env.render())  # before the first reset: the empty scene
        for episode in range(4):
            s, extra = env.reset(seed=episode)
            terminated = False
            for _ in range(20):
                picture = env.render()
                assert np.shape(picture) == shape and (isinstance(picture, str) or picture.dtype == np.uint8)
                seen.setdefault(s, set()).add(picture if isinstance(picture, str) else picture.tobytes())
                if terminated:
                    break
                s, _, terminated, _, extra = env.step(int(rng.choice(np.flatnonzero(extra["action_mask"]))))
        pictures = [picture for of_state in seen.values() for picture in of_state]
        assert len(seen) >= 3 and len(set(pictures)) == len(pictures) == len(seen)  # one picture each, all different
    assert gymnasium.make(env_id).unwrapped.render() is None


@pytest.mark.parametrize("env_id", sorted(neuralq_envs.ENVIRONMENTS))
def test_what_happens_is_what_the_model_allows_with_its_frequencies(env_id: str) -> None:
    env, rng = gymnasium.make(env_id).unwrapped, np.random.default_rng(1)
    model = FiniteMDP.from_gymnasium(env)
    assert model.num_states == env.observation_space.n and model.num_actions == env.action_space.n
    legal, count, s_t_count = model.legal, Counter[int](), Counter[tuple[int, int]]()
    s, extra = env.reset(seed=1)
    for _ in range(600):
        assert extra["action_mask"].tolist() == legal[s].tolist()
        a = int(rng.choice(np.flatnonzero(extra["action_mask"])))
        row = int(model.row_index[s, a])
        s_t, reward, terminated, truncated, extra = env.step(a)
        deterministic = model.transition[[row]].max() == 1 or model.termination[row] == 1
        if deterministic and env_id not in ("neuralq/MaximizationBias-v0", "neuralq/TicTacToe-v0"):
            assert reward == model.reward[row] and terminated == (model.termination[row] == 1)
        assert not truncated
        count[row] += 1
        s_t_count[row, s_t] += not terminated
        s, extra = env.reset() if terminated else (s_t, extra)
        assert not terminated or model.start_distribution[s] > 0
    for row, num in count.items():
        expected = num * model.transition[[row]].toarray()[0]
        found = np.array([s_t_count[row, s_t] for s_t in range(model.num_states)])
        assert (found[expected == 0] == 0).all()
        # Four standard deviations of a binomial count, and a little for the smallest counts.
        assert (np.abs(found - expected) <= 4 * np.sqrt(np.maximum(expected, 0.25)) + 1).all()


@pytest.mark.parametrize("mode", ["single", "vector"])
@pytest.mark.parametrize("env_id", ["MaximizationBias", "BlockingMaze", "TicTacToe", "RandomWalk"])
def test_a_run_can_be_resumed_in_them(env_id: str, mode: str) -> None:
    if mode == "single":
        found = is_resumable(lambda: gymnasium.make(f"neuralq/{env_id}-v0"), 0, np.random.default_rng(0))
    elif env_id == "BlockingMaze":
        return
    else:
        found = is_resumable(lambda: _vector(f"neuralq/{env_id}-v0"), 0, np.random.default_rng(0))
    assert found.exact, found


def _vector(env_id: str) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(env_id, num_envs=3, vectorization_mode="vector_entry_point")


def test_importing_the_environments_first_is_as_good() -> None:
    # Gymnasium registers them when it is imported, which then happens in the middle of their own import.
    program = "import neuralq_envs.cliff, gymnasium; gymnasium.make('neuralq/CliffWalking-v0')"
    subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", program], check=True, timeout=60)


def test_an_episode_starts_in_the_state_that_is_asked_for() -> None:
    env = gymnasium.make("neuralq/ExerciseGrid-v0")
    assert env.reset(options={"state": 3})[0] == 3 and env.step(N)[0] == 0
    for wrong in (4, 6, -1):  # G, where nothing can be done, and two that are no cells
        with pytest.raises(ValueError, match="must be a state"):
            env.reset(options={"state": wrong})


def test_the_grid_has_the_arrows_of_the_figure() -> None:
    model = mitchell.mdp()
    found = dict(zip(zip(model.s_tm1.tolist(), model.a_tm1.tolist(), strict=True), model.reward, strict=True))
    assert found == {pair: 100.0 if s_t == 2 else 0.0 for pair, s_t in ARROWS.items()}
    for row in range(model.num_rows):
        s_t = ARROWS[int(model.s_tm1[row]), int(model.a_tm1[row])]
        assert model.transition[[row]].toarray()[0].tolist() == [float(s == s_t and s != 2) for s in range(6)]
        assert model.termination[row] == (s_t == 2)
    assert model.start_distribution.tolist() == [0.2, 0.2, 0.0, 0.2, 0.2, 0.2]


def test_the_environment_moves_as_its_model_says() -> None:
    env = gymnasium.make("neuralq/MitchellGrid-v0")
    assert isinstance(FiniteMDP.from_gymnasium(env), FiniteMDP)
    rng = np.random.default_rng(0)
    starts = set()
    for episode in range(60):
        s, extra = env.reset(seed=episode)
        starts.add(s)
        for _ in range(200):
            a = int(rng.integers(4))
            legal = [(s, b) in ARROWS for b in range(4)]
            assert extra["action_mask"].tolist() == [int(x) for x in legal]
            s_t, r, terminated, truncated, extra = env.step(a)
            assert s_t == ARROWS.get((s, a), s) and r == (100.0 if terminated else 0.0)
            assert terminated == (s_t == 2) and not truncated
            s = s_t
            if terminated:
                assert extra["action_mask"].tolist() == [0, 0, 0, 0]
                break
    assert starts == {0, 1, 3, 4, 5}
    assert env.reset(seed=7)[0] == env.reset(seed=7)[0]


def test_the_grid_is_drawn_as_text_and_as_pixels() -> None:
    text = gymnasium.make("neuralq/MitchellGrid-v0", render_mode="ansi")
    cell, _ = text.reset(seed=1)
    drawn = text.render()
    assert isinstance(drawn, str) and drawn.replace("\n", " ").split()[cell] == "A" and drawn.split()[2] == "G"
    picture = gymnasium.make("neuralq/MitchellGrid-v0", render_mode="rgb_array")
    cell, _ = picture.reset(seed=1)
    pixels = picture.render()
    assert isinstance(pixels, np.ndarray) and pixels.shape == (96, 144, 3) and pixels.dtype == np.uint8
    blue = np.argwhere(pixels[..., 2].astype(int) - pixels[..., 0] > 100).mean(axis=0)
    assert (blue // 48).tolist() == [cell // 3, cell % 3]
    with pytest.raises(ValueError, match="render_mode must be one of"):
        mitchell.make(render_mode="human")


def test_the_star_is_the_books() -> None:
    problem = star()
    assert (problem.features @ problem.initial_weights).tolist() == [3.0] * 6 + [12.0]
    assert problem.importance_ratio == pytest.approx(np.tile([0.0, 7.0], (7, 1)))
    dense = problem.mdp.transition.toarray()
    assert dense.sum(axis=1) == pytest.approx(np.ones(14))  # it never ends
    assert dense[0] == pytest.approx([1 / 6] * 6 + [0]) and dense[1].tolist() == [0.0] * 6 + [1.0]
    assert star(3).features.tolist() == [[2, 0, 0, 0, 1], [0, 2, 0, 0, 1], [0, 0, 2, 0, 1], [0, 0, 0, 1, 2]]
    with pytest.raises(ValueError, match="num_upper"):
        star(0)
    with pytest.raises(ValueError, match="render_mode must be None"):
        make_star(render_mode="ansi")


def test_registering_twice_changes_nothing() -> None:
    before = gymnasium.spec("neuralq/MitchellGrid-v0")
    neuralq_envs.register()
    assert gymnasium.spec("neuralq/MitchellGrid-v0") is before
