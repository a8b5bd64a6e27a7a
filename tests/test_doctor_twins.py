"""For every measurement of the doctor a subject that it has to flag, and a healthy twin that the same code must not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from test_doctor_exam import (
    ENDS,
    FAULTS,
    GAMMA,
    Counting,
    Turning,
    alternating,
    both,
    case_of,
    ending,
    experience,
    few_episodes,  # noqa: F401  # is used by all of them
    noisy,
    on_the_beat,
    stored_case,
    summed,
    two_layers,
    waves,
    worth,
)
from torch import nn

from neuralq.doctor import examination
from neuralq.doctor.exam.case import Case
from neuralq.doctor.findings import Finding
from neuralq.doctor.loading import load_subject
from neuralq.doctor.subject import Settings, of_network
from neuralq.exact import solve
from neuralq.mdp import FiniteMDP
from neuralq.types import Array


def right(by: float = 1.0) -> Case:
    return ending(lambda t: by * worth(ENDS - t))


def shown(shows: Callable[[int, np.random.Generator], list[float]], **settings: Any) -> Case:
    return case_of(lambda: Counting(shows=shows, **settings), both(np.abs))


def trained(**settings: Any) -> Case:
    return case_of(lambda: Counting(), both(np.abs), settings=Settings(**settings))


def changed(change: Callable[[Any], None], units: int = 50) -> Case:
    net = two_layers(units)
    with torch.no_grad():
        change(net)
    return case_of(noisy, net)


def one_unit_in_all(net: Any) -> None:
    net[0].weight[:], net[0].bias[:] = net[0].weight[0].clone(), net[0].bias[0].clone()


def silenced(net: Any) -> None:
    net[0].weight[:40], net[0].bias[:40], net[0].bias[40:] = 0.0, -1.0, 1.0


def dead(net: Any) -> None:
    net[0].weight[:], net[0].bias[:] = 0.0, -1.0


def tripled(net: Any) -> None:
    net[2].weight *= 3


def untouched(net: Any) -> None: ...


def copied(times: float) -> Case:
    known = Settings(updates=100.0 * times, target_period_updates=100.0)
    return case_of(lambda: Counting(ends=None, cuts=60), both(np.abs), settings=known)


def of_frozen_lake(best: bool) -> Case:
    lake = lambda: gym.make("FrozenLake-v1", is_slippery=False)  # noqa: E731
    q = np.nan_to_num(solve(FiniteMDP.from_gymnasium(lake()), GAMMA).q)
    return case_of(lake, (lambda s: q[s]) if best else (lambda s: np.eye(4)[[0] * len(s)] * 5))


def lagging(share: float) -> Case:
    net, late = two_layers(10), two_layers(10)
    with torch.no_grad():
        late[2].weight *= 1 - share
        late[2].bias *= 1 - share
    return case_of(noisy, of_network(net, "x", target=late))


def stepping(gamma: float) -> Case:
    """Tsitsiklis and Van Roy's w → 2w, which grows for γ > 5/6."""
    net = nn.Linear(1, 2, bias=False)
    nn.init.ones_(net.weight)
    shows = lambda t, rng: [1.0 if t == 0 else 2.0]  # noqa: E731
    return case_of(lambda: Counting(ends=None, cuts=2, shows=shows), net, gamma=gamma)


def moving(rate: float) -> Case:
    net = nn.Linear(2, 2)
    with torch.no_grad():
        net.weight[:], net.bias[:] = torch.tensor([[0.01, 0.0], [-0.01, 0.0]]), 0.0
    pays = lambda: Counting(pays=lambda t, a: 1.0 - 2.0 * a, shows=lambda t, rng: [rng.normal(), rng.normal()])  # noqa: E731
    return case_of(pays, net, settings=Settings(learning_rate=rate))


def of_width(units: int) -> Case:
    def waving() -> gym.Env[Any, Any]:
        return Counting(pays=lambda t, a: 3 * math.cos(t / 3), shows=lambda t, rng: [t / 15 - 1, 0.0])

    return case_of(waving, two_layers(units))


def one_of_a_sweep(*returns: float) -> Case:
    case = case_of(alternating, lambda s: np.eye(2)[[0] * len(s)])
    return replace(case, subject=replace(load_subject(lambda s: np.eye(2)[[0] * len(s)]), siblings=returns))


def unseeded() -> Case:
    rng = np.random.default_rng()
    return shown(lambda t, _: [rng.random()])


def with_fault(name: str) -> Case:
    return stored_case(**FAULTS[name][1])


def learned_by_heart() -> Case:
    """Rewards as the values of the data say, and others on fresh experience."""
    return stored_case(reward=np.array([i - GAMMA * (i + 1) + 0.01 for i in experience()["obs"][:, 0]]))


def uniform(t: int, rng: np.random.Generator) -> list[float]:
    return [rng.random()]


def normal(t: int, rng: np.random.Generator) -> list[float]:
    return [rng.normal(), rng.normal()]


def by_equation(beta: float) -> Case:
    return ending(lambda t: summed(t, lambda i: waves(i, 0), gamma=beta), pays=waves)


def always(a: int) -> Callable[[Array], Array]:
    return lambda s: np.eye(2)[[a] * len(s)]


Made = Callable[[], Case]
TWINS: dict[str, tuple[Made, Made]] = {  # ill, and well
    "V1": (lambda: case_of(alternating, always(0)), lambda: case_of(alternating, on_the_beat)),
    "V2": (lambda: right(1.2), right),
    "V3": (lambda: ending(lambda t: worth(ENDS - t, 0.5)), right),
    "V3a": (lambda: by_equation(0.5), lambda: by_equation(GAMMA)),
    "V4": (lambda: right(1.2), right),
    "V5": (lambda: copied(21), lambda: copied(22)),  # 1 − 0.9²¹ = 0.891, and 0.902
    "V6": (lambda: ending(lambda t: t), right),
    "V6a": (lambda: case_of(alternating, lambda s: 1 - on_the_beat(s)), lambda: case_of(alternating, on_the_beat)),
    "V7": (lambda: of_frozen_lake(best=False), lambda: of_frozen_lake(best=True)),
    "V7a": (lambda: of_frozen_lake(best=False), lambda: of_frozen_lake(best=True)),
    "V8": (learned_by_heart, lambda: stored_case(reward=np.ones(600))),
    "E1": (lambda: shown(lambda t, rng: [math.nan if t == 3 else 0.0]), right),
    "E2": (unseeded, lambda: shown(uniform)),
    "E3": (lambda: shown(normal), lambda: shown(normal, ends=None, cuts=ENDS)),
    "E4": (lambda: shown(lambda t, rng: [rng.random(), 101 * rng.random()]), lambda: shown(uniform)),
    "E5": (lambda: ending(np.abs, pays=lambda t, a: -10.1), lambda: ending(np.abs, pays=lambda t, a: -9.9)),
    "E6": (lambda: case_of(lambda: Turning(1), both(np.abs)), lambda: case_of(lambda: Turning(2), both(np.abs))),
    "D1": (lambda: with_fault("D1 at the limit"), stored_case),
    "D2": (lambda: with_fault("D2"), stored_case),
    "D3": (lambda: stored_case(**{name: column[:80] for name, column in experience().items()}), stored_case),
    "D3a": (lambda: trained(capacity=100.0, batch_size=64.0), lambda: trained(capacity=1e4, batch_size=64.0)),
    "D4": (lambda: with_fault("D4"), stored_case),
    "D4a": (lambda: trained(epsilon_start=0.0, epsilon_end=0.0), lambda: trained(epsilon_start=1.0, epsilon_end=0.0)),
    "D5": (lambda: with_fault("D5"), stored_case),
    "R1": (lambda: changed(silenced), lambda: changed(untouched)),
    "R2": (lambda: changed(one_unit_in_all), lambda: changed(untouched)),
    "R3": (lambda: stepping(0.99), lambda: stepping(0.5)),
    "R4": (lambda: moving(1.0), lambda: moving(1e-9)),
    "R5": (lambda: changed(dead, 600), lambda: changed(untouched, 600)),  # fewer cannot fit it even when they are fresh
    "R6": (lambda: lagging(0.6), lambda: lagging(0.4)),
    "R6a": (lambda: changed(untouched), lambda: changed(tripled)),
    "R7": (lambda: of_width(1), lambda: of_width(64)),
    "X5": (lambda: one_of_a_sweep(10.0, 20.0, 10.0), lambda: one_of_a_sweep(10.0, 10.0, 10.0)),
}
SLOW = {"R5", "R7"}  # they train networks


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in examination._MEASUREMENTS]
)
def test_what_is_ill_is_flagged_and_its_healthy_twin_is_not(name: str) -> None:
    ill, well = TWINS[name]
    found = [examination._MEASUREMENTS[name](make()) for make in (ill, well)]
    assert all(isinstance(one, Finding) and one.id == name for one in found)
    assert [one.flagged for one in found if isinstance(one, Finding)] == [True, False]
