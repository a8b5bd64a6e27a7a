"""What a method of the lab consists of: its expected update as an affine map, and its sampled update over many seeds.

Both act on θ = (w, h, ...): the weights that make the values come first, what the method needs besides follows. The
expected update is

    θ ← M(α) θ + c(α),   for most methods   M = I − α G,  c = α g,

derived by hand from the problem; the sampled one is the textbook's, one transition per seed. Neither is made from the
other, so that the mean of the second over all transitions can be held against the first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import Sample
from neuralq.types import Floats

__all__ = ["Expected", "Learner", "Method", "Options", "Piece", "flow"]

Options = Mapping[str, float]
_LARGEST = 1e100
"""What every option stays below: its square is still a finite number."""
_RANGES = {"lambda_": (0, 1), "phi": (0, 1), "eta": (0, _LARGEST), "num_steps": (0, 100_000), "period": (0, 1e9)}
"""What options of a name mean is the same in every method, and so are their ranges; the rest is up to the method."""
Piece = tuple[Floats, Floats]  # M [n, n] and c [n] of θ ← M θ + c


@dataclass(frozen=True, eq=False)
class Expected:
    """The expected update θ ← M θ + c.

    Args:
        size: entries of θ; the first d are w.
        at: ``at(theta, step_size) -> (M, c)``: the affine piece that holds at θ.
        generator: ``(G, g)`` where M = I − α G and c = α g for every α; None for methods that are not such a flow.
        linear: whether the same piece holds at every θ.
        start: ``start(w0) -> theta0``; by default everything after w is 0.
        updates_per_sweep: sampled updates that one application stands for: the period of a hard target network.
    """

    size: int
    at: Callable[[Floats, float], Piece]
    generator: tuple[Floats, Floats] | None = None
    linear: bool = True
    start: Callable[[Floats], Floats] | None = None
    updates_per_sweep: int = 1

    def initial(self, w0: Floats) -> Floats:
        """θ at the beginning, ``[d] -> [size]``."""
        if self.start is not None:
            return self.start(w0)
        return np.concatenate([w0, np.zeros(self.size - len(w0))])


def flow(G: Floats, g: Floats) -> Expected:
    """The expected update θ ← θ + α (g − G θ).

    Example:
        >>> M, c = flow(np.array([[2.0]]), np.array([1.0])).at(np.zeros(1), 0.1)
        >>> M.tolist(), c.tolist()
        ([[0.8]], [0.1])
    """
    return Expected(len(g), lambda theta, step_size: (np.eye(len(g)) - step_size * G, step_size * g), (G, g))


class Learner(Protocol):
    """The sampled update of one method for N seeds at once."""

    theta: Floats
    """``[N, size]``, the weights w first; changed in place."""

    def update(self, sample: Sample, step_size: float) -> None:
        """Learn from one transition per seed."""
        ...


@dataclass(frozen=True, eq=False)
class Method:
    """A method with its expected update, its sampled update and its options.

    Args:
        name: one word that commands and files use, such as ``"td"``.
        title: how people call it.
        source: author and year.
        options: every option with its default.
        expected: ``expected(process, options) -> Expected``; None where there is none to derive.
        learner: ``learner(process, w0 [N, d], options) -> Learner``; None for methods that solve instead of sampling.
        rows: what it learns: ``"any"``, or ``"pairs"`` for methods whose update looks at other actions.
        remembers: whether, with these options, an update depends on more than the present transition and θ (traces,
            follow-on, counters). Second moments are exact only where it does not.
        note: a caveat in a sentence, shown beside its results.
    """

    name: str
    title: str
    source: str
    options: Options
    expected: Callable[[Process, Options], Expected] | None
    learner: Callable[[Process, Floats, Options], Learner] | None
    rows: str = "any"
    remembers: Callable[[Options], bool] = lambda options: False
    note: str = ""

    def checked(self, given: Options) -> Options:
        """The defaults with what was given in their place.

        Raises:
            ValueError: an option that the method does not have, or a value that none of that name may have.
        """
        unknown = [name for name in given if name not in self.options]
        if unknown:
            raise ValueError(
                f"{self.name} has no option {unknown[0]!r}; it has {', '.join(self.options) or 'none'}"
            )  # fmt: skip
        for name, value in given.items():
            low, high = _RANGES.get(name, (-_LARGEST, _LARGEST))
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {value!r}")
        return {**self.options, **given}
