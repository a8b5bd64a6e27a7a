"""Problems on which learning with function approximation fails, and the controls on which it must not.

`PROBLEMS` lists one named instance of each; their constructors, in `neuralq_envs.counterexamples`, take γ, ε, the
number of states and so on. Your own are as good: ``Problem.from_mdp(mdp, features, gamma=.9)``,
``Problem.from_gymnasium("FrozenLake-v1", features)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from neuralq_envs.counterexamples.baird import (
    star,
    star_1995,
    star_control,
    star_low_gamma,
    star_on_policy,
    star_tabular,
)
from neuralq_envs.counterexamples.bertsekas import bertsekas
from neuralq_envs.counterexamples.boyan import boyan
from neuralq_envs.counterexamples.chattering import chattering
from neuralq_envs.counterexamples.collision import collision
from neuralq_envs.counterexamples.emphatic import emphatic
from neuralq_envs.counterexamples.garnet import garnet
from neuralq_envs.counterexamples.gordon import gordon, gordon_averager
from neuralq_envs.counterexamples.hall import hall
from neuralq_envs.counterexamples.kolter import kolter
from neuralq_envs.counterexamples.problem import ParametricValue, Problem
from neuralq_envs.counterexamples.spiral import spiral
from neuralq_envs.counterexamples.split import a_presplit, a_split, bellman_error_left, bellman_error_right
from neuralq_envs.counterexamples.w2w import w2w, w2w_on_policy, w2w_single
from neuralq_envs.counterexamples.walks import walk5, walk19, walk_off_policy

__all__ = ["PROBLEMS", "Entry", "ParametricValue", "Problem", "problem"]


@dataclass(frozen=True)
class Entry:
    """A name and what builds the problem of that name; nothing is built until it is asked for.

    Args:
        name: the ``name`` of the problem.
        make: builds it.

    Example:
        >>> Entry("baird", star).make().name
        'baird'
    """

    name: str
    make: Callable[[], Problem]


PROBLEMS: tuple[Entry, ...] = (
    # TD(0) goes wrong
    Entry("baird", star),
    Entry("baird-1995", star_1995),
    Entry("baird-first-edition", partial(star_1995, termination=0.01)),
    Entry("baird-control", star_control),
    Entry("baird-control-uniform", partial(star_control, solid_probability=0.5)),
    Entry("w2w", w2w),
    Entry("w2w-single", w2w_single),
    Entry("gordon", gordon),
    Entry("kolter", kolter),
    Entry("emphatic", emphatic),
    Entry("spiral", spiral),
    Entry("chattering", chattering),
    # converges, to something poor, or slowly, or not where a residual method does
    Entry("hall", hall),
    Entry("bertsekas", bertsekas),
    Entry("a-split", a_split),
    Entry("a-presplit", a_presplit),
    Entry("bellman-error-left", bellman_error_left),
    Entry("bellman-error-right", bellman_error_right),
    # fitted value iteration on continuous states belongs here
    # controls: must converge
    Entry("baird-on-policy", star_on_policy),
    Entry("baird-tabular", star_tabular),
    Entry("baird-low-gamma", star_low_gamma),
    Entry("w2w-on-policy", w2w_on_policy),
    Entry("gordon-averager", gordon_averager),
    Entry("walk5", walk5),
    Entry("walk19", walk19),
    Entry("walk-tabular", partial(walk_off_policy, "tabular")),
    Entry("walk-inverted", partial(walk_off_policy, "inverted")),
    Entry("walk-dependent", partial(walk_off_policy, "dependent")),
    Entry("boyan", boyan),
    Entry("collision", collision),
    # random: nothing is promised
    Entry("garnet", garnet),
    Entry("garnet-on-policy", partial(garnet, updates="target")),
    Entry("garnet-skewed", partial(garnet, updates="random")),
)
"""One instance of every problem, with its published parameters."""


def problem(name: str) -> Problem:
    """The problem of that name in `PROBLEMS`.

    Raises:
        ValueError: no problem has that name; the message lists them.

    Example:
        >>> problem("kolter").source
        'Kolter 2011'
    """
    for entry in PROBLEMS:
        if entry.name == name:
            return entry.make()
    raise ValueError(f"no problem is called {name!r}; there are {', '.join(entry.name for entry in PROBLEMS)}")
