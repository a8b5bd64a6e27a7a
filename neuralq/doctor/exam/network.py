"""R1–R6: the network that computes the values, beside fresh ones of the same architecture."""

from __future__ import annotations

import copy
import math
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuralq.doctor.exam.case import CannotMeasure, Case, seen_at
from neuralq.doctor.findings import Finding
from neuralq.lab.networks.sampled import diagnose_sample
from neuralq.lab.watch.advice import RunTraits, advise
from neuralq.q.bodies import ACTIVATIONS, GroupedConv, GroupedLinear, Trunk
from neuralq.types import Floats, Transition

__all__ = ["churn", "dormant", "effective_rank", "kernel", "lag", "plasticity", "untouched"]

_NUM_STATES, _NUM_FRESH = 512, 8
_ACTIVATIONS = (nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.GELU, nn.SiLU, nn.Sigmoid, nn.Mish)
_MOST_WEIGHTS = 5_000_000


def _network(case: Case) -> nn.Module:
    if case.subject.network is None or case.subject.encode is None or case.subject.outputs is None:
        raise CannotMeasure("the subject is a function, whose inside is not seen; hand over the torch.nn.Module")
    return case.subject.network


def _encoded(case: Case, num: int, number: int) -> Tensor:
    assert case.subject.encode is not None
    seen = case.visited(num, number)
    return case.subject.encode(seen if seen.ndim < 4 else seen[:128])


def _outputs(case: Case, network: nn.Module, x: Tensor) -> Tensor:
    assert case.subject.outputs is not None
    return case.subject.outputs(network, x)


def fresh(network: nn.Module, rng: np.random.Generator) -> nn.Module:
    """A copy with weights as before training: each layer's uniform within ±1/√fan-in, PyTorch's default.

    Raises:
        CannotMeasure: a layer with weights of its own whose start is not known.
    """
    made = copy.deepcopy(network)
    with torch.no_grad():
        for layer in made.modules():
            own = dict(layer.named_parameters(recurse=False))
            if not own or isinstance(layer, nn.LayerNorm) or "LayerNorm" in type(layer).__name__:
                continue
            fan_in = _fan_in(layer)
            if fan_in is None:
                raise CannotMeasure(f"what a fresh {type(layer).__name__} starts from is not known")
            for p in own.values():
                drawn = rng.uniform(-1, 1, tuple(p.shape)) / math.sqrt(fan_in)
                p.copy_(torch.as_tensor(drawn, dtype=p.dtype))
    return made


def _fan_in(layer: nn.Module) -> int | None:
    weight = getattr(layer, "weight", None)
    if isinstance(layer, GroupedLinear):
        return int(layer.weight.shape[1])
    if isinstance(layer, nn.Linear | nn.Conv2d | nn.Conv1d | GroupedConv) and isinstance(weight, Tensor):
        return int(math.prod(weight.shape[1:]))
    return None


def hidden(case: Case, network: nn.Module, x: Tensor) -> list[Tensor]:
    """What each layer of hidden units gives, ``[N, units]``, the last one nearest to the output.

    Raises:
        CannotMeasure: the network has no activations that are modules.
    """
    found: list[Tensor] = []

    def keep(out: Tensor) -> None:
        out = out[0] if out.dim() == 3 and out.shape[0] == 1 else out
        if out.dim() == 4:  # a unit of a convolution is a channel
            out = out.detach().movedim(1, -1)
            out = out.reshape(len(x), -1, out.shape[-1]).abs().mean(1)
        found.append(out.detach().reshape(len(x), -1))

    def after(_: nn.Module, __: Any, out: Tensor) -> None:
        keep(out)

    handles = []
    for module in network.modules():
        if isinstance(module, _ACTIVATIONS):
            handles.append(module.register_forward_hook(after))
        elif isinstance(module, Trunk):
            handles += _hook_trunk(module, keep)
    if not handles:
        raise CannotMeasure("the network has no activations that are modules (nn.ReLU(), …)")
    try:
        with torch.no_grad():
            _outputs(case, network, x)
    finally:
        for handle in handles:
            handle.remove()
    if not found:
        raise CannotMeasure("the network has no hidden units")
    return found


def _hook_trunk(trunk: Trunk, keep: Any) -> list[Any]:
    act = ACTIVATIONS[trunk.activation]
    before = trunk.norms if trunk.layer_norm else list(trunk.layers)[:-1]
    if trunk.copies > 1:
        return [m.register_forward_hook(lambda _, __, out: keep(act(out).movedim(0, 1).flatten(1))) for m in before]
    return [module.register_forward_hook(lambda _, __, out: keep(act(out))) for module in before]


def dormant(case: Case) -> Finding:
    """R1: the share of units with s_i = E|h_i| / mean_k E|h_k| ≤ 0.025 (Sokar et al. 2023), above a fresh network's."""
    network, x = _network(case), _encoded(case, _NUM_STATES, 21)
    own = _dormant(hidden(case, network, x))
    rng = case.rng(22)
    others = np.array([_dormant(hidden(case, fresh(network, rng), x)) for _ in range(_NUM_FRESH)])
    excess = own - float(others.mean())
    interval = (own - float(others.max()), own - float(others.min()))
    return Finding(
        "R1", "most units have gone silent: the step size is too large", "algorithm", "B", excess, interval, 0.5,
        "Sokar et al. 2023 for τ = 0.025; the excess over fresh networks is our own", interval[0] > 0.5,
        f"{100 * own:.0f} % of hidden units hardly answer, and {100 * others.mean():.0f} % in fresh networks",
        "a step size ten times smaller; LayerNorm", f"train again with lr = "
                                                    f"{(case.settings.learning_rate or 1e-3) / 10:.2g}",
    )  # fmt: skip


def _dormant(layers: list[Tensor]) -> float:
    silent = total = 0
    for h in layers:
        activity = h.double().abs().mean(0)
        scores = activity / activity.mean().clamp(min=1e-30)
        silent += int((scores <= 0.025).sum())
        total += len(scores)
    return silent / total


def effective_rank(case: Case) -> Finding:
    """R2: srank, the number of singular values that make 99 % of their sum (Kumar et al. 2021); a vital sign."""
    network, x = _network(case), _encoded(case, _NUM_STATES, 23)
    own = _srank(hidden(case, network, x)[-1])
    rng = case.rng(24)
    others = [_srank(hidden(case, fresh(network, rng), x)[-1]) for _ in range(_NUM_FRESH)]
    return Finding(
        "R2", "the last hidden layer spans few directions", "representation", "C", float(own),
        (float(min(others)), float(max(others))), 3.0, "none that is stable (Gulcehre et al. 2022); beside fresh "
                                                       "networks",
        own <= 3 and own < min(others),
        f"the effective rank of the last hidden layer is {own}, of fresh networks {min(others)} to {max(others)}",
        "a sign that values diverged, or that the network is too small", "watch it while training again",
    )  # fmt: skip


def _srank(h: Tensor) -> int:
    sizes = torch.linalg.svdvals(h.double())
    share = torch.cumsum(sizes, 0) / sizes.sum().clamp(min=1e-300)
    return int((share < 0.99).sum()) + 1


class _Values(nn.Module):
    """A network as the lab asks it: ``all(s)`` and ``at(s, a)``."""

    def __init__(self, case: Case, network: nn.Module, num_actions: int) -> None:
        super().__init__()
        self.network, self.num_actions = network, num_actions
        self._case = [case]

    def all(self, s: Tensor) -> Tensor:
        return _outputs(self._case[0], self.network, s)

    def at(self, s: Tensor, a: Tensor) -> Tensor:
        return self.all(s).gather(-1, a[..., None])[..., 0]


def _transitions(case: Case, num: int, number: int) -> Transition:
    assert case.subject.encode is not None
    pool = [*case.greedy, *case.explored]
    a, r = (np.concatenate([getattr(one, name) for one in pool]) for name in ("actions", "rewards"))
    ended = np.concatenate([np.arange(one.length) == (one.length - 1 if one.terminated else -1) for one in pool])
    pick = case.rng(number).permutation(len(r))[:num]
    scale = case.settings.reward_scale or 1.0
    discount = np.where(ended[pick], 0.0, case.gamma)
    now, ahead = (case.subject.encode(seen_at(pool, pick, later)) for later in (0, 1))
    return Transition(
        now, torch.as_tensor(a[pick]), torch.ones(len(pick)),
        torch.as_tensor(scale * r[pick]).float(), torch.as_tensor(discount).float(), ahead,
        torch.as_tensor(ended[pick]),
    )  # fmt: skip


def kernel(case: Case) -> Finding:
    """R3: what plain one-step updates would do to the errors of visited transitions (`neuralq.lab`); local."""
    network = _network(case)
    weights = sum(p.numel() for p in network.parameters())
    if weights > _MOST_WEIGHTS:
        raise CannotMeasure(f"the network has {weights:,} weights; the kernel is computed for up to {_MOST_WEIGHTS:,}")
    num = int(min(64, max(8, 2e7 // weights)))
    rate = case.settings.learning_rate or 1e-4
    found = diagnose_sample(
        cast(Any, _Values(case, copy.deepcopy(network), case.world.num_actions)), _transitions(case, num, 25), rate
    )
    period = case.settings.target_period_updates
    traits = RunTraits(
        gamma=case.gamma, step_size=rate, target_period=None if period is None or period <= 1 else max(int(period), 1)
    )
    return Finding(
        "R3", "one-step updates make errors grow from here", "algorithm", "C", found.min_real_eigenvalue, None, 0.0,
        "the sign of the kernel's smallest eigenvalue beyond the noise of a sample (Yue et al. 2023)", found.unstable,
        found.explain(), "; ".join(advise(traits, found)[:3]), "neuralq lab prescribe baird  # what each remedy does",
    )  # fmt: skip


def churn(case: Case) -> Finding:
    """R4: in which share of other states the greedy action changes by one Adam step (Schaul et al. 2022)."""
    network = copy.deepcopy(_network(case))
    x = _encoded(case, _NUM_STATES, 26)
    with torch.no_grad():
        before = _outputs(case, network, x)
    step = _transitions(case, 32, 27)
    rate = case.settings.learning_rate or 1e-4
    values = _Values(case, network, case.world.num_actions)
    with torch.no_grad():
        target = step.r_t + step.discount_t * values.all(step.s_t).amax(1)
    optimiser = torch.optim.Adam(network.parameters(), lr=rate)
    loss = nn.functional.mse_loss(values.at(step.s_tm1, step.a_tm1), target.to(before.dtype))
    torch.autograd.backward(loss)
    optimiser.step()
    with torch.no_grad():
        after = _outputs(case, network, x)
    moved = float((before.argmax(1) != after.argmax(1)).float().mean())
    change = float((before - after).abs().mean())
    return Finding(
        "R4", "one update changes the policy elsewhere", "algorithm", "C", moved, None, 0.1, "our own", moved > 0.1,
        f"one Adam step of size {rate:g} on 32 transitions changes the greedy action in {100 * moved:.2g} % of "
        f"other states, "
        f"and values by {change:.3g}",
        "a smaller step size, larger batches", f"train again with lr = {rate / 10:.2g}",
    )  # fmt: skip


def plasticity(case: Case) -> Finding:
    """R5: the error after 500 Adam steps on sin(1e5 f(s)), over that of fresh networks (Lyle et al. 2023)."""
    network = _network(case)
    if sum(p.numel() for p in network.parameters()) > 300_000 or case.clock.left < 0.3 * case.clock.budget_s:
        raise CannotMeasure("it trains the network 1,000 steps, which the budget does not allow")
    x, rng = _encoded(case, 128, 28), case.rng(29)
    with torch.no_grad():
        target = torch.sin(1e5 * _outputs(case, fresh(network, rng), x))
    own, other = (_fitted(case, copy.deepcopy(net), x, target) for net in (network, fresh(network, rng)))
    ratio = own / max(other, 1e-12)
    return Finding(
        "R5", "the network has lost its plasticity", "representation", "C", ratio, None, 1.5, "our own; Lyle et al. "
        "2023",
        ratio > 1.5, f"on a new target it ends at an error of {own:.3g}, a fresh one at {other:.3g}",
        "LayerNorm, weight decay, or resets", "train a fresh network on the same data, and compare",
    )  # fmt: skip


def _fitted(case: Case, network: nn.Module, x: Tensor, target: Tensor) -> float:
    optimiser, error = torch.optim.Adam(network.parameters(), lr=1e-3), torch.zeros(())
    for _ in range(500):
        optimiser.zero_grad()
        error = nn.functional.mse_loss(_outputs(case, network, x), target)
        torch.autograd.backward(error)
        optimiser.step()
    return float(error.detach())


def lag(case: Case) -> Finding:
    """R6: mean |Q − Q⁻| over mean |Q|, of the target network that was saved; and whether all weights are finite."""
    network, x = _network(case), _encoded(case, _NUM_STATES, 30)
    if not all(bool(torch.isfinite(p).all()) for p in network.parameters()):
        return Finding(
            "R6", "the weights are not finite", "algorithm", "B", float("nan"), None, 0.5, "any", True,
            "some weights are NaN or infinite", "a smaller step size, and gradients clipped", "train again with lr "
            "/ 10",
        )  # fmt: skip
    if case.subject.target is None:
        raise CannotMeasure("the file holds no target network")
    with torch.no_grad():
        q, late = (_outputs(case, net, x).double() for net in (network, case.subject.target))
    share = float((q - late).abs().mean() / q.abs().mean().clamp(min=1e-12))
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
    network = _network(case)
    if sum(p.numel() for p in network.parameters()) < 100:
        raise CannotMeasure("the network has fewer than 100 weights, too few to tell how they are distributed")
    own = _distance(network)
    rng = case.rng(31)
    most = max(_distance(fresh(network, rng)) for _ in range(_NUM_FRESH))
    still = own <= 1.5 * most
    return Finding(
        "R6a", "the weights have hardly moved: too small a step size, or too few updates", "algorithm", "B", own, None,
        1.5 * most, "our own: 1.5 times the largest of fresh networks", still,
        f"the weights differ from a fresh network's by {own:.3g} (Kolmogorov distance), fresh ones by up to {most:.3g}",
        "a larger step size (1e-4 to 1e-3 with Adam), or longer training", "train again with lr = 1e-3",
    )  # fmt: skip


def _distance(network: nn.Module) -> float:
    most = 0.0
    for layer in network.modules():
        fan_in = _fan_in(layer)
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
