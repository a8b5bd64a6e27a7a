"""Representations are modules like any other: called, traced, compiled, exported and profiled.

Mutants that must die here: a call that is another function than ``all`` · a batch size that is remembered.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from neuralq.q import (
    MLP,
    ActionInputQ,
    ActionOutputQ,
    CategoricalQ,
    Conv,
    DuelingQ,
    FlatParameters,
    ImplicitQuantileQ,
    LinearQ,
    MaskedQ,
    QuantileQ,
    SeparateQ,
    TableQ,
)

SMALL = MLP((8,), layer_norm=True)
CASES: dict[str, Any] = {
    "table": lambda: TableQ(5, 3),
    "linear": lambda: LinearQ(4, 3),
    "action-output": lambda: ActionOutputQ(4, 3, SMALL),
    "action-input": lambda: ActionInputQ(4, 3, SMALL),
    "separate": lambda: SeparateQ(4, 3, SMALL),
    "dueling": lambda: DuelingQ(4, 3, MLP((8, 8))),
    "quantile": lambda: QuantileQ(ActionOutputQ(4, 15, SMALL), 5),
    "categorical": lambda: CategoricalQ(ActionOutputQ(4, 15, SMALL), 5, -1.0, 1.0),
    "implicit": lambda: ImplicitQuantileQ(ActionOutputQ(4, 3, SMALL)),
    "masked": lambda: MaskedQ(ActionOutputQ(4, 3, SMALL), (4,)),
    "frames": lambda: ActionOutputQ((10, 10, 4), 3, Conv()),
}


def observations(case: str, n: int) -> Tensor:
    g = torch.Generator().manual_seed(n)
    if case == "table":
        return torch.randint(0, 5, (n,), generator=g)
    if case == "frames":
        return torch.randint(0, 2, (n, 10, 10, 4), generator=g).bool()
    s = torch.randn(n, 4, generator=g)
    return torch.cat([s, torch.randint(0, 2, (n, 3), generator=g).clamp(min=0)], 1) if case == "masked" else s


@pytest.mark.parametrize("case", CASES)
def test_a_call_gives_all_values_and_can_be_exported_for_any_batch(case: str) -> None:
    q, few, many = CASES[case](), observations(case, 2), observations(case, 7)
    for parameter in q.parameters():  # some start at 0
        parameter.data += torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    expected = q.all(many)
    assert torch.equal(q(many), expected)
    exported = torch.export.export(q, (few,), dynamic_shapes=({0: torch.export.Dim("n")},))
    assert torch.equal(exported.module()(many), expected)


@pytest.mark.parametrize("case", ["table", "separate", "masked"])
@pytest.mark.filterwarnings("ignore:`torch.jit.trace:DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_modules_trace_compile_and_profile(case: str) -> None:
    q, few, many = CASES[case](), observations(case, 2), observations(case, 7)
    assert torch.equal(torch.jit.trace(q, few)(many), q.all(many))  # type: ignore[no-untyped-call]
    compiled: Any = torch.compile(q, backend="eager", fullgraph=True, dynamic=True)
    assert torch.equal(compiled(many), q.all(many))
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        q(many)
    assert profile.key_averages()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch's own
def test_modules_compile_to_code() -> None:
    q, many = CASES["action-output"](), observations("action-output", 7)
    torch.testing.assert_close(torch.compile(q)(many), q.all(many), rtol=1e-5, atol=1e-6)


def test_places_in_the_flat_vector_bear_the_names_of_layers() -> None:
    q = SeparateQ(4, 3, SMALL)
    flat = FlatParameters(q)
    named = {
        name: flat.values[start : start + int(torch.Size(shape).numel())].view(shape)
        for name, (start, shape) in flat.layers.items()
    }
    state = q.state_dict()
    assert list(named) == [name for name, _ in q.named_parameters()] and named.keys() == state.keys()
    assert all(torch.equal(named[name], state[name]) for name in state)
    assert isinstance(q, nn.Module)
