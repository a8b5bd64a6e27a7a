"""Whole systems made of the library's parts, one folder each; they know nothing of each other.

A system of the chapter is five things with one name: an environment, a learner made of the library's rules, baselines,
an oracle and a page. To add one, write a folder with its `System`, and a line in `SYSTEMS`.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np

from neuralq.checks import check_choice, check_whole

if TYPE_CHECKING:
    from neuralq.runs.report.claims import ChapterPage, Row

__all__ = ["SYSTEMS", "System", "SystemEntry", "run_system", "system_named"]


class SystemEntry(NamedTuple):
    """Where a system is, as "module:name", what it shows in one line, CPU-seconds that it takes, and its section."""

    home: str
    summary: str
    seconds: int = 0
    section: str = "13.8"


SYSTEMS = {
    "advice": SystemEntry("neuralq.systems.advice:ADVICE", "rules told to a learner of Pengo, and refined", 60),
    "ase-ace": SystemEntry("neuralq.systems.ase_ace:ASE_ACE", "a pole balanced by the first actor-critic", 10),
    "bucket-brigade": SystemEntry(
        "neuralq.systems.bucket_brigade:BUCKET_BRIGADE", "rules that pay each other, and find food in the woods", 35
    ),
    "checkers": SystemEntry(
        "neuralq.systems.checkers:CHECKERS", "checkers, learned from its own search and by rote", 85
    ),
    "child": SystemEntry("neuralq.systems.child:CHILD", "nine mazes, each learned with what the last ones taught", 20),
    "ebnn": SystemEntry("neuralq.systems.ebnn:EBNN", "slopes from a theory that explains what was seen", 40),
    "elevators": SystemEntry("neuralq.systems.elevators:ELEVATORS", "four elevators that learn when to stop", 85),
    "hierarchies": SystemEntry(
        "neuralq.systems.hierarchies:HIERARCHIES", "tasks made of tasks, by modules and skills", 75
    ),
    "job-shop": SystemEntry(
        "neuralq.systems.job_shop:JOB_SHOP", "a schedule repaired by what was learned of schedules", 95
    ),
    "lin": SystemEntry("neuralq.systems.lin:LIN", "to eat and not to be eaten, by replay and by teaching", 90),
    "littman": SystemEntry("neuralq.systems.littman:LITTMAN", "the best way through a maze where cells look alike", 10),
    "mccallum": SystemEntry("neuralq.systems.mccallum:MCCALLUM", "a maze that can only be learned with a memory", 25),
    "obelix": SystemEntry("neuralq.systems.obelix:OBELIX", "a robot that learns to push boxes, by behaviours", 25),
    "peng-williams": SystemEntry("neuralq.systems.peng_williams:PENG_WILLIAMS", "the pole again, by Q(λ)", 15),
    "regions": SystemEntry("neuralq.systems.regions:REGIONS", "whole regions of a maze, backed up at once", 50),
    "thrun-robot": SystemEntry(
        "neuralq.systems.thrun_robot:THRUN_ROBOT", "a robot that explains its way to a target", 100
    ),
}

R = TypeVar("R")


@dataclass(frozen=True)
class System(Generic[R]):
    """One system: what `run_system` trains, measures and shows.

    Args:
        name: in `SYSTEMS`.
        environment: its id.
        learner: "module:name" of the library's rule that learns.
        contenders: learners and baselines by name. Each trains from nothing with one seed, measures what came of it and
            returns that; the second argument says whether at the original's size. Contenders with the same seed face
            the same draws as far as they draw alike.
        baselines: which of the contenders are not the learner, for comparison.
        oracle: exact checks of environment and learner, a row each.
        page: what the results of every contender, one for each seed, say and look like.
        num_seeds: by default.
        full_num_seeds: by default at the original's size.
    """

    name: str
    environment: str
    learner: str
    contenders: Mapping[str, Callable[[np.random.SeedSequence, bool], R]]
    baselines: Sequence[str]
    oracle: Callable[[], tuple[Row, ...]]
    page: Callable[[Mapping[str, tuple[R, ...]], bool], ChapterPage]
    num_seeds: int
    full_num_seeds: int


def system_named(name: str) -> System[Any]:
    """The system of that name.

    Raises:
        ValueError: there is none.

    Example:
        >>> system_named("ase-ace").environment
        'neuralq/PoleBoxes-v0'
    """
    check_choice("system", name, SYSTEMS)
    module, _, attribute = SYSTEMS[name].home.partition(":")
    system: System[Any] = getattr(importlib.import_module(module), attribute)
    return system


def run_system(
    system: System[R],
    num_seeds: int | None = None,
    full: bool = False,
    tell: Callable[[int, int, str], None] = lambda finished, total, latest: None,
) -> ChapterPage:
    """Trains every contender with every seed, several at a time, and makes the page of what came out.

    Args:
        system: which.
        num_seeds: how many; None for the system's own number.
        full: whether at the original's size where that is not the default.
        tell: told how many trainings have ended, of how many, and of which contender the latest was.

    Raises:
        ValueError: fewer than one seed.

    Example:
        >>> from neuralq.runs.report.claims import ChapterPage, Measured
        >>> def roll(seed: np.random.SeedSequence, full: bool) -> float:
        ...     return float(np.random.default_rng(seed).random())
        >>> def page(found: Mapping[str, tuple[float, ...]], full: bool) -> ChapterPage:
        ...     return ChapterPage("dice", "Dice", "13.8", (), (), measured=(Measured("rolled", found["dice"]),))
        >>> dice = System("dice", "none", "none", {"dice": roll}, (), lambda: (), page, num_seeds=3, full_num_seeds=9)
        >>> len(run_system(dice).measured[0].values), len(run_system(dice, full=True).measured[0].values)
        (3, 9)
    """
    from neuralq.runs.sweep import num_cores  # brings PyTorch, which listing the systems does not need

    if num_seeds is None:
        num_seeds = system.full_num_seeds if full else system.num_seeds
    check_whole("num_seeds", num_seeds)
    seeds = np.random.SeedSequence(0).spawn(num_seeds)
    todo = [(name, i) for i in range(num_seeds) for name in system.contenders]
    found: dict[str, dict[int, R]] = {name: {} for name in system.contenders}
    tell(0, len(todo), "compiling")
    pool = ThreadPoolExecutor(min(num_cores(), len(todo)))
    try:
        running = {pool.submit(system.contenders[name], seeds[i], full): (name, i) for name, i in todo}
        for finished, future in enumerate(as_completed(running), 1):
            name, i = running[future]
            found[name][i] = future.result()
            tell(finished, len(todo), name)
    finally:
        pool.shutdown(cancel_futures=True)
    page = system.page({name: tuple(results[i] for i in range(num_seeds)) for name, results in found.items()}, full)
    facts = {
        "environment": system.environment,
        "learner": system.learner,
        "baselines": ", ".join(system.baselines),
        "seeds": f"{num_seeds}, the same for every contender",
    }
    return dataclasses.replace(page, rows=(*page.rows, *system.oracle()), facts={**facts, **page.facts})
