"""A transition table is compared with what its environment does, wrappers and all, before it is believed.

Mutants that die here: states that are never set; the outcomes of a row that come as often as they like; a start that is
not looked at; an attribute ``s`` that is not the state taken for it; the environment itself stepped instead of a copy.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import (
    RecordEpisodeStatistics,
    StickyAction,
    TimeLimit,
    TransformAction,
    TransformObservation,
    TransformReward,
)

from neuralq.mdp import FiniteMDP


class Ring(gym.Env[Any, Any]):
    """A ring of 8 states: action 0 stays, 1 goes on with probability ``table`` as P says, ``truth`` as step does."""

    def __init__(self, table: float = 0.7, truth: float = 0.7, first: int = 0, haunted: int = -1) -> None:
        self.observation_space, self.action_space = spaces.Discrete(8), spaces.Discrete(2)
        self.truth, self.first, self.haunted = truth, first, haunted
        self.initial_state_distrib = np.eye(8)[0]
        self.P = {
            s: {
                0: [(1.0, s, 0.0, False)],
                1: [(table, (s + 1) % 8, 1.0, s == 7), (1 - table, s, 1.0, False)],
            }
            for s in range(8)
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.s = self.first
        return self.s, {}

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
        s, moves = self.s, bool(action) and self.np_random.random() < self.truth
        self.s = (s + 1) % 8 if moves else s
        if s == self.haunted and action == 0:
            return s, -1.0, False, False, {}
        return self.s, float(action), moves and s == 7, False, {}


class Hidden(Ring):
    """The state is elsewhere; ``s`` is a number of another kind."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        self.inner = Ring()
        found = self.inner.reset(seed=seed)
        self.s = 0
        return found

    def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
        return self.inner.step(action)


@pytest.mark.parametrize("name", ["FrozenLake-v1", "CliffWalking-v1"])
def test_environments_that_do_what_they_say_are_believed_and_left_alone(name: str) -> None:
    env = gym.make(name)
    env.reset(seed=3)
    state, generator = env.unwrapped.s, env.unwrapped.np_random.bit_generator.state  # type: ignore[attr-defined]
    assert FiniteMDP.from_gymnasium(env).num_rows > 0
    assert env.unwrapped.s == state and env.unwrapped.np_random.bit_generator.state == generator  # type: ignore[attr-defined]
    assert FiniteMDP.from_gymnasium(RecordEpisodeStatistics(TimeLimit(Ring(), 30))).num_rows == 16
    assert FiniteMDP.from_gymnasium(Hidden()).num_rows == 16


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (lambda: Ring(haunted=6), "in state 6 action 0 led to state 6 with reward -1, which the table does not have"),
        (lambda: Ring(truth=0.4), "where the table says"),
        (lambda: Ring(table=1.0), "which the table does not have"),
        (lambda: Ring(first=3), "episodes began in state 0, where its initial_state_distrib says"),
        (lambda: TransformReward(Ring(), lambda r: 2 * r), "with reward 2"),
        (lambda: TransformObservation(Ring(), lambda s: (s + 1) % 8, spaces.Discrete(8)), "does not do what its table"),
        (lambda: TransformObservation(Ring(), lambda s: s, spaces.Discrete(9)), "its observations are Discrete"),
        (lambda: TransformAction(Ring(), lambda a: 1 - a, spaces.Discrete(2)), "which the table does not have"),
        (lambda: StickyAction(Ring(), 0.25), "which the table does not have"),
    ],
)
def test_what_the_table_does_not_have_is_refused(env: Any, said: str) -> None:
    with pytest.raises(ValueError, match="does not do what its table says") as refused:
        FiniteMDP.from_gymnasium(env())
    assert said in str(refused.value) and "\n" not in str(refused.value)
    assert FiniteMDP.from_gymnasium(env(), check=False).num_rows == 16  # the way out works


def test_a_model_of_its_own_is_not_believed_behind_a_wrapper_that_changes_things() -> None:
    model = FiniteMDP.garnet(4, 2, 2, seed=0)
    assert FiniteMDP.from_gymnasium(TimeLimit(model.as_env(), 5)) is model
    wrapped = TransformReward(model.as_env(), lambda r: 2 * r)
    with pytest.raises(ValueError, match="the wrapper TransformReward may change what"):
        FiniteMDP.from_gymnasium(wrapped)
    assert FiniteMDP.from_gymnasium(wrapped, check=False) is model


def test_tables_that_do_not_fit_their_spaces_are_refused_in_a_line() -> None:
    ring = Ring()
    ring.observation_space = spaces.Discrete(9)
    with pytest.raises(ValueError, match=r"has no entry 8; it needs P\[s\]\[a\] for every state of 0\.\.8"):
        FiniteMDP.from_gymnasium(ring)
    ring.observation_space = spaces.Box(0, 1, (8,))  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"needs states and actions that are numbers"):
        FiniteMDP.from_gymnasium(ring)
    ring.observation_space = spaces.Discrete(8, start=1)
    with pytest.raises(ValueError, match=r"and not the numbers 0\.\.7 of the table"):
        FiniteMDP.from_gymnasium(ring)


def test_what_cannot_be_copied_is_said_to_be_unchecked() -> None:
    ring = Ring(haunted=6)
    ring.lock = (_ for _ in ())  # type: ignore[attr-defined]
    with pytest.warns(UserWarning, match=r"cannot be copied .TypeError., so its table was not compared"):
        assert FiniteMDP.from_gymnasium(ring).num_rows == 16
