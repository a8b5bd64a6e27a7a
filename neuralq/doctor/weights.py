"""Files of weights, opened so that nothing in them is ever executed. The only module that may call ``torch.load``.

A ``.pth`` is a zip archive with a pickle in it, and a pickle is a program. Four walls stand before it:

1. *Archives* are bounded before a byte is unpacked: number, names and sizes of members, and how far they are packed.
2. The *program* is read, not run: every name that it asks for must be one that a state dict needs (`_ALLOWED`), and of
   its instructions only those that ``torch.save`` writes are let through.
3. The archive is *written anew* from the members that were looked at, so that PyTorch sees what was looked at and
   nothing else, and read with ``weights_only=True`` (sound from torch 2.10; CVE-2026-24747 before).
4. *Tensors* are views until they are copied; one of more entries than `MOST_ENTRIES` is refused before that.
"""

from __future__ import annotations

import io
import pickletools
import posixpath
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuralq.runs.folder.files import RunFolderError, read_regular

__all__ = [
    "MOST_ENTRIES", "CannotLoad", "plain_bytes", "read_arrays", "read_members", "read_safetensors", "read_state",
]  # fmt: skip

MOST_ENTRIES = 2**31
"""Entries of a tensor, at most."""
_MOST_BYTES = 2**30
"""Of a member of an archive, at most."""
_MOST_PACKED = 200
"""How many times smaller a member may be in the archive, at most."""
_MOST_MEMBERS = 10_000
_MOST_PROGRAM = 2**24
"""Bytes of a pickle, at most: it holds names and shapes, no weights."""

_ALLOWED = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    "torch Size",
    *(f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char")),
    *("torch ByteStorage", "torch BoolStorage"),
}
_REFUSED_OPCODES = {
    *("STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID"),
    *("NEXT_BUFFER", "READONLY_BUFFER", "BYTEARRAY8"),
}

EXPORT = "import torch\ntorch.save(model.state_dict(), 'weights.pth')"
"""What turns a model in memory into a file that can be loaded without running code."""


class CannotLoad(ValueError):
    """A file holds no value function that can be rebuilt; the message says what does not fit and what to pass."""


def plain_bytes(path: Path) -> bytes:
    """What is in a regular file of at most 4 GiB.

    Raises:
        CannotLoad: if there is none, or it is larger.
    """
    try:
        if path.stat().st_size > 4 * _MOST_BYTES:
            raise CannotLoad(
                f"{path} has {path.stat().st_size:,} bytes, more than the 4 GiB that are read; export less"
            )
        return read_regular(path)
    except (OSError, RunFolderError) as error:
        raise CannotLoad(f"cannot read {path}: {error}; give the path of a saved agent") from error


def read_members(raw: bytes, wanted: Callable[[str], bool], what: str) -> dict[str, bytes]:
    """The members of a zip archive that are asked for, by name; all members are looked at before one is unpacked.

    Args:
        raw: the archive.
        wanted: whether a member is to be read.
        what: how errors call it.

    Raises:
        CannotLoad: it is no archive or a damaged one; a member is too large or packed too far, is named twice, or has a
            name that leads out of the archive.

    Example:
        >>> packed = io.BytesIO()
        >>> with zipfile.ZipFile(packed, "w") as archive:
        ...     archive.writestr("../stolen", "x")
        >>> read_members(packed.getvalue(), lambda name: True, "agent.zip")
        Traceback (most recent call last):
        neuralq.doctor.weights.CannotLoad: agent.zip has a member '../stolen', which leads out of it; ...
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            members = archive.infolist()
            _check_members(members, what)
            return {member.filename: archive.read(member) for member in members if wanted(member.filename)}
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, OSError, ValueError) as error:
        if isinstance(error, CannotLoad):
            raise
        raise CannotLoad(f"{what} is no whole zip archive ({error}); save the agent again") from error
    except Exception as error:  # zlib.error and its like, of a damaged stream
        raise CannotLoad(f"{what} is damaged ({type(error).__name__}: {error}); save the agent again") from error


def _check_members(members: list[zipfile.ZipInfo], what: str) -> None:
    ours = "a file that a library saved has none; do not trust it"
    names = [member.filename for member in members]
    if len(names) > _MOST_MEMBERS:
        raise CannotLoad(f"{what} has {len(names):,} members, at most {_MOST_MEMBERS:,} are read; {ours} of that many")
    if len(set(names)) < len(names):
        raise CannotLoad(f"{what} has two members of one name; {ours}")
    for member in members:
        name = member.filename
        if name.startswith("/") or "\\" in name or ":" in name or ".." in name.split("/"):
            raise CannotLoad(f"{what} has a member {name!r}, which leads out of it; {ours}")
        if member.file_size > _MOST_BYTES:
            raise CannotLoad(f"{what} has a member {name!r} of {member.file_size:,} bytes, more than 1 GiB; {ours}")
        if member.file_size > _MOST_PACKED * max(member.compress_size, 1) and member.file_size > 4096:
            raise CannotLoad(f"{what} has a member {name!r} that unpacks to over {_MOST_PACKED} times its size; {ours}")
    if sum(member.file_size for member in members) > 4 * _MOST_BYTES:
        raise CannotLoad(f"{what} unpacks to more than 4 GiB; {ours}")


def read_state(raw: bytes, what: str) -> dict[Any, Any]:
    """The dictionary in a ``.pth`` file, by walls 1 to 4.

    Args:
        raw: the file.
        what: how errors call it.

    Returns:
        What the dictionary holds: tensors, and plain values.

    Raises:
        CannotLoad: it is damaged, holds a whole model or anything else that only running code could rebuild, or a
            tensor of too many entries.
    """
    if not raw.startswith(b"PK"):
        raise CannotLoad(
            f"{what} is no archive as torch.save writes one since 1.6 (a bare pickle runs code when it is read); "
            f"load it "
            f"where you trust it, and save: {_one_line()}"
        )
    members = read_members(raw, _of_tensors, what)
    program = next((name for name in members if posixpath.basename(name) == "data.pkl"), None)
    if program is None:
        raise CannotLoad(f"{what} has no member data.pkl, as torch.save writes it; save again: {_one_line()}")
    _check_program(members[program], what)
    try:
        state = torch.load(_repacked(members), map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a damaged file makes of it
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CannotLoad(f"{what} cannot be read as weights ({first}); save again: {_one_line()}") from error
    if not isinstance(state, Mapping):
        raise CannotLoad(f"{what} holds a {type(state).__name__}, not a state dict; save again: {_one_line()}")
    _check_sizes(state, what)
    return dict(state)


def _of_tensors(name: str) -> bool:
    return posixpath.basename(name) in ("data.pkl", "version", "byteorder") or "/data/" in name


def _one_line() -> str:
    return EXPORT.replace("\n", "; ")


def _check_program(program: bytes, what: str) -> None:
    """Refuses a pickle that asks for more than a state dict needs; it is only read."""
    if len(program) > _MOST_PROGRAM:
        raise CannotLoad(f"{what} has a pickle of {len(program):,} bytes, more than weights need; save: {_one_line()}")
    try:
        for opcode, argument, _ in pickletools.genops(program):
            if opcode.name == "GLOBAL" and argument not in _ALLOWED:
                name = str(argument).replace(" ", ".")
                raise CannotLoad(
                    f"{what} asks for {name}, so it holds more than weights (a whole model, say), and reading it would "
                    f"run code; where you trust it, save its weights alone: {_one_line()}"
                )
            if opcode.name in _REFUSED_OPCODES:
                raise CannotLoad(
                    f"{what} has the pickle instruction {opcode.name}, which weights need not; {_one_line()}"
                )
            if isinstance(argument, int) and opcode.name.startswith(("BININT", "LONG", "INT")) and argument >= 2**40:
                raise CannotLoad(f"{what} holds a tensor of {argument:,} entries, more than any network has; refused")
    except CannotLoad:
        raise
    except Exception as error:  # no pickle at all
        raise CannotLoad(f"{what} has a damaged data.pkl ({error}); save again: {_one_line()}") from error


def _repacked(members: Mapping[str, bytes]) -> io.BytesIO:
    """A new archive of these members."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(f"archive/{name.partition('/')[2]}", content)
    packed.seek(0)
    return packed


def _check_sizes(state: Mapping[Any, Any], what: str, depth: int = 3) -> None:
    for key, value in state.items():
        if isinstance(value, Tensor) and value.numel() > min(MOST_ENTRIES, _stored(value)):
            raise CannotLoad(
                f"{what}: {key!r} says that it has {value.numel():,} entries, and the file holds "
                f"{_stored(value):,}; refused"
            )
        if isinstance(value, Mapping) and depth:
            _check_sizes(value, f"{what}: {key!r}", depth - 1)


def _stored(value: Tensor) -> int:
    return value.untyped_storage().nbytes() // max(value.element_size(), 1)


def read_safetensors(raw: bytes, what: str) -> dict[str, Tensor]:
    """The tensors of a ``.safetensors`` file.

    Raises:
        CannotLoad: it is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(raw)
    except (SafetensorError, ValueError, KeyError) as error:
        raise CannotLoad(f"{what} is no whole safetensors file ({error}); save it again") from error


def read_arrays(raw: bytes, what: str) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays of an ``.npz`` file; arrays of objects, which would be pickles, are refused.

    Raises:
        CannotLoad: it is damaged, too large, or holds objects.
    """
    members = read_members(raw, lambda name: name.endswith(".npy"), what)
    found = {}
    for name, content in members.items():
        stream = io.BytesIO(content)
        try:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(stream)
            if int(np.prod(shape, dtype=object)) * dtype.itemsize > len(content):
                raise ValueError(f"shape {shape} does not fit its {len(content):,} bytes")
            stream.seek(0)
            found[name.removesuffix(".npy")] = np.lib.format.read_array(stream, allow_pickle=False)
        except (ValueError, EOFError, OSError, MemoryError, OverflowError) as error:
            raise CannotLoad(f"{what}: {name} cannot be read ({error}); save plain numbers with numpy.savez") from error
    return found
