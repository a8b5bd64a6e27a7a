"""English draughts on the full board: positions, legal moves, pictures, and an environment to play in.

`Position` is the readable door; the loops of a learner use the compiled functions of `rules` on bits.
"""

from __future__ import annotations

from neuralq_envs.checkers.position import COLOURS, MOST_QUIET_PLIES, Move, Position

__all__ = ["COLOURS", "MOST_QUIET_PLIES", "Move", "Position"]
