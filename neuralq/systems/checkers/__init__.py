"""Samuel 1959: checkers learned from what its own look-ahead says, and by rote."""

from neuralq.systems.checkers.player import LEARNED, CheckersPlayer, RankedMove, plies_to_the_end
from neuralq.systems.checkers.system import CHECKERS

__all__ = ["CHECKERS", "LEARNED", "CheckersPlayer", "RankedMove", "plies_to_the_end"]
