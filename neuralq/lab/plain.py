"""Results as JSON takes them: what is infinite, or no number, is None, which stands for unlimited or not known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["fields_of", "plain"]


def plain(value: Any) -> Any:
    """A value made of text, truth values, lists, mappings and finite numbers; a complex number is a pair.

    Example:
        >>> plain({"bound": float("inf"), "factors": np.array([0.5 + 1j]), "steps": (1, 2)})
        {'bound': None, 'factors': [[0.5, 1.0]], 'steps': [1, 2]}
    """
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: plain(one) for name, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def fields_of(one: object, *names: str) -> dict[str, Any]:
    """Attributes of an object by name, each as `plain` gives it.

    Example:
        >>> fields_of(1j, "real", "imag")
        {'real': 0.0, 'imag': 1.0}
    """
    return {name: plain(getattr(one, name)) for name in names}
