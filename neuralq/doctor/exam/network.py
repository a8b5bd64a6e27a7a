"""R1–R6: the network that computes the values, beside fresh ones of the same architecture."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.exam.case import CannotMeasure, Case, legal_at, seen_at
from neuralq.doctor.exam.signs import (
    NUM_FRESH,
    Outputs,
    dormant_share,
    fan_in_of,
    fresh,
    hidden,
    lag_of,
    moved,
    rank_of,
)
from neuralq.doctor.findings import Finding
from neuralq.lab.networks.sampled import SampleDiagnosis, diagnose_sample
from neuralq.lab.watch.advice import RunTraits, advise
from neuralq.types import Array, Floats, Transition

__all__ = ["churn", "dormant", "effective_rank", "kernel", "lag", "plasticity", "untouched"]

_NUM_STATES = 512
_MOST_WEIGHTS, _FEW_WEIGHTS = 5_000_000, 20_000


def _network(case: Case) -> tuple[nn.Module, Outputs]:
    if case.subject.network is None or case.subject.encode is None or case.subject.outputs is None:
        raise CannotMeasure("the subject is a function, whose inside is not seen; hand over the torch.nn.Module")
    return case.subject.network, case.subject.outputs


def _encoded(case: Case, num: int, number: int) -> Tensor:
    assert case.subject.encode is not None
    seen, _ = case.visited(num, number)
    return case.subject.encode(seen if seen.ndim < 4 else seen[:128])


def _with_mask(case: Case, observations: Array, legal: Array | None) -> Tensor:
    """What the network takes, and behind it which actions are legal, if there are masks."""
    assert case.subject.encode is not None
    x = case.subject.encode(observations)
    return x if legal is None else torch.cat([x.reshape(len(x), -1), torch.as_tensor(legal).to(x.dtype)], dim=1)


def _legal_only(case: Case, outputs: Outputs) -> Outputs:
    """The outputs for what `_with_mask` gives, −∞ for illegal actions."""
    if not case.masked:
        return outputs
    assert case.subject.encode is not None
    shape = case.subject.encode(case.greedy[0].observations[:1]).shape[1:]

    def legal(network: nn.Module, x: Tensor) -> Tensor:
        seen, mask = x[..., : -case.world.num_actions], x[..., -case.world.num_actions :]
        return outputs(network, seen.reshape(*x.shape[:-1], *shape)).masked_fill(mask == 0, -torch.inf)

    return legal


def _fresh_ones(network: nn.Module, rng: np.random.Generator) -> Iterator[nn.Module]:
    return (fresh(network, rng) for _ in range(NUM_FRESH))


def dormant(case: Case) -> Finding:
    """R1: the share of units with s_i = E|h_i| / mean_k E|h_k| ≤ 0.025 (Sokar et al. 2023), above a fresh network's."""
    (network, outputs), x = _network(case), _encoded(case, _NUM_STATES, 21)
    own = dormant_share(hidden(network, outputs, x))
    others = np.array([dormant_share(hidden(one, outputs, x)) for one in _fresh_ones(network, case.rng(22))])
    excess = own - float(others.mean())
    interval = (own - float(others.max()), own - float(others.min()))
    return Finding(
        "R1", "most units have gone silent: the step size is too large", "algorithm", "B", excess, interval, 0.5,
        "Sokar et al. 2023 for τ = 0.025; the excess over fresh networks is our own", interval[0] > 0.5,
        f"{100 * own:.0f} % of hidden units hardly answer, and {100 * others.mean():.0f} % in fresh networks",
        "a step size ten times smaller; LayerNorm", f"train again with lr = "
                                                    f"{(case.settings.learning_rate or 1e-3) / 10:.2g}",
        fresh=tuple((others - others.mean()).tolist()),
    )  # fmt: skip


def effective_rank(case: Case) -> Finding:
    """R2: srank, the number of singular values that make 99 % of their sum (Kumar et al. 2021); a vital sign."""
    (network, outputs), x = _network(case), _encoded(case, _NUM_STATES, 23)
    own = rank_of(hidden(network, outputs, x)[-1])
    others = [rank_of(hidden(one, outputs, x)[-1]) for one in _fresh_ones(network, case.rng(24))]
    return Finding(
        "R2", "the last hidden layer spans few directions", "representation", "C", float(own),
        (float(min(others)), float(max(others))), 3.0, "none that is stable (Gulcehre et al. 2022); beside fresh "
                                                       "networks",
        own <= 3 and own < min(others),
        f"the effective rank of the last hidden layer is {own}, of fresh networks {min(others)} to {max(others)}",
        "a sign that values diverged, or that the network is too small", "watch it while training again",
        fresh=tuple(map(float, others)),
    )  # fmt: skip


class _Values(nn.Module):
    """A network as the lab asks it: ``all(s)`` and ``at(s, a)``."""

    def __init__(self, network: nn.Module, outputs: Outputs, num_actions: int) -> None:
        super().__init__()
        self.network, self.num_actions, self.outputs = network, num_actions, outputs

    def all(self, s: Tensor) -> Tensor:
        return self.outputs(self.network, s)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        return self.all(s).gather(-1, a[..., None])[..., 0]


def _transitions(case: Case, num: int, number: int) -> Transition:
    pool = [*case.greedy, *case.explored]
    a, r = (np.concatenate([getattr(one, name) for one in pool]) for name in ("actions", "rewards"))
    ended = np.concatenate([np.arange(one.length) == (one.length - 1 if one.terminated else -1) for one in pool])
    pick = case.rng(number).permutation(len(r))[:num]
    scale = case.settings.reward_scale or 1.0
    discount = np.where(ended[pick], 0.0, case.gamma)
    now, ahead = (_with_mask(case, seen_at(pool, pick, k), legal_at(pool, pick, k)) for k in (0, 1))
    return Transition(
        now, torch.as_tensor(a[pick]), torch.ones(len(pick)),
        torch.as_tensor(scale * r[pick]).float(), torch.as_tensor(discount).float(), ahead,
        torch.as_tensor(ended[pick]),
    )  # fmt: skip


def kernel(case: Case) -> Finding:
    """R3: what plain one-step updates would do to the errors of visited transitions (`neuralq.lab`); local."""
    network, outputs = _network(case)
    weights = sum(p.numel() for p in network.parameters())
    if weights > _MOST_WEIGHTS:
        raise CannotMeasure(f"the network has {weights:,} weights; the kernel is computed for up to {_MOST_WEIGHTS:,}")
    step = _transitions(case, int(min(64, max(8, 2e7 // weights))), 25)
    rate = case.settings.learning_rate or 1e-4

    def diagnosed(one: nn.Module) -> SampleDiagnosis:
        return diagnose_sample(cast(Any, _Values(one, _legal_only(case, outputs), case.world.num_actions)), step, rate)

    found = diagnosed(copy.deepcopy(network))
    others: list[float] = []
    if weights <= _FEW_WEIGHTS and case.clock.left > 0.3 * case.clock.budget_s:
        with contextlib.suppress(CannotMeasure):
            others = [diagnosed(one).min_real_eigenvalue for one in _fresh_ones(network, case.rng(34))]
    period = case.settings.target_period_updates
    traits = RunTraits(
        gamma=case.gamma, step_size=rate, target_period=None if period is None or period <= 1 else max(int(period), 1)
    )
    return Finding(
        "R3", "one-step updates make errors grow from here", "algorithm", "C", found.min_real_eigenvalue, None, 0.0,
        "the sign of the kernel's smallest eigenvalue beyond the noise of a sample (Yue et al. 2023)", found.unstable,
        found.explain(), "; ".join(advise(traits, found)[:3]), "neuralq lab prescribe baird  # what each remedy does",
        fresh=tuple(others),
    )  # fmt: skip


def churn(case: Case) -> Finding:
    """R4: in which share of other states the greedy action changes by one Adam step (Schaul et al. 2022)."""
    (network, every), seen = _network(case), case.visited(_NUM_STATES, 26)
    outputs, x = _legal_only(case, every), _with_mask(case, *seen)[: 512 if seen[0].ndim < 4 else 128]
    step, rate = _transitions(case, 32, 27), case.settings.learning_rate or 1e-4
    share, change = moved(network, outputs, step, rate, x)
    others: list[float] = []
    with contextlib.suppress(CannotMeasure):
        others = [moved(one, outputs, step, rate, x)[0] for one in _fresh_ones(network, case.rng(33))]
    return Finding(
        "R4", "one update changes the policy elsewhere", "algorithm", "C", share, None, 0.1, "our own", share > 0.1,
        f"one Adam step of size {rate:g} on 32 transitions changes the greedy action in {100 * share:.2g} % of "
        f"other states, "
        f"and values by {change:.3g}",
        "a smaller step size, larger batches", f"train again with lr = {rate / 10:.2g}", fresh=tuple(others),
    )  # fmt: skip


def plasticity(case: Case) -> Finding:
    """R5: the error after 500 Adam steps on sin(1e5 f(s)), over that of fresh networks (Lyle et al. 2023)."""
    network, outputs = _network(case)
    if sum(p.numel() for p in network.parameters()) > 300_000 or case.clock.left < 0.3 * case.clock.budget_s:
        raise CannotMeasure("it trains the network 1,000 steps, which the budget does not allow")
    x, rng = _encoded(case, 128, 28), case.rng(29)
    with torch.no_grad():
        target = torch.sin(1e5 * outputs(fresh(network, rng), x))
    own, other = (_fitted(copy.deepcopy(net), outputs, x, target) for net in (network, fresh(network, rng)))
    ratio = own / max(other, 1e-12)
    return Finding(
        "R5", "the network has lost its plasticity", "representation", "C", ratio, None, 1.5, "our own; Lyle et al. "
        "2023",
        ratio > 1.5, f"on a new target it ends at an error of {own:.3g}, a fresh one at {other:.3g}",
        "LayerNorm, weight decay, or resets", "train a fresh network on the same data, and compare",
    )  # fmt: skip


def _fitted(network: nn.Module, outputs: Outputs, x: Tensor, target: Tensor) -> float:
    optimiser, error = torch.optim.Adam(network.parameters(), lr=1e-3), torch.zeros(())
    for _ in range(500):
        optimiser.zero_grad()
        error = nn.functional.mse_loss(outputs(network, x), target)
        torch.autograd.backward(error)
        optimiser.step()
    return float(error.detach())


def lag(case: Case) -> Finding:
    """R6: mean |Q − Q⁻| over mean |Q|, of the target network that was saved; and whether all weights are finite."""
    (network, outputs), x = _network(case), _encoded(case, _NUM_STATES, 30)
    if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
        return Finding(
            "R6", "the weights are not finite", "algorithm", "B", float("nan"), None, None, "any", True,
            "some weights are NaN or infinite", "a smaller step size, and gradients clipped", "train again with lr "
            "/ 10",
        )  # fmt: skip
    if case.subject.target is None:
        raise CannotMeasure("the file holds no target network")
    with torch.no_grad():
        share = lag_of(outputs(network, x), outputs(case.subject.target, x))
    return Finding(
        "R6", "the target network lags behind", "algorithm", "C", share, None, 0.5, "our own", share > 0.5,
        f"values and those of the target network differ by {100 * share:.3g} % of their size",
        "copy the target network more often, or take a smaller step", "print((q(obs) - q_target(obs)).abs().mean())",
    )  # fmt: skip


def untouched(case: Case) -> Finding:
    """R6a: how far the weights have left where PyTorch's default puts them, beside fresh networks.

    A fresh layer's weights are uniform within ±1/√fan-in. The measure is the largest over layers of the Kolmogorov
    distance to that; where it is no larger than in fresh networks, nothing has been learned yet.
    """
    network, _ = _network(case)
    if sum(p.numel() for p in network.parameters()) < 100:
        raise CannotMeasure("the network has fewer than 100 weights, too few to tell how they are distributed")
    own = _distance(network)
    others = [_distance(one) for one in _fresh_ones(network, case.rng(31))]
    most = max(others)
    still = own <= 1.5 * most
    return Finding(
        "R6a", "the weights have hardly moved: too small a step size, or too few updates", "algorithm", "B", own, None,
        1.5 * most, "our own: 1.5 times the largest of fresh networks", still,
        f"the weights differ from a fresh network's by {own:.3g} (Kolmogorov distance), fresh ones by up to {most:.3g}",
        "a larger step size (1e-4 to 1e-3 with Adam), or longer training", "train again with lr = 1e-3",
        fresh=tuple(others),
    )  # fmt: skip


def _distance(network: nn.Module) -> float:
    most = 0.0
    for layer in network.modules():
        fan_in = fan_in_of(layer)
        if fan_in is not None:
            w = cast(Tensor, layer.weight).detach().double().reshape(-1).numpy() * math.sqrt(fan_in)
            most = max(most, _kolmogorov(w))
    return most


def _kolmogorov(w: Floats) -> float:
    """The largest distance of two distribution functions, weights' and the uniform one's on [−1, 1], times √n."""
    ordered = np.sort(w)
    uniform, n = np.clip((ordered + 1) / 2, 0, 1), len(w)
    steps = np.arange(1, n + 1) / n
    return float(max(np.abs(steps - uniform).max(), np.abs(steps - 1 / n - uniform).max()) * math.sqrt(n))
