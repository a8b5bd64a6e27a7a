"""Encoders against `gymnasium.spaces.utils.flatten` and `numpy.ravel_multi_index`, buffer reuse, and every refusal.

Planted mutants that these tests kill: the copy left out of `floats` or of the image path; `start` not subtracted; radix
order reversed; the one-hot column offset left out; `>=` limit check turned into `>`; the finite check left out or run
before the cast to float32; the part order of a Dict reversed; environments and entries swapped in the error.
"""

from __future__ import annotations

import copy
import timeit
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import Space, spaces
from gymnasium.spaces.utils import flatten, flatten_space
from gymnasium.vector.utils import concatenate, create_empty_array

from neuralq.q.inputs import OneHot, Pixels
from neuralq.runs.stream.encoding import MAX_TABLE_STATES, ObservationError, discrete_actions, encoder_for


def batch_of(space: Space[Any], samples: list[Any]) -> Any:
    """The batch exactly as Gymnasium's vector environments put it together."""
    out: Any = create_empty_array(space, n=len(samples))
    return concatenate(space, samples, out)


def random_leaf(rng: np.random.Generator, *, finite: bool) -> Space[Any]:
    shape = tuple(int(n) for n in rng.integers(1, 4, size=rng.integers(0, 3)))
    kind = int(rng.integers(0, 3 if finite else 6))
    if kind == 0:
        return spaces.Discrete(int(rng.integers(1, 5)), start=int(rng.integers(-3, 4)))
    if kind == 1:
        nvec = rng.integers(1, 4, size=shape or (2,))
        return spaces.MultiDiscrete(nvec, start=rng.integers(-2, 3, size=nvec.shape))
    if kind == 2:
        return spaces.MultiBinary(int(rng.integers(1, 4)))
    if kind == 3:
        return spaces.Box(-5, 5, shape, np.float64)
    if kind == 4:
        return spaces.Box(0, 255, (2, *shape), np.uint8)
    return spaces.Box(-9, 9, shape, np.int32)


def random_space(rng: np.random.Generator, depth: int, *, finite: bool) -> Space[Any]:
    if depth == 0:
        return random_leaf(rng, finite=finite)
    inner = [random_space(rng, int(rng.integers(0, depth)), finite=finite) for _ in range(int(rng.integers(1, 4)))]
    if rng.random() < 0.5:
        return spaces.Tuple(inner)
    return spaces.Dict({f"k{int(rng.integers(100))}-{i}": space for i, space in enumerate(inner)})


@pytest.mark.parametrize("seed", range(40))
def test_nested_spaces_equal_gymnasium_flatten(seed: int) -> None:
    rng = np.random.default_rng(seed)
    space = random_space(rng, 1 + seed % 3, finite=False)
    space.seed(seed)
    samples = [space.sample() for _ in range(4)]
    encoder = encoder_for(space)
    got = encoder.encode(batch_of(space, samples))
    want = np.stack([np.asarray(flatten(space, sample), np.float32) for sample in samples])
    # Bytes of 0..255, the only numbers here beyond ±32, become 0..1.
    high = flatten_space(space).high
    want = np.divide(want, np.where(high > 32, high, 1), dtype=np.float32)
    assert got.dtype == np.float32 and got.shape == (4, *encoder.shape) and encoder.num_categories is None
    np.testing.assert_array_equal(got, want)
    for row, sample in zip(got, samples, strict=True):
        np.testing.assert_array_equal(encoder.encode_single(sample), row)


@pytest.mark.parametrize(
    "space",
    [spaces.MultiDiscrete(np.array([[2, 3], [4, 1]]), start=np.array([[1, 0], [-1, 5]])), spaces.MultiBinary((2, 3))],
)
def test_discrete_arrays_equal_gymnasium_flatten(space: Space[Any]) -> None:
    space.seed(1)
    samples = [space.sample() for _ in range(20)]
    want = np.stack([np.asarray(flatten(space, sample)) for sample in samples])
    np.testing.assert_array_equal(encoder_for(space).encode(batch_of(space, samples)), want)


@pytest.mark.parametrize("seed", range(25))
def test_state_index_is_the_ravelled_multi_index(seed: int) -> None:
    rng = np.random.default_rng(seed)
    space = random_space(rng, seed % 3, finite=True)
    space.seed(seed)
    samples = [space.sample() for _ in range(30)]
    try:
        encoder = encoder_for(space, as_index=True)
    except ValueError as error:  # a rare draw has too many states; the number must then be in the message
        assert "states is refused" in str(error)
        return

    def digits(space: Space[Any], sample: Any) -> list[tuple[int, int]]:
        """(digit, radix) pairs in order, straight from the space's own fields."""
        if isinstance(space, spaces.Tuple):
            return [pair for inner, x in zip(space.spaces, sample, strict=True) for pair in digits(inner, x)]
        if isinstance(space, spaces.Dict):
            return [pair for key, inner in space.spaces.items() for pair in digits(inner, sample[key])]
        if isinstance(space, spaces.Discrete):
            return [(int(sample - space.start), int(space.n))]
        if isinstance(space, spaces.MultiBinary):
            return [(int(bit), 2) for bit in sample.flat]
        assert isinstance(space, spaces.MultiDiscrete)
        return [(int(x - s), int(n)) for x, s, n in zip(sample.flat, space.start.flat, space.nvec.flat, strict=True)]

    got = encoder.encode(batch_of(space, samples))
    pairs = [digits(space, sample) for sample in samples]
    want = [int(np.ravel_multi_index([d for d, _ in row], [n for _, n in row])) for row in pairs]
    assert got.dtype == np.int64 and got.tolist() == want
    assert encoder.shape == () and encoder.num_categories == np.prod([radix for _, radix in pairs[0]])


def test_mixed_radix_by_hand_and_no_two_states_share_an_index() -> None:
    space = spaces.Tuple((spaces.Discrete(2, start=3), spaces.MultiDiscrete([3, 2])))
    encoder = encoder_for(space, as_index=True)
    # (4, [2, 1]) -> digits 1, 2, 1 in radix 2, 3, 2 -> (1·3 + 2)·2 + 1 = 11, the last of the 12 states
    assert encoder.encode((np.array([4]), np.array([[2, 1]]))).tolist() == [11]
    grid = np.stack(np.meshgrid([3, 4], [0, 1, 2], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    assert sorted(encoder.encode((grid[:, 0], grid[:, 1:])).tolist()) == list(range(12))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (2, 3, 2)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64, np.int8])
def test_box_keeps_its_shape_as_float32(shape: tuple[int, ...], dtype: Any) -> None:
    space = spaces.Box(-9, 9, shape, dtype, seed=0)
    samples = [space.sample() for _ in range(3)]
    encoder = encoder_for(space)
    got = encoder.encode(batch_of(space, samples))
    assert (encoder.shape, encoder.dtype, encoder.num_categories) == (shape, np.dtype(np.float32), None)
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, np.stack(samples).astype(np.float32))


def test_images_stay_bytes_and_byte_vectors_become_floats() -> None:
    image = encoder_for(spaces.Box(0, 255, (4, 4, 3), np.uint8))
    assert image.dtype == np.uint8 and image.encode(np.full((2, 4, 4, 3), 255, np.uint8)).dtype == np.uint8
    assert encoder_for(spaces.Box(0, 255, (128,), np.uint8)).dtype == np.float32
    with pytest.raises(ObservationError, match="must be uint8, got dtype int64"):
        image.encode(np.full((2, 4, 4, 3), 300))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (3,)),
        spaces.Box(-1, 1, (3,), np.float64),
        spaces.Box(0, 255, (3, 3), np.uint8),
        spaces.Discrete(5),
        spaces.MultiBinary(4),
    ],
    ids=str,
)
def test_an_environment_that_reuses_its_buffer_cannot_change_what_was_encoded(space: Space[Any]) -> None:
    buffer: Any = create_empty_array(space, n=2)
    encoder = encoder_for(space)
    first = encoder.encode(buffer)
    kept = first.copy()
    buffer[...] = 1
    second = encoder.encode(buffer)
    np.testing.assert_array_equal(first, kept)
    assert not np.shares_memory(first, buffer) and not np.shares_memory(first, second)
    single = encoder.encode_single(buffer[0])
    assert not np.shares_memory(single, buffer)


def test_vector_environments_feed_the_encoder() -> None:
    envs = gymnasium.make_vec("FrozenLake-v1", num_envs=3)
    observation, _ = envs.reset(seed=0)
    encoder = encoder_for(envs.single_observation_space, as_index=True)
    assert encoder.num_categories == 16 and encoder.encode(observation).tolist() == [0, 0, 0]
    envs.close()


FLOATS = np.zeros((2, 2), np.float32)
NAN = np.array([[0, 0], [0, np.nan]], np.float32)
NESTED = spaces.Dict({"speed": spaces.Box(-1, 1, (2,)), "gear": spaces.Tuple((spaces.Discrete(3, start=1),))})


@pytest.mark.parametrize(
    ("space", "batch", "env_index", "field", "words"),
    [
        (spaces.Box(-1, 1, (2,)), NAN, 1, "observation", r"finite, got nan at index \(1,\)"),
        (spaces.Box(-1, 1, ()), np.array([0, 0, -np.inf]), 2, "observation", "finite, got -inf$"),
        (spaces.Box(-1, 1, (1,), np.float64), np.array([[1e300]]), 0, "observation", "beyond the range of float32"),
        (spaces.Box(-1, 1, (2,)), np.zeros((3, 4), np.float32), None, "observation", r"shape \[N, 2\], got \[3, 4\]"),
        (spaces.Box(-1, 1, (2,)), np.zeros(2, np.float32), None, "observation", "encode_single"),
        (spaces.Box(-1, 1, (2,)), np.zeros((1, 2), np.int64), None, "observation", "floating-point.*got dtype int64"),
        (spaces.Box(0, 9, (2,), np.int64), np.zeros((1, 2)), None, "observation", "whole-number.*got dtype float64"),
        (spaces.Box(-1, 1, (2,)), [[0.0], [0.0, 1.0]], None, "observation", "ragged list"),
        (spaces.Box(-1, 1, (2,)), {"x": 1}, None, "observation", "must be an array, got dict of"),
        (spaces.Box(-1, 1, (2,)), np.array(["a"]), None, "observation", "shape"),
        (spaces.Discrete(3, start=1), np.array([1, 3, 4]), 2, "observation", r"lie in 1\.\.3, got 4"),
        (spaces.Discrete(3, start=1), np.array([1, 0]), 1, "observation", r"lie in 1\.\.3, got 0"),
        (spaces.Discrete(3), np.array([1.0]), None, "observation", "whole-number"),
        (spaces.MultiBinary(2), np.array([[0, 1], [2, 0]]), 1, "observation", r"lie in 0\.\.1, got 2 at flat index 0"),
        (NESTED, {"speed": FLOATS}, None, "observation", r"dict holding 'gear', got dict of \['speed'\]"),
        (NESTED, {"gear": (), "speed": 0}, None, "observation['gear']", "tuple holding 0, got tuple"),
        (NESTED, {"gear": (np.array([1]),), "speed": FLOATS}, None, "observation['speed']", "has 2 rows"),
        (NESTED, {"gear": (np.array([1, 9]),), "speed": FLOATS}, 1, "observation['gear'][0]", "got 9"),
    ],
)  # fmt: skip
def test_refusals_name_environment_and_field(
    space: Space[Any], batch: Any, env_index: int | None, field: str, words: str
) -> None:
    with pytest.raises(ObservationError, match=words) as caught:
        encoder_for(space).encode(batch)
    assert (caught.value.env_index, caught.value.field) == (env_index, field)
    assert str(caught.value).startswith(f"environment {env_index}: {field} " if env_index is not None else f"{field} ")
    again = copy.deepcopy(caught.value)  # rebuilt from its arguments, as when it travels from a worker process
    assert (str(again), again.env_index, again.field) == (str(caught.value), env_index, field)


def test_single_observation_errors_name_the_environment_they_are_told() -> None:
    encoder = encoder_for(spaces.Box(-1, 1, (2,)))
    with pytest.raises(ObservationError, match=r"^environment 7: observation must be finite, got nan at index \(0,\)"):
        encoder.encode_single(np.array([np.nan, 0], np.float32), env_index=7)
    with pytest.raises(ObservationError, match=r"^environment 0: observation must have shape \[N, 2\], got \[1, 3\]"):
        encoder.encode_single(np.zeros(3, np.float32))


def test_the_largest_finite_values_pass() -> None:
    most = np.finfo(np.float32).max
    assert encoder_for(spaces.Box(-1, 1, (2,))).encode(np.array([[most, -most]], np.float32)).tolist() == [
        [most, -most]
    ]


@pytest.mark.parametrize(
    "space",
    [
        spaces.Text(5),
        spaces.Sequence(spaces.Discrete(2)),
        spaces.Graph(spaces.Box(-1, 1, (2,)), None),
        spaces.OneOf((spaces.Discrete(2), spaces.Box(-1, 1, (2,)))),
    ],
    ids=lambda space: type(space).__name__,
)
def test_spaces_without_arrays_are_refused_by_name(space: Space[Any]) -> None:
    with pytest.raises(ValueError, match=rf"{type(space).__name__}.*TransformObservation"):
        encoder_for(space)
    with pytest.raises(ValueError, match=r"at observation\['note'\]"):
        encoder_for(spaces.Dict({"note": space}))


def test_tables_refuse_boxes_and_too_many_states() -> None:
    with pytest.raises(ValueError, match=r"got a Box in observation\[1\].*another layout.*discretise"):
        encoder_for(spaces.Tuple((spaces.Discrete(2), spaces.Box(-1, 1, (2,)))), as_index=True)
    with pytest.raises(ValueError, match=r"a table of 16,777,216 states is refused \(the most is 10,000,000\)"):
        encoder_for(spaces.MultiBinary(24), as_index=True)
    with pytest.raises(
        ValueError, match=r"table of 1,267,650,600,228,229,401,496,703,205,376 states"
    ):  # 2¹⁰⁰, no overflow
        encoder_for(spaces.MultiBinary(100), as_index=True)
    assert encoder_for(spaces.Discrete(MAX_TABLE_STATES), as_index=True).num_categories == 10_000_000
    with pytest.raises(ValueError, match="holds nothing"):
        encoder_for(spaces.Dict({}))


def test_actions_must_be_discrete() -> None:
    assert discrete_actions(spaces.Discrete(4)) == (4, 0)
    assert discrete_actions(spaces.Discrete(4, start=2)) == (4, 2)
    for space in (spaces.Box(-1, 1, (2,)), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2), spaces.Text(3)):
        with pytest.raises(ValueError, match=rf"must be Discrete, got {type(space).__name__}.*TransformAction"):
            discrete_actions(space)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_one_hot_equals_rows_of_the_identity(shape: tuple[int, ...]) -> None:
    index = torch.from_numpy(np.asarray(np.random.default_rng(0).integers(0, 7, shape)))
    got = OneHot(7, torch.float64)(index)
    assert got.dtype == torch.float64 and torch.equal(got, torch.eye(7, dtype=torch.float64)[index])
    assert torch.equal(torch.func.vmap(OneHot(7))(torch.arange(7)), torch.eye(7))
    assert not list(OneHot(7).parameters()) and not OneHot(7).state_dict()


def test_pixels_scale_bytes_once() -> None:
    image = torch.arange(256, dtype=torch.uint8).reshape(1, 16, 16)
    np.testing.assert_allclose(Pixels()(image).numpy().ravel(), np.arange(256) / 255, rtol=1e-7)
    with pytest.raises(ValueError, match=r"uint8 images, got torch\.float32"):
        Pixels()(Pixels()(image))


def test_encoding_a_small_box_takes_microseconds() -> None:
    encoder = encoder_for(spaces.Box(-1, 1, (4,)))
    batch = np.zeros((4, 4), np.float32)
    best_seconds = min(timeit.repeat(lambda: encoder.encode(batch), number=1000, repeat=5)) / 1000
    assert best_seconds < 30e-6  # about 3 µs on a quiet core


def test_encoders_compare_by_what_they_do() -> None:
    assert encoder_for(spaces.Discrete(3)) == encoder_for(spaces.Discrete(3)) != encoder_for(spaces.Discrete(4))
    same = copy.deepcopy(encoder_for(NESTED))
    assert same == encoder_for(NESTED) and same.shape == (5,)
