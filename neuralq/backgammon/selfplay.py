"""TD(λ) self-play: one network plays both sides, and every position is taught by what came after it.

Two ways to learn from the same games:

* online: Tesauro's own. Eligibility traces, an update after every turn, each game played by weights that have learned
  from all turns before; the step size is that of plain gradient steps.
* batched: a batch of games is played with fixed weights, on as many cores as there are threads; the λ-returns of all
  turns are then fitted by one step of Adam along the mean gradient.

On one core both are equal where the step size is so small that a game changes nothing (tests/test_backgammon_learning).

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

from neuralq.backgammon.kernels import new_scratch, play_batch, play_online
from neuralq.backgammon.network import ValueNetwork
from neuralq.checks import check_choice, check_fraction, check_positive, check_whole
from neuralq.optim import FlatOptimiser, Optimiser

__all__ = ["SelfPlay", "SelfPlaySettings"]


@dataclass(frozen=True)
class SelfPlaySettings:
    """How a network learns from games against itself.

    Args:
        num_games: games of the whole run, over which the schedules go.
        num_hidden: hidden units.
        num_outputs: 4 (plain win, gammon, plain loss, lost gammon), or 1 (win), which knows nothing of gammons.
        inputs: "tesauro" (198 of the bare board) or "expert" (14 more, `neuralq_envs.backgammon.expert`).
        mode: "online" or "batched".
        lambda_: λ in [0, 1] at the beginning.
        lambda_end: λ at the end, linear in between; None keeps it.
        step_size: α at the beginning: of each turn's step (online), or Adam's (batched).
        step_size_end: α at the end; in between it falls by the same factor in every game.
        batch_games: games between two steps, shared evenly by the threads; batched mode only.
        num_threads: cores that play; more than one in batched mode only. Part of what a seed stands for.
        weight_scale: initial weights are uniform in ± this.
        dtype: "float32" or "float64".

    Raises:
        ValueError: values outside their range, or that would be ignored.
    """

    num_games: int = 300_000
    num_hidden: int = 80
    num_outputs: int = 4
    inputs: str = "tesauro"
    mode: str = "online"
    lambda_: float = 0.7
    lambda_end: float | None = None
    step_size: float = 0.1
    step_size_end: float = 0.01
    batch_games: int = 16
    num_threads: int = 1
    weight_scale: float = 0.1
    dtype: str = "float32"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        for name in ("num_games", "num_hidden", "batch_games", "num_threads"):
            check_whole(name, getattr(self, name))
        check_choice("num_outputs", self.num_outputs, (1, 4))
        check_choice("inputs", self.inputs, ("tesauro", "expert"))
        check_choice("mode", self.mode, ("online", "batched"))
        check_choice("dtype", self.dtype, ("float32", "float64"))
        check_fraction("lambda_", self.lambda_)
        if self.lambda_end is not None:
            check_fraction("lambda_end", self.lambda_end)
        for name in ("step_size", "step_size_end", "weight_scale"):
            check_positive(name, getattr(self, name))
        if self.mode == "online" and self.num_threads > 1:
            raise ValueError(
                f"online learning is one game after another, got num_threads={self.num_threads}; "
                "use mode='batched', or train several seeds side by side"
            )
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
        weights, *dice = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(17))
        if settings.num_threads >= len(dice):
            raise ValueError(f"num_threads must be at most {len(dice)}, got {settings.num_threads}")
        self.network = ValueNetwork.drawn(
            settings.num_hidden, settings.num_outputs, weights,
            scale=settings.weight_scale, dtype=settings.dtype, expert=settings.inputs == "expert",
        )  # fmt: skip
        self.num_games = 0
        self.tally = np.zeros(4, np.int64)  # plain games, gammons, backgammons, turns
        self._dice = dice[: settings.num_threads]
        self._batch = _Batch(self.network, settings) if settings.mode == "batched" else None

    def play(self, num_games: int) -> None:
        """Plays so many games and learns from them; in batched mode a multiple of ``batch_games``.

        Raises:
            ValueError: no whole number of batches.
        """
        check_whole("num_games", num_games)
        if self._batch is None:
            net, games = self.network, self.num_games + np.arange(num_games)
            rates, lambdas = self.settings.step_sizes(games), self.settings.lambdas(games)
            play_online(rates, lambdas, self._dice[0], net.w, net.v, net.c, net.scratch, self.tally)
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
            "optimiser": None if self._batch is None else self._batch.optimiser.state_dict(),
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
