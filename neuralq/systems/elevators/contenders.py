"""Who runs the elevators, each measured on the same fifty hours that nobody has learned from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neuralq.systems.elevators.controllers import (
    ALWAYS_STOP,
    HUFF,
    LQF,
    NEAREST,
    NETWORK,
    RANDOM,
    SECTOR,
    SECTOR_TOP,
    new_controller,
)  # fmt: skip
from neuralq.systems.elevators.training import Settings, Training, Waits, held_out_hours, measure, train

__all__ = ["BASELINES", "CONTENDERS", "CONTROLS", "LEARNED", "MYOPIC", "NAMES", "UNCLIPPED", "Outcome"]

LEARNED, MYOPIC, UNCLIPPED = "SMDP Q-learning", "myopic (β = 1)", "errors not clipped"
NAMES = {
    LQF: "LQF", HUFF: "HUFF", NEAREST: "nearest car", SECTOR_TOP: "sector, top first", SECTOR: "sector",
    RANDOM: "random", ALWAYS_STOP: "always stop",
}  # fmt: skip
_FULL_HOURS = 60_000
_CONTROL_HOURS = 2_000


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of one contender with one seed.

    Args:
        waits: on the fifty hours.
        seed: whose hours these are.
        training: what it learned; None for a rule of thumb.
        num_hours: it learned from; 0 for a rule of thumb.
    """

    waits: Waits
    seed: np.random.SeedSequence
    training: Training | None = None
    num_hours: int = 0


def _by_rule(rule: int) -> Callable[[np.random.SeedSequence, bool], Outcome]:
    def contend(seed: np.random.SeedSequence, full: bool) -> Outcome:
        return Outcome(measure(new_controller(rule, seed=seed), held_out_hours(seed)), seed)

    return contend


def _learning(
    settings: Settings, full_settings: Settings, watched: bool = False
) -> Callable[[np.random.SeedSequence, bool], Outcome]:
    def contend(seed: np.random.SeedSequence, full: bool) -> Outcome:
        chosen, hours = full_settings if full else settings, held_out_hours(seed)
        training = train(seed, chosen, watched=hours if watched else ())
        waits = measure(new_controller(NETWORK, network=training.network), hours)
        return Outcome(waits, seed, training, chosen.num_hours)

    return contend


CONTROLS = {
    # With β = 1 everything later than a second is forgotten; the scale makes up for the shorter integral.
    MYOPIC: Settings(_CONTROL_HOURS, beta=1.0, cost_scale=1e-4),
    UNCLIPPED: Settings(_CONTROL_HOURS, max_error=np.inf),
}
"""What must fail."""

BASELINES = tuple(NAMES.values())
CONTENDERS = {
    LEARNED: _learning(Settings(), Settings(_FULL_HOURS), watched=True),
    **{name: _by_rule(rule) for rule, name in NAMES.items()},
    **{name: _learning(control, replace(control, num_hours=_FULL_HOURS)) for name, control in CONTROLS.items()},
}
