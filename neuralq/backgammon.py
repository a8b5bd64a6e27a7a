"""TD-Gammon by a short name: `neuralq.systems.backgammon`, for ``from neuralq.backgammon import load_agent``."""

from neuralq.systems.backgammon import *  # noqa: F403 - all of its public names, whichever they are
from neuralq.systems.backgammon import __all__ as __all__
