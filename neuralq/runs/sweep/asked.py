"""What a sweep is asked for: options that all runs share, axes along which they differ, and seeds.

    env: CartPole-v1
    total_steps: 5000
    learning_rate: [1e-4, 3e-4, 1e-3]                                a list: one value after the other
    num_envs: {from: 4, to: 16, step: 4}                             a range: 4, 8, 12, 16
    lambda: {from: 0.5, to: 0.9, count: 3}                           three values, equally far from each other
    seeds: 8                                                         0 to 7; or a list, or a range

Names are those of `neuralq.train`'s keywords. Of options whose value is a list itself (hidden, wrappers, rules) a list
is one value, and a list of lists several: ``hidden: [64, 64]`` is one network, ``hidden: [[64, 64], [32]]`` are two.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neuralq.checks import check_whole

__all__ = ["Asked", "cell_name", "check_seeds", "read_asked"]

_MOST_RUNS = 10_000_000
_RANGE = {"from", "to", "step", "count", "scale"}
_LISTS = {"hidden", "wrappers", "rules"}


@dataclass(frozen=True)
class Asked:
    """What a sweep is asked for.

    Args:
        base: options that all runs share, by name.
        axes: the values of each option along which runs differ, by name; empty where seeds are all there is.
        seeds: of which each combination of values has a run.
    """

    base: dict[str, Any]
    axes: dict[str, list[Any]] = field(default_factory=dict)
    seeds: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        """Raises ValueError for what no sweep can be."""
        check_seeds(list(self.seeds))
        for name, values in self.axes.items():
            words = [json.dumps(value, sort_keys=True) for value in values]
            if not words or len(set(words)) < len(words):
                raise ValueError(f"{name} needs one value or more, each named once, got {values!r}")
            if name in self.base:
                raise ValueError(f"{name} is given twice, for all runs and as an axis; leave one out")
        if (number := self.num_cells * len(self.seeds)) > _MOST_RUNS:
            raise ValueError(f"a sweep has at most {_MOST_RUNS:,} runs, got {number:,}; take fewer values or seeds")

    @property
    def num_cells(self) -> int:
        """Combinations of values."""
        return int(np.prod([len(values) for values in self.axes.values()], dtype=np.int64))

    def cells(self) -> Iterator[dict[str, Any]]:
        """Every combination of values, the last axis fastest; one without options where there are no axes."""
        for values in itertools.product(*self.axes.values()):
            yield dict(zip(self.axes, values, strict=True))

    def joined(self, other: Asked) -> Asked:
        """The same with the values and seeds of another one that differs in nothing else.

        Raises:
            ValueError: if it differs in more, which would make another sweep of it.

        Example:
            >>> Asked({}, {"gamma": [0.9]}, (0,)).joined(Asked({}, {"gamma": [0.9, 0.99]}, (0, 1))).axes
            {'gamma': [0.9, 0.99]}
        """
        here, there = _plain(self.base), _plain(other.base)
        names = [n for n in {**here, **there} if here.get(n) != there.get(n)]
        names += sorted(self.axes.keys() ^ other.axes.keys())
        if names:
            told = ", ".join(f"{n}: {_told(self, n)} there, {_told(other, n)} here" for n in dict.fromkeys(names))
            raise ValueError(
                f"it was asked for otherwise ({told}); values and seeds may be added to a sweep, all else makes "
                "another one: choose another folder"
            )
        axes = {name: _union(values, other.axes[name]) for name, values in self.axes.items()}
        return Asked(self.base, axes, tuple(_union(self.seeds, other.seeds)))


def _told(asked: Asked, name: str) -> str:
    return repr(asked.axes.get(name, asked.base.get(name, "nothing")))


def _plain(value: Any) -> Any:
    """As it is after it was kept in a file."""
    return json.loads(json.dumps(value))


def _union(first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    known = [_plain(value) for value in first]
    return [*first, *(value for value in second if _plain(value) not in known)]


def check_seeds(seeds: Any) -> None:
    """They become names of folders, so nothing but whole numbers will do.

    Raises:
        ValueError: for anything but a list of them, each named once.
    """
    for seed in seeds if isinstance(seeds, list) else ():
        if not isinstance(seed, int):
            raise ValueError(f"seed must be a whole number, got {seed!r}")
        check_whole("seed", seed, 0)
    if not isinstance(seeds, list) or not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"a sweep needs one seed or more, each named once, got {seeds!r}")


def read_asked(content: Mapping[str, Any]) -> Asked:
    """What a file asks for.

    Args:
        content: options by name; each a value, a list or a range.

    Raises:
        ValueError: for what no sweep can be, with the option.

    Example:
        >>> asked = read_asked({"env": "CartPole-v1", "lambda": [0.5, 0.9], "seeds": 2})
        >>> asked.base, asked.axes, asked.seeds
        ({'env': 'CartPole-v1'}, {'lambda_': [0.5, 0.9]}, (0, 1))
    """
    base: dict[str, Any] = {}
    axes: dict[str, list[Any]] = {}
    for name, value in _keywords(content):
        if name in base or name in axes:
            raise ValueError(f"{name} is given twice; leave one out")
        if name in ("seed", "seeds"):
            continue
        if isinstance(value, Mapping) and value.keys() <= _RANGE and {"from", "to"} <= value.keys():
            axes[name] = _range_of(name, value)
        elif isinstance(value, list) and (name not in _LISTS or all(isinstance(one, list) for one in value)):
            axes[name] = value
        else:
            base[name] = value
    if {"seed", "seeds"} <= content.keys():
        raise ValueError("seed and seeds are given; leave one out")
    return Asked(base, axes, _seeds_of(content.get("seeds", [content.get("seed", 0)])))


def _keywords(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names as Python has them; settings of the learner, which may stand in a part of their own, flat."""
    from neuralq.runs.recipe.config import RunConfig  # brings PyTorch, which telling how far a sweep is does not need

    learner = str(content.get("learner", RunConfig.learner))
    for name, value in content.items():
        text = re.sub(r"(^|\.)lambda$", r"\1lambda_", str(name).replace("-", "_"))
        if text == learner and isinstance(value, Mapping):
            yield from _keywords(value)
        else:
            yield text.removeprefix(f"{learner}."), value


def _seeds_of(value: Any) -> tuple[int, ...]:
    if isinstance(value, Mapping):
        value = _range_of("seeds", value)
    if isinstance(value, int) and not isinstance(value, bool):
        check_whole("seeds", value)
        if value > _MOST_RUNS:
            raise ValueError(f"a sweep has at most {_MOST_RUNS:,} runs, got {value:,} seeds; take fewer")
        value = list(range(value))
    check_seeds(value)
    return tuple(value)


def _range_of(name: str, given: Mapping[str, Any]) -> list[Any]:
    """The values of a range, both ends included.

    Raises:
        ValueError: if it is none.
    """
    low, high, step, count = (given.get(key) for key in ("from", "to", "step", "count"))
    scale = given.get("scale", "linear")
    numbers = [value for value in (low, high, step, count) if value is not None]
    told = f"{name} must be a range like {{from: 4, to: 16, step: 4}} or {{from: 1e-4, to: 1e-2, count: 5, scale: log}}"
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in numbers):
        raise ValueError(f"{told}, got {dict(given)!r}")
    if scale not in ("linear", "log") or given.keys() - _RANGE or low is None or high is None:
        raise ValueError(f"{told}, got {dict(given)!r}")
    if (step is None) == (count is None) and not (step is None and all(isinstance(v, int) for v in (low, high))):
        raise ValueError(f"{told}, got {dict(given)!r}")
    if count is not None:
        check_whole(f"count of {name}", count)
        if scale == "log" and min(low, high) <= 0:
            raise ValueError(f"{name}: a range with scale log lies above 0, got {dict(given)!r}")
        spaced = np.geomspace(low, high, count) if scale == "log" else np.linspace(low, high, count)
        values = [float(f"{value:.6g}") for value in spaced]  # as people would write them
        whole = all(isinstance(value, int) for value in (low, high)) and all(value.is_integer() for value in values)
        return list(map(int, values)) if whole else values
    step = 1 if step is None else step
    if scale == "log" or not step * (high - low) >= 0 or step == 0:
        raise ValueError(f"{told}, got {dict(given)!r}")
    number = int((high - low) / step + 1e-9) + 1
    if number > _MOST_RUNS:
        raise ValueError(f"{name} has {number:,} values; take fewer")
    return [
        low + i * step if isinstance(low + i * step, int) else float(f"{low + i * step:.6g}") for i in range(number)
    ]


def cell_name(options: Mapping[str, Any]) -> str:
    """The name of the folder of a combination of values: what they are, as far as a name can say it, and their hash.

    Example:
        >>> cell_name({"learning_rate": 0.001, "hidden": [64, 64]})
        'learning_rate=0.001-hidden=64-64-d0a7206d'
    """
    words = ",".join(f"{name}={json.dumps(value, ensure_ascii=False)}" for name, value in options.items())
    slug = re.sub(r"[^A-Za-z0-9._=,+]+", "-", re.sub(r"[\"\[\]{} ]", "", words).replace(",", "-"))[:80].strip(".-")
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:8]
    return f"{slug}-{digest}"
