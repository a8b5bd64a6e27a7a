"""One vector behind all parameters: what is written to the one is read from the other, and autograd keeps it so.

Mutants that these tests kill: copies instead of views (of values, or of gradients); a wrong order or offset; gradients
replaced instead of accumulated; a load that rebinds the vector, or that broadcasts; a hash of part of the bytes.
"""

from __future__ import annotations

import hashlib
from typing import Any

import pytest
import torch
from torch import nn

from neuralq.q import MLP, ActionInputQ, ActionOutputQ, Conv, FlatParameters, LinearQ, SeparateQ, TableQ

MODULES: dict[str, Any] = {
    "table": lambda: TableQ(3, 2),
    "linear": lambda: LinearQ(3, 2, bias=True),
    "separate": lambda: SeparateQ((3,), 2, MLP((4,), layer_norm=True)),
    "conv": lambda: ActionOutputQ((1, 4, 4), 2, Conv((2,), (3,), (1,), (4,))),
    "action input": lambda: ActionInputQ((3,), 2, MLP((4, 4))),
}


@pytest.mark.parametrize("name", MODULES)
def test_parameters_and_gradients_are_views_in_order(name: str) -> None:
    q = MODULES[name]()
    before = [p.detach().clone() for p in q.parameters()]
    flat = FlatParameters(q)
    assert torch.equal(flat.values, torch.cat([p.reshape(-1) for p in before])), "the values stay"
    assert flat.grad.shape == flat.values.shape and not flat.grad.any()
    numbers = torch.arange(float(len(flat.values)), dtype=flat.values.dtype)
    flat.values.copy_(numbers)
    flat.grad.copy_(-numbers)
    start = 0
    for p in q.parameters():
        end = start + p.numel()
        assert flat.offset(p) == start
        assert p.detach().reshape(-1).tolist() == list(range(start, end))
        assert p.grad.reshape(-1).tolist() == [-float(i) for i in range(start, end)]
        assert p.data_ptr() == flat.values.data_ptr() + start * flat.values.element_size()
        p.data.neg_()
        start = end
    assert start == len(flat.values) and torch.equal(flat.values, -numbers)


def test_autograd_accumulates_in_place() -> None:
    """Q(s, a) = w_a·s: the gradient of Q([1, 2], 1) is [0, 0, 1, 2]; a second backward doubles it."""
    q = LinearQ(2, 2)
    flat = FlatParameters(q)
    address = flat.grad.data_ptr()
    for times in (1, 2):
        q.at(torch.tensor([1.0, 2.0]), torch.tensor(1)).backward()
        assert flat.grad.tolist() == [0.0, 0.0, 1.0 * times, 2.0 * times]
    assert q.weight.grad is not None and q.weight.grad.data_ptr() == address == flat.grad.data_ptr()


def test_load_is_in_place_and_refuses_another_network() -> None:
    q = TableQ(2, 2)
    flat = FlatParameters(q)
    vector = flat.values
    flat.load(torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64))
    assert flat.values is vector and q.weight.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    for wrong in (torch.zeros(5), torch.zeros(1), torch.zeros(2, 2), torch.zeros(())):
        with pytest.raises(ValueError, match=r"has 4 parameters, the saved one has \d"):
            flat.load(wrong)
    assert q.weight.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_the_hash_is_of_every_bit() -> None:
    flat = FlatParameters(LinearQ(3, 2, dtype=torch.float32))
    assert flat.sha256() == hashlib.sha256(bytes(24)).hexdigest()
    seen = {flat.sha256()}
    bits = flat.values.view(torch.int32)
    for i in range(6):
        for bit in (0, 31):  # the last bit of the fraction; the sign
            bits[i] ^= 1 << bit if bit < 31 else -(1 << 31)
            seen.add(flat.sha256())
    assert len(seen) == 13
    flat.load(torch.zeros(6))
    assert flat.sha256() == hashlib.sha256(bytes(24)).hexdigest()
    flat.values[0] = 1.0
    assert flat.sha256() == hashlib.sha256(b"\x00\x00\x80\x3f" + bytes(20)).hexdigest()  # 1 is 3f800000


def test_modules_that_make_no_vector_are_refused() -> None:
    with pytest.raises(ValueError, match="ReLU has no parameters to learn"):
        FlatParameters(nn.ReLU())
    mixed = nn.ModuleList([TableQ(1, 1), TableQ(1, 1, dtype=torch.float32)])
    with pytest.raises(ValueError, match="must share one dtype and device"):
        FlatParameters(mixed)
