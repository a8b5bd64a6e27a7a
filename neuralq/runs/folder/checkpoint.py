"""Checkpoints that survive a kill at any moment and refuse whatever they cannot vouch for.

A checkpoint is one folder: tensors in `tensors.safetensors`, small NumPy arrays one after another in `arrays.npy`,
large ones in a `.npy` file each, everything else in `state.json`, and `manifest.json` with the SHA-256 of each file.
It is written under a temporary name, forced to disk, and only then renamed to `step-000000012288`: a folder of that
name is whole, and a writer killed half-way leaves a temporary folder that the next save clears away. The last two are
kept, because a disk may still spoil the newest. Nothing is ever unpickled: reading a checkpoint runs no code from it.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import math
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_bytes
from safetensors.torch import load_file, save_file

from neuralq.checks import check_whole
from neuralq.runs.folder.whole import (
    FORMAT_NAME,
    FORMAT_VERSION,
    MANIFEST,
    STATE,
    CheckpointError,
    candidates,
    fingerprint,
    read_manifest,
    signed,
    verified,
)

__all__ = ["FORMAT_VERSION", "Checkpoint", "CheckpointError", "load", "load_newest", "save", "storable"]

# From this size an array gets a file of its own: below it, one more fsync costs more than the bytes.
OWN_FILE_BYTES = 1 << 20
_TENSORS, _ARRAYS = "tensors.safetensors", "arrays.npy"
_TEMPORARY_NAME = re.compile(r"\.tmp-(write|drop)-step-[0-9]{12,18}(\.replaced)?-[0-9a-f]+")


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What was saved: the counter ``step``, the ``state`` tree, and the folder ``path`` that it was read from."""

    step: int
    state: dict[str, Any]
    path: Path


def save(folder: str | Path, step: int, state: Mapping[str, Any], *, keep: int = 2) -> Path:
    """A kill at any moment of this call leaves either the old checkpoints or the old ones and this one.

    Args:
        folder: where the checkpoints of one run live; made if missing. One writer at a time (the run folder's lock).
        step: at least 0, below 10^18; names the checkpoint. Saving a step again replaces it.
        state: nested mappings with ``str`` keys (any characters, order kept) whose leaves are tensors, NumPy arrays and
            scalars (no object arrays), ``int`` of any size, ``float`` (also NaN and infinities), ``str``, ``bool``,
            ``None``, and lists and tuples of those. A tensor or array that occurs twice is one object again after
            loading; views of one storage become separate tensors. Tensors come back on the CPU.
        keep: how many whole checkpoints stay, at least 1; older ones are deleted.

    Returns:
        The folder ``step-…`` of this checkpoint.

    Raises:
        TypeError: for a leaf that cannot be stored, naming its place in the tree.
        CheckpointError: if the disk refuses (full, read-only); earlier checkpoints are intact.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> path = save(folder, 5, {"learner": {"parameters": torch.ones(2), "generator": 2**100}})
        >>> path.name, load_newest(folder).state["learner"]["parameters"]
        ('step-000000000005', tensor([1., 1.]))
    """
    check_whole("step", step, 0)
    check_whole("keep", keep)
    if step >= 10**18:
        raise ValueError(f"step must be below 10^18, got {step}")
    if not isinstance(state, Mapping):
        raise TypeError(f"state must be a mapping with str keys, got {type(state).__name__}")
    packing = _Packing()
    document = packing.pack(state, "state")
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for left_over in folder.iterdir():
            if _TEMPORARY_NAME.fullmatch(left_over.name) and left_over.is_dir() and not left_over.is_symlink():
                shutil.rmtree(left_over)
        path = _write(folder, int(step), document, packing)
        _prune(folder, path, keep)
    except (OSError, SafetensorError) as error:
        message = f"could not save step {step} in {folder}: {error}; earlier checkpoints there are intact"
        raise CheckpointError(f"{message}; make room, then resume") from error
    return path


def storable(state: Mapping[str, Any]) -> None:
    """Nothing for a state that `save` can store.

    Raises:
        TypeError: for a leaf that cannot be stored, naming its place in the tree.

    Example:
        >>> storable({"seen": {"best": 1.5}})
    """
    _Packing().pack(state, "state")


def load(path: str | Path) -> Checkpoint:
    """The state comes back bit for bit, or not at all: every file's size and SHA-256 is compared before it is read.

    Raises:
        CheckpointError: if ``path`` is no checkpoint, is incomplete or altered, or was written by a newer neuralq.

    Example:
        >>> import tempfile
        >>> path = save(tempfile.mkdtemp(), 7, {"epsilon": 0.1, "names": ["left", "right"]})
        >>> load(path).state
        {'epsilon': 0.1, 'names': ['left', 'right']}
    """
    path = Path(path)
    step, files = verified(path)
    try:
        document = json.loads((path / STATE).read_bytes())
        tensors = _read_tensors(path / _TENSORS) if _TENSORS in files else {}
        arrays = _read_arrays(path / _ARRAYS) if _ARRAYS in files else []
        own = {n: np.load(path / n, allow_pickle=False) for n in files if n.startswith("array-")}
        state = _Unpacking(tensors, arrays, own).unpack(document)
        if not isinstance(state, dict):
            raise ValueError(f"the root of the state is a {type(state).__name__}, not a mapping")
    except Exception as error:  # whatever a forged document provokes; its hashes may be right
        raise CheckpointError(f"{path} is no readable checkpoint: {type(error).__name__}: {error}") from error
    return Checkpoint(step, state, path)


def load_newest(folder: str | Path) -> Checkpoint:
    """The newest checkpoint that is whole; each newer one that is not is named in a warning.

    Raises:
        CheckpointError: if there is none in ``folder``, or none that is whole.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> for step in (10, 20, 30):
        ...     path = save(folder, step, {"env_steps": step})
        >>> load_newest(folder).step, sorted(p.name for p in Path(folder).iterdir())
        (30, ['step-000000000020', 'step-000000000030'])
    """
    folder = Path(folder)
    refused: list[str] = []
    for path in candidates(folder) if folder.is_dir() else []:
        try:
            checkpoint = load(path)
        except CheckpointError as error:
            refused.append(str(error))
            continue
        for reason in refused:
            warnings.warn(f"{reason}; falling back to step {checkpoint.step}", stacklevel=2)
        return checkpoint
    if refused:
        raise CheckpointError(f"no usable checkpoint in {folder}: " + "; ".join(refused))
    raise CheckpointError(f"no checkpoint in {folder}; start a run with `neuralq train`")


@dataclass
class _Packing:
    """The tree as a JSON document; tensors and arrays are set aside and referred to by number.

    Every JSON object has one member, whose name is the kind of node; so no key of the caller's can be mistaken for one.
    """

    tensors: dict[str, torch.Tensor] = field(default_factory=dict)
    arrays: list[np.ndarray[Any, Any]] = field(default_factory=list)
    own: dict[str, np.ndarray[Any, Any]] = field(default_factory=dict)
    seen: dict[int, tuple[Any, dict[str, Any]]] = field(default_factory=dict)
    storages: set[int] = field(default_factory=set)

    def pack(self, value: Any, place: str) -> Any:
        kind = type(value)
        if value is None or kind is bool or kind is str:
            return value
        if kind is int:
            return value if -(2**63) <= value < 2**63 else {"int": hex(value)}
        if kind is float:
            return value if math.isfinite(value) else {"float": repr(value)}
        if kind is list:
            return [self.pack(v, f"{place}[{i}]") for i, v in enumerate(value)]
        if kind is tuple:
            return {"tuple": [self.pack(v, f"{place}[{i}]") for i, v in enumerate(value)]}
        if isinstance(value, Mapping):
            for key in value:
                if type(key) is not str:
                    raise TypeError(f"keys must be str, got {key!r} ({type(key).__name__}) in {place}")
            return {"dict": {k: self.pack(v, f"{place}[{k!r}]") for k, v in value.items()}}
        if isinstance(value, torch.Tensor | np.ndarray | np.generic):
            if id(value) not in self.seen:  # the object is kept beside its node, so that its id stays taken
                self.seen[id(value)] = (value, self._set_aside(value, place))
            return self.seen[id(value)][1]
        raise TypeError(
            f"{place} is a {kind.__module__}.{kind.__qualname__}, which a checkpoint cannot hold; "
            "store it as tensors, NumPy arrays, numbers, strings, None, lists and mappings of those"
        )

    def _set_aside(self, value: Any, place: str) -> dict[str, Any]:
        if isinstance(value, torch.Tensor):
            if value.layout is not torch.strided or value.is_quantized or value.is_meta:
                raise TypeError(f"{place} is a {value.layout} tensor on {value.device}; only dense ones are stored")
            dense = value.detach().cpu().resolve_conj().resolve_neg().contiguous()
            storage = dense.untyped_storage().data_ptr()
            name = str(len(self.tensors))
            # safetensors refuses two tensors of one storage
            self.tensors[name] = dense.clone() if storage in self.storages else dense
            self.storages.add(storage)
            return {"tensor": name}
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise TypeError(f"{place} is an object array; store its parts as plain arrays")
        if isinstance(value, np.generic):
            self.arrays.append(array)
            return {"scalar": len(self.arrays) - 1}
        if array.nbytes >= OWN_FILE_BYTES:
            name = f"array-{len(self.own):05d}.npy"
            self.own[name] = array
            return {"own": name}
        self.arrays.append(array)
        return {"array": len(self.arrays) - 1}


@dataclass(frozen=True)
class _Unpacking:
    tensors: Mapping[str, torch.Tensor]
    arrays: list[np.ndarray[Any, Any]]
    own: Mapping[str, np.ndarray[Any, Any]]

    def unpack(self, node: Any) -> Any:
        if isinstance(node, list):
            return [self.unpack(v) for v in node]
        if not isinstance(node, dict):
            return node
        ((kind, value),) = node.items()
        if kind == "dict":
            return {k: self.unpack(v) for k, v in value.items()}
        if kind == "tuple":
            return tuple(self.unpack(v) for v in value)
        if kind in ("int", "float"):
            return int(value, 16) if kind == "int" else float(value)
        if kind == "scalar":
            return self.arrays[value][()]
        sources: dict[str, Any] = {"tensor": self.tensors, "array": self.arrays, "own": self.own}
        return sources[kind][value]


def _write(folder: Path, step: int, document: Any, packing: _Packing) -> Path:
    path = folder / f"step-{step:012d}"
    temporary = folder / f".tmp-write-{path.name}-{secrets.token_hex(8)}"  # a name that nobody can foresee
    temporary.mkdir()
    try:
        _fill(temporary, step, document, packing)
        if os.path.lexists(path):
            # A folder cannot be replaced in one step; the old one stays loadable under its second name meanwhile.
            aside = folder / f"{path.name}.replaced"
            _drop(aside)
            os.rename(path, aside)
        os.rename(temporary, path)
    except Exception:
        shutil.rmtree(temporary, ignore_errors=True)  # on a full disk it would keep the room that is missing
        raise
    _sync(folder)
    _drop(folder / f"{path.name}.replaced")
    return path


def _fill(temporary: Path, step: int, document: Any, packing: _Packing) -> None:
    if packing.tensors:
        save_file(packing.tensors, temporary / _TENSORS)
        _sync(temporary / _TENSORS)
    if packing.arrays:
        with _durable(temporary / _ARRAYS) as file:
            for array in packing.arrays:
                np.save(file, array, allow_pickle=False)
    for name, array in packing.own.items():
        with _durable(temporary / name) as file:
            np.save(file, array, allow_pickle=False)
    with _durable(temporary / STATE) as file:
        file.write(json.dumps(document, allow_nan=False).encode())
    with _durable(temporary / MANIFEST) as file:
        files = {p.name: fingerprint(p) for p in sorted(temporary.iterdir()) if p.name != MANIFEST}
        body = {
            "format": FORMAT_NAME,
            "version": FORMAT_VERSION,
            "step": step,
            "libraries": _versions(),
            "files": files,
        }
        file.write(signed(body))
    _sync(temporary)


@contextlib.contextmanager
def _durable(path: Path) -> Iterator[IO[bytes]]:
    with open(path, "xb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@functools.cache
def _versions() -> dict[str, str]:
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "safetensors")}
    return {"neuralq": importlib.metadata.version("neuralq"), "torch": str(torch.__version__), **versions}


def _read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """No path that is not UTF-8 is opened by safetensors, and the name of a folder need not be; bytes it reads."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return load_bytes(path.read_bytes())
    return load_file(path)


def _read_arrays(path: Path) -> list[np.ndarray[Any, Any]]:
    size = path.stat().st_size
    arrays = []
    with open(path, "rb") as file:
        while file.tell() < size:
            arrays.append(np.lib.format.read_array(file, allow_pickle=False))
    return arrays


def _prune(folder: Path, newest: Path, keep: int) -> None:
    """Deletes our checkpoints that are older than the last ``keep`` whole ones, and nothing that is not ours."""
    num_whole = 1
    for path in candidates(folder):
        if path == newest:
            continue
        try:
            if num_whole >= keep:
                read_manifest(path)
                _drop(path)
            else:
                verified(path)
                num_whole += 1
        except CheckpointError:
            continue


def _drop(path: Path) -> None:
    """Renamed before it is deleted, so that a half-deleted checkpoint never looks like a damaged one."""
    if path.is_symlink():  # never what it leads to
        path.unlink()
    elif path.exists():
        doomed = path.parent / f".tmp-drop-{path.name}-{secrets.token_hex(8)}"
        os.rename(path, doomed)
        shutil.rmtree(doomed)
