"""A new environment is one file and one line of the table."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.envs import registration
from gymnasium.utils.env_checker import check_env

from neuralq.mdp import FiniteMDP
from neuralq_envs import ENVIRONMENTS, Registration, register

SWITCH = '''
from neuralq.mdp import FiniteMDP
from neuralq_envs.graphs import GraphScene
from neuralq_envs.rendering import factories


def mdp(reward: float = 1.0) -> FiniteMDP:
    """From off to on, which pays and ends the episode."""
    return FiniteMDP.from_functions(
        2, 1, lambda s: [0][s:], lambda s, a: [(0.5, 0, 0.0, False), (0.5, 1, reward, True)], start=[1.0, 0.0]
    )


make, make_vector = factories(mdp, lambda **_: GraphScene(("OFF", "ON"), ((0, 0), (0, 1)), ((0, 1),), (1,)))
'''


@pytest.fixture
def switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "switch_env.py").write_text(SWITCH)
    monkeypatch.syspath_prepend(tmp_path)
    env_id = "neuralq/Switch-v0"
    monkeypatch.setitem(ENVIRONMENTS, env_id, Registration("switch_env", {"reward": 3.0}))
    monkeypatch.setattr(registration, "registry", dict(registration.registry))
    register()
    return env_id


def test_one_file_and_one_line_make_an_environment_with_its_model_its_copies_and_its_picture(switch: str) -> None:
    check_env(gymnasium.make(switch).unwrapped)
    env = gymnasium.make(switch, render_mode="ansi")
    env.reset(seed=0)
    assert env.render() == "[OFF] ON\n"
    assert FiniteMDP.from_gymnasium(env).reward.tolist() == [1.5]
    assert FiniteMDP.from_gymnasium(gymnasium.make(switch, reward=8.0)).reward.tolist() == [4.0]
    envs = gymnasium.make_vec(switch, num_envs=5, vectorization_mode="vector_entry_point", reward=2.0)
    assert envs.reset(seed=0)[0].tolist() == [0] * 5
    s_t, reward, terminated, _, _ = envs.step(np.zeros(5, dtype=np.int64))
    assert (reward == 2.0 * terminated).all() and (s_t == terminated).all()


def test_what_a_problem_does_not_know_is_refused_by_name(switch: str) -> None:
    with pytest.raises(TypeError, match=r"unexpected keyword argument .colour"):
        gymnasium.make(switch, colour="red")


def test_every_registered_module_has_what_its_line_promises() -> None:
    for one in ENVIRONMENTS.values():
        module = __import__(one.module, fromlist=["make"])
        assert callable(module.make) and hasattr(module, "make_vector") == one.has_vector
