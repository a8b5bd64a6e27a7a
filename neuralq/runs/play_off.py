"""Which agent a run keeps, where its last parameters are not those that were evaluated best, and what that one scores.

One evaluation that was lucky is no reason to go back to it, so both play on, on fresh episodes. What those episodes say
of the agent that is kept is then the run's result, and no longer the last evaluation, which may be another agent's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuralq.runs.evaluation import Evaluation, shown
from neuralq.runs.folder.files import as_float

__all__ = ["Score", "about", "play_off", "score_of", "told_of"]

Play = Callable[[int, int], Evaluation]

_MOST_EPISODES = 100
"""Of a play-off."""


def play_off(final: Play, best: Play, per_round: int, most_steps: int, seed: int) -> dict[str, Any]:
    """Which of two agents a run is to keep: the final one, unless the best one is better beyond chance.

    Both play the same episodes. The best is kept where the mean of its returns less the final one's exceeds the
    standard error of that difference: one evaluation that was lucky is no reason.

    Args:
        final: plays so many episodes from a seed on with the last parameters.
        best: the same with those whose evaluation scored highest.
        per_round: episodes that are played at a time.
        most_steps: of both together; a round that was begun is finished, and the first is played in any case.
        seed: of the episodes.

    Returns:
        "agent", which is "final" or "best"; of each "final_return" and "best_return" with
        "final_standard_error" and "best_standard_error"; "num_episodes"; the "difference", best less final, and its
        "standard_error".

    Example:
        >>> steady = lambda n, seed: Evaluation((500.0,) * n, (500,) * n, 0)
        >>> falls = lambda n, seed: Evaluation((500.0, 151.0) * (n // 2), (500, 151) * (n // 2), 0)
        >>> play_off(falls, steady, 20, 10**6, 0)["agent"], play_off(steady, falls, 20, 10**6, 0)["agent"]
        ('best', 'final')
    """
    returns: tuple[list[float], list[float]] = ([], [])
    num_steps = 0
    while len(returns[0]) < _MOST_EPISODES and (not returns[0] or num_steps < most_steps):
        count = min(per_round, max(2, _MOST_EPISODES - len(returns[0])))
        at = seed + len(returns[0])
        for play, kept in zip((final, best), returns, strict=True):
            found = play(count, at)
            kept += found.returns
            num_steps += sum(found.lengths)
    (last, last_error), (top, top_error) = map(_mean_and_error, returns)
    difference, error = _mean_and_error(np.subtract(returns[1], returns[0]))
    return {
        "agent": "best" if difference > error else "final",
        "final_return": last,
        "final_standard_error": last_error,
        "best_return": top,
        "best_standard_error": top_error,
        "num_episodes": len(returns[0]),
        "difference": difference,
        "standard_error": error,
    }


def _mean_and_error(returns: Any) -> tuple[float, float]:
    return float(np.mean(returns)), float(np.std(returns, ddof=1) / np.sqrt(len(returns)))


@dataclass(frozen=True, slots=True)
class Score:
    """What the agent of a run scores.

    Args:
        mean: return per episode.
        standard_error: of it; None where it is not known.
        agent: which parameters, "final" or "best".
        num_episodes: of the play-off; None where it is the last evaluation that counts.
    """

    mean: float
    standard_error: float | None
    agent: str
    num_episodes: int | None


def score_of(summary: Mapping[str, Any]) -> Score | None:
    """The score of a run's agent: of the play-off, where there was one, else of the last evaluation.

    Args:
        summary: of a run, or a result as plain values; what is missing or damaged counts as not there.

    Example:
        >>> score_of({"greedy_return": 325.5, "agent_standard_error": 31.0})
        Score(mean=325.5, standard_error=31.0, agent='final', num_episodes=None)
        >>> score_of({"greedy_return": 325.5, "play_off": {"agent": "best", "best_return": 498.0, "num_episodes": 60}})
        Score(mean=498.0, standard_error=None, agent='best', num_episodes=60)
    """
    found = summary.get("play_off")
    agent = found.get("agent") if isinstance(found, Mapping) else None
    if isinstance(found, Mapping) and agent in ("final", "best"):
        names = (f"{agent}_return", f"{agent}_standard_error", "num_episodes")
        mean, error, count = (as_float(found.get(name)) for name in names)
        if math.isfinite(mean) and math.isfinite(count):
            return Score(mean, error if math.isfinite(error) else None, str(agent), int(count))
    mean, error = (as_float(summary.get(name)) for name in ("greedy_return", "agent_standard_error"))
    return Score(mean, error if math.isfinite(error) else None, "final", None) if math.isfinite(mean) else None


def told_of(summary: Mapping[str, Any]) -> str:
    """What a run scored, for people; the last evaluation beside it where that is another number.

    Args:
        summary: as for `score_of`.

    Example:
        >>> told_of({"greedy_return": 325.5, "agent_standard_error": 31.0})
        'greedy return 325.5 ± 31'
        >>> told_of({"greedy_return": 325.5, "play_off": {"agent": "best", "best_return": 498.0, "num_episodes": 60}})
        'greedy return 498.0 of the best parameters over 60 episodes (last evaluation 325.5)'
    """
    score, last = score_of(summary), as_float(summary.get("greedy_return"))
    if score is None:
        return "not evaluated"
    error = "" if score.standard_error is None else f" ± {score.standard_error:.2g}"
    text = f"greedy return {shown(score.mean)}{error}"
    if score.num_episodes is None:
        return text
    which = "best" if score.agent == "best" else "last"
    return f"{text} of the {which} parameters over {score.num_episodes} episodes (last evaluation {shown(last)})"


def about(found: Mapping[str, Any]) -> str | None:
    """A play-off in a sentence; None where numbers are missing.

    Example:
        >>> about({"agent": "best", "final_return": 0.5, "best_return": 9.0, "num_episodes": 100,
        ...        "standard_error": 0.125})
        "it ended below its best evaluation; over 100 fresh episodes the last parameters score 0.500, the best 9.0, \
± 0.12 between them: the best are the run's agent, --final takes the last"
    """
    names = ("best_return", "final_return", "num_episodes", "standard_error")
    best, final, count, error = (as_float(found.get(name)) for name in names)
    if not all(map(math.isfinite, (best, final, count, error))):
        return None
    at = as_float(found.get("best_env_steps"))
    which = (
        "the best are the run's agent, --final takes the last"
        if found.get("agent") == "best"
        else "the last are the run's agent, for the best are not better beyond chance; --best takes them"
    )
    return (
        f"it ended below its best evaluation{f', at {at:,.0f} steps' if math.isfinite(at) else ''}; over {count:,.0f} "
        f"fresh episodes the last parameters score {shown(final)}, the best {shown(best)}, ± {error:.2g} between them: "
        f"{which}"
    )
