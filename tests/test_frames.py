"""Frames are stored as they come and convolved with their channels where they are; the games of the extras are played.

Mutants that must die here: channels first taken for last, and the other way round · a frame of one channel refused ·
bytes not divided by 255, or flags divided · a frame stored as floats · the last layer started like the hidden ones ·
the streaming kernels fed frames in the order in which they are stored.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuralq.learners.replay.buffer import ReplayBuffer
from neuralq.q import MLP, NAMED_BODIES, ActionOutputQ, Conv, SeparateQ, body_for
from neuralq.q.engine import Loss, TorchEngine
from neuralq.q.frames import channels_first
from neuralq.q.single_row import SingleRowNetwork
from neuralq.runs import RunConfig, train, with_preset
from neuralq.runs.recipe.build import build_q, build_session
from neuralq.runs.recipe.config import config_from_dict
from neuralq.runs.recipe.environments import make_envs
from neuralq.runs.recipe.games import make_single
from neuralq.runs.stream import Interaction, make_vector_env
from neuralq.runs.stream.encoding import encoder_for


@pytest.mark.parametrize(
    ("shape", "order", "wanted"),
    [
        ((84, 84, 3), "auto", (3, 84, 84)), ((4, 84, 84), "auto", (4, 84, 84)), ((10, 10, 7), "auto", (7, 10, 10)),
        ((210, 160, 3), "auto", (3, 210, 160)), ((3, 210, 160), "auto", (3, 210, 160)), ((84, 84), "auto", (1, 84, 84)),
        ((10, 10, 10), "last", (10, 10, 10)), ((6, 5, 4), "first", (6, 5, 4)), ((4, 5, 6), "last", (6, 4, 5)),
    ],
)  # fmt: skip
def test_channels_are_found_or_given(shape: tuple[int, ...], order: str, wanted: tuple[int, ...]) -> None:
    assert channels_first(shape, order) == wanted


@pytest.mark.parametrize("shape", [(10, 10, 10), (5, 7, 5)])
def test_an_order_that_cannot_be_seen_is_asked_for(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="give the Conv body channel_order='first' or 'last'"):
        ActionOutputQ(shape, 2, Conv())
    with pytest.raises(ValueError, match="use an MLP body, or make it one of these"):
        channels_first((2, 4, *shape))


@pytest.mark.parametrize(("shape", "order"), [((4, 6, 5, 3), "auto"), ((4, 3, 6, 5), "auto"), ((4, 5, 5, 5), "last")])
@pytest.mark.parametrize("layout", [ActionOutputQ, SeparateQ])
def test_a_stack_of_colour_frames_is_one_frame_with_all_their_channels(
    shape: tuple[int, ...], order: str, layout: Any
) -> None:
    assert isinstance(body_for((4, 84, 84, 3), True), Conv), "and not a flat network"
    s = torch.rand(2, *shape)
    channels = s if shape[1] == 3 else s.permute(0, 1, 4, 2, 3)
    stacked = layout(shape, 2, Conv((4,), (3,), (1,), (8,), channel_order=order), rng=3)
    flat = layout(
        tuple(channels.flatten(1, 2).shape[1:]), 2, Conv((4,), (3,), (1,), (8,), channel_order="first"), rng=3
    )
    torch.testing.assert_close(stacked.all(s), flat.all(channels.flatten(1, 2)))


@pytest.mark.parametrize("layout", [ActionOutputQ, SeparateQ])
@pytest.mark.parametrize("order", ["auto", "last"])
def test_a_network_gives_the_same_values_whichever_way_the_frame_lies(layout: Any, order: str) -> None:
    first = layout((3, 6, 5), 2, Conv((4, 5), (3, 2), (1, 1), (8,)), rng=3)
    last = layout((6, 5, 3), 2, Conv((4, 5), (3, 2), (1, 1), (8,), channel_order=order), rng=3)
    s = torch.rand(7, 3, 6, 5)
    torch.testing.assert_close(last.all(s.permute(0, 2, 3, 1).contiguous()), first.all(s))
    assert not torch.allclose(last.all(s.permute(0, 3, 2, 1).reshape(7, 6, 5, 3)), first.all(s))


def test_with_equal_sides_the_given_order_decides() -> None:
    nets = [ActionOutputQ((5, 5, 5), 2, Conv(hidden=(8,), channel_order=order), rng=3) for order in ("first", "last")]
    s = torch.rand(4, 5, 5, 5)
    torch.testing.assert_close(nets[1].all(s.permute(0, 2, 3, 1)), nets[0].all(s))


def test_a_frame_of_one_channel_needs_no_axis_for_it() -> None:
    flat, deep = (ActionOutputQ(shape, 2, Conv(hidden=(8,)), rng=3) for shape in ((6, 5), (1, 6, 5)))
    s = torch.rand(4, 6, 5)
    torch.testing.assert_close(flat.all(s), deep.all(s[:, None]))


@pytest.mark.parametrize(("shape", "order"), [((6, 5, 3), "auto"), ((5, 5, 5), "last"), ((6, 5), "auto")])
def test_the_streaming_kernels_see_the_frame_as_the_network_does(shape: tuple[int, ...], order: str) -> None:
    body = Conv((4, 3), (3, 2), (1, 1), (8,), channel_order=order)
    engine = TorchEngine(ActionOutputQ(shape, 2, body, rng=3, dtype=torch.float64), Loss())
    s = torch.rand(4, *shape, dtype=torch.float64)
    torch.testing.assert_close(SingleRowNetwork(engine).values(s), engine.all(s))
    torch.testing.assert_close(SingleRowNetwork(engine).values(s > 0.5), engine.all(s > 0.5))


def test_he_weights_have_the_variance_that_rectified_units_need() -> None:
    """He et al. (2015), eq. 10: 2/fan_in below a ReLU; nothing is rectified above the last layer: 1/fan_in."""
    q = ActionOutputQ((12, 12, 8), 50, Conv((64,), (3,), (1,), (300,), init="he"), rng=0)
    stem: Any = q.input.stem
    weights = [stem.weights[0], q.trunk.layers[0].weight, q.trunk.layers[1].weight]
    for weight, fan_in, gain in zip(weights, (8 * 9, 64 * 100, 300), (2.0, 2.0, 1.0), strict=True):
        assert float(weight.detach().var()) * fan_in == pytest.approx(gain, rel=0.1)
        assert abs(float(weight.detach().mean())) < 5 * (gain / fan_in / weight.numel()) ** 0.5
    assert all(not bool(b.any()) for b in (*stem.biases, q.trunk.layers[0].bias, q.trunk.layers[1].bias))


def test_the_minatar_body_is_the_published_one() -> None:
    """Gallici et al. (2024): conv 16 @ 3 × 3 valid, normalisation, 128, normalisation, A. Breakout: 4 channels."""
    q = ActionOutputQ((10, 10, 4), 3, NAMED_BODIES["minatar"])
    conv, norms, dense = 16 * 4 * 9 + 16, 2 * 16 * 8 * 8 + 2 * 128, (1024 * 128 + 128) + (128 * 3 + 3)
    assert sum(p.numel() for p in q.parameters()) == conv + norms + dense


def test_a_body_is_chosen_by_the_frame() -> None:
    assert body_for((10, 10, 4), True).channels == (16,)  # type: ignore[union-attr]
    assert body_for((4, 84, 84), True).channels == (32, 64, 64)  # type: ignore[union-attr]
    assert body_for((84, 84), True).channels == (32, 64, 64)  # type: ignore[union-attr]
    for shape, is_frame in (((4,), False), ((2, 2, 3), False), ((10, 10), False), ((2, 9), True)):
        assert body_for(shape, is_frame) == MLP()


@pytest.mark.parametrize("dtype", [np.uint8, np.bool_])
def test_frames_are_encoded_and_stored_as_they_come(dtype: type) -> None:
    space = spaces.Box(0, 255 if dtype is np.uint8 else 1, (5, 4, 3), dtype)  # type: ignore[type-var]
    encoder = encoder_for(space)
    frames = np.stack([space.sample() for _ in range(6)])
    assert encoder.dtype == dtype and encoder.encode(frames).dtype == dtype
    with pytest.raises(ValueError, match=f"must be {np.dtype(dtype)}, got dtype float64"):
        encoder.encode(frames.astype(np.float64))
    buffer = ReplayBuffer(8, encoder.shape, encoder.dtype)
    for s_tm1, s_t in itertools.pairwise(frames):
        buffer.add_step(0, s_tm1, 0, 1.0, 0.0, 0.9, s_t, False)
    stored = buffer.sample(64, np.random.default_rng(0)).transition.s_tm1.numpy()
    assert stored.dtype == dtype and {x.tobytes() for x in stored} == {x.tobytes() for x in frames[:-1]}


class Screen(gym.Env[Any, Any]):
    """Frames of one colour: 51 everywhere for bytes, all set for flags."""

    action_space = spaces.Discrete(2)

    def __init__(self, dtype: Any) -> None:
        self.observation_space = spaces.Box(0, 255 if dtype == np.uint8 else 1, (6, 6, 2), dtype)

    def look(self) -> tuple[Any, dict[str, Any]]:
        dtype: Any = self.observation_space.dtype
        return np.full((6, 6, 2), 51 if dtype == np.uint8 else 1, dtype), {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.look()[0], 0.0, False, False, {}


@pytest.mark.parametrize("layout", ["action-output", "action-input", "separate", "linear"])
@pytest.mark.parametrize(("dtype", "brightness"), [(np.uint8, 0.2), (np.bool_, 1.0)])
def test_bytes_become_brightness_and_flags_ones(layout: str, dtype: Any, brightness: float) -> None:
    spec = Interaction(make_vector_env(lambda: Screen(dtype), 1), 0.9, seed=0).spec
    assert spec.dtype == dtype and spec.shape == (6, 6, 2)
    q: Any = build_q(RunConfig(layout=layout), spec, np.random.default_rng(0))
    first = q.weight if layout == "linear" else q.input.stem.weights[0]
    with torch.no_grad():
        for p in q.parameters():
            p.fill_(0.01)
    seen: list[torch.Tensor] = []
    if layout != "linear":
        q.input.stem.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    frame = torch.from_numpy(Screen(dtype).look()[0])[None]
    value = q.all(frame)
    if layout == "linear":
        assert first.shape == (2, 72)
        torch.testing.assert_close(value, torch.full((1, 2), 72 * 0.01 * brightness + 0.01, dtype=value.dtype))
    else:
        torch.testing.assert_close(seen[0], torch.full((1, 6, 6, 2), brightness))


@pytest.mark.parametrize(("name", "kind"), [("minatar", Conv), ("conv", Conv), ("mlp", MLP)])
def test_bodies_have_names(name: str, kind: type) -> None:
    config = config_from_dict({"body": name})
    assert type(config.body) is kind and config.body == NAMED_BODIES[name]
    with pytest.raises(ValueError, match="one of mlp, minatar, conv, gru, or 'module:Class' of your own, got 'cnn'"):
        config_from_dict({"body": "cnn"})


def test_a_missing_extra_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("minatar", "minatar.gym", "ale_py"):
        monkeypatch.setitem(sys.modules, module, None)
    for key in [key for key in gym.registry if key.startswith(("MinAtar/", "ALE/"))]:
        monkeypatch.delitem(gym.registry, key)
    for env, extra in (("MinAtar/Breakout-v1", "minatar"), ("ALE/Breakout-v5", "atari")):
        with pytest.raises(ValueError, match=rf"needs the extra '{extra}' .*pip install 'neuralq\[{extra}\]'"):
            make_envs(RunConfig(env=env), 1)


GAMES = [("Asterix", 4), ("Breakout", 4), ("Freeway", 7), ("Seaquest", 10), ("SpaceInvaders", 6)]


@pytest.mark.parametrize(("game", "num_channels"), GAMES)
@pytest.mark.parametrize("learner", ["rollout", "streaming"])
def test_every_minatar_game_has_a_preset_that_trains(game: str, num_channels: int, learner: str, tmp_path: Any) -> None:
    pytest.importorskip("minatar", reason="needs the extra minatar")
    config = with_preset(
        {
            "env": f"MinAtar/{game}-v1", "learner": learner, "total_steps": 64, "evaluation_episodes": 1,
            "evaluation_max_steps": 5,
            **({"rollout": {"num_envs": 4, "num_steps": 8, "num_minibatches": 2}} if learner == "rollout" else {}),
        }
    )  # fmt: skip
    session = build_session(config)
    try:
        assert session.stream.spec.inner_shape == (10, 10, num_channels)
        stem: Any = session.learner.engine.q.input.stem  # type: ignore[attr-defined]
        assert stem.in_shape == (num_channels, 10, 10) and stem.channels_last
        assert session.stream.spec.dtype == (np.bool_ if learner == "rollout" else np.float32)
    finally:
        session.close()
    if game == "Seaquest":
        assert train(config, tmp_path / "run").env_steps == 64


def test_atari_screens_are_preprocessed_and_stacked() -> None:
    pytest.importorskip("ale_py", reason="needs the extra atari")
    pytest.importorskip("cv2", reason="needs the extra atari")
    for num_envs in (1, 2):
        envs = make_envs(RunConfig(env="ALE/Breakout-v5"), num_envs)
        stream = Interaction(envs, 0.99, seed=0)
        assert stream.spec.shape == (4, 84, 84) and stream.spec.dtype == np.uint8
        envs.close()


def test_a_minatar_game_is_drawn_in_bytes() -> None:
    pytest.importorskip("minatar", reason="needs the extra minatar")
    pytest.importorskip("seaborn", reason="MinAtar draws with it")
    env = make_single("MinAtar/Breakout-v1", {}, "rgb_array")
    env.reset(seed=0)
    picture: Any = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (240, 240, 3) and env.metadata["render_fps"] == 10
    # Ground, paddle and bricks: the ball starts in row 3, which bricks are drawn over.
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 3
    env.close()
