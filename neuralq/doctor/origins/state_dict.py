"""Weights alone: a state dict of PyTorch, ``.safetensors`` or ``.npz``, of a class or a plain stack."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from neuralq.checks import check_module_name
from neuralq.doctor.networks import fill, stack
from neuralq.doctor.origins.cleanrl import of_state
from neuralq.doctor.origins.record import Origin
from neuralq.doctor.subject import Subject, of_network
from neuralq.doctor.weights import CannotLoad, plain_bytes, read_arrays, read_safetensors, read_state

__all__ = ["STATE_DICT"]

_SUFFIXES = (".pth", ".pt", ".bin", ".ckpt", ".safetensors", ".npz")


def _load(path: Path, net: str | None, env: Any) -> Subject:
    raw, what = plain_bytes(path), str(path)
    state: Mapping[Any, Any]
    if path.suffix == ".safetensors":
        state = read_safetensors(raw, what)
    elif path.suffix == ".npz":
        state = {
            name: torch.from_numpy(array)
            for name, array in read_arrays(raw, what).items()
            if array.dtype.kind in "fiub"
        }
    else:
        state = read_state(raw, what)
    if net is None and ("model_weights" in state or any(str(key).startswith("network.") for key in state)):
        return of_state(state, path)
    tensors = {str(key): value for key, value in state.items() if isinstance(value, Tensor)}
    if len(tensors) < len(state):
        other = next(key for key, value in state.items() if not isinstance(value, Tensor))
        raise CannotLoad(
            f"{what}: {other!r} is no tensor, so this is no state dict; if it is a checkpoint, save the part that "
            f"is one: "
            "torch.save(checkpoint['model'], 'weights.pth')"
        )
    if net is not None:
        return of_network(fill(_made(net), tensors, what), f"{net} ({path.name})")
    return of_network(stack(_without_prefix(tensors), what), f"a plain stack of layers ({path.name})")


def _without_prefix(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The names after what all of them begin with, as in ``q_net.0.weight``."""
    heads = {key.rpartition(".")[0].rpartition(".")[0] for key in tensors}
    head = f"{heads.pop()}." if len(heads) == 1 else ""
    return {key.removeprefix(head) if head != "." else key: value for key, value in tensors.items()}


def _made(net: str) -> nn.Module:
    """The user's own network: "module:Class", called without arguments. Its code is theirs, and they named it."""
    module, colon, name = net.partition(":")
    if not colon:
        raise CannotLoad(
            f"--net must be 'module:Class', got {net!r}; a class or function that is called without arguments"
        )
    try:
        check_module_name("the network", module, net)
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        made = found()
    except Exception as error:
        raise CannotLoad(
            f"cannot make the network {net!r}: {type(error).__name__}: {error}; --net names a class or function "
            f"that is "
            "called without arguments"
        ) from error
    if not isinstance(made, nn.Module):
        raise CannotLoad(f"--net {net} must make a torch.nn.Module, and made {type(made).__name__}")
    return made


STATE_DICT = Origin("a state dict", lambda path: path.suffix in _SUFFIXES and path.is_file(), _load, place=3)
