"""Whether a checkpoint is the one that was written: its manifest, and the SHA-256 of every file.

Without torch, so that whoever only keeps or moves checkpoints need not load it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuralq.runs.folder.files import RunFolderError, open_regular, parse_json, read_regular

__all__ = [
    "FORMAT_NAME",
    "FORMAT_VERSION",
    "MANIFEST",
    "STATE",
    "CheckpointError",
    "candidates",
    "fingerprint",
    "newest_whole",
    "read_manifest",
    "signed",
    "step_of",
    "verified",
]

FORMAT_NAME = "neuralq-checkpoint"
FORMAT_VERSION = 1
MANIFEST, STATE = "manifest.json", "state.json"
_FILE_NAME = re.compile(r"state\.json|tensors\.safetensors|arrays\.npy|array-[0-9]{5}\.npy")
_FOLDER_NAME = re.compile(r"step-([0-9]{12,18})(\.replaced)?")


class CheckpointError(RuntimeError):
    """A checkpoint could not be written or must not be read; the message says which one, why, and the way out."""


def candidates(folder: Path) -> list[Path]:
    """Newest first; of two with one step, the one that replaced the other first."""
    found = [(int(m[1]), m[2] is None, p) for p in folder.iterdir() if (m := _FOLDER_NAME.fullmatch(p.name))]
    return [p for _, _, p in sorted(found, key=lambda f: f[:2], reverse=True)]


def step_of(path: Path) -> int:
    """The step that the name of a checkpoint's folder says.

    Example:
        >>> step_of(Path("step-000000012288"))
        12288
    """
    named = _FOLDER_NAME.fullmatch(path.name)
    assert named is not None
    return int(named[1])


def newest_whole(folder: Path) -> Path | None:
    """The newest checkpoint in a folder that is whole; None where there is none."""
    try:
        found = candidates(folder)
    except OSError:  # there is no such folder, or no longer
        return None
    for path in found:
        try:
            verified(path)
        except CheckpointError:
            continue
        return path
    return None


def fingerprint(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    with open(open_regular(path, os.O_RDONLY), "rb") as file:
        return {"bytes": os.fstat(file.fileno()).st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def signed(body: Mapping[str, Any]) -> bytes:
    """The manifest vouches for the other files; its own digest, over its other members, vouches for it."""
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    return json.dumps({**body, "sha256": digest}, indent=1).encode()


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint, which vouches for itself and not yet for the files that it names.

    Raises:
        CheckpointError: if it cannot be read, was altered, or was written by a newer neuralq.
    """
    try:
        raw = read_regular(path / MANIFEST)
        manifest = parse_json(raw)
    except (OSError, ValueError, RunFolderError) as error:
        raise CheckpointError(f"{path} is no whole checkpoint: its {MANIFEST} cannot be read ({error})") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT_NAME:
        raise CheckpointError(f"{path} was not written by neuralq: its {MANIFEST} is of another format")
    version = manifest.get("version")
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise CheckpointError(
            f"{path} has format version {version}, and this neuralq reads up to {FORMAT_VERSION}; upgrade neuralq"
        )
    if raw != signed({k: v for k, v in manifest.items() if k != "sha256"}):
        raise CheckpointError(f"{path} is damaged: its {MANIFEST} does not match its own SHA-256")
    return manifest


def verified(path: Path) -> tuple[int, dict[str, Any]]:
    """Step and files of a checkpoint whose every byte is the one that was written."""
    manifest = read_manifest(path)
    step, files = manifest.get("step"), manifest.get("files")
    if type(step) is not int or not isinstance(files, dict) or STATE not in files:
        raise CheckpointError(f"{path} has a malformed {MANIFEST}")
    if (named := _FOLDER_NAME.fullmatch(path.name)) and int(named[1]) != step:
        raise CheckpointError(f"{path} holds step {step}: the folder was renamed")
    for name, expected in files.items():
        if not _FILE_NAME.fullmatch(name):  # also keeps a forged manifest from pointing outside the folder
            raise CheckpointError(f"{path} lists the file {name!r}, which is not a checkpoint's")
        try:
            got = fingerprint(path / name)
        except (OSError, RunFolderError) as error:
            raise CheckpointError(f"{path} is incomplete: {name} cannot be read ({error})") from error
        if got != expected:
            raise CheckpointError(f"{path} is damaged: {name} is not what was written (size or SHA-256 differs)")
    return step, files
