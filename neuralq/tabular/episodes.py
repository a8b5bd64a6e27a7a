"""Q-learning after each episode, backwards, and on stored transitions (Mitchell 1997, section 13.3.6)."""

from __future__ import annotations

from numpy.typing import ArrayLike

from neuralq.checks import check_choice, check_whole
from neuralq.tabular.engine import RunOptions, Source, learn, new_table, replay, table_from
from neuralq.tabular.kernels.acting import Table
from neuralq.tabular.kernels.episodes import BACKUPS, new_store, run_episodes
from neuralq.tabular.kernels.random_numbers import Seed
from neuralq.tabular.learner import Learner
from neuralq.tabular.policies import PolicyLike, StepCode, StepSizeLike, acting_code, step_code
from neuralq.tabular.results import Experience, Learned

__all__ = ["apply_episodes", "episodic_q_learning"]


def episodic_q_learning(
    source: Source,
    num_steps: int,
    gamma: float,
    *,
    order: str = "reverse",
    num_replayed: int = 0,
    capacity: int | None = None,
    policy: PolicyLike = "epsilon-greedy",
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
) -> Learned:
    """Q-learning after each episode, backwards, and again from stored transitions.

    Args:
            (set ``max_episode_steps`` where the world never does).
        order: "reverse" or "forward", of the updates of an episode.
        num_replayed: stored transitions drawn (with replacement) and updated after each episode.
        capacity: transitions stored; None for all.

    Raises:
        ValueError: an argument out of range.

    Source: Mitchell 1997, section 13.3.6; Lin 1992.

    Example:
        One episode of two steps: backwards both learn.

        >>> from neuralq.mdp import FiniteMDP
        >>> mdp = FiniteMDP.from_functions(2, 1, lambda s: [0], lambda s, a: [(1.0, 1, 8.0 * s, s == 1)], start=[1, 0])
        >>> episodic_q_learning(mdp, 2, gamma=0.5, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
        >>> episodic_q_learning(mdp, 2, gamma=0.5, step_size=1.0, order="forward").q.tolist()
        [[0.0], [8.0]]
    """
    table, ready = new_table(source, options)
    alpha = step_code(step_size, num_steps * (1 + num_replayed))
    learner = _learner(table, policy, alpha, order, num_replayed, num_steps if capacity is None else capacity)
    return learn(learner, ready, num_steps, gamma, seed, options)


def apply_episodes(
    q: ArrayLike,
    experience: Experience,
    *,
    order: str = "reverse",
    num_replayed: int = 0,
    step_size: StepSizeLike = "visits",
    seed: Seed = 0,
) -> Learned:
    """The same updates on recorded episodes.

    Args:
        experience: whole episodes; what follows the last end is not learned from.
        order: "reverse" or "forward".
        num_replayed: stored transitions drawn and updated after each episode.
        step_size: α by updates of the pair, counted from 0.
        seed: of the draws.

    Raises:
        ValueError: an argument out of range, or transitions that do not fit the table.

    Example:
        >>> steps = Experience([0, 1], [0, 0], [0.0, 8.0], [0.5, 0.0], [1, 1], [False, True])
        >>> apply_episodes([[0.0], [0.0]], steps, step_size=1.0).q.tolist()
        [[4.0], [8.0]]
    """
    code = step_code(step_size, len(experience) * (1 + num_replayed))
    learner = _learner(table_from(q), "random", code, order, num_replayed, max(1, len(experience)))
    return replay(learner, experience, seed)


def _learner(
    table: Table, policy: PolicyLike, step_size: StepCode, order: str, num_replayed: int, capacity: int
) -> Learner:
    acting = acting_code(policy)
    check_choice("order", order, ("reverse", "forward"))
    check_whole("num_replayed", num_replayed, 0)
    check_whole("capacity", capacity)
    store = new_store(int(capacity), table.q.shape)
    arguments = (step_size, store, order == "reverse", int(num_replayed))
    return Learner(run_episodes, table, acting, arguments, backups=store.counters[BACKUPS:])
