"""A small network as regressor: trained from the same initial weights on every set of values, until it fits no better.

Unlike a linear smoother its fit is no fixed combination of the values, so no hat matrix describes it and no certificate
covers it. Starting every fit anew from one seed makes it at least a function of the values: the same values, the same
fit. Values are standardised before and after, which leaves the family of functions as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuralq.checks import check_whole
from neuralq.types import Floats

__all__ = ["NetworkRegressor"]


@dataclass(frozen=True)
class NetworkRegressor:
    """A tanh network with one hidden layer, fitted by L-BFGS on all values at once, in float64.

    Args:
        num_hidden: hidden units.
        seed: of the initial weights.
        num_steps: most steps of L-BFGS for one fit; it stops by itself where nothing improves.

    Example:
        >>> x = np.linspace(0, 1, 9)[:, None]
        >>> fit = NetworkRegressor(num_hidden=8, num_steps=100).fit(x).predict(x[:, 0] ** 2, np.array([[0.3]]))
        >>> bool(abs(fit[0] - 0.09) < 0.01)
        True
    """

    num_hidden: int = 12
    seed: int = 0
    num_steps: int = 60

    def fit(self, x_support: Floats) -> _Network:
        """Keep the support, scaled to [−1, 1].

        Raises:
            ValueError: a number of units or steps below 1.
        """
        check_whole("num_hidden", self.num_hidden)
        check_whole("num_steps", self.num_steps)
        low, high = x_support.min(axis=0), x_support.max(axis=0)
        return _Network(self, x_support, (low + high) / 2, np.maximum(high - low, 1e-12) / 2)


@dataclass(frozen=True, eq=False)
class _Network:
    settings: NetworkRegressor
    support: Floats
    centre: Floats
    half_width: Floats

    def predict(self, y: Floats, x_query: Floats) -> Floats:
        """Train from the initial weights on ``y``, then answer."""
        mean, scale = float(y.mean()), max(float(y.std()), 1e-12)
        weights = self._trained(torch.from_numpy((y - mean) / scale))
        with torch.no_grad():
            out: Floats = _forward(weights, self._scaled(x_query)).numpy()
        return mean + scale * out

    def _scaled(self, x: Floats) -> Tensor:
        return torch.from_numpy((x - self.centre) / self.half_width)

    def _trained(self, target: Tensor) -> list[Tensor]:
        rng = np.random.default_rng(self.settings.seed)
        h, dim = self.settings.num_hidden, self.support.shape[1]
        shapes = ((dim, h), (h,), (h, 1), (1,))
        sizes = (dim**-0.5, dim**-0.5, h**-0.5, h**-0.5)
        weights = [
            torch.from_numpy(size * rng.uniform(-1, 1, shape)).requires_grad_()
            for shape, size in zip(shapes, sizes, strict=True)
        ]
        x = self._scaled(self.support)
        optimiser = torch.optim.LBFGS(weights, max_iter=self.settings.num_steps, line_search_fn="strong_wolfe")

        def loss() -> Tensor:
            optimiser.zero_grad()
            value = ((_forward(weights, x) - target) ** 2).mean()
            value.backward()  # type: ignore[no-untyped-call]
            return value

        optimiser.step(loss)  # type: ignore[no-untyped-call]
        return weights


def _forward(weights: list[Tensor], x: Tensor) -> Tensor:
    w1, b1, w2, b2 = weights
    return (torch.tanh(x @ w1 + b1) @ w2 + b2)[:, 0]
