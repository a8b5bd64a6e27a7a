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
from typing import Any, Literal, Protocol

import numpy as np

from neuralq.lab.linear.process import Process
from neuralq.lab.linear.sampling import SampledTransition
from neuralq.lab.plain import fields_of
from neuralq.types import Floats

__all__ = [
    "LAMBDA",
    "LARGEST",
    "RIDGE",
    "STEP_RATIO",
    "Expected",
    "Method",
    "Option",
    "Options",
    "Piece",
    "SampledUpdate",
    "flow",
]

Options = Mapping[str, float]
"""Values of a method's options, all of them, as `Method.checked` gives them."""
Piece = tuple[Floats, Floats]  # M [n, n] and c [n] of θ ← M θ + c
LARGEST = 1e100
"""What every option stays below: its square is still a finite number."""


@dataclass(frozen=True)
class Option:
    """A number that a method takes: its default, its useful range, and what is accepted.

    Args:
        default: its value where none is given.
        low: left end of a slider.
        high: right end.
        label: its symbol and what it is.
        spacing: ``"linear"``, ``"log"`` (accepted is every number above 0) or ``"whole"`` (whole numbers only).
        most: largest value accepted; ``high`` where None.
        least: smallest value accepted, of numbers that are not spaced as ``"log"``; ``low`` where None.
        special: a value outside the range with a meaning of its own.
        special_label: that meaning.

    Example:
        >>> Option(0.01, 1e-4, 1.0, "τ", "log").accepts(1e-9), Option(4, 1, 64, "n", "whole").accepts(1.5)
        (True, False)
    """

    default: float
    low: float
    high: float
    label: str
    spacing: Literal["linear", "log", "whole"] = "linear"
    most: float | None = None
    least: float | None = None
    special: float | None = None
    special_label: str = ""

    @property
    def largest(self) -> float:
        """The largest value accepted."""
        return self.high if self.most is None else self.most

    @property
    def _smallest(self) -> float:
        return self.low if self.least is None else self.least

    def accepts(self, value: float) -> bool:
        """Whether the option may have this value."""
        if self.special is not None and value == self.special:
            return True
        inside = 0 < value <= self.largest if self.spacing == "log" else self._smallest <= value <= self.largest
        return inside and (self.spacing != "whole" or value == int(value))

    @property
    def range_text(self) -> str:
        """The values accepted, in words."""
        kind, low = "a whole number" if self.spacing == "whole" else "a number", f"{self._smallest:g}"
        if self.spacing == "log":
            text = "above 0" if self.largest >= LARGEST else f"above 0, at most {self.largest:g}"
        else:
            text = f"of at least {low}" if self.largest >= LARGEST else f"from {low} to {self.largest:g}"
        return f"{kind} {text}" + ("" if self.special is None else f" (or {self.special:g} for {self.special_label})")

    def plain(self) -> dict[str, Any]:
        """What a slider needs to know, for JSON."""
        return fields_of(self, "label", "low", "high", "spacing", "special", "special_label")


LAMBDA = Option(0.0, 0.0, 1.0, "λ, trace")
RIDGE = Option(0.0, 0.0, 2.0, "η, penalty on the weights", most=LARGEST)
STEP_RATIO = Option(10.0, 1e-2, 1e3, "β/α, second time scale", "log", LARGEST)


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


class SampledUpdate(Protocol):
    """The sampled update of one method for N seeds at once."""

    theta: Floats
    """``[N, size]``, the weights w first; changed in place."""

    def update(self, sample: SampledTransition, step_size: float) -> None:
        """Learn from one transition per seed."""
        ...


@dataclass(frozen=True, eq=False)
class Method:
    """A method with its expected update, its sampled update and its options.

    Args:
        name: one word that commands and files use, such as ``"td"``.
        title: how people call it.
        source: author and year.
        options: every option by name.
        expected: ``expected(process, options) -> Expected``; None where there is none to derive.
        learner: ``learner(process, w0 [N, d], options) -> SampledUpdate``; None for methods that solve instead.
        rows: what it learns: ``"any"``, or ``"pairs"`` for methods whose update looks at other actions.
        remembers: whether, with these options, an update depends on more than the present transition and θ (traces,
            follow-on, counters). Second moments are exact only where it does not.
        note: a caveat in a sentence, shown beside its results.
        memory_growth: ``memory_growth(process, options)``: growth per step of the mean square of what it remembers
            along a chain, where runs scatter by that; None elsewhere.
        place: where it stands in lists; those of one number by name.
    """

    name: str
    title: str
    source: str
    options: Mapping[str, Option]
    expected: Callable[[Process, Options], Expected] | None
    learner: Callable[[Process, Floats, Options], SampledUpdate] | None
    rows: str = "any"
    remembers: Callable[[Options], bool] = lambda options: options.get("lambda_", 0.0) > 0
    note: str = ""
    memory_growth: Callable[[Process, Options], float] | None = None
    place: int = 100

    @property
    def defaults(self) -> dict[str, float]:
        """Every option with its default."""
        return {name: option.default for name, option in self.options.items()}

    def checked(self, given: Options) -> Options:
        """The defaults with what was given in their place.

        Raises:
            ValueError: an option that the method does not have, or a value out of its range.
        """
        for name, value in given.items():
            if name not in self.options:
                raise ValueError(f"{self.name} has no option {name!r}; it has {', '.join(self.options) or 'none'}")
            if not self.options[name].accepts(value):
                raise ValueError(f"{name} must be {self.options[name].range_text}, got {value!r}")
        return {**self.defaults, **given}

    def plain(self) -> dict[str, Any]:
        """What it is, for JSON."""
        return {**fields_of(self, "name", "title", "source", "rows", "note"), "options": self.defaults}
