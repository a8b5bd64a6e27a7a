"""The registered environments: Gymnasium's checker, the exact models, pictures, vector entry points.

Mutants that die here: G placed at the bottom right; reward for leaving instead of entering G; south and north swapped;
episodes that may start in G; a grid that is not seeded.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import neuralq_envs
from neuralq.mdp import FiniteMDP
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


@pytest.mark.parametrize("env_id", sorted(neuralq_envs.ENVIRONMENTS))
def test_every_environment_has_a_vector_entry_point(env_id: str) -> None:
    envs = gymnasium.make_vec(env_id, num_envs=5, vectorization_mode="vector_entry_point")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    s, extra = envs.reset(seed=0)
    assert s.shape == (5,) and extra["action_mask"].shape[0] == 5
    assert envs.single_observation_space == gymnasium.make(env_id).observation_space


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
