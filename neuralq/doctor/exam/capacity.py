"""R7: can a network like the subject's represent the returns of its own policy?

A fresh network of the same architecture is regressed on them, first its last layer alone, in closed form: if that does
it, nothing needs to be trained. Beside it stands a ridge regression on random Fourier features (Rahimi & Recht 2007),
which hardly depends on scales and sizes; episodes that neither has seen judge both. Only the gap counts, because noise
caps what either can explain.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.estimates import bounds_of, held_out_scores
from neuralq.doctor.exam.case import CannotMeasure, Case
from neuralq.doctor.exam.signs import fresh, hidden
from neuralq.doctor.findings import Finding
from neuralq.types import Array, Floats

__all__ = ["capacity", "labelled", "regressed", "t_interval"]

_NUM_ROWS, _SEEDS, _MOST_WEIGHTS, _MOST_WIDTH = 1000, 6, 300_000, 500
_NUM_STEPS = 300
_GAP = 0.10


def capacity(case: Case) -> Finding:
    """R7: R² of held-out returns by random features less that by a fresh network, over six of those and divisions."""
    network, encode, outputs = case.subject.network, case.subject.encode, case.subject.outputs
    if network is None or encode is None or outputs is None:
        raise CannotMeasure("the subject is a function, whose architecture is not known; hand over the torch.nn.Module")
    if case.width > _MOST_WIDTH or sum(p.numel() for p in network.parameters()) > _MOST_WEIGHTS:
        raise CannotMeasure("it trains fresh networks, which the budget does not allow for one of this size")
    s, a, g, names = labelled(case, _NUM_ROWS)
    theirs, with_action = encode(s), np.concatenate([case.world.as_rows(s), np.eye(case.world.num_actions)[a]], axis=1)
    divisions = []
    for seed in range(_SEEDS):
        rng = case.rng(320 + seed)
        held = np.isin(names, rng.permutation(np.unique(names))[: len(np.unique(names)) // 2])
        divisions.append((held, fresh(network, rng), _by_features(with_action, g, held, rng), rng))
    scores = [
        (_untrained(net, outputs, theirs, np.eye(case.world.num_actions)[a], g, held), other)
        for held, net, other, _ in divisions
    ]
    if np.mean([other - own for own, other in scores]) > _GAP:  # training may do better than the layers it starts from
        if case.clock.left < 0.3 * case.clock.budget_s:
            raise CannotMeasure("it trains fresh networks, for which too little of the budget was left")
        scores = [(regressed(net, outputs, theirs, a, g, held, rng), other) for held, net, other, rng in divisions]
    gaps = [other - own for own, other in scores]
    own, other = np.mean(scores, axis=0)
    low, high = bounds_of(np.column_stack([gaps, np.ones(_SEEDS)]), lambda s: s[:, 0] / s[:, 1], case.rng(319))
    return Finding(
        "R7", "a network of this kind cannot represent the returns", "representation", "B", float(np.mean(gaps)),
        (low, high), _GAP, "our own", low > _GAP,
        f"a fresh network of this architecture predicts held-out returns with R² {own:.2f}, random features with "
        f"{other:.2f}",
        "a wider body with LayerNorm, and observations scaled to about ±1",
        f"neuralq train {case.world.name} --body.hidden '[256, 256]' --body.layer-norm true",
    )  # fmt: skip


def _untrained(
    net: nn.Module, outputs: Callable[[nn.Module, Tensor], Tensor], x: Tensor, chosen: Floats, g: Floats, held: Array
) -> float:  # fmt: skip
    """R² on the held-out rows of a least squares fit on the last hidden layer as it starts; −1 without one."""
    try:
        h = hidden(net, outputs, x)[-1].double().numpy()
    except CannotMeasure:
        return -1.0
    rows = np.concatenate([np.ones((len(h), 1)), h / max(float(np.abs(h).mean()), 1e-300)], axis=1)
    each = (chosen[:, :, None] * rows[:, None, :]).reshape(len(h), -1)
    gram = each[~held].T @ each[~held] + 1e-4 * (~held).sum() * np.eye(each.shape[1])
    predicted = each[held] @ np.linalg.solve(gram, each[~held].T @ g[~held])
    return _explained(g[held], predicted)


def _by_features(x: Floats, g: Floats, held: Array, rng: np.random.Generator) -> float:
    predicted = held_out_scores(x, g[:, None], held.astype(np.int64), rng)[held, 0]
    return _explained(g[held], predicted)


def _explained(g: Floats, predicted: Floats) -> float:
    """R², no less than −1."""
    return max(1.0 - float(((g - predicted) ** 2).mean() / max(float(g.var()), 1e-12)), -1.0)


def labelled(case: Case, most: int) -> tuple[Array, Array, Floats, Array]:
    """s, a and G of steps whose return is known, and of which episode they are.

    Raises:
        CannotMeasure: there are too few, or all are the same.
    """
    rows = []
    for i, one in enumerate((*case.greedy, *case.explored)):
        g = case.returns(one)
        if len(g):
            rows.append((one.observations[: len(g)], one.actions[: len(g)], g, np.full(len(g), i)))
    if len(rows) < 9:
        raise CannotMeasure("fewer than 9 episodes have steps whose return is known")
    s, a, g, names = (np.concatenate([row[k] for row in rows]) for k in range(4))
    if g.std() < 1e-9:
        raise CannotMeasure("all returns are the same, so that there is nothing to represent")
    pick = case.rng(69).permutation(len(g))[:most]
    return s[pick], a[pick], g[pick], names[pick]


def regressed(
    net: nn.Module, outputs: Callable[[nn.Module, Tensor], Tensor], x: Tensor, a: Array, g: Floats, held: Array,
    rng: np.random.Generator,
) -> float:  # fmt: skip
    """R² on the held-out rows after 300 Adam steps on 128 of the others each; no less than −1."""
    target = torch.as_tensor((g - g[~held].mean()) / max(float(g[~held].std()), 1e-12)).float()
    chosen, learn, out = torch.as_tensor(a)[:, None], np.flatnonzero(~held), torch.as_tensor(held)
    optimiser = torch.optim.Adam(net.parameters(), lr=3e-3)
    for _ in range(_NUM_STEPS):
        pick = torch.as_tensor(rng.choice(learn, min(128, len(learn)), replace=False))
        error = ((outputs(net, x[pick]).gather(1, chosen[pick])[:, 0] - target[pick]) ** 2).mean()
        optimiser.zero_grad()
        torch.autograd.backward(error)
        nn.utils.clip_grad_norm_(net.parameters(), 10.0)
        optimiser.step()
    with torch.no_grad():
        predicted = outputs(net, x[out]).gather(1, chosen[out])[:, 0]
    return _explained(target[out].double().numpy(), predicted.double().numpy())


def t_interval(values: list[float]) -> tuple[float, float]:
    """95 % of the mean, by Student's t over seeds."""
    from scipy.stats import t

    n = len(values)
    half = float(t.ppf(0.975, n - 1)) * float(np.std(values, ddof=1)) / np.sqrt(n)
    return float(np.mean(values) - half), float(np.mean(values) + half)
