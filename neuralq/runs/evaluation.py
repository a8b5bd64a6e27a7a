"""Greedy evaluation: the returns of a policy without exploration, on an environment of its own.

The first episode of every environment counts and no other: taking whichever finish first would favour short ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from neuralq.checks import check_whole
from neuralq.runs.stop_request import raise_if_asked
from neuralq.runs.stream import Interaction
from neuralq.runs.stream.acting import choose_greedy

if TYPE_CHECKING:
    from neuralq.runs.held import Comparison

__all__ = ["MOST_STEPS", "Evaluation", "evaluate_greedy", "shown"]

MOST_STEPS = 10_000
"""After so many an episode is cut where nothing else is said."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Undiscounted returns and lengths of greedy episodes.

    Args:
        returns: one per episode.
        lengths: steps of each.
        num_cut: episodes that were stopped at ``max_steps`` although the environment had not ended them.
        exact: what was learned beside the exact answer, where the environment has a model and that was wanted.
        about_exact: a line on the exact answer, or on why there is none.
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    num_cut: int
    exact: Comparison | None = None
    about_exact: str | None = None

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def standard_error(self) -> float | None:
        """Of `mean`; None of one episode."""
        count = len(self.returns)
        return float(np.std(self.returns, ddof=1) / np.sqrt(count)) if count > 1 else None

    def plain(self) -> dict[str, Any]:
        """The same as plain values, for JSON."""
        plain = {"greedy_return": self.mean, "standard_error": self.standard_error, "returns": list(self.returns)}
        exact = None if self.exact is None else self.exact.plain()
        return {**plain, "lengths": list(self.lengths), "num_cut": self.num_cut, "exact": exact}

    def lines(self) -> list[str]:
        """The same for people."""
        places = 2 + _more_places(self.returns)
        error = "" if self.standard_error is None else f" ± {self.standard_error:.{places}f} (standard error)"
        spread = [f"{x:.{places - 1}f}" for x in np.percentile(self.returns, [0, 25, 50, 75, 100])]
        lines = [
            f"mean return {self.mean:.{places}f}{error} over {len(self.returns)} episodes",
            f"lowest {spread[0]}, quartiles {' '.join(spread[1:4])}, highest {spread[4]}",
        ]
        if self.num_cut:
            lines.append(f"{self.num_cut} episodes were cut off: the environment did not end them")
        if self.about_exact is not None:
            lines.append(self.about_exact)
        return lines if self.exact is None else [*lines, *self.exact.lines()]


def shown(value: float, places: int = 1) -> str:
    """A return for people: so many decimals, and two more where returns lie within ±1.

    Example:
        >>> shown(20.24), shown(0.9731)
        ('20.2', '0.973')
    """
    return f"{value:.{places + _more_places([value])}f}"


def _more_places(returns: Sequence[float]) -> int:
    return 2 if max(map(abs, returns)) <= 1 else 0


def evaluate_greedy(
    values: Callable[[Tensor], Tensor], stream: Interaction, num_episodes: int, seed: int, max_steps: int = MOST_STEPS
) -> Evaluation:
    """Play ``num_episodes`` greedy episodes.

    Args:
        values: observations ``[N, *obs]`` to action values ``[N, A]``.
        stream: an interaction with an environment made for evaluation; it is reset.
        num_episodes: how many; in rounds if there are more than environments.
        seed: of the resets; the same seed meets the same episodes.
        max_steps: bound on an episode where the environment has none.

    Returns:
        Returns and lengths in the order of environments.

    Raises:
        StopAsked: if a signal asks for the end and the evaluation may be abandoned.
    """
    check_whole("num_episodes", num_episodes)
    returns: list[float] = []
    lengths: list[int] = []
    num_cut = 0
    while len(returns) < num_episodes:
        stream.restart(seed + len(returns))
        wanted = min(stream.num_envs, num_episodes - len(returns))
        first: dict[int, tuple[float, int]] = {}
        missing = set(range(wanted))
        for _ in range(max_steps):
            raise_if_asked()
            for episode in stream.step(lambda s: choose_greedy(values(s))).episodes:
                if episode.env_index in missing:
                    first[episode.env_index] = (episode.episode_return, episode.length)
                    missing.discard(episode.env_index)
            if not missing:
                break
        running = stream.running_episodes()
        num_cut += len(missing)
        for env_index in range(wanted):
            value, length = first.get(env_index, running[env_index])
            returns.append(value)
            lengths.append(length)
    return Evaluation(tuple(returns), tuple(lengths), num_cut)
