"""The second function of gradient-TD methods: h(s, a) estimates the expected TD error from what Q can tell apart.

Gradient-TD methods follow the gradient of a squared *projected* error E[δ·∇Q]ᵀ E[∇Q ∇Qᵀ]⁻¹ E[δ·∇Q], a product of two
expectations of which one sample sees only one factor. The other factor is learned on the side by regressing δ on

* `TangentCorrection`: h(s, a) = ∇Q(s, a)·h, with h in the parameter space of Q. With linear features that is x·h; with
  a network, whose tangent space turns as it learns, the gradient has one more term, with the Hessian ∇²Q·h (Maei et
  al. 2009);
* `HeadCorrection`: any function with parameters of its own, such as a second network (Patterson et al. 2022; Elelimy
  et al. 2025). The space in which h is sought does not turn then, so there is no Hessian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import torch
from torch import Tensor, nn

from neuralq.learners.gradient.differentiation import gradient, gradient_rows, module_parameters
from neuralq.q.engine import Engine
from neuralq.q.flat import FlatParameters
from neuralq.types import QFunction

__all__ = ["Correction", "Estimate", "HeadCorrection", "TangentCorrection"]


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the second function says of N pairs.

    Args:
        h: its values, ``[N]``.
        grad: their gradients by its own parameters, ``[N, k]``.
        curvature: ∇²Q·h of every pair, ``[N, d]``; None where h does not live in the tangent space of Q.
    """

    h: Tensor
    grad: Tensor
    curvature: Tensor | None


class Correction(Protocol):
    """A second function with its own flat parameters ``values`` ``[k]``; ``tangent`` says whether h is ∇Q·h."""

    values: Tensor
    tangent: bool

    def estimate(self, s: Tensor, a: Tensor, q: Tensor, grad: Tensor) -> Estimate:
        """Values and derivatives at N pairs, given Q there, with its graph, and ∇Q ``[N, d]``."""
        ...


class TangentCorrection:
    """h(s, a) = ∇Q(s, a)·h, from h = 0: the second weight vector of linear GTD2 and TDC, for any differentiable Q.

    Args:
        engine: of the Q-function whose tangent space it is.

    Source: Sutton et al. 2009 (linear); Maei et al. 2009 (Hessian term).

    Example:
        >>> from neuralq.q import TableQ
        >>> from neuralq.q.engine import Loss, TorchEngine
        >>> TangentCorrection(TorchEngine(TableQ(2, 2), Loss())).values.tolist()
        [0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, engine: Engine) -> None:
        self.tangent = True
        self.values = torch.zeros_like(engine.flat.values)
        self._parameters = module_parameters(engine.q)

    def estimate(self, s: Tensor, a: Tensor, q: Tensor, grad: Tensor) -> Estimate:
        """Values ∇Q·h, gradients ∇Q and Hessian-vector products ∇²Q·h."""
        curvature = torch.zeros_like(grad)
        # Row by row: all rows at once would differentiate N rows of N graphs, which grows with N³.
        for i, value in enumerate(q):
            slope = gradient(value, self._parameters, differentiable=True)
            if not slope.requires_grad:
                break  # a table or a linear function: the gradient does not depend on the parameters, in any row
            curvature[i] = gradient(slope @ self.values, self._parameters)
        return Estimate(grad @ self.values, grad, curvature)


class HeadCorrection:
    """h(s, a) by a function of its own, with one output for each action of Q.

    Args:
        head: any Q-function on the same observations; its initial values are where h starts (0 is the usual choice).

    Source: Patterson, White, White 2022; Elelimy et al. 2025.

    Example:
        >>> from neuralq.q import TableQ
        >>> HeadCorrection(TableQ(2, 2)).values.tolist()
        [0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, head: QFunction) -> None:
        self.tangent = False
        self.head = head
        self.values = FlatParameters(cast(nn.Module, head)).values
        self._parameters = module_parameters(head)

    def estimate(self, s: Tensor, a: Tensor, q: Tensor, grad: Tensor) -> Estimate:
        """Values of the head and their gradients by its parameters."""
        h = self.head.at(s, a)
        return Estimate(h.detach(), gradient_rows(h, self._parameters), None)
