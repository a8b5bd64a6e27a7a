"""ASE/ACE on the pole as a system: contenders, oracle and page."""

from __future__ import annotations

from collections.abc import Mapping

import gymnasium
import numpy as np

from neuralq.runs.report.claims import ChapterPage, Measured, Row, number, own, published
from neuralq.systems import System
from neuralq.systems.ase_ace.pictures import boxes_picture, film, lengths_picture
from neuralq.systems.ase_ace.trials import MOST_FAILURES, Training, train
from neuralq.tabular.kernels.ase_ace import AseAceRates
from neuralq_envs.pole import BSA_FRICTION
from neuralq_envs.pole_kernels import pole_step

__all__ = ["ASE_ACE", "difference_from_cart_pole"]

BOTH, RUBBING, ALONE, RANDOM = "ASE/ACE", "ASE/ACE with friction", "ASE alone", "random pushes"
_FEW = 300  # failures after which a hopeless contender is given up
_FULL_STEPS = 500_000


def _both(seed: np.random.SeedSequence, full: bool) -> Training:
    return train(seed, long_trial_steps=_FULL_STEPS if full else 100_000)


def _rubbing(seed: np.random.SeedSequence, full: bool) -> Training:
    return train(seed, long_trial_steps=_FULL_STEPS if full else 100_000, friction=BSA_FRICTION)


def _alone(seed: np.random.SeedSequence, full: bool) -> Training:
    return train(seed, AseAceRates(beta=0.0), most_failures=_FEW)


def _random(seed: np.random.SeedSequence, full: bool) -> Training:
    return train(seed, AseAceRates(alpha=0.0, beta=0.0), most_failures=_FEW)


def difference_from_cart_pole(num_steps: int = 1500, seed: int = 0) -> float:
    """The largest difference between a step without friction and Gymnasium's, over random pushes.

    Example:
        >>> difference_from_cart_pole(num_steps=100) < 1e-12
        True
    """
    env = gymnasium.make("CartPole-v1").unwrapped
    actions = np.random.default_rng(seed).integers(2, size=num_steps).tolist()
    env.reset(seed=seed)
    worst = 0.0
    for action in actions:
        x, x_dot, theta, theta_dot = map(float, env.state)  # type: ignore[attr-defined]
        _, _, fallen, _, _ = env.step(action)
        ours = np.array(pole_step(x, x_dot, theta, theta_dot, action, 0.0, 0.0))
        worst = max(worst, float(np.abs(ours - env.state).max()))  # type: ignore[attr-defined]
        if fallen:
            env.reset()
    return worst


def _oracle() -> tuple[Row, ...]:
    return (
        number(
            "largest difference of a step without friction from Gymnasium's CartPole",
            0.0,
            difference_from_cart_pole(),
            tol=1e-12,
            note="1,500 random pushes",
        ),
    )


def _page(found: Mapping[str, tuple[Training, ...]], full: bool) -> ChapterPage:
    steps = found[BOTH][0].long_trial_steps
    failures = {
        name: Measured(
            f"{name}: failures before a trial of {steps:,} steps",
            tuple(one.failures for one in found[name]),
            MOST_FAILURES,
        )
        for name in (BOTH, RUBBING)
    }
    late = {
        name: Measured(
            f"{name}: mean steps of the last 100 trials",
            tuple(float(np.mean(one.lengths[-100:])) for one in found[name]),
        )
        for name in (ALONE, RANDOM)
    }
    text = _text(failures[BOTH], found, steps)
    rows = (_published(failures[BOTH], found), _critic(found), *_ours(failures, late, found))
    drawings = (
        film(found[BOTH][0], AseAceRates()),
        lengths_picture({name: found[name] for name in (BOTH, ALONE, RANDOM)}),
        boxes_picture(found[BOTH][0].elements),
    )
    return ChapterPage(
        "ase-ace",
        "A pole balanced by two neuron-like elements",
        "13.8",
        text,
        rows,
        drawings,
        source="Barto, Sutton & Anderson 1983",
        measured=(*failures.values(), *late.values()),
        facts={
            "what is seen": "which of 162 boxes the state is in",
            "constants": "α = 1000, β = .5, γ = .95, traces .9 and .8, noise .01",
        },
    )


def _text(failures: Measured, found: Mapping[str, tuple[Training, ...]], steps: int) -> tuple[str, ...]:
    both, alone = (sum(one.balanced for one in found[name]) for name in (BOTH, ALONE))
    reproduced = "Reproduced: " if _critic_matters(found) else "Not reproduced with these seeds: "
    return (
        f"{reproduced}{both} of {len(found[BOTH])} trainings come to balance the pole for {steps:,} steps "
        f"({steps / 50 / 60:.0f} minutes), in the median after {failures.median:.0f} failures; without the critic "
        f"{alone or 'none'} of {len(found[ALONE])} does.",
        "A cart is pushed left or right, fifty times a second, and the only thing ever told is that the pole has "
        "fallen. The element that acts cannot know which of the last pushes was to blame: it keeps a fading trace of "
        "them. The other element learns to predict the fall from each box, and the change of that prediction tells the "
        "first one at every step whether things have become better or worse. That is temporal-difference learning, and "
        "the two together are the first actor-critic.",
        "Without the critic the acting element is corrected only where the pole falls, by a trace that has forgotten "
        "what happened two seconds before. It learns not to fall at once, and no more.",
    )


def _critic_matters(found: Mapping[str, tuple[Training, ...]]) -> bool:
    """Whether most balance with it and none without it."""
    with_it, without = (sum(one.balanced for one in found[name]) for name in (BOTH, ALONE))
    return without == 0 and 2 * with_it > len(found[BOTH])


def _published(failures: Measured, found: Mapping[str, tuple[Training, ...]]) -> Row:
    within = sum(one.balanced and one.failures <= 100 for one in found[BOTH])
    note = f"the authors' program gives up after 100; here {within} of {len(found[BOTH])} trainings are through by then"
    return published(
        "failures until it balances, median [95 %]", "at most 100", str(failures), failures.median <= 100, note
    )


def _critic(found: Mapping[str, tuple[Training, ...]]) -> Row:
    alone, both = (sum(one.balanced for one in found[name]) for name in (ALONE, BOTH))
    longest = max(int(one.lengths.max()) for one in found[ALONE])
    return published(
        "the critic tells more than the reward alone",
        "it does",
        f"{alone} of {len(found[ALONE])} balance without it, {both} with it",
        _critic_matters(found),
        f"longest trial without it: {longest:,} steps",
    )


def _ours(
    failures: Mapping[str, Measured], late: Mapping[str, Measured], found: Mapping[str, tuple[Training, ...]]
) -> tuple[Row, ...]:
    within = sum(one.balanced and one.failures <= _FEW for one in found[BOTH])
    rubbed = sum(one.balanced for one in found[RUBBING])
    return (
        own(f"trainings that balance within {_FEW} failures", f"{within} of {len(found[BOTH])}"),
        own(
            "with the original's friction: failures, median [95 %]",
            str(failures[RUBBING]),
            f"{rubbed} of {len(found[RUBBING])} balance; the others are counted with the failures they had",
        ),
        own(f"without the critic: steps of trials {_FEW - 99} to {_FEW}", str(late[ALONE])),
        own(f"pushes at random: steps of trials {_FEW - 99} to {_FEW}", str(late[RANDOM])),
    )


ASE_ACE = System(
    name="ase-ace",
    environment="neuralq/PoleBoxes-v0",
    learner="neuralq.tabular:ase_ace_update",
    contenders={BOTH: _both, RUBBING: _rubbing, ALONE: _alone, RANDOM: _random},
    baselines=(ALONE, RANDOM),
    oracle=_oracle,
    page=_page,
    num_seeds=20,
    full_num_seeds=100,
)
