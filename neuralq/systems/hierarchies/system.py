"""Tasks made of tasks as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.hierarchies.oracle import constants, oracle
from neuralq.systems.hierarchies.pictures import curve_picture, modules_picture
from neuralq.systems.hierarchies.studies import (
    COMPOSITE,
    ENOUGH,
    PRACTICE,
    ROOM,
    Study,
    flat_study,
    modules_study,
    skills_study,
)
from neuralq.tabular import CompositionalRates

__all__ = ["HIERARCHIES", "trials_to_enough"]

SKILLS, MODULES, UNBIASED, UNLABELLED, FLAT = (
    "Lin's skills",
    "CQ-L",
    "CQ-L, K = 0",
    "CQ-L, no labels",
    "flat Q-learning",
)
_FEW, _SOME, _MANY = 100, 500, 1000  # trials: skills at most, CQ-L at most, flat at least


def _skills(seed: np.random.SeedSequence, full: bool) -> Study:
    return skills_study(seed, 400 if full else 200)


def _modules(labelled: bool = True, bias_step: float = 0.2) -> Callable[[np.random.SeedSequence, bool], Study]:
    rates = CompositionalRates(bias_step=bias_step)
    return lambda seed, full: modules_study(seed, rates, labelled=labelled, num_trials=4000 if full else 2000)


def _flat(seed: np.random.SeedSequence, full: bool) -> Study:
    return flat_study(seed, 6000 if full else 3000)


def trials_to_enough(studies: tuple[Study, ...], name: str) -> Measured:
    """Trials until composite tasks take at most 1.25 of the shortest ways.

    Example:
        >>> one = Study(np.array([0, 20, 40]), np.array([9.0, 1.2, 1.1]), *(np.zeros(1),) * 3)
        >>> trials_to_enough((one,), "a learner").values
        (20.0,)
    """
    limit = float(max(one.trials[-1] for one in studies))
    return Measured(f"{name}: trials to {ENOUGH:g} of the shortest ways", tuple(one.enough for one in studies), limit)


def _last(studies: tuple[Study, ...], name: str) -> Measured:
    return Measured(f"{name}: steps at the end, in shortest ways", tuple(float(one.ratios[-1]) for one in studies))


def _page(found: Mapping[str, tuple[Study, ...]], full: bool) -> ChapterPage:
    trials = {name: trials_to_enough(studies, name) for name, studies in found.items()}
    last = {name: _last(studies, name) for name, studies in found.items()}
    return ChapterPage(
        "hierarchies",
        "Tasks made of tasks",
        "13.8",
        _text(trials, last, found),
        (*_claims(trials), *_ours(last, found)),
        (modules_picture(found[MODULES][0]), curve_picture(found)),
        source="Singh 1992; Lin 1993",
        measured=(*trials.values(), *last.values()),
        facts={
            "tasks": "A, B, C (elemental); A then C, B then C, A then B then C (composite); 8 x 8 cells, four moves",
            "rewards": "−.05 a step, 1 at the end of the task, no discount; at most 300 steps",
            "before": f"{PRACTICE:,} trials of the elemental tasks, but for who learns all six at once",
            "CQ-L": "α = .5, softmax of temperature .01 with ε = .1; σ = .3, gate step 1, step of K .2",
            "skills": "Q-learning, α = .5, ε = .1; coordinator: SMDP Q-learning of stage and skill, a skill runs until "
            "its landmark or for 40 steps",
        },
    )


def _right_gates(study: Study) -> bool:
    """Whether every stage of a composite task takes the module that its landmark's elemental task takes."""
    chosen = study.gates.argmax(axis=1)
    composite = np.arange(ROOM.first[COMPOSITE[0]], len(ROOM.goals))
    of_landmark = chosen[: len(set(ROOM.landmarks.tolist()))]
    return len(set(of_landmark.tolist())) == len(of_landmark) and bool(
        (chosen[composite] == of_landmark[ROOM.landmarks[composite]]).all()
    )


def _held(trials: Mapping[str, Measured]) -> bool:
    return (
        trials[SKILLS].median <= _FEW
        and trials[MODULES].median <= _SOME
        and trials[FLAT].median >= _MANY
        and trials[UNBIASED].median >= 3 * trials[MODULES].median
    )


def _text(
    trials: Mapping[str, Measured], last: Mapping[str, Measured], found: Mapping[str, tuple[Study, ...]]
) -> tuple[str, ...]:
    unlabelled = sum(_right_gates(one) for one in found[UNLABELLED])
    return (
        f"{'Reproduced' if _held(trials) else 'Not reproduced with these seeds'}: whoever knows the elemental tasks "
        f"learns the composite ones sooner. Until they take at most {ENOUGH:g} of the shortest ways a coordinator of "
        f"skills needs {trials[SKILLS]} trials, CQ-L {trials[MODULES]}, and a learner of all six tasks at once "
        f"{trials[FLAT]} of all.",
        "A composite task is a sequence of elemental ones: go to A, then to C. Without a discount, and with one cost "
        "for every step, what a move is worth in the first part differs from what it is worth in the elemental task by "
        "a constant, what the rest is worth. So CQ-L (Singh) has modules that all tasks share, a gate that finds which "
        "module a stage needs, and a K for each stage. Lin gives skills by hand, lets each be practised, and learns "
        "only in which order to use them: a skill is a decision that lasts, learned about by SMDP Q-learning.",
        f"Without K the modules are told to be worth what the whole task is worth, and forget: {trials[UNBIASED]} "
        f"trials, and {last[UNBIASED]} times the shortest ways at the end. Singh's gate also finds out by itself which "
        f"module learns which elemental task. Here, where modules are not given to tasks beforehand, every stage ends "
        f"with the module of its landmark in {unlabelled} of {len(found[UNLABELLED])} seeds. A gate that judges every "
        "step by itself, as we remember his, was not made to work in any of 31 settings.",
        f"Practice is not free: with its {PRACTICE:,} trials skills come to {PRACTICE + trials[SKILLS].median:,.0f}. "
        "The gain is in what comes after.",
    )


def _claims(trials: Mapping[str, Measured]) -> tuple[Row, ...]:
    return (
        published(
            f"Lin's skills: trials to {ENOUGH:g} of the shortest ways, median [95 %]",
            "far fewer than flat",
            str(trials[SKILLS]),
            trials[SKILLS].median <= _FEW,
            f"few: at most {_FEW}",
        ),
        published(
            "CQ-L: the same",
            "fewer than flat",
            str(trials[MODULES]),
            trials[MODULES].median <= _SOME,
            f"fewer: at most {_SOME}",
        ),
        published(
            "flat Q-learning: the same, of all six tasks",
            "many",
            str(trials[FLAT]),
            trials[FLAT].median >= _MANY,
            f"many: at least {_MANY:,}",
        ),
        published(
            "CQ-L without K: the same",
            "K is needed",
            str(trials[UNBIASED]),
            trials[UNBIASED].median >= 3 * trials[MODULES].median,
            "the control: at least three times as many",
        ),
    )


def _ours(last: Mapping[str, Measured], found: Mapping[str, tuple[Study, ...]]) -> tuple[Row, ...]:
    gates = tuple(
        own(
            f"{name}: seeds in which every stage takes the right module",
            f"{sum(_right_gates(one) for one in found[name])} of {len(found[name])}",
        )
        for name in (MODULES, UNBIASED, UNLABELLED)
    )
    exact = constants()[0]
    stages = np.flatnonzero(np.abs(exact) > 1e-9)
    learned = np.median([one.biases[stages] for one in found[MODULES]], axis=0)
    said = ", ".join(f"{ours:.2f} ({told:.2f})" for ours, told in zip(learned, exact[stages], strict=True))
    return (
        *(own(f"{name}: steps at the end, in shortest ways", str(one)) for name, one in last.items()),
        *gates,
        own("CQ-L: K of AC, BC, ABC and its second stage, medians (exact)", said),
    )


HIERARCHIES = System(
    name="hierarchies",
    environment="neuralq/Landmarks-v0",
    learner="neuralq.tabular:compositional_update",
    contenders={
        SKILLS: _skills,
        MODULES: _modules(),
        UNBIASED: _modules(bias_step=0.0),
        UNLABELLED: _modules(labelled=False),
        FLAT: _flat,
    },
    baselines=(UNBIASED, FLAT),
    oracle=oracle,
    page=_page,
    num_seeds=20,
    full_num_seeds=50,
)
