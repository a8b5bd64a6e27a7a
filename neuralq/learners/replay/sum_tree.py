"""A sum tree: draws leaf i with probability w_i / Σ w, and changes a weight, both in O(log N).

The tree is one array: node 1 is the root, node k has the children 2k and 2k + 1, and the leaves are its second half.
Every inner node is recomputed as the sum of its two children when a leaf below it changes, so rounding never
accumulates over updates (adding differences would).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neuralq.checks import check_whole
from neuralq.jit import kernel
from neuralq.types import Floats, Indices

__all__ = ["SumTree"]


class SumTree:
    """Leaf i is found with probability w_i / Σ w; setting a weight and finding a leaf take O(log N).

    Args:
        num_leaves: how many weights there are; all start at 0.

    Attributes:
        nodes: the tree as one float64 array (for kernels that walk it themselves).

    Example:
        >>> import numpy as np
        >>> tree = SumTree(3)
        >>> tree.set(np.array([0, 2]), np.array([1.0, 3.0]))
        >>> tree.total
        4.0
        >>> tree.find(np.array([0.5, 1.0, 3.9])).tolist()
        [0, 2, 2]
    """

    __slots__ = ("nodes", "num_leaves")

    def __init__(self, num_leaves: int) -> None:
        check_whole("num_leaves", num_leaves)
        self.num_leaves = int(num_leaves)
        self.nodes: Floats = np.zeros(2 * (1 << (self.num_leaves - 1).bit_length()))

    @property
    def total(self) -> float:
        """Σ w."""
        return float(self.nodes[1])

    @property
    def weights(self) -> Floats:
        """The weights ``[num_leaves]``: a view, to be read only."""
        half = self.nodes.size // 2
        return self.nodes[half : half + self.num_leaves]

    def set(self, indices: Indices, weights: Floats) -> None:
        """The leaves ``indices`` weigh ``weights`` from now on; a leaf named twice keeps the later weight.

        Raises:
            ValueError: an index out of range, or a weight that is negative or not finite; nothing is changed then.
        """
        indices, weights = np.asarray(indices, np.int64), np.asarray(weights, np.float64)
        if indices.shape != weights.shape or indices.ndim != 1:
            raise ValueError(f"indices and weights must be two equally long rows, got {indices.shape}, {weights.shape}")
        if indices.size and not (indices.min() >= 0 and indices.max() < self.num_leaves):
            raise ValueError(f"indices must lie in [0, {self.num_leaves}), got {indices.min()} to {indices.max()}")
        sound = np.isfinite(weights) & (weights >= 0)
        if not sound.all():
            raise ValueError(f"weights must be finite and not negative, got {weights[~sound][0]}")
        set_leaves(self.nodes, indices, weights)

    def load(self, weights: Floats) -> None:
        """All weights at once ``[num_leaves]``, in O(N)."""
        half = self.nodes.size // 2
        self.nodes[half : half + self.num_leaves] = weights
        rebuild(self.nodes)

    def find(self, masses: Floats) -> Indices:
        """For each mass x in [0, Σ w): the leaf i with Σ_{j<i} w_j ≤ x < Σ_{j≤i} w_j. Never a leaf of weight 0.

        Raises:
            ValueError: the tree is empty (Σ w = 0), or a mass lies outside [0, Σ w).
        """
        masses = np.asarray(masses, np.float64)
        if self.total <= 0:
            raise ValueError("every weight is 0, so there is no leaf to find; set a weight first")
        if masses.size and not (masses.min() >= 0 and masses.max() < self.total):
            raise ValueError(f"masses must lie in [0, {self.total!r}), got {masses.min()!r} to {masses.max()!r}")
        found = np.empty(masses.shape, np.int64)
        find_leaves(self.nodes, masses, found)
        return found

    def state_dict(self) -> dict[str, Any]:
        """The weights, copied; the inner nodes follow from them."""
        return {"weights": self.weights.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The tree that `state_dict` described, node for node.

        Raises:
            ValueError: another number of leaves.
        """
        weights = np.asarray(state["weights"], np.float64)
        if weights.shape != (self.num_leaves,):
            raise ValueError(f"state holds {weights.shape} weights, this tree has {self.num_leaves} leaves")
        self.load(weights)


@kernel
def set_leaf(nodes: Floats, index: int, weight: float) -> None:
    """One leaf and the path above it; each parent is the sum of its children."""
    node = nodes.size // 2 + index
    nodes[node] = weight
    node //= 2
    while node >= 1:
        nodes[node] = nodes[2 * node] + nodes[2 * node + 1]
        node //= 2


@kernel
def set_leaves(nodes: Floats, indices: Indices, weights: Floats) -> None:
    """`set_leaf` for each index, in order."""
    for i in range(indices.size):
        set_leaf(nodes, indices[i], weights[i])


@kernel
def rebuild(nodes: Floats) -> None:
    """All inner nodes from the leaves."""
    for node in range(nodes.size // 2 - 1, 0, -1):
        nodes[node] = nodes[2 * node] + nodes[2 * node + 1]


@kernel
def find_leaves(nodes: Floats, masses: Floats, found: Indices) -> None:
    """The leaf under each mass; where rounding pushes a mass past the last leaf, an empty subtree is not entered."""
    half = nodes.size // 2
    for i in range(masses.size):
        mass = masses[i]
        node = 1
        while node < half:
            left = nodes[2 * node]
            if mass < left or nodes[2 * node + 1] == 0.0:
                node = 2 * node
            else:
                mass -= left
                node = 2 * node + 1
        found[i] = node - half
