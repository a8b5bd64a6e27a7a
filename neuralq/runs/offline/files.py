"""Where recorded experience lies: files of arrays, and data sets of Minari's."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from neuralq.checks import check_fits
from neuralq.runs.folder.files import replacing
from neuralq.runs.offline.minari_files import read_minari
from neuralq.runs.offline.recorded import LAYOUT, Recorded, recorded_from

__all__ = ["read_recorded", "write_recorded"]

_MINARI = "minari:"
_OTHER_NAMES = {"terminals": "terminations", "timeouts": "truncations"}


def read_recorded(name: str) -> Recorded:
    """The data set of this name: a file of arrays, or "minari:ID" (extra minari).

    Raises:
        ValueError: if it cannot be read, or is of another layout, with the one that is wanted.
        MissingExtra: for one of Minari's, if that is not installed.
    """
    if name.startswith(_MINARI):
        return read_minari(name.removeprefix(_MINARI))
    if not name.endswith(".npz"):
        raise ValueError(f"a data set is minari:ID or a file.npz, got {name!r}")
    try:
        with zipfile.ZipFile(name) as file:
            check_fits(f"the data set {name}", sum(one.file_size for one in file.infolist()), "take a part of it")
        with np.load(name, allow_pickle=False) as file:
            arrays = {_OTHER_NAMES.get(key, key): file[key] for key in file.files}
    except (OSError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"cannot read the data set {name}: {error}; {LAYOUT}") from error
    except ValueError as error:
        told = "it holds Python objects, which are never loaded" if "pickle" in str(error) else str(error)
        raise ValueError(f"cannot read the data set {name}: {told}; {LAYOUT}") from error
    try:
        return recorded_from(arrays)
    except ValueError as error:
        raise ValueError(f"the data set {name}: {error}") from error


def write_recorded(path: str | Path, data: Recorded) -> None:
    """Leave a record in a file, in one step.

    Example:
        >>> import tempfile
        >>> data = Recorded(np.arange(2.0), np.zeros(2, int), np.ones(2), np.array([False, True]), np.zeros(2, bool))
        >>> write_recorded(path := tempfile.mkdtemp() + "/data.npz", data)
        >>> read_recorded(path).sha256() == data.sha256()
        True
    """
    with replacing(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **data.arrays())  # type: ignore[arg-type]  # its flag is none of our names
