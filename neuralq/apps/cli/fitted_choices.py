"""The worlds and regressors that ``neuralq lab fitted`` knows by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from neuralq.lab.fitted.regressors import (
    GridInterpolation,
    KernelSmoothing,
    LeastSquares,
    LocallyWeighted,
    NearestNeighbours,
    Regressor,
    StateAggregation,
    linear_features,
)
from neuralq.lab.plain import fields_of
from neuralq_envs.counterexamples.boyan_moore import car_on_the_hill, gridworld, puddle_world
from neuralq_envs.counterexamples.continuous import ContinuousModel

__all__ = ["REGRESSORS", "WORLDS", "FittedChoice", "fitted_table", "plain_choices"]


def _network(_: ContinuousModel, num_hidden: float) -> Regressor:
    from neuralq.lab.fitted.network import NetworkRegressor  # needs PyTorch

    return NetworkRegressor(int(num_hidden))


def _spacing(model: ContinuousModel, num_per_side: int) -> float:
    return float((model.high - model.low).mean()) / (num_per_side - 1)


@dataclass(frozen=True)
class FittedChoice:
    """A regressor that can be asked for by name, with the one number that it takes.

    Args:
        name: one word.
        title: what it is.
        source: author and year.
        make: the regressor for a world and the number.
        option: what the number is called; None if it takes none.
        default: the number, if none is given, for a world and points per side.
        most_points: points per side up to which its hat matrix fits a small machine.

    Example:
        >>> next(one for one in REGRESSORS if one.name == "nearest").regressor(gridworld(), 16, None)
        NearestNeighbours(num_neighbours=1, weighting='uniform')
    """

    name: str
    title: str
    source: str
    make: Callable[[ContinuousModel, float], Regressor]
    option: str | None = None
    default: Callable[[ContinuousModel, int], float] = lambda model, num_per_side: 0.0
    most_points: int = 60

    def regressor(self, model: ContinuousModel, num_per_side: int, number: float | None) -> Regressor:
        """The regressor for a world, with the given number or else the default."""
        return self.make(model, self.default(model, num_per_side) if number is None else number)


WORLDS: tuple[Callable[[], ContinuousModel], ...] = (gridworld, puddle_world, car_on_the_hill)
"""Makers of the problems."""

REGRESSORS = (
    FittedChoice("quadratic", "least squares on monomials of degree 2", "Boyan & Moore 1995",
                 lambda model, _: LeastSquares()),
    FittedChoice("linear", "least squares on 1 and the coordinates", "Gordon 1995",
                 lambda model, _: LeastSquares(linear_features)),
    FittedChoice("nearest", "mean of the nearest points: an averager", "Gordon 1995",
                 lambda model, number: NearestNeighbours(int(number)), "neighbours", lambda model, _: 1),
    FittedChoice("interpolation", "multilinear on a full grid: an averager", "Gordon 1995",
                 lambda model, _: GridInterpolation()),
    FittedChoice("aggregation", "one value per box: an averager", "Gordon 1995",
                 lambda model, number: StateAggregation(tuple(model.low), tuple(model.high), int(number)),
                 "boxes", lambda model, num_per_side: max(num_per_side // 2, 1)),
    FittedChoice("kernel", "mean under a Gaussian: an averager", "Nadaraya 1964; Watson 1964",
                 lambda model, number: KernelSmoothing(number), "bandwidth", _spacing, 40),
    FittedChoice("lwr", "a local line under a Gaussian", "Cleveland & Devlin 1988",
                 lambda model, number: LocallyWeighted(number), "bandwidth", _spacing, 40),
    FittedChoice("network", "a tanh network, trained anew in each sweep", "Boyan & Moore 1995",
                 _network, "hidden", lambda model, _: 12),
)  # fmt: skip
"""Every regressor of the command, in the order of its table."""


def fitted_table() -> Table:
    """Worlds and regressors, for `neuralq lab list`."""
    table = Table(
        "name", "kind", "what it is", "option", title="fitted value iteration", box=SIMPLE_HEAD, title_justify="left"
    )
    table.columns[0].no_wrap = True
    for model in (make() for make in WORLDS):
        table.add_row(model.name, "world", Text.assemble(model.title, (f" ({model.source})", "dim")), "")
    table.add_section()
    for one in REGRESSORS:
        table.add_row(one.name, "regressor", Text.assemble(one.title, (f" ({one.source})", "dim")), one.option or "")
    return table


def plain_choices() -> dict[str, list[dict[str, Any]]]:
    """The same for programs."""
    worlds, names = [make() for make in WORLDS], ("name", "title", "source")
    return {
        "worlds": [fields_of(one, *names, "known") for one in worlds],
        "regressors": [fields_of(one, *names, "option") for one in REGRESSORS],
    }
