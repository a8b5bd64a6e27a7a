"""(I − cP)⁻¹ Y by three ways, against a dense solution.

Mutants that die here: the order of rows not undone, GMRES left out for columns that BiCGSTAB leaves, P transposed.
"""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
from scipy import sparse

from neuralq.exact import resolvent, td_operator
from neuralq.exact import resolvent as resolvent_function
from neuralq.mdp import FiniteMDP


def random_chain(n: int, branching: int, seed: int) -> sparse.csr_array:
    rng = np.random.default_rng(seed)
    entries = (rng.dirichlet(np.ones(branching), n).reshape(-1),
               (np.repeat(np.arange(n), branching), rng.integers(0, n, n * branching)))  # fmt: skip
    return sparse.csr_array(sparse.coo_array(entries, shape=(n, n)))


def walk(n: int, seed: int) -> sparse.csr_array:
    """A walk that leaves at both ends, its states numbered at random."""
    order = np.random.default_rng(seed).permutation(n)
    P = sparse.csr_array(sparse.diags_array([np.full(n - 1, 0.5), np.full(n - 1, 0.5)], offsets=[-1, 1]))
    return sparse.csr_array(P[order][:, order])


@pytest.mark.parametrize("shape", [(), (3,)])
@pytest.mark.parametrize("chain", [random_chain(700, 6, 0), walk(700, 1), random_chain(60, 3, 2)])
@pytest.mark.parametrize("scale", [0.5, 0.99])
def test_every_way_agrees_with_lapack(
    chain: sparse.csr_array, scale: float, shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    n = chain.shape[0]
    Y = np.random.default_rng(3).normal(size=(n, *shape))
    exact = np.linalg.solve(np.eye(n) - scale * chain.toarray(), Y)
    assert resolvent(chain.toarray(), Y, scale) == pytest.approx(exact, rel=1e-11)
    assert resolvent(chain, Y, scale) == pytest.approx(exact, rel=1e-9, abs=1e-11)
    module = __import__("sys").modules[resolvent_function.__module__]
    monkeypatch.setattr(module, "LARGEST_FACTOR", 0)
    assert resolvent(chain, Y, scale) == pytest.approx(exact, rel=1e-9, abs=1e-10)
    monkeypatch.setattr(module, "MOST_ITERATIONS", 1)  # everything is left to GMRES
    assert resolvent(chain, Y, scale) == pytest.approx(exact, rel=1e-9, abs=1e-10)


def test_chains_that_mix_too_slowly_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    module = __import__("sys").modules[resolvent_function.__module__]
    monkeypatch.setattr(module, "LARGEST_FACTOR", 0)
    monkeypatch.setattr(module, "MOST_ITERATIONS", 1)
    slow = walk(1500, 0)
    with pytest.raises(ValueError, match="mixes too slowly"):
        resolvent(slow, np.ones(1500), 1.0)


def test_a_sparse_chain_gives_the_same_operator() -> None:
    rng = np.random.default_rng(4)
    P, X, r, d = random_chain(600, 4, 5), rng.normal(size=(600, 5)), rng.normal(size=600), rng.dirichlet(np.ones(600))
    for lambda_ in (0.0, 0.8):
        A, b = td_operator(P, r, X, d, 0.95, lambda_)
        A_dense, b_dense = td_operator(P.toarray(), r, X, d, 0.95, lambda_)
        assert A == pytest.approx(A_dense, rel=1e-10, abs=1e-13)
        assert b == pytest.approx(b_dense, rel=1e-10, abs=1e-13)


def test_what_mixes_in_a_few_steps_is_iterated_to_its_end_without_help(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*args: object, **kwargs: object) -> None:
        raise AssertionError("nothing is left for it")

    module = import_module("neuralq.exact.resolvent")  # whose name is that of its function, too
    monkeypatch.setattr(module, "gmres", refused)
    chain = FiniteMDP.garnet(60, 1, 5, seed=0).transition
    system = sparse.csr_array(sparse.eye_array(60) - 0.9 * chain)
    right = np.random.default_rng(0).normal(size=(60, 40))  # more columns than one block has
    assert module._iterate(system, right) == pytest.approx(np.linalg.solve(system.toarray(), right), rel=1e-10)
