"""What a number means is decided by the bounds of its space, whatever its dtype and wherever it stands."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.runs import RunConfig
from neuralq.runs.recipe.build import build_q
from neuralq.runs.recipe.opening import opening_lines
from neuralq.runs.stream import Interaction, Normalisation, make_vector_env
from neuralq.runs.stream.encoding import encoder_for
from neuralq.runs.stream.scaling import scaling_of
from neuralq.types import Array

BITS = np.random.default_rng(0).integers(0, 2, (6, 6, 2))


class Still(gym.Env[Any, Any]):
    """Shows one observation for ever."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: gym.Space[Any], observation: Any) -> None:
        self.observation_space, self.observation = space, observation

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation, 0.0, False, False, {}


def stream_of(space: gym.Space[Any], observation: Any, normalisation: Normalisation | None = None) -> Interaction:
    return Interaction(make_vector_env(lambda: Still(space, observation), 1), 0.9, 0, normalisation=normalisation)


def seen_by_a_linear_function(space: gym.Space[Any], observation: Any) -> Array:
    """What the weights of a linear function are multiplied by."""
    stream = stream_of(space, observation)
    q: Any = build_q(RunConfig(layout="linear"), stream.spec, np.random.default_rng(0))
    s = torch.from_numpy(stream.state_dict()["s"])
    return (s if q.features is None else q.features(s)).numpy().astype(np.float64).ravel()


def boxes(dtype: Any, high: int) -> list[tuple[gym.Space[Any], Any]]:
    """Bits as a picture, in a row, and inside a Dict with a state beside them."""
    box, x = spaces.Box(0, high, BITS.shape, dtype), (BITS * high).astype(dtype)
    row = spaces.Box(0, high, (BITS.size,), dtype)
    return [(box, x), (row, x.ravel()), (spaces.Dict(a=box, z=spaces.Discrete(2)), {"a": x, "z": 0})]


@pytest.mark.parametrize("high", [1, 255])
@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.int8, np.int64, np.float32, np.float64])
def test_the_same_facts_are_the_same_numbers_in_every_dtype_and_every_place(dtype: Any, high: int) -> None:
    if np.dtype(dtype) in (np.bool_, np.int8):
        high = min(high, np.iinfo(dtype).max if dtype is np.int8 else 1)
    for space, observation in boxes(dtype, high):
        np.testing.assert_array_equal(seen_by_a_linear_function(space, observation)[: BITS.size], BITS.ravel())


def test_bytes_in_a_row_have_the_bits_of_bytes_in_a_picture() -> None:
    every = np.arange(256, dtype=np.uint8)
    picture = seen_by_a_linear_function(spaces.Box(0, 255, (16, 16, 1), np.uint8), every.reshape(16, 16, 1))
    row = seen_by_a_linear_function(spaces.Box(0, 255, (256,), np.uint8), every)
    floats = seen_by_a_linear_function(spaces.Box(0, 255, (256,), np.float32), every.astype(np.float32))
    brightness = (every.astype(np.float32) / np.float32(255)).astype(np.float64)
    for found in (picture, row, floats):
        np.testing.assert_array_equal(found, brightness)


@pytest.mark.parametrize(
    ("low", "high", "dtype", "x", "wanted"),
    [
        (-128, 127, np.int8, -64, -0.5),  # 0 stays 0 where it is allowed: over the larger of 128 and 127
        (100, 110, np.int16, 105, 0.5),  # where it is not, the bound that is nearer to 0 becomes 0
        (-110, -100, np.float64, -110.0, -1.0),
        (1e9, 1e9 + 100, np.float64, 1e9 + 1, 0.01),  # subtracted before float32, where 1e9 + 1 is 1e9
        (-32, 32, np.float32, 31.0, 31.0),  # what is small is left as it is: CartPole, Acrobot, LunarLander
        (0, 15, np.uint8, 7, 7.0),
        (-np.inf, np.inf, np.float32, 1000.0, 1000.0),
        (0, np.inf, np.float32, 1000.0, 1000.0),
        (-np.finfo(np.float32).max, np.finfo(np.float32).max, np.float32, 5.0, 5.0),  # no bound at all
        (0, np.iinfo(np.int32).max, np.int32, 5, 5.0),
        (np.iinfo(np.int64).min, np.iinfo(np.int64).max, np.int64, 5, 5.0),
        (200, 200, np.float32, 200.0, 200.0),
    ],
)  # fmt: skip
def test_finite_bounds_beyond_32_become_one(low: float, high: float, dtype: Any, x: float, wanted: float) -> None:
    encoder = encoder_for(spaces.Box(low, high, (2,), dtype))  # type: ignore[arg-type]
    np.testing.assert_allclose(encoder.encode(np.full((1, 2), x, dtype)), wanted, rtol=1e-6)


def test_every_entry_has_its_own_bounds() -> None:
    space = spaces.Box(np.array([0, -np.inf, 0], np.float32), np.array([255, 1, 1], np.float32))
    assert encoder_for(space).encode(np.array([[51, 40, 1]], np.float32))[0].tolist() == pytest.approx([0.2, 40, 1])
    full = np.array([255, 1], np.uint8) + np.zeros((4, 4, 2), np.uint8)
    seen = seen_by_a_linear_function(spaces.Box(np.zeros_like(full), full, dtype=np.uint8), full)
    assert seen.tolist() == [1.0] * 32
    assert scaling_of(spaces.Box(0, 255, (0,), np.float32)) is None, "nothing to scale"


@pytest.mark.parametrize(
    ("space", "observation", "wanted"),
    [
        (spaces.Box(0, 1, (6, 6, 2), np.uint8), BITS.astype(np.uint8), "6 × 6 × 2 bytes as they come"),
        (spaces.Box(0, 255, (9,)), np.ones(9, np.float32), "9 numbers, all over 255, the bound of its space"),
        (
            spaces.Dict(a=spaces.Box(100, 300, (2,)), b=spaces.Discrete(3)), {"a": np.full(2, 100, np.float32), "b": 0},
            "5 numbers, ['a'] over 200, the bound of its space after 100 is subtracted",
        ),
        (spaces.Discrete(7), 0, "one of 7 states"),
    ],
)  # fmt: skip
def test_a_run_says_how_it_sees_its_observations(space: gym.Space[Any], observation: Any, wanted: str) -> None:
    assert opening_lines(stream_of(space, observation)) == [f"observations: {wanted}"]


def test_what_is_normalised_is_not_scaled_as_well() -> None:
    space, seen = spaces.Box(0, 255, (1,), np.float32), Normalisation((1,), 0.9, 1)
    stream = stream_of(space, np.ones(1, np.float32), seen)
    assert opening_lines(stream) == ["observations: 1 numbers over their mean and spread so far"]
    assert seen.state_dict()["observation_mean"].tolist() == [1.0]


@pytest.mark.parametrize("saved", [None, {"observation": [[0.0], [255.0]]}])
def test_a_run_that_learned_from_numbers_of_another_scale_is_refused(saved: Any) -> None:
    planes = stream_of(spaces.Box(0, 1, (6, 6, 2), np.uint8), BITS.astype(np.uint8))
    state = planes.state_dict()
    planes.load_state_dict(state)
    with pytest.raises(ValueError, match=r"scaled otherwise.*train it anew"):  # as a version did that knew bytes only
        planes.load_state_dict({**state, "scalings": saved})
    pictures = stream_of(spaces.Box(0, 255, (6, 6, 2), np.uint8), BITS.astype(np.uint8))
    pictures.load_state_dict({**pictures.state_dict(), "scalings": saved})
