"""The value network of backgammon: 198 inputs, one hidden layer, one or four outputs, all sigmoids."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_bytes
from safetensors.numpy import save_file

from neuralq.checks import check_choice, check_positive, check_whole
from neuralq.systems.backgammon.kernels import evaluate, new_scratch
from neuralq.types import Array
from neuralq_envs.backgammon.expert import NUM_EXPERT
from neuralq_envs.backgammon.inputs import NUM_INPUTS
from neuralq_envs.backgammon.rules import Board

__all__ = ["ValueNetwork", "equities"]


class ValueNetwork:
    """Outcome chances of a position, as the side to move sees it (`neuralq.systems.backgammon.kernels`).

    All weights are views into one vector, ``flat``. A network is not safe to share between threads: it owns the
    scratch that its values are computed in.

    Args:
        num_hidden: hidden units H.
        num_outputs: 6 (plain win, gammon, backgammon, and the same lost), 4 (a backgammon counts as a gammon) or 1
            (win).
        dtype: float32 or float64.
        expert: whether it is also shown the fourteen numbers of `neuralq_envs.backgammon.expert`.

    Raises:
        ValueError: for other numbers of outputs, other types, or no hidden unit.

    Example:
        >>> from neuralq_envs.backgammon.rules import START
        >>> network = ValueNetwork(40)
        >>> network.flat.size, network.outputs(START[None]).tolist()  # zero weights know nothing
        (8124, [[0.5, 0.5, 0.5, 0.5]])
    """

    def __init__(self, num_hidden: int, num_outputs: int = 4, dtype: Any = np.float32, expert: bool = False) -> None:
        check_whole("num_hidden", num_hidden)
        check_choice("num_outputs", num_outputs, (1, 4, 6))
        self.dtype = np.dtype(dtype)
        check_choice("dtype", self.dtype.name, ("float32", "float64"))
        num_rows = NUM_INPUTS + 1 + (NUM_EXPERT if expert else 0)
        sizes = np.cumsum([num_rows * num_hidden, num_outputs * num_hidden, num_outputs])
        self.flat: Array = np.zeros(sizes[-1], self.dtype)
        self.w: Array = self.flat[: sizes[0]].reshape(num_rows, num_hidden)
        self.v: Array = self.flat[sizes[0] : sizes[1]].reshape(num_outputs, num_hidden)
        self.c: Array = self.flat[sizes[1] :]
        self.scratch = new_scratch(num_hidden, num_outputs, self.dtype)

    @classmethod
    def drawn(
        cls,
        num_hidden: int,
        num_outputs: int,
        rng: np.random.Generator,
        *,
        scale: float = 0.1,
        dtype: Any = np.float32,
        expert: bool = False,
    ) -> ValueNetwork:
        """A network with weights uniform in ±``scale``, and outputs without a bias.

        Example:
            >>> bool(abs(ValueNetwork.drawn(40, 4, np.random.default_rng(0)).flat).max() < 0.1)
            True
        """
        check_positive("scale", scale)
        network = cls(num_hidden, num_outputs, dtype, expert)
        for weights in (network.w, network.v):
            weights[:] = rng.uniform(-scale, scale, weights.shape)
        return network

    @property
    def num_hidden(self) -> int:
        """H."""
        return int(self.w.shape[1])

    @property
    def num_outputs(self) -> int:
        """K: 6, 4 or 1."""
        return len(self.c)

    @property
    def expert(self) -> bool:
        """Whether it is shown more than Tesauro's inputs."""
        return len(self.w) > NUM_INPUTS + 1

    def outputs(self, boards: Board) -> Array:
        """Chances ``[n, K]`` of the sides to move in boards ``[n, 2, 25]``; certainties where the game is over."""
        y = np.empty((len(boards), self.num_outputs), self.dtype)
        evaluate(np.require(boards, np.int8, ["C", "W"]), self.w, self.v, self.c, self.scratch, y)
        return y

    def copy(self) -> ValueNetwork:
        """The same weights, with scratch of its own."""
        other = ValueNetwork(self.num_hidden, self.num_outputs, self.dtype, self.expert)
        other.flat[:] = self.flat
        return other

    def sha256(self) -> str:
        """Of the bytes of all weights."""
        return hashlib.sha256(self.flat.tobytes()).hexdigest()

    def save(self, path: str | Path, notes: dict[str, str] | None = None) -> None:
        """Weights into one safetensors file; ``notes`` go into its header."""
        save_file({"w": self.w, "v": self.v, "c": self.c}, str(path), {"kind": "backgammon-values", **(notes or {})})

    @classmethod
    def load(cls, path: str | Path) -> ValueNetwork:
        """What `save` wrote.

        Raises:
            ValueError: the file is missing, damaged, or holds something else.
        """
        try:
            tensors = load_bytes(Path(path).read_bytes())  # it opens no path that is not UTF-8
        except (OSError, SafetensorError, KeyError, ValueError) as error:  # of kinds that NumPy does not have
            raise ValueError(
                f"{path} cannot be read as weights ({error}); train some: neuralq train td-gammon"
            ) from error
        shapes = {name: tensor.shape for name, tensor in tensors.items()}
        num_outputs, num_hidden = shapes.get("v", (0, 0))
        expert = shapes.get("w") == (NUM_INPUTS + 1 + NUM_EXPERT, num_hidden)
        num_rows = NUM_INPUTS + 1 + (NUM_EXPERT if expert else 0)
        expected = {"w": (num_rows, num_hidden), "v": (num_outputs, num_hidden), "c": (num_outputs,)}
        if shapes != expected:
            raise ValueError(f"{path} holds no backgammon network: expected arrays w, v and c, got {shapes}")
        network = cls(num_hidden, num_outputs, tensors["w"].dtype, expert)
        network.w[:], network.v[:], network.c[:] = tensors["w"], tensors["v"], tensors["c"]
        return network


def equities(y: Array) -> NDArray[np.float64]:
    """Points that the side to move expects, from ``[..., K]``: Σₖ (k + 1)(yₖ − yₖ₊ₘ), m = K/2, or 2y₀ − 1 where K = 1.

    Example:
        >>> equities(np.array([[0.5, 0.25, 0.25, 0.0]])).tolist()
        [0.75]
    """
    y = np.asarray(y, np.float64)
    if y.shape[-1] == 1:
        return 2.0 * y[..., 0] - 1.0
    kinds = y.shape[-1] // 2
    lead: NDArray[np.float64] = (y[..., :kinds] - y[..., kinds:]) @ np.arange(1.0, kinds + 1)
    return lead
