"""What follows an update: the target network, and the average of the parameters where one is kept to play with."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neuralq.learners.averaging import IterateAverage
from neuralq.learners.descent import count_update
from neuralq.learners.replay.settings import ReplaySettings
from neuralq.q.engine import Engine

__all__ = ["average_for", "evaluation_parameters", "finish_update"]


def average_for(engine: Engine, settings: ReplaySettings) -> IterateAverage | None:
    """The average that the settings ask for, of the parameters as they are."""
    window = settings.average_updates
    return None if window is None else IterateAverage(engine.flat.values, window)


def finish_update(self: Any) -> None:
    """One more update of a learner: its target network and its average follow."""
    if self._average is not None:
        self._average.update()
    count_update(self, self.settings.target_period_updates, self.settings.target_rate)


def evaluation_parameters(self: Any) -> Tensor:
    """The parameters for greedy play: the average where one is kept, else those that are learned."""
    values: Tensor = self.engine.flat.values if self._average is None else self._average.values
    return values
