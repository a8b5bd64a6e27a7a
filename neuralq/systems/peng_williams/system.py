"""Q(λ) on the pole as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, own, published
from neuralq.systems import System
from neuralq.systems.peng_williams.oracle import oracle
from neuralq.systems.peng_williams.pictures import failures_picture, film
from neuralq.systems.peng_williams.trials import Settings, Training, train

__all__ = ["PENG_WILLIAMS"]

_LAMBDAS = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0)
_SMALL, _LARGE = 0.1, 0.5
_FULL_STEPS = 100_000


def _name(lambda_: float, step_size: float) -> str:
    return f"λ = {lambda_:g}" + ("" if step_size == _SMALL else f", α = {step_size:g}")


def _contender(lambda_: float, step_size: float) -> Callable[[np.random.SeedSequence, bool], Training]:
    def contend(seed: np.random.SeedSequence, full: bool) -> Training:
        long_trial_steps = _FULL_STEPS if full else 10_000
        return train(seed, Settings(lambda_, step_size, long_trial_steps=long_trial_steps))

    return contend


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    steps = next(iter(found.values()))[0].settings.long_trial_steps
    measured = {
        name: Measured(
            f"{name}: failures before a trial of {steps:,} steps",
            tuple(one.failures for one in trainings),
            trainings[0].settings.most_failures,
        )
        for name, trainings in found.items()
    }
    one_step, traced = measured[_name(0.0, _SMALL)], measured[_name(0.9, _SMALL)]
    ratio = traced.median / one_step.median
    groups = {
        f"α = {step_size:g}": [found[_name(lambda_, step_size)] for lambda_ in _LAMBDAS]
        for step_size in (_SMALL, _LARGE)
    }
    drawings = (film(found[_name(0.0, _SMALL)][0], found[_name(0.9, _SMALL)][0]), failures_picture(groups))
    return ChapterPage(
        "peng-williams",
        "A pole balanced by Q(λ)",
        "13.5",
        _text(ratio, one_step, traced, found),
        (_faster(ratio, one_step, traced), *_ours(measured, found)),
        drawings,
        source="Peng & Williams 1996",
        measured=tuple(measured.values()),
        facts={
            "what is seen": "which of 162 boxes the state is in",
            "constants": "α = .1 (and .5), γ = .99, accumulating traces that are never cut, greedy with ties drawn",
        },
    )


def _text(
    ratio: float, one_step: Measured, traced: Measured, found: Mapping[str, tuple[Training, ...]]
) -> tuple[str, ...]:
    balanced = {
        name: f"{sum(one.balanced for one in trainings) or 'none'} of {len(trainings)}"
        for name, trainings in found.items()
    }
    found_out = (
        f"Reproduced: with λ = 0.9 the pole falls {traced.median:.0f} times before it is balanced, with one-step "
        f"Q-learning {one_step.median:.0f} times (medians), {1 / ratio:.1f} times as often."
        if ratio <= 0.5
        else f"Not reproduced with these seeds: {traced.median:.0f} failures with λ = 0.9 are not half of the "
        f"{one_step.median:.0f} with one-step Q-learning (medians)."
    )
    return (
        found_out,
        "Q-learning corrects one pair of box and push at a time, by what the next box promises. Here the only reward, "
        "−1, comes when the pole falls, so it has to seep back push by push, one trial after the other. Q(λ) hands "
        "every correction to the pairs before as well, by a trace that fades with λ. Peng and Williams's version lets "
        "the trace live through pushes that were not the best ones, where Watkins's cuts it.",
        "The boxes hide where in a box the state is, so the world that the learner sees is not Markov, and what the "
        "next box promises is wrong in a way that no amount of experience mends. Longer traces lean on it less.",
        "It is no free lunch. With λ = 1, where nothing but whole trials counts, "
        f"{balanced[_name(1.0, _SMALL)]} trainings balance the pole; with λ = 0.9 and five times the step size, "
        f"{balanced[_name(0.9, _LARGE)]} do: what a long trace tears down at a fall is in proportion to both.",
    )


def _faster(ratio: float, one_step: Measured, traced: Measured) -> Row:
    return published(
        "failures until it balances, λ = 0.9 against one-step",
        "significantly fewer",
        f"{traced} against {one_step}",
        ratio <= 0.5,
        f"medians [95 %]; their ratio is {ratio:.2f}, and up to .5 counts as agreeing",
    )


def _ours(measured: Mapping[str, Measured], found: Mapping[str, tuple[Training, ...]]) -> tuple[Row, ...]:
    better = min(measured[_name(0.0, step_size)].median for step_size in (_SMALL, _LARGE))
    best = min(measured[_name(0.9, step_size)].median for step_size in (_SMALL, _LARGE))
    rows = [own("λ = 0.9 against one-step, each with its better α", f"{best:g} against {better:g}", "medians")]
    for name, one in measured.items():
        balanced = sum(training.balanced for training in found[name])
        rows.append(own(f"{name}: failures", str(one), f"{balanced} of {len(one.values)} balance"))
    return tuple(rows)


PENG_WILLIAMS = System(
    name="peng-williams",
    environment="neuralq/PoleBoxes-v0",
    learner="neuralq.tabular:q_lambda",
    contenders={
        _name(lambda_, step_size): _contender(lambda_, step_size)
        for step_size in (_SMALL, _LARGE)
        for lambda_ in _LAMBDAS
    },
    baselines=(f"{_name(0.0, _SMALL)} (one-step Q-learning)",),
    oracle=oracle,
    page=_page,
    num_seeds=30,
    full_num_seeds=100,
)
