"""TD(λ) self-play: one network plays both sides, and every position is taught by what came after it.

Two ways to learn from the same games:

* online: Tesauro's own. Eligibility traces, an update after every turn, each game played by weights that have learned
  from all turns before; the step size is that of plain gradient steps.
* batched: a batch of games is played with fixed weights, on as many cores as there are threads; the λ-returns of all
  turns are then fitted by one step of Adam along the mean gradient.

Both run on compiled loops, or on PyTorch (`neuralq.systems.backgammon.torch_engine`), which can use a GPU.

The two are equal where the step size is so small that a game changes nothing (tests/test_backgammon_learning).

Sources: Tesauro (1992), "Practical issues in temporal difference learning"; Tesauro (1995), "Temporal difference
learning and TD-Gammon"; Sutton & Barto (2018), section 16.1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.learners.optim import FlatOptimiser, Optimiser
from neuralq.systems.backgammon import torch_engine
from neuralq.systems.backgammon.kernels import new_scratch
from neuralq.systems.backgammon.learning_kernels import play_batch, play_online
from neuralq.systems.backgammon.network import ValueNetwork

__all__ = ["MOST_THREADS", "SelfPlay", "SelfPlaySettings"]

MOST_THREADS = 16

# What did best of a few tried over 50,000 to 100,000 games with 80 hidden units (docs/td-gammon.md). Tesauro's own are
# said to have been λ = 0.7 and α = 0.1.
_STEP_SIZES = {"online": 0.3, "batched": 0.01}
_FALL = 30.0
_MOST_OF_ADAM = 0.1


@dataclass(frozen=True)
class SelfPlaySettings:
    """How a network learns from games against itself.

    Args:
        num_games: games of the whole run, over which the schedules go.
        num_hidden: hidden units.
        num_outputs: 6 (plain win, gammon, backgammon, and the same lost), 4 (as Tesauro: a backgammon counts as a
            gammon), or 1 (win), which knows nothing of gammons.
        inputs: "tesauro" (198 of the bare board) or "expert" (14 more, `neuralq_envs.backgammon.expert`).
        mode: "online" or "batched".
        lambda_: λ in [0, 1] at the beginning.
        lambda_end: λ at the end, linear in between; None keeps it.
        step_size: α at the beginning: of each turn's step (online, by default 0.3), or Adam's (batched, 0.01).
        step_size_end: α at the end, by default a thirtieth; in between it falls by the same factor in every game.
        batch_games: games between two steps, shared evenly by the threads; batched mode only.
        num_threads: cores that play; more than one in batched mode only. Part of what a seed stands for.
        weight_scale: initial weights are uniform in ± this.
        dtype: "float32" or "float64".
        engine: "compiled" or "torch" (`neuralq.systems.backgammon.torch_engine`, which can use a GPU). The same
            games and weights to rounding if online; batched, the dice of each game are drawn in another way.
        device: where the torch engine computes: "cpu", "cuda", "cuda:1" and so on.

    Raises:
        ValueError: values outside their range, or that would be ignored.
    """

    num_games: int = 300_000
    num_hidden: int = 80
    num_outputs: int = 4
    inputs: str = "tesauro"
    mode: str = "online"
    lambda_: float = 0.3
    lambda_end: float | None = None
    step_size: float = None  # type: ignore[assignment]  # never None once it is made
    step_size_end: float = None  # type: ignore[assignment]
    batch_games: int = 8
    num_threads: int = 1
    weight_scale: float = 0.1
    dtype: str = "float32"
    engine: str = "compiled"
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        for name in ("num_games", "num_hidden", "batch_games", "num_threads"):
            check_whole(name, getattr(self, name))
        check_choice("num_outputs", self.num_outputs, (1, 4, 6))
        check_choice("inputs", self.inputs, ("tesauro", "expert"))
        check_choice("mode", self.mode, ("online", "batched"))
        check_choice("dtype", self.dtype, ("float32", "float64"))
        check_choice("engine", self.engine, ("compiled", "torch"))
        check_fraction("lambda_", self.lambda_)
        if self.lambda_end is not None:
            check_fraction("lambda_end", self.lambda_end)
        if self.step_size is None:
            object.__setattr__(self, "step_size", _STEP_SIZES[self.mode])
        if self.step_size_end is None:
            object.__setattr__(self, "step_size_end", self.step_size / _FALL)
        for name in ("step_size", "step_size_end", "weight_scale"):
            check_positive(name, getattr(self, name))
        if self.mode == "batched" and self.step_size > _MOST_OF_ADAM:
            raise ValueError(
                f"batched mode takes steps of Adam, each as large as step_size: got {self.step_size}; "
                f"use about {_STEP_SIZES['batched']}"
            )
        self._check_where_it_runs()

    def _check_where_it_runs(self) -> None:
        if self.engine == "compiled" and self.device != "cpu":
            raise ValueError(f"the compiled engine runs on the CPU, got device={self.device!r}; use engine='torch'")
        if self.engine == "torch" and self.num_threads > 1:
            raise ValueError(
                f"the torch engine plays a batch in lockstep, got num_threads={self.num_threads}; "
                "leave it at 1 (torch.set_num_threads is what it heeds)"
            )
        if self.mode == "online" and self.num_threads > 1:
            raise ValueError(
                f"online learning is one game after another, got num_threads={self.num_threads}; "
                "use mode='batched', or train several seeds side by side"
            )
        if self.num_threads > MOST_THREADS:
            raise ValueError(f"num_threads must be at most {MOST_THREADS}, got {self.num_threads}")
        if self.batch_games % self.num_threads != 0:
            raise ValueError(
                f"batch_games={self.batch_games} games cannot be shared evenly by num_threads={self.num_threads}"
            )

    def step_sizes(self, games: NDArray[np.int64]) -> NDArray[np.float64]:
        """α of the games with these numbers, counted from 0.

        Example:
            >>> SelfPlaySettings(num_games=100, step_size=0.1, step_size_end=0.001).step_sizes(np.array([0, 50]))
            array([0.1 , 0.01])
        """
        falls = math.log(self.step_size_end / self.step_size)
        return self.step_size * np.exp(falls * np.minimum(games / self.num_games, 1.0))

    def lambdas(self, games: NDArray[np.int64]) -> NDArray[np.float64]:
        """λ of the games with these numbers, counted from 0.

        Example:
            >>> SelfPlaySettings(num_games=100, lambda_=0.8, lambda_end=0.4).lambdas(np.array([0, 50]))
            array([0.8, 0.6])
        """
        end = self.lambda_ if self.lambda_end is None else self.lambda_end
        return self.lambda_ + (end - self.lambda_) * np.minimum(games / self.num_games, 1.0)


class SelfPlay:
    """A network, the dice, and how far the games have come.

    Args:
        settings: how to learn.
        seed: of the weights and the dice.

    Example:
        >>> learner = SelfPlay(SelfPlaySettings(num_hidden=10), seed=0)
        >>> learner.play(2)
        >>> learner.num_games, int(learner.tally[:3].sum())  # plain wins, gammons, backgammons
        (2, 2)
    """

    def __init__(self, settings: SelfPlaySettings, seed: int) -> None:
        check_whole("seed", seed, 0)
        self.settings = settings
        weights, *dice = (
            np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(1 + MOST_THREADS)
        )
        self.network = ValueNetwork.drawn(
            settings.num_hidden, settings.num_outputs, weights,
            scale=settings.weight_scale, dtype=settings.dtype, expert=settings.inputs == "expert",
        )  # fmt: skip
        self.num_games = 0
        self.tally = np.zeros(4, np.int64)  # plain games, gammons, backgammons, turns
        self._dice = dice[: settings.num_threads]
        self._batch = _batch(self.network, settings) if settings.mode == "batched" else None
        online = settings.mode == "online" and settings.engine == "torch"
        self._torch = torch_engine.TorchValues(self.network, settings.device) if online else None

    def play(self, num_games: int) -> None:
        """Plays so many games and learns from them; in batched mode a multiple of ``batch_games``.

        Raises:
            ValueError: no whole number of batches.
        """
        check_whole("num_games", num_games)
        if self._batch is None:
            net, games = self.network, self.num_games + np.arange(num_games)
            rates, lambdas = self.settings.step_sizes(games), self.settings.lambdas(games)
            if self._torch is None:
                play_online(rates, lambdas, self._dice[0], net.w, net.v, net.c, net.scratch, self.tally)
            else:
                self._torch.read(net)
                torch_engine.play_online(self._torch, rates, lambdas, self._dice[0], self.tally)
                self._torch.write(net)
            self.num_games += num_games
            return
        size = self.settings.batch_games
        if num_games % size != 0:
            raise ValueError(f"num_games must be a multiple of batch_games={size}, got {num_games}")
        for first in range(self.num_games, self.num_games + num_games, size):
            at = np.array([first])
            rate, lambda_ = self.settings.step_sizes(at)[0], self.settings.lambdas(at)[0]
            self._batch.step(float(rate), float(lambda_), self._dice, self.tally)
        self.num_games += num_games

    def state_dict(self) -> dict[str, Any]:
        """Weights, dice, counters and, in batched mode, the optimiser."""
        return {
            "weights": self.network.flat.copy(),
            "num_games": self.num_games,
            "tally": self.tally.copy(),
            "dice": [rng.bit_generator.state for rng in self._dice],
            "optimiser": None if self._batch is None else _copied(self._batch.optimiser.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict`, bit for bit.

        Raises:
            ValueError: a state of other settings.
        """
        weights = np.asarray(state["weights"])
        if weights.shape != self.network.flat.shape or weights.dtype != self.network.dtype:
            raise ValueError(
                f"the state is of {weights.size} weights in {weights.dtype}, and the settings ask for "
                f"{self.network.flat.size} in {self.network.dtype}; keep the run's settings"
            )
        if len(state["dice"]) != len(self._dice) or (state["optimiser"] is None) != (self._batch is None):
            raise ValueError("the state is of another mode or number of threads; keep the run's settings")
        self.network.flat[:] = weights
        self.num_games = int(state["num_games"])
        self.tally[:] = state["tally"]
        for rng, saved in zip(self._dice, state["dice"], strict=True):
            rng.bit_generator.state = saved
        if self._batch is not None:
            self._batch.optimiser.load_state_dict(state["optimiser"])


def _copied(state: dict[str, Any]) -> dict[str, Any]:
    """A state that later steps do not change, on the CPU."""
    return {name: value.cpu().clone() if isinstance(value, torch.Tensor) else value for name, value in state.items()}


def _batch(network: ValueNetwork, settings: SelfPlaySettings) -> _Batch | torch_engine.TorchBatch:
    if settings.engine == "torch":
        return torch_engine.TorchBatch(network, settings.batch_games, settings.device)
    return _Batch(network, settings)


class _Batch:
    """Plays a batch of games on all threads, and takes one step. Each thread has dice, scratch and sums of its own."""

    def __init__(self, network: ValueNetwork, settings: SelfPlaySettings) -> None:
        self.network = network
        self.optimiser = FlatOptimiser(Optimiser("adam"), torch.from_numpy(network.flat))
        self._share = settings.batch_games // settings.num_threads
        shape = (settings.num_hidden, settings.num_outputs, network.dtype)
        self._sums = [
            ValueNetwork(*shape, network.expert) for _ in range(settings.num_threads)
        ]  # gradients have the weights' shapes
        self._scratch = [new_scratch(*shape) for _ in range(settings.num_threads)]
        self._tallies = np.zeros((settings.num_threads, 4), np.int64)
        self._pool = ThreadPoolExecutor(settings.num_threads) if settings.num_threads > 1 else None

    def step(self, rate: float, lambda_: float, dice: list[np.random.Generator], tally: NDArray[np.int64]) -> None:
        """Adds to ``tally``."""

        def play(i: int) -> None:
            net, sums = self.network, self._sums[i]
            sums.flat[:] = 0
            self._tallies[i] = 0
            play_batch(
                self._share, lambda_, dice[i], net.w, net.v, net.c, sums.w, sums.v, sums.c,
                self._scratch[i], self._tallies[i],
            )  # fmt: skip

        if self._pool is None:
            play(0)
        else:
            list(self._pool.map(play, range(len(dice))))
        grad = self._sums[0].flat
        for other in self._sums[1:]:
            grad += other.flat
        grad *= -1.0 / self._tallies[:, 3].sum()
        self.optimiser.step(torch.from_numpy(grad), rate)
        tally += self._tallies.sum(0)
