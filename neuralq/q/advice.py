"""Advice: rules that become units of a network, to be refined by whatever it learns afterwards.

A rule says IF so many of these conditions hold THEN this action is worth so much more (or less). Its unit reads the
inputs that the rule names and adds to the value of the rule's action; all else in the network stays as it is, and every
weight learns on. Advice can be given before training or at any time during it, and wrong advice is unlearned.

How true a condition is runs linearly from 0 to 1 between two values of its input, tᵢ = (x − false_at)/(true_at −
false_at), so that input values of 0 and 1 are logic. A sigmoid unit of a rule that asks for M of its conditions gives

    σ(6 (Σᵢ tᵢ − M + ½)):  at least σ(3) = .9526 where M are true, at most σ(−3) = .0474 where only M − 1 are.

A tanh unit takes half of that, which is the same unit in other clothes: tanh(z/2) = 2σ(z) − 1. A ReLU unit gives
Σᵢ tᵢ − (M − 1), that is 1 where exactly M are true, 2 for M + 1, and 0 where they are too few; a leaky one nearly 0.
Layers above pass on what the unit says.

A condition beyond its ``true_at`` counts for more than 1 and could make up for another that is false. Where that must
not be, ``true_at`` is the utmost that the input can say, as 0 and 1 are.

Source: Maclin & Shavlik 1996 (RATLE), after Towell & Shavlik 1994 (KBANN).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor, nn

from neuralq.checks import check_whole
from neuralq.q.bodies import GroupedLinear, Trunk
from neuralq.q.layouts import ActionInputQ, ActionOutputQ, SeparateQ
from neuralq.q.masked import MaskedQ
from neuralq.types import QFunction

__all__ = ["Rule", "insert_rules"]

Q = TypeVar("Q", bound=QFunction)


class _Kind(NamedTuple):
    """How units of one activation say what a rule does.

    Args:
        slope: of what goes into the unit, by the number of conditions that are true.
        margin: what goes in where just enough of them are.
        passed: factor and constant with which the unit of the next layer takes over.
        said: the shares of the rule's value that are weight and constant of the output.
    """

    slope: float
    margin: float
    passed: tuple[float, float]
    said: tuple[float, float]


_HOLDS = 1 / (1 + math.exp(-3.0))  # what a sigmoid unit gives where its rule just holds
_PASSED = 3.0 / (_HOLDS - 0.5)
_PLAIN = _Kind(1.0, 1.0, (1.0, 0.0), (1.0, 0.0))
_KINDS = {
    "relu": _PLAIN,
    "leaky_relu": _PLAIN,
    "sigmoid": _Kind(6.0, 3.0, (_PASSED, -_PASSED / 2), (1.0, 0.0)),
    "tanh": _Kind(3.0, 1.5, (1.5 / math.tanh(1.5), 0.0), (0.5, 0.5)),
}


@dataclass(frozen=True)
class Rule:
    """IF at least so many conditions hold THEN an action is worth more, or less.

    Args:
        conditions: by the input that each reads, counted in the flattened observation (after one-hot encoding, where
            the network has that): True for an input of 0 and 1 that must be 1, False for one that must be 0, or the
            two values (where it is false, where it is true). They are kept as (input, false_at, true_at).
        action: whose value changes.
        value: by how much, in the units that the network learns; negative to advise against the action.
        at_least: how many of the conditions; None for all of them.

    Raises:
        ValueError: no condition, two of one input, values that do not tell true from false, or counts out of range.

    Source: Maclin & Shavlik 1996.

    Example:
        >>> rule = Rule({0: True, 3: False, 5: (0.0, 0.2)}, action=1)
        >>> rule.conditions
        ((0, 0.0, 1.0), (3, 1.0, 0.0), (5, 0.0, 0.2))
        >>> rule.holds(torch.tensor([[1, 0, 0, 0, 0, 0.2], [1, 0, 0, 1, 0, 0.2]])).tolist()
        [True, False]
    """

    conditions: Mapping[int, bool | tuple[float, float]] | Sequence[tuple[int, float, float]]
    action: int
    value: float = 1.0
    at_least: int | None = None

    def __post_init__(self) -> None:
        """Refuse what is no rule."""
        read = tuple(_read(one) for one in _listed(self.conditions))
        if not read:
            raise ValueError("a rule needs a condition, got none; a value of every state is the output's bias")
        inputs = [one[0] for one in read]
        if len(set(inputs)) < len(inputs):
            raise ValueError(f"a rule reads each input once, got conditions on inputs {inputs}; write several rules")
        object.__setattr__(self, "conditions", read)
        check_whole("action", self.action, 0)
        if not isinstance(self.value, Real) or not math.isfinite(self.value):
            raise ValueError(f"value must be finite, got {self.value!r}")
        object.__setattr__(self, "value", float(self.value))
        if self.at_least is not None:
            check_whole("at_least", self.at_least)
            if self.at_least > len(read):
                raise ValueError(f"at_least must be at most the number of conditions, {len(read)}, got {self.at_least}")

    @property
    def num_needed(self) -> int:
        """How many conditions have to hold."""
        return len(self.conditions) if self.at_least is None else self.at_least

    def holds(self, x: Tensor) -> Tensor:
        """Whether it does, by inputs as the network takes them: ``[*n, d] -> [*n] bool``."""
        true = [(x[..., i] - low) / (high - low) >= 1 - 1e-6 for i, low, high in _conditions(self)]
        return torch.stack(true).sum(0) >= self.num_needed


def insert_rules(q: Q, rules: Sequence[Rule]) -> Q:
    """The same network with a unit for each rule in its hidden layers; ``q`` itself stays as it is.

    Where no rule holds, and all conditions are plainly true or false, a value moves by at most .0474 times the values
    of its rules, and with ReLU units not at all. In `ActionOutputQ` and `ActionInputQ` a rule takes a unit of each
    hidden layer; in `SeparateQ` it takes one of its action's network, and others grow alike by units that say nothing.

    Args:
        q: one of the three layouts, or one under `MaskedQ`, with an `MLP` body of at least one hidden layer and without
            layer normalisation, which would let a unit change what all others say.
        rules: what is advised.

    Returns:
        A network of the same class, whose hidden layers are wider.

    Raises:
        ValueError: another representation or body, or a rule on an input or action that the network does not have.

    Source: Maclin & Shavlik 1996.

    Example:
        >>> from neuralq.q import MLP
        >>> q = ActionOutputQ(3, 2, MLP((8,)), rng=0)
        >>> told = insert_rules(q, [Rule({0: True, 2: False}, action=1, value=5.0)])
        >>> s = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
        >>> (told.all(s) - q.all(s)).round(decimals=4).abs().tolist()
        [[0.0, 5.0], [0.0, 0.0]]
    """
    told = copy.deepcopy(q)
    inner: Any = told.inner if isinstance(told, MaskedQ) else told
    _check_network(inner)
    for rule in rules:
        _check_place(inner, rule)
    chains = [list(rules)]
    if isinstance(inner, SeparateQ):
        chains = [[rule for rule in rules if rule.action == a] for a in range(inner.num_actions)]
    _grow(inner, chains)
    return told


def _listed(conditions: Any) -> list[Any]:
    if isinstance(conditions, Mapping):
        return list(conditions.items())
    if isinstance(conditions, Sequence) and not isinstance(conditions, str):
        return list(conditions)
    raise ValueError(f"conditions are a mapping of inputs, as in {{3: True, 5: False}}, got {conditions!r}")


def _read(given: Any) -> tuple[int, float, float]:
    """One condition as (input, false_at, true_at)."""
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) < 2:
        raise ValueError(f"a condition is an input and where it is true, as in {{3: True}}, got {given!r}")
    where, *said = given
    check_whole("the input of a condition", where, 0)
    truth: Any = said[0] if len(said) == 1 else said
    low, high = (float(not truth), float(truth)) if isinstance(truth, bool) else _ends(where, truth)
    return int(where), low, high


def _ends(where: int, truth: Any) -> tuple[float, float]:
    """Where a condition is false, and where true."""
    ends = list(truth) if isinstance(truth, Sequence) and not isinstance(truth, str) else []
    if len(ends) == 2 and all(isinstance(x, Real) and math.isfinite(x) for x in ends) and ends[0] != ends[1]:
        return float(ends[0]), float(ends[1])
    raise ValueError(
        "a condition is true, false, or two different numbers (where it is false, where it is true), got "
        f"{truth!r} for input {where}"
    )


def _conditions(rule: Rule) -> tuple[tuple[int, float, float], ...]:
    return cast("tuple[tuple[int, float, float], ...]", rule.conditions)


def _check_network(inner: Any) -> None:
    if type(inner) not in (ActionOutputQ, SeparateQ, ActionInputQ):
        raise ValueError(
            "rules become units of ActionOutputQ, SeparateQ or ActionInputQ, without dueling or a distribution; "
            f"this is {type(inner).__name__}"
        )
    trunk = inner.trunk
    if inner.input.stem is not None or type(trunk) is not Trunk:
        raise ValueError("rules read inputs, which the first layer of an MLP does; take an MLP for a body")
    if len(trunk.layers) < 2:
        raise ValueError("rules become hidden units, and this network has no hidden layer; give its body a width")
    if trunk.layer_norm:
        raise ValueError(
            "layer normalisation would let a rule change what all other units say; take a body with layer_norm=False"
        )
    if any(type(layer) is not GroupedLinear for layer in trunk.layers):
        raise ValueError("rules become units of plain dense layers, and these are noisy; leave the noise out")


def _check_place(inner: Any, rule: Rule) -> None:
    num_inputs = inner.input.num_features
    if rule.action >= inner.num_actions:
        raise ValueError(f"a rule advises action {rule.action}, and there are 0 to {inner.num_actions - 1}")
    if (most := max(i for i, _, _ in _conditions(rule))) >= num_inputs:
        raise ValueError(f"a rule reads input {most}, and there are 0 to {num_inputs - 1}")


def _grow(inner: Any, chains: list[list[Rule]]) -> None:
    """Widen every hidden layer by the units of each network's rules."""
    trunk: Trunk = inner.trunk
    kind, more, last = _KINDS[trunk.activation], max(map(len, chains)), len(trunk.layers) - 1
    for i, layer in enumerate(trunk.layers):
        assert isinstance(layer, GroupedLinear)
        below, above = layer.weight.shape[1:]
        weight = _padded(layer.weight, (0, more * (i < last), 0, more * (i > 0)))
        bias = _padded(layer.bias, (0, more * (i < last)))
        for network, chain in enumerate(chains):
            for k, rule in enumerate(chain):
                if i == 0:
                    _read_inputs(inner, rule, kind, weight[network, :, above + k], bias[network, above + k])
                elif i < last:
                    weight[network, below + k, above + k], bias[network, above + k] = kind.passed
                else:
                    output = rule.action if isinstance(inner, ActionOutputQ) else 0
                    weight[network, below + k, output] = rule.value * kind.said[0]
                    bias[network, output] += rule.value * kind.said[1]
        layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
    trunk.sizes = (trunk.sizes[0], *(size + more for size in trunk.sizes[1:-1]), trunk.sizes[-1])


def _padded(parameter: Tensor, zeros: tuple[int, ...]) -> Tensor:
    return nn.functional.pad(parameter.detach(), zeros)


def _read_inputs(inner: Any, rule: Rule, kind: _Kind, weight: Tensor, bias: Tensor) -> None:
    """Weights and bias of the unit, in place: slope (Σ t − M) + margin, and far below where it is another action."""
    constant = kind.margin - kind.slope * rule.num_needed
    for i, low, high in _conditions(rule):
        weight[i] = kind.slope / (high - low)
        constant -= kind.slope * low / (high - low)
    if isinstance(inner, ActionInputQ):  # as many as could make up for it, and one more
        needed = kind.slope * (len(_conditions(rule)) - rule.num_needed + 1)
        weight[inner.input.num_features + rule.action] = needed
        constant -= needed
    bias.fill_(constant)
