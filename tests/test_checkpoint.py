"""Checkpoints: exact round trips, and every way to damage or forge one.

Mutants that must die here: manifest without its own digest · digest of a file not compared · keep counts damaged ones ·
file names of the manifest not checked · large integers as JSON floats · a shared storage written twice or not at all ·
non-finite floats as null · object arrays pickled. Interruptions are in test_checkpoint_kill.py.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neuralq.runs.folder.checkpoint import CheckpointError, load, load_newest, save


def same(a: Any, b: Any) -> bool:
    """Equal in type, order of keys and every bit; written without the module under test."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor):
        if a.dtype != b.dtype or a.shape != b.shape:
            return False
        return torch.equal(*(x.contiguous().reshape(-1).view(torch.uint8) for x in (a, b)))
    if isinstance(a, np.ndarray | np.generic):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return a.hex() == b.hex()
    return bool(a == b)


def example_state() -> dict[str, Any]:
    flat = torch.arange(6, dtype=torch.float32)
    rng = np.random.default_rng(7)
    return {
        "z last letter first": 1,
        "learner": {
            "parameters": flat,
            "view": flat[2:4].view(2, 1),
            "bf16": torch.tensor([1.5, -0.0], dtype=torch.bfloat16),
            "scalar": torch.tensor(3.25, dtype=torch.float64),
            "flags": torch.tensor([True, False]),
            "empty": torch.zeros(0, 3),
        },
        "replay": {
            "big": rng.integers(0, 255, size=(1100, 1000), dtype=np.uint8),
            "fortran": np.asfortranarray(rng.random((3, 4))),
            "strided": np.arange(10)[::3],
            "uint64": np.array(2**64 - 1, dtype=np.uint64),
            "bools": np.array([[True], [False]]),
            "none": np.zeros((0, 2)),
            "text": np.array(["a", "bcd"]),
        },
        "generator": rng.bit_generator.state,
        "numbers": [0, -1, 2**63, -(2**200), 10**5000, True, False, None],
        "floats": [0.1, -0.0, float("inf"), float("-inf"), float("nan"), 5e-324],
        "numpy scalars": (np.float64(0.5), np.int8(-3), np.bool_(True), np.float32("nan")),
        "words": ["", "naïve λ", "\ud800", '"\\/\n'],
        "../../etc/passwd": {"a/b": {"": 1, "dict": {"tensor": "0"}}},
        "nested": [[1, [2]], {"in a list": (1, [np.ones(2)])}, []],
    }


def flip(path: Path, position: int, bit: int) -> None:
    raw = bytearray(path.read_bytes())
    raw[position] ^= 1 << bit
    path.write_bytes(raw)


def test_every_kind_of_leaf_comes_back_bit_for_bit(tmp_path: Path) -> None:
    state = example_state()
    path = save(tmp_path, 12288, state)
    assert path == tmp_path / "step-000000012288"
    found = load_newest(tmp_path)
    assert (found.step, found.path) == (12288, path)
    assert same(found.state, state)
    assert {p.name for p in path.iterdir()} == {
        *("manifest.json", "state.json", "tensors.safetensors", "arrays.npy", "array-00000.npy")
    }


def test_a_loaded_generator_draws_what_the_saved_one_draws(tmp_path: Path) -> None:
    for bits in (np.random.PCG64, np.random.MT19937, np.random.Philox, np.random.SFC64):
        rng = np.random.Generator(bits(5))
        rng.integers(0, 10, dtype=np.uint32)  # leaves half a word buffered
        save(tmp_path, 1, {"rng": rng.bit_generator.state})
        other = np.random.Generator(bits(0))
        other.bit_generator.state = load_newest(tmp_path).state["rng"]
        assert (rng.random(50) == other.random(50)).all() and rng.integers(9) == other.integers(9)


def test_one_object_stays_one_and_parameters_lose_only_their_gradient(tmp_path: Path) -> None:
    weights, array = torch.nn.Parameter(torch.ones(2)), np.zeros(3)
    mapping = OrderedDict(w=weights, again=weights)
    found = load(save(tmp_path, 0, {"m": mapping, "a": array, "b": [array]})).state
    assert found["m"]["w"] is found["m"]["again"] and found["a"] is found["b"][0]
    assert type(found["m"]) is dict and not found["m"]["w"].requires_grad


def test_what_is_loaded_shares_no_memory_with_the_file_or_the_saved(tmp_path: Path) -> None:
    state = {"t": torch.zeros(3), "a": np.zeros(3)}
    path = save(tmp_path, 0, state)
    first = load(path).state
    first["t"] += 1
    first["a"] += 1
    assert same(load(path).state, state) and state["t"].sum() == 0


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(2**130), 2**130),
    st.floats(),
    st.text(),
    st.just(np.int16(3)),
)
trees = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=12,
)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(state=st.dictionaries(st.text(max_size=6), trees, max_size=4))
def test_any_tree_of_plain_values_comes_back(tmp_path: Path, state: dict[str, Any]) -> None:
    assert same(load(save(tmp_path, 3, state)).state, state)


@pytest.mark.parametrize(
    ("state", "named"),
    [
        ({"a": {"b": [object()]}}, r"state\['a'\]\['b'\]\[0\] is a builtins.object"),
        ({"a": {3: 1}}, r"keys must be str, got 3 \(int\) in state\['a'\]"),
        ({"o": np.array([None])}, r"state\['o'\] is an object array"),
        ({"s": torch.eye(2).to_sparse()}, r"state\['s'\] is a torch.sparse_coo tensor"),
        ({"f": {1, 2}}, r"state\['f'\] is a builtins.set"),
        ([1], "state must be a mapping"),
    ],
)
def test_what_cannot_be_stored_is_named_before_anything_is_written(tmp_path: Path, state: Any, named: str) -> None:
    with pytest.raises(TypeError, match=named):
        save(tmp_path / "c", 1, state)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(("step", "keep"), [(-1, 2), (1.5, 2), (True, 2), (10**18, 2), (1, 0)])
def test_steps_and_keep_are_checked(tmp_path: Path, step: Any, keep: int) -> None:
    with pytest.raises(ValueError, match=r"step|keep"):
        save(tmp_path, step, {}, keep=keep)


def test_the_last_two_are_kept_and_saving_a_step_again_replaces_it(tmp_path: Path) -> None:
    for step in (1, 2, 3):
        save(tmp_path, step, {"step": step})
    save(tmp_path, 3, {"step": "again"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step-000000000002", "step-000000000003"]
    assert load_newest(tmp_path).state == {"step": "again"}
    save(tmp_path, 4, {}, keep=1)
    assert [p.name for p in tmp_path.iterdir()] == ["step-000000000004"]


def test_a_damaged_checkpoint_does_not_count_as_one_of_the_two(tmp_path: Path) -> None:
    for step in (1, 2):
        save(tmp_path, step, {"step": step})
    flip(tmp_path / "step-000000000002" / "state.json", 3, 0)
    save(tmp_path, 3, {"step": 3})
    flip(tmp_path / "step-000000000003" / "state.json", 3, 0)
    with pytest.warns(UserWarning, match="damaged"):
        assert load_newest(tmp_path).step == 1


def test_other_things_in_the_folder_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "step-000000000001").mkdir()
    (tmp_path / "step-000000000001" / "precious").write_text("mine")
    (tmp_path / ".tmp-mine").mkdir()
    for step in (5, 6, 7):
        save(tmp_path, step, {})
    assert (tmp_path / "step-000000000001" / "precious").read_text() == "mine" and (tmp_path / ".tmp-mine").is_dir()


def test_flipped_bits_anywhere_are_noticed(tmp_path: Path) -> None:
    path = save(tmp_path, 9, {k: v for k, v in example_state().items() if k != "replay"} | {"array": np.arange(4)})
    rng = np.random.default_rng(0)
    for file in sorted(path.iterdir()):
        raw = file.read_bytes()
        places = range(0, len(raw), 3) if file.name == "manifest.json" else rng.integers(len(raw), size=25)
        for position in places:
            flip(file, int(position), int(rng.integers(8)))
            with pytest.raises(CheckpointError):
                load(path)
            file.write_bytes(raw)
    assert load(path).step == 9


def test_truncated_lengthened_missing_and_swapped_files_are_noticed(tmp_path: Path) -> None:
    path = save(tmp_path, 9, {"t": torch.ones(3), "a": np.ones(3), "b": np.zeros(1 << 18)})
    for file in sorted(path.iterdir()):
        raw = file.read_bytes()
        for content in (raw[:-1], raw[: len(raw) // 2], b"", raw + b"\0"):
            file.write_bytes(content)
            with pytest.raises(CheckpointError, match=str(path)):
                load(path)
        file.unlink()
        with pytest.raises(CheckpointError, match=r"incomplete|no whole"):
            load(path)
        file.mkdir()
        with pytest.raises(CheckpointError, match=str(path)):
            load(path)
        file.rmdir()
        file.write_bytes(raw)
    assert load(path).step == 9


def test_a_damaged_newest_falls_back_with_a_warning_that_says_what_was_wrong(tmp_path: Path) -> None:
    for step in (1, 2):
        save(tmp_path, step, {"step": step, "t": torch.ones(2)})
    flip(tmp_path / "step-000000000002" / "tensors.safetensors", -1, 0)
    with pytest.warns(UserWarning, match="step-000000000002 is damaged: tensors.safetensors .*falling back to step 1"):
        assert load_newest(tmp_path).state["step"] == 1
    (tmp_path / "step-000000000001" / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match=r"no usable checkpoint.*damaged.*no whole checkpoint"):
        load_newest(tmp_path)


def resign(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """A forger's manifest: changed, and with every digest right. The layout is written down here independently."""
    body = json.loads((path / "manifest.json").read_bytes())
    body.pop("sha256")
    change(body)
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    (path / "manifest.json").write_bytes(json.dumps({**body, "sha256": digest}, indent=1).encode())


def test_foreign_newer_and_renamed_checkpoints_are_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CheckpointError, match="no checkpoint in"):
            load_newest(folder)
    path = save(tmp_path, 4, {})
    resign(path, lambda body: body)  # the forger's hand is good: unchanged content still loads
    assert load(path).step == 4
    resign(path, lambda body: body.update(version=2))
    with pytest.raises(CheckpointError, match="format version 2, and this neuralq reads up to 1; upgrade"):
        load_newest(tmp_path)
    resign(path, lambda body: body.update(version=1, format="other-checkpoint"))
    with pytest.raises(CheckpointError, match="not written by neuralq"):
        load_newest(tmp_path)
    path = save(tmp_path / "b", 4, {})
    path.rename(path.with_name("step-000000000005"))
    with pytest.raises(CheckpointError, match="holds step 4"):
        load_newest(tmp_path / "b")


@pytest.mark.parametrize("name", ["../secret", "/etc/hostname", "state.json/../../secret", "a\\b", "manifest.json", ""])
def test_a_forged_manifest_reaches_no_file_outside(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_bytes(b"x")
    path = save(tmp_path, 1, {})
    entry = {"bytes": 1, "sha256": hashlib.sha256(b"x").hexdigest()}
    resign(path, lambda body: body["files"].update({name: entry}))
    with pytest.raises(CheckpointError, match="is not a checkpoint's"):
        load(path)


@pytest.mark.parametrize(
    "document",
    [
        *(
            b"[]",
            b'{"own": "../secret"}',
            b'{"dict": {"a": {"own": "/etc/passwd"}}}',
            b'{"dict": {"a": {"tensor": 3}}}',
        ),
        *(
            b'{"dict": {}, "int": "1"}',
            b'{"dict": 3}',
            b'{"dict": {"a": {"float": "x"}}}',
            b"[" * 100000,
            b"\xff",
            b"9" * 9999,
        ),
        *(b'{"dict": {"a": {"array": 7}}}', b'{"dict": {"a": {}}}', b'{"dict": {"a": {"eval": "1"}}}', b"{"),
    ],
)
def test_a_forged_state_gives_one_clear_error(tmp_path: Path, document: bytes) -> None:
    path = save(tmp_path, 1, {})
    (path / "state.json").write_bytes(document)
    entry = {"bytes": len(document), "sha256": hashlib.sha256(document).hexdigest()}
    resign(path, lambda body: body["files"].update({"state.json": entry}))
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        load(path)


def test_a_pickled_array_in_a_forged_checkpoint_is_never_unpickled(tmp_path: Path) -> None:
    path = save(tmp_path, 1, {"a": np.ones(2)})
    np.save(path / "arrays.npy", np.array([{"x": 1}], dtype=object), allow_pickle=True)
    raw = (path / "arrays.npy").read_bytes()
    entry = {"bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    resign(path, lambda body: body["files"].update({"arrays.npy": entry}))
    with pytest.raises(CheckpointError, match="allow_pickle"):
        load(path)
